"""E57 scans (ASTM E2807), as terrestrial scanners write them: stations with poses, images, and points packed bit by bit.

All stations of a file are one scan in world coordinates; with several of them a column says of which one a point is. What is
written back has every station, image and field it had. Not here: stations (e57_stations.py), the container (e57_file.py),
elements of its XML (e57_xml.py).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import e57_file
from pcdenoise.io.e57_file import Container, Field, Layout
from pcdenoise.io.e57_new import NAMES, NAMESPACES, OURS, PROVENANCE, added, created, described, storable
from pcdenoise.io.e57_stations import AXES_OF_BOUNDS, AZIMUTH, BOUNDS, CARTESIAN, SPHERICAL, Station, offset, stations_of
from pcdenoise.io.e57_xml import Edits, Element, a_text, parsed
from pcdenoise.io.source import STATION, Column, changed, free_name, moved_points, station_numbers

_NOTES = "names and notes"
_SECTIONS = ("Blob", "CompressedVector")
"""Types of elements that name a section of the file."""


@dataclass(frozen=True)
class E57Source:
    """An E57 file: its bytes, their container, the root of its XML, its stations; labels: attribute name -> name of its field."""

    raw: bytes
    container: Container
    root: Element
    stations: Sequence[Station]
    labels: Mapping[str, str]
    columns: Mapping[str, Column]
    origin: str

    @property
    def xml(self) -> bytes:
        """The text of its XML."""
        return self.container.data[self.container.xml].tobytes()

    def points(self) -> Points:
        """(N, 3) world coordinates; NaN where a record says that it is no measurement."""
        return np.concatenate([station.world() for station in self.stations] or [np.zeros((0, 3))])

    def step(self) -> float:
        """The length that moved coordinates are rounded to where they are coarsest; 0 where all are float64."""
        return max((station.step() for station in self.stations), default=0.0)

    @property
    def has_steps(self) -> bool:
        """Whether all world coordinates are whole numbers of steps: no floats, no angles, no poses."""
        return all(
            station.systems[0] == CARTESIAN and station.pose.is_home and field.kind in ("integer", "scaled")
            for station in self.stations
            for field in station.coordinates
        )

    def attachments(self) -> list[str]:
        """Images, poses, metadata of the coordinates, texts of points; not notes, which only say where a file comes from."""
        return [name for name in self.payloads() if name != _NOTES]

    def payloads(self) -> dict[str, bytes]:
        """The bytes of all images and of texts of points; poses, metadata and all other texts as the XML says them."""
        kinds = {element: element.attributes.get("type") for element in self.root.all()}
        blobs = {offset(element, self.origin): None for element, kind in kinds.items() if kind == "Blob"}
        notes = [element.text for element, kind in kinds.items() if kind == "String" and element.name != PROVENANCE]
        places = [json.dumps([station.pose.back.tolist(), station.pose.shift.tolist()]) for station in self.stations]
        texts = [
            stream
            for records in (station.records for station in self.stations)
            for field, stream in zip(records.fields, records.streams, strict=True)
            if field.kind == "text"
        ]
        metadata, is_home = self.root.find("coordinateMetadata"), all(station.pose.is_home for station in self.stations)
        found = {
            "images": b"".join(e57_file.section_at(self.container, blob, self.origin) for blob in blobs),
            "poses of stations": b"" if is_home else "\n".join(places).encode(),
            "coordinate metadata": b"" if metadata is None else metadata.text.strip().encode(),
            "texts of points": b"".join(texts),
            _NOTES: "\0".join(notes).encode(),
        }
        return {name: data for name, data in found.items() if data}

    def without(self, names: Collection[str]) -> E57Source:
        """The file without these fields and our provenance; its other points are packed anew."""
        gone, edits, parts = {self.labels[name] for name in names if name in self.labels}, Edits(self.xml), []
        for station in self.stations:
            part = _Part.of(station)
            for number in reversed(range(len(part.fields))):
                if part.fields[number].name in gone:
                    del part.fields[number], part.streams[number]
            for child in station.records.prototype.children:
                if child.name in gone:
                    edits.remove(child)
            parts.append(part)
        if (provenance := self.root.find(PROVENANCE)) is not None:
            edits.remove(provenance)
        source: E57Source = read(_assembled(self, parts, edits), self.origin).source
        return source

    def selected(self, keep: Mask) -> E57Source:
        """The file with only these points; what groups rows of a station is left out. Raises ScanError for text per point."""
        edits, parts = Edits(self.xml), []
        for station in self.stations:
            part, kept = _Part.of(station), keep[station.rows]
            for number, field in enumerate(part.fields):
                if field.kind == "text":
                    raise ScanError(f"{self.origin}: has text for each point ({field.name}), which rows cannot be taken out of")
                part.streams[number] = field.packed(field.unpacked(part.streams[number], part.n)[kept])
            part.n = int(kept.sum())
            parts.append(part)
            if (groups := station.element.find("pointGroupingSchemes")) is not None:
                edits.remove(groups)
        source: E57Source = read(_assembled(self, parts, edits, are_grouped=False), self.origin).source
        return source


@dataclass
class _Part:
    """The records of a station as they are to be written; ends: lowest and highest of the floats that are new, by their field."""

    fields: list[Field]
    streams: list[bytes]
    n: int
    ends: dict[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, station: Station) -> _Part:
        """As they are in the file."""
        records = station.records
        return cls(list(records.fields), records.streams, records.n)

    def put(self, number: int, values: Column) -> None:
        """Gives a field (n,) other values, and wider bounds where they need them."""
        field = self.fields[number]
        if field.kind in ("integer", "scaled") and len(values):
            field = replace(field, low=min(field.low, int(values.min())), high=max(field.high, int(values.max())))
        elif len(known := values[np.isfinite(values)]):
            self.ends[field.name] = float(known.min()), float(known.max())
        self.fields[number], self.streams[number] = field, field.packed(values)


def matches(head: bytes) -> bool:
    """Whether a file starts like E57."""
    return head.startswith(e57_file.SIGNATURE)


def read(raw: bytes, origin: str) -> Scan:
    """A scan of E57 bytes: all stations in world coordinates, their fields as attributes. Raises ScanError on damage.

    A field that a station lacks is 0 there, or NaN. Records that say that they are no measurement have coordinates of NaN.
    """
    container = e57_file.opened(raw, origin)
    root = parsed(container.data[container.xml].tobytes(), origin)
    stations = list(stations_of(container, root, origin))
    for element in root.all():
        if element.attributes.get("type") in _SECTIONS:
            offset(element, origin)  # a fault is told now, not when the scan has been cleaned
    source = E57Source(raw, container, root, stations, {}, {}, origin)
    own = {*CARTESIAN, *SPHERICAL}
    names = dict.fromkeys(f.name for s in stations for f in s.records.fields if f.name not in own and f.kind != "text")
    labels: dict[str, str] = {}
    columns: dict[str, Column] = {}
    for name in names:
        attribute = free_name(NAMES.get(name, name.removeprefix(OURS)), columns)
        labels[attribute], columns[attribute] = name, _column(stations, name)
    if len(stations) > 1:
        columns[free_name(STATION, columns)] = station_numbers([station.records.n for station in stations])
    source = replace(source, labels=labels, columns=columns)
    return Scan(source.points(), columns, "e57", origin, source)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of columns that E57 has no number type for: text, and uint64."""
    return [name for name in columns if name not in storable(columns)]


