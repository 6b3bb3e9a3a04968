"""How the projection network is run in torch: stages among the seeds, then all points landing on their surface.

With gradients this is what learning goes through; without them it stands in where there is no compiled code (networks.fused).
In blocks that fit the cache. Not here: the network itself (networks.projection), seeds (seeds.py), passes (network_pass.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdenoise.cloud.blocks import BLOCK_POINTS, blocks, each_block
from pcdenoise.cloud.neighbours import NeighbourSearch
from pcdenoise.cloud.scan import Points
from pcdenoise.networks.fused import Noise, checked_finite
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
)


@dataclass(frozen=True)
class Descent:
    """What a run of the network gives.

    seeds: their places after every stage, (M, 3) each; shape (M, 3): that of the planes around them at first; landed: raw points
    (Q, 3), if any.
    """

    seeds: list[Tensor]
    shape: Tensor
    landed: Tensor | None

    @property
    def last(self) -> Tensor:
        """(F, 3) where the raw points are in the end, or the seeds where every point is its own."""
        return self.seeds[-1] if self.landed is None else self.landed

    @property
    def earlier(self) -> list[Tensor]:
        """(M, 3) places of the seeds after every stage that others follow."""
        return self.seeds[:-1] if self.landed is None else self.seeds


def descend(
    network: ProjectionNetwork,
    seeds: Points,
    count: NDArray[np.float64] | None,
    raw: Points | None,
    noise: Noise,
    raw_noise: Noise | None = None,
    *,
    block_points: int = BLOCK_POINTS,
    threads: int = 1,
    on_block: Callable[[int], None] = lambda _: None,
) -> Descent:
    """Runs the network on (M, 3) seeds and lands (Q, 3) raw points on them; differentiable where gradients are on.

    noise: its standard deviation at the seeds (M,), raw_noise: at the raw points (Q,); or one for all. Points stay float64 and
    only differences between neighbours become float32. The result does not depend on `block_points`.
    Raises ModelError when a stage gives positions that are not numbers.
    """
    points = torch.from_numpy(np.ascontiguousarray(seeds))
    weights = None if count is None else torch.from_numpy(count.astype(np.float32))

    def nearest(points: Tensor, sources: Tensor) -> Tensor:
        search = NeighbourSearch(sources.detach().numpy(), threads)
        return torch.from_numpy(search.nearest(points.detach().numpy(), network.config.neighbours))

    def looking(points: Tensor, sources: Tensor, index: Tensor, noise: Noise = noise) -> _Looking:
        everywhere = torch.as_tensor(noise, dtype=torch.float32).expand(len(points))
        return _Looking(points, sources, index, weights, everywhere, block_points, threads)

    index = nearest(points, points)
    features: Tensor | None = None
    stages: list[Tensor] = []
    shape = torch.empty(0, 3)
    for stage in network.among:
        among = looking(points, points, index)
        own, known = among.around(stage)
        shape = shape if stages else own.shape
        features = known if features is None else features + known
        move, features = among.messages(stage, own, features, on_block)
        points = _numbers(points + move.double())
        stages.append(points)
        if raw is not None:  # points that are their own seeds hardly move: they keep their neighbours
            index = nearest(points, points)
    if raw is None or features is None:
        return Descent(stages, shape, None)
    seed_planes = looking(points, points, index).planes()
    landing = torch.from_numpy(np.ascontiguousarray(raw))
    on_seeds = looking(landing, points, nearest(landing, points), noise if raw_noise is None else raw_noise)
    move = on_seeds.landing(network.landing, seed_planes, features, on_block)
    return Descent(stages, shape, _numbers(landing + move.double()))


def _numbers(points: Tensor) -> Tensor:
    checked_finite(points.detach().numpy())
    return points


class _Looking:
    """M points that look at their nearest sources, block by block; with a single block nothing is computed twice.

    points (M, 3), sources (N, 3) float64; index (M, K) int32: rows of each point's sources; count (N,) or None;
    noise (M,).
    """

    def __init__(
        self, points: Tensor, sources: Tensor, index: Tensor, count: Tensor | None, noise: Tensor, block_points: int, threads: int
    ) -> None:
        self.points, self.sources, self.index, self.count = points, sources, index, count
        self.noise, self.block_points, self.threads = noise, block_points, threads
        self._only: Edges | None = None
        self._only_features: tuple[Tensor, Tensor, Tensor] | None = None

    def over_blocks(self, work: Callable[[slice, Edges], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """What `work` gives for each block and its edges, put together."""
        return _in_blocks(lambda block: work(block, self._edges(block)), len(self.points), self.threads, self.block_points)

    @property
    def in_one(self) -> bool:
        """Whether all points are one block, whose edges are kept."""
        return len(self.points) <= self.block_points

    def _edges(self, block: slice) -> Edges:
        if self._only is not None:
            return self._only
        index = self.index[block]
        graph = edges((at(self.sources, index) - self.points[block, None]).float(), index, self.count)
        if self.in_one:
            self._only = graph
        return graph

    def planes(self) -> Planes:
        """Tangent planes of all points."""
        return Planes(*self.over_blocks(lambda _, graph: planes(graph)))

    def around(self, stage: Stage) -> tuple[Planes, Tensor]:
        """Tangent planes and first features (M, C) of all points."""

        def look(block: slice, graph: Edges) -> tuple[Tensor, ...]:
            plane = planes(graph)
            return *plane, stage.embed(point_features(graph, plane, self.noise[block]))

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
                edge, a, b = self._features(block, graph, mine, planes)
                known, news = layer(edge, graph, before[block], heard, stage.step.head if last else None)  # noqa: B023
                on_block(block.stop - block.start)
                return (news, stage.step(known, graph, mine, planes, a, b)) if last else (news,)  # noqa: B023

            features, *moves = self.over_blocks(exchange)
            move = moves[0] if last else move
        return move, features

    def landing(self, stage: Stage, theirs: Planes, sources: Tensor, on_block: Callable[[int], None]) -> Tensor:
        """(M, 3) moves of points that hear of sources alone, whose planes and features (N, C) stay: a block does all rounds."""
        heard = [layer.hear(sources) for layer in stage.exchanges]

        def land(block: slice, graph: Edges) -> tuple[Tensor]:
            mine, noise = planes(graph), self.noise[block]
            features = stage.embed(point_features(graph, mine, noise))
            edge, a, b = edge_features(graph, mine, theirs, noise)
            for number, (layer, said) in enumerate(zip(stage.exchanges, heard, strict=True), start=1):
                known, features = layer(edge, graph, features, said, stage.step.head if number == len(heard) else None)
                on_block(block.stop - block.start)
            return (stage.step(known, graph, mine, theirs, a, b),)

        return self.over_blocks(land)[0]

    def _features(self, block: slice, graph: Edges, mine: Planes, theirs: Planes) -> tuple[Tensor, Tensor, Tensor]:
        if not self.in_one:
            return edge_features(graph, mine, theirs, self.noise[block])
        if self._only_features is None:
            self._only_features = edge_features(graph, mine, theirs, self.noise)
        return self._only_features


_Work = Callable[[slice], tuple[Tensor, ...]]


def _in_blocks(work: _Work, n: int, threads: int, block_points: int) -> tuple[Tensor, ...]:
    """What `work` gives for the rows of each block, (B, …) each, put together to (n, …); n >= 1.

    Without gradients every result goes to its place at once, so that nothing but the results outlives its block.
    """
    parts = blocks(n, block_points)
    if len(parts) == 1:
        return work(parts[0])
    if torch.is_grad_enabled():  # known to this thread alone
        return tuple(map(torch.cat, zip(*map(work, parts), strict=True)))
    first = work(parts[0])
    whole = tuple(part.new_empty((n, *part.shape[1:])) for part in first)

    def put(block: slice, results: tuple[Tensor, ...]) -> None:
        for place, result in zip(whole, results, strict=True):
            place[block] = result

    def one(block: slice) -> None:
        with torch.no_grad():
            put(block, first if block.start == 0 else work(block))

    each_block(one, n, threads, block_points)
    return whole
