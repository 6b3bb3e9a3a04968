"""How the projection network is run: raw points to seeds, stages among the seeds, all points landing on their surface.

Coarse to fine in O(N·K), in blocks that fit the cache. Not here: the network itself (networks.projection), passes and stop
rules (denoiser.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdenoise.cloud.neighbours import Indices, NeighbourSearch, coordinate_hash, drawn_by
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points
from pcdenoise.denoising.blocks import BLOCK_POINTS, each_block, in_blocks
from pcdenoise.errors import ModelError
from pcdenoise.networks import fused
from pcdenoise.networks.projection import (
    Edges,
    Planes,
    ProjectionNetwork,
    Stage,
    at,
    edge_features,
    edges,
    planes,
    point_features,
    trust,
)

_APART = {1: 0.52, 2: 0.39, 3: 0.31, 5: 0.23}
"""Share of candidates that remain when none may be among the so many nearest of another (measured)."""
_LANDSCAPE = 11.0
"""Neighbourhoods hold 11·√(points that show the surface) raw points: the balance of noise, which asks for all of them, and of
curvature, which asks for few (measured on shapes that serve for nothing else)."""


@dataclass(frozen=True)
class Seeds:
    """points (M, 3): means of the raw points in each seed's cell; count (M,) of them; cell (N,): each raw point's seed."""

    points: Points
    count: NDArray[np.float64]
    cell: Indices


def share_of_seeds(level: NoiseLevel, neighbours: int) -> float:
    """Seeds per raw point, so that those the network looks at stand for the right number of raw points; 1 for little noise."""
    share = neighbours / (_LANDSCAPE * level.scale_points**0.5)
    densest = max(_APART.values())
    return min(share, densest) if share < 1.5 * densest else 1.0


def coarsen(points: Points, share: float, seed: int = 0, threads: int = -1, identity: NDArray[np.uint64] | None = None) -> Seeds:
    """About share * N seeds of (N, 3) finite points in spatial order, spread evenly relative to the local density.

    identity (N,): what to draw by in place of the coordinates, for points whose last bits depend on how they were computed.
    Candidates are drawn by hash; those that are first among their nearest candidates stay, round by round; every raw point
    then joins its nearest seed. Averaging inside the cells keeps the statistical weight of every raw point.
    """
    apart = max((n for n, left in _APART.items() if left >= share), default=1)
    drawn = drawn_by(coordinate_hash(points, 0) if identity is None else identity, seed)
    is_candidate = drawn < np.uint64(min(share / _APART[apart], 1.0) * float(2**64 - 2**11))
    candidates = points[is_candidate]
    if len(candidates) <= apart + 1:
        return Seeds(points, np.ones(len(points)), np.arange(len(points)))
    chosen = candidates[_first_among_nearest(candidates, drawn_by(drawn[is_candidate], 1), apart, threads)]
    cell = NeighbourSearch(chosen, threads).knn(points, 1)[1][:, 0]
    count = np.bincount(cell, minlength=len(chosen)).astype(np.float64)
    filled = count > 0
    origin = chosen.mean(axis=0)
    sums = np.stack([np.bincount(cell, weights=column, minlength=len(chosen)) for column in (points - origin).T], axis=1)
    number = np.cumsum(filled) - 1
    return Seeds(sums[filled] / count[filled, None] + origin, count[filled], number[cell])


def _first_among_nearest(candidates: Points, rank: NDArray[np.uint64], apart: int, threads: int) -> Indices:
    """Rows of a maximal set in which none is among the nearest of another: greedy in order of rank, all places at once."""
    n = len(candidates)
    near = NeighbourSearch(candidates, threads).knn(candidates, apart + 1)[1][:, 1:].ravel()
    self_ = np.repeat(np.arange(n), apart)
    ends, others = np.concatenate([self_, near]), np.concatenate([near, self_])
    place = np.empty(n, dtype=np.int64)
    place[np.lexsort((np.arange(n), rank))] = np.arange(n)
    undecided, chosen = np.ones(n, dtype=bool), np.zeros(n, dtype=bool)
    while undecided.any():
        best = np.where(undecided, place, n)
        np.minimum.at(best, ends, np.where(undecided[others], place[others], n))
        first = undecided & (best == place)
        chosen |= first
        undecided &= ~first
        undecided[others[first[ends]]] = False
    return np.flatnonzero(chosen)


@dataclass(frozen=True)
class Descent:
    """What a run of the network gives.

    seeds: their places after every stage, (M, 3) each; trust (M,): see networks.projection; landed: raw points (Q, 3), if any.
    """

    seeds: list[Tensor]
    trust: Tensor
    landed: Tensor | None


def descend(
    network: ProjectionNetwork,
    seeds: Points,
    count: NDArray[np.float64] | None,
    raw: Points | None,
    noise: float,
    *,
    block_points: int = BLOCK_POINTS,
    threads: int = 1,
    on_block: Callable[[int], None] = lambda _: None,
) -> Descent:
    """Runs the network on (M, 3) seeds and lands (Q, 3) raw points on them; differentiable where gradients are on.

    Points stay float64 and only differences between neighbours become float32. The result does not depend on `block_points`.
    Raises ModelError when a stage gives positions that are not numbers.
    """
    points = torch.from_numpy(np.ascontiguousarray(seeds))
    weights = None if count is None else torch.from_numpy(count.astype(np.float32))
    kind = _Fused if fused.runs(network) else _Looking

    def neighbours(points: Tensor, sources: Tensor) -> Tensor:
        search = NeighbourSearch(sources.detach().numpy(), threads)
        return torch.from_numpy(search.nearest(points.detach().numpy(), network.config.neighbours))

    def looking(points: Tensor, sources: Tensor, index: Tensor) -> _Looking | _Fused:
        return kind(fused.Surroundings(points, sources, index, weights, noise), block_points, threads)

    features: Tensor | None = None
    stages: list[Tensor] = []
    surface = torch.ones(0)
    index: Tensor | None = None
    for stage in network.among:
        if index is None or raw is not None:  # points that are their own seeds hardly move: they keep their neighbours
            index = neighbours(points, points)
        among = looking(points, points, index)
        own, known = among.around(stage)
        surface = surface if stages else trust(own, noise)
        features = known if features is None else features + known
        move, features = among.messages(stage, own, features, on_block)
        points = _numbers(points + move.double())
        stages.append(points)
    if raw is None or features is None:
        return Descent(stages, surface, None)
    seed_planes = looking(points, points, neighbours(points, points)).planes()
    landing = torch.from_numpy(np.ascontiguousarray(raw))
    move = looking(landing, points, neighbours(landing, points)).landing(network.landing, seed_planes, features, on_block)
    return Descent(stages, surface, _numbers(landing + move.double()))


def _numbers(points: Tensor) -> Tensor:
    """The points. Raises ModelError where one is no number, which only broken weights bring about."""
    if not bool(points.isfinite().all()):
        raise ModelError("the network gave positions that are not numbers; use another model, or --method jet")
    return points


class _Looking:
    """M points that look at their nearest sources, block by block; with a single block nothing is computed twice."""

    def __init__(self, here: fused.Surroundings, block_points: int, threads: int) -> None:
        self.here, self.block_points, self.threads = here, block_points, threads
        self._only: Edges | None = None
        self._only_features: tuple[Tensor, Tensor, Tensor] | None = None

    def over_blocks(self, work: Callable[[slice, Edges], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """What `work` gives for each block and its edges, put together."""
        return in_blocks(lambda block: work(block, self._edges(block)), len(self.here.points), self.threads, self.block_points)

    @property
    def in_one(self) -> bool:
        """Whether all points are one block, whose edges are kept."""
        return len(self.here.points) <= self.block_points

    def _edges(self, block: slice) -> Edges:
        if self._only is not None:
            return self._only
        index = self.here.index[block]
        graph = edges((at(self.here.sources, index) - self.here.points[block, None]).float(), index, self.here.count)
        if self.in_one:
            self._only = graph
        return graph

    def planes(self) -> Planes:
        """Tangent planes of all points."""
        return Planes(*self.over_blocks(lambda _, graph: planes(graph)))

    def around(self, stage: Stage) -> tuple[Planes, Tensor]:
        """Tangent planes and first features (M, C) of all points."""

        def look(_: slice, graph: Edges) -> tuple[Tensor, ...]:
            plane = planes(graph)
            return *plane, stage.embed(point_features(graph, plane, self.here.noise))

        normal, shape, known = self.over_blocks(look)
        return Planes(normal, shape), known

    def messages(self, stage: Stage, planes: Planes, features: Tensor, on_block: Callable[[int], None]) -> tuple[Tensor, Tensor]:
        """(M, 3) moves and (M, C) features after all rounds of a stage, one by one: points hear of each other's news."""
        move = torch.zeros(0)
        for number, layer in enumerate(stage.exchanges, start=1):
            last = number == len(stage.exchanges)
            heard = layer.hear(features)
            before = features

            def exchange(block: slice, graph: Edges) -> tuple[Tensor, ...]:
                mine = planes.block(block)
                edge, a, b = self._features(graph, mine, planes)
                message, news = layer(edge, graph, before[block], heard)  # noqa: B023
                on_block(block.stop - block.start)
                return (news, stage.step(message, graph, mine, planes, a, b)) if last else (news,)  # noqa: B023

            features, *moves = self.over_blocks(exchange)
            move = moves[0] if last else move
        return move, features

    def landing(self, stage: Stage, theirs: Planes, sources: Tensor, on_block: Callable[[int], None]) -> Tensor:
        """(M, 3) moves of points that hear of sources alone, whose planes and features (N, C) stay: a block does all rounds."""
        heard = [layer.hear(sources) for layer in stage.exchanges]

        def land(block: slice, graph: Edges) -> tuple[Tensor]:
            mine = planes(graph)
            features = stage.embed(point_features(graph, mine, self.here.noise))
            edge, a, b = edge_features(graph, mine, theirs, self.here.noise)
            for layer, said in zip(stage.exchanges, heard, strict=True):
                message, features = layer(edge, graph, features, said)
                on_block(block.stop - block.start)
            return (stage.step(message, graph, mine, theirs, a, b),)

        return self.over_blocks(land)[0]

    def _features(self, graph: Edges, mine: Planes, theirs: Planes) -> tuple[Tensor, Tensor, Tensor]:
        if not self.in_one:
            return edge_features(graph, mine, theirs, self.here.noise)
        if self._only_features is None:
            self._only_features = edge_features(graph, mine, theirs, self.here.noise)
        return self._only_features


