"""Text scans before their first row: delimiter, decimal mark, column names, a count. Not here: the rows (xyz.py)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from pcdenoise.errors import ScanError
from pcdenoise.io.lines import Offsets, is_number, split_fields

_DELIMITERS = (ord(";"), ord(","), ord("\t"), None)
_COMMENTS = (b"#", b"//")
_BOM = b"\xef\xbb\xbf"
_EAST = "e east easting x_coord xcoord coord_x rechts rechtswert rw abscisse ost ostwert est este oost"
_NORTH = "n north northing y_coord ycoord coord_y hoch hochwert hw ordonnée nord nordwert norte noord"
_HEIGHT = (
    "h height alt altitude altitud elev elevation elevación z z_coord zcoord coord_z höhe hoehe nhn cota quota altura hoogte"
)
AXES: tuple[Mapping[str, str], ...] = (
    {"x": "x", "y": "y", "z": "z"},
    {
        **dict.fromkeys([*_EAST.split(), "x coordinate", "coordenada x"], "x"),
        **dict.fromkeys([*_NORTH.split(), "y coordinate", "coordenada y"], "y"),
        **dict.fromkeys([*_HEIGHT.split(), "z coordinate", "coordenada z"], "z"),
    },
)
"""What columns are called that hold coordinates; the first set that is complete counts."""
_DECIMAL_COMMA = re.compile(rb"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)
_MOST_TITLES = 1000
_LONGEST_LINE = 1 << 17


@dataclass(frozen=True)
class Layout:
    """What the lines before the first row say; `first_row` is that row's line, counted from 0.

    decimal_comma: whether numbers are written as 1,5.
    """

    first_row: int
    delimiter: int | None
    decimal_comma: bool
    names: list[str]
    names_end: int | None
    count: tuple[int, int] | None
    n_claimed: int

    @classmethod
    def of(cls, raw: bytes, visible: Offsets, ends: Offsets, origin: str, *, decimal_comma: bool = False) -> Layout:
        """Read on to the first line with three numbers; before it stand only comments, one count and lines without a number.

        decimal_comma: for lines that are known to have such numbers, whatever the first ones are.
        """
        titles: list[tuple[bytes, int]] = []
        count: tuple[int, int] | None = None
        spans = list(zip(visible[:_MOST_TITLES].tolist(), ends[:_MOST_TITLES].tolist(), strict=True))
        for i, (start, end) in enumerate(spans):
            line = raw[start:end].removeprefix(_BOM)
            if len(line) > _LONGEST_LINE:
                raise ScanError(f"{origin}: line {i + 1} has {len(line)} bytes; is it a point cloud?")
            if line.startswith(_COMMENTS):
                titles.append((line, end))
                continue
            n_numbers, fields, delimiter = _best(line, is_number)
            if n_numbers < 3 or decimal_comma:
                with_commas = _best(line, _has_no_point)
                if with_commas[0] >= 3:
                    decimal_comma, (n_numbers, fields, delimiter) = True, with_commas
            if n_numbers >= 3:
                following = (raw[first:last] for first, last in spans[i:])
                decimal_comma = decimal_comma or (delimiter != ord(",") and _turns_to_commas(following, delimiter))
                names, names_end = _names(titles, delimiter, len(fields))
                if delimiter == ord(",") and len(fields) == 2 * len(names) and all(map(_is_whole, fields)):
                    raise ScanError(
                        f"{origin}: line {i + 1}: has {len(fields)} fields under {len(names)} names, so that commas"
                        " divide columns and mark decimals; save it with another delimiter"
                    )
                claimed = int(raw[slice(*count)]) if count else 0
                return cls(i, delimiter, decimal_comma, names, names_end, count, claimed)
            if count is None and len(fields) == 1 and line.strip().isdigit() and len(line) < 19:
                count = (end - len(line), end)
            elif n_numbers:
                raise ScanError(f"{origin}: line {i + 1}: has fewer than three numbers; correct or remove it")
            elif line:
                titles.append((line, end))
        raise ScanError(f"{origin}: none of the first {_MOST_TITLES} lines has three numbers; it holds no points as text")


def _best(line: bytes, counts: Callable[[bytes], bool]) -> tuple[int, list[bytes], int | None]:
    """How many fields of a line count as numbers, its fields and the delimiter, for that which gives the most."""
    splits = [(split_fields(line, delimiter), delimiter) for delimiter in _DELIMITERS]
    return max(((sum(map(counts, fields)), fields, delimiter) for fields, delimiter in splits), key=lambda found: found[0])


def _has_no_point(field: bytes) -> bool:
    """Whether a field is a number with a decimal comma or a whole one."""
    return _DECIMAL_COMMA.fullmatch(field) is not None or (b"." not in field and is_number(field))


def _is_whole(field: bytes) -> bool:
    return is_number(field) and field.lstrip(b"+-").isdigit()


def _turns_to_commas(lines: Iterable[bytes], delimiter: int | None) -> bool:
    """Whether the first number with decimals has a comma."""
    for line in lines:
        if not line.startswith(_COMMENTS):
            for field in split_fields(line, delimiter):
                if _DECIMAL_COMMA.fullmatch(field):
                    return True
                if b"." in field and is_number(field):
                    return False
    return False


def _names(titles: Sequence[tuple[bytes, int]], delimiter: int | None, n_fields: int) -> tuple[list[str], int | None]:
    """The column names in the last title that has x, y and z among them (or is no comment and has one for each column)."""
    for line, end in reversed(titles):
        for candidate in (delimiter, *_DELIMITERS):
            names = [decoded(field)[0] for field in split_fields(line.lstrip(b"#/"), candidate)]
            complete = len(names) == n_fields and not line.startswith(_COMMENTS)
            if len(names) <= n_fields and (complete or _names_axes(names)):
                return names, end
    return [], None


def decoded(line: bytes) -> tuple[str, str]:
    """A line in UTF-8 or, as older programs write it, in Latin-1, and which of them it is in."""
    try:
        return line.decode(), "utf-8"
    except UnicodeDecodeError:
        return line.decode("latin-1"), "latin-1"


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
