"""How good passes are, without ground truth: half of the points are cleaned and judged by the other half.

Not here: the passes themselves and what follows from the judgement (denoiser.py).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch, drawn_by
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points

MOST_POINTS = 60_000
"""Of a larger cloud, those nearest to one of its points stand for all."""
_NEIGHBOURS = (16, 256)
_NEAREST = 4  # of the held-out points around a cleaned one, along the surface
_FURTHEST_STDS = 4.0
"""A held-out point further off than that is an outlier, or the cleaned one is lost."""


class HeldOut:
    """Two halves of (N, 3) finite, distinct points under a level of noise, the same ones whatever the order of rows.

    Both see the same surface, and the noise of one says nothing about that of the other. So the mean squared height of a cleaned
    point over raw, held-out ones is the noise's variance plus its squared error; the first never changes. Which ones it is above
    is decided along the surface alone: the nearest ones in space err to the same side as the point.

    identity (N,): the `coordinate_hash` of where the points were in the file; afterwards that of the cleaned half.
    """

    def __init__(self, points: Points, identity: NDArray[np.uint64], level: NoiseLevel, seed: int, threads: int) -> None:
        number = drawn_by(identity, seed)
        if len(points) > MOST_POINTS:
            distance = np.linalg.norm(points - points[number.argmin()], axis=1)
            nearest = np.argpartition(distance, MOST_POINTS)[:MOST_POINTS]
            points, number, identity = points[nearest], number[nearest], identity[nearest]
        seen = number >> np.uint64(63) == 0
        self.cleaned, self._held, self.identity = points[seen], points[~seen], identity[seen]
        self._search = NeighbourSearch(self._held, threads)
        self._k = int(np.clip(level.scale_points / 2, *_NEIGHBOURS))
        self._limit = _FURTHEST_STDS * level.std
        near = points[NeighbourSearch(points, threads).knn(self.cleaned, 2 * self._k)[1]]
        near -= near.mean(axis=1, keepdims=True)
        self._normals = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0]

    def after(self, one_pass: Callable[[Points], Points]) -> float:
        """The residual, in the points' unit, once the seen half went through one more pass."""
        self.cleaned = one_pass(self.cleaned)
        return self.residual()

    def residual(self) -> float:
        """Root mean square height of the cleaned points over held-out ones."""
        offset = self._held[self._search.knn(self.cleaned, self._k)[1]] - self.cleaned[:, None]
        height = np.einsum("mki,mi->mk", offset, self._normals)
        along = (offset**2).sum(axis=2) - height**2
        beneath = np.argpartition(along, min(_NEAREST, along.shape[1] - 1), axis=1)[:, :_NEAREST]
        height = np.take_along_axis(height, beneath, axis=1)
        return float(np.sqrt(np.minimum(height**2, self._limit**2).mean()))
