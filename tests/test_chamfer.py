"""Metrics against closed forms, brute force and, where it is present, the benchmark's own scorer."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest

from pcdenoise.errors import UsageError
from pcdenoise.evaluation.chamfer import UNITS, evaluate, face_distances, point_errors
from pcdenoise.synthesis.meshes import Mesh
from pcdenoise.synthesis.shapes import sphere

pytest.importorskip("open3d", exc_type=ImportError)

DATA = Path(os.environ.get("PCDENOISE_DATA", Path(__file__).parents[2] / "shared" / "data"))
BENCH = DATA.parent / "bench"


def square_mesh(size: float = 1.0) -> Mesh:
    """The square [0, size]² of z = 0, normal up."""
    vertices = size * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def grid(n: int, size: float = 1.0) -> np.ndarray:
    """n x n points evenly over that square, border included."""
    line = np.linspace(0, size, n)
    return np.column_stack([*(axis.ravel() for axis in np.meshgrid(line, line)), np.zeros(n * n)])


def octahedron(radius: float, levels: int) -> Mesh:
    """An octahedron whose faces are split 4^levels-fold and pushed out to the sphere."""
    corners = np.array([[(x, 0, 0), (0, y, 0), (0, 0, z)] for x in (1, -1) for y in (1, -1) for z in (1, -1)], dtype=float)
    corners[np.linalg.det(corners) < 0] = corners[np.linalg.det(corners) < 0][:, ::-1]
    for _ in range(levels):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        corners = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices = corners.reshape(-1, 3)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    vertices, rows = np.unique(np.round(vertices, 12), axis=0, return_inverse=True)
    return Mesh(radius * vertices, rows.reshape(-1, 3))


def test_a_plane_lifted_by_h_has_every_error_in_closed_form() -> None:
    """Square of side 2: diagonal and sphere radius are 2√2 and √2; every point is h from its twin, the mesh and every face."""
    size, h = 2.0, 0.01
    clean = grid(41, size)
    metrics = evaluate(clean + [0, 0, h], clean, square_mesh(size))
    assert metrics["cd"] == pytest.approx(1e4 * 2 * h**2 / 2)
    assert metrics["p2s"] == pytest.approx(1e4 * h**2 / 2, rel=1e-4)
    assert metrics["p2m"] == pytest.approx(1e4 * 2 * h**2 / 2, rel=1e-4)
    assert metrics["td"] == pytest.approx(100 * 2 * h / (2 * np.sqrt(2)), rel=1e-4)
    assert metrics["shrinkage"] == pytest.approx(-100 * h / (2 * np.sqrt(2)), rel=1e-4)
    assert metrics["normal_error"] == pytest.approx(0, abs=1e-5)
    assert metrics["spacing_variation"] == pytest.approx(0, abs=1e-9)


def test_a_sphere_shrunk_by_a_tenth_is_that_deep() -> None:
    mesh = octahedron(1.0, 5)
    metrics = evaluate(0.9 * sphere(1.0).sample(5000, np.random.default_rng(0)).points, mesh=mesh)
    # Facets of edge e lie up to e²/6 below the sphere; the longest edge, 1.3 (π / 2) / 32, gives 7e-4 of the radius.
    assert metrics["shrinkage"] == pytest.approx(100 * 0.1 / (2 * np.sqrt(3)), rel=7e-3)
    assert "cd" not in metrics
    assert "td" not in metrics


def test_numbers_do_not_depend_on_the_unit_or_the_place_of_the_files() -> None:
    rng = np.random.default_rng(1)
    clean, mesh = sphere(1.0).sample(2000, rng).points, octahedron(1.0, 3)
    noisy = clean + 0.02 * rng.standard_normal(clean.shape)
    move = np.array([4.5e6, 3.5e5, 100.0])
    moved = evaluate(noisy * 7 + move, clean * 7 + move, Mesh(mesh.vertices * 7 + move, mesh.faces))
    for name, value in evaluate(noisy, clean, mesh).items():
        # A point outside an edge is equally near to two faces: rounding decides whose normal it is compared with.
        assert moved[name] == pytest.approx(value, rel=5e-3 if name == "normal_error" else 1e-4, abs=1e-6), name


def test_every_metric_has_a_unit_and_appears_with_full_truth() -> None:
    clean = sphere(1.0).sample(500, np.random.default_rng(2)).points
    assert set(evaluate(clean, clean, octahedron(1.0, 2))) == set(UNITS)
    assert set(evaluate(clean)) == {"spacing_variation"}


def test_shrinkage_is_left_out_where_faces_disagree_about_outside() -> None:
    mesh = square_mesh()
    flipped = Mesh(mesh.vertices, np.array([mesh.faces[0], mesh.faces[1][::-1]]))
    assert "shrinkage" not in evaluate(grid(5), mesh=flipped)


@pytest.mark.parametrize("lift", [0.0, 0.003, 0.4])
def test_face_distances_agree_with_dense_sampling_of_every_face(lift: float) -> None:
    """A face's samples are at most 1/60 apart along its edges, so the true minimum is at most that below the sampled one."""
    rng = np.random.default_rng(3)
    mesh = octahedron(1.0, 1)
    points = (1 + lift) * sphere(1.0).sample(300, rng).points
    distance = face_distances(mesh, points)
    weights = np.array([(i, j, 60 - i - j) for i in range(61) for j in range(61 - i)]) / 60
    samples = np.einsum("wc,fcd->fwd", weights, mesh.corners)
    sampled = np.array([np.linalg.norm(face[:, None] - points, axis=2).min() for face in samples])
    assert (distance <= sampled * 1.01 + 1e-12).all()
    assert (distance >= sampled - 1 / 60).all()
    assert np.abs(distance - sampled).mean() < 1 / 300


