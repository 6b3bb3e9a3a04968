"""The prior's targets against their closed form on planes and spheres, and the losses against what they must converge to."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pcdenoise.errors import UsageError
from pcdenoise.learning.losses import annealed_exponent, annealed_l0, anti_clustering
from pcdenoise.learning.priors import KERNELS, Prior, gaussian_std

RADIUS = 0.05


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def plane(rng: np.random.Generator, n: int, noise: float = 0.0) -> np.ndarray:
    return np.column_stack([rng.random((n, 2)), noise * rng.normal(size=n)])


def sphere(rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
    directions = rng.normal(size=(n, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def inner(points: np.ndarray) -> np.ndarray:
    return (np.abs(points[:, :2] - 0.5) < 0.5 - RADIUS).all(axis=1)


@pytest.mark.parametrize("noise", [0.005, 0.01, 0.015])
def test_the_mean_target_on_a_plane_keeps_the_known_share_of_the_noise(rng: np.random.Generator, noise: float) -> None:
    points = plane(rng, 20_000, noise)
    keep = inner(points)
    height, target = points[keep, 2], Prior(RADIUS).targets(points, None, rng)[keep, 2]
    slope = (height * target).sum() / (height**2).sum()
    std = gaussian_std(RADIUS)
    # 16 000 targets, each with a spread of about the noise itself around its mean: the slope is known to 0.01.
    assert slope == pytest.approx(noise**2 / (noise**2 + std**2), abs=0.03)


@pytest.mark.parametrize("ball_radius", [0.2, 0.4])
def test_the_mean_target_on_a_sphere_drifts_inward_by_the_curvature_times_the_kernels_variance(
    rng: np.random.Generator, ball_radius: float
) -> None:
    points = sphere(rng, 20_000, ball_radius)
    outward = points / ball_radius
    drift = ((points - Prior(RADIUS).targets(points, None, rng)) * outward).sum(axis=1).mean()
    assert drift == pytest.approx(gaussian_std(RADIUS) ** 2 / ball_radius, rel=0.05)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("n", [8_000, 24_000])
def test_every_kernel_draws_from_its_own_law_in_the_plane(rng: np.random.Generator, kernel: str, n: int) -> None:
    points = plane(rng, n)
    keep = inner(points)
    moved = Prior(RADIUS, kernel, 1.0).targets(points, None, rng)[keep] - points[keep]
    t = (np.arange(10_000) + 0.5) / 10_000 * RADIUS
    chance = KERNELS[kernel]((t / RADIUS) ** 2) * t
    # 8 000 points have 63 neighbours within the radius, all of them candidates; 24 000 have 188, of which a third are.
    assert (moved**2).sum(axis=1).mean() == pytest.approx((chance * t**2).sum() / chance.sum(), rel=0.06)
    assert np.linalg.norm(moved, axis=1).max() <= RADIUS


def test_a_wider_kernel_moves_targets_farther_in_proportion(rng: np.random.Generator) -> None:
    points = plane(rng, 50_000)
    keep = inner(points)
    narrow, wide = (Prior(RADIUS, alpha=alpha).targets(points, None, rng)[keep] - points[keep] for alpha in (0.25, 0.5))
    assert wide.std() / narrow.std() == pytest.approx(2, rel=0.05)


def test_the_law_does_not_depend_on_unit_or_place(rng: np.random.Generator) -> None:
    points = plane(rng, 2000, 0.01)
    rows = Prior(RADIUS).rows(points, None, np.random.default_rng(5))
    np.testing.assert_array_equal(rows, Prior(RADIUS * 1e3).rows(points * 1e3, None, np.random.default_rng(5)))
    assert (rows != Prior(RADIUS).rows(points, None, np.random.default_rng(6))).mean() > 0.5


def test_colour_keeps_targets_on_their_side_of_an_edge(rng: np.random.Generator) -> None:
    points = plane(rng, 20_000)
    red = points[:, 0] < 0.5
    colour = np.column_stack([red, np.zeros(20_000), ~red]).astype(float)
    near = np.abs(points[:, 0] - 0.5) < 0.005
    crossed = {
        beta: (red[Prior(RADIUS, beta=beta).rows(points, features, rng)] != red)[near].mean()
        for beta, features in ((4.0, colour), (0.6, colour), (1.0, None))
    }
    # The far side's weight falls by exp(-β² |Δc|² / 2·0.32), |Δc|² = 2: its odds of one to one (nearly) do too.
    odds = crossed[1.0] / (1 - crossed[1.0]) * np.exp(-(0.6**2) * 2 / 0.64)
    assert crossed[1.0] > 0.35
    assert crossed[0.6] == pytest.approx(odds / (1 + odds), rel=0.15)
    assert crossed[4.0] == 0


def test_a_point_is_its_own_target_as_often_as_its_density_says_and_never_with_a_blind_spot(rng: np.random.Generator) -> None:
    n = 20_000
    points = plane(rng, n)
    own = (Prior(RADIUS, blind_spot=False).rows(points, None, rng) == np.arange(n))[inner(points)].mean()
    others = n * 2 * np.pi * gaussian_std(RADIUS) ** 2  # in units of the kernel's peak: about 25
    assert own == pytest.approx(1 / (1 + others), rel=0.15)  # some 600 of 16 000 points: known to 4 %
    assert not (Prior(RADIUS).rows(points, None, rng) == np.arange(n)).any()


def test_lonely_points_and_tiny_clouds_are_their_own_targets(rng: np.random.Generator) -> None:
    for n in (0, 1, 3):
        points = np.arange(3.0 * n).reshape(n, 3)
        for blind in (False, True):
            np.testing.assert_array_equal(Prior(RADIUS, blind_spot=blind).targets(points, None, rng), points)


def test_wrong_arguments_are_named() -> None:
    for arguments, name in (({"kernel": "box"}, "kernel"), ({"alpha": 0.0}, "alpha"), ({"beta": -1.0}, "beta")):
        with pytest.raises(UsageError, match=rf"^{name}: .+"):
            Prior(RADIUS, **arguments)


def minimiser(values: np.ndarray, exponent: float, **options: float) -> float:
    grid = torch.linspace(-1, 3, 801, dtype=torch.float64)
    samples = torch.tensor(values)
    cost = [annealed_l0(samples, torch.stack([x, x * 0, x * 0]).expand_as(samples), exponent, **options) for x in grid]
    return float(grid[int(torch.stack(cost).argmin())])


def test_the_loss_converges_to_the_mean_then_the_median_then_the_mode(rng: np.random.Generator) -> None:
    skewed = rng.exponential(size=4001)
    skewed[:400] = rng.normal(0.1, 0.005, 400)
    values = np.column_stack([skewed, np.zeros((4001, 2))])
    assert minimiser(values, 2.0) == pytest.approx(skewed.mean(), abs=0.01)
    assert minimiser(values, 1.0) == pytest.approx(np.median(skewed), abs=0.01)
    assert minimiser(values, 0.1, epsilon=0.005) == pytest.approx(0.1, abs=0.01)
    assert [annealed_exponent(t) for t in (0.0, 0.5)] == [2.0, 1.0]
    assert 0 < annealed_exponent(1.0) < 1e-6


def test_the_loss_is_invariant_to_rotation_and_its_per_axis_form_is_not(rng: np.random.Generator) -> None:
    a, b = (torch.tensor(rng.normal(size=(200, 3))) for _ in range(2))
    turn = torch.tensor(np.linalg.qr(rng.normal(size=(3, 3)))[0])
    for exponent in (2.0, 1.0, 0.3):
        torch.testing.assert_close(annealed_l0(a @ turn, b @ turn, exponent), annealed_l0(a, b, exponent))
        relative = annealed_l0(a @ turn, b @ turn, exponent, per_axis=True) / annealed_l0(a, b, exponent, per_axis=True)
        assert (abs(float(relative) - 1) < 1e-6) == (exponent == 2.0)
    torch.testing.assert_close(annealed_l0(a, b, 2.0), annealed_l0(a, b, 2.0, per_axis=True), rtol=1e-6, atol=0)


def test_losses_have_finite_gradients_where_prediction_and_target_meet() -> None:
    prediction = torch.zeros(5, 3, requires_grad=True)
    total = annealed_l0(prediction, torch.zeros(5, 3), 0.5, epsilon=1e-3) + anti_clustering(prediction, np.zeros((5, 3)), 1.0)
    total.backward()
    assert prediction.grad is not None
    assert prediction.grad.isfinite().all()


def test_anti_clustering_is_the_mean_distance_to_the_farthest_of_the_patch(rng: np.random.Generator) -> None:
    points, moved = rng.random((300, 3)), rng.random((300, 3))
    near = np.linalg.norm(points[:, None] - points, axis=2) <= 0.3
    apart = np.where(near, np.linalg.norm(moved[:, None] - moved, axis=2), 0).max(axis=1)
    prediction = torch.tensor(moved)
    assert float(anti_clustering(prediction, points, 0.3)) == pytest.approx(apart.mean())
    released = anti_clustering(prediction, points, 0.3, released_exponent=0.5)
    assert float(released) == pytest.approx((apart**2).mean() * 0.3**-1.5)


def test_descending_on_anti_clustering_evens_out_spacing(rng: np.random.Generator) -> None:
    x = np.sort(rng.random(60))
    x[20:40] = x[30] + 0.02 * (x[20:40] - x[30])  # a clump
    points = np.column_stack([x, np.zeros((60, 2))])
    prediction = torch.tensor(points, requires_grad=True)
    loss = anti_clustering(prediction, points, 0.2)
    loss.backward()
    assert prediction.grad is not None
    with torch.no_grad():
        moved = prediction - 0.01 * prediction.grad
    assert float(anti_clustering(moved, points, 0.2)) < float(loss.detach())
    assert prediction.grad.sum(dim=0).abs().max() < 1e-12  # both ends of each distance move: the whole stays where it is
