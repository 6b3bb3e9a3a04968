"""Which points are no sample of any surface: isolated ones, far small groups, gross errors. Not here: moving or removing them.

Two questions, both relative to the surroundings, so that neither density nor unit matters:

1. Is it lonely? The distance to its 12th neighbour is compared with that of the surroundings (as in Breunig et al., "LOF:
   identifying density-based local outliers", 2000). What is found leaves the surroundings and the question is asked again, so
   that outliers do not vouch for each other.
2. Is it off the surface? Its distance to robust planes through the flattest parts nearby is compared with the noise there. A
   point with company at its own height (a wall, a pole, a wire, a canopy) is structure, not an error.

Limits, measured: errors below about 5 noise stds or a fifth of the distance to the 12th neighbour are noise; groups of up to five
are seen only when four such distances away; a fog of outliers denser than a sixteenth of the scan passes for vegetation; a lone
real return above flat ground (a twig, the tip of a pole) passes for an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud import noise_level
from pcdenoise.cloud.neighbours import Distances, Indices, NeighbourSearch, distinct, spatial_order
from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.errors import UsageError

Floats = NDArray[np.float64]

_REACH_POINTS = 12  # a point's reach is its distance to so many others; groups of fewer than half as many are seen as lonely
_SURROUNDINGS = 48
_DENSEST_SHARE = 0.25  # this share of the surroundings may be denser than the reach a point is compared with
_ROUNDS = 4

_SUPPORT_POINTS = 24
_FLATTEST = 8
_MIN_DEVIATION_REACHES = 0.2  # on a surface without noise, creases deviate by less
_COMPANY_SHARE = 0.5  # of the deviation that flags a point: who is so far off keeps others company
_MAX_COMPANY = 1

_BLOCK_POINTS = 4096


def find(
    points: Points,
    *,
    isolation: float = 4.0,
    deviation: float = 6.0,
    level: noise_level.NoiseLevel | None = None,
    threads: int = -1,
) -> Mask:
    """(N,) whether each of (N, 3) finite points is an outlier. Exact duplicates count once and share the answer.

    isolation: how many times the reach of its surroundings a lonely point has; 4 spares densities that jump tenfold.
    deviation: how many noise stds a gross error is off its surface. level: the noise,
    measured if not given. Fewer than 49 distinct points: none is an outlier.
    Raises UsageError for isolation <= 1 or deviation <= 0.
    """
    if isolation <= 1:
        raise UsageError(f"isolation: must be above 1, got {isolation}")
    if deviation <= 0:
        raise UsageError(f"deviation: must be above 0, got {deviation}")
    rows, place = distinct(points)
    if len(rows) <= _SURROUNDINGS:
        return np.zeros(len(points), dtype=np.bool_)
    places = points[rows]
    kept = spatial_order(places)
    for _ in range(_ROUNDS):
        lonely = _lonely(places[kept], isolation, threads)
        if not lonely.any() or len(kept) - lonely.sum() <= _SURROUNDINGS:
            break
        kept = kept[~lonely]
    outlier = np.ones(len(places), dtype=np.bool_)
    outlier[kept] = _off_surface(places[kept], deviation, level, threads)
    return outlier[place]


def _lonely(points: Points, isolation: float, threads: int) -> Mask:
    """(N,) whether the reach of each point is so many times that of its surroundings."""
    search = NeighbourSearch(points, threads)
    reach = _reach(search, points)
    rank = round(_DENSEST_SHARE * _SURROUNDINGS)
    surroundings = (reach[indices] for _, _, indices in _neighbours(search, points, _SURROUNDINGS))
    lonely: Mask = reach > isolation * np.concatenate([np.partition(reaches, rank, axis=1)[:, rank] for reaches in surroundings])
    return lonely


def _off_surface(points: Points, deviation: float, level: noise_level.NoiseLevel | None, threads: int) -> Mask:
    """(N,) whether each point is so many noise stds off the flat parts around it, and alone there."""
    search = NeighbourSearch(points, threads)
    reach = _reach(search, points)
    planes = _planes(search, points, level or noise_level.estimate(points, threads=threads))
    stds_off = np.empty(len(points))  # 0 where it is less than creases are
    for rows, _, indices in _neighbours(search, points, _SUPPORT_POINTS):
        offsets = points[rows][:, None] - planes.centre[indices]
        depth = np.abs(np.einsum("bki,bki->bk", planes.normal[indices], offsets))
        noise = planes.thickness[indices]
        flattest = np.argpartition(noise, _FLATTEST, axis=1)[:, :_FLATTEST]
        # At a crease the planes of one side pass through the point: of the depths, the second smallest is what all agree on.
        agreed = np.partition(np.take_along_axis(depth, flattest, axis=1), 1, axis=1)[:, 1]
        is_large = agreed > _MIN_DEVIATION_REACHES * np.median(reach[indices], axis=1)
        stds_off[rows] = np.where(is_large, agreed / np.maximum(np.median(noise, axis=1), np.finfo(float).tiny), 0)
    off = stds_off > deviation
    keeps_company = stds_off > _COMPANY_SHARE * deviation
    for rows, distances, indices in _neighbours(search, points, _SUPPORT_POINTS):
        near = distances <= np.median(reach[indices], axis=1)[:, None]
        off[rows] &= (keeps_company[indices] & near).sum(axis=1) <= _MAX_COMPANY
    return off


@dataclass(frozen=True)
class _Planes:
    """One robust plane per point: unit normals (N, 3), points on them (N, 3), robust standard deviations across them (N,)."""

    normal: Floats
    centre: Points
    thickness: Floats


def _planes(search: NeighbourSearch, points: Points, level: noise_level.NoiseLevel) -> _Planes:
    """Iteratively reweighted PCA with Cauchy weights, over as many points as it takes to see a surface in the noise."""
    k = int(np.clip(level.scale_points, 16, _SURROUNDINGS))
    normal, centre, thickness = np.empty_like(points), np.empty_like(points), np.empty(len(points))
    for rows, distances, indices in _neighbours(search, points, k):
        offsets = points[indices] - points[rows][:, None]
        weights = np.ones(distances.shape)
        for _ in range(3):
            mean = np.einsum("bk,bki->bi", weights, offsets) / weights.sum(axis=1)[:, None]
            centred = offsets - mean[:, None]
            normals = np.linalg.eigh(np.einsum("bk,bki,bkj->bij", weights, centred, centred))[1][:, :, 0]
            height = np.abs(np.einsum("bki,bi->bk", centred, normals))
            across = 1.4826 * np.median(height, axis=1)
            weights = 1 / (1 + (height / np.maximum(across, 1e-3 * distances[:, -1])[:, None]) ** 2)
        normal[rows], centre[rows], thickness[rows] = normals, points[rows] + mean, across
    return _Planes(normal, centre, thickness)


def _reach(search: NeighbourSearch, points: Points) -> Distances:
    return np.concatenate([distances[:, -1] for _, distances, _ in _neighbours(search, points, _REACH_POINTS)])


def _neighbours(search: NeighbourSearch, points: Points, k: int) -> Iterator[tuple[slice, Distances, Indices]]:
    """For block after block: its rows, the distances (B, k) and rows (B, k) of each point's k nearest others."""
    for start in range(0, len(points), _BLOCK_POINTS):
        rows = slice(start, start + _BLOCK_POINTS)
        distances, indices = search.knn(points[rows], k + 1)
        yield rows, distances[:, 1:], indices[:, 1:]
