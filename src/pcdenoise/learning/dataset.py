"""Clouds to learn from: noisy points, their seeds, and, where something knows it, the surface.

Not here: where surfaces and scans come from (sources.py), how clouds are made while others are learned from (ahead.py), losses,
the training loop.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcdenoise.cloud.neighbours import coordinate_hash, knn, spatial_order
from pcdenoise.cloud.noise_level import by_place, estimate
from pcdenoise.denoising.seeds import coarsen, share_of_seeds, times_noisier
from pcdenoise.learning.ahead import CloudsAhead
from pcdenoise.synthesis import noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

N_DENSE = 200_000
"""Samples by which a training surface is known: 0.5 % of its bounding sphere apart."""
N_SEEDS = 6_000
N_RAW = 48_000
N_LANDING = 4_000
"""Most seeds, raw points and landing points of one training cloud; larger ones are cut to a ball."""
_LAWS = {
    "gaussian": 0.64,
    "rays": 0.08,
    "heavy-tailed": 0.1,
    "laplace": 0.04,
    "anisotropic": 0.06,
    "beam-bias": 0.04,
    "quantised": 0.04,
}
"""How often each law of noise is met."""


_LIKELY_OTHERS = 6
"""Residuals come from any of so many samples: with the nearest alone neighbours would share one, and noise would look smaller."""


@dataclass(frozen=True)
class Surface:
    """Samples of a surface in the unit sphere, as exact as whoever gave them knows it.

    points (S, 3), normals (S, 3) of either sign; disc: radius of the tangent disc that a sample stands for.
    residual (S, 3): the noise that was taken off each sample, where the surface is a cleaned scan, else None. own_law: how often
    that very noise is put back on; the laws of synthesis are met else.
    """

    points: Array
    normals: Array
    disc: float = 2.0 * (6.0 / N_DENSE) ** 0.5
    residual: Array | None = None
    own_law: float = 0.0


@dataclass(frozen=True)
class TrainingCloud:
    """One noisy cloud, ready for the network.

    seeds (M, 3), count (M,); raw (F, 3): points that land on the seeds. Where every point is its own seed, they and
    noise_at_raw are None.
    seed_judged (M,): seeds of the surface, far enough from the cut. judged, clutter (F,): final points far enough from the cut,
    and those that belong to no surface and should stay. noise: estimated standard deviation, noise_at_seeds (M,) and noise_at_raw
    (F,) what it is there; scale: what errors are divided by.
    surface: what predictions are held to, if anybody knows it; covered (C, 3), covered_normals (C, 3): samples of it that final
    points should come close to, else none. held_out (H, 3): noisy points that the network does not see, else none.
    """

    seeds: Array
    count: Array | None
    raw: Array | None
    seed_judged: Mask
    judged: Mask
    clutter: Mask
    noise: float
    noise_at_seeds: Array
    noise_at_raw: Array | None
    scale: float
    surface: Surface | None
    covered: Array
    covered_normals: Array
    held_out: Array

    @property
    def given(self) -> tuple[Array, Array | None, Array | None, Array, Array | None]:
        """What `pyramid.descend` takes."""
        return self.seeds, self.count, self.raw, self.noise_at_seeds, self.noise_at_raw

    @property
    def n_points(self) -> int:
        """How many points a step on this cloud learns from."""
        return len(self.seeds) + len(self.judged) if self.on_surface.any() else 0

    @property
    def on_surface(self) -> Mask:
        """(F,) final points that are judged by their distance to the surface."""
        return self.judged & ~self.clutter


PROCEDURAL = re.compile(r"shapes:([1-9]\d{0,5})")
"""How a number of procedural surfaces is asked for, here and in `pcdenoise synth`."""

Draw = Callable[[int, np.random.Generator], TrainingCloud]
"""How a source gives a training cloud, for a network's number of neighbours; it can be sent to another process."""


def from_surface(load: Callable[[], Surface], neighbours: int, rng: np.random.Generator) -> TrainingCloud:
    """A cloud of the surface, turned at random, with its own density and noise."""
    surface = load()
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    residual = None if surface.residual is None else surface.residual @ turn
    return draw_cloud(
        replace(surface, points=surface.points @ turn, normals=surface.normals @ turn, residual=residual), neighbours, rng
    )


