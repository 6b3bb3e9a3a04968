"""Text scans (.xyz .txt .csv .asc .pts): any delimiter, header, comments, extra columns. Not here: rows and fields (text.py)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np

from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io.files import Raw, check_not_cut, let_go
from pcdenoise.io.lines import Octets, find_lines, first_visible, is_number
from pcdenoise.io.source import Column, changed, colours_as_bytes, exactly, moved_rows, portable
from pcdenoise.io.source import is_number as holds_numbers
from pcdenoise.io.text import NewFields, TextRows, commas_for_points, coordinate_form, coordinates, new_rows, plain
from pcdenoise.io.xyz_header import AXES, Layout, axis_of, decoded, unique

_UTF16 = (b"\xff\xfe", b"\xfe\xff")
_COUNTS = frozenset(["id", "fid", "oid", "nr", "no", "n°", "num", "number", "nummer", "pkt", "pkt-nr", "punkt", "point", "punto"])
"""What first columns are called that number the points."""
_FEWEST_COUNTED, _MOST_COUNTED = 20, 4096
_MOST_COLUMNS = 4096
_STREAM_HEAD = 4 << 20


@dataclass(frozen=True)
class XyzSource:
    """A text file: the bytes before the first row, the rows, where x, y and z stand, and the columns as read.

    indices    attribute name -> column.
    names_end  offset in `head` past the line that names the columns, if one does.
    unnamed    names of the columns that this line leaves out.
    count      span in `head` of a .pts file's point count, if there is one.
    """

    head: bytes
    rows: TextRows
    axes: tuple[int, int, int]
    read_points: Points
    columns: Mapping[str, Column]
    indices: Mapping[str, int]
    names_end: int | None
    count: tuple[int, int] | None
    unnamed: Sequence[str] = ()

    def points(self) -> Points:
        """(N, 3) coordinates as read."""
        return self.read_points

    def attachments(self) -> list[str]:
        """Nothing: a text file is its columns."""
        return []

    def payloads(self) -> dict[str, bytes]:
        """Nothing."""
        return {}

    def without(self, names: Collection[str]) -> XyzSource:
        """The file without these columns, in its rows and in the line that names the columns."""
        head = self.head
        if self.names_end is not None:
            joint = " " if self.rows.delimiter is None else chr(self.rows.delimiter)
            start = head.rfind(b"\n", 0, self.names_end) + 1
            line, coding = decoded(head[start : self.names_end])
            for name in names:
                line = line.replace(joint + name, "", 1)
            head = head[:start] + line.encode(coding) + head[self.names_end :]
        return self._with(head, self.rows.without([self.indices[name] for name in names]))

    def selected(self, keep: Mask) -> XyzSource:
        """The file with only these lines, its count line corrected. Raises ScanError if none is left."""
        if not keep.any():
            raise ScanError(f"{self.rows.origin}: no point is left, and a text scan cannot be empty; write .ply or .las instead")
        head = self.head
        if self.count is not None:
            head = head[: self.count[0]] + str(int(keep.sum())).encode() + head[self.count[1] :]
        return self._with(head, self.rows.selected(keep).body)

    def _with(self, head: bytes, body: Octets) -> XyzSource:
        raw = head + self.rows.as_in_file(body)
        source: XyzSource = read(raw, self.rows.origin, decimal_comma=self.rows.decimal_comma).source
        return source


def matches(head: bytes) -> bool:
    """Whether the first bytes of a file look like text; other formats are asked first."""
    return head[:2] in _UTF16 or b"\0" not in head


def read(raw: bytes, origin: str, *, decimal_comma: bool = False) -> Scan:
    """A scan of text bytes. Columns are found by the names x, y, z, or easting, northing, height and the like, in a header line
    or comment, else they are the first three.

    Other columns become attributes under their header name, else column_4, column_5, … counted from 1.
    decimal_comma: for a file that is known to have such numbers, whatever its first rows are.
    Raises ScanError naming the first line that lacks a coordinate, and where the first column counts rows.
    """
    if b"\0" in raw[:65536]:
        raise ScanError(f"{origin}: is binary or UTF-16, not text; name its real format or save it as UTF-8")
    octets = np.frombuffer(raw, np.uint8)
    starts, ends = find_lines(octets)
    layout = Layout.of(raw, first_visible(octets, starts, ends), ends, origin, decimal_comma=decimal_comma)
    body_start = int(starts[layout.first_row])
    rows = _rows(octets[body_start:], layout, origin, layout.first_row + 1)
    if layout.n_claimed > len(rows):
        raise ScanError(f"{origin}: its count line claims {layout.n_claimed} points, the file holds {len(rows)}; fetch it again")
    axes, names = _named(rows, layout, origin)
    points, columns = _columns(rows, axes, names)
    indices = {name: names.index(name) for name in columns}
    head, unnamed = raw[:body_start], names[len(layout.names) :]
    source = XyzSource(head, rows, axes, points, columns, indices, layout.names_end, layout.count, unnamed)
    return Scan(points, columns, "xyz", origin, source)


def _rows(octets: Octets, layout: Layout, origin: str, first_line: int) -> TextRows:
    """The rows among lines that are whole: neither blank nor comments."""
    if layout.decimal_comma:
        octets = commas_for_points(octets)
    starts, ends = find_lines(octets)
    visible = first_visible(octets, starts, ends)
    first = octets.take(visible, mode="clip") if len(octets) else octets
    second = octets.take(visible + 1, mode="clip") if len(octets) else octets
    is_row = (visible < ends) & (first != ord("#")) & ~((first == ord("/")) & (second == ord("/")))
    return TextRows(octets, starts[is_row], ends[is_row], layout.delimiter, origin, first_line, layout.decimal_comma)


def _named(rows: TextRows, layout: Layout, origin: str) -> tuple[tuple[int, int, int], list[str]]:
    """Where x, y and z stand, and the names of all columns."""
    n_fields = len(rows.first_fields())
    if n_fields > _MOST_COLUMNS:
        raise ScanError(f"{origin}: line {layout.first_row + 1} has {n_fields} columns, more than any scan; is it a point cloud?")
    names = unique([*layout.names, *(f"column_{i + 1}" for i in range(len(layout.names), n_fields))][:n_fields])
    for words in AXES:
        found = [axis_of(name, words) for name in names]
        if set(words.values()) <= set(found):
            return (found.index("x"), found.index("y"), found.index("z")), names
    if n_fields > 3 and layout.names and names[0].strip().lower() in _COUNTS:
        raise ScanError(
            f"{origin}: its first column is {names[0]}, and no names say which columns are x, y and z; name them in a first line"
        )
    if n_fields > 3 and _counts(replace(rows, starts=rows.starts[:_MOST_COUNTED], ends=rows.ends[:_MOST_COUNTED])):
        raise ScanError(
            f"{origin}: its first column counts the rows, so that nothing says which columns are x, y and z;"
            " name them in a first line, such as: id x y z"
        )
    return (0, 1, 2), names


def _counts(rows: TextRows) -> bool:
    """Whether the first column goes up by one from row to row, in so many rows that it cannot be a coordinate."""
    try:
        first = rows.numbers([0])[0]
    except ScanError:
        return False
    return len(first) >= _FEWEST_COUNTED and bool((np.diff(first) == 1).all())


class XyzStream:
    """A text file read and written in pieces of whole lines; each piece is a scan of some of its rows, without other columns."""

    def __init__(self, raw: Raw, origin: str) -> None:
        start = raw[:_STREAM_HEAD]
        start = start[: start.rfind(b"\n") + 1]
        octets = np.frombuffer(start, np.uint8)
        starts, ends = find_lines(octets)
        self.layout = Layout.of(start, first_visible(octets, starts, ends), ends, origin)
        self.body_start = int(starts[self.layout.first_row])
        self.axes, names = _named(
            _rows(octets[self.body_start :], self.layout, origin, self.layout.first_row + 1), self.layout, origin
        )
        self._unnamed = names[len(self.layout.names) :]
        self.raw, self.origin, self.format = raw, origin, "xyz"
        self._row_bytes = max(8, (len(start) - self.body_start) // max(1, len(starts) - self.layout.first_row))
        self.n_points = (len(raw) - self.body_start) // self._row_bytes + 1
        """Estimated from the first rows; exact once `pieces` has come to its end."""
        self._extent = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._decimals = [(0, True)] * 3
        self._is_known = False

    @classmethod
    def of(cls, raw: Raw, origin: str) -> XyzStream | None:
        """The stream of a file, or None where lines do not end in LF. Raises ScanError if it is no point cloud."""
        start = raw[:_STREAM_HEAD]
        return None if b"\0" in start or b"\n" not in start else cls(raw, origin)

    def pieces(self, n_rows: int) -> Iterator[Scan]:
        """Scans of about n_rows rows, in order. Raises ScanError naming the first line that lacks a coordinate."""
        at, line, n_points = self.body_start, self.layout.first_row + 1, 0
        while at < len(self.raw):
            check_not_cut(self.raw, self.origin)
            last = min(at + n_rows * self._row_bytes, len(self.raw)) - 1
            stop = (self.raw.find(b"\n", last) + 1) or len(self.raw)
            rows = _rows(np.frombuffer(self.raw[at:stop], np.uint8), self.layout, self.origin, line)
            points = np.stack(rows.numbers(self.axes), axis=1) if len(rows) else np.empty((0, 3))
            if not self._is_known:
                self._learn(rows, points)
            head = self.raw[: self.body_start] if at == self.body_start else b""
            names_end = self.layout.names_end if at == self.body_start else None
            source = XyzSource(head, rows, self.axes, points, {}, {}, names_end, None, self._unnamed)
            yield Scan(points, {}, "xyz", self.origin, source)
            let_go(self.raw)
            line += int((rows.body == 10).sum())
            at, n_points = stop, n_points + len(points)
        if self.layout.n_claimed > n_points:
            raise ScanError(f"{self.origin}: its count line claims {self.layout.n_claimed} points, the file holds {n_points}")
        self.n_points, self._is_known = n_points, True

    def _learn(self, rows: TextRows, points: Points) -> None:
        """What the form of a moved coordinate depends on: the extent and the decimals of all rows."""
        finite = points[np.isfinite(points).all(axis=1)]
        if len(finite):
            self._extent[0] = np.minimum(self._extent[0], finite.min(axis=0))
            self._extent[1] = np.maximum(self._extent[1], finite.max(axis=0))
        for i, column in enumerate(self.axes if len(rows) else ()):
            digits, exponent = rows.decimals(column)
            most, all_exponents = self._decimals[i]
            if exponent == all_exponents:
                self._decimals[i] = max(most, digits), exponent
            elif all_exponents:
                self._decimals[i] = digits, False

    def write(self, pieces: Iterable[Scan], file: BinaryIO, *, format: str, provenance: Mapping[str, Any] | None = None) -> None:
        """Write pieces of this stream, moved or with further columns, as `write` would write the whole."""
        if not self._is_known:
            for _ in self.pieces(_STREAM_HEAD // self._row_bytes):
                pass
        forms = [coordinate_form(self._extent, *decimals) for decimals in self._decimals]
        for piece in pieces:
            head, body = _own(piece, piece.source, forms)
            file.write(head)
            for octets in body:
                file.write(octets)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of columns that are text: their blanks and delimiters could break the rows."""
    return [name for name, values in columns.items() if not holds_numbers(values)]


