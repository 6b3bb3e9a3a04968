"""The projection network's inference in compiled code: without torch, and several times as fast as layer by layer.

It is there where a C compiler was when the program was installed; elsewhere torch does the same (denoising.pyramid). Both agree
to float32's rounding wherever neighbours span a plane. Not here: the arithmetic (fused.c), the choice of seeds (denoising.seeds).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.blocks import BLOCK_POINTS, address, each_block
from pcdenoise.cloud.neighbours import NeighbourSearch
from pcdenoise.cloud.scan import Points
from pcdenoise.errors import ModelError
from pcdenoise.networks.store import ProjectionSettings, Weights

try:
    from pcdenoise.networks import _fused
except ImportError:
    IS_BUILT = False
else:
    IS_BUILT = True

CHANNELS, MESSAGES, MOST_NEIGHBOURS = 32, (32, 48), 64
"""What the compiled code is made for."""

Values = NDArray[np.float32]
Noise = float | NDArray[np.float64]
"""Standard deviation of the noise at each of some points (M,), or one for all."""


def fits(sizes: ProjectionSettings) -> bool:
    """Whether compiled code is there and made for networks of these sizes."""
    return IS_BUILT and sizes.channels == CHANNELS and sizes.message_channels in MESSAGES and sizes.neighbours <= MOST_NEIGHBOURS


@dataclass(frozen=True)
class _Stage:
    """Weights as fused.c takes them. rounds (R, …), what they hear by (R, C, M), M being the width of a message."""

    embedding: Values
    rounds: Values
    hearing: Values
    head: Values


def _stage(weights: Weights, name: str, n_rounds: int) -> _Stage:
    def packed(layer: str) -> list[Values]:
        """A layer's weights as (inputs, outputs), then its bias if it has one."""
        parts = (weights.get(f"{name}.{layer}.{part}") for part in ("weight", "bias"))
        return [np.ravel(part.T) for part in parts if part is not None]

    rounds = [f"rounds.{number}" for number in range(n_rounds)]
    layers = ("edge", "own", "message", "update", "norm")
    head = f"{name}.step.head"
    return _Stage(
        embedding=np.concatenate(packed("embed")),
        rounds=np.stack([np.concatenate([part for layer in layers for part in packed(f"{r}.{layer}")]) for r in rounds]),
        hearing=np.stack([np.ascontiguousarray(weights[f"{name}.{r}.their.weight"].T) for r in rounds]),
        head=np.concatenate([np.ravel(weights[f"{head}.weight"]), weights[f"{head}.bias"]]),
    )


@dataclass(frozen=True)
class _Surroundings:
    """M points that look at K sources each: points (M, 3), sources (N, 3), index (M, K), count (N,) or None;
    noise (M,)."""

    points: Points
    sources: Points
    index: NDArray[np.int32]
    count: Values | None
    noise: Values
    over: Callable[[Callable[[slice], None], int], None]
    on_block: Callable[[int], None]

    def around(self, stage: _Stage | None) -> tuple[Values, Values, Values]:
        """Normals and shapes (M, 3) of the tangent planes of all points, and their first features (M, C) for a stage."""
        n = len(self.points)
        normals, shapes, features = _empty(n, 3), _empty(n, 3), _empty(n if stage else 0, CHANNELS)
        embedding = None if stage is None else stage.embedding

        def look(rows: slice) -> None:
            _fused.look(self._given, rows.start, rows.stop, _at(embedding), _at(normals), _at(shapes), _at(features))

        self.over(look, n)
        return normals, shapes, features

    def hear(self, hearing: Values, features: Values) -> Values:
        """(R, N, M) what sources say in each round, by (R, C, M) weights, from their features (N, C)."""
        heard = _empty(len(hearing), len(features), hearing.shape[2])
        for weight, said in zip(hearing, heard, strict=True):

            def hear_some(rows: slice) -> None:
                _fused.hear(_at(features), rows.start, rows.stop, _at(weight), _at(said), said.shape[1])  # noqa: B023

            self.over(hear_some, len(features))
        return heard

    def told(
        self, rounds: Values, head: Values | None, normals: tuple[Values, Values], heard: Values, before: Values
    ) -> tuple[Values, Values]:
        """Features (M, C) after these rounds of messages, and the points' step (M, 3) where there is a head.

        normals: the points' (M, 3) and the sources' (N, 3); heard (R, N, …); before (M, C): features so far.
        """
        features, moves = np.empty_like(before), _empty(len(before) if head is not None else 0, 3)

        def talk(rows: slice) -> None:
            _fused.talk(
                self._given, rows.start, rows.stop, _at(normals[0]), _at(normals[1]),
                _at(rounds), len(rounds), _at(heard), heard[0].size, _at(before),
                _at(features), _at(head), _at(moves), heard.shape[2],
            )  # fmt: skip
            self.on_block((rows.stop - rows.start) * len(rounds))

        self.over(talk, len(before))
        return features, moves

    @property
    def _given(self) -> _fused.Surroundings:
        places = address(self.points, np.float64), address(self.sources, np.float64)
        return *places, address(self.index, np.int32), _at(self.count), self.index.shape[1], _at(self.noise)


