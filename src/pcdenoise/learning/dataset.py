"""Clouds to learn from: noisy points, their seeds, and where the true surface is. Not here: losses and the training loop."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.cloud.noise_level import estimate
from pcdenoise.denoising.pyramid import coarsen, share_of_seeds
from pcdenoise.synthesis.shapes import random_surface

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

N_DENSE = 200_000
"""Samples by which a training surface is known: 0.5 % of its bounding sphere apart."""
N_SEEDS = 6_000
N_RAW = 48_000
N_LANDING = 4_000
"""Most seeds, raw points and landing points of one training cloud; larger ones are cut to a ball."""


@dataclass(frozen=True)
class TrainingCloud:
    """One noisy cloud, ready for the network.

    seeds (M, 3), count (M,) or None where every point is its own seed; raw (F, 3): points that land on the seeds, or None then.
    surface (S, 3), normals (S, 3): the true surface. seed_judged (M,): seeds of the surface, far enough from the cut.
    judged, clutter (F,): final points far enough from the cut, and those that belong to no surface and should stay where they are.
    noise: estimated standard deviation; scale: what errors are divided by.
    """

    seeds: Array
    count: Array | None
    raw: Array | None
    surface: Array
    normals: Array
    seed_judged: Mask
    judged: Mask
    clutter: Mask
    noise: float
    scale: float


def draw_cloud(surface: Array, normals: Array, neighbours: int, rng: np.random.Generator) -> TrainingCloud:
    """A noisy cloud of random density, noise law and level from the (S, 3) samples of a surface in the unit sphere."""
    n_points = int(np.exp(rng.uniform(np.log(4_000), np.log(150_000))))
    std = 0.0 if rng.random() < 0.04 else float(np.exp(rng.uniform(np.log(0.0015), np.log(0.036))))
    clean, clutter = _with_clutter(surface[_sampling(surface, n_points, rng)], rng)
    noisy, clutter = _with_outliers(clean + _noise(clean, std, rng), clutter, rng)

    level = estimate(noisy, threads=1)
    share = share_of_seeds(level, neighbours) * float(np.exp(0.15 * rng.standard_normal()))
    share = min(share, 1.0)
    limit = N_SEEDS if share == 1 else min(N_RAW, int(N_SEEDS / share))
    centre = noisy[rng.choice(np.flatnonzero(~clutter))]
    distance = np.linalg.norm(noisy - centre, axis=1)
    cut = len(noisy) > limit
    radius = float(np.partition(distance, limit)[limit]) if cut else np.inf
    kept = np.flatnonzero(distance < radius)
    kept = kept[spatial_order(noisy[kept])]
    noisy, clutter = noisy[kept], clutter[kept]
    near = np.linalg.norm(surface - centre, axis=1) < radius + 0.2

    def inside(points: Array) -> Mask:
        judged: Mask = np.linalg.norm(points - centre, axis=1) < 0.75 * radius
        return judged

    truth = surface[near], normals[near]
    noise = level.std * float(np.exp(0.1 * rng.standard_normal()))
    scale = max(std, 0.05 * level.spacing, 1e-6)
    if share == 1:
        judged = inside(noisy)
        return TrainingCloud(noisy, None, None, *truth, judged & ~clutter, judged, clutter, noise, scale)
    seeds = coarsen(noisy, share, seed=int(rng.integers(2**31)), threads=1)
    seed_judged = inside(seeds.points)
    if clutter.any():
        seed_judged &= cKDTree(noisy[clutter]).query(seeds.points)[0] > 2 * level.spacing
    landing = np.sort(rng.permutation(np.flatnonzero(inside(noisy)))[:N_LANDING])
    judged = np.ones(len(landing), dtype=bool)
    return TrainingCloud(seeds.points, seeds.count, noisy[landing], *truth, seed_judged, judged, clutter[landing], noise, scale)


def _sampling(surface: Array, n_points: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of the surface samples: uniform, or with a density that varies smoothly up to tenfold."""
    n = len(surface)
    if rng.random() < 0.65:
        return rng.choice(n, size=min(n_points, n), replace=False)
    direction = rng.standard_normal(3)
    wave = np.sin(surface @ direction * rng.uniform(0.5, 4) + rng.uniform(0, 6.3))
    weight = np.exp(rng.uniform(0.3, 1.2) * wave)
    return rng.choice(n, size=min(n_points, n // 2), replace=False, p=weight / weight.sum())


def _noise(clean: Array, std: float, rng: np.random.Generator) -> Array:
    """Gaussian mostly; at times along one view direction, with heavy tails, or of a level that varies over the cloud."""
    law = rng.random()
    noise = std * rng.standard_normal(clean.shape)
    if law < 0.65:
        return noise
    if law < 0.77:
        view = rng.standard_normal(3) * 3
        ray = clean - view
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        return 0.3 * noise + std * rng.standard_normal((len(clean), 1)) * ray
    if law < 0.89:
        return noise / np.sqrt(rng.chisquare(5, (len(clean), 1)) / 5) * np.sqrt(3 / 5)
    wave = np.sin(clean @ rng.standard_normal(3) * rng.uniform(0.5, 3) + rng.uniform(0, 6.3))
    return noise * np.exp(0.4 * wave)[:, None]


def _with_clutter(clean: Array, rng: np.random.Generator) -> tuple[Array, Mask]:
    """At times adds foliage (balls of points) and wires that a denoiser must leave alone."""
    n = len(clean)
    if rng.random() > 0.15:
        return clean, np.zeros(n, dtype=bool)
    spacing = np.sqrt(6.0 / n)
    parts = [clean]
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.1, 0.4)
        centre = rng.standard_normal(3) * 0.8
        step = spacing * rng.uniform(1, 3)
        if rng.random() < 0.6:
            ball = rng.standard_normal((int(min(0.3 * n, 4 * (size / step) ** 3)) + 8, 3))
            ball *= size * rng.random((len(ball), 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
            parts.append(centre + ball)
        else:
            along = np.arange(-1, 1, spacing * rng.uniform(0.3, 1.2))[:, None]
            bend = rng.standard_normal(3) * 0.2
            parts.append(centre + along * rng.standard_normal(3) * 0.7 + along**2 * bend)
    points = np.concatenate(parts)
    return points, np.arange(len(points)) >= n


def _with_outliers(noisy: Array, clutter: Mask, rng: np.random.Generator) -> tuple[Array, Mask]:
    """At times up to 2 % gross errors; they count as clutter."""
    if rng.random() > 0.2:
        return noisy, clutter
    n = int(len(noisy) * rng.uniform(0.001, 0.02)) + 1
    gross = noisy[rng.integers(len(noisy), size=n)] + rng.standard_normal((n, 3)) * rng.uniform(0.02, 0.3)
    return np.concatenate([noisy, gross]), np.concatenate([clutter, np.ones(n, dtype=bool)])


class SurfacePool:
    """Procedural surfaces sampled once and kept as files, since sampling one costs more than learning from it."""

    def __init__(self, folder: Path, n_surfaces: int, seed: int) -> None:
        self.folder, self.n_surfaces, self.seed = folder, n_surfaces, seed
        folder.mkdir(parents=True, exist_ok=True)

    def surface(self, number: int) -> tuple[Array, Array]:
        """(S, 3) points and (S, 3) normals of one surface."""
        path = self.folder / f"{self.seed}_{number}.npy"
        if not path.exists():
            sample = random_surface(np.random.default_rng([self.seed, number]), N_DENSE)
            part = path.with_suffix(".part.npy")
            np.save(part, np.concatenate([sample.points, sample.normals], axis=1).astype(np.float32))
            part.replace(path)
        both = np.load(path).astype(np.float64)
        return both[:, :3], both[:, 3:]

    def cloud(self, number: int, neighbours: int) -> TrainingCloud:
        """The number-th training cloud of an endless series."""
        rng = np.random.default_rng([self.seed, 7, number])
        surface, normals = self.surface(int(rng.integers(self.n_surfaces)))
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        return draw_cloud(surface @ turn, normals @ turn, neighbours, rng)

    def clouds(self, first: int, neighbours: int, ahead: int = 6) -> Iterator[TrainingCloud]:
        """Endless clouds, made ahead of time by one other process."""
        with ProcessPoolExecutor(1) as makers:
            waiting: list[Future[TrainingCloud]] = [makers.submit(self.cloud, first + i, neighbours) for i in range(ahead)]
            number = first + ahead
            while True:
                yield waiting.pop(0).result()
                waiting.append(makers.submit(self.cloud, number, neighbours))
                number += 1
