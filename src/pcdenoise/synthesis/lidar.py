"""A rotating 64-beam scanner (Velodyne HDL-64E) in front of a mesh, by ray casting: the paper's *Advanced* noise.

Not here: laws of noise that need no scanner (noise.py). Needs open3d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError
from pcdenoise.synthesis.meshes import Mesh, MeshQueries
from pcdenoise.synthesis.solids import Vectors

Array = NDArray[np.float64]

ELEVATIONS_DEG: Array = np.concatenate([2.0 - np.arange(32) / 3, -8.0 - 5 / 6 - np.arange(32) / 2])
"""(64,) beam elevations, highest first: an upper block 1/3° apart, a lower block 1/2° apart."""

AZIMUTH_STEP_DEG = 0.17
STAND_OFF = 4.5
"""Scanner distance in bounding radii: the whole object fits between the highest and the lowest beam."""


@dataclass(frozen=True)
class LidarScan:
    """N returns of several scans of one object, in the mesh's frame and unit.

    points, clean  (N, 3) measured and true places.       normals  (N, 3) unit, of the true surface, facing the scanner.
    beam, pose     (N,) which laser, which scan.          ranges   (N,) measured distance.
    origins        (n_poses, 3) scanner positions.        bias     (64,) the constant range error of each laser.
    """

    points: Points
    clean: Points
    normals: Vectors
    beam: NDArray[np.int64]
    pose: NDArray[np.int64]
    ranges: Array
    origins: Points
    bias: Array

    def __len__(self) -> int:
        return len(self.points)


def scan_mesh(
    mesh: Mesh, rng: np.random.Generator, *, ray_std: float = 0.01, bias_std: float = 0.005, n_poses: int = 12
) -> LidarScan:
    """Scan a mesh from n_poses places all around it; both standard deviations in bounding-box diagonals.

    A return's range is the true one, plus its laser's bias N(0, bias_std), the same in every pose, plus N(0, ray_std).
    Raises UsageError if no ray hits, or without open3d.
    """
    queries = MeshQueries(mesh)
    origins = queries.centre + STAND_OFF * queries.radius * _around(n_poses, rng)
    bias = bias_std * mesh.diagonal * rng.standard_normal(len(ELEVATIONS_DEG))
    directions, beams = _fan()
    chunks = []
    for pose, origin in enumerate(origins):
        rays = directions @ _frame((queries.centre - origin) / np.linalg.norm(queries.centre - origin), rng)
        ranges, normals = queries.hits(np.broadcast_to(origin, rays.shape), rays)
        hit = np.isfinite(ranges)
        chunks.append((ranges[hit], rays[hit], normals[hit], beams[hit], np.full(int(hit.sum()), pose)))
    ranges, rays, normals, beam, pose_of = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
    if len(ranges) == 0:
        raise UsageError("no ray of the scanner hits the mesh; check that it has faces of some area")
    clean = origins[pose_of] + ranges[:, None] * rays
    measured = ranges + bias[beam] + ray_std * mesh.diagonal * rng.standard_normal(len(ranges))
    points = origins[pose_of] + measured[:, None] * rays
    normals = normals * -np.sign(np.einsum("ij,ij->i", normals, rays))[:, None]
    return LidarScan(points, clean, normals, beam, pose_of, measured, origins, bias)


def _fan() -> tuple[Vectors, NDArray[np.int64]]:
    """Unit directions of one turn of all beams in the scanner's frame (z up, azimuth from x), and the beam of each."""
    azimuth = np.radians(np.arange(0.0, 360.0, AZIMUTH_STEP_DEG))
    elevation = np.radians(ELEVATIONS_DEG)
    beam = np.tile(np.arange(len(elevation)), len(azimuth))
    around, up = np.repeat(azimuth, len(elevation)), elevation[beam]
    return np.column_stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]), beam


def _around(n: int, rng: np.random.Generator) -> Vectors:
    """(n, 3) evenly spread directions (a Fibonacci lattice on the sphere), turned at random."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.arange(n) * np.pi * (3 - np.sqrt(5))
    lattice = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    turned: Vectors = lattice @ np.linalg.qr(rng.standard_normal((3, 3)))[0].T
    return turned


def _frame(forward: Array, rng: np.random.Generator) -> Array:
    """(3, 3) rows x, y, z of a scanner that has the unit direction `forward` in the middle of its field, rolled at random."""
    middle = np.radians((ELEVATIONS_DEG[0] + ELEVATIONS_DEG[-1]) / 2)
    side = np.cross(forward, rng.standard_normal(3))
    side /= np.linalg.norm(side)
    z = np.sin(middle) * forward + np.cos(middle) * side
    x = (forward - np.sin(middle) * z) / np.cos(middle)
    return np.stack([x, np.cross(z, x), z])
