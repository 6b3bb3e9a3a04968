"""Depths that a camera rounded to steps, and where between the steps they were.

A depth camera counts disparity in whole steps, so that a smooth wall comes as terraces, often many points wide, on which
neighbours show no noise at all. Not here: noise that neighbours show (cloud.noise_level), passes (denoiser.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch, distinct, knn, parts, spatial_order
from pcdenoise.cloud.scan import Points

_FEWEST_DEPTHS, _POINTS_PER_DEPTH, _DEPTHS_NEARBY, _WIDTH = 32, 50, 2, 0.2
"""Depths are rounded where there are so many at least, each of so many points on average, no more of them around most points, and
those points so wide for their length: the floors and stairs of a drawing are fewer planes, the rows of a scanner are lines."""
_SAMPLE, _PART, _PROBES, _NEARBY = 100_000, 200_000, 500, 16
_WIDEST = 3.0
"""Tangent of the widest angle off the axis at which a camera sees."""
_NEIGHBOURS, _MOST_STEPS_APART = 8, 2
"""Points next to each other in the image are of one surface if they are no more steps apart: beyond it, edges of things are."""
_BENDING, _PULL, _FURTHEST_STEPS = 0.9, 0.1, 1.0
_TURNS = 150
_LEFT = 0.5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Rounding:
    """The axis along which depths were rounded, the distance from one depth to the next at the median point, and depths (L,),
    ascending, that occur."""

    axis: int
    step: float
    depths: Floats = field(repr=False)

    @property
    def figures(self) -> dict[str, Any]:
        """rounded_axis and rounding_step, for reports."""
        return {"rounded_axis": "xyz"[self.axis], "rounding_step": self.step}

    def left(self, points: Points) -> Floats:
        """(N,) standard deviation of what `shift` leaves of rounding at (N, 3) places: about half of what rounding does."""
        steps = np.interp(points[:, self.axis], self.depths, np.gradient(self.depths))
        left: Floats = _LEFT / np.sqrt(12) * steps
        return left


def find(points: Points) -> Rounding | None:
    """The one axis along which (N, 3) finite points lie in terraces, as depth cameras measure; None where there is none.

    Around most points the nearest others lie on one or two planes across the axis, and all over them. Rows of a grid or of a line
    scanner are planes as well, but then the nearest others lie on several of them, or along a line. Where two axes or all are
    rounded, as after thinning by a grid, nothing says on what side of its place a point was.
    """
    some = points[:: 1 + len(points) // _SAMPLE]
    some = some[some.any(axis=1)]  # the origin stands for no measurement
    rounded: dict[int, Rounding] = {}
    for axis in range(3):
        depths, depth = np.unique(some[:, axis], return_inverse=True)
        if _FEWEST_DEPTHS <= len(depths) <= len(some) / _POINTS_PER_DEPTH:
            rounded[axis] = Rounding(axis, float(np.median(np.gradient(depths)[depth])), depths)
    if not rounded:
        return None
    part = points[next(parts(points, _PART))]
    places = part[distinct(part)[0]]
    places = places[spatial_order(places)]
    probes = places[np.linspace(0, len(places) - 1, min(_PROBES, len(places))).astype(int)]
    near = places[NeighbourSearch(places).knn(probes, _NEARBY)[1]]
    n_planes = np.median((np.diff(np.sort(near, axis=1), axis=1) > 0).sum(axis=1) + 1, axis=0)
    near = near - near.mean(axis=1, keepdims=True)
    squared = np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near)
    is_wide = np.median(squared[:, 1] / np.maximum(squared[:, 2], 1e-300)) > _WIDTH**2
    found = [each for axis, each in rounded.items() if is_wide and n_planes[axis] <= _DEPTHS_NEARBY]
    return found[0] if len(found) == 1 else None


def shift(points: Points, rounding: Rounding, threads: int = -1) -> Points:
    """(N, 3) by how much finite points move to where they were before rounding: along their rays, by one step at most.

    A point's ray is that of a camera at the origin if points lie more evenly in its image than in one seen along the axis.
    """
    moved = np.zeros_like(points)
    known = np.flatnonzero(points.any(axis=1))
    first, place = distinct(points[known])
    places = points[known[first]]
    depth = places[:, rounding.axis]
    image, sees_from_origin = _image(places, rounding.axis, threads)
    depths, step = np.unique(depth, return_inverse=True)
    change = np.interp(_between(step.astype(np.float64), image, threads), np.arange(len(depths)), depths) - depth
    ray = places / depth[:, None] if sees_from_origin else np.eye(3)[rounding.axis]
    moved[known] = (change[:, None] * ray)[place]
    return moved


def _between(step: Floats, image: Points, threads: int) -> Floats:
    """(N,) depths s in steps, of points whose depths were rounded to these (N,) whole steps k, seen at (N, 3) places of an image.

    They minimise ½ Σ 0.9 (L s)² + 0.1 s·L s + 0.1 d², |s - k| ≤ 1: a plate that hardly bends, L being the Laplacian of
    neighbours in the image, pulled to where rounding gives k by the distance d from k - ½ or k + ½. Terraces keep their rims and
    lose their flatness; a camera's jitter, by which single points are a step off, is no rim. Points beside an edge of things, and
    on slopes so steep that steps lie closer than points, stay. Accelerated gradient descent (Nesterov 1983).
    """
    from scipy import sparse

    n, k = len(step), min(_NEIGHBOURS, len(step) - 1)
    other = knn(image, k + 1, threads=threads)[1][:, 1:]
    is_linked = np.abs(step[other] - step[:, None]) <= _MOST_STEPS_APART
    own = np.repeat(np.arange(n), k)[is_linked.ravel()]
    links = sparse.csr_matrix((np.ones(len(own)), (own, other[is_linked])), shape=(n, n))
    links = links.maximum(links.T)
    degree = np.asarray(links.sum(axis=1)).ravel() / _NEIGHBOURS
    laplacian = (sparse.diags(degree) - links / _NEIGHBOURS).tocsr()
    stiffest = 2 * float(degree.max())  # no eigenvalue of L is larger
    rate = 1 / (_BENDING * stiffest**2 + (1 - _BENDING) * stiffest + _PULL)
    furthest = np.where(is_linked.all(axis=1), _FURTHEST_STEPS, 0.0)
    now = ahead = step
    momentum = 1.0
    for _ in range(_TURNS):
        bent = laplacian @ ahead
        force = _BENDING * (laplacian @ bent) + (1 - _BENDING) * bent
        force += _PULL * (ahead - np.clip(ahead, step - 0.5, step + 0.5))
        after = np.clip(ahead - rate * force, step - furthest, step + furthest)
        grown = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = after + (momentum - 1) / grown * (after - now)
        now, momentum = after, grown
    return now


def _image(points: Points, axis: int, threads: int) -> tuple[Points, bool]:
    """(N, 3) points as seen along the axis, or by a camera at the origin where they look more even to it; and whether by it."""
    depth, across = points[:, axis], np.delete(points, axis, axis=1)
    flat = np.column_stack([across, np.zeros(len(points))])
    is_ahead = bool((depth > 0).all() or (depth < 0).all()) and bool((np.abs(across) < _WIDEST * np.abs(depth)[:, None]).all())
    if not is_ahead:
        return flat, False
    seen = np.column_stack([across / depth[:, None], np.zeros(len(points))])
    unevenness = [_unevenness(image, threads) for image in (flat, seen)]
    return (seen, True) if unevenness[1] < unevenness[0] else (flat, False)


def _unevenness(image: Points, threads: int) -> float:
    """Standard deviation of the distance to the nearest other point, over its mean."""
    probes = image[:: 1 + len(image) // _SAMPLE]
    distance = knn(image, 2, probes, threads)[0][:, -1]
    return float(distance.std() / max(distance.mean(), 1e-300))
