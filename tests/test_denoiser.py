"""A cloud in, a cleaner cloud out, row by row: nearer to the truth, and independent of everything that should not matter."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from known_clouds import UTM, Cloud, cloud, model, moves, rotation, varied
from pcdenoise import io
from pcdenoise.cloud import neighbours
from pcdenoise.cloud.neighbours import coordinate_hash, knn
from pcdenoise.cloud.noise_level import NoiseLevel, estimate
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import denoiser, network_pass, pyramid, relaxation, risk
from pcdenoise.denoising.denoiser import Result, denoise, iterate, level_of
from pcdenoise.denoising.risk import Risk
from pcdenoise.denoising.seeds import share_of_seeds
from pcdenoise.errors import ModelError, UsageError
from pcdenoise.networks import fused, store
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork
from pcdenoise.networks.store import Model
from pcdenoise.synthesis.noise import Noise, along_rays, beam_bias, heavy_tailed

PLAIN = DenoiseConfig(threads=1)


def clean(points: np.ndarray, kind: str = "seeded", **options: object) -> Result:
    return denoise(points, model(kind), DenoiseConfig.model_validate({"threads": 1, **options}))


@pytest.fixture(scope="module")
def shipped() -> Model:
    return store.load()


@pytest.fixture(scope="module")
def fine() -> Cloud:
    """So little noise that every point is its own seed and nothing is drawn by lot."""
    noisy = cloud("torus", 900, 0.3)
    assert share_of_seeds(estimate(noisy.noisy, threads=1), 24) == 1
    return noisy


@pytest.fixture(scope="module")
def coarse() -> Cloud:
    """So much noise that seeds are drawn, by a hash of the coordinates."""
    noisy = cloud("sphere", 3000, 1.5)
    assert share_of_seeds(estimate(noisy.noisy, threads=1), 24) < 0.3
    return noisy


@pytest.fixture(scope="module")
def fine_result(fine: Cloud) -> Result:
    return clean(fine.noisy)


@pytest.fixture(scope="module")
def coarse_result(coarse: Cloud) -> Result:
    return clean(coarse.noisy)


# Nearer to the truth


@pytest.mark.parametrize("seed", range(3))
def test_errors_that_neighbours_share_are_removed_where_the_noise_is_told(shipped: Model, seed: int) -> None:
    # A beam's points are off together: among few neighbours little of it shows, so that little is taken for noise.
    rng = np.random.default_rng(seed)
    surface = cloud("sphere", 20_000, 0.0, seed)
    std = 0.02
    scan = Cloud(surface.surface, surface.clean, beam_bias(surface.clean, std, rng), surface.spacing)
    guessed, told = (denoise(scan.noisy, shipped, PLAIN.model_copy(update={"noise": noise})) for noise in (None, std))
    assert guessed.figures["noise"] < 0.5 * std == 0.5 * told.figures["noise"]
    assert scan.error(told.points) < 0.8 * scan.error(guessed.points)


@pytest.mark.parametrize("seed", range(3))
def test_noise_that_grows_along_a_scan_is_removed_better_than_by_one_number(
    shipped: Model, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = cloud("cylinder", 12_000, 0.6, seed)
    noisy, _ = varied(sample, 0.5, 4.0)
    by_place = denoise(noisy, shipped, PLAIN).points
    monkeypatch.setattr(network_pass, "by_place", lambda points, _identity, level, _threads: np.full(len(points), level.std))
    assert sample.error(by_place) < 0.98 * sample.error(denoise(noisy, shipped, PLAIN).points)


@pytest.mark.parametrize("law", [heavy_tailed, along_rays])
def test_noise_that_neighbours_show_too_little_of_is_read_by_what_is_taken_off(
    shipped: Model, law: Noise, monkeypatch: pytest.MonkeyPatch
) -> None:
    surface = cloud("torus", 12_000, 0.0)
    std = 1.2 * surface.spacing
    noisy = law(surface.clean, std, np.random.default_rng(2))
    once_more = denoise(noisy, shipped, PLAIN)
    monkeypatch.setattr(denoiser.taken_off, "level_by", lambda read, *_given: read)
    as_read = denoise(noisy, shipped, PLAIN)
    true = surface.error(noisy)
    assert as_read.figures["noise"] < 0.85 * true
    assert 1.1 * as_read.figures["noise"] < once_more.figures["noise"] < 1.1 * true
    assert surface.error(once_more.points) < 0.95 * surface.error(as_read.points)


@pytest.mark.parametrize("name", ["plane", "sphere", "torus", "cube"])
def test_gaussian_noise_is_read_once(shipped: Model, name: str) -> None:
    """Neighbours show it: what is taken off is within the reading's own scatter and what edges add."""
    sample = cloud(name, 12_000, 1.2)
    assert level_of(sample.noisy, shipped, PLAIN).std == pytest.approx(estimate(sample.noisy, threads=1).std, rel=0.03)


