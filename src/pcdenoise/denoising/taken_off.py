"""The noise once more: by what a pass takes off some of the points.

What neighbours disagree by says too little where tails are long, where noise has a direction and where neighbours err alike. A
pass sees further, since it knows the surface by then, so that what it moves points by is the better reading. Not here: how
noise is read (cloud.noise_level), passes (network_pass.py).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pcdenoise.cloud.neighbours import Identity
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points, within
from pcdenoise.denoising import network_pass
from pcdenoise.networks.store import Model, ProjectionSettings

N_SAMPLES = 3
_SAMPLE_SCALES, _SAMPLE_POINTS = 24, (2000, 4000)
"""Points of a sample: of so many neighbourhoods that show the surface, within these bounds."""
_CORE = 0.5
"""Share of a sample's points, the inner ones, that count: the others see no further than its rim."""
_UNSURE, _SURE = 1.1, 1.25
"""Gaussian noise and thin parts read up to a quarter more so: factors count in full from there on, up to a tenth not at all."""
_MOST_TIMES = 2.8
"""Texture is noise to whoever does not know it, and more of it the wider one looks."""
_MOST_TURNS, _SETTLED = 3, 1.05
"""A reading is taken anew by its own light, unless it rose by less than a twentieth."""
FURTHEST_STDS = 5.0
"""Longest move of one pass along the normal: what is further from the surface is no noise but an outlier or another thing."""

Sample = tuple[Points, Identity]
"""(N, 3) points in spatial order and what they are drawn by."""


def level_by(
    read: NoiseLevel,
    centres: Points,
    around: Callable[[Points, int], Sample],
    model: Model | None,
    seed: int,
    threads: int,
) -> NoiseLevel:
    """The level, no lower than as it was read from neighbours, by what the model takes off at up to N_SAMPLES of (M, 3) places.

    around: gives so many points nearest to a place. Noise that is told, and what no projection network cleans, stays as it is.
    """
    is_seen = read.is_surface and read.std > 0 and read.share_of_noise > 0
    if model is None or not isinstance(model.config.settings, ProjectionSettings) or read.is_known or not is_seen:
        return read
    low, high = _SAMPLE_POINTS
    most = int(np.clip(_SAMPLE_SCALES * read.scale_points, low, high))
    is_whole = read.n_points <= N_SAMPLES * most
    samples = [(c, *around(c, read.n_points if is_whole else most)) for c in centres[: 1 if is_whole else N_SAMPLES]]

    def factor(level: NoiseLevel) -> float:
        taken = told = 0.0
        for centre, points, identity in samples:
            moved, noise = network_pass.projection(points, identity, level, model, [seed], threads, lambda _share: None)
            squared = ((within(FURTHEST_STDS * noise, points, moved) - points) ** 2).sum(axis=1)
            if not is_whole:
                distance = ((points - centre) ** 2).sum(axis=1)
                core = distance <= np.quantile(distance, _CORE)
                squared, noise = squared[core], noise[core]
            taken, told = taken + float(squared.sum()), told + float((noise**2).sum())
        return level.times_read * float(np.sqrt(taken / told)) if told > 0 else 1.0

    level = read
    for _turn in range(_MOST_TURNS):
        times = min(max(factor(level), 1.0), _MOST_TIMES)
        times **= read.share_of_noise * float(np.clip(np.log(times / _UNSURE) / np.log(_SURE / _UNSURE), 0, 1))
        settled = times < _SETTLED * level.times_read
        level = read.times(times)
        if settled:
            break
    return level
