"""LAS and LAZ scans: coordinates as scaled integers, dimensions as attributes. Not here: the container (las_file.py)."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdenoise import __version__
from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import crs, las_file
from pcdenoise.io.crs import Crs
from pcdenoise.io.files import Raw
from pcdenoise.io.las_dimensions import EXTRA_BYTES, Dimension, extended, reduced, structured
from pcdenoise.io.las_file import HEADER, LasFile
from pcdenoise.io.source import Column, changed, colours_as_words, portable, step_decimals, storable

_PROVENANCE = (b"pcdenoise", 1)
_CRS_IS_WKT = 16
_BEFORE = "header_before"
"""Key of the provenance under which a file's software, bounds and earlier provenance are kept, so that they can come back."""
_LONGEST_NOTE = 1 << 14
_VLR_HEAD, _EVLR_HEAD = 54, 60
_INT32 = np.iinfo(np.int32)
_QUANTA = 1e-8


@dataclass(frozen=True)
class LasSource:
    """A LAS file, its records seen through `dimensions`, the columns they gave when read, header fields to write instead."""

    file: LasFile
    records: NDArray[Any]
    dimensions: Mapping[str, Dimension]
    columns: Mapping[str, Column]
    header: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, file: LasFile) -> LasSource:
        """The source of a file as it stands."""
        records, dimensions = structured(file)
        return cls(file, records, dimensions, {name: dimension.get(records) for name, dimension in dimensions.items()})

    def points(self) -> Points:
        """(N, 3) float64 world coordinates of the stored integers."""
        return _coordinates(self.file, self.records)

    def attachments(self) -> list[str]:
        """CRS, VLRs, EVLRs and waveforms, which only LAS carries."""
        found = []
        for user_id, record_id in map(las_file.vlr_identity, self.file.vlrs):
            if user_id == b"LASF_Projection":
                found.append("coordinate reference system")
            elif (user_id, record_id) not in (EXTRA_BYTES, las_file.LASZIP, _PROVENANCE):
                found.append(f"VLR {user_id.decode('latin-1')}/{record_id}")
        if n_evlrs := len(self.file.evlrs()):
            found.append(f"{n_evlrs} EVLRs")
        if self.file.field("waveforms_start"):
            found.append("waveform packets")
        return list(dict.fromkeys(found))

    def crs(self) -> Crs | None:
        """The coordinate reference system that its records name."""
        records = [*((record, _VLR_HEAD) for record in self.file.vlrs), *((record, _EVLR_HEAD) for record in self.file.evlrs())]
        said = {
            las_file.vlr_identity(record)[1]: record[head:]
            for record, head in reversed(records)
            if las_file.vlr_identity(record)[0] == b"LASF_Projection"
        }
        return crs.parse(said)

    def payloads(self) -> dict[str, bytes]:
        """The bytes of each VLR and EVLR that says nothing about the layout of points, and of the waveforms, by name."""
        own = (EXTRA_BYTES, las_file.LASZIP, _PROVENANCE)
        records = [(las_file.vlr_identity(record), "VLR", record) for record in self.file.vlrs]
        records += [(las_file.vlr_identity(record), "EVLR", record) for record in self.file.evlrs()]
        found: dict[str, bytes] = {}
        for (user_id, record_id), kind, record in records:
            if (user_id, record_id) not in own:
                name = f"{kind} {user_id.decode('latin-1')}/{record_id}"
                found[name] = found.get(name, b"") + record
        if self.file.field("waveforms_start"):
            found["waveform packets"] = self.file.tail
        return found

    def without(self, names: Collection[str]) -> LasSource:
        """The file as it was before these extra bytes and our provenance were written: header fields noted there come back."""
        notes = self.file.vlr(*_PROVENANCE)
        file, header = reduced(self.file, names).without_vlr(*_PROVENANCE), {}
        if notes:
            try:
                said = json.loads(notes[0])[_BEFORE]
                header = {"software": said["software"].encode("latin-1"), "bounds": np.array(said["bounds"], np.float64)}
                if earlier := said["provenance"]:
                    file = file.with_vlr(*_PROVENANCE, b"how this file was made", earlier.encode("latin-1"))
            except (ValueError, KeyError, TypeError, AttributeError):
                header = {}
        return replace(LasSource.of(file), header=header)

    def selected(self, keep: Mask) -> LasSource:
        """The file with only these rows; counts and bounds follow."""
        return LasSource.of(_bounded(_counted(replace(self.file, records=self.file.records[keep]))))


def matches(head: bytes) -> bool:
    """Whether a file starts like LAS or LAZ."""
    return head[:4] == b"LASF"


