"""Seeds that stand for all points: as many as asked for, evenly spread, the same in any order of rows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from known_clouds import SURFACES, ball, cloud
from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.denoising.seeds import coarsen, share_of_seeds, times_noisier

N = 6000


def ordered(points: np.ndarray) -> np.ndarray:
    return points[spatial_order(points)]


def contrasted(n: int, rng: np.random.Generator) -> np.ndarray:
    """A square whose right half has ten times the density of its left half."""
    left = rng.random(n) < 1 / 11
    return np.column_stack([rng.random(n) - left, rng.random(n), np.zeros(n)])


CLOUDS = {
    **{name: lambda rng, name=name: cloud(name, N, 0.5, int(rng.integers(99))).noisy for name in SURFACES},
    "contrasted": lambda rng: contrasted(N, rng),
    "ball": lambda rng: ball(N, rng),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("share", [0.5, 0.3, 0.1, 0.04])
def test_seeds_are_as_many_as_asked_for_and_count_every_point_once(rng: np.random.Generator, name: str, share: float) -> None:
    points = ordered(CLOUDS[name](rng))
    seeds = coarsen(points, share, threads=1)
    assert len(seeds.points) == len(seeds.count) == pytest.approx(share * N, rel=0.15)
    assert seeds.count.sum() == N
    assert seeds.count.min() >= 1
    np.testing.assert_allclose(seeds.count @ seeds.points / N, points.mean(axis=0), atol=1e-12)
    np.testing.assert_array_equal(np.bincount(seeds.cell), seeds.count)
    own = points[seeds.cell == 7]
    np.testing.assert_allclose(own.mean(axis=0), seeds.points[7], atol=1e-12)


def test_seeds_lie_among_the_points_whose_mean_they_are(rng: np.random.Generator) -> None:
    points = ordered(cloud("sphere", N, 0.3).noisy)
    seeds = coarsen(points, 0.1, threads=1)
    # A cell of a tenth of the points has the area of ten: a mean of points further away than its diagonal would be wrong.
    assert cKDTree(points).query(seeds.points)[0].max() < np.sqrt(2 * 10) * cloud("sphere", N, 0.3).spacing
    plane = ordered(cloud("plane", N, 0.0).clean)
    np.testing.assert_allclose(coarsen(plane, 0.1, threads=1).points[:, 2], 0, atol=1e-15)


def test_seeds_follow_the_local_density(rng: np.random.Generator) -> None:
    points = ordered(contrasted(N, rng))
    seeds = coarsen(points, 0.1, threads=1)
    # About 55 seeds stand for the thin half: their number scatters by a few, as evenly spread as they are.
    thin, dense = (np.mean(side(seeds.points[:, 0])) / np.mean(side(points[:, 0])) for side in (np.signbit, lambda x: x > 0))
    assert thin == pytest.approx(1, abs=0.3)
    assert dense == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("share", [0.4, 0.1])
def test_seeds_are_spread_more_evenly_than_chance(share: float) -> None:
    points = ordered(cloud("plane", N, 0.0).clean)
    seeds = coarsen(points, share, threads=1).points
    nearest = cKDTree(seeds).query(seeds, k=2)[0][:, 1]
    # Poisson points have a nearest distance of standard deviation √(4/π - 1) = 0.52 of its mean.
    assert nearest.std() / nearest.mean() < 0.4


@pytest.mark.parametrize("share", [0.5, 0.1])
def test_seeds_do_not_depend_on_the_order_of_rows_and_threads(rng: np.random.Generator, share: float) -> None:
    points = ordered(cloud("torus", N, 0.5).noisy)
    one, other = coarsen(points, share, 7, threads=1), coarsen(rng.permutation(points), share, 7, threads=2)
    first, second = np.lexsort(one.points.round(9).T), np.lexsort(other.points.round(9).T)
    np.testing.assert_allclose(other.points[second], one.points[first], atol=1e-12)
    np.testing.assert_array_equal(other.count[second], one.count[first])


def test_another_seed_draws_other_seeds() -> None:
    points = ordered(cloud("torus", N, 0.5).noisy)
    one, other = (set(map(tuple, coarsen(points, 0.1, seed, 1).points)) for seed in (1, 2))
    assert len(one & other) < 0.05 * len(one)  # points off the rest may be alone in their cell twice


@pytest.mark.parametrize("n", [1, 2, 5, 17])
def test_too_few_points_are_their_own_seeds(rng: np.random.Generator, n: int) -> None:
    points = rng.standard_normal((n, 3))
    seeds = coarsen(points, 1e-6, threads=1)
    np.testing.assert_array_equal(seeds.points, points)
    np.testing.assert_array_equal(seeds.count, 1)


def test_the_share_of_seeds_falls_with_the_scale_of_the_noise_and_is_one_for_little_noise() -> None:
    shares = [share_of_seeds(NoiseLevel(1.0, 1.0, points, True), 24) for points in np.geomspace(1, 2000, 200)]
    assert shares[0] == 1
    assert (np.diff(shares) <= 0).all()
    assert max(share for share in shares if share < 1) <= 0.52  # no sparser set of candidates leaves more
    # Twenty-four seeds then stand for 11 √(points that show the surface) raw points.
    assert shares[-1] == pytest.approx(24 / (11 * np.sqrt(2000)))


def test_seeds_are_fewer_where_it_is_noisier_and_more_where_it_is_quieter(rng: np.random.Generator) -> None:
    square = ordered(np.column_stack([rng.random((20_000, 2)), np.zeros(20_000)]))
    left = square[:, 0] < 0.5
    even = coarsen(square, 0.1, threads=1).points[:, 0]
    for times, right, quiet in ((2.0, 0.5, 1.0), (0.5, 1.5, 1.0)):  # half the noise has half more seeds, not twice as many
        seeds = coarsen(square, 0.1, threads=1, noisier=np.where(left, 1.0, times)).points[:, 0]
        # Candidates by the thousand are drawn, and seeds thin them out: 5 % of scatter, and another layout's share of remainders.
        assert np.sum(seeds >= 0.5) / np.sum(even >= 0.5) == pytest.approx(right, rel=0.15)
        assert np.sum(seeds < 0.5) / np.sum(even < 0.5) == pytest.approx(quiet, rel=0.15)


def test_no_place_is_seen_as_a_large_share_of_a_small_cloud() -> None:
    noise = np.array([0.5, 1.0, 3.0])
    large = NoiseLevel(1.0, 1.0, 100.0, True, n_points=10**6)
    np.testing.assert_array_equal(times_noisier(noise, large, 32), noise)
    small = NoiseLevel(1.0, 1.0, 100.0, True, n_points=1000)  # 110 points are looked at, an eighth are 125
    np.testing.assert_allclose(times_noisier(noise, small, 32), [0.5, 1.0, 125 / 110])
    tiny = NoiseLevel(1.0, 1.0, 100.0, True, n_points=300)
    np.testing.assert_array_equal(times_noisier(noise, tiny, 32), [0.5, 1.0, 1.0])


def test_means_are_over_the_points_of_each_cell(rng: np.random.Generator) -> None:
    points = ordered(cloud("torus", 3000, 0.5).noisy)
    seeds = coarsen(points, 0.1, threads=1)
    np.testing.assert_allclose(np.stack([seeds.means(axis) for axis in points.T], axis=1), seeds.points, atol=1e-12)
