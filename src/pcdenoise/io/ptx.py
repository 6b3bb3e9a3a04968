"""PTX scans, as programs of terrestrial scanners exchange them: stations with poses, each a grid of points in its own frame.

A point is a row `x y z intensity`, or with `red green blue` behind that. All stations of a file are one scan in the world,
as of an E57. Not here: rows and fields (text.py).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io.lines import find_lines
from pcdenoise.io.pose import Pose
from pcdenoise.io.source import STATION, Column, changed, colours_as_bytes, exactly, moved_points, portable, station_numbers
from pcdenoise.io.text import NewFields, TextRows, coordinates, new_rows, plain

_HEAD_LINES, _WORDS = 10, (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
"""Lines before the points of a station and how many numbers each has: columns, rows, the scanner's place and axes, its pose."""
_NAMES = ("intensity", "red", "green", "blue")


@dataclass(frozen=True)
class _Station:
    """One grid: its ten lines, the rows, its (N, 3) local points and its pose."""

    head: bytes
    points_in_file: TextRows
    local: Points
    pose: Pose

    def world(self) -> Points:
        """(n, 3) points in the world; NaN where the scanner saw nothing."""
        points = self.pose.to_world(self.local)
        points[~self.local.any(axis=1)] = np.nan
        return points


@dataclass(frozen=True)
class PtxSource:
    """A PTX file: its stations, and what stands behind the last of them."""

    stations: Sequence[_Station]
    after: bytes
    columns: Mapping[str, Column]
    origin: str

    def points(self) -> Points:
        """(N, 3) world coordinates."""
        return np.concatenate([station.world() for station in self.stations])

    def attachments(self) -> list[str]:
        """Poses and grids of the stations."""
        return list(self.payloads())

    def payloads(self) -> dict[str, bytes]:
        """Poses and grids as the file says them."""
        lines = [station.head.splitlines() for station in self.stations]
        poses = b"\n".join(b"\n".join(head[2:]) for head in lines)
        grids = b"\n".join(b" x ".join(head[:2]) for head in lines)
        is_grid = any(1 not in (int(head[0]), int(head[1])) for head in lines)
        placed = not all(station.pose.is_home for station in self.stations)
        return {**({"poses of stations": poses} if placed else {}), **({"grids of stations": grids} if is_grid else {})}

    def without(self, names: Collection[str]) -> PtxSource:
        """The file as it is: it has no further columns."""
        return self

    def selected(self, keep: Mask) -> PtxSource:
        """The file with only these points; a station that loses some is no grid any more. Raises ScanError if none is left."""
        if not keep.any():
            raise ScanError(f"{self.origin}: no point is left, and a PTX cannot be empty; write .ply or .las instead")
        parts: list[bytes] = []
        for station, rows in zip(self.stations, _slices(self.stations), strict=True):
            kept, lines = keep[rows], station.head.splitlines(keepends=True)
            if kept.any() and not kept.all():
                count = re.sub(rb"\d+", str(int(kept.sum())).encode(), lines[0], count=1)
                lines[:2] = [count, re.sub(rb"\d+", b"1", lines[1], count=1)]
            if kept.any():
                parts += [*lines, station.points_in_file.selected(kept).body.tobytes()]
        source: PtxSource = read(b"".join(parts) + self.after, self.origin).source
        return source


def matches(head: bytes) -> bool:
    """Whether a file starts like PTX: ten lines of 1, 1, 3, 3, 3, 3, 4, 4, 4 and 4 numbers."""
    lines = head[:4096].splitlines()[:_HEAD_LINES]
    return len(lines) == _HEAD_LINES and all(len(_numbers(line)) == n for line, n in zip(lines, _WORDS, strict=True))


def read(raw: bytes, origin: str) -> Scan:
    """A scan of PTX bytes: all stations in world coordinates, with intensity and, where a station has them, colours.

    Points that the scanner did not see, 0 0 0 in the file, have coordinates of NaN. Where there are several stations a column
    says of which one a point is. Raises ScanError on damage.
    """
    octets = np.frombuffer(raw, np.uint8)
    starts, ends = find_lines(octets)
    stations: list[_Station] = []
    parts: list[list[Column | None]] = []
    at, stop = 0, len(raw.rstrip())
    while at < len(starts) and (not stations or starts[at] < stop):
        station, columns, at = _station(raw, octets, starts, ends, at, origin)
        stations.append(station)
        parts.append(columns)
    if not stations:
        raise ScanError(f"{origin}: has no station; check what wrote it")
    read_columns: dict[str, Column] = {}
    for name, some in zip(_NAMES, zip(*parts, strict=True), strict=True):
        if any(column is not None for column in some):
            values = np.concatenate([np.zeros(len(s.local)) if c is None else c for s, c in zip(stations, some, strict=True)])
            small = exactly(values, "u1") if name != "intensity" else None
            read_columns[name] = values if small is None else small
    if len(stations) > 1:
        read_columns[STATION] = station_numbers([len(station.local) for station in stations])
    after = raw[starts[at] :] if at < len(starts) else b""
    source = PtxSource(stations, after, read_columns, origin)
    return Scan(source.points(), read_columns, "ptx", origin, source)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of all columns but intensities that are no whole numbers, from 0 to 1 here, and colours of a byte each."""
    stored = _storable(colours_as_bytes(dict(columns)))
    return [name for name in columns if name not in stored]


def write(scan: Scan, file: BinaryIO) -> None:
    """Write a scan as PTX: the file's own lines with other coordinates, intensities and colours, or a new file of one station."""
    if not isinstance(scan.source, PtxSource):
        _create(scan, file)
        return
    source, columns = scan.source, changed(scan)
    if STATION in columns:
        raise ScanError("of which station a point is cannot be changed; write .las or .ply instead")
    moved = moved_points(source.points(), scan.points)
    for station, rows in zip(source.stations, _slices(source.stations), strict=True):
        lines, fields = station.points_in_file, list[NewFields]()
        if moved[rows].any():
            local = np.where(moved[rows, None], station.pose.from_world(scan.points[rows]), station.local)
            fields += [coordinates(lines, i, station.local, local[:, i], moved[rows]) for i in range(3)]
        there = _NAMES[: len(lines.first_fields()) - 3]
        fields += [plain(columns[name][rows], 3 + i) for i, name in enumerate(there) if name in columns]
        file.write(station.head)
        for piece in lines.rewritten(fields):
            file.write(piece)
    file.write(source.after)