def is_compressed(head: bytes) -> bool:
    """Whether the first bytes of a LAS file say that its points are compressed."""
    return len(head) > 104 and bool(head[104] & 0xC0)


def read(raw: bytes, origin: str) -> Scan:
    """A scan of LAS or LAZ bytes; attributes carry laspy's dimension names. Raises ScanError on damage.

    A COPC file is read as the LAZ file it is. Its octree indexes the old coordinates, so it is written back without it.
    """
    source = LasSource.of(las_file.parse(raw, origin).without_copc())
    return Scan(source.points(), source.columns, "laz" if is_compressed(raw) else "las", origin, source)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of columns that LAS cannot hold: text, and names beyond 32 bytes."""
    return [name for name, values in columns.items() if storable(values) is None or len(name.encode()) > 32]


class LasStream:
    """A LAS or LAZ file read and written in pieces; each piece is a scan of some of its rows."""

    def __init__(self, raw: Raw, origin: str) -> None:
        self.file, self.body = las_file.outline(raw, origin)
        self.file, self.origin, self.n_points = self.file.without_copc(), origin, self.body.n_points
        self.format = "las" if self.body.layout is None else "laz"

    def pieces(self, n_rows: int) -> Iterator[Scan]:
        """Scans of at most n_rows rows, in order. Raises ScanError on damage."""
        for records in self.body.parts(n_rows):
            source = LasSource.of(replace(self.file, records=records))
            yield Scan(source.points(), source.columns, self.format, self.origin, source)

    def write(self, pieces: Iterable[Scan], file: BinaryIO, *, format: str, provenance: Mapping[str, Any] | None = None) -> None:
        """Write pieces of this stream, moved or with further columns, as `write` would write the whole."""
        bounds = np.array([[-np.inf] * 3, [np.inf] * 3])
        is_moved = False

        def records_of(target: LasFile, moved: bool) -> NDArray[np.uint8]:
            nonlocal is_moved
            points = _coordinates(target, structured(target)[0])
            bounds[0], bounds[1] = np.maximum(bounds[0], points.max(axis=0)), np.minimum(bounds[1], points.min(axis=0))
            is_moved |= moved
            return target.records

        remaining = (_target(piece, provenance) for piece in pieces)
        first = next(remaining, None)
        if first is None:
            first = _target(Scan(np.empty((0, 3)), source=LasSource.of(self.file)), provenance)
        first[0].write(
            file,
            compressed=format == "laz",
            parts=(records_of(target, moved) for target, moved in chain([first], remaining) if len(target.records)),
            at_the_end=lambda: {"bounds": bounds.T} if is_moved else {},
        )


def write(scan: Scan, file: BinaryIO, *, compressed: bool, provenance: Mapping[str, Any] | None = None) -> None:
    """Write a scan as LAS or LAZ: unmoved coordinates keep their integers. Raises ScanError if a value does not fit."""
    _target(scan, provenance)[0].write(file, compressed=compressed)


def _target(scan: Scan, provenance: Mapping[str, Any] | None) -> tuple[LasFile, bool]:
    """The file that holds a scan, and whether any of its points moved."""
    own = scan.source if isinstance(scan.source, LasSource) else None
    source = own or _created(scan)
    columns = changed(scan) if own else _by_dimension(colours_as_words(portable(scan.attributes)), source)
    standing = {name: values for name, values in columns.items() if name in source.dimensions}
    if own is None:  # what a standard dimension cannot hold goes to extra bytes beside it
        standing = {name: values for name, values in standing.items() if source.dimensions[name].holds(source.records, values)}
    lost = unstorable(columns)
    added = {_free(name, source): values for name, values in columns.items() if name not in standing and name not in lost}
    target = extended(source.file, added)
    target = replace(target, records=target.records.copy())
    records, _ = structured(target)
    for name, values in standing.items():
        source.dimensions[name].put(records, values)
    is_moved = _move(target, records, scan.points)
    if is_moved:
        target = _bounded(target)
    if own is None:
        target = _counted(target)
    if provenance is not None:
        note = json.dumps({**provenance, **_header_before(own)}).encode()
        target = target.with_vlr(*_PROVENANCE, b"how this file was made", note)
        target = target.with_header(software=f"pcdenoise {__version__}".encode())
    elif own is not None and own.header:
        target = target.with_header(**own.header)
    return target, is_moved


def _header_before(source: LasSource | None) -> dict[str, Any]:
    """What writing our provenance replaces in a file's header and VLRs, in a form that JSON holds exactly."""
    if source is None:
        return {}
    software, bounds = source.file.field("software"), source.file.field("bounds")
    earlier = (source.file.vlr(*_PROVENANCE) or [b""])[0].decode("latin-1")
    if not np.isfinite(bounds).all() or len(earlier) > _LONGEST_NOTE:
        return {}
    return {_BEFORE: {"software": software.decode("latin-1"), "bounds": bounds.tolist(), "provenance": earlier}}


