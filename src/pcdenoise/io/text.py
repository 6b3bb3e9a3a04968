"""Rows of text fields inside a file's bytes: read, replace and append columns. Not here: which column means what.

The bytes are never turned into a list of lines: a row is a pair of offsets, a change is a splice. XYZ, PTX, ASCII PLY and
ASCII PCD share this.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.errors import ScanError
from pcdenoise.io.lines import BLANK, CR, LF, LONGEST_PADDING, QUOTE, Octets, Offsets, is_number, spliced, split_fields, without
from pcdenoise.io.source import Column, step_decimals

ColumnIndex = int | Offsets
"""Which field of a row: the same in all, or (N,) one for each row (fields after a list shift)."""

_BLOCK_BYTES = 4 << 20
_BLOCK_ROWS = 1 << 16
_LONGEST_NUMBER = 64
_LONGEST_TEXT = 256
COORDINATE_STEP = 1e-6
_NEW_FILE_STEP = 1e-9
_EXCHANGED = np.frombuffer(bytes(range(256)).translate(bytes.maketrans(b",.", b".,")), np.uint8)
_PLAIN = np.array([byte in (9, LF, CR) or (BLANK <= byte < 127 and byte != QUOTE) for byte in range(256)])


@dataclass(frozen=True)
class NewFields:
    """Values to write into a column of text: printf format `form`, in the rows chosen; column None appends to every row."""

    values: NDArray[Any]
    form: str
    column: ColumnIndex | None = None
    rows: Mask | None = None


@dataclass(frozen=True)
class TextRows:
    """N rows of delimited text.

    body        the bytes the rows lie in, with whatever stands between them (comments, blank lines).
    starts      (N,) offset in `body` of each row's line.
    ends        (N,) offset past its last byte, before the line ending.
    delimiter   the separating byte, or None for runs of blanks.
    origin      the file, for messages.
    first_line  number of the line that `body` starts with.
    decimal_comma  whether `body` has a point wherever the file has a comma, and a comma wherever it has a point.
    """

    body: Octets
    starts: Offsets
    ends: Offsets
    delimiter: int | None
    origin: str
    first_line: int
    decimal_comma: bool = False

    def __len__(self) -> int:
        return len(self.starts)

    def first_fields(self) -> list[bytes]:
        """The fields of the first row without the blanks and quotes around them; none if there is no row."""
        return split_fields(self.body[self.starts[0] : self.ends[0]].tobytes(), self.delimiter) if len(self) else []

    def n_fields(self) -> int:
        """How many fields every row has at least."""
        return min((int(_Fields.of(self, *block).counts.min()) for block in self._blocks()), default=0)

    def numbers(self, columns: Sequence[ColumnIndex]) -> list[NDArray[np.float64]]:
        """(N,) values of each column. Raises ScanError naming the first line where a field is missing or not a number."""
        if (quick := self._quick_numbers(columns)) is not None:
            return quick
        values = [np.empty(len(self)) for _ in columns]
        for first, last in self._blocks():
            fields = _Fields.of(self, first, last)
            for value, column in zip(values, columns, strict=True):
                value[first:last] = self._parsed(first, *fields.spans(column))
        return values

    def texts(self, column: ColumnIndex) -> NDArray[Any]:
        """(N,) fields as the file has them, as strings, cut after 256 bytes."""
        blocks = [np.empty(0, "S1")]
        for block in self._blocks():
            starts, ends = _Fields.of(self, *block).spans(column)
            blocks.append(_gathered(self.body, starts, np.minimum(ends - starts, _LONGEST_TEXT)))
        fields = np.concatenate(blocks)
        if self.decimal_comma:
            fields = commas_for_points(fields.view(np.uint8)).view(fields.dtype)
        return np.char.decode(fields, "utf-8", "replace")

    def decimals(self, column: ColumnIndex) -> tuple[int, bool]:
        """(most digits after the point, whether all have an exponent), from up to 4096 evenly spread rows."""
        digits = {True: 0, False: -1}
        for row in np.unique(np.linspace(0, len(self) - 1, min(len(self), 4096)).astype(np.int64)).tolist():
            fields = split_fields(self.body[self.starts[row] : self.ends[row]].tobytes(), self.delimiter)
            mantissa, e, _ = fields[column if isinstance(column, int) else int(column[row])].lower().partition(b"e")
            digits[bool(e)] = max(digits[bool(e)], len(mantissa.partition(b".")[2]))
        return (digits[True], True) if digits[False] < 0 else (digits[False], False)

    def rewritten(self, changes: Sequence[NewFields]) -> Iterator[bytes]:
        """The file's bytes with fields replaced and appended, in pieces; changes ordered by column, appended ones last."""
        at = 0
        for first, last in self._blocks() if changes else ():
            stop = int(self.ends[last - 1])
            yield self.as_in_file(self._rewritten_block(changes, first, last, at, stop))
            at = stop
        yield self.as_in_file(self.body[at:])

    def as_in_file(self, octets: Octets) -> bytes:
        """Bytes of a body like this one as they stand in the file."""
        return (commas_for_points(octets) if self.decimal_comma else octets).tobytes()

    def _rewritten_block(self, changes: Sequence[NewFields], first: int, last: int, at: int, stop: int) -> Octets:
        """Bytes `at` to `stop` of the body, which end with row `last`, with the fields of rows `first` to `last` changed."""
        fields = _Fields.of(self, first, last)
        joint = " " if self.delimiter is None else chr(self.delimiter)
        starts, lengths, new_starts, new_lengths = np.zeros((4, last - first, len(changes)), np.int64)
        used = np.ones((last - first, len(changes)), np.bool_)
        printed = [np.empty(0, np.uint8)]
        for k, change in enumerate(changes):
            chosen = used[:, k]
            if change.rows is not None:
                chosen[:] = change.rows[first:last]
            if change.column is None:
                starts[:, k] = self.ends[first:last]
            else:
                starts[:, k], ends = fields.spans(change.column)
                lengths[:, k] = ends - starts[:, k]
            form = joint + change.form if change.column is None else change.form
            octets, sizes = _printed(change.values[first:last][chosen], form)
            new_lengths[chosen, k] = sizes
            new_starts[chosen, k] = sum(map(len, printed)) + np.cumsum(sizes) - sizes
            printed.append(octets)
        new = np.concatenate(printed)
        return spliced(self.body[at:stop], starts[used] - at, lengths[used], new, new_starts[used], new_lengths[used])

    def selected(self, keep: Mask) -> TextRows:
        """The rows kept; the lines of the others go, what stands between rows stays."""
        after = self.ends.copy()
        for byte in (CR, LF):
            inside = after < len(self.body)
            after[inside] += self.body[after[inside]] == byte
        removed = np.where(keep, 0, after - self.starts)
        body = without(self.body, self.starts[~keep], removed[~keep])
        shift = (np.cumsum(removed) - removed)[keep]
        return replace(self, body=body, starts=self.starts[keep] - shift, ends=self.ends[keep] - shift)

    def without(self, columns: Sequence[ColumnIndex]) -> Octets:
        """The body without fields that are not the first of their row, each with the one byte before it, as `rewritten` adds."""
        spans = [_Fields.of(self, *block).spans(column) for block in self._blocks() for column in columns]
        starts = np.concatenate([np.zeros(0, np.int64), *(starts - 1 for starts, _ in spans)])
        ends = np.concatenate([np.zeros(0, np.int64), *(ends for _, ends in spans)])
        return without(self.body, starts, ends - starts)

    def fault(self, row: int, what: str) -> ScanError:
        """An error that names the line of a row."""
        before = self.body[: self.starts[row]]
        n_lines = int((before == LF).sum()) or int((before == CR).sum())
        return ScanError(f"{self.origin}: line {self.first_line + n_lines}: {what}")

    def _blocks(self) -> Iterator[tuple[int, int]]:
        """Row ranges of at most 65536 rows and about 4 MB of text."""
        first = 0
        while first < len(self):
            last = int(np.searchsorted(self.starts, self.starts[first] + _BLOCK_BYTES))
            last = min(max(last, first + 1), first + _BLOCK_ROWS)
            yield first, last
            first = last

    def _quick_numbers(self, columns: Sequence[ColumnIndex]) -> list[NDArray[np.float64]] | None:
        """The columns by numpy's own reader, or None where it does not see the same rows: the careful way then finds out why."""
        indices = [column for column in columns if isinstance(column, int)]
        if not len(self) or len(indices) < len(columns):
            return None
        span = self.body[self.starts[0] : self.ends[-1]]
        if not _PLAIN[span].all():  # numpy knows other blanks and no quotes
            return None
        text = BytesIO(span.tobytes())
        delimiter = None if self.delimiter is None else chr(self.delimiter)
        try:
            table = np.loadtxt(text, usecols=indices, delimiter=delimiter, comments=None, ndmin=2, encoding="utf-8")
        except ValueError:
            return None
        return list(table.T) if len(table) == len(self) else None

    def _parsed(self, first: int, starts: Offsets, ends: Offsets) -> NDArray[np.float64]:
        lengths = ends - starts
        fields = _gathered(self.body, starts, np.minimum(lengths, _LONGEST_NUMBER + 1))
        try:
            if int(lengths.max()) > _LONGEST_NUMBER:
                raise ValueError
            return fields.astype(np.float64)
        except ValueError:
            row = next(i for i, field in enumerate(fields.tolist()) if not is_number(field) or len(field) > _LONGEST_NUMBER)
            shown = self.as_in_file(np.frombuffer(fields[row][:20], np.uint8)).decode("utf-8", "replace")
            raise self.fault(first + row, f"'{shown}' is not a number; correct the line or remove it") from None