def test_clumped_and_repeated_points_do_not_change_face_distances() -> None:
    points = sphere(1.0).sample(200, np.random.default_rng(4)).points
    mesh = octahedron(1.0, 2)
    assert face_distances(mesh, np.repeat(points, 50, axis=0)) == pytest.approx(face_distances(mesh, points), abs=1e-12)


def test_point_errors_are_the_terms_whose_mean_the_metrics_report() -> None:
    rng = np.random.default_rng(5)
    clean, mesh = sphere(1.0).sample(1000, rng).points, octahedron(1.0, 3)
    noisy = clean + 0.05 * rng.standard_normal(clean.shape)
    assert 1e4 * (point_errors(noisy, mesh=mesh) ** 2).mean() == pytest.approx(evaluate(noisy, mesh=mesh)["p2s"], rel=1e-6)
    assert len(point_errors(noisy, clean)) == 1000
    with pytest.raises(UsageError, match="truth"):
        point_errors(noisy)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_coordinates_that_are_not_numbers_are_refused_by_row(bad: float) -> None:
    clean = grid(4)
    broken = clean.copy()
    broken[7, 1] = bad
    with pytest.raises(UsageError, match=r"prediction has 1 rows that are not finite \(first: row 7\)"):
        evaluate(broken, clean)
    with pytest.raises(UsageError, match=r"clean cloud has 1 rows"):
        evaluate(clean, broken)
    with pytest.raises(UsageError, match="at least two points"):
        evaluate(clean[:1])


@pytest.mark.skipif(not (BENCH / "score.py").is_file(), reason="the benchmark is not here")
def test_metrics_agree_with_the_benchmark_scorer() -> None:
    from pcdenoise.synthesis.meshes import load_mesh

    spec = importlib.util.spec_from_file_location("score", BENCH / "score.py")
    assert spec is not None
    assert spec.loader is not None
    score = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(score)
    noisy, clean = (score.read_ply(BENCH / "clouds" / f"bunny_10000_{kind}.ply") for kind in ("0.01", "clean"))
    expected = score.metrics(noisy, clean, BENCH / "meshes" / "bunny.ply")
    metrics = evaluate(noisy, clean, load_mesh(BENCH / "meshes" / "bunny.ply"))
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, rel=1e-5)