def write(scan: Scan, file: BinaryIO, *, suffix: str = ".xyz") -> None:
    """Write a scan as text. The file's own lines stay but for moved coordinates and new columns.

    A scan from another format becomes x y z and its columns: comma and header for .csv, a count line for .pts,
    else blanks under a `#` comment that names the columns if there are more than three.
    """
    if isinstance(scan.source, XyzSource):
        head, body = _own(scan, scan.source, None)
    else:
        columns = {name: values for name, values in colours_as_bytes(portable(scan.attributes)).items() if holds_numbers(values)}
        delimiter = ord(",") if suffix == ".csv" else None
        head = _title(len(scan), suffix, list(columns))
        rows, fields = new_rows(scan.points, delimiter)
        body = rows.rewritten([*fields, *(plain(values) for values in columns.values())])
    file.write(head)
    for piece in body:
        file.write(piece)


def _own(scan: Scan, source: XyzSource, forms: Sequence[str] | None) -> tuple[bytes, Iterator[bytes]]:
    """The bytes before the rows of a scan that came from text, and of the rows; forms: of x, y and z, else from the rows."""
    columns = {name: values for name, values in changed(scan).items() if holds_numbers(values)}
    head, rows = source.head, source.rows
    before = source.points()
    moves = [(i, moved_rows(before[:, i], scan.points[:, i])) for i in range(3)]
    if forms is None:
        fields = [coordinates(rows, source.axes[i], before, scan.points[:, i], moved) for i, moved in moves if moved.any()]
    else:
        fields = [NewFields(scan.points[:, i], forms[i], source.axes[i], moved) for i, moved in moves if moved.any()]
    fields += [plain(columns.pop(name), index) for name, index in source.indices.items() if name in columns]
    fields.sort(key=lambda change: change.column if isinstance(change.column, int) else 0)
    if source.names_end is not None:
        joint = " " if rows.delimiter is None else chr(rows.delimiter)
        names = "".join(joint + name.replace(joint, "_") for name in [*(source.unnamed if columns else ()), *columns])
        head = head[: source.names_end] + names.encode() + head[source.names_end :]
    return head, rows.rewritten([*fields, *(plain(values) for values in columns.values())])


