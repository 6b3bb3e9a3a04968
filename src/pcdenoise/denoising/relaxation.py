"""What is done about moves: relaxation toward even spacing, low frequencies taken back.

Relaxation runs in compiled code (relaxation.c) where a C compiler was when the program was installed, else in numpy, which says
what it does; both agree to rounding. Not here: moves along the normal (the network's), the limit on any move (cloud.scan).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.blocks import address, each_block
from pcdenoise.cloud.neighbours import NeighbourSearch, pairs_within, thinned
from pcdenoise.cloud.scan import Points, within

try:
    from pcdenoise.denoising import _relaxation
except ImportError:
    IS_BUILT = False
else:
    IS_BUILT = True

_NEIGHBOURS = 16
_DIRECTIONS = 12
_WAVES = np.stack([wave(2 * np.pi / _DIRECTIONS * np.arange(_DIRECTIONS)) for wave in (np.cos, np.sin)])
_OPEN, _WALL = (1.0, 1.4), 0.5
"""Local spacings: a cell that reaches further than the first is taken for one at an open border, in full from the second on, and
ends as far off as it would in an even cloud."""
_NO_SPACING = 1e-90  # where a pass has led points to one place; its square and cube are still numbers
_HELD = 0.02
"""Times (spacing / noise)²: of where the pass left a point and what an even cloud asks for each has its weight."""
_PACE = 1.25
"""Times the way to where both pull: Lloyd's algorithm with over-relaxation, which is as even after four steps as after five."""
_REACH_STDS = 1.5
"""How far a point may slide in all, in standard deviations of the noise: isotropic noise has displaced it by so much along
the surface too, so a clean cloud stays as it is."""
_SHEET = (0.25, 0.4)
"""Planarity, (√λ₂ - √λ₁) / √λ₃ of the covariance's ascending eigenvalues, at which points begin to slide and slide in full:
one in a hundred neighbourhoods of a surface has less than 0.4, half of those in a volume or on a wire less than 0.21."""
_BLOCK = 2048
_LOW_PASS_STD = 0.4 * 2**0.5  # of its radius, as released
_LOW_PASS_POINTS = 256  # within its radius: more are thinned


