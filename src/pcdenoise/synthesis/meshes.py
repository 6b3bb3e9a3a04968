"""Triangle meshes: loading, exact queries, blue-noise samples, colour by light. Not here: procedural surfaces (shapes.py)."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pcdenoise.cloud.sampling import poisson_disk_exactly
from pcdenoise.errors import ScanError, UsageError
from pcdenoise.synthesis.shapes import SurfaceSample
from pcdenoise.synthesis.solids import Mask, Vectors, directions

Faces = NDArray[np.int64]
"""(F, 3) vertex rows of triangles, counter-clockwise seen from outside."""

MESH_SUFFIXES = (".ply", ".obj", ".off", ".stl")
CANDIDATES_PER_SAMPLE = 5
TOUCHING = 1e-5
"""Depth, in bounding radii, up to which a point counts as on a surface rather than inside it."""


@dataclass(frozen=True)
class Mesh:
    """Vertices (V, 3) float64 in file units and triangles (F, 3) int64 into them."""

    vertices: Vectors
    faces: Faces

    @property
    def diagonal(self) -> float:
        """Of the bounding box, in file units."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @property
    def corners(self) -> NDArray[np.float64]:
        """(F, 3 corners, 3 coordinates)."""
        return self.vertices[self.faces]

    @property
    def area_vectors(self) -> Vectors:
        """(F, 3) face normals as long as the faces are large."""
        a, b, c = self.corners.transpose(1, 0, 2)
        return np.cross(b - a, c - a) / 2


@dataclass(frozen=True)
class Closest:
    """Where points are nearest to a mesh: distance (N,) in their unit, place (N, 3), face row (N,), its unit normal (N, 3)."""

    distance: NDArray[np.float64]
    place: Vectors
    face: Faces
    normal: Vectors


class MeshQueries:
    """Exact nearest places and ray hits on a mesh, in its own bounding sphere so that float32 costs 1e-7 of the size.

    Needs open3d; raises UsageError where it cannot be imported.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._open3d = import_open3d()
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self.centre = (low + high) / 2
        self.radius = float(np.linalg.norm(mesh.vertices - self.centre, axis=1).max()) or 1.0
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._local(mesh.vertices), self._open3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def closest(self, points: Vectors) -> Closest:
        """Nearest places of (N, 3) points."""
        found = self._scene.compute_closest_points(self._local(points))
        place = found["points"].numpy().astype(np.float64)
        distance = np.linalg.norm(((points - self.centre) / self.radius).astype(np.float32) - place, axis=1) * self.radius
        normal = found["primitive_normals"].numpy().astype(np.float64)
        face = found["primitive_ids"].numpy().astype(np.int64)
        return Closest(distance, place * self.radius + self.centre, face, normal)

    def contains(self, points: Vectors) -> Mask:
        """(N,) which of (N, 3) points lie deeper than TOUCHING inside; the mesh must be closed."""
        depth: Mask = self._scene.compute_signed_distance(self._local(points)).numpy() < -TOUCHING
        return depth

    def hits(self, origins: Vectors, rays: Vectors) -> tuple[NDArray[np.float64], Vectors]:
        """Distances (N,) along unit rays (N, 3) from origins (N, 3) to the first face, inf where none is, and its normals."""
        local = np.concatenate([(origins - self.centre) / self.radius, rays], axis=1).astype(np.float32)
        found = self._scene.cast_rays(self._open3d.core.Tensor(local))
        return found["t_hit"].numpy().astype(np.float64) * self.radius, found["primitive_normals"].numpy().astype(np.float64)

    def _local(self, points: Vectors) -> Any:
        return self._open3d.core.Tensor(((points - self.centre) / self.radius).astype(np.float32))


def import_open3d() -> Any:
    """The open3d module, loaded only where meshes are used. Raises UsageError with the fix where that fails."""
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:  # OSError: a missing libGL or libEGL
        fix = "run `pip install open3d-cpu` (or open3d); on a bare Linux also `apt install libgl1 libegl1 libx11-6 libusb-1.0-0`"
        raise UsageError(f"meshes need open3d, which cannot be imported ({str(error).splitlines()[0]}); {fix}") from error


def load_mesh(path: str | Path) -> Mesh:
    """A .ply, .obj, .off or .stl file with equal vertices merged and polygons cut into triangles. Raises ScanError."""
    path = Path(path)
    if not path.is_file():
        raise ScanError(f"{path}: no such file; check the path")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ScanError(f"{path}: not a mesh format; give one of {' '.join(MESH_SUFFIXES)}")
    vertices, faces = _read_obj(path) if path.suffix.lower() == ".obj" else _read_with_open3d(path)
    if len(faces) == 0:
        raise ScanError(f"{path}: no triangles could be read; give a complete surface mesh, not a point cloud")
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise ScanError(f"{path}: vertex {row} is not finite; repair the mesh first")
    unique, merged = np.unique(vertices, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[faces]
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return Mesh(unique, faces[~flat])


def sample_mesh(mesh: Mesh, n: int, rng: np.random.Generator) -> SurfaceSample:
    """Exactly n points of the outer surface, evenly spaced (Poisson disk), with the outward normals of their faces.

    Where several closed bodies overlap, what lies inside another body is left out; needs open3d only for that.
    Raises UsageError if the mesh has no area or nothing of it is outside.
    """
    bodies = _bodies(mesh)
    areas = mesh.area_vectors
    for body in bodies:
        if body.closed and body.volume < 0:
            areas[body.faces] *= -1.0
    length = np.linalg.norm(areas, axis=1)
    if not length.sum() > 0:
        raise UsageError("the mesh has no area to sample; give a surface mesh")
    points, faces = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    n_candidates = n_drawn = CANDIDATES_PER_SAMPLE * n
    while len(points) < n_candidates:
        drawn = rng.choice(len(length), n_drawn, p=length / length.sum())
        weights = np.sort(rng.random((n_drawn, 2)), axis=1)
        weights = np.diff(weights, axis=1, prepend=0.0, append=1.0)
        fresh = np.einsum("nc,ncd->nd", weights, mesh.corners[drawn])
        outside = ~_inside_another(mesh, bodies, fresh, drawn)
        if not outside.any():
            raise UsageError("nothing of the mesh lies outside its own bodies; check that it is not doubled")
        points, faces = np.concatenate([points, fresh[outside]]), np.concatenate([faces, drawn[outside]])
        n_drawn = max(64, int((n_candidates - len(points)) / outside.mean()))
    kept = poisson_disk_exactly(points, n, rng)
    return SurfaceSample(points[kept], areas[faces[kept]] / length[faces[kept], None])


def lambert_rgb(normals: Vectors, rng: np.random.Generator, n_lights: int = 3) -> NDArray[np.uint8]:
    """(N, 3) 8-bit colours of a white Lambertian surface with unit normals (N, 3) under random coloured directional lights."""
    lights = directions(n_lights, rng)
    colours = rng.uniform(0.2, 1.0, (n_lights, 3))
    radiance = np.maximum(normals @ lights.T, 0.0) @ colours
    colour: NDArray[np.uint8] = np.round(255 * np.minimum(radiance / colours.sum(axis=0).max() * 1.5, 1.0)).astype(np.uint8)
    return colour


def _read_with_open3d(path: Path) -> tuple[Vectors, Faces]:
    open3d = import_open3d()
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        read = open3d.io.read_triangle_mesh(str(path))
    return np.asarray(read.vertices, dtype=np.float64), np.asarray(read.triangles, dtype=np.int64)


def _read_obj(path: Path) -> tuple[Vectors, Faces]:
    """Vertices and fan-triangulated faces of a Wavefront OBJ; open3d would silently drop its quads."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            key, *words = line.split() or [""]
            try:
                if key == "v":
                    x, y, z = words[:3]
                    vertices.append([float(x), float(y), float(z)])
                elif key == "f":
                    rows = [int(word.split("/")[0]) for word in words]
                    corners = [row - 1 if row > 0 else len(vertices) + row for row in rows]
                    faces += [(corners[0], second, third) for second, third in pairwise(corners[1:])]
            except ValueError:
                raise ScanError(f"{path}: line {number} is not a valid '{key}' line; repair the file") from None
    triangles = np.array(faces, dtype=np.int64).reshape(-1, 3)
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise ScanError(f"{path}: a face names a vertex beyond the {len(vertices)} there are; repair the file")
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), triangles


