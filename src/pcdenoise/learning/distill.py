"""Distillation: a teacher cleans the noisy training set, what it took off is put back, and the student undoes that.

No clean point is seen. The student inherits the teacher's bias, not its scatter; the next round's teacher is the student.
Not here: the student's loss, which is that of supervised learning (supervised.py).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from pcdenoise.cloud.neighbours import knn, principal_axes
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.learning.dataset import Array, Draw, Surface, from_surface
from pcdenoise.learning.sources import NoisyClouds, save_array
from pcdenoise.networks import store

_DISC_SPACINGS = 2.0
_NORMAL_POINTS = 12


def distilled(noisy: list[NoisyClouds], teacher: Path, cache: Path, own_law: float) -> list[list[Draw]]:
    """Draws from the noisy clouds as the teacher, a model folder, cleans them: each when it is first met.

    own_law: how often the noise that was taken off is put back, rather than one of the laws of synthesis.
    """
    cache.mkdir(parents=True, exist_ok=True)
    return [
        [
            partial(from_surface, partial(_kept_clean, cache / f"{i}_{n}.npy", load, teacher, own_law))
            for n, load in enumerate(clouds)
        ]
        for i, clouds in enumerate(noisy)
    ]


def cleaned(points: Array, model: store.Model, own_law: float) -> Surface:
    """(N, 3) noisy points as a surface: the teacher's answer, normals, what was taken off."""
    clean = denoise(points, model, DenoiseConfig.model_validate({"threads": 1, "relax_steps": 0})).points
    near = clean[knn(clean, _NORMAL_POINTS, threads=1)[1]]
    near -= near.mean(axis=1, keepdims=True)
    normals = principal_axes(near)[:, :, 0]
    disc = _DISC_SPACINGS * float(np.median(knn(clean, 4, clean[:: max(1, len(clean) // 1000)], threads=1)[0][:, -1]))
    return Surface(clean, normals, disc, points - clean, own_law)


def _kept_clean(path: Path, load: Callable[[], Array], teacher: Path, own_law: float) -> Surface:
    if not path.exists():
        made = cleaned(load()[:, :3], _teacher(teacher), own_law)
        assert made.residual is not None
        rows = np.concatenate([made.points, made.normals, made.residual, np.full((len(made.points), 1), made.disc)], axis=1)
        save_array(path, rows.astype(np.float32))
    rows = np.load(path).astype(np.float64)
    return Surface(rows[:, :3], rows[:, 3:6], float(rows[0, 9]), rows[:, 6:9], own_law)


@lru_cache(maxsize=2)
def _teacher(folder: Path) -> store.Model:
    return store.load(folder)
