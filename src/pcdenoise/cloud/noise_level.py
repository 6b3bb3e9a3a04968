"""How noisy a cloud is, as a whole and by place, and at what scale its surface shows. Not here: what is done about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import (
    Distances,
    Identity,
    Indices,
    NeighbourSearch,
    coordinate_hash,
    distinct,
    drawn_by,
    is_drawn,
    principal_axes,
    spatial_order,
)
from pcdenoise.cloud.scan import Points

N_PROBES = 1000
"""Points whose surroundings are looked at; the estimate's own scatter is then two to three percent."""

_PROBED = 128_000  # neighbours looked at on one rung of the ladder
_LADDER = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048)
_SURFACE_ASPECT = 3.8
"""A neighbourhood shows a surface once its radius is so many times what a quadric leaves in it.

A ball that is filled with noise has 2.3 to 2.9 at any size, a disc of radius R under noise std has R / std.
"""
_CERTAIN_ASPECT, _SMALL_SHARE = 4.4, 1 / 40
"""A surface shows in a small share of the cloud, or more clearly than a solid ball, cube or blob ever does: those have up to 4.3,
in neighbourhoods of half of them."""
_MOST_OF_IT, _FEW_POINTS = 3 / 4, 31
"""More of a cloud is seen from its edge, from where any blob looks flat. And what a quadric leaves of few points is chance:
of balls, cubes and blobs of N points 19 in 20 stay below _CERTAIN_ASPECT + (_FEW_POINTS / N)²."""
_CLEARER_SHARE = 0.3  # this share of all places must show it: edges and thin parts stay thick at any scale
_SEEN = ([3.0, 3.7, 4.1, 4.7, 5.2, 6.1, 8.0], [0.72, 0.82, 0.86, 0.9, 0.92, 0.94, 0.95])
_POINTS_PER_PLACE, _POINTS_AROUND, _PLACES_SEED = 32, 384, 5
"""Noise by place is read at one in so many of the points that are looked at, at N_PROBES at least, and is a mean over the places
of so many of them."""
UNCERTAIN = 4 / 3
"""A reading is told from the cloud's by what it goes beyond this factor: curvature and thin parts alone read as much."""
_PLACES_FROM, _PLACES_IN_FULL = 1.0, 4.0
"""Points within the scale of the noise at which places begin to count, and count in full: where there are few, the smallest
neighbourhood is much larger than that scale, and what it leaves may be curvature."""
_ENOUGH = 48  # points tell what a neighbourhood of any size leaves: of larger ones a share is drawn
MOST_TIMES = 3.0
"""Readings count up to so many times the cloud's noise, so that noise by place is within MOST_TIMES / UNCERTAIN of it."""
_SCALE_STDS = 4.5  # the radius of the neighbourhood of `scale_points`


@dataclass(frozen=True)
class NoiseLevel:
    """std: noise along the normal; spacing: median distance to the nearest other point (both in the points' unit).

    scale_points: how many nearest points show a surface rather than a ball of noise; it grows as std² times density.
    is_surface: whether any scale shows one (False: vegetation, clutter, a filled volume).
    is_known: whether somebody told the std. n_points: distinct points of the cloud that it was read from. times_read: how many
    times what neighbours disagree by the std is, where something else says so. least: std (M,) that there is at (M, 3) places of
    the cloud whatever neighbours show, where somebody knows.
    """

    std: float
    spacing: float
    scale_points: float
    is_surface: bool
    is_known: bool = False
    n_points: int = 0
    times_read: float = 1.0
    least: Callable[[Points], NDArray[np.float64]] | None = None

    def times(self, factor: float) -> NoiseLevel:
        """The level of so many times the noise; the scale goes with its square, as the points of a disc do."""
        std, scale_points, times_read = factor * self.std, factor**2 * self.scale_points, factor * self.times_read
        return replace(self, std=std, scale_points=scale_points, times_read=times_read)

    @property
    def share_of_noise(self) -> float:
        """How far what a place shows is noise: 0 where the smallest neighbourhood is much larger than the noise, to 1."""
        return float(np.clip((self.scale_points - _PLACES_FROM) / (_PLACES_IN_FULL - _PLACES_FROM), 0, 1))

    @property
    def as_read(self) -> NoiseLevel:
        """The level by what neighbours disagree by alone."""
        return replace(self.times(1 / self.times_read), times_read=1.0)


def estimate(points: Points, seed: int = 0, threads: int = -1, known_std: float | None = None) -> NoiseLevel:
    """The noise level of (N, 3) finite points from a fixed number of probes, at a cost that hardly grows with N.

    Neighbourhoods grow until a share of all places shows a surface; the noise is what a quadric height field leaves there,
    its six degrees of freedom given back. Exact duplicates count once. Fewer than 16 distinct points show no surface, and std 0.
    known_std: the noise where somebody knows it, and then the std; what remains to be found is the scale at which the surface
    shows under it.
    """
    points = points[distinct(points)[0]]
    points = points[spatial_order(points)]
    return estimate_at(points, probes(drawn_by(coordinate_hash(points, 0), seed)), threads, known_std)


