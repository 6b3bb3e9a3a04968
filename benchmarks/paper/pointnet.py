"""Somebody else's denoiser, of PointCleanNet's kind: a PointNet looks at the patch around each point and says where it belongs.

It learns from pairs of noisy and clean clouds and knows nothing of priors; which pairs it is given is the caller's choice.
Rakotosaona et al., "PointCleanNet" (2019), without the spatial transformers. Not here: pairs (learning.upgrade), errors (lab.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import IterableDataset

from pcdenoise.cloud.neighbours import knn
from pcdenoise.cloud.scan import Points
from pcdenoise.denoising.relaxation import without_low_frequencies

PATCH_POINTS, PATCH_RADIUS = 64, 0.05
"""Most neighbours that are looked at, and how far they may be, in diagonals of the bounding box."""
_INFLATION_RADIUS = 0.035
_CENTRES_PER_STEP, _AT_ONCE = 256, 2048


class PatchNet(nn.Module):
    """(B, K, 3) patches around their own centres, in radii, to (B, 3) moves of the centres, in radii."""

    def __init__(self) -> None:
        super().__init__()
        self.each = nn.Sequential(nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 128), nn.ReLU())
        self.whole = nn.Sequential(nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, 3))

    def forward(self, patches: Tensor) -> Tensor:
        moves: Tensor = self.whole(self.each(patches).amax(dim=1)).tanh()
        return moves


def learn(network: PatchNet, pairs: Iterable[tuple[Tensor, Tensor]], steps: int, seed: int) -> None:
    """Its supervised training: mean squared distance to the clean point of the same row, on some patches of a pair per step."""
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    rng = np.random.default_rng(seed)
    for _, (noisy, clean) in zip(range(steps), pairs, strict=False):
        centres = rng.permutation(len(noisy))[:_CENTRES_PER_STEP]
        target = (clean - noisy)[torch.from_numpy(centres)] / PATCH_RADIUS
        optimiser.zero_grad()
        loss = (network(patches(noisy.double().numpy(), centres)) - target).square().sum(dim=1).mean()
        torch.autograd.backward(loss)
        optimiser.step()
        schedule.step()


def one_pass(network: PatchNet, points: Points, diagonal: float) -> Points:
    """(N, 3) points moved once; what they all share of the moves is taken back, as PointCleanNet does against shrinking."""
    unit = points / diagonal
    with torch.no_grad():
        parts = [network(patches(unit, rows)).double().numpy() for rows in _blocks(len(unit))]
    moves = PATCH_RADIUS * np.concatenate(parts)
    kept: Points = without_low_frequencies(unit, moves, _INFLATION_RADIUS, np.random.default_rng(0))
    return points + diagonal * kept


def patches(points: Points, centres: np.ndarray) -> Tensor:
    """(B, K, 3) what is near some of (N, 3) points of diagonal 1; what lies beyond the radius is replaced by the centre."""
    distance, near = knn(points, PATCH_POINTS, points[centres], threads=1)
    offset = (points[near] - points[centres][:, None]) / PATCH_RADIUS
    return torch.from_numpy(np.where(distance[..., None] <= PATCH_RADIUS, offset, 0.0)).float()


def _blocks(n: int) -> Iterator[np.ndarray]:
    return (np.arange(start, min(start + _AT_ONCE, n)) for start in range(0, n, _AT_ONCE))


class CleanPairs(IterableDataset[tuple[Tensor, Tensor]]):
    """Endless epochs of (noisy, clean) float32 tensors whose rows correspond, the noisy ones' diagonal 1."""

    def __init__(self, pairs: list[tuple[Points, Points]], seed: int) -> None:
        super().__init__()
        self.pairs, self.seed = pairs, seed

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        rng = np.random.default_rng(self.seed)
        while True:
            for place in rng.permutation(len(self.pairs)):
                noisy, clean = self.pairs[place]
                low, high = noisy.min(axis=0), noisy.max(axis=0)
                unit = float(np.linalg.norm(high - low))
                yield tuple(torch.from_numpy((points - (low + high) / 2) / unit).float() for points in (noisy, clean))  # type: ignore[misc]