def from_noisy(load: Callable[[], Array], neighbours: int, rng: np.random.Generator, *, judging: bool = False) -> TrainingCloud:
    """A noisy cloud as it is, turned at random, some points held out: the network sees 40 to 70 % of them.

    judging: it sees those that `learned_from` gives, and the others are held out; then the rows have a fourth column.
    """
    rows = load()
    seen = rows[:, 3] > 0 if judging else rng.random(len(rows)) < rng.uniform(0.4, 0.7)
    points = rows[:, :3] @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    clutter = np.zeros(int(seen.sum()), dtype=bool)
    return _prepared(points[seen], clutter, 0.0, neighbours, rng, held_out=points[~seen])


def learned_from(load: Callable[[], Array]) -> Array:
    """(M, 3) those points of a noisy cloud that its fourth column does not set aside to judge by."""
    rows = load()
    return rows[rows[:, 3] > 0, :3]


def is_learned_from(points: Array) -> Mask:
    """(N,) three in four points of a scan, by a hash of their place in the file: the same in every part that is cut of it."""
    chosen: Mask = coordinate_hash(points, 0) >= np.uint64(2**62)
    return chosen


def draw_cloud(surface: Surface, neighbours: int, rng: np.random.Generator) -> TrainingCloud:
    """A noisy cloud of random density, noise law and level from samples of a surface in the unit sphere."""
    if surface.residual is not None and rng.random() < surface.own_law:
        noisy = _noisy_again(surface, rng)
        kept = rng.random(len(noisy)) < rng.choice([1.0, rng.uniform(0.4, 1)])
        return _prepared(noisy[kept], np.zeros(int(kept.sum()), dtype=bool), 0.0, neighbours, rng, surface=surface)
    n_points = int(np.exp(rng.uniform(np.log(4_000), np.log(150_000))))
    std = 0.0 if rng.random() < 0.04 else float(np.exp(rng.uniform(np.log(0.0015), np.log(0.036))))
    clean, clutter = _with_clutter(surface.points[_sampling(surface.points, n_points, rng)], rng)
    noisy, clutter = _with_outliers(_noise(clean, std, rng), clutter, rng)
    return _prepared(noisy, clutter, std, neighbours, rng, surface=surface)


def measured(surface: Surface, rng: np.random.Generator) -> Array:
    """(N, 3) what a scanner would give of a surface: 120 to 200 thousand points with noise of one of the laws, no gross errors.

    The noise, 0.02 to 0.2 % of the radius, is what scanners have rather than what they are tested with: up to a third of the
    spacing of the points. A cloud of little noise, cleaned, is a surface by which much noise can be taught (distill.py).
    """
    n_points = int(np.exp(rng.uniform(np.log(120_000), np.log(200_000))))
    std = float(np.exp(rng.uniform(np.log(0.0002), np.log(0.002))))
    return _noise(surface.points[_sampling(surface.points, n_points, rng)], std, rng)


def _noisy_again(surface: Surface, rng: np.random.Generator) -> Array:
    """(S, 3) the samples with the residual of other samples, all the same way along the surface, so that what errs together, such
    as the points of a beam, still does. Sign and strength are drawn."""
    assert surface.residual is not None
    points, normals = surface.points, surface.normals
    away = rng.standard_normal(3)
    slide = away - (normals @ away)[:, None] * normals
    slide *= surface.disc * rng.uniform(2, 6) / np.linalg.norm(away)
    near = knn(points, _LIKELY_OTHERS, points + slide, threads=1)[1]
    other = near[np.arange(len(points)), rng.integers(near.shape[1], size=len(points))]
    heights = (surface.residual[other] * normals[other]).sum(axis=1)
    along = surface.residual[other] - heights[:, None] * normals[other]
    same_side = np.sign((normals[other] * normals).sum(axis=1))
    strength = rng.choice([-1.0, 1.0]) * np.exp(0.15 * rng.standard_normal())
    noisy: Array = points + strength * ((heights * same_side)[:, None] * normals + along)
    return noisy