def test_noise_that_is_told_stays_as_it_is_told(shipped: Model) -> None:
    noisy = heavy_tailed(cloud("torus", 4000, 0.0).clean, 0.08, np.random.default_rng(2))
    assert level_of(noisy, shipped, PLAIN.model_copy(update={"noise": 0.05})).std == 0.05


def test_telling_the_noise_that_would_have_been_read_is_as_good_where_all_places_have_it(shipped: Model, coarse: Cloud) -> None:
    guessed = denoise(coarse.noisy, shipped, PLAIN)
    told = denoise(coarse.noisy, shipped, PLAIN.model_copy(update={"noise": guessed.figures["noise"]}))
    assert coarse.error(told.points) == pytest.approx(coarse.error(guessed.points), rel=0.1)


@pytest.mark.parametrize("n", [1000, 4000])
@pytest.mark.parametrize("name", ["plane", "sphere", "torus", "cube"])
def test_the_shipped_model_halves_the_error_at_any_noise_and_density(shipped: Model, name: str, n: int) -> None:
    # The kernel's squared weights sum to 0.08, so one step on a plane leaves 0.28 of the noise, and half is a generous bar. Under
    # little noise it is the shape that errs: 24 neighbours reach 2.8 spacings, over a cube's edges and around a sparse tube.
    bent = name == "cube" or (name, n) == ("torus", 1000)
    for std_spacings in (0.1, 0.3, 0.6, 1.0, 1.5 if (name, n) != ("torus", 1000) else 1.1):  # 1.5 fill half of its tube
        noisy = cloud(name, n, std_spacings)
        remains = noisy.error(denoise(noisy.noisy, shipped, PLAIN).points) / noisy.error(noisy.noisy)
        assert remains < (0.75 if bent and std_spacings < 0.5 else 0.5), f"{std_spacings} spacings"


def test_even_an_untrained_network_halves_the_error(coarse: Cloud, fine: Cloud) -> None:
    for noisy in (coarse, fine):
        assert noisy.error(clean(noisy.noisy, "untrained").points) < 0.5 * noisy.error(noisy.noisy)


def test_two_halves_of_a_real_scan_cleaned_apart_agree_better_than_they_did(shipped: Model, milk: Path) -> None:
    # Without truth: the halves share the surface and not the noise, so whatever brings them together has found the surface.
    def gap(one: np.ndarray, other: np.ndarray) -> float:
        near = other[knn(other, 16, one, threads=1)[1]]
        spread = near - near.mean(axis=1, keepdims=True)
        normals = np.linalg.eigh(spread.transpose(0, 2, 1) @ spread)[1][:, :, 0]
        return float(np.median(np.abs(((one - near.mean(axis=1)) * normals).sum(axis=1))))

    points = io.read(milk).points
    halves = points[::2], points[1::2]
    first, second = (denoise(half, shipped, PLAIN).points for half in halves)
    assert gap(first, second) < 0.5 * gap(*halves)


def test_a_real_scan_becomes_smooth_and_keeps_its_extent(shipped: Model, milk: Path) -> None:
    points = io.read(milk).points
    result = denoise(points, shipped, PLAIN)
    noise = estimate(points, threads=1).std
    assert 0.95 < result.figures["noise"] / noise < 1.5  # by what is taken off, which is more than neighbours show
    assert estimate(result.points, threads=1).std < 0.5 * noise
    for side in (np.min, np.max):
        assert np.abs(side(result.points, axis=0) - side(points, axis=0)).max() < 4 * noise
    assert not result.left_alone.all()


