"""Per-point records in the body of a file, binary or text: read, replace and add named fields. Not here: headers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.errors import ScanError
from pcdenoise.io.lines import Octets, Offsets, spliced, without
from pcdenoise.io.source import Column, exactly, moved_rows
from pcdenoise.io.text import ColumnIndex, TextRows, coordinates, plain

_AXES = ("x", "y", "z")


class Records(Protocol):
    """N records of named fields, x, y and z among them; none of the methods changes the records."""

    def points(self) -> Points:
        """(N, 3) coordinates."""

    def column(self, name: str) -> Column:
        """(N,) values of one field, in the file's number type."""

    def rewritten(self, points: Points, changes: Mapping[str, Column], added: Mapping[str, Column]) -> Iterator[bytes]:
        """The bytes of the records with moved coordinates, changed fields and further fields; ScanError if one does not fit."""

    def selected(self, keep: Mask) -> bytes:
        """The bytes of the records kept."""

    def without(self, names: Collection[str]) -> bytes:
        """The bytes of the records without these fields."""


@dataclass(frozen=True)
class FixedRecords:
    """Binary records of one size: a structured array whose x, y, z are the fields named in `axes`."""

    array: NDArray[Any]
    axes: tuple[str, str, str] = _AXES

    def points(self) -> Points:
        return _stacked(self.array[name] for name in self.axes)

    def column(self, name: str) -> Column:
        return self.array[name]

    def rewritten(self, points: Points, changes: Mapping[str, Column], added: Mapping[str, Column]) -> Iterator[bytes]:
        old = self.array.dtype
        dtype = [(name, old[name]) for name in old.names or ()] + [(name, values.dtype) for name, values in added.items()]
        array = np.empty(len(self.array), dtype)
        for name in old.names or ():
            array[name] = encoded(changes[name], old[name], name) if name in changes else self.array[name]
        for name, values in added.items():
            array[name] = values
        for i, rows in _moves(self.points(), points):
            array[self.axes[i]][rows] = encoded(points[rows, i], old[self.axes[i]], "xyz"[i])
        yield array.tobytes()

    def selected(self, keep: Mask) -> bytes:
        return self.array[keep].tobytes()

    def without(self, names: Collection[str]) -> bytes:
        left = [name for name in self.array.dtype.names or () if name not in names]
        return repack_fields(self.array[left]).tobytes()


@dataclass(frozen=True)
class ListRecords:
    """Binary records with lists of changing length: the bytes, where each record ends, where each single value stands."""

    body: Octets
    ends: Offsets
    offsets: Mapping[str, Offsets]
    dtypes: Mapping[str, np.dtype[Any]]
    axes: tuple[str, str, str] = _AXES

    def points(self) -> Points:
        return _stacked(map(self.column, self.axes))

    def column(self, name: str) -> Column:
        dtype = self.dtypes[name]
        octets = self.body[self.offsets[name][:, None] + np.arange(dtype.itemsize)]
        return np.frombuffer(octets.tobytes(), dtype)

    def rewritten(self, points: Points, changes: Mapping[str, Column], added: Mapping[str, Column]) -> Iterator[bytes]:
        body = self.body.copy()
        for name, values in changes.items():
            _put(body, self.offsets[name], encoded(values, self.dtypes[name], name))
        for i, rows in _moves(self.points(), points):
            _put(body, self.offsets[self.axes[i]][rows], encoded(points[rows, i], self.dtypes[self.axes[i]], "xyz"[i]))
        new = np.concatenate([_octets(values) for values in added.values()] or [np.empty((len(self.ends), 0), np.uint8)], axis=1)
        sizes = np.full(len(self.ends), new.shape[1], np.int64)
        yield spliced(body, self.ends, sizes * 0, new.reshape(-1), np.cumsum(sizes) - sizes, sizes).tobytes()

    def selected(self, keep: Mask) -> bytes:
        starts = np.concatenate([np.zeros(1, np.int64), self.ends])[: len(self.ends)]
        return without(self.body, starts[~keep], (self.ends - starts)[~keep]).tobytes()

    def without(self, names: Collection[str]) -> bytes:
        starts = np.concatenate([np.zeros(0, np.int64), *(self.offsets[name] for name in names)])
        sizes = np.repeat([self.dtypes[name].itemsize for name in names], len(self.ends))
        return without(self.body, starts, sizes.astype(np.int64)).tobytes()


@dataclass(frozen=True)
class TextRecords:
    """Records as rows of text; `fields` gives each single value's place in the row and number type."""

    rows: TextRows
    fields: Mapping[str, tuple[ColumnIndex, np.dtype[Any]]]
    axes: tuple[str, str, str] = _AXES

    def points(self) -> Points:
        return np.stack(self.rows.numbers([self.fields[name][0] for name in self.axes]), axis=1)

    def column(self, name: str) -> Column:
        index, dtype = self.fields[name]
        values = self.rows.numbers([index])[0]
        typed = values.astype(dtype) if dtype.kind == "f" else exactly(values, dtype)
        return values if typed is None else typed

    def rewritten(self, points: Points, changes: Mapping[str, Column], added: Mapping[str, Column]) -> Iterator[bytes]:
        before = self.points()
        new = {name: plain(encoded(values, self.fields[name][1], name), self.fields[name][0]) for name, values in changes.items()}
        for i, name in enumerate(self.axes):
            index, dtype = self.fields[name]
            rows = moved_rows(before[:, i], points[:, i])
            if rows.any() and dtype.kind in "iu":
                new[name] = replace(plain(encoded(points[:, i], dtype, "xyz"[i]), index), rows=rows)
            elif rows.any():
                new[name] = coordinates(self.rows, index, before, points[:, i], rows)
        ordered = [new[name] for name in self.fields if name in new]
        yield from self.rows.rewritten([*ordered, *(plain(values) for values in added.values())])

    def selected(self, keep: Mask) -> bytes:
        return self.rows.selected(keep).body.tobytes()

    def without(self, names: Collection[str]) -> bytes:
        return self.rows.without([self.fields[name][0] for name in names]).tobytes()


def encoded(values: Column, dtype: np.dtype[Any], name: str) -> Column:
    """Values in a field's number type. Raises ScanError where whole numbers would have to round or floats overflow."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            fitting = values.astype(dtype)
        if not (np.isinf(fitting) & np.isfinite(values)).any():
            return fitting
    elif (exact := exactly(values, dtype)) is not None:
        return exact
    raise ScanError(f"{name} is stored as {dtype.name}, which cannot hold the new values; write another format")


def _stacked(axes: Iterable[Column]) -> Points:
    with np.errstate(invalid="ignore"):  # a NaN may be a signalling one
        return np.stack([values.astype(np.float64) for values in axes], axis=1)


def _moves(before: Points, after: Points) -> Iterator[tuple[int, Mask]]:
    """Each axis along which rows moved, and which did."""
    for i in range(3):
        rows = moved_rows(before[:, i], after[:, i])
        if rows.any():
            yield i, rows


def _octets(values: Column) -> Octets:
    """(N, itemsize) bytes of N values."""
    return np.ascontiguousarray(values).view(np.uint8).reshape(len(values), values.dtype.itemsize)


def _put(body: Octets, places: Offsets, values: Column) -> None:
    body[places[:, None] + np.arange(values.dtype.itemsize)] = _octets(values)