def _prepared(
    noisy: Array,
    clutter: Mask,
    std: float,
    neighbours: int,
    rng: np.random.Generator,
    *,
    surface: Surface | None = None,
    held_out: Array | None = None,
) -> TrainingCloud:
    """Seeds and landing points of (N, 3) noisy points, cut to a ball of what fits one step. std: 0 where nobody knows it."""
    order = spatial_order(noisy)
    noisy, clutter = noisy[order], clutter[order]
    level = estimate(noisy, threads=1)
    share = share_of_seeds(level, neighbours) * float(np.exp(0.15 * rng.standard_normal()))
    share = min(share, 1.0)
    limit = N_SEEDS if share == 1 else min(N_RAW, int(N_SEEDS / share))
    around = by_place(noisy, coordinate_hash(noisy, 0), level, threads=1)
    centre = noisy[rng.choice(np.flatnonzero(~clutter))]
    distance = np.linalg.norm(noisy - centre, axis=1)
    cut = len(noisy) > limit
    radius = float(np.partition(distance, limit)[limit]) if cut else np.inf
    kept = np.flatnonzero(distance < radius)
    noisy, clutter, around = noisy[kept], clutter[kept], around[kept]

    def inside(points: Array, share: float = 0.75) -> Mask:
        within: Mask = np.linalg.norm(points - centre, axis=1) < share * radius
        return within

    covered = covered_normals = np.zeros((0, 3))
    if surface is not None:
        to_cover = rng.permutation(np.flatnonzero(inside(surface.points, 0.6)))[:N_LANDING]
        covered, covered_normals = surface.points[to_cover], surface.normals[to_cover]
        near = np.linalg.norm(surface.points - centre, axis=1) < radius + 0.2
        surface = replace(surface, points=surface.points[near], normals=surface.normals[near], residual=None)
    held_out = np.zeros((0, 3)) if held_out is None else held_out[inside(held_out, 1.0)]
    misread = float(np.exp(0.1 * rng.standard_normal()))
    scale = max(std, 0.5 * level.std if std else level.std, 0.1 * level.spacing, 1e-6)
    made = partial(
        TrainingCloud, noise=misread * level.std, scale=scale,
        surface=surface, covered=covered, covered_normals=covered_normals, held_out=held_out,
    )  # fmt: skip
    if share == 1:
        judged = inside(noisy)
        return made(noisy, None, None, judged & ~clutter, judged, clutter, noise_at_seeds=misread * around, noise_at_raw=None)
    noisier = times_noisier(around, level, neighbours)
    seeds = coarsen(noisy, share, seed=int(rng.integers(2**31)), threads=1, noisier=noisier)
    seed_judged = inside(seeds.points)
    if clutter.any():
        seed_judged &= cKDTree(noisy[clutter]).query(seeds.points)[0] > 2 * level.spacing
    landing = np.sort(rng.permutation(np.flatnonzero(inside(noisy)))[:N_LANDING])
    judged = np.ones(len(landing), dtype=bool)
    given = seeds.points, seeds.count, noisy[landing], seed_judged, judged, clutter[landing]
    return made(*given, noise_at_seeds=misread * seeds.means(around), noise_at_raw=misread * around[landing])


def _sampling(surface: Array, n_points: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of the surface samples: uniform, or with a density that varies smoothly up to tenfold."""
    if rng.random() < 0.65:
        return rng.choice(len(surface), size=min(n_points, len(surface)), replace=False)
    kept = noise.thin(surface, rng, contrast=rng.uniform(2, 10))
    return rng.choice(kept, size=min(n_points, len(kept)), replace=False)


def _noise(clean: Array, std: float, rng: np.random.Generator) -> Array:
    """Noisy points: the same normal law everywhere at most times, a level that varies over the cloud or another law at others."""
    if rng.random() < 0.15:
        wave = np.sin(clean @ rng.standard_normal(3) * rng.uniform(0.5, 3) + rng.uniform(0, 6.3))
        varied: Array = clean + (noise.gaussian(clean, std, rng) - clean) * np.exp(0.4 * wave)[:, None]
        return varied
    law = rng.choice(list(_LAWS), p=list(_LAWS.values()))
    return noise.NOISES[law](clean, std, rng)


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
    result, wrong = noise.outliers(noisy, rng.uniform(0.001, 0.02), rng, reach=rng.uniform(0.01, 0.1))
    return result, clutter | wrong


class CloudSource(CloudsAhead[TrainingCloud]):
    """Training clouds from some lists of draws, each list as often as the others; the n-th depends on seed and n alone."""

    def __init__(self, draws: Sequence[Sequence[Draw]], seed: int) -> None:
        self.draws, self.seed = draws, seed

    def cloud(self, number: int, neighbours: int) -> TrainingCloud:
        """The number-th cloud."""
        rng = np.random.default_rng([self.seed, 7, number])
        draws = self.draws[int(rng.integers(len(self.draws)))]
        return draws[int(rng.integers(len(draws)))](neighbours, rng)