def commas_for_points(octets: Octets) -> Octets:
    """Bytes with commas where there are points and points where there are commas; twice, they are what they were."""
    return _EXCHANGED[octets]


@dataclass(frozen=True)
class _Fields:
    """The fields of a block of rows: row i's are `starts[heads[i]]` onwards, `counts[i]` of them."""

    rows: TextRows
    first: int
    starts: Offsets
    ends: Offsets
    heads: Offsets
    counts: Offsets

    @classmethod
    def of(cls, rows: TextRows, first: int, last: int) -> _Fields:
        row_starts, row_ends = rows.starts[first:last], rows.ends[first:last]
        base = int(row_starts[0])
        block = rows.body[base : int(row_ends[-1])]
        if rows.delimiter is None:
            edges = np.flatnonzero(np.diff(block > BLANK, prepend=False, append=False)) + base
            starts, ends = edges[0::2], edges[1::2]
        else:
            places = np.flatnonzero(block == rows.delimiter) + base
            row = np.searchsorted(row_starts, places, side="right") - 1
            places, row = places[places < row_ends[row]], row[places < row_ends[row]]
            quotes = np.flatnonzero(block == QUOTE) + base
            if len(quotes):
                n_before = np.searchsorted(quotes, places) - np.searchsorted(quotes, row_starts)[row]
                places = places[n_before % 2 == 0]
            starts = np.sort(np.concatenate([row_starts, places + 1]), kind="stable")
            ends = np.sort(np.concatenate([row_ends, places]), kind="stable")
        heads = np.searchsorted(starts, row_starts)
        return cls(rows, first, starts, ends, heads, np.searchsorted(starts, row_ends, side="right") - heads)

    def spans(self, column: ColumnIndex) -> tuple[Offsets, Offsets]:
        """Start and end of one field in each row. Raises ScanError naming the first line that lacks it."""
        index = column if isinstance(column, int) else column[self.first : self.first + len(self.heads)]
        short = np.flatnonzero(self.counts <= index)
        if len(short):
            raise self.rows.fault(
                self.first + int(short[0]), f"has {self.counts[short[0]]} columns, too few; correct the line or remove it"
            )
        starts, ends = self.starts[self.heads + index], self.ends[self.heads + index]
        for _ in range(LONGEST_PADDING):
            before, after = (starts < ends) & self._is_padding(starts), (starts + 1 < ends) & self._is_padding(ends - 1)
            if not (before | after).any():
                break
            starts, ends = starts + before, ends - after
        return starts, ends

    def _is_padding(self, places: Offsets) -> Mask:
        bytes_there = self.rows.body.take(places, mode="clip")
        padding: Mask = (bytes_there <= BLANK) | (bytes_there == QUOTE)
        return padding