# What must not matter


def test_rows_in_another_order_give_the_same_rows_in_that_order(
    fine: Cloud, fine_result: Result, coarse: Cloud, coarse_result: Result, rng: np.random.Generator
) -> None:
    for noisy, result in ((fine.noisy, fine_result), (coarse.noisy, coarse_result)):
        order = rng.permutation(len(noisy))
        np.testing.assert_array_equal(clean(noisy[order]).points, result.points[order])


def test_one_seed_gives_the_same_bytes_and_another_one_other_seeds(coarse: Cloud, coarse_result: Result) -> None:
    assert clean(coarse.noisy, seed=0).points.tobytes() == coarse_result.points.tobytes()
    assert np.abs(clean(coarse.noisy, seed=1).points - coarse_result.points).max() > 0.1 * coarse.spacing


def test_the_number_of_threads_does_not_show(coarse: Cloud, coarse_result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    for descend in (pyramid.descend, fused.descend):
        monkeypatch.setattr(descend, "__kwdefaults__", {**descend.__kwdefaults__, "block_points": 500})
    before = torch.get_num_threads()
    by_two = clean(coarse.noisy, threads=2).points
    np.testing.assert_allclose(by_two, coarse_result.points, atol=1e-5 * coarse.spacing)
    if fused.IS_BUILT:  # compiled code does point by point, torch block by block
        assert by_two.tobytes() == coarse_result.points.tobytes()
    assert torch.get_num_threads() == before


SIMILARITIES = {
    "turned": (1.0, 1.0, np.zeros(3)),
    "mirrored": (-1.0, 1.0, np.zeros(3)),
    "shifted to UTM": (0.0, 1.0, UTM),
    "in millimetres": (0.0, 1e3, np.zeros(3)),
    "in kilometres": (0.0, 1e-3, np.zeros(3)),
    "all at once": (-1.0, 30.0, UTM),
}


@pytest.mark.parametrize("name", SIMILARITIES)
def test_where_nothing_is_drawn_the_result_moves_with_the_cloud(
    fine: Cloud, fine_result: Result, name: str, rng: np.random.Generator
) -> None:
    handed, unit, shift = SIMILARITIES[name]
    turn = handed * rotation(rng) if handed else np.eye(3)
    result = (clean(fine.noisy @ turn.T * unit + shift).points - shift) / unit @ turn
    # float32 messages err by 1e-7 and a float64 step of a northing is 1e-9; nothing amplifies them a hundredfold.
    np.testing.assert_allclose(result, fine_result.points, atol=1e-5 * fine.spacing)


@pytest.mark.parametrize("name", SIMILARITIES)
def test_where_seeds_are_drawn_the_result_is_as_good_wherever_the_cloud_is(
    coarse: Cloud, coarse_result: Result, name: str
) -> None:
    handed, unit, shift = SIMILARITIES[name]
    rng = np.random.default_rng(3)
    turn = handed * rotation(rng) if handed else np.eye(3)
    found = clean(coarse.noisy @ turn.T * unit + shift)
    result = (found.points - shift) / unit @ turn
    # Other coordinates hash to other seeds. The error is that of some 3000 / 100 independent places: it scatters by 13 %.
    assert coarse.error(result) == pytest.approx(coarse.error(coarse_result.points), rel=0.4)
    assert found.figures["noise"] / unit == pytest.approx(coarse_result.figures["noise"], rel=0.1)
    # Either way a point goes to about the same place: within the noise, which is 1.5 spacings.
    assert np.median(moves(coarse_result.points, result)) < 1.5 * coarse.spacing


def test_duplicates_move_together_and_count_once(fine: Cloud, fine_result: Result, rng: np.random.Generator) -> None:
    copies, alone = rng.integers(900, size=300), fine_result.points
    result = clean(np.concatenate([fine.noisy[copies], fine.noisy]))
    np.testing.assert_array_equal(result.points, np.concatenate([alone[copies], alone]))
    assert result.figures["points_coincident"] == 300


def test_rows_that_are_not_finite_stay_and_the_others_do_not_notice(fine: Cloud, fine_result: Result) -> None:
    points = np.insert(fine.noisy, [0, 5, 900], [[np.nan] * 3, [1.0, -np.inf, np.nan], [np.inf, 2.0, 3.0]], axis=0)
    broken = ~np.isfinite(points).all(axis=1)
    result = clean(points)
    assert result.points[broken].tobytes() == points[broken].tobytes()
    np.testing.assert_array_equal(result.points[~broken], fine_result.points)
    assert result.left_alone[broken].all()
    assert result.figures["points_not_finite"] == 3
    (step,) = iterate(points, model("seeded"), PLAIN)
    np.testing.assert_array_equal(step.points, result.points)


def test_a_point_far_away_stays_and_the_others_hardly_notice(fine: Cloud, fine_result: Result) -> None:
    points = np.concatenate([fine.noisy, [[1e9, 0, 0]]])
    result = clean(points).points
    assert result[-1].tolist() == pytest.approx([1e9, 0, 0], abs=10 * fine.spacing)
    np.testing.assert_allclose(result[:-1], fine_result.points, atol=0.01 * fine.spacing)


def test_the_input_is_not_written_to(fine: Cloud) -> None:
    before = fine.noisy.copy()
    clean(fine.noisy)
    np.testing.assert_array_equal(fine.noisy, before)


# Few points and clouds without a surface


@pytest.mark.parametrize("n", [0, 1, 2, 3, 15])
def test_fewer_than_sixteen_points_come_back_bit_by_bit(n: int, rng: np.random.Generator) -> None:
    mixed = 10 ** rng.uniform(-8, 8, (n, 3))  # these lose digits when an origin is taken away and given back
    for points in (rng.random((n, 3)) + UTM, np.repeat(mixed, 5, axis=0)):
        result = clean(points)
        assert result.points.tobytes() == points.tobytes()
        assert result.left_alone.all()
        assert result.steps == []


def test_sixteen_points_are_cleaned_or_left_but_stay_points(rng: np.random.Generator) -> None:
    sheet = np.column_stack([rng.random((16, 2)), 1e-3 * rng.standard_normal(16)])
    for points in (sheet, rng.random((16, 3))):
        result = clean(points).points
        assert result.shape == (16, 3)
        assert np.isfinite(result).all()
        assert moves(points, result).max() < 0.5


@pytest.mark.parametrize("shift", [np.zeros(3), UTM])
@pytest.mark.parametrize("direction", [[1.0, 2.0, -0.5], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
def test_points_on_a_line_stay_in_place(rng: np.random.Generator, direction: list[float], shift: np.ndarray) -> None:
    line = np.outer(rng.random(300), direction) + shift
    np.testing.assert_allclose(clean(line).points, line, atol=1e-6)


@pytest.mark.parametrize("shift", [np.zeros(3), UTM])
def test_points_in_a_plane_stay_in_it(rng: np.random.Generator, shift: np.ndarray) -> None:
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [7.0]), axis=-1).reshape(-1, 3)
    for flat in (grid, grid * [1, 40, 1], np.column_stack([rng.random((400, 2)), np.full(400, 0.1)])):
        np.testing.assert_allclose(clean(flat + shift).points, flat + shift, atol=1e-4)
        np.testing.assert_allclose(clean(flat + shift).points[:, 2], (flat + shift)[:, 2], atol=1e-6)


def test_points_at_one_place_stay_there() -> None:
    points = np.full((500, 3), 0.1) + UTM
    result = clean(points)
    assert result.points.tobytes() == points.tobytes()
    assert result.figures["points_coincident"] == 499


@settings(max_examples=40, deadline=None)
@given(
    points=hnp.arrays(
        np.float64,
        st.tuples(st.integers(0, 60), st.just(3)),
        elements=st.one_of(
            st.integers(-3, 3).map(float),
            st.integers(-(10**10), 10**10).map(lambda thousandths: thousandths / 1000),  # no extent that is refused
            st.sampled_from([np.nan, np.inf, -np.inf]),
        ),
        fill=st.nothing(),
    )
)
def test_any_small_cloud_comes_back_with_its_rows_and_finite_where_it_was(points: np.ndarray) -> None:
    result = clean(points)
    finite = np.isfinite(points).all(axis=1)
    assert result.points.shape == points.shape
    assert np.isfinite(result.points[finite]).all()
    assert result.points[~finite].tobytes() == points[~finite].tobytes()
    assert len(result.outlier) == len(result.left_alone) == len(points)


# Settings


def test_draws_are_averaged_over_seeds_of_their_own_and_what_is_left_is_less(coarse: Cloud) -> None:
    """The mean of as many runs under one level; where every point is its own seed nothing is drawn."""
    level = level_of(coarse.noisy, model("seeded"), PLAIN)

    def moved(cloud: Cloud, level: NoiseLevel, **settings: int) -> np.ndarray:
        return denoise(cloud.noisy, model("seeded"), PLAIN.model_copy(update={"relax_steps": 0, **settings}), level=level).points

    assert share_of_seeds(level, 32) < 1
    single = [moved(coarse, level, seed=seed) for seed in (0, denoiser._DRAWS_APART)]
    together = moved(coarse, level, draws=2)
    np.testing.assert_allclose(together, np.mean(single, axis=0), atol=1e-12)
    assert coarse.error(together) < min(coarse.error(points) for points in single)
    fine = cloud("sphere", 2000, 0.2)
    level = level_of(fine.noisy, model("seeded"), PLAIN)
    np.testing.assert_array_equal(moved(fine, level, draws=3), moved(fine, level))


def test_no_strength_is_no_move_and_half_of_it_half_the_way(coarse: Cloud, coarse_result: Result) -> None:
    half, none = (clean(coarse.noisy, strength=strength) for strength in (0.5, 0.0))
    assert none.points.tobytes() == coarse.noisy.tobytes()
    assert none.left_alone.all()
    np.testing.assert_allclose(half.points, (coarse.noisy + coarse_result.points) / 2, atol=1e-12)


def test_no_point_moves_further_than_allowed_and_shorter_moves_are_not_cut(fine: Cloud, fine_result: Result) -> None:
    full = fine_result.points
    bound = float(np.median(moves(fine.noisy, full)))
    cut, thrice = (clean(fine.noisy, max_move=bound, iters=iters).points for iters in (1, 3))
    for limited in (cut, thrice):
        assert moves(fine.noisy, limited).max() <= bound * (1 + 1e-9)
    short = moves(fine.noisy, full) < bound
    np.testing.assert_allclose(cut[short], full[short], atol=1e-12)


def test_every_pass_is_a_step_and_the_last_one_is_the_result(fine: Cloud, fine_result: Result) -> None:
    config = PLAIN.model_copy(update={"iters": 3})
    steps = list(iterate(fine.noisy, model("seeded"), config))
    assert [step.figures["iteration"] for step in steps] == [1, 2, 3]
    np.testing.assert_array_equal(steps[0].points, fine_result.points)
    np.testing.assert_array_equal(steps[-1].points, clean(fine.noisy, iters=3).points)
    for before, after in pairwise(steps):
        assert after.figures["roughness_before"] == before.figures["roughness_after"]
        assert np.abs(after.points - before.points).max() > 0
    assert steps[0].figures["move_max"] == pytest.approx(moves(fine.noisy, steps[0].points).max(), rel=1e-9)


@pytest.mark.parametrize("options", [{"iters": 2}, {"iters": 2, "strength": 0.5}, {"max_move": 1e-3}])
def test_the_last_step_of_a_result_is_the_result_whatever_limits_it(fine: Cloud, options: dict[str, object]) -> None:
    result = clean(fine.noisy, **options)
    np.testing.assert_array_equal(result.steps[-1].points, result.points)
    *_, last = iterate(fine.noisy, model("seeded"), DenoiseConfig.model_validate({"threads": 1, **options}))
    np.testing.assert_array_equal(last.points, result.points)


@pytest.mark.parametrize(("name", "std_spacings"), [("sphere", 0.3), ("cube", 0.7), ("torus", 1.2)])
def test_auto_stops_by_itself_and_is_no_worse_than_one_pass(shipped: Model, name: str, std_spacings: float) -> None:
    noisy = cloud(name, 1500, std_spacings)
    auto = denoise(noisy.noisy, shipped, PLAIN.model_copy(update={"iters": "auto"}))
    once = denoise(noisy.noisy, shipped, PLAIN)
    assert auto.figures["iterations"] >= 1
    assert noisy.error(auto.points) <= 1.05 * noisy.error(once.points)


@pytest.mark.parametrize(("method", "noise"), [("network", 0.0), ("mean", 0.0), ("mean", 0.1)])
def test_auto_makes_no_pass_that_would_do_harm(shipped: Model, method: str, noise: float) -> None:
    noisy = cloud("torus" if noise else "plane", 1500, noise)
    config = PLAIN.model_copy(update={"method": method, "iters": "auto", "neighbours": 60 if noise else None})
    auto = denoise(noisy.noisy, shipped if method == "network" else None, config)
    once = denoise(noisy.noisy, shipped if method == "network" else None, config.model_copy(update={"iters": 1}))
    assert auto.figures["iterations"] == 0 or not noise
    assert noisy.error(auto.points) <= noisy.error(once.points)
    np.testing.assert_allclose(auto.points, noisy.noisy, rtol=0, atol=1e-6 * noisy.spacing)


@pytest.mark.parametrize(
    ("method", "name", "std_spacings"),
    [
        ("network", "torus", 1.2),
        ("jet", "sphere", 0.5),
        ("bilateral", "torus", 0.5),
        ("bilateral", "sphere", 0.7),
        ("mean", "torus", 0.5),
        ("mean", "sphere", 1.2),
    ],
)
def test_auto_comes_within_five_percent_of_whoever_sees_the_truth(
    shipped: Model, method: str, name: str, std_spacings: float
) -> None:
    noisy = cloud(name, 2500, std_spacings)
    used = shipped if method == "network" else None
    config = PLAIN.model_copy(update={"method": method, "iters": 10})
    oracle = min(two_way(noisy, step.points) for step in denoise(noisy.noisy, used, config).steps)
    auto = denoise(noisy.noisy, used, config.model_copy(update={"iters": "auto"}))
    assert two_way(noisy, auto.points) <= 1.05 * oracle
    for step in auto.steps:
        assert step.figures["estimated_error_after"] < step.figures["estimated_error_before"]


def two_way(noisy: Cloud, points: np.ndarray) -> float:
    """Mean distance from points to the surface plus that from samples of it to points: what a stop is judged by."""
    there = np.abs(noisy.surface.signed_distance(points)).mean()
    return float(there + knn(points, 1, noisy.clean, threads=1)[0].mean())


@pytest.mark.parametrize("left", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("bias", [0.0, 0.006])
def test_the_estimated_error_is_that_against_the_truth(rng: np.random.Generator, left: float, bias: float) -> None:
    noise = 0.01
    points = np.column_stack([rng.random((20_000, 2)), noise * rng.standard_normal(20_000)])
    level = replace(estimate(points, threads=1), std=0.87 * noise)
    before, after = Risk(points, coordinate_hash(points, 0), level, 0, 1).after(lambda cloud: cloud * [1, 1, left] + [0, 0, bias])
    places = rng.uniform(0.05, 0.95, (20_000, 3)) * [1, 1, 0]
    for found, height in ((before, noise), (after, max(np.hypot(left * noise, bias), 0.1 * noise))):  # less is not told from none
        distance = (2 / np.pi) ** 0.5 * height
        gap = knn(points * [1, 1, 0], 1, places, threads=1)[0][:, 0]
        assert found == pytest.approx(distance + np.hypot(gap, distance).mean(), abs=0.05 * noise)


def test_no_order_of_rows_and_no_motion_changes_where_auto_stops(rng: np.random.Generator) -> None:
    noisy = cloud("torus", 1200, 0.7)
    config = PLAIN.model_copy(update={"method": "jet", "iters": "auto"})
    there = denoise(noisy.noisy, None, config)
    order = rng.permutation(1200)
    again = denoise(noisy.noisy[order], None, config)
    np.testing.assert_allclose(again.points, there.points[order], rtol=0, atol=1e-9)
    moved = denoise(1000 * noisy.noisy, None, config)  # draws follow coordinates, so other ones are made
    assert abs(moved.figures["iterations"] - there.figures["iterations"]) <= 1


def test_a_judged_pass_is_the_pass(fine: Cloud) -> None:
    """Where the whole cloud is judged its pass is made once, and is the one that is made unjudged."""
    judged = next(iterate(fine.noisy, model("seeded"), PLAIN)).points
    np.testing.assert_array_equal(judged, clean(fine.noisy).points)


def test_of_a_large_cloud_some_points_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = cloud("sphere", 4000, 0.7)
    config = PLAIN.model_copy(update={"method": "jet", "iters": "auto"})
    whole = denoise(noisy.noisy, None, config)
    monkeypatch.setattr(risk, "MOST_POINTS", 2000)
    part = denoise(noisy.noisy, None, config)
    assert two_way(noisy, part.points) == pytest.approx(two_way(noisy, whole.points), rel=0.05)


# The paper's network


def test_mcconv_runs_by_the_same_rules(rng: np.random.Generator) -> None:
    noisy = cloud("sphere", 1500, 1.0).noisy
    result, again = (clean(noisy, "mcconv") for _ in range(2))
    np.testing.assert_array_equal(again.points, result.points)
    assert 0 < result.figures["move_max"] <= 5 * result.figures["noise"] + result.figures["noise"]
    order = rng.permutation(len(noisy))
    np.testing.assert_array_equal(clean(noisy[order], "mcconv").points, result.points[order])
    larger = clean(noisy * 1e3 + UTM, "mcconv").points
    assert np.median(moves(result.points, (larger - UTM) / 1e3)) < 0.1 * result.figures["move_median"]
    broken = np.concatenate([noisy, [[np.nan, 0, 0]], noisy[:1]])
    np.testing.assert_array_equal(clean(broken, "mcconv").points[-1], result.points[0])


def test_a_unit_of_length_goes_with_the_model_not_with_the_cloud() -> None:
    noisy = cloud("sphere", 1500, 1.0).noisy
    known = model("mcconv")
    settings = known.config.settings.model_copy(update={"unit": float(np.linalg.norm(np.ptp(noisy, axis=0)))})
    in_metres = replace(known, config=known.config.model_copy(update={"settings": settings}))
    np.testing.assert_allclose(denoise(noisy, in_metres, PLAIN).points, clean(noisy, "mcconv").points, atol=1e-9)
    # A second cloud far away makes the diagonal longer and leaves the unit as it is.
    two = np.concatenate([noisy, noisy + [100.0, 0, 0]])
    moved = denoise(two, in_metres, PLAIN).points - two
    lone = denoise(noisy, in_metres, PLAIN).points - noisy
    assert np.corrcoef(moved[:1500].ravel(), lone.ravel())[0, 1] > 0.8


def test_decoding_in_blocks_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = cloud("torus", 1500, 0.5).noisy
    whole = clean(noisy, "mcconv").points
    monkeypatch.setattr(network_pass, "_DECODED_AT_ONCE", 400)
    np.testing.assert_allclose(clean(noisy, "mcconv").points, whole, atol=1e-5)


def test_progress_grows_to_one_in_every_pass(coarse: Cloud) -> None:
    seen: dict[str, list[float]] = {}
    config = PLAIN.model_copy(update={"iters": 2})
    denoise(coarse.noisy, model("untrained"), config, lambda task, share: seen.setdefault(task, []).append(share))
    assert list(seen) == ["pass 1", "pass 2"]
    for shares in seen.values():
        assert (np.diff(shares) > 0).all()
        assert shares[-1] == pytest.approx(1)


def test_figures_say_what_happened(coarse: Cloud, coarse_result: Result) -> None:
    result = coarse_result
    length = moves(coarse.noisy, result.points)
    assert result.figures["move_median"] == pytest.approx(np.median(length), rel=1e-9)
    assert result.figures["move_p99"] == pytest.approx(np.quantile(length, 0.99), rel=1e-9)
    assert result.figures["move_max"] == pytest.approx(length.max(), rel=1e-9)
    assert result.figures["noise"] == pytest.approx(1.5 * coarse.spacing, rel=0.3)
    assert result.figures["points_left_alone"] == result.left_alone.sum() == (length == 0).sum()
    assert result.figures["iterations"] == len(result.steps) == 1


@pytest.mark.parametrize("method", ["mean", "bilateral", "jet"])
def test_classical_filters_run_without_a_model_and_by_the_same_rules(
    coarse: Cloud, method: str, rng: np.random.Generator
) -> None:
    config = PLAIN.model_copy(update={"method": method})
    order = rng.permutation(3000)
    points = np.concatenate([coarse.noisy, [[np.nan] * 3]])
    result = denoise(points, None, config).points
    assert coarse.error(result[:-1]) < 0.7 * coarse.error(coarse.noisy)
    assert np.isnan(result[-1]).all()
    np.testing.assert_array_equal(denoise(coarse.noisy[order], None, config).points, result[:-1][order])


def test_flagged_points_are_told_and_keep_their_row(fine: Cloud) -> None:
    points = np.concatenate([[[9.0, 9.0, 9.0], [np.nan, 0, 0]], fine.noisy])
    result = clean(points, outliers="flag")
    assert result.outlier[0]
    assert not result.outlier[1]  # not finite is not an outlier
    assert result.outlier.sum() == result.figures["outliers"] < 0.05 * len(points)
    assert len(result.points) == len(points)
    assert not clean(points).outlier.any()


def test_the_network_needs_a_model_and_a_model_needs_numbers(fine: Cloud) -> None:
    with pytest.raises(UsageError, match=r"^--method network needs a model; [^\n]+$"):
        denoise(fine.noisy, None, PLAIN)
    broken = ProjectionNetwork(ProjectionConfig())
    for stage in range(2):  # found before the next stage looks for neighbours, or at the end
        with torch.no_grad():
            broken.among[0].step.head.bias.fill_(0.0 if stage else float("nan"))
            broken.among[1].step.head.bias.fill_(float("nan"))
        with pytest.raises(ModelError, match=r"^[^\n]*positions that are not numbers; use another model[^\n]*$"):
            denoise(fine.noisy, Model.of(broken, "broken"), PLAIN)


def test_the_noise_that_is_reported_is_the_noise_that_is_cleaned_by(coarse: Cloud) -> None:
    repeated = np.concatenate([coarse.noisy, coarse.noisy[:10], np.full((1, 3), np.nan)])
    reported, used = estimate(repeated[:-1]), level_of(repeated, None, PLAIN)
    assert (used.std, used.spacing) == pytest.approx((reported.std, reported.spacing), rel=1e-9)


def test_without_compiled_code_scipy_torch_and_numpy_clean_alike(
    coarse: Cloud, coarse_result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (neighbours, fused, relaxation):
        monkeypatch.setattr(module, "IS_BUILT", False)
    np.testing.assert_allclose(clean(coarse.noisy).points, coarse_result.points, atol=5e-5 * coarse.spacing)


def test_networks_of_sizes_that_nothing_is_compiled_for_clean_too() -> None:
    noisy = cloud("sphere", 1500, 1.0)
    small = Model.of(ProjectionNetwork(ProjectionConfig(channels=16)), "small")
    assert noisy.error(denoise(noisy.noisy, small, PLAIN).points) < 0.5 * noisy.error(noisy.noisy)


def test_compiled_code_refuses_arrays_that_it_would_misread() -> None:
    for values in (np.zeros((4, 3), np.float32), np.zeros((4, 6))[:, ::2]):
        with pytest.raises(TypeError, match="dense arrays of float64"):
            fused.address(values, np.float64)
