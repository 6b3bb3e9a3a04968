"""Neighbours against brute force, spatial order as a curve without jumps, hashes that know coordinates only."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from pcdenoise.cloud import neighbours
from pcdenoise.cloud.neighbours import (
    NeighbourSearch,
    coordinate_hash,
    distinct,
    drawn_by,
    knn,
    pairs_within,
    radius_pairs,
    spatial_order,
    thinned,
)

# A coarse grid makes duplicates and equal distances common; sums of squares of such numbers are exact in float64.
on_grid = hnp.arrays(np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.integers(-4, 4).map(float))
anywhere = hnp.arrays(np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-1e12, 1e12))


def all_distances(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(queries[:, None] - points[None]).sum(axis=2))


@settings(max_examples=60, deadline=None)
@given(points=on_grid, k=st.integers(1, 60))
def test_neighbours_of_the_points_themselves_are_the_nearest_of_all(points: np.ndarray, k: int) -> None:
    distances, indices = knn(points, k, threads=1)
    every = all_distances(points, points)
    assert distances.shape == indices.shape == (len(points), min(k, len(points)))
    np.testing.assert_array_equal(distances, np.sort(every, axis=1)[:, :k])
    np.testing.assert_array_equal(distances, np.take_along_axis(every, indices, axis=1))
    assert all(len(set(row)) == len(row) for row in indices.tolist())
    np.testing.assert_array_equal(points[indices[:, 0]], points)


@settings(max_examples=60, deadline=None)
@given(points=on_grid, queries=on_grid, k=st.integers(1, 60))
def test_neighbours_of_other_places_are_the_nearest_of_all(points: np.ndarray, queries: np.ndarray, k: int) -> None:
    distances, indices = knn(points, k, queries, threads=1)
    every = all_distances(queries, points)
    np.testing.assert_array_equal(distances, np.sort(every, axis=1)[:, :k])
    np.testing.assert_array_equal(distances, np.take_along_axis(every, indices, axis=1))


CLOUDS = {
    "a volume": lambda rng: rng.standard_normal((700, 3)),
    "a sheet far away": lambda rng: rng.random((700, 3)) * [1, 1, 1e-3] + [5e5, 5e6, 100],
    "a line": lambda rng: rng.random((700, 1)) * [1.0, 2.0, 3.0],
    "a grid": lambda rng: rng.permutation(np.argwhere(np.ones((9, 9, 9))).astype(float))[:700],
    "a grid whose steps are rounded": lambda rng: rng.permutation(np.argwhere(np.ones((9, 9, 9))) * 0.1)[:700],
    "a sheet and a speck": lambda rng: np.concatenate([rng.random((400, 3)) * 1e-161, rng.random((300, 3)) * [1, 1, 1e-3]]),
    "one place": lambda rng: np.full((700, 3), 7.0),
    "a crowd and one far off": lambda rng: np.concatenate([1e-9 * rng.random((699, 3)), np.full((1, 3), 1e9)]),
}


@pytest.mark.parametrize("is_built", [True, False])
@pytest.mark.parametrize("kind", CLOUDS)
def test_neighbours_in_clouds_of_any_kind_are_those_of_brute_force(
    kind: str, is_built: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiled and not, near and far queries, in spatial order and out of it; compiled, equally near ones come by row."""
    if is_built and not neighbours.IS_BUILT:
        pytest.skip("was installed where no C compiler is")
    monkeypatch.setattr(neighbours, "IS_BUILT", is_built)
    points = CLOUDS[kind](rng)
    queries = np.concatenate([points[spatial_order(points)], points[:50], points[:50] + rng.standard_normal((50, 3))])
    every = all_distances(queries, points)
    search = NeighbourSearch(points, threads=2)
    for k in (1, 2, 12, 33, 300, 700):
        distances, rows = search.knn(queries, k)
        np.testing.assert_allclose(distances, np.sort(every, axis=1)[:, :k], rtol=1e-12, atol=1e-155)
        np.testing.assert_allclose(distances, np.take_along_axis(every, rows, axis=1), rtol=1e-12, atol=1e-155)
        assert (np.diff(np.sort(rows, axis=1), axis=1) > 0).all()
        if is_built:  # whatever was asked before, and for whatever number
            alone = [NeighbourSearch(points, 1).knn(queries[i : i + 1], 700)[1][0, :k] for i in range(0, len(queries), 40)]
            np.testing.assert_array_equal(rows[::40], alone)
    if is_built and kind in ("a grid", "one place"):
        np.testing.assert_array_equal(search.knn(queries, 700)[1][:750], np.argsort(every[:750], axis=1, kind="stable"))