def _columns(rows: TextRows, axes: tuple[int, int, int], names: Sequence[str]) -> tuple[Points, dict[str, Column]]:
    """(N, 3) points, and every other column that all rows have: whole numbers as int64, else float64, else text."""
    first = rows.first_fields()
    others = [i for i in range(len(names)) if i not in axes]
    numeric = [i for i in others if is_number(first[i])]
    try:
        values = rows.numbers([*axes, *numeric])
    except ScanError:  # raised again by the next line if it is a coordinate that is wrong
        values, numeric = rows.numbers(axes), []
    read = dict(zip(numeric, values[3:], strict=True))
    n_common = len(first) if len(read) == len(others) else rows.n_fields()
    columns = {names[i]: _whole(rows, i, read[i]) if i in read else _number_or_text(rows, i) for i in others if i < n_common}
    return np.stack(values[:3], axis=1), columns


def _number_or_text(rows: TextRows, column: int) -> Column:
    try:
        return _whole(rows, column, rows.numbers([column])[0])
    except ScanError:
        return rows.texts(column)


def _whole(rows: TextRows, column: int, values: Column) -> Column:
    """The column as int64 if every value is whole; beyond 2^53 its digits are read again, since float64 rounds them."""
    whole = exactly(values, "i8")
    if whole is not None and len(whole) and np.abs(values).max() >= 2.0**53:
        try:
            return rows.texts(column).astype(np.int64)
        except (ValueError, OverflowError):
            return values
    return values if whole is None else whole


def _title(n_rows: int, suffix: str, names: Sequence[str]) -> bytes:
    """What stands before the rows of a new file."""
    delimiter = "," if suffix == ".csv" else " "
    title = delimiter.join(["x", "y", "z", *(name.replace(delimiter, "_") for name in names)])
    head = f"{title}\n" if suffix == ".csv" else f"{n_rows}\n" if suffix == ".pts" else f"# {title}\n" if names else ""
    return head.encode()