def descend(
    weights: Weights,
    sizes: ProjectionSettings,
    seeds: Points,
    count: NDArray[np.float64] | None,
    raw: Points | None,
    noise: Noise,
    raw_noise: Noise | None = None,
    *,
    block_points: int = BLOCK_POINTS,
    threads: int = 1,
    on_block: Callable[[int], None] = lambda _: None,
) -> tuple[Points, Values]:
    """Runs the network on (M, 3) seeds and lands (Q, 3) raw points on them, as `denoising.pyramid.descend` does.

    Gives the raw points' places, or the seeds' where there are none, and the shape (M, 3) of the planes around the seeds: their
    standard deviations along the axes. on_block: called with the number of points whenever some are through a round.
    Raises ModelError when a stage gives positions that are not numbers.
    """

    behind = None if count is None else count.astype(np.float32)

    def over(work: Callable[[slice], None], n: int) -> None:
        each_block(work, n, threads, block_points)

    def nearest(points: Points, sources: Points) -> NDArray[np.int32]:
        return NeighbourSearch(sources, threads).nearest(points, sizes.neighbours)

    def looking(points: Points, sources: Points, index: NDArray[np.int32], noise: Noise = noise) -> _Surroundings:
        everywhere = np.ascontiguousarray(np.broadcast_to(np.float32(noise), len(points)))
        return _Surroundings(points, sources, index, behind, everywhere, over, on_block)

    points = np.ascontiguousarray(seeds, np.float64)
    stages = [_stage(weights, f"stages.{number}", n_rounds) for number, n_rounds in enumerate(sizes.rounds)]
    index = nearest(points, points)
    normals, shape, features = looking(points, points, index).around(stages[0])
    for number, stage in enumerate(stages):
        among = looking(points, points, index)
        if number:
            normals, _, known = among.around(stage)
            features = features + known
        for turn in range(len(stage.rounds)):
            rounds, heard = stage.rounds[turn : turn + 1], among.hear(stage.hearing[turn : turn + 1], features)
            head = stage.head if turn + 1 == len(stage.rounds) else None
            features, moves = among.told(rounds, head, (normals, normals), heard, features)
        points = checked_finite(points + moves)
        if raw is not None:  # points that are their own seeds hardly move: they keep their neighbours
            index = nearest(points, points)
    if raw is None:
        return points, shape
    theirs, _, _ = looking(points, points, index).around(None)
    landing, stage = np.ascontiguousarray(raw, np.float64), _stage(weights, "landing", sizes.landing_rounds)
    on_seeds = looking(landing, points, nearest(landing, points), noise if raw_noise is None else raw_noise)
    mine, _, known = on_seeds.around(stage)
    _, moves = on_seeds.told(stage.rounds, stage.head, (mine, theirs), on_seeds.hear(stage.hearing, features), known)
    return checked_finite(landing + moves), shape


def checked_finite(points: Points) -> Points:
    """The points. Raises ModelError where one is no number, which only broken weights bring about."""
    if not np.isfinite(points).all():
        raise ModelError("the network gave positions that are not numbers; use another model, or --method jet")
    return points


def _empty(*shape: int) -> Values:
    return np.empty(shape, np.float32)


def _at(values: Values | None) -> int:
    return address(values, np.float32)
