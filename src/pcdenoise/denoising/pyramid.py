"""How the projection network is run: raw points to seeds, stages among the seeds, all points landing on their surface.

Coarse to fine in O(N·K), in blocks that fit the cache. Not here: the network itself (networks.projection), passes and stop
rules (denoiser.py).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdenoise.cloud.neighbours import Indices, NeighbourSearch, coordinate_hash
from pcdenoise.cloud.noise_level import NoiseLevel
from pcdenoise.cloud.scan import Points
from pcdenoise.errors import ModelError
from pcdenoise.networks.projection import (
    Edges,
    Planes,
    ProjectionNetwork,
    Stage,
    edge_features,
    edges,
    joined,
    planes,
    point_features,
    trust,
)

T = TypeVar("T")

_APART = {1: 0.52, 2: 0.39, 3: 0.31, 5: 0.23}
"""Share of candidates that remain when none may be among the so many nearest of another (measured)."""
_LANDSCAPE = 11.0
"""Neighbourhoods hold 11·√(points that show the surface) raw points: the balance of noise, which asks for all of them, and of
curvature, which asks for few (measured on shapes that serve for nothing else)."""
BLOCK_POINTS = 2048


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


def coarsen(points: Points, share: float, seed: int = 0, threads: int = -1) -> Seeds:
    """About share * N seeds of (N, 3) finite points in spatial order, spread evenly relative to the local density.

    Candidates are drawn by hash; those that are first among their nearest candidates stay, round by round; every raw point
    then joins its nearest seed. Averaging inside the cells keeps the statistical weight of every raw point.
    """
    apart = max((n for n, left in _APART.items() if left >= share), default=1)
    candidates = points[coordinate_hash(points, seed) < np.uint64(min(share / _APART[apart], 1.0) * float(2**64 - 2**11))]
    if len(candidates) <= apart + 1:
        return Seeds(points, np.ones(len(points)), np.arange(len(points)))
    chosen = candidates[_first_among_nearest(candidates, coordinate_hash(candidates, seed + 1), apart, threads)]
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
    k = network.config.neighbours
    points = torch.from_numpy(seeds)
    weights = None if count is None else torch.from_numpy(count.astype(np.float32))
    features: Tensor | None = None
    stages: list[Tensor] = []
    surface = torch.ones(0)
    for stage in network.among:
        looking = _Looking(points, points, weights, k, noise, block_points, threads)
        own, known = looking.around(stage)
        surface = surface if stages else trust(own, noise)
        features = known if features is None else features + known
        move, features = looking.messages(stage, own, own, features, features, on_block)
        points = _numbers(points + move.double())
        stages.append(points)
    if raw is None or features is None:
        return Descent(stages, surface, None)
    seed_planes = _Looking(points, points, weights, k, noise, block_points, threads).planes()
    landing = torch.from_numpy(raw)
    looking = _Looking(landing, points, weights, k, noise, block_points, threads)
    own, known = looking.around(network.landing)
    move, _ = looking.messages(network.landing, own, seed_planes, known, features, on_block)
    return Descent(stages, surface, _numbers(landing + move.double()))


def _numbers(points: Tensor) -> Tensor:
    """The points. Raises ModelError where one is no number, which only broken weights bring about."""
    if not bool(points.isfinite().all()):
        raise ModelError("the network gave positions that are not numbers; use another model, or --method jet")
    return points


class _Looking:
    """M points that look at their nearest sources, block by block; with a single block nothing is computed twice."""

    def __init__(
        self, points: Tensor, sources: Tensor, count: Tensor | None, k: int, noise: float, block_points: int, threads: int
    ) -> None:
        self.points, self.sources, self.count, self.noise, self.threads = points, sources, count, noise, threads
        index = NeighbourSearch(sources.detach().numpy(), threads).knn(points.detach().numpy(), k)[1]
        self.index = torch.from_numpy(index.astype(np.int32))
        self.blocks = [slice(i, min(i + block_points, len(points))) for i in range(0, len(points), block_points)]
        self._only: Edges | None = None
        self._only_features: tuple[Tensor, Tensor, Tensor] | None = None

    def over_blocks(self, work: Callable[[slice, Edges], T]) -> list[T]:
        """What `work` gives for each block and its edges. Blocks are spread over threads; a block's own work is done by one,
        since threads that wait for each other after every small operation cost more than they do."""
        if len(self.blocks) == 1:
            if self._only is None:
                self._only = self._edges(self.blocks[0])
            return [work(self.blocks[0], self._only)]
        with_gradient = torch.is_grad_enabled()  # known to this thread alone

        def one(block: slice) -> T:
            with torch.set_grad_enabled(with_gradient):
                return work(block, self._edges(block))

        with ThreadPoolExecutor(max(1, self.threads)) as pool:
            return list(pool.map(one, self.blocks))

    def _edges(self, block: slice) -> Edges:
        index = self.index[block].long()
        return edges((self.sources[index] - self.points[block, None]).float(), index, self.count)

    def planes(self) -> Planes:
        """Tangent planes of all points."""
        return joined(self.over_blocks(lambda _, graph: planes(graph)))

    def around(self, stage: Stage) -> tuple[Planes, Tensor]:
        """Tangent planes and first features (M, C) of all points."""

        def look(_: slice, graph: Edges) -> tuple[Planes, Tensor]:
            plane = planes(graph)
            return plane, stage.embed(point_features(graph, plane, self.noise))

        found, known = zip(*self.over_blocks(look), strict=True)
        return joined(found), torch.cat(known)

    def messages(
        self, stage: Stage, own: Planes, theirs: Planes, features: Tensor, sources: Tensor, on_block: Callable[[int], None]
    ) -> tuple[Tensor, Tensor]:
        """(M, 3) moves and (M, C) features after all rounds of a stage; among themselves, points hear of each other's news."""
        among = sources is features
        move = torch.zeros(0)
        for number, layer in enumerate(stage.exchanges, start=1):
            last = number == len(stage.exchanges)
            heard = layer.hear(features if among else sources)
            before = features

            def exchange(block: slice, graph: Edges) -> tuple[Tensor, Tensor]:
                mine = own.block(block)
                edge, a, b = self._features(graph, mine, theirs)
                message, news = layer(edge, graph, before[block], heard)  # noqa: B023
                step = stage.step(message, graph, mine, theirs, a, b) if last else torch.zeros(0, 3)  # noqa: B023
                on_block(block.stop - block.start)
                return news, step

            news, moves = zip(*self.over_blocks(exchange), strict=True)
            features = torch.cat(news)
            move = torch.cat(moves) if last else move
        return move, features

    def _features(self, graph: Edges, mine: Planes, theirs: Planes) -> tuple[Tensor, Tensor, Tensor]:
        if len(self.blocks) > 1:
            return edge_features(graph, mine, theirs, self.noise)
        if self._only_features is None:
            self._only_features = edge_features(graph, mine, theirs, self.noise)
        return self._only_features
