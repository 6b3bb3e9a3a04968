"""How far points may still be off: what is said without truth agrees with the truth, in any unit and for any share of the way."""

from __future__ import annotations

import numpy as np
import pytest

from known_clouds import UTM, ball, cloud, model, varied
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import uncertainty
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.networks import store

ASKED = DenoiseConfig(threads=1, uncertainty=True)


@pytest.mark.parametrize("name", ["plane", "torus", "cube"])
@pytest.mark.parametrize("std_spacings", [0.5, 1.5])
def test_two_thirds_of_the_distances_are_within_one_standard_deviation_most_within_two(name: str, std_spacings: float) -> None:
    """The normal law says 0.683 and 0.954. Clouds of benchmarks/uncertainty miss that by 0.053 and 0.040 (root mean square over
    36); three times that is allowed."""
    noisy = cloud(name, 4000, std_spacings, seed=3)
    result = denoise(noisy.noisy, store.load(), ASKED)
    assert result.std is not None
    distance = np.abs(noisy.surface.signed_distance(result.points))
    assert (distance < result.std).mean() == pytest.approx(0.683, abs=3 * 0.053)
    assert (distance < 2 * result.std).mean() == pytest.approx(0.954, abs=3 * 0.040)


def test_a_cloud_in_another_unit_and_place_is_uncertain_in_that_unit() -> None:
    noisy = cloud("torus", 800, 0.3).noisy  # few enough that nothing is drawn by coordinates
    there = (noisy * 1000 + UTM) - UTM
    here, far = (denoise(points, model("untrained"), ASKED).std for points in (there / 1000, there))
    np.testing.assert_allclose(far, 1000 * here, rtol=1e-3)


def test_who_goes_half_the_way_keeps_half_the_noise_and_who_stays_all_of_it() -> None:
    noisy = cloud("torus", 2000, 0.5).noisy
    results = {s: denoise(noisy, model("untrained"), ASKED.model_copy(update={"strength": s})) for s in (0.0, 0.5, 1.0)}
    noise = results[1.0].figures["noise"]
    none, half, full = (results[s].std for s in (0.0, 0.5, 1.0))
    gone = ~results[1.0].left_alone
    assert np.median(none) == pytest.approx(noise, rel=1e-9)  # places differ a little from the cloud
    np.testing.assert_allclose(half[gone], np.hypot(0.5 * full[gone], 0.5 * none[gone]), rtol=1e-6)


def test_where_there_was_more_noise_more_uncertainty_is_left() -> None:
    sample = cloud("cylinder", 8000, 0.6)
    noisy, times = varied(sample, 0.6, 2.0)
    result = denoise(noisy, store.load(), ASKED)
    distance = np.abs(sample.surface.signed_distance(result.points))
    quiet, loud = times < 0.9, times > 1.4
    assert result.std[loud].mean() > 1.35 * result.std[quiet].mean()
    for place in (quiet, loud):  # three times 0.053, as above, and two more for what places are not told apart by (0.43 to 0.77)
        assert (distance[place] < result.std[place]).mean() == pytest.approx(0.683, abs=5 * 0.053)


def test_where_there_is_no_surface_nothing_is_claimed(rng: np.random.Generator) -> None:
    result = denoise(ball(2000, rng), model("untrained"), ASKED)
    assert result.std is not None
    assert np.isnan(result.std).all()
    points = cloud("torus", 2000, 0.5).noisy
    points[7] = np.nan
    assert np.flatnonzero(np.isnan(denoise(points, model("untrained"), ASKED).std)).tolist() == [7]


def test_the_thickness_of_a_noisy_plane_is_its_noise(rng: np.random.Generator) -> None:
    """Of 24 normal heights three degrees of freedom go to the plane; the mean of 2000 such standard deviations is 1 % low."""
    points = np.column_stack([rng.random((2000, 2)), rng.normal(0, 1e-3, 2000)])
    assert uncertainty.thickness(points, points, 1).mean() == pytest.approx(1e-3, rel=0.03)


def test_nothing_is_computed_that_is_not_asked_for() -> None:
    assert denoise(cloud("torus", 500, 0.5).noisy, model("untrained"), DenoiseConfig(threads=1)).std is None