def _station(
    raw: bytes, octets: NDArray[np.uint8], starts: NDArray[np.int64], ends: NDArray[np.int64], at: int, origin: str
) -> tuple[_Station, list[Column | None], int]:
    """The station whose first line is the at-th, its intensities and colours, and the line behind it."""
    lines = [raw[start:end] for start, end in zip(starts[at : at + _HEAD_LINES], ends[at : at + _HEAD_LINES], strict=True)]
    head = [_numbers(line) for line in lines]
    if [len(numbers) for numbers in head] != list(_WORDS):
        raise ScanError(f"{origin}: line {at + 1} does not begin the ten lines of a station; it is cut off or damaged")
    (columns,), (rows,) = head[:2]
    matrix = np.array(head[6:])
    turn, shift = matrix[:3, :3], matrix[3, :3]
    count = columns * rows
    if not (columns >= 0 <= rows and columns == int(columns) and rows == int(rows)):
        raise ScanError(f"{origin}: line {at + 1}: {columns:g} x {rows:g} points are no grid; it is damaged")
    if not abs(np.linalg.det(turn)) > 0:
        raise ScanError(f"{origin}: line {at + 7}: the station's pose flattens all points; it is damaged")
    first, last = at + _HEAD_LINES, at + _HEAD_LINES + int(count)
    if last > len(starts):
        held = max(len(starts) - first, 0)
        raise ScanError(f"{origin}: line {at + 1} claims {count:.0f} points, there are {held}; it is cut off, fetch it again")
    begin = int(starts[first]) if first < len(starts) else len(raw)
    stop = int(starts[last]) if last < len(starts) else len(raw)
    points = TextRows(octets[begin:stop], starts[first:last] - begin, ends[first:last] - begin, None, origin, first + 1)
    n_fields = len(points.first_fields()) if count else 4
    if n_fields not in (4, 7):
        raise ScanError(f"{origin}: line {first + 1} has {n_fields} numbers; a point of a PTX has 4, or 7 with its colour")
    values = points.numbers(range(n_fields))
    station = _Station(raw[starts[at] : begin], points, np.stack(values[:3], axis=1), Pose(turn, np.linalg.inv(turn), shift))
    return station, [*values[3:], *[None] * (7 - n_fields)], last


def _numbers(line: bytes) -> list[float]:
    """The numbers of a line; none where something else is in it."""
    try:
        found = [float(word) for word in line.split()]
    except ValueError:
        return []
    return found if np.isfinite(found).all() else []


def _slices(stations: Sequence[_Station]) -> Iterator[slice]:
    """The rows of each station in the scan."""
    at = 0
    for station in stations:
        yield slice(at, at + len(station.local))
        at += len(station.local)


def _storable(columns: Mapping[str, Column]) -> dict[str, Column]:
    """Intensities that are no whole numbers, and colours if all three are bytes."""
    found = {name: values for name, values in columns.items() if name == "intensity" and values.dtype.kind == "f"}
    colours = {name: columns[name] for name in _NAMES[1:] if name in columns and columns[name].dtype == np.uint8}
    return found | (colours if len(colours) == 3 else {})


def _create(scan: Scan, file: BinaryIO) -> None:
    """One station without a pose: one column of all rows, 0 0 0 where they are not finite."""
    columns = _storable(colours_as_bytes(portable(scan.attributes)))
    n = len(scan)
    file.write(f"{n}\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n".encode())
    rows, fields = new_rows(np.where(scan.finite[:, None], scan.points, 0.0), None)
    intensity = columns.pop("intensity", np.full(n, 0.5))
    for piece in rows.rewritten([*fields, plain(intensity), *(plain(columns[name]) for name in _NAMES[1:] if name in columns)]):
        file.write(piece)
