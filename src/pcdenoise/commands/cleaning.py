"""How one scan of `pcdenoise denoise` is cleaned: whole, or in cells on disk where it does not fit in memory.

Not here: options and which file becomes which (denoise.py), groups that are shifted first (aligning.py), how cells are cleaned
(denoising/tiles.py).
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdenoise import __version__
from pcdenoise.commands import aligning, outputs, selection
from pcdenoise.commands.batch import Figures
from pcdenoise.commands.console import Console, counted, figure
from pcdenoise.commands.files import STREAM, Job, format_of
from pcdenoise.commands.undo import (
    columns_to_add,
    refuse_colourless,
    with_colours,
    with_displacement,
    with_outliers,
    with_uncertainty,
)
from pcdenoise.commands.verify import check_drift
from pcdenoise.errors import ScanError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pcdenoise.cloud.scan import Mask, Scan
    from pcdenoise.config import DenoiseConfig
    from pcdenoise.denoising.denoiser import Result
    from pcdenoise.evaluation.report import Page
    from pcdenoise.io import Stream
    from pcdenoise.networks.store import Model

_PIECE_ROWS = 250_000


def chosen_model(name: str | None, settings: DenoiseConfig) -> Model | None:
    """The network to use, or None for a classical filter. Raises ModelError."""
    refuse_model(name, settings)
    if settings.method != "network":
        return None
    from pcdenoise.networks import store

    return store.load(name) if name else store.load()


def refuse_model(name: str | None, settings: DenoiseConfig) -> None:
    """Raises UsageError where a model is named that no one would use."""
    if settings.method != "network" and name is not None:
        raise UsageError(f"--model {name}: --method {settings.method} uses no model; leave one of the two out")


def named_model(model: Model | None) -> dict[str, str]:
    """A model as reports and provenance name it; nothing for a classical filter."""
    return {"model": model.name, "model_sha256": model.sha256} if model else {}


def cells_of(job: Job) -> Path:
    """The folder where a scan's cells lie while it is cleaned; whoever cleans it goes on with what is there already."""
    return job.target.with_name(f".{job.target.name}.cells")


