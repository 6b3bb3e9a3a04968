"""Seeds that stand for all points, and the network's run: no block, thread, row order or origin shows in the result."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from known_clouds import SURFACES, UTM, ball, cloud, model, moves, rms
from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.denoising.pyramid import Descent, Seeds, coarsen, descend, share_of_seeds
from pcdenoise.errors import ModelError
from pcdenoise.networks import fused, store
from pcdenoise.networks.projection import ProjectionNetwork

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


# The run of the network


def run(points: np.ndarray, share: float, noise: float, **options: int) -> tuple[Seeds, Descent]:
    coarse = coarsen(points, share, threads=1) if share < 1 else Seeds(points, np.ones(len(points)), np.arange(len(points)))
    with torch.no_grad():
        network = model("seeded").network
        raw = points if share < 1 else None
        return coarse, descend(network, coarse.points, coarse.count, raw, noise, threads=1, **options)


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_the_result_does_not_depend_on_the_size_of_the_blocks(share: float) -> None:
    noisy = cloud("torus", 1500, 1.0)
    points = ordered(noisy.noisy)
    _, whole = run(points, share, noisy.spacing, block_points=10**9)
    for size in (1000, 77):
        _, blocks = run(points, share, noisy.spacing, block_points=size)
        for one, other in zip([*whole.seeds, whole.landed], [*blocks.seeds, blocks.landed], strict=True):
            if one is not None and other is not None:
                np.testing.assert_allclose(other, one, atol=1e-6)
        assert (whole.landed is None) == (blocks.landed is None) == (share == 1)


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    noisy = cloud("torus", 1500, 1.0)
    points, count, network = ordered(noisy.noisy), np.ones(1500), model("seeded").network
    with torch.no_grad():
        one, two = (descend(network, points, count, None, noisy.spacing, block_points=200, threads=n) for n in (1, 2))
    np.testing.assert_allclose(two.seeds[-1], one.seeds[-1], atol=1e-6)
    np.testing.assert_allclose(two.trust, one.trust, atol=1e-6)


@pytest.mark.skipif(not fused.IS_BUILT, reason="was installed where no C compiler is")
@pytest.mark.parametrize("name", ["default", "unsupervised"])
@pytest.mark.parametrize("share", [1, 0.2])
def test_compiled_code_and_torch_agree(name: str, share: float, rng: np.random.Generator) -> None:
    # Both round to float32; a hundred-thousandth of the spacing is a hundred times less than a scanner's last digit.
    noisy, network = cloud("torus", 1501, 1.0), store.load(name).network
    assert isinstance(network, ProjectionNetwork)
    points = ordered(noisy.noisy)
    coarse = (
        coarsen(points, share, threads=1) if share < 1 else Seeds(points, rng.integers(1, 9, 1501).astype(float), np.arange(1501))
    )
    raw = points if share < 1 else None
    by_torch = descend(network, coarse.points, coarse.count, raw, noisy.spacing, threads=1)
    with torch.no_grad():
        assert fused.runs(network)
        compiled = descend(network, coarse.points, coarse.count, raw, noisy.spacing, threads=2, block_points=400)
    np.testing.assert_allclose(compiled.trust, by_torch.trust, atol=1e-5)
    for one, other in zip([*compiled.seeds, compiled.landed], [*by_torch.seeds, by_torch.landed], strict=True):
        if one is not None and other is not None:
            assert moves(one.numpy(), other.detach().numpy()).max() < 1e-5 * noisy.spacing
    last = compiled.seeds[-1] if compiled.landed is None else compiled.landed
    assert np.median(moves(points, last.numpy())) > 0.1 * noisy.spacing


def test_compiled_code_lets_broken_weights_be_seen() -> None:
    noisy, network = cloud("torus", 500, 1.0), copy.deepcopy(model("seeded").network)
    with torch.no_grad():
        network.among[0].exchanges[0].message.weight[3, 4] = torch.nan
        with pytest.raises(ModelError, match="not numbers"):
            descend(network, ordered(noisy.noisy), None, None, noisy.spacing, threads=1)


def test_far_from_the_origin_the_same_points_take_the_same_steps() -> None:
    # Only differences between neighbours become float32; UTM coordinates themselves have float64 steps of 1e-9.
    noisy = cloud("torus", 1500, 1.0)
    points = ordered(noisy.noisy)
    coarse = coarsen(points, 0.2, threads=1)
    with torch.no_grad():
        near, far = (
            descend(model("seeded").network, coarse.points + shift, coarse.count, points + shift, noisy.spacing, threads=1).landed
            for shift in (np.zeros(3), UTM)
        )
    assert near is not None
    assert far is not None
    np.testing.assert_allclose(far.numpy() - UTM, near.numpy(), atol=1e-6)


def test_every_stage_steps_and_every_row_lands() -> None:
    noisy = cloud("sphere", 1500, 1.0)
    points = ordered(noisy.noisy)
    done: list[int] = []
    coarse = coarsen(points, 0.2, threads=1)
    with torch.no_grad():
        network = model("untrained").network
        descent = descend(
            network, coarse.points, coarse.count, points, noisy.spacing, block_points=400, threads=1, on_block=done.append
        )
    assert descent.landed is not None
    assert [stage.shape for stage in descent.seeds] == [coarse.points.shape] * 2
    assert descent.landed.shape == points.shape
    errors = [noisy.error(stage.numpy()) for stage in [*descent.seeds, descent.landed]]
    assert noisy.error(coarse.points) > errors[0] > errors[1]
    assert errors[2] < 0.4 * noisy.error(points)
    # Two rounds in each of two stages and the landing: what a progress bar adds up.
    assert sum(done) == len(coarse.points) * 4 + len(points) * 2


def test_many_points_behind_a_seed_outweigh_a_single_one() -> None:
    # Two parallel sheets interleaved; the upper one stands for nothing, so that all settle on the lower one.
    grid = np.stack(np.meshgrid(np.arange(14.0), np.arange(14.0)), axis=-1).reshape(-1, 2)
    upper = grid.sum(axis=1) % 2 == 1
    points = np.column_stack([grid, 0.2 * upper])
    with torch.no_grad():
        settled = descend(model("untrained").network, points, np.where(upper, 1e-6, 1.0), None, 0.1, threads=1).seeds[-1].numpy()
    assert np.abs(settled[:, 2]).max() < 0.02


def test_a_clean_sphere_does_not_shrink() -> None:
    # Curvature cancels to second order; a mean over the same 24 of 3000 points would sink by half their cap's height, 24 / 3000.
    clean = cloud("sphere", 3000, 0.0)
    with torch.no_grad():
        moved = descend(model("untrained").network, ordered(clean.clean), None, None, 0.0, threads=1).seeds[-1].numpy()
    signed = clean.surface.signed_distance(moved)
    assert abs(signed.mean()) < 0.02 * 24 / 3000
    assert rms(signed) < 0.1 * 24 / 3000
    assert moves(ordered(clean.clean), moved).max() < 0.1 * clean.spacing


def test_gradients_reach_every_weight() -> None:
    noisy = cloud("sphere", 300, 0.7)
    network = model("seeded").network
    coarse = coarsen(ordered(noisy.noisy), 0.3, threads=1)
    descent = descend(network, coarse.points, coarse.count, noisy.noisy, noisy.spacing, block_points=10**9, threads=1)
    assert descent.landed is not None
    loss = sum((stage.norm(dim=1) - 1).square().mean() for stage in [*descent.seeds, descent.landed])
    gradients = torch.autograd.grad(loss, list(network.parameters()), allow_unused=True)
    unused = [name for (name, _), g in zip(network.named_parameters(), gradients, strict=True) if g is None or not g.any()]
    # The last round of the landing turns messages into the step alone: its features go nowhere.
    assert all(name.startswith("landing.rounds.1.") for name in unused), unused
    assert all(bool(g.isfinite().all()) for g in gradients if g is not None)
