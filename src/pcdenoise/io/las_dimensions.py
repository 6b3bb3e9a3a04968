"""Point records as named dimensions: standard fields, bit fields, extra bytes. Not here: coordinates and headers (las.py)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.errors import ScanError
from pcdenoise.io.las_file import LasFile, standard_length
from pcdenoise.io.source import NUMBERS, Column, exactly, storable

EXTRA_BYTES = (b"LASF_Spec", 4)
"""Identity of the VLR that describes extra bytes."""

_ENTRY = np.dtype(
    [
        ("reserved", "V2"), ("type", "u1"), ("options", "u1"), ("name", "S32"), ("unused", "V4"), ("no_data", "V24"),
        ("min", "V24"), ("max", "V24"), ("scale", "<f8", 3), ("offset", "<f8", 3), ("description", "S32"),
    ]
)  # fmt: skip
_UNDESCRIBED = "extra_bytes"

_START = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1")]
_OLD = [*_START, ("raw_classification", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1"), ("point_source_id", "<u2")]
_NEW = [
    *_START, ("classification_flags", "u1"), ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2"),
    ("point_source_id", "<u2"), ("gps_time", "<f8"),
]  # fmt: skip
_TIME, _NIR = [("gps_time", "<f8")], [("nir", "<u2")]
_RGB = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
_WAVE = [
    ("wavepacket_index", "u1"), ("wavepacket_offset", "<u8"), ("wavepacket_size", "<u4"),
    ("return_point_wave_location", "<f4"), ("x_t", "<f4"), ("y_t", "<f4"), ("z_t", "<f4"),
]  # fmt: skip
_FIELDS = [
    _OLD, _OLD + _TIME, _OLD + _RGB, _OLD + _TIME + _RGB, _OLD + _TIME + _WAVE, _OLD + _TIME + _RGB + _WAVE,
    _NEW, _NEW + _RGB, _NEW + _RGB + _NIR, _NEW + _WAVE, _NEW + _RGB + _NIR + _WAVE,
]  # fmt: skip
"""The fields of point formats 0 to 10 (ASPRS LAS 1.4, tables 7 to 17) under laspy's names for them."""

_OLD_BITS = {
    "bit_fields": {"return_number": 0x07, "number_of_returns": 0x38, "scan_direction_flag": 0x40, "edge_of_flight_line": 0x80},
    "raw_classification": {"classification": 0x1F, "synthetic": 0x20, "key_point": 0x40, "withheld": 0x80},
}
_NEW_BITS = {
    "bit_fields": {"return_number": 0x0F, "number_of_returns": 0xF0},
    "classification_flags": {
        "synthetic": 0x01, "key_point": 0x02, "withheld": 0x04, "overlap": 0x08, "scanner_channel": 0x30,
        "scan_direction_flag": 0x40, "edge_of_flight_line": 0x80,
    },
}  # fmt: skip
"""Fields that hold several dimensions, each with the mask of its bits; _OLD_BITS up to format 5."""

_HAS_SCALE, _HAS_OFFSET = 8, 16


@dataclass(frozen=True)
class Dimension:
    """One per-point value: a field of the record, some bits of it, or one element, scaled or not."""

    name: str
    field: str
    mask: int = 0
    element: int | None = None
    scale: float = 1.0
    offset: float = 0.0

    def get(self, records: NDArray[Any]) -> Column:
        """(N,) values."""
        stored = self._stored(records)
        if self.mask:
            return (stored & self.mask) >> self._shift
        if not self._scaled:
            return stored
        with np.errstate(over="ignore", invalid="ignore"):  # a scale may be any number; the values say so
            return stored * self.scale + self.offset

    def holds(self, records: NDArray[Any], values: Column) -> bool:
        """Whether the record can store (N,) values exactly, or a scaled dimension to the nearest step."""
        return self._encoded(records, values) is not None

    def put(self, records: NDArray[Any], values: Column) -> None:
        """Store (N,) values in place. Raises ScanError if the record cannot hold one of them."""
        stored, fitting = self._stored(records), self._encoded(records, values)
        if fitting is None:
            raise ScanError(f"dimension {self.name} ({stored.dtype}) cannot hold the new values; use another name")
        stored[...] = (stored & ~np.uint8(self.mask)) | (fitting << self._shift) if self.mask else fitting

    def _encoded(self, records: NDArray[Any], values: Column) -> Column | None:
        raw = np.rint((values - self.offset) / self.scale) if self._scaled else values
        fitting = exactly(raw, self._stored(records).dtype)
        if fitting is not None and self.mask and int(fitting.max(initial=0)) > self.mask >> self._shift:
            return None
        return fitting

    def _stored(self, records: NDArray[Any]) -> Column:
        return records[self.field] if self.element is None else records[self.field][:, self.element]

    @property
    def _shift(self) -> int:
        return (self.mask & -self.mask).bit_length() - 1

    @property
    def _scaled(self) -> bool:
        return (self.scale, self.offset) != (1.0, 0.0)


