"""Distinct points on disk, cell by cell and pass by pass, and what lies around them, with a few cells in memory at a time.

Not here: where space is cut (cuts.py), what is done with a cell and when (tiles.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pcdenoise.cloud.blocks import blocks
from pcdenoise.cloud.neighbours import Distances, Identity, Indices, NeighbourSearch, nearest_to, spatial_order
from pcdenoise.cloud.scan import Mask, Points

_CORE_SHARE = 0.47  # of a tile's points are the cell's own, the others its rim
_RIM_RADII = 6.5
"""Width of the rim in radii of the network's neighbourhoods. A pass reaches eight radii at most, but a neighbour's weight is zero
at one radius, so that what lies beyond five does not reach a thousandth of the noise (a test measures it); and where a place is
noisier than the cloud, neighbourhoods are wider, by up to a half."""
_RINGS = 9
"""So many times the nearest of the nearest, in place of a rim: what a pass reaches, and one more for noisier places."""
_FEWEST_IN_TILE = 512
_MEDIUM_TILE = 20_000  # points: a smaller tile takes little memory, whatever cells were asked for
_ASKING = 8  # of the points of a neighbourhood
_ASKED_FOR = 1 << 22  # neighbours at once


def n_own(n_points: int) -> int:
    """How many points of a tile of so many are a cell's own, where density is even."""
    return int(_CORE_SHARE * n_points)


@dataclass(frozen=True)
class Part:
    """Some points (n, 3) where they are after some pass, and their identity (n,)."""

    points: Points
    identity: Identity

    def take(self, rows: Indices | Mask) -> Part:
        """Those of them."""
        return Part(self.points[rows], self.identity[rows])

    def __add__(self, other: Part) -> Part:
        return Part(np.concatenate([self.points, other.points]), np.concatenate([self.identity, other.identity]))


_NOBODY = Part(np.empty((0, 3)), np.empty(0, np.uint64))


