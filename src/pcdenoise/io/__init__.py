"""Reading and writing scans: one suffix table, one call each way. Not here: any format's details (las, ply, xyz, …).

What was read is written back as it was but for the coordinates that moved: `Scan.source` keeps the file, taken apart.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, Protocol

import numpy as np

from pcdenoise.cloud.scan import Mask, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import e57, files, kitti, las, pcd, ply, ptx, text, xyz
from pcdenoise.io.crs import Crs
from pcdenoise.io.source import changed, portable

SUFFIXES = {
    ".las": "las", ".laz": "laz", ".ply": "ply", ".pcd": "pcd", ".bin": "bin", ".e57": "e57", ".ptx": "ptx",
    ".xyz": "xyz", ".txt": "xyz", ".csv": "xyz", ".asc": "xyz", ".pts": "xyz",
}  # fmt: skip
"""File suffix -> format."""

_MODULES: dict[str, ModuleType] = {
    "las": las, "laz": las, "ply": ply, "pcd": pcd, "bin": kitti, "e57": e57, "ptx": ptx, "xyz": xyz,
}  # fmt: skip
_HEAD = 4096


def is_scan(path: str | os.PathLike[str]) -> bool:
    """Whether the path has a suffix of a scan format."""
    return Path(path).suffix.lower() in SUFFIXES


def read(path: str | os.PathLike[str], *, format: str | None = None) -> Scan:
    """The scan in a file, or on stdin if the path is '-'.

    The format is the one named, else the suffix's, and must be confirmed by the content; stdin is told by its content.
    Raises ScanError if the file is missing, damaged, of another format than it says, or holds fewer points than it claims.
    """
    is_stdin = os.fspath(path) == files.STREAM
    origin = "stdin" if is_stdin else os.fspath(path)
    named = None if is_stdin and format is None else _known(format or _by_suffix(path))
    raw = files.read_bytes(path)
    if not raw:
        raise ScanError(f"{origin}: is empty; check what wrote it")
    found = _sniffed(raw[:_HEAD])
    if named != "bin" and not (found and _MODULES[named or found] is _MODULES[found]):
        content = {"xyz": "text", "": "of no known format"}.get(found, found)
        raise ScanError(
            f"{origin}: is taken for {named or 'a scan'} but its content is {content}; rename it or name its format (--format)"
        )
    scan: Scan = _MODULES[named or found].read(raw, origin)
    return scan


def write(
    scan: Scan,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    overwrite: bool = False,
    drop_attributes: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a scan to a file, whole or not at all, or to stdout if the path is '-' (`format` is needed then).

    provenance  JSON-ready facts on how the scan was made, kept in a LAS VLR, a PLY or PCD comment,
                the XML of an E57; the rest have no place for it.
    Raises ScanError if the target exists (unless `overwrite`), cannot be written, or its format would drop something `losses`
    names (unless `drop_attributes`).
    """
    target = os.fspath(path)
    if format is None and target == files.STREAM:
        raise ScanError("stdout: has no suffix to tell the format by; name the format (--format)")
    named = _known(format or _by_suffix(path))
    if target.lower().endswith(".copc.laz"):
        raise ScanError(f"{target}: rows stay in order, so no COPC octree is written; name the file .laz without .copc")
    if not drop_attributes:
        refuse_losses(scan, path, named)
    with files.written(path, overwrite=overwrite) as file:
        try:
            _encode(scan, file, named, Path(target).suffix.lower(), provenance)
        except ScanError as fault:
            raise ScanError(f"{target}: {fault}") from None


def refuse_losses(scan: Scan, path: str | os.PathLike[str], format: str) -> None:
    """Raises ScanError if writing the scan in a format would drop something."""
    if lost := losses(scan, format):
        other = f" or write .{scan.format}" if not same_kind(format, scan.format) else ""
        fix = f"allow dropping attributes (--drop-attributes){other}"
        raise ScanError(f"{os.fspath(path)}: {format} would drop {', '.join(lost)}; {fix}")


class Stream(Protocol):
    """A file that is read and written in pieces, so that it need not fit in memory; each piece is a scan of some of its rows."""

    n_points: int
    format: str

    def pieces(self, n_rows: int) -> Iterator[Scan]:
        """Scans of at most n_rows rows, in file order. Raises ScanError on damage."""

    def write(self, pieces: Iterable[Scan], file: BinaryIO, *, format: str, provenance: Mapping[str, Any] | None) -> None:
        """Write the pieces, moved or with further columns, as `io.write` would write the whole scan."""


@contextmanager
def streamed(path: str | os.PathLike[str], *, format: str | None = None) -> Iterator[Stream | None]:
    """A file as a stream, or None where it has to be read whole: stdin, PCD, KITTI, E57, PTX, PLY as text or with lists.

    Raises ScanError as `read` does, for what shows without reading the points.
    """
    named = None if os.fspath(path) == files.STREAM or not Path(path).is_file() else _known(format or _by_suffix(path))
    if named not in ("las", "laz", "ply", "xyz") or not Path(path).stat().st_size:
        yield None
        return
    with files.mapped(path) as raw:
        origin, found = os.fspath(path), _sniffed(raw[:_HEAD])
        if not found or _MODULES[found] is not _MODULES[named]:
            yield None  # `read` says what is wrong
        elif found == "xyz":
            yield xyz.XyzStream.of(raw, origin)
        else:
            yield ply.PlyStream.of(raw, origin) if found == "ply" else las.LasStream(raw, origin)


