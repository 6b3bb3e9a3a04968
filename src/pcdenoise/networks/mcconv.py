"""The network of Total Denoising: Monte Carlo convolutions over Poisson-disk levels. Not here: the convolutions (convolution.py).

Hermosilla, Ritschel, Ropinski, "Total Denoising: Unsupervised Learning of 3D Point Cloud Cleaning" (2019), Implementation.
Lengths are shares of the unit of the network's frame: the cloud's bounding-box diagonal or, for real scans, some metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from pcdenoise.cloud.sampling import poisson_disk
from pcdenoise.cloud.scan import Points
from pcdenoise.networks.convolution import MonteCarloConvolution, receptive_fields

FIRST_RADIUS, SECOND_RADIUS = 0.05, 0.10
"""Receptive fields of the first and second level; their Poisson-disk radii are half of that."""
LONGEST_MOVE = 0.05
"""Along each axis."""
_MOMENTUM = 0.05  # of the running statistics; the released 0.01 still remembers its start after a few hundred steps


@dataclass(frozen=True)
class MCConvConfig:
    """width: channels of the first level. sampled: neighbours that stand for all, or None for all and the literal density.

    Width 51 has the 25 000 parameters that the paper names; 64, as released, has 35 840.
    unit: what a length of one stands for, in the unit of the scans that were learned from; None for the bounding-box diagonal.
    """

    width: int = 51
    sampled: int | None = 48
    dropout: float = 0.2
    unit: float | None = None


PAPER = MCConvConfig()
RELEASED = MCConvConfig(width=64, sampled=None)


class MCConvNetwork(nn.Module):
    """Positions to displacements: two levels down, two up, one skip. Never sees colour."""

    def __init__(self, config: MCConvConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.encode1 = MonteCarloConvolution(1, width)
        self.mix1 = Mix(width, 2 * width, config.dropout)
        self.encode2 = MonteCarloConvolution(2 * width, 2 * width, depthwise=True)
        self.mix2 = Mix(2 * width, width, config.dropout)
        self.decode2 = MonteCarloConvolution(width, width, depthwise=True)
        self.mix1_again = Mix(2 * width, width, config.dropout)
        self.decode1 = MonteCarloConvolution(width, 3)

    def forward(self, points: Tensor, rng: np.random.Generator | None = None) -> Tensor:
        """(N, 3) displacement of (N, 3) finite points in a frame in which a unit of length is one.

        `rng` draws levels, neighbours and, in training, dropout; None draws the same ones every time. No gradient flows to the
        positions. In training at least two points must stay on the second level.
        """
        rng = np.random.default_rng(0) if rng is None else rng
        return self.decode(self.encode(points, rng), points, rng)

    def encode(self, points: Tensor, rng: np.random.Generator) -> Code:
        """What (N, 3) points look like around each of the first level's points; small, whatever N is."""
        everything = _positions(points)
        first = everything[poisson_disk(everything, FIRST_RADIUS / 2, rng)]
        second = first[poisson_disk(first, SECOND_RADIUS / 2, rng)]
        sampled, device = self.config.sampled, points.device
        down1 = receptive_fields(everything, first, FIRST_RADIUS, sampled, rng).to(device)
        down2 = receptive_fields(first, second, SECOND_RADIUS, sampled, rng).to(device)
        up2 = receptive_fields(second, first, SECOND_RADIUS, sampled, rng).to(device)
        if len(first) == 0:
            return Code(first, torch.zeros(0, self.config.width, device=device))
        features = self.encode1(torch.ones(len(points), 1, device=device), down1)  # (N1, C)
        deep = self.encode2(self.mix1(features, rng), down2)  # (N2, 2C)
        decoded = self.decode2(self.mix2(deep, rng), up2)  # (N1, C)
        return Code(first, self.mix1_again(torch.cat([decoded, features], dim=1), rng))

    def decode(self, code: Code, points: Tensor, rng: np.random.Generator) -> Tensor:
        """(M, 3) displacement of some of the points that were encoded."""
        if len(points) == 0:
            return torch.zeros_like(points)
        up1 = receptive_fields(code.points, _positions(points), FIRST_RADIUS, self.config.sampled, rng).to(points.device)
        return LONGEST_MOVE * torch.tanh(self.decode1(code.features, up1))


class Code(NamedTuple):
    """The first level: points (N1, 3), features (N1, C)."""

    points: Points
    features: Tensor


def _positions(points: Tensor) -> Points:
    positions: Points = points.detach().cpu().double().numpy()
    return positions


class Mix(nn.Module):
    """Normalise, rectify, drop; a linear map of each point's channels; the same again. Statistics are those of the one cloud."""

    def __init__(self, in_channels: int, out_channels: int, dropout: float) -> None:
        super().__init__()
        self.before, self.after = (nn.BatchNorm1d(n, eps=1e-3, momentum=_MOMENTUM) for n in (in_channels, out_channels))
        self.linear = nn.Linear(in_channels, out_channels)
        self.dropout = dropout
        nn.init.xavier_uniform_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, features: Tensor, rng: np.random.Generator) -> Tensor:
        """(M, C_out) from (M, C_in)."""
        mixed = self.linear(self._dropped(self.before(features).relu(), rng))
        return self._dropped(self.after(mixed).relu(), rng)

    def _dropped(self, features: Tensor, rng: np.random.Generator) -> Tensor:
        if not self.training or self.dropout == 0:
            return features
        kept = torch.from_numpy(rng.random(features.shape, dtype=np.float32) >= self.dropout)
        return features * kept.to(features) / (1 - self.dropout)
