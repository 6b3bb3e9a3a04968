"""Monte Carlo convolution on point sets: receptive fields, densities, the two kinds of layer. Not here: networks (mcconv.py).

Hermosilla et al., "Monte Carlo convolution for learning on non-uniformly sampled point clouds" (2018). For an output point i,
its neighbours j within the radius R and d = (x_j - x_i) / R,

    out_i = 1/|N(i)| Σ_j f_j g(d) / p(x_j | i),

where g are multi-layer perceptrons 3→8→8→8, one for every eight outputs, and p is the density of the neighbours around x_j:
a Gaussian kernel estimate of bandwidth 0.2 R from the points of the receptive field.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import chndtr
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pcdenoise.cloud.neighbours import PAIRS_AT_ONCE, Indices, pairs_within, thinned
from pcdenoise.cloud.scan import Points

Floats = NDArray[np.float64]

BANDWIDTH = 0.2
"""Of the density estimate, in radii of the receptive field."""
OUTPUTS_PER_KERNEL = 8
"""Outputs that share the hidden layers of one perceptron."""

_PEAK = (2 * np.pi * BANDWIDTH**2) ** -1.5  # what a point adds to the density at its own place
_REACH = 3 * BANDWIDTH  # beyond which nothing is added
_DENSITY_POINTS = 64  # expected within the reach: more are thinned, which leaves the estimate unbiased
_EDGES_AT_ONCE = 2**14
_EDGES_KEPT = 2**17  # of a layer whose intermediate results stay in memory for the gradient


@dataclass(frozen=True)
class ReceptiveFields:
    """E edges from sources to M targets. target, source (E,) rows; offset (E, 3) source minus target, in radii.

    weight (E,): 1 / (neighbours summed over × density), so that a target's sum of weight × integrand estimates an integral.
    """

    target: Tensor
    source: Tensor
    offset: Tensor
    weight: Tensor
    n_targets: int

    def to(self, device: torch.device) -> ReceptiveFields:
        """The same edges on another device."""
        target, source, offset, weight = (each.to(device) for each in (self.target, self.source, self.offset, self.weight))
        return ReceptiveFields(target, source, offset, weight, self.n_targets)

    def parts(self) -> Iterator[ReceptiveFields]:
        """Some thousand edges after the other."""
        for start in range(0, len(self.target), _EDGES_AT_ONCE):
            part = slice(start, start + _EDGES_AT_ONCE)
            yield ReceptiveFields(self.target[part], self.source[part], self.offset[part], self.weight[part], self.n_targets)


def receptive_fields(
    sources: Points, targets: Points, radius: float, n_sampled: int | None, rng: np.random.Generator
) -> ReceptiveFields:
    """The neighbours of (M, 3) targets among (N, 3) sources within a radius, weighted for Monte Carlo integration.

    A uniform sample of `n_sampled` neighbours stands for all, and the density is estimated once per source from all sources, less
    what would lie outside the receptive field if the surface were flat: linear in N. None keeps all neighbours and the literal
    estimate inside each receptive field, quadratic in their number. On surfaces both agree in expectation.
    """
    edges = _all_edges(sources, targets, radius) if n_sampled is None else _some_edges(sources, targets, radius, n_sampled, rng)
    offset = (sources[edges.source] - targets[edges.target]) / radius
    if n_sampled is None:
        mass = _mass_in_field(edges.target, offset)
    else:
        used, place = np.unique(edges.source, return_inverse=True)
        others = _mass_of_others(sources, used, radius, rng)[place]
        mass = _PEAK + others * _share_in_field(np.linalg.norm(offset, axis=1))
    return ReceptiveFields(
        torch.from_numpy(edges.target),
        torch.from_numpy(edges.source),
        torch.from_numpy(offset.astype(np.float32)),
        torch.from_numpy((edges.stands_for / mass).astype(np.float32)),
        len(targets),
    )


class _Edges(NamedTuple):
    target: Indices
    source: Indices
    stands_for: Floats
    """How many neighbours an edge stands for."""


def _all_edges(sources: Points, targets: Points, radius: float) -> _Edges:
    pairs = list(pairs_within(sources, targets, radius))
    target, source = (np.concatenate([pair[side] for pair in pairs] or [np.zeros(0, dtype=np.int64)]) for side in (0, 1))
    return _Edges(target, source, np.ones(len(target)))


def _some_edges(sources: Points, targets: Points, radius: float, n: int, rng: np.random.Generator) -> _Edges:
    """At most n per target. Where there are many more, the sources are thinned first."""
    share, kept = thinned(sources, targets, radius, 2 * n, rng)
    parts = [_Edges(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for target, source in pairs_within(sources[kept], targets, radius):
        order = np.lexsort((rng.random(len(target)), target))
        chosen = order[np.arange(len(target)) - np.searchsorted(target, target) < n]
        count = np.bincount(target)[target[chosen]]
        parts.append(_Edges(target[chosen], kept[source[chosen]], count / np.minimum(count, n) / share))
    return _Edges(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _mass_in_field(target: Indices, offset: Floats) -> Floats:
    """(E,) Σ_k of the kernel around each edge's source over the sources k of the same target, in radii⁻³."""
    first = np.flatnonzero(np.diff(target, prepend=-1))
    count = np.diff(first, append=len(target))
    mass = np.empty(len(target))
    for size in np.unique(count):
        for rows in np.array_split(first[count == size], max(1, int((count == size).sum() * size**2 / PAIRS_AT_ONCE))):
            edges = rows[:, None] + np.arange(size)
            near = offset[edges]
            norm = (near**2).sum(axis=-1)
            squared = norm[:, :, None] + norm[:, None] - 2 * near @ near.transpose(0, 2, 1)
            mass[edges] = _PEAK * np.exp(-squared / (2 * BANDWIDTH**2)).sum(axis=-1)
    return mass


