"""Who is near whom: spatial order, nearest neighbours, how they lie, pairs within a radius. Not here: what is done with them.

Neighbours are found by compiled code (neighbours.c) where a C compiler was when the program was installed, else by SciPy, whose
import alone takes as long as a small scan; so it is imported where it is used.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.blocks import address, each_block
from pcdenoise.cloud.scan import Points

try:
    from pcdenoise.cloud import _neighbours
except ImportError:
    IS_BUILT = False
else:
    IS_BUILT = True

Indices = NDArray[np.int64]
Distances = NDArray[np.float64]
Identity = NDArray[np.uint64]
"""(N,) the `coordinate_hash` of where points were in the file: a part of a cloud draws by it as the whole does, in any pass."""

PAIRS_AT_ONCE = 2**20
"""About how many pairs are in memory at a time."""
_QUERIES = 1 << 12  # answered in a row by one thread
_BITS = 21  # per axis: three axes fill 63 bits of one Morton code


def spatial_order(points: Points, frame: tuple[Points, float] | None = None) -> Indices:
    """(N,) permutation of (N, 3) finite points along a Morton curve, so that near points are near in memory.

    A k-d tree over points in this order is built and queried three to four times faster than over random order, and of
    neighbours that are equally near the first counts. frame: lowest corner (3,) and extent of the cube that the curve fills,
    their own if not given: a part of a cloud lies in the order of the whole if it is in the frame of the whole.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low = points.min(axis=0)
    low, extent = frame or (low, float((points.max(axis=0) - low).max()))
    cells = np.clip((points - low) / (extent or 1.0) * (2**_BITS - 1), 0, 2**_BITS - 1).astype(np.uint64)
    code = _spread_bits(cells[:, 0]) << np.uint64(2) | _spread_bits(cells[:, 1]) << np.uint64(1) | _spread_bits(cells[:, 2])
    order: Indices = np.argsort(code, kind="stable")
    return order


def nearest_to(centre: Points, points: Points, identity: Identity, most: int) -> Indices:
    """Rows, ascending, of so many of (N, 3) points nearest to a place; of those equally far, the ones of least identity (N,)."""
    if most >= len(points):
        return np.arange(len(points))
    squared = ((points - centre) ** 2).sum(axis=1)
    furthest = np.partition(squared, most - 1)[most - 1]
    inside, rim = np.flatnonzero(squared < furthest), np.flatnonzero(squared == furthest)
    rim = rim[np.argsort(identity[rim], kind="stable")[: most - len(inside)]]
    return np.sort(np.concatenate([inside, rim]))