def _by_dimension(columns: Mapping[str, Column], source: LasSource) -> dict[str, Column]:
    """The columns under the dimension's name where theirs is the same but for case and underscores (GpsTime, pointsourceid)."""
    squeezed = {name.replace("_", ""): name for name in source.dimensions}
    renamed: dict[str, Column] = {}
    for name, values in columns.items():
        new = squeezed.get(name.lower().replace("_", ""), name)
        renamed[name if new in columns or new in renamed else new] = values
    return renamed


def _free(name: str, source: LasSource) -> str:
    return name + "_" if name in source.dimensions else name


def _coordinates(file: LasFile, records: NDArray[Any]) -> Points:
    scale, offset = file.field("scale"), file.field("offset")
    with np.errstate(over="ignore", invalid="ignore"):  # a damaged scale may lead beyond float64: rows that are not finite
        return np.stack([records[axis] * scale[i] + offset[i] for i, axis in enumerate("XYZ")], axis=1)


def _move(file: LasFile, records: NDArray[Any], points: Points) -> bool:
    """Put (N, 3) coordinates into the records where they differ from what is there; whether any did."""
    scale, offset = file.field("scale"), file.field("offset")
    moved = points != _coordinates(file, records)
    for i, axis in enumerate("XYZ"):
        rows = np.flatnonzero(moved[:, i])
        steps = np.rint((points[rows, i] - offset[i]) / scale[i])
        beyond = rows[~((steps >= _INT32.min) & (steps <= _INT32.max))]
        if len(beyond):
            raise ScanError(
                f"row {beyond[0]} has {axis.lower()} = {points[beyond[0], i]}, beyond what LAS holds "
                f"at scale {scale[i]} and offset {offset[i]}; limit the move, or write .ply or .xyz"
            )
        records[axis][rows] = steps.astype(np.int32)
    return bool(moved.any())


def _bounded(file: LasFile) -> LasFile:
    """The file with the header's bounds those of its points."""
    if not len(file.records):
        return file.with_header(bounds=0.0)
    points = _coordinates(file, structured(file)[0])
    return file.with_header(bounds=np.stack([points.max(axis=0), points.min(axis=0)], axis=1))


def _counted(file: LasFile) -> LasFile:
    """The file with the header's point counts those of its points, the legacy ones only where they were in use."""
    records, dimensions = structured(file)
    by_return = np.bincount(dimensions["return_number"].get(records), minlength=16)[1:16]
    counts: dict[str, Any] = {"n_points": len(records), "n_by_return": by_return}
    if file.point_format < 6 or file.field("legacy_n_points"):
        counts |= {"legacy_n_points": len(records), "legacy_n_by_return": by_return[:5]}
    return file.with_header(**counts)


def _created(scan: Scan) -> LasSource:
    """A LAS 1.4 file without columns for the rows of a scan from elsewhere: format 6, 7 with colour, 8 with near infrared.

    The scale is a power of ten at most 1e-8 of the extent, the offset the centre: about 1e8 of the 4e9 steps an integer has.
    """
    names = portable(scan.attributes)
    point_format = 8 if "nir" in names else 7 if {"red", "green", "blue"} <= names.keys() else 6
    if not scan.finite.all():
        row = int(np.argmin(scan.finite))
        raise ScanError(f"row {row} has no finite coordinates, which LAS cannot hold; write .ply or .pcd instead")
    decimals = step_decimals(scan.points, _QUANTA)
    centre = (scan.points.max(axis=0) + scan.points.min(axis=0)) / 2 if len(scan) else np.zeros(3)
    records = np.zeros((len(scan), las_file.standard_length(point_format)), np.uint8)
    file = LasFile(bytes(HEADER.itemsize), (), b"", records, b"", 0).with_header(
        signature=b"LASF", major=1, minor=4, header_size=HEADER.itemsize, point_format=point_format, global_encoding=_CRS_IS_WKT,
        software=f"pcdenoise {__version__}".encode(), scale=10.0**-decimals, offset=np.round(centre, min(decimals, 12)),
    )  # fmt: skip
    source = LasSource.of(file)
    for name in ("return_number", "number_of_returns"):
        source.dimensions[name].put(source.records, np.ones(len(scan), np.uint8))
    return replace(source, columns={})