def write(scan: Scan, file: BinaryIO, *, provenance: Mapping[str, Any] | None = None) -> None:
    """Write a scan as E57: the file it came from with moved coordinates and new fields, or a new one with one station.

    Coordinates keep the number type that they have; integers get wider bounds where moved points need them.
    """
    if not isinstance(scan.source, E57Source):
        file.write(created(scan, provenance))
        return
    source, columns = scan.source, changed(scan)
    if any(name in source.columns and name not in source.labels for name in columns):
        raise ScanError("of which station a point is cannot be changed; write .las or .ply instead")
    edits, parts, moved = Edits(source.xml), [], moved_points(source.points(), scan.points)
    new = storable({name: values for name, values in columns.items() if name not in source.labels})
    for station in source.stations:
        part, rows = _Part.of(station), station.rows
        if moved[rows].any():
            _move(station, part, edits, scan.points[rows], moved[rows])
        for name, values in columns.items():
            number = station.records.index_of(source.labels.get(name, ""))
            if number is not None:
                part.put(number, _as_stored(part.fields[number], values[rows]))
        further = added({name: values[rows] for name, values in new.items()}, [field.name for field in part.fields])
        for field, stream in further:
            part.fields.append(field)
            part.streams.append(stream)
            edits.append(station.records.prototype, described(field))
        _widen(station, part, edits)
        parts.append(part)
    if provenance is not None:
        if (earlier := source.root.find(PROVENANCE)) is not None:
            edits.remove(earlier)
        edits.append(source.root, a_text(PROVENANCE, json.dumps(provenance)))
    if new or provenance is not None:
        used = {field.name.partition(":")[0] for part in parts for field in part.fields} | {"pcdenoise"}
        spaces = {f"xmlns:{short}": name for short, name in NAMESPACES.items() if short in used}
        edits.set(source.root, **{name: space for name, space in spaces.items() if name not in source.root.attributes})
    file.write(_assembled(source, parts, edits))


def _column(stations: Sequence[Station], name: str) -> Column:
    """(N,) values of a field in all stations; 0 or NaN in those that have none."""
    parts = [station.records.measured(name) for station in stations]
    dtype = np.result_type(*(part.dtype for part in parts if part is not None))
    missing = np.nan if dtype.kind == "f" else 0
    pairs = zip(stations, parts, strict=True)
    whole = [np.full(station.records.n, missing, dtype) if part is None else part.astype(dtype) for station, part in pairs]
    return np.concatenate(whole)


