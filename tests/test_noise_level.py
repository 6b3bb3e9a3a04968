"""The noise level of known surfaces under known noise, and what is no surface."""

from __future__ import annotations

import numpy as np
import pytest

from known_clouds import SURFACES, UTM, ball, cloud, rotation, varied
from pcdenoise.cloud import noise_level
from pcdenoise.cloud.neighbours import coordinate_hash, spatial_order
from pcdenoise.cloud.noise_level import N_PROBES, NoiseLevel, by_place, estimate

NO_SURFACE = {
    "ball": ball,
    "box": lambda n, rng: rng.random((n, 3)),
    "blob": lambda n, rng: rng.standard_normal((n, 3)),
}


def level(name: str, n: int, std_spacings: float, seed: int = 0) -> tuple[NoiseLevel, float]:
    """The estimate and what it says in multiples of the true standard deviation."""
    noisy = cloud(name, n, std_spacings, seed)
    found = estimate(noisy.noisy, threads=1)
    return found, found.std / (std_spacings * noisy.spacing)


@pytest.mark.parametrize("std_spacings", [0.1, 0.3, 1.0, 2.0])
@pytest.mark.parametrize("name", SURFACES)
def test_noise_on_a_surface_is_read_within_thirty_percent(name: str, std_spacings: float) -> None:
    # It reads low by design: the clearer half of all places decides, and sixteen points leave ten degrees of freedom, whose
    # lower quartile is 0.82 of their standard deviation. The torus's tube is three standard deviations thick at the last.
    found, ratio = level(name, 4000, std_spacings)
    assert found.is_surface
    assert 0.7 < ratio < 1.3


@pytest.mark.parametrize("name", ["plane", "sphere", "torus"])
def test_noise_of_three_spacings_is_read_within_a_tenth_where_points_are_dense(name: str) -> None:
    # Large neighbourhoods have many degrees of freedom; what is left is 1000 probes' scatter and the torus's curvature.
    assert level(name, 20_000, 3.0)[1] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("name", SURFACES)
def test_a_clean_surface_has_no_noise_and_the_spacing_of_random_points(name: str) -> None:
    clean = cloud(name, 4000, 0.0)
    found = estimate(clean.clean, threads=1)
    # A quadric errs by third order: (h / R)³ of the neighbourhood's radius h ~ 2 spacings, averaged down by the fit.
    assert found.std < 0.002 * clean.spacing
    # The distance to the nearest of Poisson points of density 1/s² has the median s √(ln 2 / π); 1000 probes scatter by 2 %.
    assert found.spacing == pytest.approx(clean.spacing * np.sqrt(np.log(2) / np.pi), rel=0.07)
    assert found.is_surface


def test_more_noise_is_never_read_as_less() -> None:
    stds = [estimate(cloud("sphere", 3000, std).noisy, threads=1).std for std in (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)]
    assert (np.diff(stds) > 0).all()


def test_the_scale_that_shows_the_surface_grows_with_the_variance_of_the_noise_and_with_the_density() -> None:
    # Points within 4.5 std of a plane point: π (4.5 std)² per spacing². The ladder's median ball is bent and cut at borders.
    for n, std_spacings in ((4000, 1.5), (4000, 2.0), (16_000, 2.0)):
        found, ratio = level("plane", n, std_spacings)
        assert found.scale_points == pytest.approx(np.pi * (4.5 * ratio * std_spacings) ** 2, rel=0.25)


@pytest.mark.parametrize("share", [0.2, 1.0, 3.0])
def test_noise_that_is_known_is_taken_as_it_is_and_tells_the_scale(share: float) -> None:
    found = cloud("plane", 16_000, 1.0)
    std = share * found.spacing
    told = estimate(found.noisy, threads=1, known_std=std)
    assert (told.std, told.is_surface) == (std, True)
    assert told.spacing == estimate(found.noisy, threads=1).spacing
    assert told.scale_points == pytest.approx(max(1, np.pi * (4.5 * share) ** 2), rel=0.3)


