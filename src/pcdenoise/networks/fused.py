"""The projection network's inference in compiled code, several times as fast as layer by layer in torch.

It is there where a C compiler was when the program was installed; elsewhere torch does the same (projection.py). Both agree to
float32's rounding. Not here: the arithmetic (fused.c), neighbour search, blocks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from pcdenoise.networks.projection import Planes, ProjectionNetwork, Stage

try:
    from pcdenoise.networks import _fused
except ImportError:
    IS_BUILT = False
else:
    IS_BUILT = True

CHANNELS, MOST_NEIGHBOURS = 32, 64
"""What the compiled code is made for."""


@dataclass(frozen=True)
class Surroundings:
    """M points that look at K sources each: points (M, 3), sources (N, 3) float64, index (M, K) int32, count (N,) or None."""

    points: Tensor
    sources: Tensor
    index: Tensor
    count: Tensor | None
    noise: float


def runs(network: ProjectionNetwork) -> bool:
    """Whether the compiled code can run this network now: nobody learns, and it has the sizes that the code is made for."""
    sizes = network.config
    fits = sizes.channels == CHANNELS and sizes.neighbours <= MOST_NEIGHBOURS
    return fits and not torch.is_grad_enabled() and next(network.parameters()).dtype == torch.float32 and IS_BUILT


def looking(around: Surroundings, stage: Stage | None, planes: Planes, features: Tensor) -> Callable[[slice], None]:
    """A function that writes some rows' tangent planes and, for a stage, first features (M, C); threads may share it."""
    embedding = None if stage is None else _packed(stage.embed)
    given = _given(around)

    def look(rows: slice) -> None:
        _fused.look(given, rows.start, rows.stop, _at(embedding), _at(planes.normal), _at(planes.shape), _at(features))

    return look


def talking(
    around: Surroundings,
    stage: Stage,
    rounds: slice,
    normals: tuple[Tensor, Tensor],
    heard: Tensor,
    before: Tensor,
    features: Tensor,
    moves: Tensor | None,
) -> Callable[[slice], None]:
    """A function that writes some rows' features (M, C) after these rounds of messages and, into `moves` (M, 3), their step.

    normals: the points' (M, 3) and the sources' (N, 3); heard (R, N, C): what the sources say in each round; before (M, C):
    features so far. Threads may share it.
    """
    layers = stage.exchanges[rounds]
    parts = [part for layer in layers for part in (layer.edge, layer.own, layer.message, layer.update, layer.norm)]
    weights = torch.cat([_packed(part) for part in parts])
    head = None if moves is None else torch.cat([stage.step.head.weight.flatten(), stage.step.head.bias])
    given = _given(around)

    def talk(rows: slice) -> None:
        _fused.talk(
            given, rows.start, rows.stop, _at(normals[0]), _at(normals[1]),
            _at(weights), len(layers), _at(heard), heard[0].numel(), _at(before), _at(features), _at(head), _at(moves),
        )  # fmt: skip

    return talk


def _packed(layer: nn.Module) -> Tensor:
    """A layer's weights as (inputs, outputs), then its bias if it has one."""
    return torch.cat([parameter.detach().t().flatten() for parameter in layer.parameters()])


def _given(around: Surroundings) -> _fused.Surroundings:
    points, sources, index, count = map(_at, (around.points, around.sources, around.index, around.count))
    return points, sources, index, count, around.index.shape[1], around.noise


def _at(values: Tensor | None) -> int:
    """The address of dense values, 0 for none."""
    if values is None:
        return 0
    assert values.is_contiguous()
    return values.data_ptr()
