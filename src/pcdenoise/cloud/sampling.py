"""Poisson-disk subsets of a cloud: no two points closer than a radius. Not here: sampling surfaces (synthesis)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pcdenoise.cloud.neighbours import Indices, radius_pairs, spatial_order
from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError

MAX_PAIRS = 6_000_000
OVERSAMPLING = 8
"""Above this ratio of points to samples a random subset is as good a start as all points."""


def poisson_disk(points: Points, radius: float, rng: np.random.Generator) -> Indices:
    """Rows (M,) of (N, 3) finite points, at least `radius` apart and within `radius` of every point left out.

    The points that a visit in random order would keep (a greedy maximal independent set), in rounds: a round keeps every
    point that comes first among its neighbours. Rows come back in that random order.
    """
    waiting: Indices = rng.permutation(len(points))
    kept = waiting[:0]
    while len(waiting):
        size = _batch_size(points[waiting], radius, rng)
        batch, waiting = waiting[:size], waiting[size:]
        kept = np.concatenate([kept, batch[_first_come(len(batch), radius_pairs(points[batch], radius))]])
        if len(waiting):
            order = spatial_order(points[waiting])
            tree = cKDTree(points[kept], balanced_tree=False, compact_nodes=False)
            free = np.empty(len(waiting), dtype=bool)
            free[order] = tree.query(points[waiting[order]], distance_upper_bound=np.nextafter(radius, np.inf))[0] > radius
            waiting = waiting[free]
    return kept


def poisson_disk_exactly(points: Points, n: int, rng: np.random.Generator) -> Indices:
    """n rows of (N, 3) finite points, as evenly spaced as a Poisson disk: spacing ~0.65 of the densest packing's.

    The radius is bisected until slightly too many points stay, then the closest pairs lose one. Raises UsageError if n > N.
    """
    if n > len(points):
        raise UsageError(f"cannot draw {n} samples from {len(points)} points; ask for fewer samples")
    candidates = rng.permutation(len(points))[: OVERSAMPLING * n]
    if n == len(candidates):
        return candidates
    kept, radius = np.arange(len(candidates)), _disk_radius(points[candidates], n)
    low, high = 0.0, np.inf
    pairs, distances = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    for _ in range(16):
        if radius > distances.max(initial=0.0) and high == np.inf:
            pairs = radius_pairs(points[candidates], radius)
            distances = np.linalg.norm(points[candidates[pairs[:, 0]]] - points[candidates[pairs[:, 1]]], axis=1)
        trial = _first_come(len(candidates), pairs[distances <= radius])
        if len(trial) >= n:
            kept, low = trial, radius
        else:
            high = radius
        if len(kept) <= 1.004 * n:
            break
        radius = 1.2 * low if high == np.inf else (low or 0.8 * high) / 2 + high / 2
    return candidates[kept[_without_closest(points[candidates[kept]], n)]]


def _first_come(n: int, pairs: Indices) -> Indices:
    """Rows (M,) of 0..n-1 that survive when each, in turn, rules out its later neighbours; pairs (P, 2) have first < second."""
    alive = np.ones(n, dtype=bool)
    kept = np.zeros(n, dtype=bool)
    first, second = pairs.T
    while alive.any():
        preceded = np.zeros(n, dtype=bool)
        preceded[second] = True
        chosen = alive & ~preceded
        kept |= chosen
        alive &= ~chosen
        alive[second[chosen[first]]] = False
        open_pairs = alive[first] & alive[second]
        first, second = first[open_pairs], second[open_pairs]
    return np.flatnonzero(kept)


def _batch_size(points: Points, radius: float, rng: np.random.Generator) -> int:
    """How many of the (N, 3) points can be paired at once: their pairs grow with the square of their number."""
    probes = rng.integers(len(points), size=64)
    tree = cKDTree(points[: 20 * 1024], balanced_tree=False, compact_nodes=False)
    n_neighbours = tree.query_ball_point(points[probes], radius, return_length=True).mean() * len(points) / tree.n
    n_pairs = n_neighbours * len(points) / 2
    return len(points) if n_pairs < MAX_PAIRS else max(64, int(len(points) * np.sqrt(MAX_PAIRS / n_pairs)))


def _disk_radius(points: Points, n: int) -> float:
    """A radius at which slightly fewer than n of (N, 3) points on a surface would stay, from their median 8th neighbour."""
    order = spatial_order(points)
    k = min(9, len(points))
    tree = cKDTree(points[order], balanced_tree=False, compact_nodes=False)
    distance = np.median(tree.query(points[order[:: max(1, len(points) // 4096)]], k=[k])[0])
    area_per_sample = np.pi * distance**2 / (k - 1) * len(points) / n
    return float(0.9 * np.sqrt(area_per_sample)) or np.finfo(np.float64).tiny


def _without_closest(points: Points, n: int) -> Indices:
    """Rows (n,) of points left when, again and again, one point of each of the closest pairs is dropped."""
    kept = np.arange(len(points))
    while len(kept) > n:
        distances, near = cKDTree(points[kept]).query(points[kept], k=2)
        rows = np.arange(len(kept))
        nearest = np.where(near[:, 0] == rows, near[:, 1], near[:, 0])
        later = np.flatnonzero((nearest[nearest] == rows) & (nearest < rows))
        if len(later) == 0:
            later = np.array([distances[:, 1].argmin()])
        drop = later[np.argsort(distances[later, 1], kind="stable")][: len(kept) - n]
        kept = np.delete(kept, drop)
    return kept
