"""PCD scans of the Point Cloud Library: ascii, binary and binary_compressed. Not here: the header, the compression (lzf.py)."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import lzf, pcd_header
from pcdenoise.io.lines import find_lines, first_visible, is_number
from pcdenoise.io.pcd_header import Header
from pcdenoise.io.records import FixedRecords, Records, TextRecords
from pcdenoise.io.source import Column, changed, colours_as_bytes, exactly, free_name, narrowest_float, portable, storable
from pcdenoise.io.text import TextRows

_SIZES = struct.Struct("<II")
_BYTES_OF_COLOUR = {"red": 16, "green": 8, "blue": 0, "alpha": 24}
_PCL_NAMES = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PcdSource:
    """A PCD file: header, records, the bytes before and after them, the data block as packed, and where each column stands.

    labels   attribute -> label of its value in a record.
    colour   label of the packed rgb or rgba value, whose bytes are the attributes red, green, blue (and alpha).
    """

    header: Header
    before: bytes
    records: Records
    after: bytes
    packed: bytes
    labels: Mapping[str, str]
    colour: str | None
    columns: Mapping[str, Column]
    origin: str

    def points(self) -> Points:
        """(N, 3) coordinates as stored."""
        return self.records.points()

    def attachments(self) -> list[str]:
        """The grid of an organised cloud, and a viewpoint that is not the origin."""
        found = [f"organisation in {self.header.height} rows"] if self.header.height > 1 else []
        placed = all(is_number(word.encode()) for word in self.header.viewpoint) and len(self.header.viewpoint) == len(_IDENTITY)
        return found + (["viewpoint"] if placed and tuple(map(float, self.header.viewpoint)) != _IDENTITY else [])

    def payloads(self) -> dict[str, bytes]:
        """The viewpoint and the grid, as the header says them."""
        grid = f"{self.header.n_points // self.header.height} x {self.header.height}".encode()
        named = {"viewpoint": " ".join(self.header.viewpoint).encode(), f"organisation in {self.header.height} rows": grid}
        return {name: named[name] for name in self.attachments()}

    def without(self, names: Collection[str]) -> PcdSource:
        """The file without these fields and our comment; a field of several values goes if all its columns do."""
        gone = {self.labels[name] for name in names if name in self.labels}
        indices = [i for i, field in enumerate(self.header.fields) if field.count and gone.issuperset(field.labels(i))]
        header = self.header.without(indices)
        data = self.records.without([label for i in indices for label in self.header.fields[i].labels(i)])
        if self.header.encoding == "binary_compressed":
            data = _compressed(data, pcd_header.parse(header, self.origin))
        source: PcdSource = read(header + self.before + data + self.after, self.origin).source
        return source

    def selected(self, keep: Mask) -> PcdSource:
        """The file with only these points, no longer organised: WIDTH is their number, HEIGHT 1."""
        data = self.records.selected(keep)
        if self.header.encoding == "binary_compressed":
            data = _compressed(data, self.header)
        source: PcdSource = read(self.header.with_count(int(keep.sum())) + self.before + data + self.after, self.origin).source
        return source


def matches(head: bytes) -> bool:
    """Whether a file starts like PCD: comments, then one of the header's first keys."""
    return re.match(rb"\s*(?:#[^\n]*\n\s*)*(VERSION|FIELDS|COLUMNS)\s", head) is not None


