"""PLY scans, ASCII and binary: points and properties of the vertex element, all other bytes as they were. Not here: the header.

Bodies are read without plyfile, which takes seconds for a million rows of text or lists.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
from plyfile import PlyData, PlyElement

from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import ply_header
from pcdenoise.io.files import Raw, check_not_cut, let_go
from pcdenoise.io.lines import find_lines, first_visible
from pcdenoise.io.ply_header import TYPES, Element, Header
from pcdenoise.io.records import FixedRecords, ListRecords, Records, TextRecords
from pcdenoise.io.source import Column, changed, colours_as_bytes, exactly, first_exact, free_name, narrowest_float, portable
from pcdenoise.io.text import ColumnIndex, TextRows

_STORED = {"b1": ("u1",), "f2": ("f4",), "i8": ("i4", "u4", "f8"), "u8": ("u4", "f8")}


@dataclass(frozen=True)
class PlySource:
    """A PLY file: its header, the records of the vertex element, the bytes of the elements before and after it."""

    header: Header
    before: bytes
    records: Records
    after: bytes
    columns: Mapping[str, Column]
    origin: str

    def points(self) -> Points:
        """(N, 3) coordinates as stored."""
        return self.records.points()

    def attachments(self) -> list[str]:
        """Faces and other elements, and lists of the vertices."""
        found = [f"{element.count} {element.name} elements" for element in self._others()]
        return found + [f"list property {prop.name}" for prop in self.header.vertex.properties if prop.length is not None]

    def payloads(self) -> dict[str, bytes]:
        """The bytes of the elements before and after the vertices."""
        return {"other elements": self.before + self.after} if self._others() else {}

    def without(self, names: Collection[str]) -> PlySource:
        """The file without these properties and our comment."""
        raw = self.header.without(names) + self.before + self.records.without(names) + self.after
        source: PlySource = read(raw, self.origin).source
        return source

    def selected(self, keep: Mask) -> PlySource:
        """The file with only these vertices. Raises ScanError if it has other elements, which name vertices by row."""
        if others := self._others():
            raise ScanError(f"{self.origin}: its {others[0].name} elements name points by row; use --outliers flag instead")
        raw = self.header.with_count(int(keep.sum())) + self.before + self.records.selected(keep) + self.after
        source: PlySource = read(raw, self.origin).source
        return source

    def _others(self) -> list[Element]:
        return [element for element in self.header.elements if element.name != "vertex" and element.count]


def matches(head: bytes) -> bool:
    """Whether a file starts like PLY."""
    return head[:3] == b"ply" and head[3:4] in (b"\n", b"\r", b" ", b"\t")


def read(raw: bytes, origin: str) -> Scan:
    """A scan of the vertex element; its properties beside x, y, z (not lists) are the attributes. Raises ScanError on damage."""
    header, axes, single = _outline(raw, origin)
    parts = _text_body if header.byte_order == "=" else _binary_body
    before, records, after = parts(raw, header, axes, origin)
    columns = {name: _native(records.column(name)) for name in single if name not in axes}
    return Scan(records.points(), columns, "ply", origin, PlySource(header, before, records, after, columns, origin))


def _native(values: Column) -> Column:
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _outline(raw: Raw, origin: str) -> tuple[Header, tuple[str, str, str], list[str]]:
    """Header, names of the coordinates and of all single properties. Raises ScanError without vertices or coordinates."""
    header = ply_header.parse(raw, origin)
    single = [prop.name for prop in header.vertex.properties if prop.length is None]
    lowered = [name.lower() for name in single]
    if not {"x", "y", "z"} <= set(lowered):
        raise ScanError(f"{origin}: vertices have no x, y and z (but {', '.join(single) or 'nothing'}); rename the properties")
    x, y, z = (single[lowered.index(axis)] for axis in "xyz")
    return header, (x, y, z), single


class PlyStream:
    """A binary PLY file, its vertices all of one size, read and written in pieces; each piece is a scan of some of its rows."""

    def __init__(self, raw: Raw, source: PlySource, records: FixedRecords, axes: tuple[str, str, str]) -> None:
        self.raw, self.source, self.records, self.axes = raw, source, records, axes
        self.origin, self.format, self.n_points = source.origin, "ply", len(records.array)

    @classmethod
    def of(cls, raw: Raw, origin: str) -> PlyStream | None:
        """The stream of a file, or None where rows differ in size. Raises ScanError on damage."""
        header, axes, _ = _outline(raw, origin)
        if header.byte_order == "=" or any(prop.length is not None for prop in header.vertex.properties):
            return None
        before, records, after = _binary_body(raw, header, axes, origin)
        assert isinstance(records, FixedRecords)
        return cls(raw, PlySource(header, before, records, after, {}, origin), records, axes)

    def pieces(self, n_rows: int) -> Iterator[Scan]:
        """Scans of at most n_rows rows, in order."""
        names = [name for name in self.records.array.dtype.names or () if name not in self.axes]
        for first in range(0, self.n_points, n_rows):
            check_not_cut(self.raw, self.origin)
            records = FixedRecords(self.records.array[first : first + n_rows].copy(), self.axes)
            columns = {name: _native(records.column(name)) for name in names}
            source = replace(self.source, records=records, columns=columns)
            yield Scan(records.points(), columns, "ply", self.origin, source)
            let_go(self.raw)

    def write(self, pieces: Iterable[Scan], file: BinaryIO, *, format: str, provenance: Mapping[str, Any] | None = None) -> None:
        """Write pieces of this stream, moved or with further columns, as `write` would write the whole."""
        is_first = True
        for piece in pieces:
            head, body = _encoded(piece, provenance)
            if is_first:
                file.write(head)
            for octets in body:
                file.write(octets)
            is_first = False
        if is_first:
            file.write(self.source.header.raw + self.source.before)
        file.write(self.source.after)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of columns PLY has no number type for: text, and integers beyond 2^53."""
    return [name for name, values in columns.items() if _stored(values) is None]


