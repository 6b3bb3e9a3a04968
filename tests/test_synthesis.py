"""Surfaces, meshes and noise: samples lie on the surface, are uniform by area, carry outward normals; laws have their moments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import cKDTree

from pcdenoise.errors import ScanError, UsageError
from pcdenoise.synthesis import families, meshes, noise, shapes, solids, warps

SURFACES = {
    "sphere": shapes.sphere(0.7),
    "plane": shapes.plane(3.0),
    "cylinder": shapes.cylinder(0.4, 1.5),
    "torus": shapes.torus(1.0, 0.25),
    "cube": shapes.cube(1.6),
}
WARPS = {
    "twist": warps.twist(1.3),
    "taper": warps.taper(0.4),
    "bend": warps.bend(0.5),
    "wave": warps.wave(np.array([0.1, -0.05, 0.08]), np.array([3.0, 2.0, -4.0]), 0.3),
    "groove": warps.wave(np.array([0.02, 0.01, 0.02]), np.array([9.0, 2.0, -4.0]), 0.3, hardness=2.0),
    "patch": warps.wave(np.array([0.02, 0.01, 0.02]), np.array([9.0, 2.0, -4.0]), 0.3, centre=np.full(3, 0.1), width=0.8),
    "turned": warps.turned(warps.bend(0.5), np.linalg.qr(np.random.default_rng(5).standard_normal((3, 3)))[0]),
}
SEEDS = range(16)


@pytest.mark.parametrize("name", SURFACES)
def test_samples_of_analytic_surfaces_have_distance_zero_and_unit_normals(name: str) -> None:
    sample = SURFACES[name].sample(3000, np.random.default_rng(0))
    assert len(sample) == 3000
    assert np.abs(SURFACES[name].signed_distance(sample.points)).max() < 1e-12
    assert np.abs(np.linalg.norm(sample.normals, axis=1) - 1).max() < 1e-12


@pytest.mark.parametrize("name", SURFACES)
def test_signed_distance_grows_by_the_step_taken_along_the_normal(name: str) -> None:
    sample = SURFACES[name].sample(3000, np.random.default_rng(1))
    step = 0.01
    outside = SURFACES[name].signed_distance(sample.points + step * sample.normals)
    assert np.abs(outside - step).max() < 1e-12
    # Inward the nearest face may be another one within `step` of an edge: never deeper than the step, rarely shallower.
    inside = SURFACES[name].signed_distance(sample.points - step * sample.normals)
    assert inside.min() > -step - 1e-12
    assert np.mean(np.abs(inside + step) < 1e-12) > 0.9


@pytest.mark.parametrize("name", ["sphere", "plane", "cylinder", "torus", "cube"])
def test_samples_are_uniform_by_area(name: str) -> None:
    n = 20_000
    points = SURFACES[name].sample(n, np.random.default_rng(2)).points
    x, y, z = points.T
    if name == "sphere":  # Archimedes: z is uniform
        cells, areas = np.histogram(z, np.linspace(-0.7, 0.7, 21))[0], np.ones(20)
    elif name == "plane":
        cells, areas = np.histogram2d(x, y, np.linspace(-1.5, 1.5, 6))[0].ravel(), np.ones(25)
    elif name == "cylinder":  # lids and side
        top, bottom = z > 0.75 - 1e-9, z < -0.75 + 1e-9
        cells = np.array([top.sum(), bottom.sum(), (~top & ~bottom).sum()])
        areas = np.array([np.pi * 0.16, np.pi * 0.16, 2 * np.pi * 0.4 * 1.5])
    elif name == "torus":  # the outer half has area 2 pi^2 R r + 4 pi r^2, the inner 2 pi^2 R r - 4 pi r^2
        outer = np.hypot(x, y) > 1.0
        cells = np.array([outer.sum(), (~outer).sum()])
        areas = 2 * np.pi**2 * 0.25 + np.array([1, -1]) * 4 * np.pi * 0.25**2
    else:
        axis = np.abs(points).argmax(axis=1)
        cells, areas = np.bincount(2 * axis + (points[np.arange(n), axis] > 0), minlength=6), np.ones(6)
    assert stats.chisquare(cells, n * areas / areas.sum()).pvalue > 1e-3


def test_sampling_follows_the_area_stretch_of_a_warp() -> None:
    """A plate bent by curvature c: the face at y = +h is longer by (1 + c h), the one at -h shorter by (1 - c h)."""
    curvature, half = 0.6, 0.5
    plate = solids.Part(solids.Extrusion(np.array([(-1, -half), (1, -half), (1, half), (-1, half)]), 2.0))
    points, _ = solids.Body([plate], warps=[warps.bend(curvature)]).sample(30_000, np.random.default_rng(3))
    radius = np.hypot(points[:, 0], points[:, 1] + 1 / curvature)
    n_outer = int((np.abs(radius - 1 / curvature - half) < 1e-9).sum())
    n_inner = int((np.abs(radius - 1 / curvature + half) < 1e-9).sum())
    expected = (1 + curvature * half) / 2
    assert stats.binomtest(n_outer, n_outer + n_inner, expected).pvalue > 1e-3


@pytest.mark.parametrize("name", WARPS)
def test_area_vectors_of_a_warp_are_the_cross_product_of_its_tangents(name: str) -> None:
    """Central differences with step h are exact to O(h^2) = 1e-10 times third derivatives (below 1e3 here)."""
    rng = np.random.default_rng(4)
    points, tangents, others = rng.uniform(-0.8, 0.8, (3, 500, 3))
    areas = np.cross(tangents, others)
    h = 1e-5

    def push(direction: solids.Vectors) -> solids.Vectors:
        return (WARPS[name](points + h * direction, areas)[0] - WARPS[name](points - h * direction, areas)[0]) / (2 * h)

    expected = np.cross(push(tangents), push(others))
    assert np.abs(WARPS[name](points, areas)[1] - expected).max() < 1e-7


def test_a_drilled_box_keeps_the_wall_of_the_hole_and_loses_the_lids() -> None:
    box = solids.Part(solids.Extrusion(np.array([(-1.0, -1.0), (1, -1), (1, 1), (-1, 1)]), 1.0))
    drill = solids.Part(solids.Lathe(np.array([(0, -2), (0.5, -2), (0.5, 2), (0, 2)])), carved=True)
    points, normals = solids.Body([box, drill]).sample(20_000, np.random.default_rng(6))
    radius = np.hypot(points[:, 0], points[:, 1])
    wall = np.abs(radius - 0.5) < 1e-12
    assert radius.min() > 0.5 - 1e-12
    assert np.abs(points[wall, 2]).max() < 0.5
    assert np.abs((normals[wall, :2] * points[wall, :2]).sum(axis=1) + 0.5).max() < 1e-12
    areas = np.array([np.pi, 2 * (4 - np.pi / 4) + 8])
    assert stats.binomtest(int(wall.sum()), len(wall), areas[0] / areas.sum()).pvalue > 1e-3


def test_nothing_visible_is_an_error() -> None:
    ball = solids.Part(solids.Blob())
    with pytest.raises(ValueError, match="visible"):
        solids.Body([ball], cuts=[(np.array([1.0, 0, 0]), -2.0)]).sample(10, np.random.default_rng(0))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_surface_fills_the_unit_sphere_and_has_unit_normals(seed: int) -> None:
    sample = shapes.random_surface(np.random.default_rng(seed), 3000)
    assert sample.points.shape == sample.normals.shape == (3000, 3)
    assert np.linalg.norm(sample.points, axis=1).max() == pytest.approx(1.0, abs=1e-12)
    assert np.abs(sample.points.max(axis=0) + sample.points.min(axis=0)).max() < 1e-12
    assert np.abs(np.linalg.norm(sample.normals, axis=1) - 1).max() < 1e-12
    assert len(np.unique(sample.points, axis=0)) == 3000


def test_one_seed_gives_one_surface_and_another_seed_another() -> None:
    first, again, other = (shapes.random_surface(np.random.default_rng(seed), 500).points for seed in (7, 7, 8))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("seed", SEEDS)
def test_normals_of_random_bodies_point_from_the_material_to_the_air(seed: int) -> None:
    """Without warps a step of 1e-7 along a normal must change sides; only samples within that step of an edge may not."""
    body = replace(families.random_body(np.random.default_rng(seed)), warps=())
    points, normals = body.sample(2000, np.random.default_rng(seed))

    def solid(at: solids.Vectors) -> solids.Mask:
        material = np.zeros(len(at), dtype=bool)
        for part in sorted(body.parts, key=lambda part: part.carved):
            material = material & ~part.contains(at) if part.carved else material | part.contains(at)
        return material

    assert solid(points - 1e-7 * normals).mean() > 0.999
    assert solid(points + 1e-7 * normals).mean() < 0.001


@pytest.mark.parametrize("seed", SEEDS)
def test_neighbours_on_a_random_surface_lie_in_the_tangent_plane(seed: int) -> None:
    """Two samples at distance d on a surface of curvature k leave the plane by k d / 2; edges and detail are the exceptions."""
    sample = shapes.random_surface(np.random.default_rng(seed), 60_000)
    distance, index = cKDTree(sample.points).query(sample.points, k=2)
    direction = (sample.points[index[:, 1]] - sample.points) / distance[:, 1:]
    assert np.median(np.abs((direction * sample.normals).sum(axis=1))) < 0.05


# Meshes

CUBE_FACES = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
"""Quads, counter-clockwise from outside, of the eight corners in the order of a binary count over x, y, z."""


def cube_obj(*lows: tuple[float, float, float]) -> str:
    """An OBJ of unit cubes with the given lowest corners."""
    lines = []
    for body, low in enumerate(lows):
        corners = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)]) + np.array(low)
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        lines += ["f " + " ".join(f"{corner + 8 * body}/1/1" for corner in face) for face in CUBE_FACES]
    return "\n".join(lines) + "\n"


@pytest.fixture
def cube_mesh(tmp_path: Path) -> meshes.Mesh:
    (tmp_path / "cube.obj").write_text(cube_obj((0.0, 0.0, 0.0)))
    return meshes.load_mesh(tmp_path / "cube.obj")


def test_quads_of_an_obj_become_triangles_of_the_same_outward_area(cube_mesh: meshes.Mesh) -> None:
    assert cube_mesh.faces.shape == (12, 3)
    assert np.linalg.norm(cube_mesh.area_vectors, axis=1).sum() == pytest.approx(6.0)
    outward = np.einsum("ij,ij->i", cube_mesh.corners.mean(axis=1) - 0.5, cube_mesh.area_vectors)
    assert outward.min() > 0
    assert cube_mesh.diagonal == pytest.approx(np.sqrt(3))


@pytest.mark.parametrize("suffix", [".ply", ".off", ".stl"])
def test_the_same_cube_is_read_from_every_format(suffix: str, cube_mesh: meshes.Mesh, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    written = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(cube_mesh.vertices), open3d.utility.Vector3iVector(cube_mesh.faces)
    )
    written.compute_triangle_normals()
    open3d.io.write_triangle_mesh(str(tmp_path / f"cube{suffix}"), written)
    read = meshes.load_mesh(tmp_path / f"cube{suffix}")
    assert np.array_equal(np.unique(read.vertices, axis=0), np.unique(cube_mesh.vertices, axis=0))
    assert np.linalg.norm(read.area_vectors, axis=1).sum() == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("missing.obj", None, "no such file"),
        ("cloud.xyz", "0 0 0\n", "not a mesh format"),
        ("cloud.obj", "v 0 0 0\nv 1 0 0\n", "no triangles"),
        ("word.obj", "v 0 0 zero\n", "line 1"),
        ("short.obj", "v 0 0\n", "line 1"),
        ("beyond.obj", "v 0 0 0\nv 1 0 0\nf 1 2 3\n", "beyond the 2"),
        ("nan.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 0 is not finite"),
    ],
)
def test_a_bad_mesh_file_is_one_line_that_names_it(name: str, text: str | None, fault: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ScanError, match=fault) as raised:
        meshes.load_mesh(tmp_path / name)
    assert name in str(raised.value)
    assert "\n" not in str(raised.value)


def test_mesh_samples_are_exactly_n_even_points_on_the_faces_with_their_normals(cube_mesh: meshes.Mesh) -> None:
    n = 2000
    sample = meshes.sample_mesh(cube_mesh, n, np.random.default_rng(1))
    assert sample.points.shape == (n, 3)
    height = np.abs(np.abs(sample.points - 0.5) - 0.5)
    assert height.min(axis=1).max() < 1e-12
    assert np.einsum("ij,ij->i", sample.points - 0.5, sample.normals) == pytest.approx(0.5)
    # The densest packing of n discs on area 6 has spacing sqrt(2 * 6 / (sqrt(3) n)); random points come 60 times nearer.
    spacing = cKDTree(sample.points).query(sample.points, k=2)[0][:, 1]
    assert spacing.min() > 0.55 * np.sqrt(12 / (np.sqrt(3) * n))


def test_what_lies_inside_another_body_is_not_sampled(tmp_path: Path) -> None:
    """Two unit cubes that overlap in a cube of side one half."""
    pytest.importorskip("open3d", exc_type=ImportError)
    (tmp_path / "two.obj").write_text(cube_obj((0, 0, 0), (0.5, 0.5, 0.5)))
    points = meshes.sample_mesh(meshes.load_mesh(tmp_path / "two.obj"), 4000, np.random.default_rng(2)).points
    in_first = ((points > 1e-4) & (points < 1 - 1e-4)).all(axis=1)
    in_second = ((points > 0.5 + 1e-4) & (points < 1.5 - 1e-4)).all(axis=1)
    assert not in_first.any()
    assert not in_second.any()


def test_a_body_turned_inside_out_still_has_outward_normals(cube_mesh: meshes.Mesh) -> None:
    sample = meshes.sample_mesh(meshes.Mesh(cube_mesh.vertices, cube_mesh.faces[:, ::-1]), 200, np.random.default_rng(3))
    assert np.einsum("ij,ij->i", sample.points - 0.5, sample.normals).min() > 0.4


def test_a_mesh_without_area_is_refused() -> None:
    line = meshes.Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(UsageError, match="no area"):
        meshes.sample_mesh(line, 10, np.random.default_rng(0))


def test_a_missing_open3d_is_one_sentence_with_the_fix(cube_mesh: meshes.Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with pytest.raises(UsageError, match="pip install open3d-cpu"):
        meshes.MeshQueries(cube_mesh)


def test_lambert_colour_depends_on_the_normal_alone_and_uses_its_range() -> None:
    normals = np.repeat(solids.directions(500, np.random.default_rng(0)), 2, axis=0)
    colour = meshes.lambert_rgb(normals, np.random.default_rng(1))
    assert colour.dtype == np.uint8
    assert np.array_equal(colour[::2], colour[1::2])
    assert np.ptp(colour.astype(int), axis=0).min() > 60


# Noise

FLAT = np.column_stack([np.random.default_rng(9).uniform(-1, 1, (40_000, 2)), np.zeros(40_000)])


@pytest.mark.parametrize("name", ["gaussian", "laplace", "heavy-tailed", "quantised"])
def test_isotropic_laws_have_mean_zero_and_the_asked_deviation_on_every_axis(name: str) -> None:
    """The standard error of a variance is std² sqrt((kurtosis - 1) / n); a Student law of freedom 4 has none, hence 20 %."""
    points = np.random.default_rng(8).uniform(-1, 1, (40_000, 3))
    error = noise.NOISES[name](points, 0.02, np.random.default_rng(1)) - points
    assert np.abs(error.mean(axis=0)).max() < 4 * 0.02 / np.sqrt(len(points))
    tolerance = 0.2 if name == "heavy-tailed" else 4 * np.sqrt(5 / len(points))
    assert np.abs(error.var(axis=0) / 0.02**2 - 1).max() < tolerance


@pytest.mark.parametrize("name", ["rays", "beam-bias"])
def test_range_noise_moves_along_rays_that_meet_in_one_place(name: str) -> None:
    error = noise.NOISES[name](FLAT, 0.02, np.random.default_rng(2)) - FLAT
    length = np.linalg.norm(error, axis=1, keepdims=True)
    moved = length[:, 0] > 1e-6
    ray = error[moved] / length[moved]
    # The place nearest to all lines solves sum (I - r r^T) (x - p) = 0; all lines pass through it.
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    centre = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, FLAT[moved]))
    assert np.abs(np.einsum("nij,nj->ni", across, centre - FLAT[moved])).max() < 1e-6
    # 64 biases with 2/3 of the variance: the mean square is off by sqrt(2 / 64) 2 / 3 = 12 % per standard deviation.
    assert (length**2).mean() / 0.02**2 == pytest.approx(1, abs=0.05 if name == "rays" else 0.5)


def test_one_beam_has_one_bias() -> None:
    error = noise.beam_bias(FLAT, 0.02, np.random.default_rng(3), n_beams=1) - FLAT
    rays = error / np.linalg.norm(error, axis=1, keepdims=True)
    signed = np.einsum("ij,ij->i", error, rays * np.sign(rays @ rays[0])[:, None])
    assert signed.std() == pytest.approx(0.02 * np.sqrt(1 / 3), rel=0.05)


@pytest.mark.parametrize("name", ["anisotropic", "misregistered"])
def test_the_largest_deviation_over_directions_is_about_the_asked_one(name: str) -> None:
    error = noise.NOISES[name](FLAT, 0.02, np.random.default_rng(4)) - FLAT
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(error.T))[-1])
    assert 0.9 * 0.02 * np.sqrt(1 / 3) < worst < 0.02 * (1.02 if name == "anisotropic" else 2.0)


def test_misregistered_passes_split_a_plane_into_layers() -> None:
    noisy = noise.misregistered(FLAT, 0.02, np.random.default_rng(5), n_passes=2)
    assert stats.kurtosis(noisy[:, 2]) < 0.1  # a mixture of two shifted normal laws is never peaked


def test_outliers_are_marked_and_nothing_else_moves() -> None:
    points, wrong = noise.outliers(FLAT, 0.05, np.random.default_rng(6))
    assert np.array_equal((points != FLAT).any(axis=1), wrong)
    assert stats.binomtest(int(wrong.sum()), len(FLAT), 0.05).pvalue > 1e-3


def test_thinning_keeps_rows_and_spreads_their_density_tenfold() -> None:
    kept = noise.thin(FLAT, np.random.default_rng(7), contrast=10.0)
    assert np.array_equal(kept, np.unique(kept))
    count = np.histogram2d(*FLAT[kept, :2].T, bins=12)[0] / np.histogram2d(*FLAT[:, :2].T, bins=12)[0]
    assert 4 < count.max() / count.min() < 16
    assert np.array_equal(noise.thin(FLAT, np.random.default_rng(7), contrast=1.0), np.arange(len(FLAT)))


@pytest.mark.parametrize("name", noise.NOISES)
def test_every_law_keeps_rows_repeats_with_its_seed_and_is_nothing_at_zero(name: str) -> None:
    law = noise.NOISES[name]
    first, again = (law(FLAT[:100], 0.1, np.random.default_rng(8)) for _ in range(2))
    assert first.shape == (100, 3)
    assert np.array_equal(first, again)
    assert np.array_equal(law(FLAT[:100], 0.0, np.random.default_rng(8)), FLAT[:100])
