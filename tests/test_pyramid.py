"""The projection network's run, compiled and in torch: no block, thread or origin shows in the result, and both agree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from known_clouds import UTM, cloud, model, moves, rms
from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.denoising import pyramid
from pcdenoise.denoising.seeds import Seeds, coarsen
from pcdenoise.errors import ModelError
from pcdenoise.networks import fused, store
from pcdenoise.networks.projection import ProjectionNetwork
from pcdenoise.networks.store import Model, ProjectionSettings

Run = Callable[..., tuple[np.ndarray, np.ndarray]]
"""From a model, seeds, what is behind them, raw points and noise to where points went and the shape around the seeds."""


def ordered(points: np.ndarray) -> np.ndarray:
    return points[spatial_order(points)]


def in_torch(model: Model, *given: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    with torch.no_grad():
        descent = pyramid.descend(model.network, *given, **options)
    return descent.last.numpy(), descent.shape.numpy()


def compiled(model: Model, *given: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    sizes = model.config.settings
    assert isinstance(sizes, ProjectionSettings)
    assert fused.fits(sizes)
    return fused.descend(model.weights, sizes, *given, **options)


needs_compiler = pytest.mark.skipif(not fused.IS_BUILT, reason="was installed where no C compiler is")


@pytest.fixture(params=[in_torch, pytest.param(compiled, marks=needs_compiler)])
def run(request: pytest.FixtureRequest) -> Run:
    """Either way of running the network."""
    way: Run = request.param
    return way


def seeds_of(points: np.ndarray, share: float) -> Seeds:
    return coarsen(points, share, threads=1) if share < 1 else Seeds(points, np.ones(len(points)), np.arange(len(points)))


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_the_result_does_not_depend_on_the_size_of_the_blocks(run: Run, share: float) -> None:
    noisy = cloud("torus", 1500, 1.0)
    points = ordered(noisy.noisy)
    coarse, raw = seeds_of(points, share), points if share < 1 else None
    given = (model("seeded"), coarse.points, coarse.count, raw, noisy.spacing)
    whole, shape = run(*given, block_points=10**9)
    assert len(whole) == 1500
    assert len(shape) == len(coarse.points)
    for size in (1000, 77):
        for one, other in zip(run(*given, block_points=size), (whole, shape), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)


def test_the_result_does_not_depend_on_the_number_of_threads(run: Run) -> None:
    noisy = cloud("torus", 1500, 1.0)
    given = (model("seeded"), ordered(noisy.noisy), np.ones(1500), None, noisy.spacing)
    for one, two in zip(*(run(*given, block_points=200, threads=n) for n in (1, 2)), strict=True):
        np.testing.assert_allclose(two, one, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize("name", ["default", "unsupervised", "wide"])
@pytest.mark.parametrize("share", [1, 0.2])
def test_compiled_code_and_torch_agree(name: str, share: float, rng: np.random.Generator) -> None:
    # Both round to float32; a hundred-thousandth of the spacing is a hundred times less than a scanner's last digit.
    noisy = cloud("torus", 1501, 1.0)
    points = ordered(noisy.noisy)
    coarse = seeds_of(points, share)
    count = coarse.count if share < 1 else rng.integers(1, 9, 1501).astype(float)
    weights = model(name) if name == "wide" else store.load(name)
    given = (weights, coarse.points, count, points if share < 1 else None, noisy.spacing)
    (by_torch, shape), (moved, its_shape) = in_torch(*given), compiled(*given, threads=2, block_points=400)
    np.testing.assert_allclose(its_shape, shape, atol=1e-5 * noisy.spacing)
    assert moves(moved, by_torch).max() < 1e-5 * noisy.spacing
    assert np.median(moves(points, moved)) > 0.1 * noisy.spacing


def test_broken_weights_are_seen(run: Run) -> None:
    noisy, sound = cloud("torus", 500, 1.0), model("seeded")
    weights = {name: array.copy() for name, array in sound.weights.items()}
    weights["stages.0.rounds.0.message.weight"][3, 4] = np.nan
    with pytest.raises(ModelError, match="not numbers"):
        run(Model("broken", sound.config, "", weights), ordered(noisy.noisy), None, None, noisy.spacing)


def test_far_from_the_origin_the_same_points_take_the_same_steps(run: Run) -> None:
    # Only differences between neighbours become float32; UTM coordinates themselves have float64 steps of 1e-9.
    noisy = cloud("torus", 1500, 1.0)
    points = ordered(noisy.noisy)
    coarse = coarsen(points, 0.2, threads=1)
    near, far = (
        run(model("seeded"), coarse.points + shift, coarse.count, points + shift, noisy.spacing)[0]
        for shift in (np.zeros(3), UTM)
    )
    np.testing.assert_allclose(far - UTM, near, atol=1e-6)


def test_every_point_that_is_through_a_round_is_counted(run: Run) -> None:
    noisy = cloud("sphere", 1500, 1.0)
    points, done = ordered(noisy.noisy), list[int]()
    coarse = coarsen(points, 0.2, threads=1)
    run(model("untrained"), coarse.points, coarse.count, points, noisy.spacing, block_points=400, on_block=done.append)
    # Two rounds in each of two stages and two in the landing: what a progress bar adds up.
    assert sum(done) == len(coarse.points) * 4 + len(points) * 2


def test_every_stage_steps_and_every_row_lands() -> None:
    noisy = cloud("sphere", 1500, 1.0)
    points = ordered(noisy.noisy)
    coarse = coarsen(points, 0.2, threads=1)
    with torch.no_grad():
        descent = pyramid.descend(model("untrained").network, coarse.points, coarse.count, points, noisy.spacing)
    assert descent.landed is not None
    assert [stage.shape for stage in descent.seeds] == [coarse.points.shape] * 2
    assert descent.landed.shape == points.shape
    errors = [noisy.error(stage.numpy()) for stage in [*descent.seeds, descent.landed]]
    assert noisy.error(coarse.points) > errors[0] > errors[1]
    assert errors[2] < 0.4 * noisy.error(points)


def test_many_points_behind_a_seed_outweigh_a_single_one(run: Run) -> None:
    # Two parallel sheets interleaved; the upper one stands for nothing, so that all settle on the lower one.
    grid = np.stack(np.meshgrid(np.arange(14.0), np.arange(14.0)), axis=-1).reshape(-1, 2)
    upper = grid.sum(axis=1) % 2 == 1
    points = np.column_stack([grid, 0.2 * upper])
    settled = run(model("untrained"), points, np.where(upper, 1e-6, 1.0), None, 0.1)[0]
    assert np.abs(settled[:, 2]).max() < 0.02


def test_a_clean_sphere_does_not_shrink(run: Run) -> None:
    # Curvature cancels to second order; a mean over the same 24 of 3000 points would sink by half their cap's height, 24 / 3000.
    clean = cloud("sphere", 3000, 0.0)
    moved = run(model("untrained"), ordered(clean.clean), None, None, 0.0)[0]
    signed = clean.surface.signed_distance(moved)
    assert abs(signed.mean()) < 0.02 * 24 / 3000
    assert rms(signed) < 0.1 * 24 / 3000
    assert moves(ordered(clean.clean), moved).max() < 0.1 * clean.spacing


def test_gradients_reach_every_weight() -> None:
    noisy = cloud("sphere", 300, 0.7)
    network = model("seeded").network
    coarse = coarsen(ordered(noisy.noisy), 0.3, threads=1)
    assert isinstance(network, ProjectionNetwork)
    descent = pyramid.descend(network, coarse.points, coarse.count, noisy.noisy, noisy.spacing, block_points=10**9, threads=1)
    assert descent.landed is not None
    loss = sum((stage.norm(dim=1) - 1).square().mean() for stage in [*descent.seeds, descent.landed])
    gradients = torch.autograd.grad(loss, list(network.parameters()), allow_unused=True)
    unused = [name for (name, _), g in zip(network.named_parameters(), gradients, strict=True) if g is None or not g.any()]
    # The last round of the landing turns messages into the step alone: its features go nowhere.
    assert all(name.startswith("landing.rounds.1.") for name in unused), unused
    assert all(bool(g.isfinite().all()) for g in gradients if g is not None)
