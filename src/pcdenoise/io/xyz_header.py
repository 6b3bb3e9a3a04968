"""Text scans before their first row: delimiter, decimal mark, column names, a count. Not here: the rows (xyz.py)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pcdenoise.errors import ScanError
from pcdenoise.io.lines import Offsets, is_number, split_fields

_DELIMITERS = (ord(";"), ord(","), ord("\t"), None)
_COMMENTS = (b"#", b"//")
_BOM = b"\xef\xbb\xbf"
_EAST = "e east easting x_coord xcoord coord_x rechts rechtswert ost ostwert est este oost"
_NORTH = "n north northing y_coord ycoord coord_y hoch hochwert nord nordwert norte noord"
_HEIGHT = "h height elev elevation alt altitude z z_coord zcoord coord_z höhe hoehe cota quota altura hoogte"
AXES: tuple[Mapping[str, str], ...] = (
    {"x": "x", "y": "y", "z": "z"},
    {
        **dict.fromkeys([*_EAST.split(), "x coordinate"], "x"),
        **dict.fromkeys([*_NORTH.split(), "y coordinate"], "y"),
        **dict.fromkeys([*_HEIGHT.split(), "z coordinate"], "z"),
    },
)
"""What columns are called that hold coordinates; the first set that is complete counts."""
_MOST_TITLES = 1000
_LONGEST_LINE = 1 << 17


@dataclass(frozen=True)
class Layout:
    """What the lines before the first row say; `first_row` is that row's line, counted from 0.

    decimal_comma: whether its numbers are written as 1,5.
    """

    first_row: int
    delimiter: int | None
    decimal_comma: bool
    names: list[str]
    names_end: int | None
    count: tuple[int, int] | None
    n_claimed: int

    @classmethod
    def of(cls, raw: bytes, visible: Offsets, ends: Offsets, origin: str) -> Layout:
        """Read on to the first line with three numbers; before it stand only comments, one count and lines without a number."""
        titles: list[tuple[bytes, int]] = []
        count: tuple[int, int] | None = None
        for i, (start, end) in enumerate(zip(visible[:_MOST_TITLES].tolist(), ends[:_MOST_TITLES].tolist(), strict=True)):
            line = raw[start:end].removeprefix(_BOM)
            if len(line) > _LONGEST_LINE:
                raise ScanError(f"{origin}: line {i + 1} has {len(line)} bytes; is it a point cloud?")
            if line.startswith(_COMMENTS):
                titles.append((line, end))
                continue
            n_numbers, fields, delimiter = _read_best(line)
            with_commas = (0, fields, delimiter) if b"." in line else _read_best(line.replace(b",", b"."))
            if has_commas := with_commas[0] > n_numbers:
                n_numbers, fields, delimiter = with_commas
            if n_numbers >= 3:
                names, names_end = _names(titles, delimiter, len(fields))
                claimed = int(raw[slice(*count)]) if count else 0
                return cls(i, delimiter, has_commas, names, names_end, count, claimed)
            if count is None and len(fields) == 1 and line.strip().isdigit() and len(line) < 19:
                count = (end - len(line), end)
            elif n_numbers:
                raise ScanError(f"{origin}: line {i + 1}: has fewer than three numbers; correct or remove it")
            elif line:
                titles.append((line, end))
        raise ScanError(f"{origin}: none of the first {_MOST_TITLES} lines has three numbers; it holds no points as text")


def _read_best(line: bytes) -> tuple[int, list[bytes], int | None]:
    """How many numbers a line has, its fields and the delimiter, for that which gives the most."""
    splits = [(split_fields(line, delimiter), delimiter) for delimiter in _DELIMITERS]
    return max(((sum(map(is_number, fields)), fields, delimiter) for fields, delimiter in splits), key=lambda found: found[0])


def _names(titles: Sequence[tuple[bytes, int]], delimiter: int | None, n_fields: int) -> tuple[list[str], int | None]:
    """The column names in the last title that has x, y and z among them (or is no comment and has one for each column)."""
    for line, end in reversed(titles):
        for candidate in (delimiter, *_DELIMITERS):
            names = [_text(field) for field in split_fields(line.lstrip(b"#/"), candidate)]
            complete = len(names) == n_fields and not line.startswith(_COMMENTS)
            if len(names) <= n_fields and (complete or _names_axes(names)):
                return names, end
    return [], None


def _text(field: bytes) -> str:
    """A name in UTF-8 or, as older programs write it, in Latin-1."""
    try:
        return field.decode()
    except UnicodeDecodeError:
        return field.decode("latin-1")


def _names_axes(names: Sequence[str]) -> bool:
    """Whether all three axes are among the names."""
    return any(set(words.values()) <= {axis_of(name, words) for name in names} for words in AXES)


def axis_of(name: str, words: Mapping[str, str]) -> str:
    """x, y or z for a column that is called by one of the words, a unit in brackets behind it or not; else nothing."""
    return words.get(re.sub(r"\s*[\[(].*", "", name.strip().lower(), flags=re.DOTALL), "")


def unique(names: Sequence[str]) -> list[str]:
    """The names, each with underscores behind it until no other before it is the same."""
    found: list[str] = []
    for name in names:
        while name in found:
            name += "_"
        found.append(name)
    return found