def write_streamed(
    stream: Stream,
    pieces: Iterable[Scan],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    overwrite: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the pieces of a stream to a file, whole or not at all; LAS as LAS or LAZ, else as the format it has."""
    target = os.fspath(path)
    with files.written(path, overwrite=overwrite) as file:
        try:
            stream.write(pieces, file, format=_known(format or _by_suffix(path)), provenance=provenance)
        except ScanError as fault:
            raise ScanError(f"{target}: {fault}") from None


def same_kind(one: str, other: str) -> bool:
    """Whether two formats hold the same, as LAS and LAZ do."""
    return _MODULES[one] is _MODULES[other]


def losses(scan: Scan, format: str) -> list[str]:
    """What writing the scan in a format would drop, in words: columns, faces, CRS, VLRs, … Empty if nothing.

    Comment lines, the header's book-keeping (software, dates, identifiers) and a COPC octree, which moved points outdate, do
    not count.
    """
    module = _MODULES[_known(format)]
    own = scan.source is not None and _MODULES.get(scan.format) is module
    columns = changed(scan) if own else portable(scan.attributes)
    lost = [] if own or scan.source is None else list(scan.source.attachments())
    if module is kitti and not own:
        lost += kitti.coarser(scan.points)
    return lost + [f"column {name}" for name in module.unstorable(columns)]


def select(scan: Scan, keep: Mask) -> Scan:
    """The rows kept, in order, in memory and in what gets written. Raises ScanError if the file has faces, which name rows."""
    if keep.shape != (len(scan),):
        raise ScanError(f"{scan.origin}: {len(scan)} points, {len(keep)} marks; give one mark a point")
    if scan.source is None:
        attributes = {name: values[keep] for name, values in scan.attributes.items()}
        return replace(scan, points=scan.points[keep], attributes=attributes)
    source = scan.source.selected(keep)
    new = {name: values[keep] for name, values in changed(scan).items()}
    return replace(scan, points=scan.points[keep], attributes={**source.columns, **new}, source=source)


def coordinate_system(scan: Scan) -> Crs | None:
    """The coordinate reference system that the scan's file names, None if it names none; only LAS and LAZ do."""
    return scan.source.crs() if isinstance(scan.source, las.LasSource) else None


def coordinate_step(scan: Scan) -> float | None:
    """What the file rounds moved coordinates to: the scale of LAS or E57, else None: text gets the decimals that it needs."""
    if isinstance(scan.source, e57.E57Source):
        return scan.source.step() if scan.source.has_steps else None
    return float(np.abs(scan.source.file.field("scale")).max()) if isinstance(scan.source, las.LasSource) else None


def rounding(scan: Scan) -> float:
    """How far a point may lie from where it was to be written: half the file's step along each axis, in the file's unit."""
    points = scan.points[scan.finite]
    if not len(points):
        return 0.0
    largest = np.abs(points).max()
    step = coordinate_step(scan)
    if step is None:
        step = 4 * float(np.spacing(largest))
        if isinstance(scan.source, e57.E57Source):  # rounded in a station's own frame
            step = max(step, scan.source.step())
        elif scan.format in ("xyz", "ptx"):
            decimals = text.fewest_decimals(points.ravel())
            coarsest = text.COORDINATE_STEP * float(np.ptp(points, axis=0).max())
            step = max(step, coarsest if decimals is None else min(coarsest, 10.0**-decimals))
        elif (points == points.astype(np.float32)).all():
            step = float(np.spacing(np.float32(largest)))
    return 3**0.5 / 2 * step


def without(scan: Scan, names: Collection[str]) -> Scan:
    """The scan without these columns, and its file without them and without our provenance: as before they were added.

    LAS gets back the software, bounds and earlier provenance that writing ours replaced. A text file loses the columns' names
    too. Raises ScanError if there is no such column.
    """
    for name in names:
        if name not in scan.attributes:
            raise ScanError(f"{scan.origin}: there is no column {name} to take away; it has {', '.join(scan.attributes)}")
    left = {name: values for name, values in scan.attributes.items() if name not in names}
    added = tuple(name for name in scan.added if name not in names)
    if scan.source is None:
        return replace(scan, attributes=left, added=added)
    source = scan.source.without([name for name in names if name in scan.source.columns])
    new = changed(scan)
    columns = {name: left[name] if name in new else source.columns.get(name, left[name]) for name in left}
    return replace(scan, attributes=columns, added=added, source=source)


def _encode(scan: Scan, file: BinaryIO, format: str, suffix: str, provenance: Mapping[str, Any] | None) -> None:
    match format:
        case "las" | "laz":
            las.write(scan, file, compressed=format == "laz", provenance=provenance)
        case "ply":
            ply.write(scan, file, provenance=provenance)
        case "pcd":
            pcd.write(scan, file, provenance=provenance)
        case "bin":
            kitti.write(scan, file)
        case "e57":
            e57.write(scan, file, provenance=provenance)
        case "ptx":
            ptx.write(scan, file)
        case _:
            xyz.write(scan, file, suffix=suffix)


def _known(format: str) -> str:
    if format not in _MODULES:
        raise ScanError(f"format {format} is unknown; choose one of {', '.join(_MODULES)}")
    return format


def _by_suffix(path: str | os.PathLike[str]) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        fix = f"name the format (--format), or use one of {' '.join(sorted(SUFFIXES))}"
        raise ScanError(f"{os.fspath(path)}: no suffix tells its format; {fix}")
    return SUFFIXES[suffix]


def _sniffed(head: bytes) -> str:
    """The format that the first bytes show; nothing if none."""
    if las.matches(head):
        return "laz" if las.is_compressed(head) else "las"
    return next((name for name in ("ply", "pcd", "e57", "ptx", "xyz") if _MODULES[name].matches(head)), "")
