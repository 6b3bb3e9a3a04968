"""What is done about moves: relaxation toward even spacing, low frequencies taken back.

Relaxation runs in compiled code (relaxation.c) where a C compiler was when the program was installed, else in numpy, which says
what it does; both agree to rounding. Not here: moves along the normal (the network's), the limit on any move (cloud.scan).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.blocks import each_block
from pcdenoise.cloud.neighbours import NeighbourSearch, pairs_within, thinned
from pcdenoise.cloud.scan import Points, within
from pcdenoise.networks.fused import address

try:
    from pcdenoise.denoising import _relaxation
except ImportError:
    IS_BUILT = False
else:
    IS_BUILT = True

_NEIGHBOURS = 12
_STEP = 0.35  # of the local spacing, at most, per step
_PUSHING = 1.6  # local spacings: who is further away does not push
_REACH_STDS = 1.0
"""How far a point may slide in all, in standard deviations of the noise: isotropic noise has displaced it by so much along
the surface too, so a clean cloud stays as it is."""
_SHEET = (0.25, 0.4)
"""Planarity, (√λ₂ - √λ₁) / √λ₃ of the covariance's ascending eigenvalues, at which points begin to slide and slide in full:
one in a hundred neighbourhoods of a surface has less than 0.4, half of those in a volume or on a wire less than 0.21."""
_BLOCK = 2048
_LOW_PASS_STD = 0.4 * 2**0.5  # of its radius, as released
_LOW_PASS_POINTS = 256  # within its radius: more are thinned


def relax(points: Points, noise_std: float, steps: int, threads: int = -1) -> Points:
    """Evens the spacing of (N, 3) finite, distinct points on a surface; row i stays row i, N < 4 comes back as it was.

    Each step pushes a point away from neighbours that are nearer than the local mean, inside the tangent plane of its
    neighbourhood; at the end all land on the surface again. Where that is no sheet (wires, volumes, corners) points stay, or
    spreading them would change the shape. Neighbours are found once: the few that push are among the twelve nearest before
    and after, since nobody slides past them.
    """
    if len(points) <= 3 or noise_std <= 0 or steps == 0:
        return points
    k = min(_NEIGHBOURS, len(points) - 1)
    distances, found = NeighbourSearch(points, threads).knn(points, k + 1)
    start = np.ascontiguousarray(points, np.float64)
    sheet = (_Compiled if IS_BUILT else _Sheet)(start, found.astype(np.int32), distances[:, k] / np.sqrt(k / 2.5), threads)
    del distances, found
    current = start
    for _ in range(steps):
        current = within(_REACH_STDS * noise_std, start, sheet.pushed(current))
    return within(_REACH_STDS * noise_std, start, sheet.landed(current))


def without_low_frequencies(points: Points, moves: Points, radius: float, rng: np.random.Generator) -> Points:
    """(N, 3) moves of (N, 3) finite points less the Gaussian mean of the moves of all others within the radius.

    "Total Denoising", Iteration: noise moves neighbours against each other, shrinking moves them alike, pass after pass. Where
    there are very many neighbours, a random sample stands for them. Points without neighbours keep their move.
    """
    sums, weights = np.zeros_like(moves), np.zeros(len(moves))
    _, kept = thinned(points, points, radius, _LOW_PASS_POINTS, rng)
    for centre, other in pairs_within(points[kept], points, radius):
        squared = ((points[centre] - points[kept[other]]) ** 2).sum(axis=1)
        weight = np.where(kept[other] == centre, 0, np.exp(-squared / (2 * (_LOW_PASS_STD * radius) ** 2)))
        weights += np.bincount(centre, weight, minlength=len(moves))
        for axis in range(3):
            sums[:, axis] += np.bincount(centre, weight * moves[kept[other], axis], minlength=len(moves))
    left: Points = moves - sums / np.maximum(weights, 1e-300)[:, None]
    return left


@dataclass
class _Sheet:
    """(N, 3) points with the rows of their neighbours (N, 1 + K), each point first, and their spacing (N,).

    normal (N, 3); sheet (N,): from 0, no surface (a wire, a volume), to 1.
    """

    points: Points
    index: NDArray[np.int32]
    spacing: NDArray[np.float64]
    threads: int

    def __post_init__(self) -> None:
        self.normal, self.sheet = np.empty_like(self.points), np.empty(len(self.points))
        each_block(self._look, len(self.points), self.threads, _BLOCK)

    def pushed(self, current: Points) -> Points:
        """(N, 3) points one step further: repulsion in the tangent plane, faded where normals disagree."""
        after = np.empty_like(current)
        each_block(lambda rows: self._push(current, rows, after), len(current), self.threads, _BLOCK)
        return after

    def landed(self, current: Points) -> Points:
        """(N, 3) points back on the surface through the starting points: the projection network's step with normals alone.

        A slide along a tangent plane leaves a curved surface by κt²/2. The mean height of the neighbours over the own plane and
        the mean depth under their planes err by that much to either side, so that their half sum meets the surface.
        """
        after = np.empty_like(current)
        each_block(lambda rows: self._land(current, rows, after), len(current), self.threads, _BLOCK)
        return after

    def _look(self, rows: slice) -> None:
        offset = self.points[self.index[rows]] - self.points[rows, None]
        offset -= offset.mean(axis=1, keepdims=True)
        eigenvalues, axes = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset / self.index.shape[1])
        thin, middle, wide = np.sqrt(np.maximum(eigenvalues, 0)).T
        planarity = (middle - thin) / np.maximum(wide, 1e-300)
        self.normal[rows] = axes[:, :, 0]
        self.sheet[rows] = np.clip((planarity - _SHEET[0]) / (_SHEET[1] - _SHEET[0]), 0, 1)

    def _push(self, current: Points, rows: slice, after: Points) -> None:
        others, upright, reach = self.index[rows, 1:], self.normal[rows], self.spacing[rows, None]
        away = current[rows, None] - current[others]
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-300)
        agreement = np.einsum("mkc,mc->mk", self.normal[others], upright) ** 2
        weight = np.maximum(1 / distance - 1 / (_PUSHING * reach), 0) * agreement * self.sheet[rows, None]
        push = reach * np.einsum("mk,mkc->mc", weight, away)
        push -= (push * upright).sum(axis=1, keepdims=True) * upright
        longest = np.maximum(np.linalg.norm(push, axis=1, keepdims=True), reach)
        after[rows] = current[rows] + _STEP * reach / np.maximum(longest, 1e-300) * push

    def _land(self, current: Points, rows: slice, after: Points) -> None:
        offset, theirs = self.points[self.index[rows]] - current[rows, None], self.normal[self.index[rows]]
        squared = (offset**2).sum(axis=2)
        weight = (1 - squared / np.maximum(squared.max(axis=1, keepdims=True), 1e-300)) ** 2 + 1e-12
        weight /= weight.sum(axis=1, keepdims=True)
        upright = np.linalg.eigh(np.einsum("mk,mki,mkj->mij", weight, theirs, theirs))[1][:, :, 2]
        over = np.einsum("mk,mkc,mc->m", weight, offset, upright)[:, None] * upright
        under = np.einsum("mk,mk,mkc->mc", weight, (offset * theirs).sum(axis=2), theirs)
        after[rows] = current[rows] + 0.5 * self.sheet[rows, None] * (under + over)


class _Compiled(_Sheet):
    """The same, point by point."""

    def _look(self, rows: slice) -> None:
        given = (self._graph, rows.start, rows.stop, _at(self.points))
        _relaxation.tangents(*given, *_SHEET, _at(self.normal), _at(self.sheet))

    def _push(self, current: Points, rows: slice, after: Points) -> None:
        given = (self._graph, rows.start, rows.stop, _at(current), _at(self.normal), _at(self.sheet), _at(self.spacing))
        _relaxation.push(*given, _PUSHING, _STEP, _at(after))

    def _land(self, current: Points, rows: slice, after: Points) -> None:
        given = (self._graph, rows.start, rows.stop, _at(current), _at(self.points), _at(self.normal), _at(self.sheet))
        _relaxation.land(*given, _at(after))

    @property
    def _graph(self) -> _relaxation.Graph:
        return address(self.index, np.int32), self.index.shape[1]


def _at(values: NDArray[np.float64]) -> int:
    return address(values, np.float64)