def _check_unchanged(source: Path, before: os.stat_result) -> None:
    """Raises ScanError if somebody wrote into a file that is read several times; one replaced or removed is still read."""
    try:
        now = source.stat()
    except OSError:
        return
    if now.st_ino == before.st_ino and (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
        raise ScanError(f"{source}: changed while it was cleaned; run again once it is complete")


@dataclass(frozen=True, kw_only=True)
class Cleaning:
    """What is the same for every scan of a run: how to clean, what to write, and pages of the last scan for its report.

    overwrite: also where workers may be lost, since a target that is there then is that of a worker that was.
    """

    config: DenoiseConfig
    selection: selection.Selection
    model_name: str | None
    console: Console
    format: str | None
    overwrite: bool
    drop_attributes: bool
    displacement: bool
    max_drift: float | None
    pictures: dict[Path, Path]
    max_bytes: int
    tile: int | None = None
    colour: bool = False
    is_reported: bool = False
    pages: list[Page] = field(default_factory=list)

    @cached_property
    def model(self) -> Model | None:
        """Loaded when it is first asked for, once a scan is read: faults of scans come first."""
        return chosen_model(self.model_name, self.config)

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that shaped the result, by name, for the report and the file's provenance."""
        named = named_model(self.model)
        colour = {"colour": True} if self.colour else {}
        return {**self.config.model_dump(mode="json"), **self.selection.settings, **named, **colour}

    def clean(self, job: Job) -> Figures:
        """Reads one scan, cleans it, writes it with its picture, and returns its figures; in cells on disk if it is too large."""
        from pcdenoise import io

        with io.streamed(job.source, format=format_of(job.source, self.format)) as stream:
            if stream is not None and (self.tile or self._is_too_large(stream)):
                return self._clean_in_cells(job, stream)
        if self.tile:
            self.console.note(f"{job.source}: read whole; only LAS, LAZ, binary PLY and text files are cleaned in cells")
        return self._clean_whole(job)

    def look(self, job: Job) -> Figures:
        """A survey of one scan for a plan, after what `clean` would refuse without any work has been refused."""
        from pcdenoise import io
        from pcdenoise.commands.survey import survey

        with io.streamed(job.source, format=format_of(job.source, self.format)) as stream:
            if stream is not None and (self.tile or self._is_too_large(stream)):
                self._refuse_cells(job, stream)
        scan = io.read(job.source, format=format_of(job.source, self.format))
        self._refuse(job, scan)
        self.selection.masks(scan)
        return survey(scan, seed=self.config.seed, threads=self.config.threads or -1, unround=self.config.unround)

    def _refuse(self, job: Job, scan: Scan) -> None:
        """Raises ScanError for what could not be added to a scan, or not be written, once it is cleaned."""
        from pcdenoise import io

        asked = {
            "--displacement": self.displacement,
            "--uncertainty": self.config.uncertainty,
            "--outliers flag": self.config.outliers == "flag",
        }
        added = columns_to_add(scan, [option for option, is_asked in asked.items() if is_asked])
        if self.colour:
            refuse_colourless(scan)
        if self.config.align_by:
            from pcdenoise.denoising.alignment import check_columns

            check_columns(scan, self.config.align_by)
        written = format_of(job.target, self.format) or io.SUFFIXES.get(job.target.suffix.lower())
        lost = io.losses(replace(scan, attributes=added, source=None), written) if written and added else []
        if unheld := [column for name in added if (column := f"column {name}") in lost]:
            raise ScanError(f"{job.target}: {written} cannot hold {', '.join(unheld)}, which is asked for; write .ply or .las")
        if written and not self.drop_attributes:
            io.refuse_losses(scan.with_attributes(**added), job.target, written)

    def _is_too_large(self, stream: Stream) -> bool:
        from pcdenoise.denoising.tiles import needed_bytes

        return needed_bytes(stream.n_points) > self.max_bytes

    def _refuse_cells(self, job: Job, stream: Stream) -> None:
        """Raises UsageError for what is not done where a scan is cleaned in cells."""
        from pcdenoise import io
        from pcdenoise.denoising.tiles import needs_the_whole

        written = format_of(job.target, self.format) or io.SUFFIXES.get(job.target.suffix.lower(), stream.format)
        global_ = needs_the_whole(self.model, self.config)
        more = "raise --max-memory" if self._is_too_large(stream) else ""
        other = " and ".join(filter(None, ["leave out --tile" if self.tile else "", more]))
        for is_asked, fault in (
            (self.config.outliers == "remove", "--outliers remove: use --outliers flag"),
            (self.colour, "--colour: leave it out"),
            (self.selection != selection.Selection(), "--only-class and --roi: leave them out"),
            (global_, f"{global_}: leave it out"),
            (job.source in self.pictures, "--picture: leave it out"),
            (not io.same_kind(stream.format, written), f"conversion to {written}: keep {stream.format}"),
            (job.target == STREAM, "output to a pipe: write to a file"),
        ):
            if is_asked:
                raise UsageError(
                    f"{job.source}: {stream.n_points:,} points are cleaned in cells, which does not go with {fault}, or {other}"
                )

    def _clean_in_cells(self, job: Job, stream: Stream) -> Figures:
        """The same for a scan that need not fit in memory: rows are streamed, cells lie in a folder beside the target."""
        from pcdenoise import io
        from pcdenoise.denoising.tiles import Tiles, points_per_cell

        started = time.perf_counter()
        self._refuse_cells(job, stream)
        cell_points = self.tile or points_per_cell(self.max_bytes)
        job.target.parent.mkdir(parents=True, exist_ok=True)
        folder = cells_of(job)
        about = job.source.stat()
        for piece in islice(stream.pieces(_PIECE_ROWS), 1):
            self._refuse(job, piece)
            aligning.note_unshifted(str(job.source), piece.points, self.model, self.config, self.console)

        def read() -> Iterator[Scan]:
            for piece in stream.pieces(_PIECE_ROWS):
                _check_unchanged(job.source, about)
                yield piece

        tiles = Tiles(
            folder, lambda: (piece.points for piece in read()), self.model, self.config, cell_points,
            {"source": str(job.source.resolve()), "size": about.st_size, "changed": about.st_mtime_ns, "version": __version__},
        )  # fmt: skip
        self.console.detail(f"{job.source}: {stream.n_points:,} points in cells of {cell_points:,}, kept in {folder}")
        with self.console.progress(job.source.name) as on_progress:
            tiles.run(on_progress)
            check_drift(job.target, tiles.figures["drift"], tiles.figures["noise"], self.max_drift)
            pieces = (
                self._with_columns(scan, scan.moved_to(rows.points), rows.std, rows.outlier)
                for scan, rows in zip(read(), tiles.rows(), strict=True)
            )
            io.write_streamed(
                stream, pieces, job.target, format=format_of(job.target, self.format), overwrite=self.overwrite,
                provenance=outputs.provenance("denoise", self.settings),
            )  # fmt: skip
        tiles.remove()
        figures = {"points": stream.n_points, **tiles.figures, "seconds": round(time.perf_counter() - started, 3)}
        self.console.note(f"{job.target}: {_summary(figures)}")
        return figures

    def _clean_whole(self, job: Job) -> Figures:
        from pcdenoise import io
        from pcdenoise.commands.survey import traps, unit_of
        from pcdenoise.denoising import denoiser
        from pcdenoise.denoising.part import denoise_part

        started = time.perf_counter()
        self.console.detail(f"{job.source}: reading")
        scan = io.read(job.source, format=format_of(job.source, self.format))
        self._refuse(job, scan)
        with self.console.progress(job.source.name) as on_progress:
            movable, seen = self.selection.masks(scan)
            correction = aligning.correction(scan, seen, self.model, self.config, self.console, on_progress)
            if self.selection == selection.Selection():
                result = denoiser.denoise(scan.points, self.model, self.config, on_progress, correction=correction)
            else:
                if not movable.any():
                    self.console.note(f"{job.source}: no point is asked for by {self.selection}; written as it is")
                result = denoise_part(scan.points, movable, seen, self.model, self.config, on_progress, correction=correction)
        for step in result.steps:
            self.console.detail(", ".join(f"{name.replace('_', ' ')} {figure(value)}" for name, value in step.figures.items()))
        check_drift(job.target, result.figures["drift"], result.figures["noise"], self.max_drift)
        job.target.parent.mkdir(parents=True, exist_ok=True)
        io.write(
            self._written(scan, result), job.target, format=format_of(job.target, self.format), overwrite=self.overwrite,
            drop_attributes=self.drop_attributes, provenance=outputs.provenance("denoise", self.settings),
        )  # fmt: skip
        figures = {
            "points": len(scan),
            **result.figures,
            **correction.figures,
            "seconds": round(time.perf_counter() - started, 3),
        }
        if self.config.outliers == "remove":
            figures["points_written"] = len(scan) - figures["outliers"]
        unit = unit_of(scan)
        if picture := self.pictures.get(job.source):
            outputs.save_before_after(
                picture, scan, result.points, notes=picture_notes(result, unit), unit=unit, overwrite=self.overwrite
            )
        if self.is_reported:
            from pcdenoise.evaluation.report import Page

            self.pages[:] = [Page(scan.points, result.points, colours=outputs.colours(scan), unit=unit)]
        for text in traps(scan, figures["noise"] if figures["is_surface"] else None):
            self.console.note(f"{job.source}: {text}")
        self.console.note(f"{job.target}: {_summary(figures)}" + (f"; picture {picture}" if picture else ""))
        return figures

    def _written(self, scan: Scan, result: Result) -> Scan:
        """The moved scan as it is to be written: colours, further columns, without the rows that were not wanted."""
        from pcdenoise import io

        cleaned = scan.moved_to(result.points)
        if self.colour:
            cleaned = with_colours(scan, cleaned, undoable=self.displacement, threads=self.config.threads)
        cleaned = self._with_columns(scan, cleaned, result.std, result.outlier)
        return io.select(cleaned, ~result.outlier) if self.config.outliers == "remove" else cleaned

    def _with_columns(self, scan: Scan, cleaned: Scan, std: NDArray[np.float64] | None, outlier: Mask) -> Scan:
        """The cleaned scan, or some rows of it, with the columns that were asked for; `undo` relies on their order."""
        if self.displacement:
            cleaned = with_displacement(scan.points, cleaned)
        if std is not None:
            cleaned = with_uncertainty(cleaned, std)
        return with_outliers(cleaned, outlier) if self.config.outliers == "flag" else cleaned


def picture_notes(result: Result, unit: str) -> tuple[str, str]:
    """What a picture says under its titles: how far points were off, and how far they moved."""
    if not result.steps:
        return "no surface shows", "nothing moved"
    unit = f" {unit}" if unit else ""
    return f"noise {figure(result.figures['noise'])}{unit}", f"moved by {figure(result.figures['move_median'])}{unit}, median"


def _summary(figures: Figures) -> str:
    """One line for a person: how many points, how noisy they were, how far they moved, what was left alone."""
    parts = [counted(figures["points"], "point")]
    if "points_selected" in figures:
        parts.append(f"{figures['points_selected']:,} selected")
    if "rounded_axis" in figures:
        parts.append(f"{figures['rounded_axis']} was rounded in steps of {figure(figures['rounding_step'])}")
    if "aligned_by" in figures:
        off = f"off by {figure(figures['offset'])}" if figures["offset"] else "which agree"
        parts.append(f"{figures['groups']:,} groups by {figures['aligned_by']} {off}" if figures["groups"] > 1 else "one group")
    parts.append(f"noise {figure(figures['noise'])}" if figures["is_surface"] else "no surface to clean")
    parts.append(f"moved {figure(figures['move_median'])} (median), at most {figure(figures['move_max'])}")
    if figures["points_left_alone"]:
        parts.append(f"{figures['points_left_alone']:,} left alone")
    if figures.get("outliers"):
        parts.append(f"{figures['outliers']:,} outliers" + (" removed" if "points_written" in figures else ""))
    return ", ".join([*parts, f"{figures['seconds']:.1f} s"])
