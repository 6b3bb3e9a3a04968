"""What every format module keeps of the file a scan was read from, and names shared by conversions. Not here: any file layout."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points, Scan

Column = NDArray[Any]
"""(N,) values of one attribute."""

NUMBERS = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
"""The number types that LAS extra bytes and PCD know, in the order of LAS' codes for them."""

STATION = "station"
"""The column that says which station measured a point, where a file has several."""

_COMMON_NAMES = {
    "r": "red", "g": "green", "b": "blue", "a": "alpha", "diffuse_red": "red", "diffuse_green": "green", "diffuse_blue": "blue",
    "normal_x": "nx", "normal_y": "ny", "normal_z": "nz", "scalar_intensity": "intensity", "gpstime": "gps_time",
}  # fmt: skip
_KNOWN = {"red", "green", "blue", "alpha", "nx", "ny", "nz", "intensity", "classification", "label", "time"}
_COLOURS = ("red", "green", "blue")


class Source(Protocol):
    """A file taken apart: enough to write it back as it was, with some coordinates and columns replaced."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """The attributes as read; a scan's attribute that is not this very array has been changed or added."""

    def points(self) -> Points:
        """(N, 3) coordinates as read."""

    def attachments(self) -> list[str]:
        """What the file holds beside points and columns, in words, for whoever writes another format."""

    def payloads(self) -> dict[str, bytes]:
        """The bytes of what the file holds beside points and columns, by name, without what only says how these are stored."""

    def without(self, names: Collection[str]) -> Source:
        """The file without the columns of these names and without our provenance: the inverse of adding them."""

    def selected(self, keep: Mask) -> Source:
        """The file with only these rows. Raises ScanError if other parts of it refer to rows."""


def changed(scan: Scan) -> dict[str, Column]:
    """The attributes that differ from the file the scan came from; all of them if it came from none."""
    known: Mapping[str, Column] = scan.source.columns if scan.source is not None else {}
    return {name: values for name, values in scan.attributes.items() if known.get(name) is not values}


def moved_rows(before: Column, after: Column) -> Mask:
    """(N,) where a coordinate changed; NaN that stayed NaN did not."""
    moved: Mask = (before != after) & ~(np.isnan(before) & np.isnan(after))
    return moved


def moved_points(before: Points, after: Points) -> Mask:
    """(N,) rows of which a coordinate changed."""
    moved: Mask = np.logical_or.reduce([moved_rows(before[:, i], after[:, i]) for i in range(3)])
    return moved


def station_numbers(sizes: Sequence[int]) -> Column:
    """(N,) the number of the station that each point is of, from how many points each has."""
    return np.repeat(np.arange(len(sizes), dtype=np.min_scalar_type(len(sizes) - 1)), sizes)


def free_name(name: str, taken: Iterable[str]) -> str:
    """The name without blanks, with underscores behind it until no other has it."""
    used = set(taken)
    name = "_".join(name.split()) or "column"
    while name in used:
        name += "_"
    return name


def portable(attributes: Mapping[str, Column]) -> dict[str, Column]:
    """The columns under the names most formats share (R to red, normal_x to nx, …), unless that name is taken."""
    columns: dict[str, Column] = {}
    for name, values in attributes.items():
        low = name.lower()
        common = _COMMON_NAMES.get(low, low if low in _KNOWN else name)
        taken = common in columns or (common != name and common in attributes)
        columns[name if taken else common] = values
    return columns


def is_number(values: Column) -> bool:
    """Whether a column holds numbers or truth values, not text."""
    return values.dtype.kind in "biuf"


def storable(values: Column) -> Column | None:
    """The column in one of NUMBERS (truth values as uint8, half floats as float32), or None for text."""
    if values.dtype.kind == "b":
        return values.astype("u1")
    if values.dtype == np.float16:
        return values.astype("f4")
    return values if values.dtype.str[1:] in NUMBERS else None


def exactly(values: Column, dtype: Any) -> Column | None:
    """The column in another number type, or None if a value would change."""
    target = np.dtype(dtype)
    if values.dtype == target:
        return values
    if not is_number(values):
        return None
    if target.kind in "iu" and len(values):
        low, high = values.min(), values.max()  # NaN fails both comparisons
        if not (low >= np.iinfo(target).min and high <= np.iinfo(target).max):
            return None
    with np.errstate(over="ignore", invalid="ignore"):
        converted = values.astype(target)
        same = (converted.astype(values.dtype) == values) | ((values != values) & (converted != converted))
    return converted if bool(same.all()) else None


def first_exact(values: Column, dtypes: Iterable[str]) -> Column | None:
    """The column in the first of several number types that holds every value, or None."""
    return next((found for dtype in dtypes if (found := exactly(values, dtype)) is not None), None)


def colours_as_bytes(columns: dict[str, Column]) -> dict[str, Column]:
    """Red, green and blue as uint8 where nothing is lost: values up to 255, or 8-bit values times 257 or 256."""
    rgb = [columns[name] for name in _COLOURS if name in columns]
    if len(rgb) == 3 and all(values.dtype.kind in "iu" for values in rgb):
        for factor in (1, 257, 256):
            small = [exactly(values // factor, "u1") for values in rgb if not (values % factor).any()]
            if len(small) == 3 and all(values is not None for values in small):
                return {**columns, **{name: values for name, values in zip(_COLOURS, small, strict=True) if values is not None}}
    return columns


def colours_as_words(columns: dict[str, Column]) -> dict[str, Column]:
    """8-bit red, green and blue as the 16-bit ones LAS asks for, times 256; wider ones stay as they are."""
    small = {name: exactly(columns[name], "u1") for name in _COLOURS if name in columns and columns[name].dtype != np.uint16}
    if len(small) < 3 or any(values is None for values in small.values()):
        return columns
    return {**columns, **{name: values.astype("u2") * np.uint16(256) for name, values in small.items() if values is not None}}


def step_decimals(points: Points, relative: float) -> int:
    """Decimals d >= 0 such that 10^-d is at most `relative` times the largest extent of the finite (N, 3) points."""
    finite = points[np.isfinite(points).all(axis=1)]
    extent = float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0
    return max(0, int(np.ceil(-np.log10(relative * (extent or 1.0)))))


def narrowest_float(points: Points) -> str:
    """'f4' if every coordinate is a float32 already, else 'f8'."""
    return "f8" if exactly(points.reshape(-1), "f4") is None else "f4"