@pytest.mark.parametrize("n", [300, 4000, 20_000])
@pytest.mark.parametrize("name", NO_SURFACE)
def test_a_filled_volume_is_no_surface(rng: np.random.Generator, name: str, n: int) -> None:
    assert not estimate(NO_SURFACE[name](n, rng), threads=1).is_surface


@pytest.mark.parametrize("n", [16, 32, 64])
@pytest.mark.parametrize("name", NO_SURFACE)
def test_few_points_in_a_volume_are_taken_for_a_surface_by_chance_alone(rng: np.random.Generator, name: str, n: int) -> None:
    # One in twenty is; 12 or more of 60 are with a chance below 0.0001.
    assert sum(estimate(NO_SURFACE[name](n, rng), threads=1).is_surface for _ in range(60)) < 12


@pytest.mark.parametrize("n", [16, 32, 64])
def test_few_points_on_a_sheet_show_it(rng: np.random.Generator, n: int) -> None:
    sheet = rng.uniform(-1, 1, (n, 3)) * (1, 1, 0)
    std = 0.2 * 2 / np.sqrt(n)
    assert all(estimate(sheet + rng.normal(0, std, (n, 3)), threads=1).is_surface for _ in range(20))


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**30])
def test_the_estimate_scales_with_the_cloud(factor: float) -> None:
    # Coordinates hash differently in another unit, so that other probes would be drawn from more points; nothing else may change.
    points = cloud("torus", N_PROBES, 0.7).noisy
    one, other = estimate(points, threads=1), estimate(points * factor, threads=1)
    assert other.std == pytest.approx(factor * one.std, rel=1e-9)
    assert other.spacing == pytest.approx(factor * one.spacing, rel=1e-9)
    assert (other.scale_points, other.is_surface) == (pytest.approx(one.scale_points, rel=1e-9), one.is_surface)


def test_the_estimate_hardly_changes_when_the_cloud_is_turned_and_shifted(rng: np.random.Generator) -> None:
    points = cloud("torus", 2000, 0.7).noisy
    turned = estimate(points @ rotation(rng).T + UTM, threads=1)
    # Other probes are drawn, so this is their scatter: 2 to 3 percent each.
    assert turned.std == pytest.approx(estimate(points, threads=1).std, rel=0.1)


def test_rows_in_another_order_and_exact_duplicates_change_nothing(rng: np.random.Generator) -> None:
    points = cloud("sphere", 2000, 0.5).noisy
    found = estimate(points, threads=1)
    assert estimate(rng.permutation(points), threads=1) == found
    assert estimate(np.concatenate([points, points[:700], points[:1]]), threads=1) == found
    assert estimate(points, threads=2) == found


def test_another_seed_looks_at_other_places_and_finds_about_the_same() -> None:
    points = cloud("sphere", 8000, 0.5).noisy
    one, other = estimate(points, seed=1, threads=1), estimate(points, seed=2, threads=1)
    assert one.std != other.std
    assert one.std == pytest.approx(other.std, rel=0.1)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 15])
def test_fewer_than_sixteen_distinct_points_show_no_noise_and_no_surface(n: int) -> None:
    points = np.column_stack([np.arange(n) * 3.0, np.zeros((n, 2))])
    assert estimate(np.repeat(points, 9, axis=0), threads=1) == NoiseLevel(0.0, 3.0 if n > 1 else 0.0, 16.0, False, n_points=n)


def test_flat_straight_and_coincident_points_have_no_noise(rng: np.random.Generator) -> None:
    flat = np.column_stack([rng.random((500, 2)), np.zeros(500)])
    line = np.outer(rng.random(500), [1.0, 2.0, -0.5]) + UTM
    # No reading is finer than a millionth of the neighbourhoods' radius, which is under a tenth here.
    assert estimate(flat, threads=1).std < 2e-7
    assert estimate(line, threads=1).std < 2e-7
    assert estimate(np.full((500, 3), 3.0), threads=1).std == 0


def test_one_point_far_away_does_not_hide_the_rest() -> None:
    points = cloud("sphere", 2000, 0.5).noisy
    found = estimate(np.concatenate([points, [[1e9, 0, 0]]]), threads=1)
    assert found.std == pytest.approx(estimate(points, threads=1).std, rel=0.1)
    assert found.is_surface


# Noise by place


