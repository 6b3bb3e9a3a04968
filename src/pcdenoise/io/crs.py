"""What a LAS file says about its coordinate reference system: names and units. Not here: any conversion between systems.

Read are well-known text (OGC 01-009 and ISO 19162) and GeoTIFF keys, as ASPRS LAS 1.4 R15 puts them into VLRs or EVLRs. A code
without a name or unit stays a code: looking it up needs the EPSG register, which this package does not carry.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

WKT, GEO_KEYS, GEO_TEXT = 2112, 34735, 34737
"""Record numbers of user LASF_Projection: text, GeoTIFF directory, GeoTIFF strings."""

PROJECTED, GEOGRAPHIC, GEOCENTRIC = "projected", "geographic", "geocentric"
"""Kinds of systems: a map's plane; longitude and latitude; x, y, z from the middle of the Earth."""

_MOST_DEGREES = (360.0, 90.0)
_EARTH_M = (6.2e6, 6.6e6)  # from its middle to the deepest and highest places that anybody scans, airborne included

_UNITS = {9001: "metre", 9002: "foot", 9003: "US survey foot", 9101: "radian", 9102: "degree"}
_FACTORS = {1.0: "metre", 0.3048: "foot", 0.304800609601219: "US survey foot", 0.017453292519943: "degree"}
_TOKEN = re.compile(r'"(?:[^"]|"")*"|[\[\](),]|[^\[\](),"\s]+')
_KINDS = {
    **dict.fromkeys(("PROJCS", "PROJCRS", "PROJECTEDCRS"), PROJECTED),
    **dict.fromkeys(("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS"), GEOGRAPHIC),
    "GEOCCS": GEOCENTRIC,
    "GEODCRS": "",  # geographic or geocentric, as its axes have it
}
_VERTICAL = {"VERT_CS", "VERTCRS", "VERTICALCRS"}
_UNIT = {"UNIT", "LENGTHUNIT", "ANGLEUNIT"}
_MOST_TOKENS = 20_000
_KIND_KEYS = {1: PROJECTED, 2: GEOGRAPHIC, 3: GEOCENTRIC}
_USER_DEFINED = 32767


@dataclass(frozen=True)
class Crs:
    """Names, kind and units as the file gives them, empty where it does not; a code is 'EPSG:32617'."""

    name: str = ""
    unit: str = ""
    vertical_name: str = ""
    vertical_unit: str = ""
    kind: str = ""

    def misfit(self, low: Sequence[float], high: Sequence[float]) -> str:
        """Why coordinates between two corners cannot be of this system, in a clause; empty if they may be."""
        far = [max(abs(a), abs(b)) for a, b in zip(low, high, strict=True)]
        if self.unit == "degree":
            beyond = [axis for axis in (0, 1) if far[axis] > _MOST_DEGREES[axis]]
            return f"says degrees, but {'xy'[beyond[0]]} reaches {far[beyond[0]]:,.0f}" if beyond else ""
        if self.kind == GEOCENTRIC and self.unit == "metre":
            nearest = math.hypot(*(0.0 if a < 0 < b else min(abs(a), abs(b)) for a, b in zip(low, high, strict=True)))
            if math.hypot(*far) < _EARTH_M[0]:
                return f"says metres from the middle of the Earth, but {math.hypot(*far) / 1000:,.0f} km from it is underground"
            if nearest > _EARTH_M[1]:
                return f"says metres from the middle of the Earth, but {nearest / 1000:,.0f} km from it is space"
        return ""

    def __str__(self) -> str:
        kind = self.kind if self.kind == GEOCENTRIC else ""
        parts = [self.name or "unnamed", kind, self.unit, f"heights {self.vertical_name}" if self.vertical_name else ""]
        parts.append(f"heights in {self.vertical_unit}" if self.vertical_unit not in ("", self.unit) else "")
        return ", ".join(part for part in parts if part)


