"""The projection network's inference in compiled code, several times as fast as layer by layer in torch.

It is there where a C compiler was when the program was installed; elsewhere torch does the same (projection.py). Both agree to
float32's rounding. Not here: the arithmetic (fused.c), neighbour search, blocks.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor, nn

from pcdenoise.networks.projection import Planes, ProjectionNetwork, Stage

CHANNELS, MOST_NEIGHBOURS = 32, 64
"""What the compiled code is made for."""
_Integer, _Real, _Address = ctypes.c_int64, ctypes.c_float, ctypes.c_void_p


@dataclass(frozen=True)
class Surroundings:
    """M points that look at K sources each: points (M, 3), sources (N, 3) float64, index (M, K) int32, count (N,) or None."""

    points: Tensor
    sources: Tensor
    index: Tensor
    count: Tensor | None
    noise: float


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL | None:
    """The library, whose calls leave the interpreter to other threads; None where it was not built or is another system's."""
    found = find_spec("pcdenoise.networks._fused")
    if found is None or found.origin is None:
        return None
    try:
        compiled = ctypes.CDLL(found.origin)
    except OSError:
        return None
    around: list[Any] = [*[_Address] * 4, ctypes.c_int, _Real, _Integer, _Integer]
    compiled.look.argtypes = [*around, *[_Address] * 4]
    compiled.talk.argtypes = [*around, *[_Address] * 3, ctypes.c_int, _Address, _Integer, *[_Address] * 4]
    compiled.look.restype = compiled.talk.restype = None
    return compiled


def runs(network: ProjectionNetwork) -> bool:
    """Whether the compiled code can run this network now: nobody learns, and it has the sizes that the code is made for."""
    sizes = network.config
    fits = sizes.channels == CHANNELS and sizes.neighbours <= MOST_NEIGHBOURS
    return fits and not torch.is_grad_enabled() and next(network.parameters()).dtype == torch.float32 and library() is not None


def looking(around: Surroundings, stage: Stage | None, planes: Planes, features: Tensor) -> Callable[[slice], None]:
    """A function that writes some rows' tangent planes and, for a stage, first features (M, C); threads may share it."""
    embedding = None if stage is None else _packed(stage.embed)
    compiled, given = library(), _given(around)
    assert compiled is not None

    def look(rows: slice) -> None:
        compiled.look(*given, rows.start, rows.stop, _at(embedding), _at(planes.normal), _at(planes.shape), _at(features))

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
    compiled, given = library(), _given(around)
    assert compiled is not None

    def talk(rows: slice) -> None:
        compiled.talk(
            *given, rows.start, rows.stop, *map(_at, normals), _at(weights), len(layers), _at(heard), heard[0].numel(),
            _at(before), _at(features), _at(head), _at(moves),
        )  # fmt: skip

    return talk


def _packed(layer: nn.Module) -> Tensor:
    """A layer's weights as (inputs, outputs), then its bias if it has one."""
    return torch.cat([parameter.detach().t().flatten() for parameter in layer.parameters()])


def _given(around: Surroundings) -> Sequence[int | float | None]:
    arrays = (around.points, around.sources, around.index, around.count)
    return *map(_at, arrays), around.index.shape[1], around.noise


def _at(values: Tensor | None) -> int | None:
    """Where dense values lie."""
    if values is None:
        return None
    assert values.is_contiguous()
    return values.data_ptr()