@dataclass(frozen=True)
class _Body:
    """One connected piece of a mesh: its face rows, whether every edge has two faces, its signed volume and box."""

    faces: Faces
    closed: bool
    volume: float
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def _bodies(mesh: Mesh) -> list[_Body]:
    n = len(mesh.vertices)
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    _, label = connected_components(coo_array((np.ones(len(start), dtype=bool), (start, end)), shape=(n, n)), directed=False)
    of_face = label[mesh.faces[:, 0]]
    _, inverse, count = np.unique(np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True)
    closed_face = (count[inverse.reshape(-1, 3)] == 2).all(axis=1)
    corners = mesh.corners
    centre = corners.mean(axis=(0, 1))
    volumes = np.einsum("ij,ij->i", corners.mean(axis=1) - centre, mesh.area_vectors) / 3
    bodies = []
    for body in np.unique(of_face):
        faces = np.flatnonzero(of_face == body)
        own = corners[faces].reshape(-1, 3)
        bodies.append(_Body(faces, bool(closed_face[faces].all()), float(volumes[faces].sum()), own.min(axis=0), own.max(axis=0)))
    return bodies


def _inside_another(mesh: Mesh, bodies: list[_Body], points: Vectors, faces: Faces) -> Mask:
    """(N,) which points, each on a face, lie strictly inside a closed body that the face is not part of."""
    inside = np.zeros(len(points), dtype=bool)
    if len(bodies) == 1:
        return inside
    owner = np.empty(len(mesh.faces), dtype=np.int64)
    for i, body in enumerate(bodies):
        owner[body.faces] = i
    for i, body in enumerate(bodies):
        near = np.flatnonzero((owner[faces] != i) & ~inside & ((points > body.low) & (points < body.high)).all(axis=1))
        if body.closed and len(near):
            used, local = np.unique(mesh.faces[body.faces], return_inverse=True)
            inside[near] = MeshQueries(Mesh(mesh.vertices[used], local.reshape(-1, 3))).contains(points[near])
    return inside