class _Fused:
    """What `_Looking` does, in compiled code: no edge is ever written to memory."""

    def __init__(self, here: fused.Surroundings, block_points: int, threads: int) -> None:
        self.here, self.block_points, self.threads = here, block_points, threads

    def planes(self) -> Planes:
        """Tangent planes of all points."""
        return self._seen(None)[0]

    def around(self, stage: Stage) -> tuple[Planes, Tensor]:
        """Tangent planes and first features (M, C) of all points."""
        return self._seen(stage)

    def messages(self, stage: Stage, planes: Planes, features: Tensor, on_block: Callable[[int], None]) -> tuple[Tensor, Tensor]:
        """(M, 3) moves and (M, C) features after all rounds of a stage, one by one: points hear of each other's news."""
        moves = torch.empty(len(features), 3)
        for number, layer in enumerate(stage.exchanges):
            last = number + 1 == len(stage.exchanges)
            heard = layer.hear(features)[None]
            rounds = slice(number, number + 1)
            features = self._told(stage, rounds, planes, planes, heard, features, moves if last else None, on_block)
        return moves, features

    def landing(self, stage: Stage, theirs: Planes, sources: Tensor, on_block: Callable[[int], None]) -> Tensor:
        """(M, 3) moves of points that hear of sources alone, whose planes and features (N, C) stay."""
        heard = torch.stack([layer.hear(sources) for layer in stage.exchanges])
        mine, features = self._seen(stage)
        moves = torch.empty(len(features), 3)
        self._told(stage, slice(None), mine, theirs, heard, features, moves, on_block)
        return moves

    def _seen(self, stage: Stage | None) -> tuple[Planes, Tensor]:
        n = len(self.here.points)
        planes, features = Planes(torch.empty(n, 3), torch.empty(n, 3)), torch.empty(n if stage else 0, fused.CHANNELS)
        look = fused.looking(self.here, stage, planes, features)
        each_block(look, n, self.threads, self.block_points)
        return planes, features

    def _told(
        self, stage: Stage, rounds: slice, mine: Planes, theirs: Planes, heard: Tensor, before: Tensor,
        moves: Tensor | None, on_block: Callable[[int], None],
    ) -> Tensor:  # fmt: skip
        features = torch.empty_like(before)
        talk = fused.talking(self.here, stage, rounds, (mine.normal, theirs.normal), heard, before, features, moves)

        def told(block: slice) -> None:
            talk(block)
            on_block((block.stop - block.start) * len(heard))

        each_block(told, len(before), self.threads, self.block_points)
        return features
