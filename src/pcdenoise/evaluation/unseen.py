"""Error without a truth: a cleaned half of a scan judged by the other half, which nothing that cleans has seen.

The noise of the held half says nothing about the cleaned half, so that no method gains by following either. Not here: metrics
against a truth (chamfer.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud import noise_level
from pcdenoise.cloud.neighbours import NeighbourSearch, principal_axes, spatial_order
from pcdenoise.cloud.scan import Points

N_PLACES = 1000
_NEAREST = 16  # cleaned points judged at a place
_CLEAR_ASPECT = 4.4
_FEWEST, _MOST = 32, 512
_MOST_LEVERAGE = 0.5
"""A point of full leverage is fitted exactly, whatever its error."""


class Unseen:
    """Quadrics through (M, 3) held points at up to N_PLACES of them; each knows how uncertain it is."""

    def __init__(self, held: Points, seed: int = 0, threads: int = -1) -> None:
        held = held[spatial_order(held)]
        level = noise_level.estimate(held, seed, threads)
        self.threads = threads
        self._k = int(min(np.clip(2 * level.scale_points, _FEWEST, _MOST), len(held)))
        rng = np.random.default_rng(seed)
        centres = held[np.sort(rng.choice(len(held), size=min(N_PLACES, len(held)), replace=False))]
        distances, indices = NeighbourSearch(held, threads).knn(centres, self._k)
        radius = np.maximum(distances[:, -1], 1e-300)
        near = (held[indices] - centres[:, None]) / radius[:, None, None]
        middle = near.mean(axis=1, keepdims=True)
        frames = principal_axes(near - middle)
        height, u, v = np.moveaxis((near - middle) @ frames, 2, 0)
        terms = _terms(u, v)
        information = np.linalg.inv(terms.transpose(0, 2, 1) @ terms + 1e-9 * np.eye(6))
        coefficients = (information @ (terms.transpose(0, 2, 1) @ height[:, :, None]))[:, :, 0]
        left = height - np.einsum("mkt,mt->mk", terms, coefficients)
        variance = (left**2).sum(axis=1) / max(self._k - 6, 1)
        shown = np.sqrt(variance) * _CLEAR_ASPECT <= 1
        self.centres, self._middle, self._frames = centres[shown], middle[shown], frames[shown]
        self._radius, self._information = radius[shown], information[shown]
        self._coefficients, self._variance = coefficients[shown], variance[shown]

    def error(self, points: Points) -> float:
        """Root mean square height of cleaned points over the surface, at places where one shows; NaN without any.

        The surface is a quadric through the held points. What its own uncertainty adds, the held noise's variance times the
        leverage of the place, is subtracted: the square is unbiased where the surface is a quadric, whatever the noise. Points
        over which the quadric is hardly known, beside the held points or between two rows of them, do not count.
        """
        points = points[spatial_order(points)]
        if not len(self.centres) or len(points) < _NEAREST:
            return float("nan")
        indices = NeighbourSearch(points, self.threads).knn(self.centres, min(self._k, len(points)))[1]
        near = (points[indices] - self.centres[:, None]) / self._radius[:, None, None] - self._middle
        height, u, v = np.moveaxis(near @ self._frames, 2, 0)
        chosen = np.argsort(u**2 + v**2, axis=1)[:, :_NEAREST]
        height, u, v = (np.take_along_axis(values, chosen, axis=1) for values in (height, u, v))
        terms = _terms(u, v)
        squared = (height - np.einsum("mkt,mt->mk", terms, self._coefficients)) ** 2
        leverage = np.einsum("mkt,mts,mks->mk", terms, self._information, terms)
        known = leverage < _MOST_LEVERAGE
        squared = np.where(known, squared - self._variance[:, None] * leverage, 0.0).sum(axis=1)
        number = known.sum(axis=1)
        counted = number >= _NEAREST / 4
        mean: NDArray[np.float64] = squared[counted] / number[counted] * self._radius[counted] ** 2
        return float(np.sqrt(max(mean.mean(), 0.0))) if counted.any() else float("nan")


def halves(points: Points, most: int, seed: int = 0) -> tuple[Points, Points]:
    """Two random halves of (N, 3) finite points; of more than `most`, those nearest to a point drawn from them."""
    rng = np.random.default_rng(seed)
    if len(points) > most:
        distance = np.linalg.norm(points - points[rng.integers(len(points))], axis=1)
        points = points[np.argpartition(distance, most)[:most]]
    order = rng.permutation(len(points))
    return points[order[: len(points) // 2]], points[order[len(points) // 2 :]]


def _terms(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
