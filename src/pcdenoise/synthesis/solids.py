"""Solids with exact boundaries, and uniform sampling of what is visible of their union and difference.

Not here: smooth warps of them (warps.py), which solids are put together and why (families.py).

The one quantity carried through everything is the *area vector* of a sample: its direction is the outward normal, its length
the area the sample stands for (one over the sampling density). A map with Jacobian J takes it to cof(J) a, so normals and area
stretch of a warped surface are exact and cost one rank-one update.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float64]
"""(N, 3) points or area vectors."""
Mask = NDArray[np.bool_]
Warp = Callable[[Vectors, Vectors], tuple[Vectors, Vectors]]
"""(points, area vectors) of a surface to those of the warped surface."""

N_PILOT = 4096
N_BLOCK = 16384


class Solid(Protocol):
    """A closed body around the origin."""

    @property
    def reach(self) -> float:
        """Radius of a ball around the origin that holds the body."""

    def boundary(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        """n boundary points (n, 3) and their outward area vectors (n, 3); the mean length is the boundary's area."""

    def contains(self, points: Vectors) -> Mask:
        """(N,) which of (N, 3) points lie inside."""


@dataclass(frozen=True)
class Extrusion:
    """A polygon (M, 2), counter-clockwise and possibly concave, swept along z from -height/2 to height/2."""

    polygon: NDArray[np.float64]
    height: float

    @property
    def reach(self) -> float:
        return float(np.hypot(np.linalg.norm(self.polygon, axis=1).max(), self.height / 2))

    def boundary(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        lengths = np.linalg.norm(edges, axis=1)
        cap_area = polygon_area(self.polygon)
        areas = np.append(lengths * self.height, 2 * cap_area)
        side = rng.choice(len(lengths), n, p=lengths / lengths.sum())
        points = np.column_stack([self.polygon[side] + rng.random((n, 1)) * edges[side], self.height * (rng.random(n) - 0.5)])
        normals = np.column_stack([edges[side, 1], -edges[side, 0], np.zeros(n)]) / lengths[side, None]
        n_cap = rng.binomial(n, areas[-1] / areas.sum())
        points[:n_cap, :2] = _inside_polygon(self.polygon, n_cap, rng)
        upward = np.where(rng.random(n_cap) < 0.5, 1.0, -1.0)
        points[:n_cap, 2] = upward * self.height / 2
        normals[:n_cap] = 0.0
        normals[:n_cap, 2] = upward
        return points, normals * areas.sum()

    def contains(self, points: Vectors) -> Mask:
        inside: Mask = np.abs(points[:, 2]) < self.height / 2
        inside[inside] = polygon_contains(self.polygon, points[inside, 0], points[inside, 1])
        return inside


@dataclass(frozen=True)
class Lathe:
    """A polygon (M, 2) of (radius >= 0, z), counter-clockwise, turned around the z axis: cylinders, cones, pipes, shafts."""

    profile: NDArray[np.float64]

    @property
    def reach(self) -> float:
        return float(np.linalg.norm(self.profile, axis=1).max())

    def boundary(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        ends = np.roll(self.profile, -1, axis=0)
        edges = ends - self.profile
        lengths = np.linalg.norm(edges, axis=1)
        areas = np.pi * (self.profile[:, 0] + ends[:, 0]) * lengths
        edge = rng.choice(len(areas), n, p=areas / areas.sum())
        start_radius, end_radius = self.profile[edge, 0], ends[edge, 0]
        pair = np.sort(rng.random((n, 2)), axis=1)  # density along an edge grows linearly with the radius
        along = np.where(rng.random(n) * (start_radius + end_radius) < end_radius, pair[:, 1], pair[:, 0])
        radius, z = (self.profile[edge] + along[:, None] * edges[edge]).T
        angle = rng.random(n) * (2 * np.pi)
        cos, sin = np.cos(angle), np.sin(angle)
        outward, upward = edges[edge, 1] / lengths[edge], -edges[edge, 0] / lengths[edge]
        points = np.column_stack([radius * cos, radius * sin, z])
        return points, np.column_stack([outward * cos, outward * sin, upward]) * areas.sum()

    def contains(self, points: Vectors) -> Mask:
        return polygon_contains(self.profile, np.hypot(points[:, 0], points[:, 1]), points[:, 2])


@dataclass(frozen=True)
class Torus:
    """A ring around the z axis; major > minor > 0."""

    major: float
    minor: float

    @property
    def reach(self) -> float:
        return self.major + self.minor

    def boundary(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        around, across = rng.random((2, n)) * (2 * np.pi)
        normals = np.column_stack([np.cos(across) * np.cos(around), np.cos(across) * np.sin(around), np.sin(across)])
        ring = np.column_stack([np.cos(around), np.sin(around), np.zeros(n)]) * self.major
        radius = self.major + self.minor * np.cos(across)
        return ring + self.minor * normals, normals * (4 * np.pi**2 * self.minor * radius)[:, None]

    def contains(self, points: Vectors) -> Mask:
        inside: Mask = np.hypot(np.hypot(points[:, 0], points[:, 1]) - self.major, points[:, 2]) < self.minor
        return inside


@dataclass(frozen=True)
class Blob:
    """A star-shaped body of radius r (1 + sum_j amplitude_j sin(wave_j . u + phase_j)) in direction u; without waves a ball."""

    radius: float = 1.0
    waves: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    amplitudes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    phases: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def reach(self) -> float:
        return self.radius * (1.0 + float(np.abs(self.amplitudes).sum()))

    def boundary(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        u = directions(n, rng)
        angle = u @ self.waves.T + self.phases
        radius = self.radius * (1.0 + np.sin(angle) @ self.amplitudes)
        gradient = self.radius * (np.cos(angle) * self.amplitudes) @ self.waves
        gradient -= np.einsum("ij,ij->i", gradient, u)[:, None] * u
        area = (radius**2)[:, None] * u - radius[:, None] * gradient
        return radius[:, None] * u, area * (4 * np.pi)

    def contains(self, points: Vectors) -> Mask:
        distance = np.linalg.norm(points, axis=1)
        u = points / np.maximum(distance, 1e-300)[:, None]
        inside: Mask = distance < self.radius * (1.0 + np.sin(u @ self.waves.T + self.phases) @ self.amplitudes)
        return inside


@dataclass(frozen=True)
class Part:
    """A solid scaled along its own axes, then rotated, then moved; `carved` parts are taken away from the union of the others."""

    solid: Solid
    centre: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    scale: NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    carved: bool = False

    def boundary(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        points, areas = self.solid.boundary(n, rng)
        areas = (areas * (self.scale.prod() / self.scale)) @ self.rotation.T
        return (points * self.scale) @ self.rotation.T + self.centre, -areas if self.carved else areas

    def contains(self, points: Vectors) -> Mask:
        offset = points - self.centre
        near: Mask = np.einsum("ij,ij->i", offset, offset) < (self.solid.reach * self.scale.max()) ** 2
        near[near] = self.solid.contains((offset[near] @ self.rotation) / self.scale)
        return near


@dataclass(frozen=True)
class Body:
    """The boundary of (union of parts) minus (union of carved parts), cut open, then warped.

    cuts    (normal (3,), offset): only what has normal . p < offset before the warp is kept, with no lid where it was cut.
    warps   applied in order.
    """

    parts: Sequence[Part]
    cuts: Sequence[tuple[NDArray[np.float64], float]] = ()
    warps: Sequence[Warp] = ()

    def sample(self, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        """n points uniform by area on the warped boundary, in random order, and unit outward normals; both (n, 3).

        Raises ValueError where nothing of the boundary is visible.
        """
        lengths = [np.linalg.norm(self._visible(part, N_PILOT, rng)[1], axis=1) for part in self.parts]
        peaks = np.array([1.05 * length.max() if len(length) else 0.0 for length in lengths])
        total_area = sum(length.sum() for length in lengths) / N_PILOT
        if not total_area > 0:
            raise ValueError("nothing of the boundary is visible")
        chunks: list[tuple[Vectors, Vectors]] = []
        missing = n
        while missing > 0:
            n_candidates = np.ceil(1.05 * missing * peaks / total_area).astype(np.int64)
            for part, peak, n_part in zip(self.parts, peaks, n_candidates, strict=True):
                for start in range(0, n_part, N_BLOCK):
                    points, areas = self._visible(part, min(N_BLOCK, n_part - start), rng)
                    length = np.linalg.norm(areas, axis=1)
                    accepted = rng.random(len(length)) * peak < length
                    chunks.append((points[accepted], areas[accepted] / length[accepted, None]))
                    missing -= int(accepted.sum())
        points, normals = (np.concatenate(arrays) for arrays in zip(*chunks, strict=True))
        order = rng.permutation(len(points))[:n]
        return points[order], normals[order]

    def scatter(self, n: int, rng: np.random.Generator) -> Vectors:
        """Visible ones (M, 3) of n random points on each part, not uniform: enough for a box or a quantile."""
        return np.concatenate([self._visible(part, n, rng)[0] for part in self.parts])

    def _visible(self, part: Part, n: int, rng: np.random.Generator) -> tuple[Vectors, Vectors]:
        """What survives of n candidates on one part, warped."""
        points, areas = part.boundary(n, rng)
        for normal, offset in self.cuts:
            kept = points @ normal < offset
            points, areas = points[kept], areas[kept]
        if part.carved:
            covered = np.zeros(len(points), dtype=bool)
            for other in self.parts:
                if not other.carved:
                    covered |= other.contains(points)
            points, areas = points[covered], areas[covered]
        for other in self.parts:
            if other is not part and (other.carved or not part.carved):
                outside = ~other.contains(points)
                points, areas = points[outside], areas[outside]
        for warp in self.warps:
            points, areas = warp(points, areas)
        return points, areas


def directions(n: int, rng: np.random.Generator) -> Vectors:
    """(n, 3) unit vectors, uniform on the sphere."""
    vectors = rng.standard_normal((n, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors


def rectangle(width: float, height: float) -> NDArray[np.float64]:
    """The four corners (4, 2) of a rectangle around the origin, counter-clockwise."""
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, height / 2)


def polygon_area(polygon: NDArray[np.float64]) -> float:
    """Area of a counter-clockwise polygon (M, 2)."""
    x, y = polygon.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def polygon_contains(polygon: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> Mask:
    """(N,) which points (x, y) a polygon (M, 2) holds, by the parity of crossings."""
    inside = np.zeros(len(x), dtype=bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
    return inside


def _inside_polygon(polygon: NDArray[np.float64], n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """n points (n, 2) uniform inside a polygon, by rejection from its box."""
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    share = polygon_area(polygon) / float(np.prod(high - low))
    points = np.zeros((0, 2))
    while len(points) < n:
        batch = low + rng.random((int(1.1 * (n - len(points)) / share) + 8, 2)) * (high - low)
        points = np.concatenate([points, batch[polygon_contains(polygon, batch[:, 0], batch[:, 1])]])
    return points[:n]
