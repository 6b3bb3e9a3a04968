"""A denoiser made for clean targets, trained from noisy clouds alone: a small PointNet on patches, as PointCleanNet has it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from pcdenoise.cloud.neighbours import knn
from pcdenoise.learning.priors import Prior
from pcdenoise.learning.upgrade import PseudoCleanPairs, pseudo_clean

NOISE = 0.02


def noisy_sphere(rng: np.random.Generator, n: int = 1500) -> np.ndarray:
    directions = rng.normal(size=(n, 3))
    return 0.29 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + NOISE * rng.normal(size=(n, 3))


class PatchNet(nn.Module):
    """Somebody else's denoiser: every point moves by what a PointNet makes of its 48 neighbours. It has never heard of priors."""

    reach = 0.1

    def __init__(self) -> None:
        super().__init__()
        self.each = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU())
        self.all = nn.Sequential(nn.Linear(64, 32), nn.ReLU(), nn.Linear(32, 3))

    def forward(self, points: Tensor) -> Tensor:
        near = points[torch.from_numpy(knn(points.double().numpy(), 48)[1])]
        return points + self.reach * self.all(self.each((near - points[:, None]) / self.reach).mean(dim=1))


def train_supervised(network: nn.Module, pairs: DataLoader[tuple[Tensor, Tensor]]) -> None:
    """Somebody else's training: mean squared distance to the clean point of the same row."""
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3)
    for noisy, clean in pairs:
        optimiser.zero_grad()
        (network(noisy) - clean).square().sum(dim=1).mean().backward()
        optimiser.step()


def rms_error(points: Tensor) -> float:
    return float((points.norm(dim=1) - 0.29).square().mean().sqrt())


def test_a_supervised_denoiser_learns_from_noisy_clouds_alone(rng: np.random.Generator) -> None:
    torch.manual_seed(0)
    network = PatchNet()
    clouds = [noisy_sphere(rng) for _ in range(4)]
    train_supervised(network, DataLoader(PseudoCleanPairs(clouds, epochs=30, centred=False), batch_size=None))
    fresh = torch.from_numpy(noisy_sphere(rng)).float()
    with torch.no_grad():
        # The target's mean keeps σ²/(σ²+s²) = 0.66 of the noise with s = 0.014: no network of this prior gets below it.
        assert rms_error(network(fresh)) < 0.8 * rms_error(fresh)


def test_every_epoch_draws_anew_and_one_seed_gives_one_series(rng: np.random.Generator) -> None:
    clouds = [noisy_sphere(rng, 300) for _ in range(3)]
    first, again = (list(PseudoCleanPairs(clouds, epochs=2, seed=4)) for _ in range(2))
    assert len(first) == 6
    for (noisy, clean), (noisy_again, clean_again) in zip(first, again, strict=True):
        assert torch.equal(noisy, noisy_again)
        assert torch.equal(clean, clean_again)
    same = [clean for noisy, clean in first if torch.equal(noisy, first[0][0])]
    assert len(same) == 2
    assert not torch.equal(*same)


def test_workers_share_an_epoch_and_change_nothing(rng: np.random.Generator) -> None:
    pairs = PseudoCleanPairs([noisy_sphere(rng, 200) for _ in range(4)], epochs=1)
    alone = sorted(float(clean.sum()) for _, clean in pairs)
    shared = sorted(float(clean.sum()) for _, clean in DataLoader(pairs, batch_size=None, num_workers=2))
    assert shared == alone


def test_what_passes_for_clean_is_another_noisy_point_within_the_patch(rng: np.random.Generator) -> None:
    points = noisy_sphere(rng) * 40 + 1e5
    clean = pseudo_clean(points, rng=rng)
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    moved = np.linalg.norm(clean - points, axis=1)
    assert (moved > 0).mean() > 0.99  # all but those without a neighbour
    assert moved.max() <= 0.05 * diagonal
    assert np.isin(clean.view("V24"), points.view("V24")).all()
    narrow = pseudo_clean(points, prior=Prior(0.02 * diagonal), rng=rng)
    assert np.linalg.norm(narrow - points, axis=1).max() <= 0.02 * diagonal


@pytest.mark.parametrize("n", [0, 1])
def test_next_to_no_points_are_their_own_targets(n: int, rng: np.random.Generator) -> None:
    np.testing.assert_array_equal(pseudo_clean(np.zeros((n, 3)), rng=rng), np.zeros((n, 3)))