def placed(points: np.ndarray, known_std: float | None = None) -> tuple[np.ndarray, NoiseLevel]:
    """By place, in the order of the rows that are given."""
    order = spatial_order(points)
    ordered, level = points[order], estimate(points, threads=1, known_std=known_std)
    noise = np.empty(len(points))
    noise[order] = by_place(ordered, coordinate_hash(ordered, 0), level, threads=1)
    return noise, level


@pytest.mark.parametrize("name", ["plane", "sphere", "torus"])
def test_noise_that_is_the_same_everywhere_is_the_same_at_every_place(name: str) -> None:
    noise, level = placed(cloud(name, 8000, 1.0).noisy)
    # Readings are means over 384 points, of a scatter of 4 %, and the factor within which they are not told apart is 1.33.
    assert np.mean(np.abs(noise / level.std - 1) < 0.05) > 0.95


@pytest.mark.parametrize("name", ["plane", "sphere", "cylinder"])
def test_places_tell_how_noise_grows_along_a_scan(name: str) -> None:
    sample = cloud(name, 20_000, 1.0)
    noisy, times = varied(sample, 0.6, 2.4)
    noise, level = placed(noisy)
    true = times * sample.spacing
    log_ratio = np.log(noise / true)
    # Within 1.33 of the cloud's it counts as the cloud's, and what is beyond counts by so much less: ln 1.33 = 0.29, and 4 %.
    assert np.sqrt(np.mean(log_ratio**2)) < 0.45
    assert np.sqrt(np.mean(log_ratio**2)) < 0.75 * np.sqrt(np.mean(np.log(level.std / true) ** 2))
    assert np.corrcoef(np.log(noise), np.log(true))[0, 1] > 0.8


def test_places_are_within_bounds_and_take_what_is_known_as_it_is(rng: np.random.Generator) -> None:
    noisy, _ = varied(cloud("plane", 6000, 1.0), 0.4, 4.0)
    noise, level = placed(noisy)
    most = noise_level.MOST_TIMES / noise_level.UNCERTAIN * (1 + 1e-9)
    assert np.all((noise >= level.std / most) & (noise <= level.std * most))
    assert noise.max() > 1.5 * level.std
    known, level = placed(noisy, known_std=0.03)
    assert level.is_known
    np.testing.assert_array_equal(known, 0.03)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((1, 3)), np.arange(45.0).reshape(15, 3) % 7])
def test_few_points_have_the_noise_of_the_cloud(points: np.ndarray) -> None:
    level = NoiseLevel(0.1, 1.0, 16.0, False, n_points=len(points))
    np.testing.assert_array_equal(by_place(points, coordinate_hash(points, 0), level, threads=1), np.full(len(points), 0.1))


def test_a_part_of_a_cloud_has_the_noise_by_place_that_the_whole_has() -> None:
    noisy, _ = varied(cloud("plane", 20_000, 0.6), 0.5, 3.0)
    noisy = noisy[spatial_order(noisy)]
    identity, level = coordinate_hash(noisy, 0), estimate(noisy, threads=1)
    whole = by_place(noisy, identity, level, threads=1)
    part = np.abs(noisy[:, 0]) < 0.7
    inner = np.abs(noisy[:, 0]) < 0.3  # 384 points reach about 11 spacings, the neighbourhoods of their places 5 more
    found = np.empty(len(noisy))
    found[part] = by_place(noisy[part], identity[part], level, threads=1)
    np.testing.assert_allclose(found[inner], whole[inner], rtol=1e-12)


def test_noise_by_place_follows_turns_units_and_the_order_of_rows(rng: np.random.Generator) -> None:
    noisy, _ = varied(cloud("torus", 900, 1.0), 0.5, 3.0)  # few enough for every point to be a place
    noise, _ = placed(noisy)
    order = rng.permutation(len(noisy))
    np.testing.assert_allclose(placed(noisy[order])[0], noise[order], rtol=1e-9)
    np.testing.assert_allclose(placed(noisy @ rotation(rng).T)[0], noise, rtol=1e-6)
    np.testing.assert_allclose(placed(noisy * 1e3)[0], noise * 1e3, rtol=1e-6)