def structured(file: LasFile) -> tuple[NDArray[Any], dict[str, Dimension]]:
    """The records as an (N,) structured array (a view), and every dimension but X, Y, Z by laspy's name for it.

    Extra bytes no VLR describes are dimensions too (extra_bytes_0, …), so that nothing per point is without a name.
    """
    fields: list[Any] = [(name, np.dtype(kind)) for name, kind in _FIELDS[file.point_format]]
    bits = _OLD_BITS if file.point_format <= 5 else _NEW_BITS
    dimensions: dict[str, Dimension] = {}
    for field, _ in fields:
        for name, mask in bits.get(field, {field: 0}).items():
            dimensions[name] = Dimension(name, field, mask)
    left = file.records.shape[1] - standard_length(file.point_format)
    for entry in _entries(file):
        dtype, n_elements = _number_type(entry)
        if dtype.itemsize * n_elements > left:
            break
        left -= dtype.itemsize * n_elements
        _add(fields, dimensions, entry["name"].decode("utf-8", "replace"), dtype, n_elements, entry)
    if left:
        _add(fields, dimensions, _UNDESCRIBED, np.dtype("u1"), left, np.zeros(1, _ENTRY)[0])
    for axis in "XYZ":
        del dimensions[axis]
    return file.records.reshape(-1).view(np.dtype(fields)), dimensions


def extended(file: LasFile, columns: Mapping[str, Column]) -> LasFile:
    """The file with further extra bytes holding these columns, described in its extra bytes VLR.

    Raises ScanError if the extra bytes it has are described wrongly, or a column is no number or its name too long for LAS.
    """
    if not columns:
        return file
    entries = _entries(file)
    n_described = sum(dtype.itemsize * n_elements for dtype, n_elements in map(_number_type, entries))
    n_undescribed = file.records.shape[1] - standard_length(file.point_format) - n_described
    if not 0 <= n_undescribed <= 255:
        raise ScanError("extra bytes are described wrongly, so no column can be added; repair its VLR first")
    data = entries.tobytes() + (_entry(_UNDESCRIBED, 0, n_undescribed) if n_undescribed else b"")
    blocks = [file.records]
    for name, given in columns.items():
        values = storable(given)
        if values is None or len(name.encode()) > 32:
            raise ScanError(f"column {name} ({given.dtype}) cannot be LAS extra bytes; rename it or make it a number")
        data += _entry(name, NUMBERS.index(values.dtype.str[1:]) + 1, 0)
        little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        blocks.append(little.view(np.uint8).reshape(len(values), little.itemsize))
    return replace(file, records=np.concatenate(blocks, axis=1)).with_vlr(*EXTRA_BYTES, b"extra bytes", data)


def reduced(file: LasFile, names: Collection[str]) -> LasFile:
    """The file without the extra bytes described under these names: what `extended` added goes, byte for byte."""
    entries = _entries(file)
    widths = [dtype.itemsize * n_elements for dtype, n_elements in map(_number_type, entries)]
    ends = standard_length(file.point_format) + np.cumsum(widths, dtype=np.int64)
    dropped = [entry["name"].decode("utf-8", "replace") in names for entry in entries]
    if not any(dropped) or ends[-1] > file.records.shape[1]:
        return file
    kept = np.ones(file.records.shape[1], dtype=np.bool_)
    for end, width, is_dropped in zip(ends.tolist(), widths, dropped, strict=True):
        kept[end - width : end] = not is_dropped
    left = entries[~np.array(dropped)].tobytes()
    slim = replace(file, records=np.ascontiguousarray(file.records[:, kept]))
    return slim.with_vlr(*EXTRA_BYTES, b"extra bytes", left) if left else slim.without_vlr(*EXTRA_BYTES)


def _entries(file: LasFile) -> NDArray[Any]:
    """All extra bytes descriptions of a file, in record order; a cut-off last one is left out."""
    data = b"".join(file.vlr(*EXTRA_BYTES))
    return np.frombuffer(data, _ENTRY, len(data) // _ENTRY.itemsize)


def _entry(name: str, kind: int, options: int) -> bytes:
    entry = np.zeros(1, _ENTRY)
    entry[0]["type"], entry[0]["options"], entry[0]["name"] = kind, options, name.encode()
    entry[0]["description"] = b"added by pcdenoise" if kind else b""
    return entry.tobytes()


def _number_type(entry: Any) -> tuple[np.dtype[Any], int]:
    """(number type, elements) of a description; type 0 is undescribed bytes, 11 to 30 are deprecated arrays of 2 or 3."""
    kind = int(entry["type"])
    if not 1 <= kind <= 30:
        return np.dtype("u1"), int(entry["options"])
    return np.dtype(NUMBERS[(kind - 1) % 10]).newbyteorder("<"), (kind - 1) // 10 + 1


def _add(
    fields: list[Any], dimensions: dict[str, Dimension], name: str, dtype: np.dtype[Any], n_elements: int, entry: Any
) -> None:
    """Append one extra field; n > 1 elements become n dimensions name_0, name_1, …, each under a name not yet taken."""
    if n_elements == 0:
        return
    field = f"extra {len(fields)}"
    fields.append((field, dtype, (n_elements,)))
    options = int(entry["options"]) if entry["type"] else 0
    for k in range(n_elements):
        label = (name or _UNDESCRIBED) + (f"_{k}" if n_elements > 1 else "")
        while label in dimensions or label in ("x", "y", "z"):
            label += "_"
        scale = float(entry["scale"][min(k, 2)]) if options & _HAS_SCALE else 1.0
        offset = float(entry["offset"][min(k, 2)]) if options & _HAS_OFFSET else 0.0
        dimensions[label] = Dimension(label, field, element=k, scale=scale or 1.0, offset=offset)
