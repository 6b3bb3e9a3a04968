"""The header of a PLY file: elements, properties, edits that leave its other lines as they are. Not here: the body (ply.py)."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Literal

import numpy as np
from plyfile import PlyData, PlyListProperty, PlyParseError

from pcdenoise.errors import ScanError
from pcdenoise.io.files import Raw

TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
"""numpy number types and PLY's names for them."""

_LONGEST = 1 << 20
_ELEMENT = re.compile(rb"element[ \t]+(\S+)[ \t]+(\d{1,18})[ \t]*")
_BOOL = re.compile(rb"(?<=property )bool(?= )")
_PROVENANCE = b"comment pcdenoise {"


@dataclass(frozen=True)
class Property:
    """A named value of an element; `length` is the type of a list's length, None for a single value."""

    name: str
    dtype: np.dtype[Any]
    length: np.dtype[Any] | None


@dataclass(frozen=True)
class Element:
    """A named table of the body."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def smallest_row(self) -> int:
        """Bytes of a binary row whose lists are empty."""
        return sum((prop.length or prop.dtype).itemsize for prop in self.properties)


@dataclass(frozen=True)
class Header:
    """The header's bytes and what they say; `byte_order` is '<' or '>', or '=' for ASCII."""

    raw: bytes
    byte_order: Literal["<", ">", "="]
    elements: tuple[Element, ...]

    @property
    def vertex(self) -> Element:
        """The element that holds the points."""
        return next(element for element in self.elements if element.name == "vertex")

    def with_properties(self, types: Mapping[str, np.dtype[Any]]) -> bytes:
        """The header's bytes with further vertex properties after the present ones."""
        if not types:
            return self.raw
        lines = self.raw.splitlines(keepends=True)
        eol = lines[0][len(lines[0].rstrip(b"\r\n")) :]
        at = self._vertex_line(lines)
        last = at
        for i in range(at + 1, len(lines)):
            if lines[i].split()[:1] in ([b"element"], [b"end_header"]):
                break
            if lines[i].split()[:1] == [b"property"]:
                last = i
        new = [f"property {TYPES[dtype.str[1:]]} {name}".encode() + eol for name, dtype in types.items()]
        return b"".join([*lines[: last + 1], *new, *lines[last + 1 :]])

    def without(self, names: Collection[str]) -> bytes:
        """The header's bytes without these single properties of the vertices and without our provenance."""
        lines = [line for line in self.raw.splitlines(keepends=True) if not line.startswith(_PROVENANCE)]
        kept, element = [], b""
        for line in lines:
            words = line.split()
            element = words[1] if words[:1] == [b"element"] else element
            named = element == b"vertex" and words[:1] == [b"property"] and len(words) == 3 and words[2].decode() in names
            kept += [] if named else [line]
        return b"".join(kept)

    def with_count(self, count: int) -> bytes:
        """The header's bytes for another number of vertices."""
        lines = self.raw.splitlines(keepends=True)
        at = self._vertex_line(lines)
        lines[at] = re.sub(rb"\d+(\s*)$", str(count).encode() + rb"\1", lines[at])
        return b"".join(lines)

    @staticmethod
    def _vertex_line(lines: list[bytes]) -> int:
        return next(i for i, line in enumerate(lines) if line.split()[:2] == [b"element", b"vertex"])


def with_provenance(header: bytes, text: str) -> bytes:
    """Header bytes whose last comment is `pcdenoise {json}`, in place of an earlier one."""
    lines = [line for line in header.splitlines(keepends=True) if not line.startswith(_PROVENANCE)]
    eol = lines[0][len(lines[0].rstrip(b"\r\n")) :]
    return b"".join([*lines[:-1], b"comment pcdenoise " + text.encode("ascii") + eol, lines[-1]])


def parse(raw: Raw, origin: str) -> Header:
    """The header at the start of a PLY file. Raises ScanError if it has none, breaks the grammar or has no vertices."""
    first_line = re.match(rb"ply[ \t]*(\r\n|\n|\r)", raw)
    if first_line is None:
        raise ScanError(f"{origin}: does not start with a line 'ply'; name its real format")
    end = re.search(rb"[\r\n]end_header[ \t]*(?:%b|$)" % first_line[1], raw[:_LONGEST])
    if end is None:
        raise ScanError(f"{origin}: has no end_header line within {_LONGEST} bytes; the file is cut off or damaged")
    counts: list[int] = []
    lines = [b"ply"]
    for line in raw[: end.end()].splitlines()[1:]:
        element = _ELEMENT.fullmatch(line)
        if element is not None:
            counts.append(int(element[2]))
            line = b"element " + element[1] + b" 0"
        is_remark = not line.strip() or line.split()[0] in (b"comment", b"obj_info")
        lines.append(b"comment" if is_remark else _BOOL.sub(b"uchar", line.strip()))
    try:  # plyfile sees no counts, so that it reads no rows, and no remarks, which it takes in ASCII only
        grammar = PlyData.read(BytesIO(b"\n".join(lines) + b"\n"))
    except (PlyParseError, ValueError) as fault:
        raise ScanError(f"{origin}: PLY header is wrong ({fault}); correct it with a text editor") from None
    order: Literal["<", ">", "="] = "=" if grammar.text else grammar.byte_order
    elements = tuple(
        Element(
            element.name,
            count,
            tuple(
                Property(
                    prop.name,
                    np.dtype(prop.val_dtype).newbyteorder(order),
                    np.dtype(prop.len_dtype).newbyteorder(order) if isinstance(prop, PlyListProperty) else None,
                )
                for prop in element.properties
            ),
        )
        for element, count in zip(grammar.elements, counts, strict=True)
    )
    if any(prop.length is not None and prop.length.kind == "f" for element in elements for prop in element.properties):
        raise ScanError(f"{origin}: PLY header declares list lengths as floats; correct it with a text editor")
    if not any(element.name == "vertex" for element in elements):
        raise ScanError(f"{origin}: has no vertex element, so no points; name another file")
    return Header(raw[: end.end()], order, elements)