@pytest.mark.skipif(not neighbours.IS_BUILT, reason="was installed where no C compiler is")
def test_what_is_no_number_has_no_neighbours_and_is_none(rng: np.random.Generator) -> None:
    points = rng.random((300, 3))
    points[[3, 50, 51]] = [[np.nan] * 3, [np.inf, 0, 0], [1e200, 0, 0]]
    distances, rows = NeighbourSearch(points, threads=1).knn(points, 5)
    numbers = np.delete(np.arange(300), [3, 50, 51])
    assert set(rows[numbers].ravel().tolist()) == set(numbers.tolist())
    assert (rows[3] == 300).all()
    assert np.isinf(distances[[3, 50]]).all()


@settings(max_examples=40, deadline=None)
@given(points=on_grid, seed=st.integers(0, 99))
def test_distances_to_neighbours_follow_their_rows_in_any_order(points: np.ndarray, seed: int) -> None:
    order = np.random.default_rng(seed).permutation(len(points))
    np.testing.assert_array_equal(knn(points[order], 8, threads=1)[0], knn(points, 8, threads=1)[0][order])


@settings(max_examples=60, deadline=None)
@given(points=on_grid, radius=st.sampled_from([0.5, 1.0, 2.0, 3.0, 20.0]))
def test_pairs_within_a_radius_are_all_pairs_up_to_and_with_that_distance(points: np.ndarray, radius: float) -> None:
    first, second = np.nonzero(np.triu(all_distances(points, points) <= radius, k=1))
    pairs = radius_pairs(points, radius)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert sorted(map(tuple, pairs.tolist())) == list(zip(first.tolist(), second.tolist(), strict=True))


def test_the_number_of_threads_does_not_change_the_neighbours(rng: np.random.Generator) -> None:
    points = rng.standard_normal((3000, 3))
    for one, two in zip(NeighbourSearch(points, 1).knn(points, 9), NeighbourSearch(points, 2).knn(points, 9), strict=True):
        np.testing.assert_array_equal(one, two)


@settings(max_examples=80, deadline=None)
@given(points=anywhere)
def test_spatial_order_is_a_permutation_of_any_finite_points(points: np.ndarray) -> None:
    assert sorted(spatial_order(points).tolist()) == list(range(len(points)))


@pytest.mark.parametrize("unit", [5e-323, 1e-300, 0.1, 1e15])
def test_spatial_order_visits_a_grid_of_any_unit_cube_by_cube(rng: np.random.Generator, unit: float) -> None:
    """Morton: every aligned run of 8^j points of a grid of side 2^m fills a cube of side 2^j."""
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    shuffled = rng.permutation(grid)
    along = shuffled[spatial_order(shuffled * unit)]
    for level in (1, 2):
        runs = along.reshape(-1, 8**level, 3)
        np.testing.assert_array_equal(np.ptp(runs, axis=1), 2.0**level - 1)


def test_spatial_order_of_nothing_one_place_and_one_far_point() -> None:
    assert spatial_order(np.zeros((0, 3))).tolist() == []
    assert spatial_order(np.full((5, 3), 7e6)).tolist() == [0, 1, 2, 3, 4]
    assert spatial_order(np.array([[1e9, 0, 0], [0.0, 0, 0], [1, 0, 0]])).tolist() == [1, 2, 0]