def _mass_of_others(sources: Points, rows: Indices, radius: float, rng: np.random.Generator) -> Floats:
    """(len(rows),) Σ of the kernel around some sources over all other sources, in radii⁻³, from a thinned cloud."""
    reach = _REACH * radius
    share, kept = thinned(sources, sources[rows], reach, _DENSITY_POINTS, rng)
    mass = np.zeros(len(rows))
    for centre, other in pairs_within(sources[kept], sources[rows], reach):
        squared = ((sources[rows[centre]] - sources[kept[other]]) ** 2).sum(axis=1) / (BANDWIDTH * radius) ** 2
        added = np.where(rows[centre] == kept[other], 0, np.exp(-squared / 2))
        mass += np.bincount(centre, added, minlength=len(rows))
    total: Floats = _PEAK * mass / share
    return total


def _share_in_field(distance: Floats) -> Floats:
    """How much of a flat, even surface that the kernel sees from so many radii off the centre lies inside the receptive field."""
    grid = np.linspace(0, 1, 65)
    share: Floats = np.interp(distance, grid, chndtr(BANDWIDTH**-2, 2, (grid / BANDWIDTH) ** 2))
    return share


class MonteCarloConvolution(nn.Module):
    """One layer from C_in to C_out features. `depthwise`: feature c of the output sees feature c of the input only, C_out = C_in.

    Initial weights as in the released code, whose hidden layers are smaller the more kernels there are.
    """

    def __init__(self, in_channels: int, out_channels: int, *, depthwise: bool = False) -> None:
        super().__init__()
        self.in_channels, self.out_channels, self.depthwise = in_channels, out_channels, depthwise
        self.n_integrands = in_channels if depthwise else in_channels * out_channels
        n_kernels, width = ceil(self.n_integrands / OUTPUTS_PER_KERNEL), OUTPUTS_PER_KERNEL
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(n_kernels, rows, width)) for rows in (3, width, width))
        self.biases = nn.ParameterList(nn.Parameter(torch.zeros(n_kernels, 1, width)) for _ in range(3))
        for weight, fan in zip(self.weights, (3 + width * n_kernels, 2 * width * n_kernels, 2 * width * n_kernels), strict=True):
            nn.init.uniform_(weight, -((6 / fan) ** 0.5), (6 / fan) ** 0.5)

    def forward(self, features: Tensor, fields: ReceptiveFields) -> Tensor:
        """(M, C_out) from (N, C_in): Σ of weight × feature × kernel over edges. Large layers are computed anew for gradients."""
        out = features.new_zeros(fields.n_targets, self.out_channels)
        is_large = len(fields.target) > _EDGES_KEPT and torch.is_grad_enabled()
        for part in fields.parts():
            terms = checkpoint(self._terms, features, part, use_reentrant=False) if is_large else self._terms(features, part)
            out = out.index_add(0, part.target, terms)
        return out

    def _terms(self, features: Tensor, fields: ReceptiveFields) -> Tensor:
        """(E, C_out) of each edge."""
        hidden = fields.offset.expand(len(self.weights[0]), -1, -1)  # (kernels, E, 3)
        for matrix, bias in zip(self.weights[:2], self.biases[:2], strict=True):
            hidden = torch.baddbmm(bias, hidden, matrix).relu_()  # (kernels, E, 8)
        kernel = torch.baddbmm(self.biases[2], hidden, self.weights[2])
        kernel = kernel.transpose(0, 1).flatten(1)[:, : self.n_integrands]  # (E, integrands)
        weighted = features[fields.source] * fields.weight[:, None]  # (E, C_in)
        if self.depthwise:
            return kernel * weighted
        return (kernel.view(-1, self.out_channels, self.in_channels) @ weighted[:, :, None]).squeeze(-1)