def _spread_bits(value: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Puts two zero bits between any two of the lowest 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        value = (value | value << np.uint64(shift)) & np.uint64(mask)
    return value


class NeighbourSearch:
    """A k-d tree over (N, 3) finite points; fastest when they, and those who ask, are in `spatial_order`."""

    def __init__(self, points: Points, threads: int = -1) -> None:
        self.n_points = len(points)
        self.threads = threads
        self._tree: _OurTree | _SciPyTree = (_OurTree if IS_BUILT and 0 < len(points) < 2**31 else _SciPyTree)(points)

    def knn(self, queries: Points, k: int) -> tuple[Distances, Indices]:
        """(M, k) distances and row numbers of the nearest points, nearest first; k is cut to N. Needs N >= 1."""
        shape = len(queries), min(k, self.n_points)
        distances, indices = np.empty(shape), np.empty(shape, np.int64)
        self._answer(queries, indices, distances)
        return distances, indices

    def nearest(self, queries: Points, k: int) -> NDArray[np.int32]:
        """(M, k) row numbers alone, at a third of the memory."""
        indices = np.empty((len(queries), min(k, self.n_points)), np.int32)
        self._answer(queries, indices, None)
        return indices

    def _answer(self, queries: Points, indices: NDArray[np.signedinteger], distances: Distances | None) -> None:
        queries = np.ascontiguousarray(queries, np.float64)
        if queries.ndim != 2 or queries.shape[1] != 3:
            raise ValueError(f"queries must be (M, 3), got {queries.shape}")
        each_block(lambda rows: self._tree.answer(queries, rows, indices, distances), len(queries), self.threads, _QUERIES)


class _SciPyTree:
    """Gives equally near points in any order."""

    def __init__(self, points: Points) -> None:
        from scipy.spatial import cKDTree

        self._tree = cKDTree(points, balanced_tree=False, compact_nodes=False)

    def answer(self, queries: Points, rows: slice, indices: NDArray[np.signedinteger], distances: Distances | None) -> None:
        """Writes the rows of the points nearest to some of (M, 3) queries, and their distances if wanted, into (M, k) arrays."""
        found = self._tree.query(queries[rows], k=np.arange(1, indices.shape[1] + 1))
        indices[rows] = found[1]
        if distances is not None:
            distances[rows] = found[0]


class _OurTree:
    """Gives equally near points by row."""

    def __init__(self, points: Points) -> None:
        points = np.ascontiguousarray(points, np.float64)
        self._axes, self._rows = np.empty((3, len(points))), np.empty(len(points), np.int32)
        self._boxes = np.empty((_neighbours.n_nodes(len(points)), 6))
        self._parts = address(self._axes, np.float64), address(self._rows, np.int32), address(self._boxes, np.float64)
        _neighbours.plant(address(points, np.float64), len(points), *self._parts)

    def answer(self, queries: Points, rows: slice, indices: NDArray[np.signedinteger], distances: Distances | None) -> None:
        """As `_SciPyTree.answer`."""
        is_narrow = indices.dtype == np.int32
        narrow, wide = (address(indices, np.int32), 0) if is_narrow else (0, address(indices, np.int64))
        tree = *self._parts, len(self._rows)
        asked = address(queries, np.float64), rows.start, rows.stop, indices.shape[1]
        _neighbours.nearest(tree, *asked, address(distances, np.float64), narrow, wide)


def knn(points: Points, k: int, queries: Points | None = None, threads: int = -1) -> tuple[Distances, Indices]:
    """(M, k) distances and row numbers of the k points nearest to each query, nearest first; k is cut to N.

    Without queries the points ask about themselves, and each one finds itself (or an exact duplicate) first.
    Works in any order of rows and pays one sort for it; finite input only, N >= 1.
    """
    order = spatial_order(points)
    search = NeighbourSearch(points[order], threads)
    query_order = order if queries is None else spatial_order(queries)
    distances, indices = search.knn((points if queries is None else queries)[query_order], k)
    back = np.empty_like(query_order)
    back[query_order] = np.arange(len(query_order))
    return distances[back], order[indices[back]]


def principal_axes(centred: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 3, 3) axes of (M, K, 3) neighbours about their means, as columns, the thinnest first: the normal."""
    axes: NDArray[np.float64] = np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)[1]
    return axes


def radius_pairs(points: Points, radius: float) -> Indices:
    """(P, 2) rows i < j of all pairs of (N, 3) finite points at most `radius` apart, in no particular order."""
    from scipy.spatial import cKDTree

    order = spatial_order(points)
    pairs = order[cKDTree(points[order], balanced_tree=False, compact_nodes=False).query_pairs(radius, output_type="ndarray")]
    return np.sort(pairs, axis=1)


def thinned(sources: Points, targets: Points, radius: float, n: int, rng: np.random.Generator) -> tuple[float, Indices]:
    """A share of the sources, and their rows, such that a target has about n within the radius, or all it has."""
    share = min(1.0, n / _mean_count(sources, targets, radius))
    return share, np.flatnonzero(rng.random(len(sources)) < share) if share < 1 else np.arange(len(sources))


def pairs_within(sources: Points, targets: Points, radius: float) -> Iterator[tuple[Indices, Indices]]:
    """(target, source) rows of all pairs within the radius, sorted by target; some targets at a time, so memory is bounded."""
    from scipy.spatial import cKDTree

    n_targets = max(1, int(PAIRS_AT_ONCE / _mean_count(sources, targets, radius)))
    tree = cKDTree(sources)
    for start in range(0, len(targets), n_targets):
        block = cKDTree(targets[start : start + n_targets])
        found = block.sparse_distance_matrix(tree, radius, output_type="ndarray")
        order = np.argsort(found["i"], kind="stable")
        yield found["i"][order] + start, found["j"][order]


def _mean_count(sources: Points, targets: Points, radius: float) -> float:
    """About how many sources lie within the radius of a target, at least one."""
    from scipy.spatial import cKDTree

    probes = targets[:: max(1, len(targets) // 256)]
    counts = cKDTree(sources).query_ball_point(probes, radius, return_length=True)
    return float(np.maximum(np.mean(counts), 1)) if len(probes) else 1.0


def parts(points: Points, most: int) -> Iterator[Indices]:
    """Rows (M,) of parts of (N, 3) finite points with at most `most` each, halved along the longest side until they fit."""
    waiting = [np.arange(len(points))]
    while waiting:
        rows = waiting.pop()
        if len(rows) <= most:
            yield rows
            continue
        axis = int(np.ptp(points[rows], axis=0).argmax())
        order = np.argpartition(points[rows, axis], len(rows) // 2)
        waiting += [np.sort(rows[order[len(rows) // 2 :]]), np.sort(rows[order[: len(rows) // 2]])]


def coordinate_hash(points: Points, seed: int) -> NDArray[np.uint64]:
    """(N,) pseudo-random numbers that depend on a point's coordinates and the seed alone: not on its row, block or tile."""
    state = np.full(len(points), np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15), dtype=np.uint64)
    for axis in range(3):
        state = _mixed(state ^ (np.ascontiguousarray(points[:, axis]) + 0.0).view(np.uint64))
    return state


def drawn_by(identity: NDArray[np.uint64], seed: int) -> NDArray[np.uint64]:
    """(N,) pseudo-random numbers that depend on numbers that stand for the points, as `coordinate_hash` gives, and the seed."""
    return _mixed(identity ^ _mixed(np.full(1, np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15), dtype=np.uint64)))


def is_drawn(drawn: NDArray[np.uint64], share: float | NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) who belongs to a share of all points, or is drawn with a chance of its own (N,), by numbers as of `drawn_by`."""
    chosen: NDArray[np.bool_] = drawn <= (np.minimum(share, 1.0) * float(2**64 - 2**11)).astype(np.uint64)
    return chosen


def _mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The finaliser of splitmix64: every bit of the result depends on every bit given."""
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    return state ^ state >> np.uint64(31)


def distinct(points: Points) -> tuple[Indices, Indices]:
    """Rows (D,) of one point at each place and, for every row, which of those it coincides with (N,)."""
    return distinct_by(coordinate_hash(points, 0))


def distinct_by(identity: NDArray[np.uint64]) -> tuple[Indices, Indices]:
    """`distinct` for points whose `coordinate_hash` is known."""
    _, rows, place = np.unique(identity, return_index=True, return_inverse=True)
    return rows, place