def relax(points: Points, noise_std: float | NDArray[np.float64], steps: int, threads: int = -1) -> Points:
    """Evens the spacing of (N, 3) finite, distinct points on a surface; row i stays row i, N < 4 comes back as it was.

    noise_std: standard deviation of the noise, in the points' unit, one for all or (N,) at each. Steps of Lloyd's algorithm,
    held back: each point goes to the centre of its cell in the tangent plane, as far as it may have been displaced by noise; at
    the end all land on the surface again. Where there is no sheet (wires, volumes, corners) points stay, or spreading them would
    change the shape.
    Neighbours are found once: those that bound a cell are among the sixteen nearest before and after.
    """
    if len(points) <= 3 or steps == 0 or not np.any(noise_std):
        return points
    k = min(_NEIGHBOURS, len(points) - 1)
    distances, found = NeighbourSearch(points, threads).knn(points, k + 1)
    start = np.ascontiguousarray(points, np.float64)
    spacing = np.maximum(distances[:, k] * np.sqrt(np.pi / k), _NO_SPACING)
    held = _HELD * (spacing / np.maximum(noise_std, 1e-9 * spacing)) ** 2
    sheet = (_Compiled if IS_BUILT else _Sheet)(start, found.astype(np.int32), spacing, held, threads)
    del distances, found
    current = start
    for _ in range(steps):
        current = within(_REACH_STDS * noise_std, start, sheet.evened(current))
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
    """(N, 3) points with the rows of their neighbours (N, 1 + K), each point first, their spacing (N,), and how strongly each is
    held by its start (N,), in units of how strongly its cell's centre pulls.

    normal (N, 3); sheet (N,): from 0, no surface (a wire, a volume), to 1; pace (N,): of both pulls, what a step follows.
    """

    points: Points
    index: NDArray[np.int32]
    spacing: NDArray[np.float64]
    held: NDArray[np.float64]
    threads: int

    def __post_init__(self) -> None:
        self.normal, self.sheet = np.empty_like(self.points), np.empty(len(self.points))
        each_block(self._look, len(self.points), self.threads, _BLOCK)
        self.pace = _PACE * self.sheet / (1 + self.held)

    def evened(self, current: Points) -> Points:
        """(N, 3) points one step further: on the way to the centre of their cell in the tangent plane, and held by their start.

        Along each of some directions the cell ends halfway to the neighbour that is met first. One beyond an edge is met where it
        lies as seen along the normal, or points would crowd there; one over the point, on another sheet, further away. Where
        none is near, at an open border, a cell ends where it would in an even cloud, so that borders creep less.
        """
        after = np.empty_like(current)
        each_block(lambda rows: self._even(current, rows, after), len(current), self.threads, _BLOCK)
        return after

    def landed(self, current: Points) -> Points:
        """(N, 3) points back on the surface through the starting points: the projection network's step with normals alone.

        A slide along a tangent plane leaves a curved surface by κt²/2. The mean height of the neighbours over the own plane and
        the mean depth under their planes err by that much to either side, so that their half sum meets the surface. Neighbours
        count by how well their normals agree with the own: beyond an edge is another surface.
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

    def _even(self, current: Points, rows: slice, after: Points) -> None:
        others, upright = self.index[rows, 1:], self.normal[rows]
        offset = current[others] - current[rows, None]
        first = _flattened(self.points[self.index[rows, 1]] - self.points[rows], upright)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
        second = np.cross(upright, first)
        *along, height = (np.einsum("mkc,mc->mk", offset, axis) for axis in (first, second, upright))
        squared = along[0] ** 2 + along[1] ** 2 + _agreement(self.normal[others], upright) * height**2
        nearness = 2 / np.maximum(squared, 1e-300)
        shares = sum((nearness * side)[:, :, None] * wave for side, wave in zip(along, _WAVES, strict=True))
        ends, spacing = np.maximum(shares.max(axis=1), 1e-300), self.spacing[rows, None]
        radius = np.minimum(1 / ends, _OPEN[1] * spacing)
        is_open = np.maximum((radius / spacing - _OPEN[0]) / (_OPEN[1] - _OPEN[0]), 0)
        radius += is_open * (_WALL * spacing - radius)
        third, area = 2 / 3 * radius**3, np.maximum((radius**2).sum(axis=1), 1e-300)
        to_centre = sum(
            ((third * wave).sum(axis=1) / area)[:, None] * axis for wave, axis in zip(_WAVES, (first, second), strict=True)
        )
        back = _flattened(self.points[rows] - current[rows], upright)
        after[rows] = current[rows] + self.pace[rows, None] * (to_centre + self.held[rows, None] * back)

    def _land(self, current: Points, rows: slice, after: Points) -> None:
        offset, theirs = self.points[self.index[rows]] - current[rows, None], self.normal[self.index[rows]]
        squared = (offset**2).sum(axis=2)
        falling = 1 - squared / np.maximum(squared.max(axis=1, keepdims=True), 1e-300)
        weight = falling**2 * _agreement(theirs, self.normal[rows]) + 1e-12
        weight /= weight.sum(axis=1, keepdims=True)
        upright = np.linalg.eigh(np.einsum("mk,mki,mkj->mij", weight, theirs, theirs))[1][:, :, 2]
        over = np.einsum("mk,mkc,mc->m", weight, offset, upright)[:, None] * upright
        under = np.einsum("mk,mk,mkc->mc", weight, (offset * theirs).sum(axis=2), theirs)
        after[rows] = current[rows] + 0.5 * self.sheet[rows, None] * (under + over)


def _agreement(theirs: NDArray[np.float64], own: Points) -> NDArray[np.float64]:
    """(M, K) from 0 to 1, half at 24 degrees: how well unit normals (M, K, 3) agree with (M, 3) others, signs apart."""
    agreement: NDArray[np.float64] = np.einsum("mkc,mc->mk", theirs, own) ** 8
    return agreement


def _flattened(vectors: Points, normal: Points) -> Points:
    """(M, 3) what is left of vectors in the planes across (M, 3) unit normals."""
    flat: Points = vectors - (vectors * normal).sum(axis=1, keepdims=True) * normal
    return flat


class _Compiled(_Sheet):
    """The same, point by point."""

    def _look(self, rows: slice) -> None:
        given = (self._graph, rows.start, rows.stop, _at(self.points))
        _relaxation.tangents(*given, *_SHEET, _at(self.normal), _at(self.sheet))

    def _even(self, current: Points, rows: slice, after: Points) -> None:
        given = (self._graph, rows.start, rows.stop, _at(current), _at(self.points), _at(self.normal))
        pulls = _at(self.spacing), _at(self.held), _at(self.pace)
        _relaxation.even(*given, *pulls, _at(_WAVES), _DIRECTIONS, *_OPEN, _WALL, _at(after))

    def _land(self, current: Points, rows: slice, after: Points) -> None:
        given = (self._graph, rows.start, rows.stop, _at(current), _at(self.points), _at(self.normal), _at(self.sheet))
        _relaxation.land(*given, _at(after))

    @property
    def _graph(self) -> _relaxation.Graph:
        return address(self.index, np.int32), self.index.shape[1]


def _at(values: NDArray[np.float64]) -> int:
    return address(values, np.float64)
