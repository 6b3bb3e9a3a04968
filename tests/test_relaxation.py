"""Relaxation evens the spacing, stays on the surface, goes no further than the noise and leaves what is no sheet alone."""

from __future__ import annotations

import numpy as np
import pytest

from known_clouds import UTM, ball, cloud, moves, rms, rotation
from pcdenoise.cloud.neighbours import knn
from pcdenoise.denoising import relaxation
from pcdenoise.denoising.relaxation import relax, without_low_frequencies

STEPS = 8


@pytest.fixture(params=["numpy", "compiled"], autouse=True)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Either way of computing it."""
    if request.param == "compiled" and not relaxation.IS_BUILT:
        pytest.skip("was installed where no C compiler is")
    monkeypatch.setattr(relaxation, "IS_BUILT", request.param == "compiled")


def unevenness(points: np.ndarray) -> float:
    """Coefficient of variation of the distance to the nearest other point: 0.52 for Poisson points, 0 for a lattice."""
    nearest = knn(points, 2, threads=1)[0][:, 1]
    return float(nearest.std() / nearest.mean())


def test_chance_becomes_even_spacing_on_a_plane_that_is_not_left() -> None:
    flat = cloud("plane", 3000, 0.0)
    relaxed = relax(flat.clean, flat.spacing, STEPS, threads=1)
    assert unevenness(flat.clean) == pytest.approx(np.sqrt(4 / np.pi - 1), rel=0.05)
    assert unevenness(relaxed) < 0.5 * unevenness(flat.clean)
    np.testing.assert_allclose(relaxed[:, 2], 0, atol=1e-15)


@pytest.mark.parametrize(("name", "curvature"), [("sphere", 1.0), ("cylinder", 1 / 0.6), ("torus", 1 / 0.4)])
def test_on_a_curved_surface_points_slide_and_land_on_it_again(name: str, curvature: float) -> None:
    clean = cloud(name, 3000, 0.0)
    inner = np.abs(clean.clean[:, 2]) < 0.8 if name == "cylinder" else np.ones(3000, dtype=bool)  # away from the rims
    relaxed = relax(clean.clean, 0.5 * clean.spacing, STEPS, threads=1)
    slide = moves(clean.clean, relaxed)
    assert unevenness(relaxed) < 0.6 * unevenness(clean.clean)
    assert np.median(slide) > 0.1 * clean.spacing
    # The 16 neighbours of a landing point reach ρ = spacing √(16 / π) and lie up to κρ²/2 under its tangent plane; the half sum
    # of heights and depths cancels that where they surround the point, and no neighbourhood may err by more than its depth.
    left, reach = np.abs(clean.surface.signed_distance(relaxed))[inner], knn(clean.clean, 17, threads=1)[0][:, -1].max()
    assert rms(left) < 0.11 * curvature * clean.spacing**2 * 16 / np.pi / 2
    assert left.max() < curvature * reach**2 / 2


def test_points_do_not_crowd_along_edges() -> None:
    """A neighbour beyond an edge bounds a cell as one in the plane does, though the way around is longer."""
    cube = cloud("cube", 6000, 0.0)
    relaxed = relax(cube.clean, 0.5 * cube.spacing, 4, threads=1)
    nearest = knn(relaxed, 2, threads=1)[0][:, 1]
    to_edge = np.sort(1 - np.abs(relaxed), axis=1)[:, 1]
    assert nearest[to_edge < cube.spacing].mean() > 0.78 * nearest[to_edge > 3 * cube.spacing].mean()
    assert (nearest[to_edge < cube.spacing] < 0.5 * cube.spacing).mean() < 0.17


@pytest.mark.parametrize("name", ["plane", "torus", "cube"])
def test_no_point_goes_further_than_the_noise_can_have_displaced_it(name: str) -> None:
    clean, reach = cloud(name, 2000, 0.0), relaxation._REACH_STDS
    assert reach <= 2
    for std_spacings in (0.01, 0.2, 0.5):
        std = std_spacings * clean.spacing
        slide = moves(clean.clean, relax(clean.clean, std, 30, threads=1))
        assert slide.max() <= reach * std * (1 + 1e-9)
        # The bound is met, or this would test nothing; by little noise a point is held before it comes so far.
        assert std_spacings < 0.1 or slide.max() > 0.95 * reach * std


def test_without_noise_without_steps_and_with_few_points_nothing_moves(rng: np.random.Generator) -> None:
    points = cloud("sphere", 500, 0.0).clean
    np.testing.assert_array_equal(relax(points, 0.0, STEPS, threads=1), points)
    np.testing.assert_array_equal(relax(points, 0.1, 0, threads=1), points)
    for n in range(4):
        few = rng.random((n, 3))
        np.testing.assert_array_equal(relax(few, 1.0, STEPS, threads=1), few)


@pytest.mark.parametrize("n", [4, 5, 12, 13, 14])
def test_a_handful_of_points_stays_finite_and_within_the_bound(rng: np.random.Generator, n: int) -> None:
    points = np.column_stack([rng.random((n, 2)), np.zeros(n)])
    relaxed = relax(points, 0.01, STEPS, threads=1)
    assert moves(points, relaxed).max() <= 0.01 * relaxation._REACH_STDS * (1 + 1e-9)


def test_a_lattice_is_at_rest() -> None:
    angle = np.arange(30.0)
    x, y = np.meshgrid(angle, angle)
    lattice = np.stack([x + y / 2, y * np.sqrt(0.75), np.zeros_like(x)], axis=-1).reshape(-1, 3)
    inner = (x > 8) & (x < 21) & (y > 8) & (y < 21)
    slide = moves(lattice, relax(lattice, 1.0, 3, threads=1)).reshape(x.shape)
    assert slide[inner].max() < 1e-9


def test_points_on_a_wire_do_not_fan_out_to_a_ribbon(rng: np.random.Generator) -> None:
    # Cells of a line have no width: without a second dimension nothing may spread into it.
    t = np.sort(rng.random(400)) * 6
    wire = np.column_stack([t, np.sin(t), 0.3 * np.cos(2 * t)])
    np.testing.assert_allclose(relax(wire, 0.05, STEPS, threads=1), wire, atol=1e-3)


def test_points_in_a_volume_move_less_than_on_a_sheet(rng: np.random.Generator) -> None:
    # Bound by the noise all the same; planarity of chance neighbourhoods in a volume is 0.21 in the median.
    volume, sheet = ball(3000, rng), cloud("plane", 3000, 0.0)
    apart = [np.median(knn(points, 2, threads=1)[0][:, 1]) for points in (volume, sheet.clean)]
    slides = [
        np.median(moves(points, relax(points, 0.5 * a, STEPS, threads=1))) / a
        for points, a in zip((volume, sheet.clean), apart, strict=True)
    ]
    assert slides[0] < 0.3 * slides[1]


def test_relaxation_follows_turns_shifts_units_and_the_order_of_rows(rng: np.random.Generator) -> None:
    noisy = cloud("torus", 1200, 0.1)
    std, order, turn = 0.3 * noisy.spacing, rng.permutation(1200), rotation(rng)
    relaxed = relax(noisy.noisy, std, STEPS, threads=1)
    np.testing.assert_allclose(relax(noisy.noisy[order], std, STEPS, threads=1), relaxed[order], atol=1e-9)
    np.testing.assert_allclose(relax(noisy.noisy @ turn.T, std, STEPS, threads=1), relaxed @ turn.T, atol=1e-9)
    np.testing.assert_allclose(relax(noisy.noisy * 1e3, std * 1e3, STEPS, threads=1), relaxed * 1e3, atol=1e-6)
    # One float64 step of a northing is 1e-9; the sine of a plane through points 0.1 apart errs by 1e-8 and some more.
    np.testing.assert_allclose(relax(noisy.noisy + UTM, std, STEPS, threads=1) - UTM, relaxed, atol=1e-6)


def test_blocks_and_threads_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = cloud("torus", 1200, 0.1)
    whole = relax(noisy.noisy, 0.3 * noisy.spacing, STEPS, threads=1)
    monkeypatch.setattr(relaxation, "_BLOCK", 101)
    np.testing.assert_allclose(relax(noisy.noisy, 0.3 * noisy.spacing, STEPS, threads=2), whole, atol=1e-12)


@pytest.mark.skipif(not relaxation.IS_BUILT, reason="was installed where no C compiler is")
@pytest.mark.parametrize("way", ["compiled"], indirect=True)
def test_compiled_code_and_numpy_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy, ways = cloud("cube", 1200, 0.3), []
    for is_built in (False, True):
        monkeypatch.setattr(relaxation, "IS_BUILT", is_built)
        ways.append(relax(noisy.noisy, 0.5 * noisy.spacing, STEPS, threads=1))
    np.testing.assert_allclose(*ways, atol=1e-9 * noisy.spacing)


def test_the_input_is_not_written_to() -> None:
    points = cloud("torus", 500, 0.1).noisy
    before = points.copy()
    relax(points, 0.1, STEPS, threads=1)
    np.testing.assert_array_equal(points, before)


def test_moves_that_all_share_are_taken_back_and_those_of_single_points_stay(rng: np.random.Generator) -> None:
    points = np.column_stack([rng.random((4000, 2)), np.zeros(4000)])
    inner = (np.abs(points[:, :2] - 0.5) < 0.4).all(axis=1)
    noise, drift = 0.01 * rng.standard_normal((4000, 3)), np.tile([0.02, -0.01, 0.03], (4000, 1))
    left = without_low_frequencies(points, noise + drift, 0.1, np.random.default_rng(0))[inner]
    # Some 125 neighbours, of whose weights s = 0.057 leaves about 60 even ones: a mean of their noise of 0.13 remains.
    assert np.abs(left.mean(axis=0)).max() < 0.001
    assert (left - noise[inner]).std() < 0.25 * 0.01
    slope = points[:, :1] * [0, 0, 0.1]  # a Gaussian mean keeps what is linear: nothing of a tilt is left
    tilted = without_low_frequencies(points, slope, 0.1, np.random.default_rng(0))[inner]
    assert np.abs(tilted).mean() < 0.02 * np.abs(slope).mean()


def test_a_low_pass_leaves_lonely_points_and_empty_clouds_alone(rng: np.random.Generator) -> None:
    points, moves = np.arange(15.0).reshape(5, 3), rng.standard_normal((5, 3))
    np.testing.assert_array_equal(without_low_frequencies(points, moves, 0.1, rng), moves)
    assert len(without_low_frequencies(points[:0], moves[:0], 0.1, rng)) == 0


def test_points_that_a_pass_has_led_to_one_place_stay_numbers(rng: np.random.Generator) -> None:
    points = np.concatenate([np.full((14, 3), 0.5), np.column_stack([rng.random((300, 2)), np.full(300, 0.5)])])
    relaxed = relax(points, 0.05, STEPS, threads=1)
    assert np.isfinite(relaxed).all()
    assert moves(points, relaxed).max() <= 0.05 * relaxation._REACH_STDS * (1 + 1e-9)


def test_each_point_slides_by_the_noise_of_its_place() -> None:
    sample = cloud("plane", 1500, 0.0)
    std = np.where(sample.clean[:, 0] > 0, 0.5 * sample.spacing, 0.0)
    slide = moves(sample.clean, relax(sample.clean, std, STEPS, threads=1))
    assert np.median(slide[std > 0]) > 0.1 * sample.spacing
    assert slide[std == 0].max() <= 1e-12
