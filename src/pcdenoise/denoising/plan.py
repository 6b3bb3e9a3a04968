"""What a job over cells on disk is: counts, frame, probes and cuts, found by reading the cloud twice, which also makes the cells.

All of it is found as it is in memory: the frame's origin and the probes are those of the smallest hashes. Not here: where space
is cut (cuts.py), how cells are read (cells.py), what is done with them (tiles.py, which says what lies in the folder).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pcdenoise.cloud.neighbours import Identity, coordinate_hash, distinct_by, drawn_by
from pcdenoise.cloud.noise_level import N_PROBES
from pcdenoise.cloud.scan import Points, check_extent
from pcdenoise.denoising.cuts import Cuts, by_cell, cell_of, cuts_of, number_of_cells
from pcdenoise.denoising.local_cloud import N_CENTRAL, origin_of
from pcdenoise.whole_files import put

Chunks = Callable[[], Iterable[Points]]
"""Streams the (n, 3) rows of a cloud in file order, the same every time it is called."""

_PLAN = "plan.json"
_LARGER_CELLS = 1.5  # than asked for are still gone on with: how much memory is free changes from run to run


@dataclass(frozen=True)
class Plan:
    """A job and its cells; as plain as JSON, so that it comes back from the disk as it was.

    job: what is cleaned and how; cell_points: points that a cell was to have; origin (3,) of the local frame, which the rest is
    in; cuts: see cuts.py; probes (P, 3): where noise is read, and what they were drawn by (P,); low (3,), extent and diagonal: of
    the box around all finite points, its longest side and its diagonal.
    """

    job: dict[str, Any]
    cell_points: int
    n_rows: int
    n_finite: int
    n_distinct: int
    n_cells: int
    origin: list[float]
    cuts: Cuts
    probes: list[list[float]]
    probe_keys: list[int]
    low: list[float]
    extent: float
    diagonal: float


def plan_in(folder: Path, chunks: Chunks, job: Mapping[str, Any], cell_points: int, seed: int) -> Plan:
    """The plan of a job: the one in the folder if it is of this job, else a new one in an emptied folder, with its cells.

    Raises ScanError for clouds that are too wide, OSError if a plan that is there cannot be read: nothing is removed then.
    """
    plain: dict[str, Any] = json.loads(json.dumps(job))
    return _kept(folder, plain, cell_points) or _made(folder, chunks, plain, cell_points, seed)


def _kept(folder: Path, job: dict[str, Any], cell_points: int) -> Plan | None:
    """The plan in a folder, if it is one of this job and of cells that fit in memory now; OSError if one cannot be read."""
    path = folder / _PLAN
    if not path.is_file():
        return None
    said = path.read_bytes()
    try:
        plan = Plan(**json.loads(said))
        is_same = plan.job == job and plan.cell_points <= _LARGER_CELLS * cell_points
    except (ValueError, TypeError):
        return None
    return plan if is_same else None


def _made(folder: Path, chunks: Chunks, job: dict[str, Any], cell_points: int, seed: int) -> Plan:
    shutil.rmtree(folder, ignore_errors=True)
    start = folder / "start"
    start.mkdir(parents=True)
    central, probed = _Smallest(N_CENTRAL), _Smallest(N_PROBES)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    n_rows = n_finite = 0
    for chunk in chunks():
        usable = _finite(chunk)
        identity = coordinate_hash(usable, 0)
        central.add(identity, usable)
        probed.add(drawn_by(identity, seed), usable)
        n_rows, n_finite = n_rows + len(chunk), n_finite + len(usable)
        low, high = np.minimum(low, usable.min(axis=0, initial=np.inf)), np.maximum(high, usable.max(axis=0, initial=-np.inf))
    if n_finite:
        check_extent(np.stack([low, high]))
    origin = origin_of(central.points)
    low, high = (low - origin, high - origin) if n_finite else (np.zeros(3), np.zeros(3))
    cuts = cuts_of(central.points - origin, max(1, -(-n_finite // cell_points)))
    for chunk in chunks():
        usable = _finite(chunk)
        rows = np.column_stack([usable - origin, coordinate_hash(usable, 0).view(np.float64)])
        for cell, those in by_cell(cell_of(rows[:, :3], cuts)):
            with (start / f"{cell}.f64").open("ab") as file:
                file.write(rows[those].tobytes())
    n_cells = number_of_cells(cuts)
    plan = Plan(
        job=job,
        cell_points=cell_points,
        n_rows=n_rows,
        n_finite=n_finite,
        n_distinct=sum(_sort(start / f"{cell}.f64") for cell in range(n_cells)),
        n_cells=n_cells,
        origin=origin.tolist(),
        cuts=cuts,
        probes=(probed.points - origin).tolist(),
        probe_keys=probed.keys.tolist(),
        low=low.tolist(),
        extent=float((high - low).max()),
        diagonal=float(np.linalg.norm(high - low)),
    )
    put(folder / _PLAN, json.dumps(asdict(plan)).encode())
    return plan


class _Smallest:
    """The n points of smallest key of a stream, each key once."""

    def __init__(self, n: int) -> None:
        self.n, self.keys, self.points = n, np.empty(0, np.uint64), np.empty((0, 3))

    def add(self, keys: Identity, points: Points) -> None:
        if len(self.keys) == self.n:
            few = keys < self.keys[-1]
            keys, points = keys[few], points[few]
        keys, points = np.concatenate([self.keys, keys]), np.concatenate([self.points, points])
        keys, rows = np.unique(keys, return_index=True)
        self.keys, self.points = keys[: self.n], points[rows[: self.n]]


def _finite(chunk: Points) -> Points:
    usable: Points = chunk[np.isfinite(chunk).all(axis=1)]
    return usable


def _sort(path: Path) -> int:
    """Leaves one row for each place of a cell, in the order of the hashes; how many there are."""
    rows = np.fromfile(path).reshape(-1, 4) if path.is_file() else np.empty((0, 4))
    first, place = distinct_by(np.ascontiguousarray(rows[:, 3]).view(np.uint64))
    put(path, rows[first].tobytes())
    put(path.with_suffix(".i8"), place.astype(np.int64).tobytes())
    return len(first)