@dataclass(frozen=True)
class Cells:
    """The cells of one cloud; iterating gives their numbers.

    FOLDER/start/7.f64 and FOLDER/pass_2/7.f64 as in tiles.py. asked_for: points that a cell was to have; low (3,) and extent: of
    all n_points, the frame of their order in space.
    """

    folder: Path
    n_cells: int
    n_points: int
    asked_for: int
    low: Points
    extent: float
    threads: int

    def __len__(self) -> int:
        return self.n_cells

    def __iter__(self) -> Iterator[int]:
        return iter(range(self.n_cells))

    def part(self, cell: int, number: int) -> Part:
        """The points of a cell, in the order of their hashes, after so many passes."""
        rows = np.fromfile(self.folder / "start" / f"{cell}.f64").reshape(-1, 4)
        identity = np.ascontiguousarray(rows[:, 3]).view(np.uint64)
        if number == 0:
            return Part(np.ascontiguousarray(rows[:, :3]), identity)
        return Part(np.fromfile(self.folder / f"pass_{number}" / f"{cell}.f64").reshape(-1, 3), identity)

    def order(self, points: Points) -> Indices:
        """(N,) the order in which the whole cloud has these points."""
        return spatial_order(points, (self.low, self.extent))

    def nearest(self, centres: Points, k: int, number: int) -> tuple[Part, Distances, Indices]:
        """The points nearest to any of (M, 3) centres after a pass, and for each centre its (M, k) distances and rows of these.

        Of points equally near, those come first that the whole cloud has first; k is cut to all there are.
        """
        low, high = centres.min(axis=0), centres.max(axis=0)
        near, furthest = _NOBODY, math.inf
        distances, rows = np.empty((len(centres), 0)), np.empty((len(centres), 0), np.int64)
        for gap, cell in self._by_distance(low, high, number):
            if gap > furthest:
                break
            part = self.part(cell, number)
            part = part.take(_inside(part.points, np.nextafter(low - furthest, -np.inf), np.nextafter(high + furthest, np.inf)))
            if len(part.points):
                near += part
                near = near.take(self.order(near.points))
                distances, rows = NeighbourSearch(near.points, self.threads).knn(centres, k)
                wanted = np.zeros(len(near.points), bool)
                wanted[rows] = True
                near, rows = near.take(wanted), (np.cumsum(wanted) - 1)[rows]
                furthest = float(distances.max()) if rows.shape[1] == k else math.inf
        return near, distances, rows

    def around(self, centre: Points, most: int) -> Part:
        """So many points nearest to a place, as they are in the file, in the order of the whole cloud."""
        near, furthest = _NOBODY, math.inf
        for gap, cell in self._by_distance(centre, centre, 0):
            if gap > furthest:
                break
            near += self.part(cell, 0)
            near = near.take(nearest_to(centre, near.points, near.identity, most))
            if len(near.points) == most:
                furthest = float(np.linalg.norm(near.points - centre, axis=1).max())
        return near.take(self.order(near.points))

    def tile(self, cell: int, number: int, k: int, ball: float = 0.0) -> tuple[Part, Part]:
        """A cell's own points after a pass, and these followed by what a pass over neighbourhoods of k points hears of.

        That is a rim of even width or, where something dense lies beside a sparse cell and would be in it as a whole, rings.
        ball: the radius of what a pass looks at, where that is a length; then the tile has all within it, however many.
        """
        own = self.part(cell, number)
        if not len(own.points):
            return own, own
        low, high = own.points.min(axis=0), own.points.max(axis=0)
        ordered = own.points[self.order(own.points)]
        radii = NeighbourSearch(ordered, self.threads).knn(ordered, k)[0][:, -1]
        margin = max(_RIM_RADII * float(np.quantile(radii, 0.9)), ball, 1e-12)
        most = math.inf if ball else max(self.asked_for / _CORE_SHARE, _MEDIUM_TILE)
        while True:
            tile, n = own, len(own.points)
            for part in self._rim(cell, number, low - margin, high + margin):
                n += len(part.points)
                tile = tile + part if n <= most else own
            if n >= min(_FEWEST_IN_TILE, self.n_points):
                break
            margin *= 2
        if n > most:
            rings = self._with_rings(own, ordered, number, k)
            if len(rings.points) <= n:
                return own, rings
            tile = sum(self._rim(cell, number, low - margin, high + margin), start=own)  # in a volume, rings are the wider
        return own, self._with_rings(tile, ordered[radii > margin / 2], number, k)

    def _with_rings(self, tile: Part, asking: Points, number: int, k: int) -> Part:
        """A tile followed by the nearest of some of its points, the nearest of these and so on, as far as they are not in it.

        After the first ring some points ask for all, since neighbourhoods lie over each other.
        """
        for _ in range(_RINGS):
            n = len(tile.points)
            for rows in blocks(len(asking), max(1, _ASKED_FOR // k)):
                found = self.nearest(asking[rows], k, number)[0]
                tile += found.take(~np.isin(found.identity, tile.identity))
            asking = tile.points[n:]
            asking = asking[self.order(asking)][:: max(1, k // _ASKING)]
        return tile

    def _rim(self, cell: int, number: int, low: Points, high: Points) -> Iterator[Part]:
        """The points of all other cells in a box after a pass."""
        for other in self:
            if other != cell:
                its_low, its_high = self._box(other, number)
                if (its_low <= high).all() and (its_high >= low).all():
                    part = self.part(other, number)
                    yield part.take(_inside(part.points, low, high))

    def _by_distance(self, low: Points, high: Points, number: int) -> list[tuple[float, int]]:
        """How far from a box the points of each cell are at least, and its number, nearest first; none without points."""
        boxes = [(self._box(cell, number), cell) for cell in self]
        gaps = [(np.maximum(0, np.maximum(its_low - high, low - its_high)), cell) for (its_low, its_high), cell in boxes]
        return sorted((float(np.linalg.norm(gap)), cell) for gap, cell in gaps if np.isfinite(gap).all())

    def _box(self, cell: int, number: int) -> tuple[Points, Points]:
        if (cell, number) not in self._boxes:
            points = self.part(cell, number).points
            empty = np.full(3, np.inf), np.full(3, -np.inf)
            self._boxes[cell, number] = (points.min(axis=0), points.max(axis=0)) if len(points) else empty
        return self._boxes[cell, number]

    @cached_property
    def _boxes(self) -> dict[tuple[int, int], tuple[Points, Points]]:
        return {}


def _inside(points: Points, low: Points, high: Points) -> Mask:
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))
