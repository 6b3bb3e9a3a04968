"""Outliers on analytic scenes: what must be found, what must be spared, and one real scan."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pcdenoise.cloud.neighbours import knn
from pcdenoise.denoising.outliers import find
from pcdenoise.errors import UsageError

DATA = Path(os.environ.get("PCDENOISE_DATA", Path(__file__).parents[2] / "shared" / "data"))
N = 6000
Scene = Callable[[np.random.Generator], np.ndarray]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def sphere(rng: np.random.Generator, n: int = N) -> np.ndarray:
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def cube(rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(-1, 1, (N, 3))
    face = rng.integers(0, 3, N)
    points[np.arange(N), face] = np.sign(points[np.arange(N), face])
    return points


def bordered_sheet(rng: np.random.Generator) -> np.ndarray:
    x = rng.random((N, 2))
    return np.column_stack([x, 0.1 * np.sin(5 * x[:, 0])])


def sheet_whose_density_jumps_tenfold(rng: np.random.Generator) -> np.ndarray:
    x = rng.random((N, 2))
    x[: N // 11, 0] += 1
    return np.column_stack([x, np.zeros(N)])


def sheet_whose_density_falls_to_a_tenth(rng: np.random.Generator) -> np.ndarray:
    x = rng.random((4 * N, 2))
    x = x[rng.random(4 * N) < 0.1 + 0.9 * x[:, 0]][:N]
    return np.column_stack([x, 0.1 * np.sin(4 * x[:, 0])])


def wires_over_ground(rng: np.random.Generator) -> np.ndarray:
    along = rng.random((3, 200))
    wires = [np.column_stack([t, np.full(200, 0.3 * i + 0.2), 0.15 + 0.2 * (t - 0.5) ** 2]) for i, t in enumerate(along)]
    ground = rng.random((N - 600, 3)) * [1, 1, 0]
    return np.concatenate([ground, *wires])


def terrain_with_trees(rng: np.random.Generator) -> np.ndarray:
    def ground(x: np.ndarray) -> np.ndarray:
        return 0.05 * np.sin(5 * x[:, 0]) * np.cos(4 * x[:, 1])

    x = rng.random((N * 7 // 10, 2))
    trees = []
    for _ in range(12):
        stem = rng.random((1, 2))
        crown = sphere(rng, N // 40) * np.cbrt(rng.random((N // 40, 1))) * [0.06, 0.06, 0.05]
        trees.append(crown + np.column_stack([stem, ground(stem) + 0.06]))
    return np.concatenate([np.column_stack([x, ground(x) + 0.001 * rng.normal(size=len(x))]), *trees])


def noisy_sphere(rng: np.random.Generator) -> np.ndarray:
    return sphere(rng) + 0.02 * rng.normal(size=(N, 3))


def very_noisy_sphere(rng: np.random.Generator) -> np.ndarray:
    return sphere(rng) + 0.06 * rng.normal(size=(N, 3))


SCENES: list[Scene] = [
    sphere,
    cube,
    bordered_sheet,
    sheet_whose_density_jumps_tenfold,
    sheet_whose_density_falls_to_a_tenth,
    wires_over_ground,
    terrain_with_trees,
    noisy_sphere,
    very_noisy_sphere,
]


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.__name__)
def test_at_most_one_point_in_a_thousand_of_a_clean_scene_is_an_outlier(rng: np.random.Generator, scene: Scene) -> None:
    assert find(scene(rng)).mean() <= 1e-3


@pytest.mark.parametrize("share", [0.01, 0.05])
@pytest.mark.parametrize("scene", [sphere, bordered_sheet, terrain_with_trees, noisy_sphere], ids=lambda scene: scene.__name__)
def test_scattered_points_farther_than_the_12th_neighbour_are_found(rng: np.random.Generator, scene: Scene, share: float) -> None:
    points = scene(rng)
    n_scattered = int(share * len(points))
    low, high = points.min(axis=0), points.max(axis=0)
    cloud = np.concatenate([points, rng.uniform(low - 0.3 * (high - low), high + 0.3 * (high - low), (n_scattered, 3))])
    found, added = find(cloud), np.arange(len(cloud)) >= len(points)
    reach = np.median(knn(points, 13)[0][:, -1])
    clear = added.copy()
    clear[added] = knn(points, 1, cloud[added])[0][:, 0] > 1.5 * reach
    assert found[clear].mean() >= 0.9
    assert found[~added].mean() <= 1e-3


@pytest.mark.parametrize("share", [0.01, 0.05])
@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_gross_errors_near_the_surface_are_found(rng: np.random.Generator, noise: float, share: float) -> None:
    stds = rng.normal(size=N)
    gross = rng.random(N) < share
    stds[gross] = rng.uniform(5, 20, gross.sum()) * rng.choice([-1, 1], gross.sum())
    found = find(sphere(rng) * (1 + noise * stds[:, None]))
    assert found[gross & (np.abs(stds) > 8)].mean() >= 0.9
    assert found[gross].mean() >= 0.8
    assert found[~gross].mean() <= 1e-3


def test_a_small_group_far_from_everything_is_found_and_a_large_one_is_an_object(rng: np.random.Generator) -> None:
    group, thing = sphere(rng, 5) * 0.01 + [0, 0, 3], sphere(rng, 300) * 0.3 + [0, 4, 0]
    found = find(np.concatenate([sphere(rng), group, thing]))
    assert found[N : N + 5].all()
    assert not found[N + 5 :].any()
    assert not found[:N].any()


def test_the_answer_does_not_depend_on_unit_place_attitude_or_order(rng: np.random.Generator) -> None:
    cloud = np.concatenate([sphere(rng) * (1 + 0.005 * rng.normal(size=(N, 1))), rng.uniform(-2, 2, (60, 3))])
    expected = find(cloud)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    order = rng.permutation(len(cloud))
    assert 50 < expected.sum() <= 60
    for other in (cloud * 1e5, cloud + [5.0e5, 4.5e6, 100.0], cloud @ turn.T):
        np.testing.assert_array_equal(find(other), expected)
    np.testing.assert_array_equal(find(cloud[order]), expected[order])


def test_duplicates_count_once_and_share_the_answer(rng: np.random.Generator) -> None:
    cloud = np.concatenate([sphere(rng), [[0.0, 0, 0]], [[0.0, 2.5, 0]]])
    expected = find(cloud)
    copies = np.ones(len(cloud), dtype=int)
    copies[::2] = 2
    copies[-2] = 500  # what a scanner writes where it saw nothing
    np.testing.assert_array_equal(find(np.repeat(cloud, copies, axis=0)), np.repeat(expected, copies))
    assert expected[-2:].all()
    assert expected.sum() == 2


@pytest.mark.parametrize("n", [0, 1, 2, 13, 48])
def test_clouds_without_surroundings_have_no_outliers(rng: np.random.Generator, n: int) -> None:
    found = find(rng.random((n, 3)))
    assert found.shape == (n,)
    assert found.dtype == np.bool_
    assert not found.any()


def test_lines_rasters_and_heaps_have_no_outliers(rng: np.random.Generator) -> None:
    raster = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [7.0]), axis=-1).reshape(-1, 3)
    line = np.outer(np.linspace(0, 1, 500), [1.0, 2.0, -0.5])
    for points in (raster, line, raster * [1, 30, 1], np.zeros((200, 3)), np.repeat(raster[:60], 20, axis=0)):
        assert not find(points).any()


def test_wrong_thresholds_are_named() -> None:
    with pytest.raises(UsageError, match=r"^isolation: "):
        find(np.zeros((3, 3)), isolation=1.0)
    with pytest.raises(UsageError, match=r"^deviation: "):
        find(np.zeros((3, 3)), deviation=0.0)


def test_an_airborne_scan_keeps_its_ground_and_trees_and_loses_the_point_below_the_ground() -> None:
    path = DATA / "scans" / "laspy_file_with_both_wkt_and_geotiff_vlrs.las"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    laspy = pytest.importorskip("laspy")
    scan = laspy.read(path)
    points, noise = np.column_stack([scan.x, scan.y, scan.z]), np.asarray(scan.classification) == 7
    found = find(points)
    # Most of the 25 points of class 7 lie within the ground's own noise; only some differ from it by geometry at all.
    assert found[noise].sum() >= 3
    assert found[np.flatnonzero(noise)[points[noise, 2].argmin()]]
    assert found[~noise].mean() < 0.005
    assert found[np.asarray(scan.classification) == 2].mean() < 0.0005
