"""Seeds that stand for all points: spread evenly, each the mean of the points nearest to it, drawn by hash.

Not here: what the network does with them (pyramid.py, networks.fused).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import Identity, Indices, NeighbourSearch, coordinate_hash, drawn_by, is_drawn
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points

_APART = {1: 0.52, 2: 0.39, 3: 0.31, 5: 0.23}
"""Share of candidates that remain when none may be among the so many nearest of another (measured)."""
_MOST_MORE = 1.5
"""Where there is little noise there are so many times the seeds at most: others could not be spread as evenly."""
_LARGEST = 1 / 8
_LANDSCAPE = 11.0
"""Neighbourhoods hold 11·√(points that show the surface) raw points: the balance of noise, which asks for all of them, and of
curvature, which asks for few (measured on shapes that serve for nothing else)."""


@dataclass(frozen=True)
class Seeds:
    """points (M, 3): means of the raw points in each seed's cell; count (M,) of them; cell (N,): each raw point's seed."""

    points: Points
    count: NDArray[np.float64]
    cell: Indices

    def means(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M,) mean of (N,) values of the raw points in each seed's cell."""
        return np.bincount(self.cell, weights=values, minlength=len(self.points)) / self.count


def share_of_seeds(level: NoiseLevel, neighbours: int) -> float:
    """Seeds per raw point, so that those the network looks at stand for the right number of raw points; 1 for little noise."""
    share = neighbours / (_LANDSCAPE * level.scale_points**0.5)
    densest = max(_APART.values())
    return min(share, densest) if share < 1.5 * densest else 1.0


def times_noisier(noise: NDArray[np.float64], level: NoiseLevel, neighbours: int) -> NDArray[np.float64]:
    """(N,) how many times noisier than the whole cloud each point is, as far as `coarsen` should heed it.

    noise (N,): what it is there. No place is to be seen by the network as a larger share of a small cloud than _LARGEST.
    """
    largest = _LARGEST * level.n_points * share_of_seeds(level, neighbours) / neighbours
    times: NDArray[np.float64] = np.minimum(noise / level.std, max(1.0, largest))
    return times


def coarsen(
    points: Points,
    share: float,
    seed: int = 0,
    threads: int = -1,
    identity: Identity | None = None,
    noisier: NDArray[np.float64] | None = None,
) -> Seeds:
    """About share * N seeds of (N, 3) finite points in spatial order, spread evenly relative to the local density.

    identity (N,): what to draw by in place of the coordinates, for points whose last bits depend on how they were computed.
    noisier (N,): how many times noisier than the whole each place is. Seeds are so many times fewer there, and a place with
    little noise has at most _MOST_MORE times the share.
    Candidates are drawn by hash; those that are first among their nearest candidates stay, round by round; every raw point
    then joins its nearest seed. Averaging inside the cells keeps the statistical weight of every raw point.
    """
    most = share if noisier is None else min(_MOST_MORE * share, max(_APART.values()))
    apart = max((n for n, left in _APART.items() if left >= most), default=1)
    drawn = drawn_by(coordinate_hash(points, 0) if identity is None else identity, seed)
    is_candidate = is_drawn(drawn, np.minimum(share / (1.0 if noisier is None else noisier), most) / _APART[apart])
    candidates = points[is_candidate]
    if len(candidates) <= apart + 1:
        return Seeds(points, np.ones(len(points)), np.arange(len(points)))
    chosen = candidates[_first_among_nearest(candidates, drawn_by(drawn[is_candidate], 1), apart, threads)]
    cell = NeighbourSearch(chosen, threads).knn(points, 1)[1][:, 0]
    count = np.bincount(cell, minlength=len(chosen)).astype(np.float64)
    filled = count > 0
    origin = chosen.mean(axis=0)
    sums = np.stack([np.bincount(cell, weights=column, minlength=len(chosen)) for column in (points - origin).T], axis=1)
    number = np.cumsum(filled) - 1
    return Seeds(sums[filled] / count[filled, None] + origin, count[filled], number[cell])


def _first_among_nearest(candidates: Points, rank: NDArray[np.uint64], apart: int, threads: int) -> Indices:
    """Rows of a maximal set in which none is among the nearest of another: greedy in order of rank, all places at once."""
    n = len(candidates)
    near = NeighbourSearch(candidates, threads).knn(candidates, apart + 1)[1][:, 1:].ravel()
    self_ = np.repeat(np.arange(n), apart)
    ends, others = np.concatenate([self_, near]), np.concatenate([near, self_])
    place = np.empty(n, dtype=np.int64)
    place[np.lexsort((np.arange(n), rank))] = np.arange(n)
    undecided, chosen = np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
    while undecided.any():
        best = np.where(undecided, place, n)
        np.minimum.at(best, ends, np.where(undecided[others], place[others], n))
        first = undecided & (best == place)
        chosen |= first
        undecided &= ~first
        undecided[others[first[ends]]] = False
    return np.flatnonzero(chosen)
