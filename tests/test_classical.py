"""The classical filters on planes, spheres, creases and degenerate clouds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pcdenoise.cloud.neighbours import knn
from pcdenoise.denoising import classical
from pcdenoise.denoising.classical import FILTERS, bilateral, jet, mean, tune
from pcdenoise.errors import UsageError

Filter = Callable[[np.ndarray], np.ndarray]

FIXED: dict[str, Filter] = {
    "mean": lambda points: mean(points, 16),
    "jet": lambda points: jet(points, 24),
    "plane": lambda points: jet(points, 16, degree=1),
}


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def on_square(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.column_stack([rng.random((n, 2)), np.zeros(n)])


def on_sphere(rng: np.random.Generator, n: int) -> np.ndarray:
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def inner(points: np.ndarray, margin: float) -> np.ndarray:
    return (np.abs(points[:, :2] - 0.5) < 0.5 - margin).all(axis=1)


def variance_factor(degree: int) -> float:
    """k times the variance that the weighted fit leaves at the centre of a disc, by numerical integration over t = (r / R)².

    By symmetry the value at the centre only mixes with u² + v², so the quadric has two unknowns there and the plane one.
    """
    t = (np.arange(100_000) + 0.5) / 100_000
    weights = np.exp(-1.5 * t)
    terms = np.stack([np.ones_like(t), t])[:degree]
    inverse = np.linalg.inv(terms * weights @ terms.T / t.size)
    return float((inverse @ (terms * weights**2 @ terms.T / t.size) @ inverse)[0, 0])


@pytest.mark.parametrize("degree", [1, 2])
def test_jet_on_a_plane_leaves_the_variance_of_its_fit(rng: np.random.Generator, degree: int) -> None:
    k, noise = 64, 1e-4
    points = on_square(rng, 20_000)
    keep = inner(points, 0.05)
    moved = jet(points + [0, 0, 1] * rng.normal(size=(20_000, 1)) * noise, k, degree)
    # About 16 000 / 64 independent neighbourhoods: the measured variance itself scatters by sqrt(2 / 250) = 9 %.
    assert (moved[keep, 2] ** 2).mean() / noise**2 == pytest.approx(variance_factor(degree) / k, rel=0.2)


def test_mean_on_a_plane_divides_the_variance_by_k(rng: np.random.Generator) -> None:
    points = on_square(rng, 20_000)
    keep = inner(points, 0.05)
    moved = mean(points + [0, 0, 1] * rng.normal(size=(20_000, 1)) * 1e-4, 32)
    assert (moved[keep, 2] ** 2).mean() / 1e-8 == pytest.approx(1 / 32, rel=0.2)


def test_mean_sinks_into_a_sphere_by_k_over_n_and_jet_does_not(rng: np.random.Generator) -> None:
    # Archimedes: the k nearest of N points fill a cap of height 2k/N, and their mean height is half of that.
    points = on_sphere(rng, 10_000)
    by_mean, by_jet = (1 - np.linalg.norm(moved, axis=1).mean() for moved in (mean(points, 50), jet(points, 50)))
    assert by_mean == pytest.approx(50 / 10_000, rel=0.05)
    assert abs(by_jet) < 0.02 * by_mean


def test_jet_on_a_noisy_sphere_leaves_the_variance_of_its_fit(rng: np.random.Generator) -> None:
    points = on_sphere(rng, 20_000) * (1 + 1e-3 * rng.normal(size=(20_000, 1)))
    # The curvature's third-order terms cancel on a sphere; the fourth order is (k/N)² ~ 1e-5, far below the noise of 1e-3.
    assert np.mean((np.linalg.norm(jet(points, 64), axis=1) - 1) ** 2) / 1e-6 == pytest.approx(variance_factor(2) / 64, rel=0.15)


def test_bilateral_on_a_plane_and_a_sphere_takes_away_almost_half_of_the_noise(rng: np.random.Generator) -> None:
    plane = on_square(rng, 10_000) + 0.01 * rng.normal(size=(10_000, 3))
    sphere = on_sphere(rng, 10_000) + 0.02 * rng.normal(size=(10_000, 3))
    keep = inner(plane, 0.08)
    assert rms(bilateral(plane)[keep, 2]) < 0.6 * 0.01
    assert rms(np.linalg.norm(bilateral(sphere), axis=1) - 1) < 0.6 * 0.02


@pytest.mark.parametrize("method", ["mean", "jet"])
def test_the_automatic_size_beats_a_fixed_one_under_strong_noise_and_matches_it_under_weak(
    rng: np.random.Generator, method: str
) -> None:
    size = {"jet": 24, "mean": 12}[method]
    for noise, bar in ((0.006, 1.2), (0.09, 0.8)):
        points = on_sphere(rng, 4000) + noise * rng.normal(size=(4000, 3))
        automatic, fixed = (rms(np.linalg.norm(FILTERS[method](points, k), axis=1) - 1) for k in (None, size))
        assert automatic < bar * fixed


def test_a_quadric_in_its_own_frame_is_reproduced_exactly(rng: np.random.Generator) -> None:
    u = rng.normal(size=(40, 2))
    u = np.concatenate([[[0, 0]], u, -u, u @ [[0, 1], [-1, 0]], -u @ [[0, 1], [-1, 0]]])  # four-fold: the PCA frame is exact
    for bend in (np.diag([0.3, 0.3]), np.diag([0.2, -0.2])):
        points = np.column_stack([u, np.einsum("ni,ij,nj->n", u, bend, u)]) * 0.1
        turn, shift = rotation(rng), np.array([5e5, 4.5e6, 100.0])
        moved = jet(points @ turn.T + shift, len(points))
        assert np.linalg.norm(moved[0] - shift) < 1e-8  # a few steps of float64 at 4.5e6


def test_the_error_of_jet_on_a_clean_surface_falls_faster_than_that_of_a_plane(rng: np.random.Generator) -> None:
    def error(n: int, degree: int) -> float:
        x = on_square(rng, n)
        x[:, 2] = 0.1 * np.sin(6 * x[:, 0]) * np.cos(5 * x[:, 1])
        return rms((jet(x, 32, degree) - x)[inner(x, 0.1)])

    # Four times the points halve the spacing h: a plane errs by h², a quadric by h³ (odd terms of one-sided neighbourhoods).
    assert error(4_000, 1) / error(16_000, 1) == pytest.approx(4, rel=0.15)
    assert error(4_000, 2) / error(16_000, 2) > 6


def test_bilateral_keeps_a_crease_sharper_than_mean(rng: np.random.Generator) -> None:
    n, noise = 20_000, 0.004
    along, across = rng.random(n), rng.uniform(-0.5, 0.5, n)
    roof = np.column_stack([across, along, -np.abs(across)]) + noise * rng.normal(size=(n, 3))

    def distance(points: np.ndarray) -> np.ndarray:
        return np.abs(points[:, 2] + np.abs(points[:, 0])) / np.sqrt(2)

    near_ridge = (np.abs(across) < 0.02) & (np.abs(along - 0.5) < 0.45)
    flat = (np.abs(np.abs(across) - 0.25) < 0.1) & (np.abs(along - 0.5) < 0.4)
    by_bilateral, by_mean = bilateral(roof, 0.05), mean(roof, 80)
    assert rms(distance(by_mean)[flat]) == pytest.approx(rms(distance(by_bilateral)[flat]), rel=0.5)  # as strong a filter ...
    assert rms(distance(by_bilateral)[near_ridge]) < 0.7 * rms(distance(by_mean)[near_ridge])  # ... that keeps the ridge


@pytest.mark.parametrize("name", [*FIXED, "bilateral"])
def test_filters_commute_with_similarities_and_row_order(rng: np.random.Generator, name: str) -> None:
    points = on_sphere(rng, 1500) * [1.0, 0.7, 0.5] + 0.01 * rng.normal(size=(1500, 3))

    def apply(x: np.ndarray, scale: float = 1.0) -> np.ndarray:
        return bilateral(x, 0.15 * scale, 0.1 * scale, 0.03 * scale) if name == "bilateral" else FIXED[name](x)

    moved, turn, order = apply(points), rotation(rng), rng.permutation(len(points))
    utm = np.array([5.0e5, 4.5e6, 120.0])
    np.testing.assert_allclose(apply(points @ turn.T), moved @ turn.T, atol=1e-9)
    np.testing.assert_allclose(apply(points[order]), moved[order], atol=1e-12)
    np.testing.assert_allclose(apply(points + utm) - utm, moved, atol=1e-7)  # one float64 step at 4.5e6 is 1e-9
    np.testing.assert_allclose(apply(points * 1e4, 1e4), moved * 1e4, atol=1e-6)
    assert not np.allclose(moved, points, atol=1e-3)


def test_a_cloud_of_doubled_points_is_filtered_as_the_single_one(rng: np.random.Generator) -> None:
    points = on_sphere(rng, 800) + 0.01 * rng.normal(size=(800, 3))
    doubled = np.repeat(points, 2, axis=0)
    np.testing.assert_allclose(jet(doubled, 48), np.repeat(jet(points, 24), 2, axis=0), atol=1e-8)
    np.testing.assert_allclose(mean(doubled, 48), np.repeat(mean(points, 24), 2, axis=0), atol=1e-12)
    by_ball = bilateral(doubled, 0.1, 0.05, 0.03), bilateral(points, 0.1, 0.05, 0.03)
    np.testing.assert_allclose(by_ball[0], np.repeat(by_ball[1], 2, axis=0), atol=1e-9)


@pytest.mark.parametrize("method", FILTERS)
def test_too_few_points_stay_exactly_in_place(rng: np.random.Generator, method: str) -> None:
    for n in range(7):
        points = rng.random((n, 3)) + 4.5e6
        np.testing.assert_array_equal(FILTERS[method](points), points)
    few = rng.random((15, 3)) + 4.5e6
    moved = FILTERS[method](few)
    assert moved.dtype == np.float64
    assert np.linalg.norm(moved - few, axis=1).max() < np.sqrt(3)


@pytest.mark.parametrize("apply", [jet, bilateral, FIXED["jet"], lambda points: bilateral(points, 0.1, 0.1, 0.1)])
def test_points_on_a_line_or_at_one_place_stay_exactly_in_place(rng: np.random.Generator, apply: Filter) -> None:
    line = np.outer(rng.random(300), [1.0, 2.0, -0.5]) + [5e5, 4.5e6, 10]
    for points in (line, np.repeat(line[:9], 40, axis=0), np.repeat(line[:1], 300, axis=0)):
        np.testing.assert_array_equal(apply(points), points)


@pytest.mark.parametrize("method", FILTERS)
def test_points_in_a_plane_stay_in_it(rng: np.random.Generator, method: str) -> None:
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0), [7.0]), axis=-1).reshape(-1, 3)
    for points in (grid, np.repeat(grid, 3, axis=0), grid * [1, 40, 1]):  # a raster, tripled, and two scan lines far apart
        assert np.abs(FILTERS[method](points)[:, 2] - 7).max() < 1e-6


def test_the_size_of_the_blocks_and_the_number_of_threads_do_not_matter(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = on_sphere(rng, 1000) + 0.01 * rng.normal(size=(1000, 3))
    whole = jet(points, 24, threads=1)
    monkeypatch.setattr(classical, "_BLOCK_PAIRS", 24 * 33)
    np.testing.assert_allclose(jet(points, 24, threads=2), whole, atol=1e-13)


def test_filtering_leaves_its_input_alone(rng: np.random.Generator) -> None:
    points = on_sphere(rng, 500)
    before = points.copy()
    for apply in FILTERS.values():
        apply(points)
    np.testing.assert_array_equal(points, before)


def test_tuning_finds_large_neighbourhoods_on_a_plane_and_small_ones_on_clean_detail(rng: np.random.Generator) -> None:
    plane = on_square(rng, 1500) + 0.01 * rng.normal(size=(1500, 3))
    ripples = on_square(rng, 1500)
    ripples[:, 2] = 0.05 * np.sin(40 * ripples[:, 0])
    wide = tune([(plane, lambda points: np.abs(points[:, 2]))], "jet")
    fine = tune([(ripples, lambda points: np.abs(points[:, 2] - 0.05 * np.sin(40 * points[:, 0])))], "jet")
    assert wide["k"] >= 128
    assert fine.get("k", 27) <= 27  # 27 is the automatic size without noise


@pytest.mark.parametrize("method", FILTERS)
def test_tuned_parameters_fit_the_filter_and_are_no_worse_than_the_automatic_ones(rng: np.random.Generator, method: str) -> None:
    clean = on_sphere(rng, 500)
    noisy = clean + 0.03 * rng.normal(size=(500, 3))
    tuned = tune([(noisy, clean)], method)

    def error(points: np.ndarray) -> float:
        return float(knn(clean, 1, points)[0].mean() + knn(points, 1, clean)[0].mean())

    assert error(FILTERS[method](noisy, **tuned)) <= error(FILTERS[method](noisy))


def test_wrong_arguments_are_named() -> None:
    cloud = np.zeros((10, 3))
    for call, name in (
        (lambda: mean(cloud, 0), "k"),
        (lambda: jet(cloud, -1), "k"),
        (lambda: jet(cloud, 8, degree=3), "degree"),
        (lambda: bilateral(cloud, -1.0, 1.0, 1.0), "radius"),
        (lambda: bilateral(cloud, 1.0, 1.0, 0.0), "sigma_n"),
        (lambda: bilateral(cloud, 1.0, 1.0, 1.0, iterations=0), "iterations"),
        (lambda: tune([], "mean"), "pairs"),
        (lambda: tune([(cloud, cloud)], "network"), "method"),
    ):
        with pytest.raises(UsageError, match=f"^{name}: .+"):
            call()
