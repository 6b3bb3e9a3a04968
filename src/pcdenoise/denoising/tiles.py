"""Clouds larger than memory: cells on disk, each cleaned with what lies around it, so that a tile gives what the whole gives.

Here: what is done with each cell, and what is kept for a later `resume`. Not here: how the cells come about (plan.py), what
lies around them (cells.py), scan files (io), one pass (denoiser.py).

All that is global in a pass is found first, streaming, exactly as it is found in memory: the frame's origin, the probes and the
noise level they read, the stop rule. The rest is local, and every draw is a hash of a point's place in the file, so a cell needs
nothing but what the network sees around it.

FOLDER/plan.json        what is cleaned and how, and the cuts between the cells
FOLDER/start/7.f64      distinct points of cell 7: x, y, z in the local frame and the hash of the place in the file, ascending
FOLDER/start/7.i8       for each of its rows, in file order, which of these it is
FOLDER/pass_2/7.f64     where they are after the second pass
FOLDER/done/7.f64       its rows at their new places, 1 for an outlier plus 2 for who stayed, and the uncertainty if asked for
FOLDER/pass_2.json      the noise level after the second pass
FOLDER/drift/7.json     how far its surface moved, see cloud.drift
FOLDER/outliers/7.u1    whether each distinct point is an outlier
FOLDER/std/7.f64        how far each distinct point may still be off
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud import drift
from pcdenoise.cloud.neighbours import Distances, drawn_by
from pcdenoise.cloud.noise_level import NoiseLevel, by_place, estimate_from
from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import classical, denoiser, outliers, risk, taken_off, uncertainty
from pcdenoise.denoising.cells import Cells, Part, n_own
from pcdenoise.denoising.cuts import by_cell, cell_of
from pcdenoise.denoising.denoiser import Progress
from pcdenoise.denoising.plan import Chunks, Plan, plan_in
from pcdenoise.denoising.seeds import share_of_seeds
from pcdenoise.networks.store import Model
from pcdenoise.whole_files import put

BASE_BYTES, POINT_BYTES = 400 << 20, 1100
"""Memory of the program itself, and of each point of the part that is being cleaned: measured where torch
runs the network, with a tenth to spare; compiled code takes three quarters of it."""
_RIM_NEIGHBOURS = 24
_GATHERED = (192, 2048)  # neighbours kept of each probe: most clouds show their surface within the first
_N_LENGTHS = 1_000_000


def needs_the_whole(model: Model | None, config: DenoiseConfig) -> str:
    """What in these settings draws from a whole cloud, so that cells cannot be cleaned one by one; nothing if all is local."""
    if config.unshrink:
        return "--unshrink"
    if config.align_by:
        return "--align-by"
    return "a model of network mcconv" if model is not None and model.config.network == "mcconv" else ""


def needed_bytes(n_points: int) -> int:
    """Memory that cleaning so many points at once takes."""
    return BASE_BYTES + POINT_BYTES * n_points


def points_per_cell(max_bytes: int) -> int:
    """How many points a cell may have, so that it is cleaned within so much memory."""
    return max(10_000, n_own((max_bytes - BASE_BYTES) // POINT_BYTES))


@dataclass(frozen=True)
class Rows:
    """Points of one chunk after cleaning: points (n, 3), outlier (n,), unmoved (n,), std (n,) as of `denoiser.Result`, if any."""

    points: Points
    outlier: Mask
    unmoved: Mask
    std: NDArray[np.float64] | None = None


class Tiles:
    """One cloud on its way through the cells.

    fingerprint: facts that tell this job from another one; what is found in the folder of the same job is not done again.
    """

    def __init__(
        self,
        folder: Path,
        chunks: Chunks,
        model: Model | None,
        config: DenoiseConfig,
        cell_points: int,
        fingerprint: Mapping[str, Any],
    ) -> None:
        self.folder, self.chunks, self.model, self.config = folder, chunks, model, config
        self.threads = config.threads or os.cpu_count() or 1
        job = {**fingerprint, "config": config.model_dump(mode="json", exclude={"threads"})}
        self.job = {**job, "model": model.sha256 if model else None}
        self.cell_points = cell_points
        self.figures: dict[str, Any] = {}
        self.steps: list[dict[str, Any]] = []
        self._gathered: dict[int, dict[bytes, tuple[Distances, Points]]] = {}

    @cached_property
    def plan(self) -> Plan:
        """Counts, frame, cuts and probes; cells are made on the disk if they are not there."""
        return plan_in(self.folder, self.chunks, self.job, self.cell_points, self.config.seed)

    @cached_property
    def cells(self) -> Cells:
        """The distinct points, cell by cell."""
        plan, low = self.plan, np.array(self.plan.low)
        return Cells(self.folder, plan.n_cells, plan.n_distinct, plan.cell_points, low, plan.extent, self.threads)

    def run(self, on_progress: Progress = lambda _task, _share: None) -> None:
        """All passes over all cells, and the figures of a `denoiser.Result`."""
        level = first = self.level(0)
        n_done = 0
        if self.config.outliers != "keep":
            for cell in self.cells:
                self.find_outliers(cell, first.as_read)
                on_progress("outliers", (cell + 1) / len(self.cells))
        most = denoiser.most_passes(self.plan.n_distinct, first, self.config)
        judge = self._judge(first) if most and self.config.iters == "auto" else None
        for number in range(1, most + 1):
            task = "cleaning" if self.config.iters == 1 else f"pass {number}"
            judgement = judge.figures(level) if judge is not None else {}
            if judgement is None:
                break
            for cell in [] if self._is_over(number) else self.cells:
                self.clean(cell, number, level)
                on_progress(task, (cell + 1) / len(self.cells))
            after = self.level(number)
            roughness = {"roughness_before": level.as_read.std, "roughness_after": after.std}
            self.steps.append({"iteration": number, **roughness, **judgement})
            if number > 2:
                shutil.rmtree(self.folder / f"pass_{number - 2}", ignore_errors=True)
            level, n_done = after, number
        if self.config.uncertainty:
            for cell in self.cells:
                self.find_uncertainty(cell, n_done, first.as_read)
        drifts = [self._drift(cell, n_done) for cell in self.cells]
        share = np.array([n for n, _, _ in drifts]) / max(1, self.plan.n_distinct)
        self.figures = {
            "noise": first.std,
            "spacing": first.spacing,
            "is_surface": first.is_surface,
            "iterations": n_done,
            "drift": float(np.sqrt((share * [size**2 for _, size, _ in drifts]).sum())),
            "drift_inward": float((share * [inward for _, _, inward in drifts]).sum()),
            "points_not_finite": self.plan.n_rows - self.plan.n_finite,
            "points_coincident": self.plan.n_finite - self.plan.n_distinct,
            "cells": len(self.cells),
        }

    def _is_over(self, number: int) -> bool:
        """Whether a pass was made before, and removed once others had been made after it."""
        return (self.folder / f"pass_{number}.json").is_file() and not (self.folder / f"pass_{number}").is_dir()

    def rows(self) -> Iterator[Rows]:
        """Every chunk's rows at their new places, in file order; completes the figures. Needs `run` before."""
        origin, n_done = np.array(self.plan.origin), self.figures["iterations"]
        read = np.zeros(len(self.cells), dtype=np.int64)
        lengths: list[NDArray[np.float64]] = []
        width = 4 + self.config.uncertainty
        step = -(-self.plan.n_rows // _N_LENGTHS) or 1
        n_unmoved = n_outliers = 0
        longest = 0.0
        for cell in self.cells:
            self._finish(cell, n_done)
        for chunk in self.chunks():
            finite = np.flatnonzero(np.isfinite(chunk).all(axis=1))
            std = np.full(len(chunk), np.nan) if self.config.uncertainty else None
            result = Rows(chunk.copy(), np.zeros(len(chunk), bool), np.ones(len(chunk), bool), std)
            for cell, those in by_cell(cell_of(chunk[finite] - origin, self.plan.cuts)):
                path = self.folder / "done" / f"{cell}.f64"
                done = np.fromfile(path, count=width * len(those), offset=8 * width * read[cell]).reshape(-1, width)
                read[cell] += len(those)
                rows, unmoved = finite[those], done[:, 3] >= 2
                result.outlier[rows], result.unmoved[rows] = done[:, 3] % 2 == 1, unmoved
                result.points[rows[~unmoved]] = done[~unmoved, :3] + origin
                if std is not None:
                    std[rows] = done[:, 4]
            length = np.linalg.norm(result.points[finite] - chunk[finite], axis=1)
            lengths.append(length[::step])
            longest = max(longest, float(length.max(initial=0.0)))
            n_unmoved, n_outliers = n_unmoved + int(result.unmoved.sum()), n_outliers + int(result.outlier.sum())
            yield result
        some = np.concatenate(lengths) if self.plan.n_finite else np.zeros(1)
        self.figures |= {
            "move_median": float(np.median(some)),
            "move_p99": float(np.quantile(some, 0.99)),
            "move_max": longest,
            "points_left_alone": n_unmoved,
            **({"outliers": n_outliers} if self.config.outliers != "keep" else {}),
        }

    def level(self, number: int) -> NoiseLevel:
        """The noise after so many passes, read at the same probes as in memory."""
        path = self.folder / f"pass_{number}.json"
        plan = self.plan
        if path.is_file():
            return NoiseLevel(**json.loads(path.read_text()))
        probed, keys = np.array(plan.probes).reshape(-1, 3), np.array(plan.probe_keys, np.uint64)
        for cell, those in by_cell(cell_of(probed, plan.cuts)):
            part = self.cells.part(cell, number)
            drawn = drawn_by(part.identity, self.config.seed)
            order = np.argsort(drawn)
            probed[those] = part.points[order[np.searchsorted(drawn, keys[those], sorter=order)]]
        self._gathered = {k: {} for k in _GATHERED}

        def around(centres: Points, k: int) -> tuple[Distances, Points]:
            kept = self._gathered[next(n for n in _GATHERED if n >= k)]
            missing = np.array([centre.tobytes() not in kept for centre in centres])
            if missing.any():
                most = min(next(n for n in _GATHERED if n >= k), plan.n_distinct)
                for _, those in by_cell(cell_of(centres[missing], plan.cuts)):  # near each other, so that few cells are read
                    asked = centres[missing][those]
                    near, distances, rows = self.cells.nearest(asked, most, number)
                    kept.update(
                        {centre.tobytes(): pair for centre, *pair in zip(asked, distances, near.points[rows], strict=True)}
                    )
            pairs = [kept[centre.tobytes()] for centre in centres]
            return np.stack([distances[:k] for distances, _ in pairs]), np.stack([near[:k] for _, near in pairs])

        found = estimate_from(probed, plan.n_distinct, around, None if number else self.config.noise)
        self._gathered = {}
        if number == 0:
            model = self.model if self.config.method == "network" else None
            found = taken_off.level_by(found, probed, self._sample, model, self.config.seed, self.threads)
        put(path, json.dumps(asdict(found)).encode())
        return found

    def _judge(self, level: NoiseLevel) -> denoiser.Judge:
        """The points that stand for the whole cloud: those nearest to the first of all probes, as in memory."""
        points, identity = self._sample(np.array(self.plan.probes[0]), risk.MOST_POINTS)
        some = risk.Risk(points, identity, level.as_read, self.config.seed, self.threads)
        return denoiser.Judge(some, level, self.plan.diagonal, self.model, self.config, self.threads)

    def _sample(self, centre: Points, most: int) -> taken_off.Sample:
        around = self.cells.around(centre, most)
        return around.points, around.identity

    def _drift(self, cell: int, number: int) -> tuple[int, float, float]:
        """How many points a cell has, and how far its surface moved in all passes, at all and inward."""
        path = self.folder / "drift" / f"{cell}.json"
        if not path.is_file():
            start = self.cells.part(cell, 0).points
            moved = start if number == 0 else denoiser.limited(start, self.cells.part(cell, number).points, self.config)
            found = drift.measure(start, moved, self.config.seed, self.threads)
            put(path, json.dumps([len(start), found.size, found.inward]).encode())
        n, size, inward = json.loads(path.read_text())
        return n, size, inward

    def clean(self, cell: int, number: int, level: NoiseLevel) -> None:
        """Pass `number` over one cell, from what pass `number - 1` left there and around; nothing if that is done already."""
        path = self.folder / f"pass_{number}" / f"{cell}.f64"
        if path.is_file():
            return
        own, tile = self._tile(cell, number - 1)
        order = self.cells.order(tile.points)
        moved = denoiser.one_pass(
            tile.points[order], tile.identity[order], level, self.plan.diagonal, self.model, self.config, self.threads
        )
        back = np.empty_like(tile.points)
        back[order] = moved
        put(path, back[: len(own.points)].tobytes())

    def find_outliers(self, cell: int, level: NoiseLevel) -> None:
        """Marks the outliers of one cell; nothing if that is done already."""
        path = self.folder / "outliers" / f"{cell}.u1"
        if not path.is_file():
            own, tile = self._tile(cell, 0)
            order = self.cells.order(tile.points)
            found = np.zeros(len(order), bool)
            found[order] = outliers.find(tile.points[order], level=level, threads=self.threads)
            put(path, found[: len(own.points)].tobytes())

    def find_uncertainty(self, cell: int, number: int, level: NoiseLevel) -> None:
        """How far the points of one cell may still be off after that pass; nothing if that is done already."""
        path = self.folder / "std" / f"{cell}.f64"
        if path.is_file():
            return
        own, tile = self._tile(cell, number)
        std = np.full(len(own.points), np.nan)
        if level.is_surface:
            measured, around = self._tile(cell, 0)
            order, noise = self.cells.order(around.points), np.empty(len(around.points))
            noise[order] = by_place(around.points[order], around.identity[order], level, self.threads)
            start, cleaned = measured.points, tile.points[self.cells.order(tile.points)]
            final = start if number == 0 else denoiser.limited(start, own.points, self.config)
            std = uncertainty.estimate(cleaned, start, own.points, final, noise[: len(start)], self.threads)
        put(path, std.tobytes())

    def _tile(self, cell: int, number: int) -> tuple[Part, Part]:
        """A cell's own points after a pass, and these followed by what lies around, as of `Cells.tile`."""
        level = self.level(number)
        return self.cells.tile(cell, number, 1 + self._neighbours(level), self._ball(level))

    def _neighbours(self, level: NoiseLevel) -> int:
        """How many nearest points a pass looks at, at that noise."""
        if self.config.method != "network":
            return self.config.neighbours or max(_RIM_NEIGHBOURS, classical.neighbourhood_size(level, 2))
        return max(_RIM_NEIGHBOURS, round(self._looked_at / share_of_seeds(level, self._looked_at)))

    @property
    def _looked_at(self) -> int:
        return int(getattr(self.model.config.settings, "neighbours", _RIM_NEIGHBOURS)) if self.model else _RIM_NEIGHBOURS

    def _ball(self, level: NoiseLevel) -> float:
        """Radius of what a pass looks at, where that is a length: in the bilateral filter."""
        if self.config.method != "bilateral":
            return 0.0
        return classical.ball_radius(level) if self.config.radius is None else self.config.radius * self.plan.diagonal

    def _finish(self, cell: int, number: int) -> None:
        """Writes the new places of a cell's rows, in file order; nothing if that is done already."""
        path = self.folder / "done" / f"{cell}.f64"
        if path.is_file():
            return
        start = self.cells.part(cell, 0).points
        moved = start if number == 0 else denoiser.limited(start, self.cells.part(cell, number).points, self.config)
        done = np.zeros((len(start), 4 + self.config.uncertainty))
        done[:, :3], done[:, 3] = moved, 2 * (moved == start).all(axis=1)
        if self.config.outliers != "keep":
            done[:, 3] += np.fromfile(self.folder / "outliers" / f"{cell}.u1", bool)
        if self.config.uncertainty:
            done[:, 4] = np.fromfile(self.folder / "std" / f"{cell}.f64")
        put(path, done[np.fromfile(self.folder / "start" / f"{cell}.i8", np.int64)].tobytes())

    def remove(self) -> None:
        """Removes the work folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