def read(raw: bytes, origin: str) -> Scan:
    """A scan of PCD bytes: fields beside x, y, z are attributes, `rgb` is unpacked to red, green and blue.

    A field of several values gives name_0, name_1, …; padding gives none. Organised clouds keep their rows of NaN.
    Raises ScanError on damage.
    """
    header = pcd_header.parse(raw, origin)
    names = [field.name.lower() for field in header.fields]
    if not {"x", "y", "z"} <= set(names) or any(header.fields[names.index(axis)].count != 1 for axis in "xyz"):
        raise ScanError(f"{origin}: has no single fields x, y and z (but {', '.join(names)}); rename them in the header")
    x, y, z = (f"{names.index(axis)}.0" for axis in "xyz")
    body = raw[len(header.raw) :]
    packed = b""
    if header.encoding == "ascii":
        before, records, after = _text_body(body, header, (x, y, z), origin)
    elif header.encoding == "binary":
        array = _array(body, header, origin)
        before, records, after = b"", FixedRecords(array, (x, y, z)), body[array.nbytes :]
    elif header.encoding == "binary_compressed":
        array, packed, after = _decompressed(body, header, origin)
        before, records = b"", FixedRecords(array, (x, y, z))
    else:
        raise ScanError(f"{origin}: DATA {header.encoding} is unknown; PCD has ascii, binary and binary_compressed")
    labels: dict[str, str] = {}
    colour = None
    columns: dict[str, Column] = {}
    for i, field in enumerate(header.fields):
        if field.name == "_" or f"{i}.0" in (x, y, z):
            continue
        if field.name.lower() in ("rgb", "rgba") and (field.dtype.itemsize, field.count) == (4, 1) and colour is None:
            colour = f"{i}.0"
            word = _colour_word(records, colour)
            kept = list(_BYTES_OF_COLOUR)[: 3 if field.name.lower() == "rgb" else 4]
            octets = {name: (word >> _BYTES_OF_COLOUR[name] & 255).astype(np.uint8) for name in kept}
            columns.update({name: values for name, values in octets.items() if name not in columns})
            continue
        for k, label in enumerate(field.labels(i)):
            name = free_name(field.name + (f"_{k}" if field.count > 1 else ""), columns)
            labels[name] = label
            columns[name] = records.column(label)
    source = PcdSource(header, before, records, after, packed, labels, colour, columns, origin)
    return Scan(records.points(), columns, "pcd", origin, source)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of columns PCD has no number type for: text."""
    return [name for name, values in columns.items() if storable(values) is None]


def write(scan: Scan, file: BinaryIO, *, provenance: Mapping[str, Any] | None = None) -> None:
    """Write a scan as PCD: the file it came from with moved coordinates and new fields, or a new binary one.

    A new file stores coordinates as float32 if that loses nothing, else as float64; 8-bit colours become one packed rgb field.
    """
    if isinstance(scan.source, PcdSource):
        source, columns = scan.source, changed(scan)
    else:
        source, columns = _created(scan), colours_as_bytes(portable(scan.attributes))
    changes = {source.labels[name]: values for name, values in columns.items() if name in source.labels}
    colours = {name: values for name, values in columns.items() if name in source.columns and name not in source.labels}
    if colours and source.colour is not None:
        changes[source.colour] = _recoloured(source, colours)
    taken = [*(source.header.dtype.names or ()), *(field.name for field in source.header.fields)]
    added: dict[str, Column] = {}
    fresh = {name: values for name, values in columns.items() if name not in source.columns}
    for name, values in _with_packed_colours(fresh).items():
        if (stored := storable(values)) is not None:
            stored = stored.astype(stored.dtype.newbyteorder("<"), copy=False)
            added[free_name(_PCL_NAMES.get(name, name), [*taken, *added])] = stored
    header = source.header.with_fields({name: values.dtype for name, values in added.items()})
    data = b"".join(source.records.rewritten(scan.points, changes, added))
    if source.header.encoding == "binary_compressed":
        same = not added and data == source.records.selected(np.ones(len(scan), np.bool_))
        data = source.packed if same else _compressed(data, pcd_header.parse(header, scan.origin))
    if provenance is not None:
        header = pcd_header.with_provenance(header, json.dumps(provenance))
    file.write(header + source.before + data + source.after)


def _created(scan: Scan) -> PcdSource:
    """A binary file with x, y and z for the rows of a scan from elsewhere."""
    kind = np.dtype(f"<{narrowest_float(scan.points)}")
    header = pcd_header.written({"x": kind, "y": kind, "z": kind}, len(scan), scan.origin)
    array = np.zeros(len(scan), header.dtype)
    for i in range(3):
        array[f"{i}.0"] = scan.points[:, i]
    return PcdSource(header, b"", FixedRecords(array, ("0.0", "1.0", "2.0")), b"", b"", {}, None, {}, scan.origin)


def _text_body(body: bytes, header: Header, axes: tuple[str, str, str], origin: str) -> tuple[bytes, Records, bytes]:
    """Bytes before, records and bytes after the points of an ascii body: one line each, blank lines not counted."""
    octets = np.frombuffer(body, np.uint8)
    starts, ends = find_lines(octets)
    full = first_visible(octets, starts, ends) < ends
    starts, ends = starts[full][: header.n_points], ends[full][: header.n_points]
    _check_count(header.n_points, len(starts), origin)
    begin, stop = (int(starts[0]), int(ends[-1])) if len(starts) else (0, 0)
    first_line = len(header.raw.splitlines()) + body[:begin].count(b"\n") + 1
    rows = TextRows(octets[begin:stop], starts - begin, ends - begin, None, origin, first_line)
    names = header.dtype.names or ()
    return body[:begin], TextRecords(rows, {name: (k, header.dtype[name]) for k, name in enumerate(names)}, axes), body[stop:]


def _array(body: bytes, header: Header, origin: str) -> NDArray[Any]:
    """The records of a binary body."""
    _check_count(header.n_points, len(body) // header.dtype.itemsize, origin)
    return np.frombuffer(body, header.dtype, header.n_points)


def _decompressed(body: bytes, header: Header, origin: str) -> tuple[NDArray[Any], bytes, bytes]:
    """Records, packed block and bytes after it of a binary_compressed body, which holds field after field."""
    if len(body) < _SIZES.size:
        raise ScanError(f"{origin}: ends before its points; it is cut off, fetch it again")
    size, full_size = _SIZES.unpack_from(body)
    end = _SIZES.size + size
    expected = header.n_points * header.dtype.itemsize
    if full_size != expected:
        raise ScanError(f"{origin}: header claims {expected} bytes of points, the file packs {full_size}; fetch it again")
    if end > len(body):
        held = len(body) - _SIZES.size
        raise ScanError(f"{origin}: {size} bytes of packed points are claimed, {held} are there; it is cut off, fetch it again")
    if full_size > lzf.LARGEST_RATIO * size:
        raise ScanError(f"{origin}: {full_size} bytes of points cannot be packed in {size}; it is damaged, fetch it again")
    try:
        plain = lzf.decompress(body[_SIZES.size : end], full_size)
    except ValueError as fault:
        raise ScanError(f"{origin}: {fault}; the file is damaged, fetch it again") from None
    array = np.empty(header.n_points, header.dtype)
    at = 0
    for i, field in enumerate(header.fields):
        block = np.frombuffer(plain, field.dtype, header.n_points * field.count, at).reshape(header.n_points, field.count)
        at += block.nbytes
        for k, label in enumerate(field.labels(i)):
            array[label] = block[:, k]
    return array, body[:end], body[end:]


def _compressed(data: bytes, header: Header) -> bytes:
    """The packed block of records, field after field."""
    array = np.frombuffer(data, header.dtype)
    labels = [field.labels(i) for i, field in enumerate(header.fields) if field.count]
    blocks = [np.stack([array[label] for label in group], axis=1) for group in labels]
    plain = b"".join(block.tobytes() for block in blocks)
    packed = lzf.compress(plain)
    return _SIZES.pack(len(packed), len(plain)) + packed


def _check_count(claimed: int, held: int, origin: str) -> None:
    if claimed > held:
        raise ScanError(f"{origin}: header claims {claimed} points, the file holds {held}; it is cut off, fetch it again")


def _colour_word(records: Records, label: str) -> NDArray[np.uint32]:
    """(N,) 0xAARRGGBB of a packed colour; ascii files print it as the float of the same bits or, PCL too, as a whole number."""
    if isinstance(records, TextRecords):
        index, dtype = records.fields[label]
        assert isinstance(index, int)
        values = records.rows.numbers([index])[0]
        fields = records.rows.first_fields()
        if dtype.kind != "f" or (fields and re.fullmatch(rb"\d+", fields[index])):
            return (values.astype(np.int64) & 0xFFFFFFFF).astype(np.uint32)
        with np.errstate(over="ignore"):
            return values.astype(np.float32).view(np.uint32)
    return np.ascontiguousarray(records.column(label)).view(np.uint32)


def _recoloured(source: PcdSource, colours: Mapping[str, Column]) -> Column:
    """The packed colour with some of its bytes replaced. Raises ScanError for ascii files and values beyond a byte."""
    if source.colour is None or isinstance(source.records, TextRecords):
        raise ScanError("packed colours of an ascii PCD cannot be replaced; write .ply instead")
    word = _colour_word(source.records, source.colour)
    for name, values in colours.items():
        octet = exactly(values, "u1")
        if octet is None:
            raise ScanError(f"{name} is one byte here, which cannot hold the new values; write .ply instead")
        shift = _BYTES_OF_COLOUR[name]
        word = word & np.uint32(~(255 << shift) & 0xFFFFFFFF) | octet.astype(np.uint32) << np.uint32(shift)
    return word.view(source.records.column(source.colour).dtype)


def _with_packed_colours(columns: dict[str, Column]) -> dict[str, Column]:
    """8-bit red, green, blue (and alpha) as the one rgb (rgba) column the Point Cloud Library knows."""
    names = [name for name in _BYTES_OF_COLOUR if name in columns and columns[name].dtype == np.uint8]
    if not {"red", "green", "blue"} <= set(names):
        return columns
    word = np.zeros(len(columns["red"]), np.uint32)
    for name in names:
        word |= columns[name].astype(np.uint32) << np.uint32(_BYTES_OF_COLOUR[name])
    rest = {name: values for name, values in columns.items() if name not in names}
    return {**rest, "rgba": word} if "alpha" in names else {**rest, "rgb": word.view(np.float32)}
