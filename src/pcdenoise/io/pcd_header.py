"""The header of a PCD file: fields, counts, and edits that leave its other lines as they are. Not here: the body (pcd.py)."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcdenoise.errors import ScanError

_KINDS = {"F": "f", "I": "i", "U": "u"}
_LONGEST = 1 << 16
_MOST_VALUES = 1 << 16
_PROVENANCE = b"# pcdenoise {"


@dataclass(frozen=True)
class Field:
    """One entry of FIELDS: `count` values of a type under a name; the name `_` is padding."""

    name: str
    dtype: np.dtype[Any]
    count: int

    def labels(self, index: int) -> list[str]:
        """A name for each value, unique in the file: names of fields need not be."""
        return [f"{index}.{k}" for k in range(self.count)]


@dataclass(frozen=True)
class Header:
    """The header's bytes up to the end of its DATA line, and what they say."""

    raw: bytes
    fields: tuple[Field, ...]
    n_points: int
    height: int
    encoding: str
    viewpoint: tuple[str, ...]

    @property
    def dtype(self) -> np.dtype[Any]:
        """A record with one field for each value, under its label."""
        return np.dtype([(label, field.dtype) for i, field in enumerate(self.fields) for label in field.labels(i)])

    def with_fields(self, columns: Mapping[str, np.dtype[Any]]) -> bytes:
        """The header's bytes with further fields behind the present ones."""
        if not columns:
            return self.raw
        letters = {kind: letter for letter, kind in _KINDS.items()}
        types = list(columns.values())
        return self._appended(
            {
                b"FIELDS": list(columns), b"COLUMNS": list(columns), b"SIZE": [str(dtype.itemsize) for dtype in types],
                b"TYPE": [letters[dtype.kind] for dtype in types], b"COUNT": ["1"] * len(types),
            }
        )  # fmt: skip

    def without(self, indices: Collection[int]) -> bytes:
        """The header's bytes without the fields of these numbers and without our provenance."""
        lines = [line for line in self.raw.splitlines(keepends=True) if not line.startswith(_PROVENANCE)]
        for i, line in enumerate(lines):
            if line.split() and line.split()[0].upper() in (b"FIELDS", b"COLUMNS", b"SIZE", b"TYPE", b"COUNT"):
                words = re.findall(rb"\s*\S+", line.rstrip())
                left = words[:1] + [word for k, word in enumerate(words[1:]) if k not in indices]
                lines[i] = b"".join(left) + line[len(line.rstrip()) :]
        return b"".join(lines)

    def with_count(self, n_points: int) -> bytes:
        """The header's bytes for another number of points, not organised."""
        new = {b"WIDTH": n_points, b"HEIGHT": 1, b"POINTS": n_points}
        lines = self.raw.splitlines(keepends=True)
        keys = [line.split()[0].upper() if line.split() else b"" for line in lines]
        return b"".join(
            re.sub(rb"\d+(\s*)$", str(new[key]).encode() + rb"\1", line) if key in new else line
            for key, line in zip(keys, lines, strict=True)
        )

    def _appended(self, words: Mapping[bytes, Sequence[str]]) -> bytes:
        lines = self.raw.splitlines(keepends=True)
        for i, line in enumerate(lines):
            key = line.split()[0].upper() if line.split() else b""
            text = line.rstrip()
            lines[i] = text + "".join(f" {word}" for word in words.get(key, ())).encode() + line[len(text) :]
        return b"".join(lines)


def with_provenance(header: bytes, text: str) -> bytes:
    """Header bytes whose second line is `# pcdenoise {json}`, in place of an earlier one."""
    lines = [line for line in header.splitlines(keepends=True) if not line.startswith(_PROVENANCE)]
    eol = lines[0][len(lines[0].rstrip(b"\r\n")) :]
    at = 1 if lines[0].startswith(b"#") else 0
    return b"".join([*lines[:at], b"# pcdenoise " + text.encode("ascii") + eol, *lines[at:]])


def written(fields: Mapping[str, np.dtype[Any]], n_points: int, origin: str) -> Header:
    """The header of a new binary file."""
    empty = (
        b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS\nSIZE\nTYPE\nCOUNT\n"
        b"WIDTH %d\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS %d\nDATA binary\n" % (n_points, n_points)
    )
    return parse(Header(empty, (), n_points, 1, "binary", ()).with_fields(fields), origin)


def parse(raw: bytes, origin: str) -> Header:
    """The header at the start of a PCD file, version 0.5 to 0.7. Raises ScanError if it is incomplete or contradicts itself."""
    end = re.search(rb"^[ \t]*DATA[ \t]+(\w+)[ \t]*(\r\n|\n|$)", raw[:_LONGEST], re.MULTILINE | re.IGNORECASE)
    if end is None:
        raise ScanError(f"{origin}: has no PCD header with a DATA line; name its real format or repair the header")
    words: dict[str, list[str]] = {}
    for line in raw[: end.end()].decode("latin-1").splitlines():
        key, *values = line.split() or ["#"]
        if not key.startswith("#"):
            words[key.upper()] = values
    names = words.get("FIELDS", words.get("COLUMNS", []))
    sizes, kinds = words.get("SIZE", []), words.get("TYPE", [])
    counts = [_count(word, "COUNT", origin) for word in words.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ScanError(
            f"{origin}: {len(names)} FIELDS, {len(sizes)} SIZE, {len(kinds)} TYPE, {len(counts)} COUNT entries; make them equal"
        )
    if sum(counts) > _MOST_VALUES:
        raise ScanError(f"{origin}: header claims {sum(counts)} values a point; the file is damaged")
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        code = _KINDS.get(kind.upper(), "?") + size
        if code not in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"):
            raise ScanError(f"{origin}: field {name} has TYPE {kind} SIZE {size}, which PCD does not know; correct the header")
        fields.append(Field(name, np.dtype("<" + code), count))
    width, height, n_points = (_integer(words, key, origin) for key in ("WIDTH", "HEIGHT", "POINTS"))
    grid = None if width is None else width * (1 if height is None else height)
    if n_points is not None and grid is not None and n_points != grid:
        raise ScanError(f"{origin}: POINTS is {n_points} but WIDTH x HEIGHT is {grid}; correct the header")
    total = n_points if n_points is not None else grid
    if total is None:
        raise ScanError(f"{origin}: the header has neither POINTS nor WIDTH; add the number of points")
    return Header(raw[: end.end()], tuple(fields), total, height or 1, end[1].decode().lower(), tuple(words.get("VIEWPOINT", ())))


def _integer(words: Mapping[str, Sequence[str]], key: str, origin: str) -> int | None:
    return _count(words[key][0], key, origin) if words.get(key) else None


def _count(word: str, key: str, origin: str) -> int:
    if not re.fullmatch(r"\d{1,15}", word):
        raise ScanError(f"{origin}: {key} {word} is no count; correct the header")
    return int(word)