def _as_stored(field: Field, values: Column) -> Column:
    """(n,) values as a field stores them: the nearest that it has. Raises ScanError where an integer is no number."""
    if field.kind in ("single", "double"):
        return values.astype(np.float32 if field.kind == "single" else np.float64)
    if values.dtype.kind in "iub" and field.kind == "integer":
        steps = values
        fits = not len(values) or int(values.max()) < 2**63
    else:
        steps = np.rint((values.astype(np.float64) - field.offset) / field.scale)
        fits = bool((np.abs(steps) < 2.0**62).all())  # NaN is not
    if not fits:
        raise ScanError(f"{field.name} holds whole numbers, which the new values are not; write .las or .ply instead")
    return steps.astype(np.int64)


def _move(station: Station, part: _Part, edits: Edits, points: Points, moved: Mask) -> None:
    """Puts moved (n, 3) points of a station into all coordinates that it has, and their bounds into its XML."""
    bounds = {name: element for name in BOUNDS if (element := station.element.find(name)) is not None}
    systems = {*station.systems, *(BOUNDS[name] for name in bounds)}
    places = {system: station.from_world(points[moved], system) for system in systems}
    for name, element in bounds.items():
        _stretch(element, places[BOUNDS[name]], AXES_OF_BOUNDS[name], edits)
    for system in station.systems:
        for name, new in zip(system, places[system].T, strict=True):
            number, values = station.records.index_of(name), station.records.values(name)
            assert number is not None
            assert values is not None
            if name == AZIMUTH:  # from 0 to 2 π, or from -π on: as the file counts
                before = station.records.measured(name)
                assert before is not None
                new = new + 2 * np.pi * np.rint((before[moved] - new) / (2 * np.pi))
            stored = _as_stored(part.fields[number], new)
            values = values.astype(stored.dtype)
            values[moved] = stored
            part.put(number, values)


def _stretch(bounds: Element, points: Points, axes: Sequence[str], edits: Edits) -> None:
    """Moves bounds of a station's coordinates outward, those that are there, to where (m, 3) points are."""
    for name, values in zip(axes, points.T, strict=True):
        for end, value, sign in ((name + "Minimum", values.min(), -1), (name + "Maximum", values.max(), 1)):
            element = bounds.find(end)
            if element is not None and sign * value > sign * element.number():
                edits.put(element, float(value))


def _widen(station: Station, part: _Part, edits: Edits) -> None:
    """Says in the XML between what bounds the fields that were there lie now."""
    for child, before, field in zip(station.records.prototype.children, station.records.fields, part.fields, strict=False):
        if (field.low, field.high) != (before.low, before.high):
            edits.set(child, minimum=str(field.low), maximum=str(field.high))
        elif field.name in part.ends:
            said, (low, high) = child.attributes, part.ends[field.name]
            wider = {"minimum": low} if low < float(said.get("minimum", "-inf")) else {}
            wider |= {"maximum": high} if high > float(said.get("maximum", "inf")) else {}
            if wider:
                edits.set(child, **{name: repr(end) for name, end in wider.items()})


def _assembled(source: E57Source, parts: Sequence[_Part], edits: Edits, are_grouped: bool = True) -> bytes:
    """The file with its stations' records replaced: in place where they are as long as they were, else section by section."""
    container, data = source.container, source.container.data
    pairs = list(zip(source.stations, parts, strict=True))
    if all(_fits(station, part) for station, part in pairs):
        data = data.copy()
        for station, part in pairs:
            for pieces, stream in zip(station.records.vector.pieces, part.streams, strict=True):
                _put(data, pieces, stream)
        if edits.made() == source.xml and (data == container.data).all():
            return source.raw
        end = container.xml.start if not data[container.xml.stop :].any() else len(data)
        return e57_file.closed(data[:end].tobytes(), edits.made(), container.page)
    layout = Layout()
    by_element = {station.records.element: part for station, part in pairs}
    gone = [] if are_grouped else [station.element.find("pointGroupingSchemes") for station in source.stations]
    skipped = {inner for element in gone if element is not None for inner in element.all()}
    placed: dict[int, int] = {}
    for element in source.root.all():
        if element in by_element:
            new = by_element[element]
            at = layout.add_vector(new.fields, new.streams, new.n)
            edits.set(element, fileOffset=str(at), recordCount=str(new.n))
        elif element.attributes.get("type") in _SECTIONS and element not in skipped:
            before = offset(element, source.origin)
            placed[before] = placed.get(before) or layout.add_section(container, before, source.origin)
            edits.set(element, fileOffset=str(placed[before]))
    return e57_file.closed(layout.data, edits.made())


def _fits(station: Station, part: _Part) -> bool:
    """Whether a station's records can be put where they were."""
    records = station.records
    same = part.n == records.n and len(part.fields) == len(records.fields)
    return same and all(new.bits == old.bits for new, old in zip(part.fields, records.fields, strict=True))


def _put(data: NDArray[np.uint8], pieces: Sequence[slice], stream: bytes) -> None:
    """Puts a stream where it was; the file may have had some bytes behind its last value."""
    at = 0
    for piece in pieces:
        part = np.frombuffer(stream[at : at + piece.stop - piece.start], np.uint8)
        data[piece.start : piece.start + len(part)] = part
        at += len(part)