def write(scan: Scan, file: BinaryIO, *, provenance: Mapping[str, Any] | None = None) -> None:
    """Write a scan as PLY: the file it came from with moved coordinates and new properties, or a new binary one.

    A new file stores coordinates as float if that loses nothing, else as double.
    """
    head, body = _encoded(scan, provenance)
    file.write(head)
    for piece in body:
        file.write(piece)
    file.write(scan.source.after if isinstance(scan.source, PlySource) else b"")


def _encoded(scan: Scan, provenance: Mapping[str, Any] | None) -> tuple[bytes, Iterator[bytes]]:
    """The bytes before the vertices of a scan's file, and those of the vertices."""
    if isinstance(scan.source, PlySource):
        source, columns = scan.source, changed(scan)
    else:
        source, columns = _created(scan), colours_as_bytes(portable(scan.attributes))
    changes = {name: values for name, values in columns.items() if name in source.columns}
    taken = [prop.name for prop in source.header.vertex.properties]
    added: dict[str, Column] = {}
    for name, values in columns.items():
        if name not in changes and (stored := _stored(values)) is not None:
            ordered = stored.astype(stored.dtype.newbyteorder(source.header.byte_order), copy=False)
            added[free_name(name, [*taken, *added])] = ordered
    header = source.header.with_properties({name: values.dtype for name, values in added.items()})
    if provenance is not None:
        header = ply_header.with_provenance(header, json.dumps(provenance))
    return header + source.before, source.records.rewritten(scan.points, changes, added)


def _stored(values: Column) -> Column | None:
    """The column in a number type PLY has, or None."""
    code = values.dtype.str[1:]
    return values if code in TYPES else first_exact(values, _STORED.get(code, ()))


def _created(scan: Scan) -> PlySource:
    """A binary file with x, y and z for the rows of a scan from elsewhere."""
    kind = narrowest_float(scan.points)
    array = np.zeros(len(scan), [(axis, f"<{kind}") for axis in "xyz"])
    text = PlyData([PlyElement.describe(array, "vertex")], byte_order="<").header
    header = ply_header.parse(text.encode() + b"\n", scan.origin)
    for i, axis in enumerate("xyz"):
        array[axis] = scan.points[:, i]
    return PlySource(header, b"", FixedRecords(array), b"", {}, scan.origin)


