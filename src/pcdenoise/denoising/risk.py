"""How far off points still are after passes, without ground truth: by how they answer a little more noise.

Not here: the passes themselves and what follows from the judgement (denoiser.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.blocks import each_block
from pcdenoise.cloud.neighbours import Identity, NeighbourSearch, drawn_by, nearest_to, principal_axes
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points

MOST_POINTS = 30_000
"""Of a larger cloud, those nearest to one of its points stand for all."""
_NEIGHBOURS = (16, 512)
_SHAKEN_STDS = 0.5
"""How far the copy is shaken. Less, and what a pass does by jumps (who is whose neighbour) drowns the answer."""
_NO_NOISE = 1e-6  # of the spacing: a cloud is shaken by so much at least
_LEVEL_SEES = 0.87
"""Share of the noise that its estimate shows on smooth shapes; it shows more where a thin shape is taken for noise."""
_MOST_LEFT = 0.5
"""Passes that leave a larger share of the noise say nothing about how much it was: jumps raise q, so that v would be too low."""
_SURE_TO = 0.1
"""In noise stds: errors below that are not told from none."""
_FURTHEST_STDS = 4.0  # a point further off than that is an outlier, and not counted
_DRAWS = (2, 3, 4, 5)
"""Numbers of the draws of the shake and of three axes; the network draws its seeds by 1 and by none, which these must not be."""
_NEAREST = 24  # cleaned points, one of which is the nearest along the surface


class Risk:
    """(N, 3) finite, distinct points under a level of noise, and a shaken copy: both go through the same passes.

    Stein's unbiased risk estimate (SURE), along the normal and by one random shake (Ramani, Blu, Unser 2008). Noise of variance v
    of which a pass leaves the share s, which the copy shows, gives cleaned points a squared error of m - v (1 - 2 s), if they
    moved by m on average of squares. No point is held out: a pass over half of the points is another pass.

    v is not known well. Of the noise, a pass that is right about the surface moves points by m = v (1 - 2 s + q), q the mean
    square of what comes of the shake; one that is wrong moves them further. So the least m / (1 - 2 s + q) of the passes so far
    bounds v from above, and so does what the noise's estimate may have missed.

    identity (N,): the `coordinate_hash` of where the points were in the file.
    """

    def __init__(self, points: Points, identity: Identity, level: NoiseLevel, seed: int, threads: int) -> None:
        if len(points) > MOST_POINTS:
            nearest = nearest_to(points[drawn_by(identity, seed).argmin()], points, identity, MOST_POINTS)
            points, identity = points[nearest], identity[nearest]
        self.points, self.identity = points, identity
        self._start, self._threads = points, threads
        k = int(np.clip(level.scale_points, *_NEIGHBOURS))
        index, middle = NeighbourSearch(points, threads).nearest(points, k), np.empty_like(points)
        self._normals = np.empty_like(points)

        def look(rows: slice) -> None:
            near = points[index[rows]]
            middle[rows] = near.mean(axis=1)
            near -= middle[rows, None]
            self._normals[rows] = principal_axes(near)[:, :, 0]

        each_block(look, len(points), threads)
        height = self._along(points - middle)
        self._counted = np.abs(height) <= max(_FURTHEST_STDS * level.std, np.median(np.abs(height)))
        sign, *beside = (_shares(identity, seed, number) for number in _DRAWS)
        self._shake = np.where(sign < 0, -1.0, 1.0) * max(_SHAKEN_STDS * level.std, _NO_NOISE * level.spacing)
        self._shaken = points + self._shake[:, None] * self._normals
        aside = 12**0.5 * level.spacing * np.stack(beside, axis=1)
        self._places = points + aside - self._along(aside)[:, None] * self._normals
        self._variance = (level.std / _LEVEL_SEES) ** 2
        self._last = self._measured()

    def after(self, one_pass: Callable[[Points], Points]) -> tuple[float, float]:
        """The estimated errors before and after one more pass, in the points' unit; they compare with each other alone.

        An error is the paper's: mean distance from points to the surface plus that from places on the surface to points.
        """
        self.points, self._shaken = one_pass(self.points), one_pass(self._shaken)
        before, self._last = self._last, self._measured()
        self._variance = min(self._variance, self._last.most_noise)
        return before.error(self._variance), self._last.error(self._variance)

    def _along(self, vectors: Points) -> NDArray[np.float64]:
        along: NDArray[np.float64] = np.einsum("ni,ni->n", vectors, self._normals)
        return along

    def _measured(self) -> _Passed:
        moved = self._along(self.points - self._start)[self._counted]
        answer = (self._along(self._shaken - self.points) / self._shake)[self._counted]
        near = self.points[NeighbourSearch(self.points, self._threads).knn(self._places, _NEAREST)[1]] - self._places[:, None]
        height = np.einsum("nki,ni->nk", near, self._normals)
        gap = np.sqrt(np.maximum((near**2).sum(axis=2) - height**2, 0).min(axis=1))
        return _Passed(float((moved**2).mean()), float(answer.mean()), float((answer**2).mean()), gap)


@dataclass(frozen=True)
class _Passed:
    """What shows after some passes: m, s and q of `Risk`, and gap (N,) from places to the nearest point along the surface."""

    moved: float
    left: float
    left_squared: float
    gap: NDArray[np.float64]

    @property
    def most_noise(self) -> float:
        """The bound on v that these passes give."""
        return self.moved / (1 - 2 * self.left + self.left_squared) if self.left < _MOST_LEFT else np.inf

    def error(self, variance: float) -> float:
        """As of `Risk.after`, under noise of that variance."""
        squared = max(self.moved - variance * (1 - 2 * self.left), _SURE_TO**2 * variance)
        distance = (2 / np.pi * squared) ** 0.5  # of a Gaussian with that variance
        return float(distance + np.sqrt(self.gap**2 + distance**2).mean())


def _shares(identity: Identity, seed: int, number: int) -> NDArray[np.float64]:
    """(N,) from -1/2 to 1/2, evenly spread and the same for the same point in any order."""
    shares: NDArray[np.float64] = drawn_by(drawn_by(identity, seed), number) / 2.0**64 - 0.5
    return shares
