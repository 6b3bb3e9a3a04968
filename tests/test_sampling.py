"""Poisson-disk subsets: never closer than the radius, nothing left uncovered, exactly n when asked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pcdenoise.cloud import sampling
from pcdenoise.cloud.sampling import poisson_disk, poisson_disk_exactly
from pcdenoise.errors import UsageError
from pcdenoise.synthesis.shapes import sphere


def smallest_spacing(points: np.ndarray) -> float:
    return float(cKDTree(points).query(points, k=2)[0][:, 1].min())


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    return sphere(1.0).sample(20_000, np.random.default_rng(0)).points


@pytest.mark.parametrize("radius", [0.02, 0.1, 0.7])
def test_samples_keep_their_distance_and_cover_every_point(cloud: np.ndarray, radius: float) -> None:
    kept = poisson_disk(cloud, radius, np.random.default_rng(1))
    assert len(np.unique(kept)) == len(kept)
    assert smallest_spacing(cloud[kept]) > radius
    assert cKDTree(cloud[kept]).query(cloud)[0].max() <= radius * (1 + 1e-12)


def test_batches_give_the_same_samples_as_all_pairs_at_once(cloud: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are the visit in the order of one random permutation; few pairs at a time only save memory."""
    at_once = poisson_disk(cloud, 0.1, np.random.default_rng(2))
    monkeypatch.setattr(sampling, "MAX_PAIRS", 20_000)
    assert set(poisson_disk(cloud, 0.1, np.random.default_rng(2))) == set(at_once)


def test_samples_are_what_a_visit_one_by_one_would_keep(cloud: np.ndarray) -> None:
    points = cloud[:600]
    order = np.random.default_rng(3).permutation(600)
    kept: list[int] = []
    for row in order:
        if all(np.linalg.norm(points[row] - points[other]) > 0.2 for other in kept):
            kept.append(int(row))
    assert set(poisson_disk(points, 0.2, np.random.default_rng(3)).tolist()) == set(kept)


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 400), seed=st.integers(0, 1000), copies=st.integers(1, 3))
def test_exactly_n_distinct_rows_come_back_whatever_n_and_however_many_duplicates(n: int, seed: int, copies: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.repeat(rng.standard_normal((400 // copies + 1, 3)), copies, axis=0)
    kept = poisson_disk_exactly(points, min(n, len(points)), rng)
    assert len(kept) == len(np.unique(kept)) == min(n, len(points))
    assert 0 <= kept.min() <= kept.max() < len(points)


@pytest.mark.parametrize("n", [100, 1000, 5000])
def test_exactly_n_samples_are_spread_like_a_poisson_disk(cloud: np.ndarray, n: int) -> None:
    """On area 4π the densest packing has spacing sqrt(8π / (√3 n)); greedy disks reach 0.6 of it, random points 0.01."""
    densest = np.sqrt(8 * np.pi / (np.sqrt(3) * n))
    points = cloud[poisson_disk_exactly(cloud, n, np.random.default_rng(4))]
    assert smallest_spacing(points) > 0.58 * densest
    assert cKDTree(points).query(cloud)[0].max() < 1.1 * densest


def test_one_seed_gives_one_subset(cloud: np.ndarray) -> None:
    first, again = (poisson_disk_exactly(cloud, 700, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first, again)


def test_all_points_are_drawn_when_all_are_asked_for(cloud: np.ndarray) -> None:
    assert set(poisson_disk_exactly(cloud[:50], 50, np.random.default_rng(6))) == set(range(50))


def test_more_samples_than_points_is_a_usage_error(cloud: np.ndarray) -> None:
    with pytest.raises(UsageError, match="51 samples from 50"):
        poisson_disk_exactly(cloud[:50], 51, np.random.default_rng(7))


def test_no_points_give_no_samples() -> None:
    assert len(poisson_disk(np.zeros((0, 3)), 1.0, np.random.default_rng(8))) == 0
