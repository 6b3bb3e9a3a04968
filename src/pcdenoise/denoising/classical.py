"""Classical filters: mean, bilateral and jet smoothing, and their tuning on training pairs. Not here: networks, iteration, tiles.

Every filter takes (N, 3) finite float64 points in any unit and at any offset and returns as many in the same order. A point whose
neighbourhood shows no surface (too few distinct points, all on a line) comes back as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud import noise_level
from pcdenoise.cloud.neighbours import Distances, Indices, NeighbourSearch, knn, spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError

Floats = NDArray[np.float64]
Surface = Points | Callable[[Points], Distances]
"""What is clean: (M, 3) samples of the surface, or a function from (N, 3) points to their (N,) distances from it."""

_BLOCK_PAIRS = 2**16  # point-neighbour pairs of one block: what it needs then stays in the cache, whatever N
_LINE = 1e-10  # ratio of the second to the first PCA eigenvalue below which the neighbours are on a line
_RIDGE = 1e-9  # beside a mean squared term near one: neighbours on two scan lines do not fix all six parameters


def mean(points: Points, k: int | None = None, *, level: NoiseLevel | None = None, threads: int = -1) -> Points:
    """Moves each point to the mean of its k nearest points, itself included. Shrinks curved surfaces and clumps points.

    k None fits the noise level, which is measured if not given; fewer than k points stay where they are. Raises UsageError for
    k < 1.
    """
    k = neighbourhood_size(level or noise_level.estimate(points, threads=threads), 1) if k is None else _positive_count("k", k)
    moved = points.copy()
    if len(points) < k:
        return moved
    for rows, centres, _, offsets in _neighbourhoods(points, k, threads):
        moved[rows] = centres + offsets.mean(axis=2).T
    return moved


def jet(points: Points, k: int | None = None, degree: int = 2, *, level: NoiseLevel | None = None, threads: int = -1) -> Points:
    """Moves each point along its normal onto a height field fitted to its k nearest points, itself included.

    Weighted least squares in the PCA frame (Cazals and Pouget, "Estimating differential quantities using polynomial fitting
    of osculating jets", 2003), weights exp(-1.5 (distance / largest distance)²); degree 1 is a plane, 2 a quadric.
    k None fits the noise level, which is measured if not given. Raises UsageError for k < 1 or another degree.
    """
    if degree not in (1, 2):
        raise UsageError(f"degree: {degree} is not offered; use 1 (plane) or 2 (quadric)")
    k = (
        neighbourhood_size(level or noise_level.estimate(points, threads=threads), degree)
        if k is None
        else _positive_count("k", k)
    )
    moved = points.copy()
    for rows, centres, distances, offsets in _neighbourhoods(points, k, threads):
        reach = np.maximum(distances[:, -1], np.finfo(float).tiny)
        near = offsets / reach[:, None]
        weights = np.exp(-1.5 * (distances / reach[:, None]) ** 2)
        frames, shows_surface = _frames(near, weights)
        height, u, v = np.einsum("abk,bac->cbk", near, frames)
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v][: 3 * degree])
        shows_surface &= distances.shape[1] > len(terms)
        shift = np.where(shows_surface, _fit_at_centre(terms, height, weights) * reach, 0)
        moved[rows] = centres + shift[:, None] * frames[:, :, 0]
    return moved


def bilateral(
    points: Points,
    radius: float | None = None,
    sigma_d: float | None = None,
    sigma_n: float | None = None,
    *,
    iterations: int = 1,
    max_neighbours: int = 256,
    level: NoiseLevel | None = None,
    threads: int = -1,
) -> Points:
    """Moves each point along its normal by the mean height of the points around it, near ones counting more.

    Digne and de Franchis, "The Bilateral Filter for Point Clouds" (IPOL 2017): weights exp(-d² / 2σ_d² - h² / 2σ_n²) in a ball,
    d the distance and h the height over the tangent plane; its normal is the PCA normal of the ball. Lengths are in the points'
    unit. By default radius = max(4 noise stds, 4 spacings), σ_d = radius / 2, σ_n = 3 noise stds; the noise is measured
    if not given. Of a ball with more than `max_neighbours` points the nearest count. Without measurable noise (too few points,
    exact planes) there is no default, and points stay where they are. Raises UsageError unless every argument is above 0.
    """
    if radius is None or sigma_n is None:
        level = level or noise_level.estimate(points, threads=threads)
        if level.std == 0:
            return points.copy()
        radius = ball_radius(level) if radius is None else radius
        sigma_n = 3 * level.std if sigma_n is None else sigma_n
    sigma_d = radius / 2 if sigma_d is None else sigma_d
    for name, length in (("radius", radius), ("sigma_d", sigma_d), ("sigma_n", sigma_n)):
        if not length > 0:
            raise UsageError(f"{name}: must be above 0, got {length}")
    k = _positive_count("max_neighbours", max_neighbours)
    for _ in range(_positive_count("iterations", iterations)):
        moved = points.copy()
        for rows, centres, distances, offsets in _neighbourhoods(points, k, threads):
            inside = (distances <= radius).astype(np.float64)
            frames, shows_surface = _frames(offsets / radius, inside)
            height = np.einsum("abk,ba->bk", offsets, frames[:, :, 0])
            weights = inside * np.exp(-0.5 * (distances / sigma_d) ** 2 - 0.5 * (height / sigma_n) ** 2)
            shift = np.where(shows_surface, (weights * height).sum(axis=1) / weights.sum(axis=1), 0)
            moved[rows] = centres + shift[:, None] * frames[:, :, 0]
        points = moved
    return points


FILTERS: Mapping[str, Callable[..., Points]] = {"mean": mean, "bilateral": bilateral, "jet": jet}
"""The filters by the name that a configuration gives them."""


def tune(pairs: Sequence[tuple[Points, Surface]], method: str, *, threads: int = -1) -> dict[str, Any]:
    """Keyword arguments of `FILTERS[method]` with the least mean distance to the truth over (noisy points, clean surface) pairs.

    A coarse grid; lengths are multiples of the pairs' mean spacing and noise, so all pairs should share one unit, as the paper's
    do (diagonal 1). Clean samples count both ways, as in the paper's metric: prediction to samples plus samples to prediction.
    An empty dictionary says that the automatic choice was best. Raises UsageError for an unknown method or no pairs.
    """
    if method not in FILTERS:
        raise UsageError(f"method: {method} has nothing to tune; use one of {', '.join(FILTERS)}")
    if not pairs:
        raise UsageError("pairs: none given; tuning needs at least one noisy cloud with its clean surface")
    candidates: list[dict[str, Any]] = [{}]
    if method == "bilateral":
        levels = [noise_level.estimate(noisy, threads=threads) for noisy, _ in pairs]
        spacing, std = float(np.mean([level.spacing for level in levels])), float(np.mean([level.std for level in levels]))
        for spacings, share, stds in product((2, 3, 4.5, 7, 10), (1 / 3, 1 / 2, 1), (1, 2, 4)):
            lengths = {"radius": spacings * spacing, "sigma_d": share * spacings * spacing, "sigma_n": stds * std}
            candidates += [lengths] if min(lengths.values()) > 0 else []
    else:
        candidates += [{"k": k} for k in (4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)]

    def error(arguments: dict[str, Any]) -> float:
        filtered = (FILTERS[method](noisy, **arguments, threads=threads) for noisy, _ in pairs)
        return float(np.mean([_mean_distance(moved, clean) for moved, (_, clean) in zip(filtered, pairs, strict=True)]))

    return min(candidates, key=error)


def _mean_distance(points: Points, clean: Surface) -> float:
    if callable(clean):
        return float(clean(points).mean())
    return float(knn(clean, 1, points)[0].mean() + knn(points, 1, clean)[0].mean())


def _positive_count(name: str, value: int) -> int:
    if value < 1:
        raise UsageError(f"{name}: must be 1 or more, got {value}")
    return value


def ball_radius(level: NoiseLevel) -> float:
    """The bilateral filter's ball at a cloud's noise."""
    return max(4 * level.std, 4 * level.spacing)


def neighbourhood_size(level: NoiseLevel, degree: int) -> int:
    """How many points a fit of that degree needs at a cloud's noise; a mean needs as many as a plane.

    The root of what shows the surface: under strong noise it is curvature that limits the fit. Both constants are fitted to the
    best sizes on training meshes of 10K and 50K points with noise of 0.5 to 3 % of the radius.
    """
    size: int = round(max(27.0, 7.5 * level.scale_points**0.5) * degree / 2)
    return size


def _neighbourhoods(points: Points, k: int, threads: int) -> Iterator[tuple[Indices, Points, Distances, Floats]]:
    """For block after block of B near points: rows (B,), centres (B, 3), distances (B, k), offsets (3, B, k); k is cut to N."""
    order = spatial_order(points)
    ordered = points[order]
    search = NeighbourSearch(ordered, threads)
    n_rows = max(1, _BLOCK_PAIRS // k)
    for start in range(0, len(points), n_rows):
        centres = ordered[start : start + n_rows]
        distances, indices = search.knn(centres, k)
        yield order[start : start + n_rows], centres, distances, ordered.T[:, indices] - centres.T[:, :, None]


def _frames(offsets: Floats, weights: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """PCA frames of (3, B, k) offsets: (B, 3, 3), normal in column 0; and (B,) whether the points span more than a line."""
    total = weights.sum(axis=1)
    centred = offsets - ((offsets * weights).sum(axis=2) / total)[:, :, None]
    covariances = np.einsum("abk,cbk->bac", centred * weights, centred)
    eigenvalues, frames = np.linalg.eigh(covariances)
    return frames, eigenvalues[:, 1] > _LINE * eigenvalues[:, 2]


def _fit_at_centre(terms: Floats, height: Floats, weights: Floats) -> Floats:
    """(B,) value at the origin of the weighted least-squares combination of (P, B, k) terms that is nearest to (B, k) heights."""
    weighted = terms * weights
    normal_matrix = np.einsum("pbk,qbk->bpq", weighted, terms) + _RIDGE * np.eye(len(terms))
    right_side = np.einsum("pbk,bk->bp", weighted, height)
    parameters: Floats = np.linalg.solve(normal_matrix, right_side[:, :, None])
    return parameters[:, 0, 0]