def _gathered(body: Octets, starts: Offsets, lengths: Offsets) -> NDArray[np.bytes_]:
    """(n,) byte strings of the spans given."""
    width = max(1, int(lengths.max(initial=0)))
    columns = np.arange(width)
    letters = np.where(columns < lengths[:, None], body.take(starts[:, None] + columns, mode="clip"), np.uint8(0))
    return letters.view(f"S{width}").reshape(-1)


def _printed(values: NDArray[Any], form: str) -> tuple[Octets, Offsets]:
    """Values printed one after the other, and the length of each."""
    lines = np.frombuffer((f"{form}\n" * len(values) % tuple(values.tolist())).encode(), np.uint8)
    breaks = np.flatnonzero(lines == LF)
    lengths = np.diff(breaks, prepend=-1) - 1
    return lines[lines != LF], lengths


def coordinates(rows: TextRows, column: ColumnIndex, before: Points, after: Column, moved: Mask) -> NewFields:
    """New fields for one coordinate of the rows that moved: the column's decimals, but a step of at most 1e-6 of the extent.

    Values that are short decimals themselves, as those a file gave before they moved, are printed exactly.
    """
    if (short := fewest_decimals(after[moved])) is not None:
        return NewFields(after, f"%.{short}f", column, moved)
    return NewFields(after, coordinate_form(before, *rows.decimals(column)), column, moved)