def probes(hashes: NDArray[np.uint64]) -> Indices:
    """Rows of at most N_PROBES points drawn by their hash, as of `drawn_by`: the same points in any order and any part."""
    if len(hashes) <= N_PROBES:
        return np.arange(len(hashes))
    return np.sort(np.argpartition(hashes, N_PROBES)[:N_PROBES])


def estimate_at(points: Points, rows: Indices, threads: int = -1, known_std: float | None = None) -> NoiseLevel:
    """`estimate` for (N, 3) points that are distinct and in spatial order already, at the probes in these rows."""
    search = NeighbourSearch(points, threads)

    def nearest(centres: Points, k: int) -> tuple[Distances, Points]:
        distances, indices = search.knn(centres, k)
        return distances, points[indices]

    return estimate_from(points[rows], len(points), nearest, known_std)


Nearest = Callable[[Points, int], tuple[Distances, Points]]
"""(M, k) distances and (M, k, 3) positions of the k points nearest to (M, 3) points of the cloud, nearest first."""


def estimate_from(probed: Points, n_points: int, nearest: Nearest, known_std: float | None = None) -> NoiseLevel:
    """`estimate` at (M, 3) probes of a cloud that only `nearest` knows; it is asked for up to 2048 neighbours."""
    level = partial(NoiseLevel, is_known=known_std is not None, n_points=n_points)
    if n_points < 2:
        return level(known_std or 0.0, 0.0, float(_LADDER[0]), False)
    probed = probed[spatial_order(probed)]
    spacing = float(np.median(nearest(probed, 2)[0][:, 1]))
    if n_points < _LADDER[0]:
        return level(known_std or 0.0, spacing, float(_LADDER[0]), False)

    rungs: list[_Rung] = []
    for k in (k for k in _LADDER if k <= n_points):
        some = probed[:: max(1, N_PROBES * k // _PROBED)]
        distances, near = nearest(some, k)
        radius = np.maximum(distances[:, -1], 1e-300)
        aspect = 1 / np.maximum(_quadric_residual(near, some, radius), 1e-6)
        clear = float(np.quantile(aspect, 1 - _CLEARER_SHARE))
        std = float(np.median((radius / aspect)[aspect >= np.quantile(aspect, 0.5)]))
        rungs.append(_Rung(k, float(np.median(radius)), clear, std / _share_seen(clear)))
        if clear >= _SURFACE_ASPECT and rungs[-1].radius >= _SCALE_STDS * (known_std or rungs[-1].std):
            break
    shown = [rung for rung in rungs if rung.aspect >= _SURFACE_ASPECT]
    if not shown:
        std = known_std or max(rungs, key=lambda rung: rung.aspect).std
        return level(std, spacing, float(_LADDER[0]), False)
    std = known_std or shown[0].std
    clearest = max(rung.aspect for rung in rungs if rung.k <= max(_LADDER[0], _MOST_OF_IT * n_points))
    certain = shown[0].k <= _SMALL_SHARE * n_points or clearest >= _CERTAIN_ASPECT + (_FEW_POINTS / n_points) ** 2
    return level(std, spacing, _points_within(_SCALE_STDS * std, rungs), certain)


def around(points: Points, level: NoiseLevel, at: Points | None = None, seed: int = 0, threads: int = -1) -> NDArray[np.float64]:
    """(M,) noise std of (N, 3) finite points around each of (M, 3) places, the points themselves if not given.

    The map to the one number of `estimate`; NaN where no surface shows.
    """
    if level.times_read != 1:
        return level.times_read * around(points, level.as_read, at, seed, threads)
    at = points if at is None else at
    cloud = points[distinct(points)[0]]
    cloud = cloud[spatial_order(cloud)]
    places, std = _readings(cloud, drawn_by(coordinate_hash(cloud, 0), seed), level, threads)
    if not len(places):
        return np.full(len(at), np.nan)
    return _spread(places, std, at, level, threads)


def by_place(points: Points, identity: Identity, level: NoiseLevel, threads: int = -1) -> NDArray[np.float64]:
    """(N,) noise std at (N, 3) distinct points in spatial order, as a pass takes it: never NaN, within bounds of the level's.

    Noise that is known, and that of places without a surface, is the level's. Places are drawn by identity (N,), and what is read
    there and spread from there lies near, so that a part of a cloud gives what the whole does.
    """
    if level.least is not None and not level.is_known:
        return np.maximum(level.least(points), by_place(points, identity, replace(level, least=None), threads))
    if level.times_read != 1:
        return level.times_read * by_place(points, identity, level.as_read, threads)
    everywhere, share = np.full(len(points), level.std), level.share_of_noise
    if level.is_known or level.std <= 0 or share == 0:
        return everywhere
    places, std = _readings(points, drawn_by(identity, _PLACES_SEED), level, threads)
    if not len(places):
        return everywhere
    times = np.clip(np.where(np.isnan(std), 1.0, std / level.std), 1 / MOST_TIMES, MOST_TIMES)
    logarithm = np.log(_spread(places, times, points, level, threads))
    beyond = share * np.sign(logarithm) * np.maximum(np.abs(logarithm) - np.log(UNCERTAIN), 0)
    noise: NDArray[np.float64] = level.std * np.exp(beyond)
    return noise


def _readings(points: Points, drawn: NDArray[np.uint64], level: NoiseLevel, threads: int) -> tuple[Points, NDArray[np.float64]]:
    """(P, 3) places, some of (N, 3) points in spatial order as drawn, and the noise std (P,) that shows there.

    Neighbourhoods grow from the cloud's own scale until they show a surface, and hold what a quadric leaves in them; NaN where
    none does, or only so large a share of the cloud that it may be a thin part. Of large ones a share of the points is looked at.
    """
    looked_at = _share_looked_at(level)
    places = points[is_drawn(drawn, looked_at * _share_of_places(level))]
    std = np.full(len(places), np.nan)
    for times in (1, 2, 4, 8):
        looked_at, left = _share_looked_at(level, times), np.flatnonzero(np.isnan(std))
        k = max(_LADDER[1], round(looked_at * times * level.scale_points))
        cloud = points[is_drawn(drawn, looked_at)]
        if not len(left) or k > len(cloud) or (times > 1 and k > _SMALL_SHARE * looked_at * level.n_points):
            break
        search = NeighbourSearch(cloud, threads)
        for block in np.array_split(left, max(1, len(left) * k // _PROBED)):
            distances, indices = search.knn(places[block], k)
            radius = np.maximum(distances[:, -1], 1e-300)
            aspect = 1 / np.maximum(_quadric_residual(cloud[indices], places[block], radius), 1e-6)
            shown = aspect >= (_SURFACE_ASPECT if level.is_surface else _CERTAIN_ASPECT)
            std[block[shown]] = (radius / aspect)[shown] / np.interp(aspect[shown], *_SEEN)
    return places, std


def _share_looked_at(level: NoiseLevel, times: float = 1) -> float:
    """Of all points, those of which neighbourhoods of so many times the scale are made: not all where each would have many."""
    return min(1.0, max(_ENOUGH / (times * level.scale_points), 4 * N_PROBES / max(1, level.n_points)))


def _share_of_places(level: NoiseLevel) -> float:
    """Places per point that is looked at."""
    return min(1.0, max(1 / _POINTS_PER_PLACE, N_PROBES / max(1.0, _share_looked_at(level) * level.n_points)))


def _spread(places: Points, std: NDArray[np.float64], at: Points, level: NoiseLevel, threads: int) -> NDArray[np.float64]:
    """(M,) noise around (M, 3) points: each of the (P, 3) places takes the mean of its neighbours, then points that of places.

    Means are geometric: single readings scatter by factors. NaN where nothing was read at most of those places.
    """
    search = NeighbourSearch(places, threads)

    def mean(at: Points, k: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
        distances, index = search.knn(at, k)
        weight = 1 - 0.99 * (distances / np.maximum(distances[:, -1:], 1e-300)) ** 2
        known = weight * ~np.isnan(values[index])
        share = known.sum(axis=1)
        averaged = (known * np.nan_to_num(values[index])).sum(axis=1) / np.maximum(share, 1e-300)
        return np.where(share >= 0.5 * weight.sum(axis=1), averaged, np.nan)

    n_around = round(_POINTS_AROUND * _share_of_places(level))
    return np.exp(mean(at, 3, mean(places, n_around, np.log(np.maximum(std, 1e-300)))))


def _points_within(radius: float, rungs: list[_Rung]) -> float:
    """How many points so large a ball holds; below the first rung their number grows as the radius squared."""
    if radius <= rungs[0].radius:
        return max(1.0, rungs[0].k * (radius / rungs[0].radius) ** 2)
    return float(np.exp(np.interp(np.log(radius), [np.log(r.radius) for r in rungs], [np.log(r.k) for r in rungs])))


@dataclass(frozen=True)
class _Rung:
    k: int
    radius: float
    aspect: float
    std: float


def _share_seen(aspect: float) -> float:
    """How much of the noise a neighbourhood holds: the ball around a noisy point cuts its tails (measured on noisy planes)."""
    return float(np.interp(aspect, *_SEEN))


def _quadric_residual(near: Points, centres: Points, radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M,) standard deviation that a quadric over the PCA plane leaves in (M, k, 3) neighbourhoods, as a share of the radius."""
    near = (near - centres[:, None]) / radius[:, None, None]
    near -= near.mean(axis=1, keepdims=True)
    frames = principal_axes(near)
    height, u, v = np.moveaxis(near @ frames, 2, 0)
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    transposed = design.transpose(0, 2, 1)
    coefficients = np.linalg.solve(transposed @ design + 1e-9 * np.eye(6), transposed @ height[:, :, None])
    left = height - (design @ coefficients)[:, :, 0]
    residual: NDArray[np.float64] = np.sqrt((left**2).sum(axis=1) / (near.shape[1] - 6))
    return residual