@settings(max_examples=40, deadline=None)
@given(points=anywhere, seed=st.integers(0, 2**63 - 1))
def test_a_hash_belongs_to_the_place_and_the_seed_and_not_to_the_row(points: np.ndarray, seed: int) -> None:
    whole = coordinate_hash(points, seed)
    np.testing.assert_array_equal(coordinate_hash(points[::-1], seed), whole[::-1])
    np.testing.assert_array_equal([coordinate_hash(points[i : i + 1], seed)[0] for i in range(len(points))], whole)
    np.testing.assert_array_equal(coordinate_hash(np.where(points == 0, -0.0, points), seed), whole)


def test_hashes_of_a_regular_grid_are_uniform_and_unlike_under_other_seeds_and_swapped_axes() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(32.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    hashes = [coordinate_hash(points, seed) for points, seed in ((grid, 0), (grid, 1), (grid[:, ::-1], 0))]
    for some in hashes:
        assert len(np.unique(some)) == len(grid)
        for shift in (0, 24, 56):  # low, middle and high bytes
            counts = np.bincount((some >> np.uint64(shift) & np.uint64(255)).astype(int), minlength=256)
            assert stats.chisquare(counts).pvalue > 1e-4
    swapped = grid[:, 0] != grid[:, 2]
    for other in (hashes[1], hashes[2]):
        assert (other != hashes[0])[swapped].all()
        assert abs(np.corrcoef(other[swapped], hashes[0][swapped])[0, 1]) < 4 / np.sqrt(len(grid))


@settings(max_examples=60, deadline=None)
@given(points=on_grid)
def test_distinct_keeps_one_row_of_each_place_and_says_where_the_others_went(points: np.ndarray) -> None:
    rows, place = distinct(points)
    assert len(rows) == len(np.unique(points + 0.0, axis=0)) == len(np.unique(points[rows] + 0.0, axis=0))
    np.testing.assert_array_equal(points[rows][place], points)
    np.testing.assert_array_equal(place[rows], np.arange(len(rows)))


@settings(max_examples=40, deadline=None)
@given(sources=on_grid, targets=on_grid, radius=st.sampled_from([0.5, 1.0, 2.0, 20.0]))
def test_pairs_between_two_clouds_are_all_pairs_sorted_by_target(sources: np.ndarray, targets: np.ndarray, radius: float) -> None:
    found = [pair for i, j in pairs_within(sources, targets, radius) for pair in zip(i.tolist(), j.tolist(), strict=True)]
    first, second = np.nonzero(all_distances(targets, sources) <= radius)
    assert sorted(found) == list(zip(first.tolist(), second.tolist(), strict=True))
    assert [i for i, _ in found] == sorted(i for i, _ in found)


def test_thinning_leaves_about_the_asked_number_of_neighbours_and_says_which_share(rng: np.random.Generator) -> None:
    points = rng.random((20_000, 3)) * [1, 1, 0]  # some 630 within 0.1
    share, kept = thinned(points, points, 0.1, 64, rng)
    assert share == pytest.approx(64 / 600, rel=0.15)
    assert len(kept) == pytest.approx(share * 20_000, rel=0.1)  # 2 100 ± 45
    assert thinned(points, points, 0.01, 64, rng)[0] == 1


def test_row_numbers_alone_are_those_of_the_distances(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "_QUERIES", 37)
    points = rng.random((200, 3))
    search = NeighbourSearch(points, threads=1)
    np.testing.assert_array_equal(search.nearest(points, 7), search.knn(points, 7)[1])
    assert search.nearest(points, 500).shape == (200, 200)


def test_draws_by_an_identity_depend_on_it_and_the_seed_alone(rng: np.random.Generator) -> None:
    identity = coordinate_hash(rng.random((4000, 3)), 0)
    one, other = drawn_by(identity, 1), drawn_by(identity, 2)
    order = rng.permutation(4000)
    np.testing.assert_array_equal(drawn_by(identity[order], 1), one[order])
    assert len(np.unique(one)) == 4000
    # Uniform, and independent between seeds: the mean of n uniform numbers has the standard deviation 1 / √(12 n).
    for draws in (one, other, one ^ other):
        assert abs(draws.mean() / 2.0**64 - 0.5) < 5 / np.sqrt(12 * 4000)