def parse(records: Mapping[int, bytes]) -> Crs | None:
    """The system that payloads of LASF_Projection records describe, text before GeoTIFF; None if they say nothing readable."""
    text = records.get(WKT, b"").split(b"\0")[0].decode("utf-8", "replace")
    return _from_text(text) or _from_keys(records.get(GEO_KEYS, b""), records.get(GEO_TEXT, b""))


@dataclass(frozen=True)
class _Node:
    """KEYWORD["value", 1.0, CHILD[...]] of well-known text."""

    keyword: str
    values: list[str]
    children: list[_Node]

    def child(self, keywords: set[str]) -> _Node | None:
        """The first direct child of one of these keywords."""
        return next((child for child in self.children if child.keyword in keywords), None)

    @property
    def name(self) -> str:
        return self.values[0] if self.values else ""

    @property
    def unit(self) -> str:
        """Of its own unit, or of its first axis that has one."""
        axis = next((found for child in self.children if child.keyword == "AXIS" and (found := child.child(_UNIT))), None)
        unit = self.child(_UNIT) or axis
        if unit is None:
            return ""
        try:
            factor = float(unit.values[1])
        except (IndexError, ValueError):
            return unit.name
        return next((name for known, name in _FACTORS.items() if abs(factor - known) < 1e-12), unit.name)


def _from_text(text: str) -> Crs | None:
    tokens = _TOKEN.findall(text)
    root = _Node("", [], [])
    path = [root]
    for place, token in enumerate(tokens[:_MOST_TOKENS]):
        if token in "[(":
            keyword = tokens[place - 1] if place else ""
            if path[-1].values[-1:] == [keyword]:
                path[-1].values.pop()
            path[-1].children.append(_Node(keyword.upper(), [], []))
            path.append(path[-1].children[-1])
        elif token in "])":
            if len(path) > 1:
                path.pop()
        elif token != ",":
            path[-1].values.append(token.strip('"'))
    systems = [node for top in root.children for node in (top, *top.children)]
    horizontal = next((node for node in systems if node.keyword in _KINDS), None)
    vertical = next((node for node in systems if node.keyword in _VERTICAL), None)
    if horizontal is None:
        return None
    kind = _KINDS[horizontal.keyword] or (GEOGRAPHIC if horizontal.unit == "degree" else GEOCENTRIC)
    return Crs(horizontal.name, horizontal.unit, vertical.name if vertical else "", vertical.unit if vertical else "", kind)


def _from_keys(directory: bytes, text: bytes) -> Crs | None:
    """GeoTIFF: a header of four shorts, then (key, where its value is, count, value or offset) for each key."""
    n_keys = min(struct.unpack_from("<4H", directory)[3], len(directory) // 8 - 1) if len(directory) >= 8 else 0
    values: dict[int, int] = {}
    texts: dict[int, str] = {}
    for place in range(1, n_keys + 1):
        key, where, count, value = struct.unpack_from("<4H", directory, 8 * place)
        if where == 0:
            values[key] = value
        elif where == GEO_TEXT:
            texts[key] = text[value : value + count].decode("latin-1").strip("\0|")
    kind = _KIND_KEYS.get(values.get(1024, 0), "")
    code = values.get(3072 if kind == PROJECTED else 2048, 0)
    citation = texts.get(3073 if kind == PROJECTED else 2049) or texts.get(1026, "")
    vertical_code = values.get(4096, 0)
    name = citation or (f"EPSG:{code}" if 0 < code < _USER_DEFINED else "")
    unit = "degree" if kind == GEOGRAPHIC else "metre" if kind == GEOCENTRIC else _UNITS.get(values.get(3076, 0), "")
    vertical = texts.get(4097) or (f"EPSG:{vertical_code}" if 0 < vertical_code < _USER_DEFINED else "")
    found = Crs(name, unit, vertical, _UNITS.get(values.get(4099, 0), ""), kind)
    return found if found != Crs() else None
