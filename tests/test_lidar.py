"""The rotating scanner: beams at the HDL-64E's angles, one bias per laser, noise along rays only, the object covered."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import cKDTree

from pcdenoise.synthesis.lidar import ELEVATIONS_DEG, LidarScan, scan_mesh
from pcdenoise.synthesis.meshes import Mesh, sample_mesh

pytest.importorskip("open3d", exc_type=ImportError)


@pytest.fixture(scope="module")
def box() -> Mesh:
    corners = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)], dtype=float)
    quads = np.array(((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)))
    return Mesh(corners * (1.0, 2.0, 3.0) + 100, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


@pytest.fixture(scope="module")
def scan(box: Mesh) -> LidarScan:
    return scan_mesh(box, np.random.default_rng(0), ray_std=0.01, bias_std=0.005)


def test_beams_are_two_blocks_of_32_a_third_and_half_a_degree_apart() -> None:
    assert len(ELEVATIONS_DEG) == 64
    assert ELEVATIONS_DEG[[0, 31, 32, 63]] == pytest.approx([2.0, -8 - 1 / 3, -8 - 5 / 6, -24 - 1 / 3])
    steps = -np.diff(ELEVATIONS_DEG)
    assert steps[:31] == pytest.approx(1 / 3)
    assert steps[31:] == pytest.approx(1 / 2)


def test_true_places_lie_on_the_mesh_and_normals_face_the_scanner(scan: LidarScan, box: Mesh) -> None:
    low, high = box.vertices.min(axis=0), box.vertices.max(axis=0)
    to_faces = np.minimum(np.abs(scan.clean - low), np.abs(scan.clean - high)).min(axis=1)
    assert to_faces.max() < 1e-5
    assert ((scan.clean > low - 1e-5) & (scan.clean < high + 1e-5)).all()
    assert np.einsum("ij,ij->i", scan.normals, scan.origins[scan.pose] - scan.clean).min() > 0


def test_every_return_moves_along_its_own_ray_only(scan: LidarScan) -> None:
    ray = scan.clean - scan.origins[scan.pose]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    measured = scan.origins[scan.pose] + scan.ranges[:, None] * ray
    assert np.abs(measured - scan.points).max() < 1e-9


def test_rays_of_one_beam_keep_their_elevation_in_every_pose(scan: LidarScan) -> None:
    """A beam sweeps a cone around the scanner's axis: ray . axis = sin(elevation), for one unit axis per pose."""
    for pose in range(len(scan.origins)):
        own = scan.pose == pose
        ray = scan.clean[own] - scan.origins[pose]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        sine = np.sin(np.radians(ELEVATIONS_DEG[scan.beam[own]]))
        axis = np.linalg.lstsq(ray, sine, rcond=None)[0]
        assert np.linalg.norm(axis) == pytest.approx(1, abs=1e-5)
        assert np.abs(ray @ axis - sine).max() < 1e-5


def test_each_laser_has_one_bias_and_rays_the_asked_deviation(scan: LidarScan, box: Mesh) -> None:
    error = scan.ranges - np.linalg.norm(scan.clean - scan.origins[scan.pose], axis=1)
    residual = error - scan.bias[scan.beam]
    n, std = len(error), 0.01 * box.diagonal
    assert abs(residual.mean()) < 4 * std / np.sqrt(n)
    assert residual.std() == pytest.approx(std, rel=4 / np.sqrt(2 * n))
    assert stats.kstest(scan.bias / (0.005 * box.diagonal), "norm").pvalue > 1e-3
    for beam in np.flatnonzero(np.bincount(scan.beam, minlength=64) > 100):
        own = residual[scan.beam == beam]
        assert abs(own.mean()) < 5 * std / np.sqrt(len(own))


def test_without_noise_the_measured_places_are_the_true_ones(box: Mesh) -> None:
    scan = scan_mesh(box, np.random.default_rng(1), ray_std=0.0, bias_std=0.0, n_poses=2)
    assert np.abs(scan.points - scan.clean).max() < 1e-12


def test_the_poses_together_see_the_whole_surface(scan: LidarScan, box: Mesh) -> None:
    """Beams are at most half a degree apart at 4.5 radii: 0.04 radii head-on, four times that where a face is seen at a slant."""
    surface = sample_mesh(box, 2000, np.random.default_rng(2)).points
    assert cKDTree(scan.clean).query(surface)[0].max() < 0.16 * box.diagonal / 2
