"""Drift: what moves a surface is seen, what only removes noise is not."""

from __future__ import annotations

import numpy as np
import pytest

from known_clouds import UTM, cloud, rotation
from pcdenoise.cloud import drift
from pcdenoise.denoising import classical

FLOOR = 1 / np.sqrt(drift.K_NEIGHBOURS)
"""Drift that removing noise of std 1 shows: the mean of so many independent normal displacements."""


@pytest.mark.parametrize("share", [-0.04, -0.01, 0.01, 0.04])
def test_a_scaled_sphere_drifts_by_its_change_of_radius(share: float) -> None:
    """A neighbourhood of 128 of 8000 points has (r / R)² = 4 * 128 / 8000 = 6 %; the mean of cosines within it is off by half."""
    sphere = cloud("sphere", 8000, 0.0).clean
    found = drift.measure(sphere, sphere * (1 - share))
    assert found.size == pytest.approx(abs(share), rel=0.05)
    assert found.inward == pytest.approx(share, rel=0.05)


@pytest.mark.parametrize("name", ["plane", "sphere", "cube", "torus"])
def test_taking_all_noise_away_is_no_drift(name: str) -> None:
    noisy = cloud(name, 8000, 1.0)
    found = drift.measure(noisy.noisy, noisy.clean)
    assert found.size < 1.3 * FLOOR * noisy.spacing
    assert abs(found.inward) < 0.5 * FLOOR * noisy.spacing


def test_a_filter_that_shrinks_drifts_by_its_error_and_one_that_keeps_curvature_does_not() -> None:
    noisy = cloud("sphere", 8000, 0.5)
    wide = classical.mean(noisy.noisy, 192)
    shrunk = 1 - np.linalg.norm(wide, axis=1).mean()
    found = drift.measure(noisy.noisy, wide)
    assert found.inward == pytest.approx(shrunk, rel=0.15)
    assert found.size > 0.3 * noisy.spacing
    assert drift.measure(noisy.noisy, classical.jet(noisy.noisy, 48)).size < 0.15 * noisy.spacing


def test_an_offset_of_a_plane_is_drift_but_a_slide_along_it_is_not() -> None:
    flat = cloud("plane", 4000, 0.0).clean
    assert drift.measure(flat, flat + [0, 0, 0.01]).size == pytest.approx(0.01, rel=1e-6)
    assert drift.measure(flat, flat + [0.01, 0, 0]).size < 1e-12


def test_drift_depends_on_neither_pose_nor_offset_nor_order_of_rows(rng: np.random.Generator) -> None:
    noisy = cloud("torus", 1500, 0.5)  # fewer points than probes, so that all are looked at
    before, after = noisy.noisy, 0.98 * noisy.clean
    found = drift.measure(before, after)
    turn, order = rotation(rng), rng.permutation(len(before))
    for points in ((before @ turn.T, after @ turn.T), (before + UTM, after + UTM), (before[order], after[order])):
        again = drift.measure(*points)
        assert (again.size, again.inward) == pytest.approx((found.size, found.inward), rel=1e-6)


@pytest.mark.parametrize("n", [0, 1, 7, 8, 20])
def test_few_points_have_little_or_no_drift_but_no_error(n: int, rng: np.random.Generator) -> None:
    points = rng.normal(size=(n, 3))
    found = drift.measure(points, points + 1)
    assert np.isfinite([found.size, found.inward]).all()
    assert (found.size == 0) == (n < 8)