def _text_body(raw: bytes, header: Header, axes: tuple[str, str, str], origin: str) -> tuple[bytes, Records, bytes]:
    """Bytes before, records and bytes after the vertices of an ASCII file: one line each, blank lines not counted."""
    octets = np.frombuffer(raw, np.uint8)[len(header.raw) :]
    starts, ends = find_lines(octets)
    full = first_visible(octets, starts, ends) < ends
    starts, ends = starts[full], ends[full]
    at = 0
    first = last = 0
    for element in header.elements:
        if at + element.count > len(starts):
            held = max(0, len(starts) - at)
            raise ScanError(f"{origin}: header claims {element.count} {element.name} rows, the file holds {held}; it is cut off")
        if element.name == "vertex":
            first, last = at, at + element.count
        at += element.count
    if first == last:
        edge = int(starts[first]) if first < len(starts) else len(octets)
        begin, stop = edge, edge
    else:
        begin, stop = int(starts[first]), int(ends[last - 1])
    body = octets[begin:stop]
    n_lines_before = len(header.raw.splitlines()) + int((octets[:begin] == 10).sum())
    rows = TextRows(body, starts[first:last] - begin, ends[first:last] - begin, None, origin, n_lines_before + 1)
    fields: dict[str, tuple[ColumnIndex, np.dtype[Any]]] = {}
    index: ColumnIndex = 0
    for prop in header.vertex.properties:
        if prop.length is None:
            fields[prop.name] = (index, prop.dtype)
            index = index + 1
        else:
            lengths = exactly(rows.numbers([index])[0], "i8")
            if lengths is None or (lengths < 0).any() or int(lengths.max(initial=0)) > len(raw):
                raise ScanError(f"{origin}: list property {prop.name} has lengths that are no counts; the file is damaged")
            index = index + 1 + lengths
    return octets[:begin].tobytes(), TextRecords(rows, fields, axes), octets[stop:].tobytes()


def _binary_body(raw: Raw, header: Header, axes: tuple[str, str, str], origin: str) -> tuple[bytes, Records, bytes]:
    """Bytes before, records and bytes after the vertices of a binary file."""
    begin = stop = at = len(header.raw)
    records: Records | None = None
    for element in header.elements:
        held = (len(raw) - at) // max(1, element.smallest_row)
        if element.count > held:
            raise ScanError(f"{origin}: header claims {element.count} {element.name} rows, the file holds {held}; it is cut off")
        if element.name == "vertex":
            begin = at
            records, at = _binary_records(raw, at, element, axes, origin)
            stop = at
        elif records is None:
            _, at = _binary_records(raw, at, element, axes, origin)
        else:
            at += element.count * element.smallest_row
    assert records is not None
    return raw[len(header.raw) : begin], records, raw[stop:]


def _binary_records(raw: Raw, at: int, element: Element, axes: tuple[str, str, str], origin: str) -> tuple[Records, int]:
    """The records of an element that starts at a byte, and where it ends; of one size if its lists are all of one length."""
    fields: list[Any] = []
    end = at
    for k, prop in enumerate(element.properties):
        if prop.length is None or element.count == 0:
            fields.append((prop.name, prop.dtype))
            end += prop.dtype.itemsize
        else:
            n = _list_length(raw, end, prop.length, element, origin)
            fields += [(f"length of {k} {prop.name}", prop.length), (prop.name, prop.dtype, (n,))]
            end += prop.length.itemsize + n * prop.dtype.itemsize
    dtype = np.dtype(fields)
    stop = at + element.count * dtype.itemsize
    if stop <= len(raw):
        array = np.frombuffer(raw, dtype, element.count, at) if dtype.itemsize else np.empty(element.count, dtype)
        lengths = [name for name in dtype.names or () if name.startswith("length of ")]
        if all((array[name] == array[name][0]).all() for name in lengths):
            return FixedRecords(array, axes), stop
    return _walked(raw, at, element, axes, origin)


def _walked(raw: Raw, at: int, element: Element, axes: tuple[str, str, str], origin: str) -> tuple[Records, int]:
    """The records of an element whose lists change in length, row after row."""
    begin = at
    single = [prop.name for prop in element.properties if prop.length is None]
    offsets = {name: np.empty(element.count, np.int64) for name in single}
    ends = np.empty(element.count, np.int64)
    for row in range(element.count):
        for prop in element.properties:
            if prop.length is None:
                offsets[prop.name][row] = at - begin
                at += prop.dtype.itemsize
            else:
                at += prop.length.itemsize + _list_length(raw, at, prop.length, element, origin) * prop.dtype.itemsize
        if at > len(raw):
            raise ScanError(f"{origin}: header claims {element.count} {element.name} rows, the file holds {row}; it is cut off")
        ends[row] = at - begin
    dtypes = {prop.name: prop.dtype for prop in element.properties}
    return ListRecords(np.frombuffer(raw, np.uint8)[begin:at], ends, offsets, dtypes, axes), at


def _list_length(raw: Raw, at: int, dtype: np.dtype[Any], element: Element, origin: str) -> int:
    """A list's length at a byte. Raises ScanError if it is negative or beyond the file."""
    if at + dtype.itemsize <= len(raw):
        n = int(np.frombuffer(raw, dtype, 1, at)[0])
        if 0 <= n <= len(raw) - at:
            return n
    raise ScanError(f"{origin}: a list of element {element.name} runs past the end of the file; it is cut off or damaged")
