"""Depths that a camera rounded to steps, and where between the steps they were.

A depth camera counts disparity in whole steps, so that a smooth wall comes as terraces, often many points wide, on which
neighbours show no noise at all. Not here: noise that neighbours show (cloud.noise_level), passes (denoiser.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch, distinct, knn, parts, spatial_order
from pcdenoise.cloud.scan import Points

_FEWEST_DEPTHS, _POINTS_PER_DEPTH, _DEPTHS_NEARBY, _WIDTH = 32, 50, 2, 0.2
"""Depths are rounded where there are so many at least, each of so many points on average, no more of them around most points, and
those points so wide for their length: the floors of a drawing are fewer planes, the rows of a scanner are lines."""
_SAMPLE, _PART, _PROBES, _NEARBY = 100_000, 200_000, 500, 16
_WHOLE, _REGULAR = 0.2, 0.9
"""So much of a step is what nine in ten gaps between depths are off whole numbers of steps at most: roofs lie anywhere."""
_SEEN, _WIDEST = 0.99, 3.0
"""A camera at the origin sees such a share of the points, no farther off its axis than this tangent says."""
_NEIGHBOURS, _MOST_STEPS_APART, _ONE_SURFACE = 8, 2, 0.7
"""Points next to each other in the image are of one surface if they are no more steps apart: beyond it, edges of things are. So
large a share of the points has neighbours of its own surface alone, where the image shows one."""
_BENDING, _PULL, _FURTHEST_STEPS = 0.9, 0.1, 1.0
_TURNS, _SETTLED_STEPS = 150, 1e-3
_LEFT = 0.5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Rounding:
    """Depths along an axis in whole steps of `unit`: of their inverse, the disparity, or else of themselves. step: from one depth
    to the next at the median point."""

    axis: int
    unit: float
    is_of_disparity: bool
    step: float

    @property
    def figures(self) -> dict[str, Any]:
        """rounded_axis and rounding_step, for reports."""
        return {"rounded_axis": "xyz"[self.axis], "rounding_step": self.step}

    def counted(self, depth: Floats) -> Floats:
        """(N,) depths in steps."""
        return (1 / depth if self.is_of_disparity else depth) / self.unit

    def measured(self, steps: Floats) -> Floats:
        """(N,) the depths of so many steps."""
        return 1 / (self.unit * steps) if self.is_of_disparity else self.unit * steps

    def left(self, points: Points) -> Floats:
        """(N,) standard deviation of what `shift` leaves of rounding at (N, 3) places: about half of what rounding does."""
        step = self.unit * (points[:, self.axis] ** 2 if self.is_of_disparity else np.ones(len(points)))
        return _LEFT / 12**0.5 * step


def find(points: Points, threads: int = -1) -> Rounding | None:
    """How depths of (N, 3) finite points were rounded along one axis, as depth cameras do; None where none was.

    Around most points the nearest others lie on one or two planes across the axis, and all over them; and planes are whole steps
    apart. Rows of a grid or of a line scanner are planes as well, but then the nearest others lie on several of them, or along a
    line. Where two axes or all are rounded, as after thinning by a grid, nothing says on what side of its place a point was.
    """
    some = points[:: 1 + len(points) // _SAMPLE]
    some = some[some.any(axis=1)]  # the origin stands for no measurement
    n_depths = [len(np.unique(some[:, axis])) for axis in range(3)]
    few = [axis for axis in range(3) if _FEWEST_DEPTHS <= n_depths[axis] <= len(some) / _POINTS_PER_DEPTH]
    if not few:
        return None
    part = points[next(parts(points, _PART))]
    places = part[distinct(part)[0]]
    places = places[spatial_order(places)]
    probes = places[np.linspace(0, len(places) - 1, min(_PROBES, len(places))).astype(int)]
    near = places[NeighbourSearch(places, threads).knn(probes, _NEARBY)[1]]
    n_planes = np.median((np.diff(np.sort(near, axis=1), axis=1) > 0).sum(axis=1) + 1, axis=0)
    near = near - near.mean(axis=1, keepdims=True)
    squared = np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near)
    is_wide = np.median(squared[:, 1] / np.maximum(squared[:, 2], 1e-300)) > _WIDTH**2
    found = [axis for axis in few if is_wide and n_planes[axis] <= _DEPTHS_NEARBY]
    return _in_steps(points[points.any(axis=1), found[0]], found[0]) if len(found) == 1 else None


def _in_steps(depth: Floats, axis: int) -> Rounding | None:
    """The steps that (N,) depths come in, of one sign if it is their disparity; None where gaps between them are of any size."""
    best, least = None, _WHOLE
    ahead = depth[depth * np.median(depth) > 0]
    for is_of_disparity, some in ((False, depth), (True, ahead)):
        depths = np.unique(some)
        if len(depths) < _FEWEST_DEPTHS or len(some) < _SEEN * len(depth):
            continue
        gaps = np.abs(np.diff(1 / depths if is_of_disparity else depths))
        unit = float(np.median(gaps))
        off = float(np.quantile(np.abs(gaps / unit - np.maximum(np.rint(gaps / unit), 1)), _REGULAR))
        if off < least:
            step = unit * float(np.median(some)) ** 2 if is_of_disparity else unit
            best, least = Rounding(axis, unit, is_of_disparity, step), off
    return best


def shift(points: Points, rounding: Rounding, threads: int = -1) -> Points:
    """(N, 3) by how much finite points move to where they were before rounding, by one step at most: along rays from the origin
    if they were seen from there, else along the axis. Nothing moves where no one surface is to be seen."""
    axis = rounding.axis
    first, place = distinct(points)
    places, moved = points[first], np.zeros((len(first), 3))
    depth, across = places[:, axis], np.delete(places, axis, axis=1)
    ahead = depth * np.median(depth) > 0
    ahead &= (np.abs(across) < _WIDEST * np.abs(depth)[:, None]).all(axis=1)
    image, ray, known = _flat(across), np.broadcast_to(np.eye(3)[axis], places.shape), places.any(axis=1)
    if ahead.mean() >= _SEEN:
        rays = places / np.where(ahead, depth, 1)[:, None]
        seen = _flat(np.delete(rays, axis, axis=1))
        if rounding.is_of_disparity or _unevenness(seen[ahead], threads) < _unevenness(image[ahead], threads):
            image, ray, known = seen, rays, ahead
    steps = rounding.counted(depth[known])
    undone = _between(steps, image[known], threads)
    change = np.where(undone == steps, 0.0, rounding.measured(undone) - depth[known])
    moved[known] = change[:, None] * ray[known]
    return moved[place]


def _between(steps: Floats, image: Points, threads: int) -> Floats:
    """(N,) depths s in steps, of points whose depths were rounded to these (N,) steps k, seen at (N, 3) places of an image.

    They minimise ½ Σ 0.9 (L s)² + 0.1 s·L s + 0.1 d², |s - k| ≤ 1: a plate that hardly bends, L being the Laplacian of
    neighbours in the image, pulled to where rounding gives k by the distance d from k - ½ or k + ½. Terraces keep their rims and
    lose their flatness; a camera's jitter, by which single points are a step off, is no rim. Points beside an edge of things, and
    on slopes so steep that steps lie closer than points, stay, and all do if most would. Accelerated gradient descent
    (Nesterov 1983).
    """
    from scipy import sparse

    n, k = len(steps), min(_NEIGHBOURS, len(steps) - 1)
    other = knn(image, k + 1, threads=threads)[1][:, 1:]
    is_linked = np.abs(steps[other] - steps[:, None]) < _MOST_STEPS_APART + 0.5
    is_free = is_linked.all(axis=1)
    if is_free.mean() < _ONE_SURFACE:
        return steps
    own = np.repeat(np.arange(n), k)[is_linked.ravel()]
    links = sparse.csr_matrix((np.ones(len(own)), (own, other[is_linked])), shape=(n, n))
    links = links.maximum(links.T)
    degree = np.asarray(links.sum(axis=1)).ravel() / _NEIGHBOURS
    laplacian = (sparse.diags(degree) - links / _NEIGHBOURS).tocsr()
    stiffest = 2 * float(degree.max())  # no eigenvalue of L is larger
    rate = 1 / (_BENDING * stiffest**2 + (1 - _BENDING) * stiffest + _PULL)
    furthest = np.where(is_free, _FURTHEST_STEPS, 0.0)
    now = ahead = steps
    momentum = 1.0
    for _ in range(_TURNS):
        bent = laplacian @ ahead
        force = _BENDING * (laplacian @ bent) + (1 - _BENDING) * bent
        force += _PULL * (ahead - np.clip(ahead, steps - 0.5, steps + 0.5))
        after = np.clip(ahead - rate * force, steps - furthest, steps + furthest)
        grown = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        change = after - now
        ahead, now, momentum = after + (momentum - 1) / grown * change, after, grown
        if np.abs(change).max() < _SETTLED_STEPS:
            break
    return now


def _flat(places: NDArray[np.float64]) -> Points:
    """(N, 3) places of an image (N, 2)."""
    return np.column_stack([places, np.zeros(len(places))])


def _unevenness(image: Points, threads: int) -> float:
    """Standard deviation of the distance to the nearest other point, over its mean."""
    probes = image[:: 1 + len(image) // _SAMPLE]
    distance = knn(image, 2, probes, threads)[0][:, -1]
    return float(distance.std() / max(distance.mean(), 1e-300))
