"""Monte Carlo convolutions against their formula and their integrals; the network's size, determinism and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.stats import ncx2

from pcdenoise.cloud.sampling import poisson_disk
from pcdenoise.networks import convolution
from pcdenoise.networks.convolution import BANDWIDTH, MonteCarloConvolution, ReceptiveFields, receptive_fields
from pcdenoise.networks.mcconv import FIRST_RADIUS, LONGEST_MOVE, PAPER, RELEASED, SECOND_RADIUS, MCConvNetwork

RADIUS = 0.05


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(2)


def noisy_sphere(rng: np.random.Generator, n: int, noise: float = 0.01) -> np.ndarray:
    """In a frame with a bounding-box diagonal of about one."""
    directions = rng.normal(size=(n, 3))
    return 0.29 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + noise * rng.normal(size=(n, 3))


def network(config: object = PAPER) -> MCConvNetwork:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return MCConvNetwork(config)


def integrals(fields: ReceptiveFields) -> np.ndarray:
    """(M,) each receptive field's integral of one."""
    return np.bincount(fields.target, fields.weight, minlength=fields.n_targets)


def by_the_formula(layer: MonteCarloConvolution, features: np.ndarray, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(C_out,) of one output point, loop by loop, with the density estimated inside its receptive field."""
    w1, w2, w3, b1, b2, b3 = (p.detach().double().numpy() for p in [*layer.weights, *layer.biases])
    near = np.flatnonzero(np.linalg.norm(points - centre, axis=1) < RADIUS)
    out = np.zeros(layer.out_channels)
    for j in near:
        gaps = (points[near] - points[j]) / RADIUS / BANDWIDTH
        density = np.mean(np.prod(np.exp(-0.5 * gaps**2) / (BANDWIDTH * np.sqrt(2 * np.pi)), axis=1))
        offset = (points[j] - centre) / RADIUS
        kernel = []
        for block in range(len(w1)):
            hidden = np.maximum(offset @ w1[block] + b1[block, 0], 0)
            hidden = np.maximum(hidden @ w2[block] + b2[block, 0], 0)
            kernel += list(hidden @ w3[block] + b3[block, 0])
        for o in range(layer.out_channels):
            channels = [o] if layer.depthwise else range(layer.in_channels)
            total = sum(features[j, c] * kernel[o if layer.depthwise else o * layer.in_channels + c] for c in channels)
            out[o] += total / density / len(near)
    return out


@pytest.mark.parametrize(("n_in", "n_out", "depthwise"), [(1, 5, False), (3, 4, False), (10, 10, True)])
def test_the_literal_convolution_is_the_papers_formula(rng: np.random.Generator, n_in: int, n_out: int, depthwise: bool) -> None:
    points, features = noisy_sphere(rng, 1500), rng.normal(size=(1500, n_in))
    targets = points[:7]
    with torch.random.fork_rng():
        torch.manual_seed(1)
        layer = MonteCarloConvolution(n_in, n_out, depthwise=depthwise)
        for bias in layer.biases:
            torch.nn.init.normal_(bias, std=0.1)
    with torch.no_grad():
        out = layer(torch.tensor(features, dtype=torch.float32), receptive_fields(points, targets, RADIUS, None, rng))
    expected = np.stack([by_the_formula(layer, features, points, centre) for centre in targets])
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("n", [6_000, 16_000])
def test_sampled_and_literal_convolution_agree_in_expectation(rng: np.random.Generator, n: int) -> None:
    points = noisy_sphere(rng, n)
    targets = points[:200]
    layer = MonteCarloConvolution(1, 16)
    ones = torch.ones(n, 1)
    with torch.no_grad():
        literal = layer(ones, receptive_fields(points, targets, RADIUS, None, rng))
        sampled = torch.stack([layer(ones, receptive_fields(points, targets, RADIUS, 16, rng)) for _ in range(20)]).mean(0)
    ratio = (sampled * literal).sum() / literal.square().sum()
    # The density once per source misses the literal one by a few percent near the edge of the field; the sample adds no bias.
    assert float(ratio) == pytest.approx(1, abs=0.06)
    assert np.corrcoef(sampled.flatten(), literal.flatten())[0, 1] > 0.97


def test_a_sample_of_the_neighbours_is_unbiased_for_all_of_them(rng: np.random.Generator) -> None:
    points = noisy_sphere(rng, 4_000)
    targets = points[:200]
    every = integrals(receptive_fields(points, targets, RADIUS, 10_000, rng))
    draws = np.stack([integrals(receptive_fields(points, targets, RADIUS, 8, rng)) for _ in range(100)])
    error = (draws.mean(axis=0) - every) / (draws.std(axis=0) / np.sqrt(100))
    assert np.sqrt((error**2).mean()) < 1.3  # in standard errors; one if unbiased
    assert receptive_fields(points, targets, RADIUS, 8, rng).target.bincount().max() == 8


def test_the_integral_over_a_plane_does_not_depend_on_its_density(rng: np.random.Generator) -> None:
    def flat(n: int) -> np.ndarray:
        return np.column_stack([rng.random((n, 2)), np.zeros(n)])

    x = flat(60_000)
    uneven = x[rng.random(60_000) < 0.1 + 0.9 * x[:, 0]]
    centres = np.column_stack([rng.uniform(0.1, 0.9, (200, 2)), np.zeros(200)])
    # On a flat disc the estimated density is that of the plane over h sqrt(2π), times what of the kernel lies inside the disc.
    t = (np.arange(1000) + 0.5) / 1000
    inside = ncx2.cdf(BANDWIDTH**-2, 2, (t / BANDWIDTH) ** 2)
    # That a point counts in its own density makes it a few percent less: 6 % at 20 000 points, 2 % at 60 000.
    expected = BANDWIDTH * np.sqrt(2 * np.pi) * np.mean(2 * np.pi * t / inside)
    for points in (flat(30_000), flat(60_000), uneven):
        assert integrals(receptive_fields(points, centres, RADIUS, 48, rng)).mean() == pytest.approx(expected, rel=0.07)


def test_levels_are_poisson_disks_and_no_receptive_field_is_empty(rng: np.random.Generator) -> None:
    points = noisy_sphere(rng, 5_000)
    first = network().eval().encode(torch.tensor(points), rng).points
    second = first[poisson_disk(first, SECOND_RADIUS / 2, rng)]
    assert 100 < len(second) < len(first) < len(points) / 4
    assert cKDTree(first).query(first, 2)[0][:, 1].min() > FIRST_RADIUS / 2
    assert (FIRST_RADIUS, SECOND_RADIUS) == (0.05, 0.1)
    for sources, targets, radius in ((points, first, 0.05), (first, second, 0.1), (second, first, 0.1), (first, points, 0.05)):
        fields = receptive_fields(sources, targets, radius, 48, rng)
        assert fields.offset.norm(dim=1).max() <= 1 + 1e-6
        assert (fields.weight > 0).all()
        # A Poisson disk leaves nobody farther than half the field from a sample.
        assert (fields.target.bincount(minlength=fields.n_targets) > 0).all()


def test_what_is_decoded_part_by_part_is_what_is_decoded_at_once(rng: np.random.Generator) -> None:
    points = torch.tensor(noisy_sphere(rng, 3_000), dtype=torch.float32)
    model = network().eval()
    with torch.no_grad():
        code = model.encode(points, rng)
        whole = model.decode(code, points, rng)
        parts = torch.cat([model.decode(code, part, rng) for part in points.split(700)])
    # No point has more than 48 of the first level's around it, so nothing is drawn by lot.
    torch.testing.assert_close(parts, whole, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(("config", "n_parameters"), [(PAPER, 25_000), (RELEASED, 35_840)])
def test_the_network_has_the_published_number_of_parameters(config: object, n_parameters: int) -> None:
    assert sum(parameter.numel() for parameter in network(config).parameters()) == n_parameters


def test_the_same_seed_gives_the_same_move_and_another_one_nearly_the_same(rng: np.random.Generator) -> None:
    points = torch.tensor(noisy_sphere(rng, 3_000), dtype=torch.float32)
    model = network().eval()
    with torch.no_grad():
        first, again = model(points), model(points)
        other = model(points, np.random.default_rng(9))
        shifted = model(points + torch.tensor([1.0, -2.0, 0.5]))
    assert first.shape == points.shape
    torch.testing.assert_close(again, first, rtol=0, atol=0)
    assert not torch.equal(other, first)
    assert np.corrcoef(other.flatten(), first.flatten())[0, 1] > 0.9
    torch.testing.assert_close(shifted, first, rtol=0, atol=0.02 * float(first.abs().max()))
    assert first.abs().max() <= LONGEST_MOVE


def test_gradients_reach_every_parameter_and_no_position(rng: np.random.Generator) -> None:
    points = torch.tensor(noisy_sphere(rng, 2_000), dtype=torch.float32, requires_grad=True)
    model = network().train()
    model(points, rng).square().sum().backward()
    assert points.grad is None
    missing = [name for name, parameter in model.named_parameters() if parameter.grad is None or not parameter.grad.any()]
    # A batch norm takes away whatever a layer before it adds to all points alike.
    assert [name for name in missing if not name.endswith("linear.bias")] == []


def test_recomputing_large_layers_changes_no_gradient(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.tensor(noisy_sphere(rng, 1_500), dtype=torch.float32)
    gradients = []
    for edges_kept in (2**17, 10):
        monkeypatch.setattr(convolution, "_EDGES_KEPT", edges_kept)
        model = network().train()
        model(points, np.random.default_rng(3)).square().sum().backward()
        gradients.append(torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None]))
    # sums of thousands of terms in single precision, of which some cancel: the rounding is that of the largest
    largest = float(gradients[0].abs().max())
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-6 * largest)


def test_some_steps_of_training_learn_to_denoise_a_sphere(rng: np.random.Generator) -> None:
    model = network().train()
    optimiser = torch.optim.Adam(model.parameters(), lr=0.005)

    def error(points: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        return ((points + move).norm(dim=1) - 0.29).square().mean()

    for _ in range(30):
        points = torch.tensor(noisy_sphere(rng, 1_500, 0.015), dtype=torch.float32)
        optimiser.zero_grad()
        error(points, model(points, rng)).backward()
        optimiser.step()
    fresh = torch.tensor(noisy_sphere(rng, 1_500, 0.015), dtype=torch.float32)
    with torch.no_grad():
        assert error(fresh, model(fresh, rng)) < 0.6 * error(fresh, torch.zeros_like(fresh))


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_tiny_and_coincident_clouds_get_a_finite_move(rng: np.random.Generator, n: int) -> None:
    model = network().eval()
    with torch.no_grad():
        for points in (torch.rand(n, 3), torch.ones(n, 3)):
            move = model(points)
            assert move.shape == (n, 3)
            assert move.isfinite().all()
