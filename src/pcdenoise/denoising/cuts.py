"""Where space is cut to cells of about equal numbers of points, and which one a point is in. Not here: cleaning (tiles.py)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Points

Cuts = list[Any]
"""A cell's number in a list of its own, or [axis, place, cuts below, cuts from there on]."""


def cuts_of(sample: Points, n_cells: int) -> Cuts:
    """Halves a sample across its longest axis again and again, until there are so many cells."""
    next_number = iter(range(n_cells))

    def cut(points: Points, n: int) -> Cuts:
        if n == 1 or len(points) < 2:
            return [next(next_number)]
        axis = int(np.ptp(points, axis=0).argmax())
        along = points[:, axis]
        place = float(np.quantile(along, (n // 2) / n))
        if place <= along.min():  # where many points share it: those form the lower part
            place = float(along[along > place].min(initial=np.inf))
        below = along < place
        if below.all():
            return [next(next_number)]
        n_below = min(max(round(n * float(below.mean())), 1), n - 1)
        return [axis, place, cut(points[below], n_below), cut(points[~below], n - n_below)]

    return cut(sample, n_cells)


def number_of_cells(cuts: Cuts) -> int:
    """How many there are: fewer than asked for where too few places tell them apart."""
    return 1 if len(cuts) == 1 else number_of_cells(cuts[2]) + number_of_cells(cuts[3])


def cell_of(points: Points, cuts: Cuts) -> NDArray[np.int64]:
    """(N,) the cell that each of (N, 3) points is in."""
    cells = np.empty(len(points), np.int64)

    def place(rows: NDArray[np.int64], cuts: Cuts) -> None:
        if len(cuts) == 1:
            cells[rows] = cuts[0]
            return
        below = points[rows, cuts[0]] < cuts[1]
        place(rows[below], cuts[2])
        place(rows[~below], cuts[3])

    place(np.arange(len(points)), cuts)
    return cells


def by_cell(cells: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each cell that occurs and the rows, ascending, that are in it."""
    order = np.argsort(cells, kind="stable")
    found, first = np.unique(cells[order], return_index=True)
    yield from zip(found.tolist(), np.split(order, first[1:]) if len(found) else [], strict=True)
