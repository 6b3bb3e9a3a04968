"""Surfaces known exactly: endless random ones to train on, five with a closed-form distance to test on.

Not here: how random ones are made up (families.py) and sampled (solids.py), surfaces from files (meshes.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.synthesis.families import random_body
from pcdenoise.synthesis.solids import Blob, Body, Extrusion, Lathe, Part, Torus, Vectors, rectangle

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceSample:
    """Points on a surface (N, 3) and unit outward normals (N, 3)."""

    points: Vectors
    normals: Vectors

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class AnalyticSurface:
    """A surface with closed-form sampling and distance.

    sample           (n, rng) -> SurfaceSample, uniform by area.
    signed_distance  (N, 3) points -> (N,) distances, negative inside, in the unit of the points.
    area             of the sampled patch.
    """

    sample: Callable[[int, np.random.Generator], SurfaceSample]
    signed_distance: Callable[[Vectors], Array]
    area: float


def sphere(radius: float = 1.0) -> AnalyticSurface:
    """A sphere around the origin."""
    body = Body([Part(Blob(radius))])
    return _analytic(body, lambda p: np.linalg.norm(p, axis=1) - radius, 4 * np.pi * radius**2)


def plane(size: float = 2.0) -> AnalyticSurface:
    """The square |x|, |y| <= size / 2 of the plane z = 0, normal +z; the distance is to the unbounded plane."""

    def sample(n: int, rng: np.random.Generator) -> SurfaceSample:
        points = np.column_stack([size * (rng.random((n, 2)) - 0.5), np.zeros(n)])
        return SurfaceSample(points, np.tile([0.0, 0.0, 1.0], (n, 1)))

    return AnalyticSurface(sample, lambda p: p[:, 2].copy(), size**2)


def cylinder(radius: float = 0.5, height: float = 2.0) -> AnalyticSurface:
    """A closed cylinder around the z axis, centred at the origin."""
    half = height / 2
    body = Body([Part(Lathe(np.array([(0, -half), (radius, -half), (radius, half), (0, half)])))])

    def distance(points: Vectors) -> Array:
        return _box_distance(np.column_stack([np.hypot(points[:, 0], points[:, 1]) - radius, np.abs(points[:, 2]) - half]))

    return _analytic(body, distance, 2 * np.pi * radius * (radius + height))


def torus(major: float = 1.0, minor: float = 0.3) -> AnalyticSurface:
    """A ring around the z axis."""

    def distance(points: Vectors) -> Array:
        return np.hypot(np.hypot(points[:, 0], points[:, 1]) - major, points[:, 2]) - minor

    return _analytic(Body([Part(Torus(major, minor))]), distance, 4 * np.pi**2 * major * minor)


def cube(size: float = 2.0) -> AnalyticSurface:
    """An axis-aligned cube around the origin."""
    body = Body([Part(Extrusion(rectangle(size, size), size))])
    return _analytic(body, lambda p: _box_distance(np.abs(p) - size / 2), 6 * size**2)


def random_surface(rng: np.random.Generator, n_samples: int) -> SurfaceSample:
    """n_samples points, uniform by area, of a random surface in the unit sphere (box centre, largest norm 1).

    One of four families, mostly warped, engraved or both: mechanical (unions and cut-outs of extruded and turned parts, right
    angles), thin (fins, rod lattices, plates, pipes), organic (blobs, rings, capsules), open (terrain, facade, room corner, any
    of the others cut open).
    """
    points, normals = random_body(rng).sample(n_samples, rng)
    return SurfaceSample(in_unit_sphere(points), normals)


def in_unit_sphere(points: Vectors) -> Vectors:
    """(N, 3) points, moved and scaled alike so that their box is centred and the furthest is at distance 1."""
    centred: Vectors = points - (points.max(axis=0) + points.min(axis=0)) / 2
    centred /= np.linalg.norm(centred, axis=1).max()
    return centred


def _box_distance(excess: Array) -> Array:
    """Signed distance from how far (N, D) coordinates exceed the half sizes of a box."""
    distance: Array = np.linalg.norm(np.maximum(excess, 0), axis=1) + np.minimum(excess.max(axis=1), 0)
    return distance


def _analytic(body: Body, distance: Callable[[Vectors], Array], area: float) -> AnalyticSurface:
    return AnalyticSurface(lambda n, rng: SurfaceSample(*body.sample(n, rng)), distance, area)