def coordinate_form(before: Points, digits: int, exponent: bool) -> str:
    """The printf format of `coordinates`, for (N, 3) points of the extent and size of all and a column's decimals."""
    needed = step_decimals(before, COORDINATE_STEP)
    if exponent:
        size = float(np.abs(before[np.isfinite(before)]).max(initial=1.0))
        return f"%.{min(max(digits, needed + int(np.ceil(np.log10(size)))), 17)}e"
    return f"%.{min(max(digits, needed), 17)}f"


def fewest_decimals(values: Column) -> int | None:
    """The fewest decimals, up to 12, that all values have; None if some have more, or all that float64 can hold there."""
    values = values[np.isfinite(values)]
    finest = np.spacing(np.abs(values).max(initial=1e-3))
    for decimals in range(min(13, int(-np.log10(finest)))):
        if all(
            bool((np.abs(np.round(some, decimals) - some) <= np.spacing(np.abs(some))).all()) for some in (values[:64], values)
        ):
            return decimals
    return None


def new_rows(points: Points, delimiter: int | None) -> tuple[TextRows, list[NewFields]]:
    """Rows of a file that is not there yet, a field each, and what makes it x of (N, 3) points and puts y and z behind it."""
    starts = np.arange(len(points), dtype=np.int64) * 2
    rows = TextRows(np.frombuffer(b"0\n" * len(points), np.uint8), starts, starts + 1, delimiter, "<new>", 1)
    form = f"%.{min(step_decimals(points, _NEW_FILE_STEP), 15)}f"
    return rows, [NewFields(points[:, i], form, 0 if i == 0 else None) for i in range(3)]


def plain(values: Column, column: ColumnIndex | None = None) -> NewFields:
    """A column printed so that it reads back as the same numbers, in as few digits as that takes."""
    if values.dtype.kind == "f":
        return NewFields(values, "%r", column) if values.dtype == np.float64 else NewFields(values.astype(str), "%s", column)
    return NewFields(values.astype(np.int64) if values.dtype.kind == "b" else values, "%s", column)
