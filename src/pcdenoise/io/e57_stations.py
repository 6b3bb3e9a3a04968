"""The stations of an E57 file: what fields their points have, how they are posed, and where points are in the world.

Not here: the container (e57_file.py), a scan of all stations and how it is written (e57.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pcdenoise.cloud.scan import Points
from pcdenoise.errors import ScanError
from pcdenoise.io import e57_file
from pcdenoise.io.e57_file import Container, Field, Vector
from pcdenoise.io.e57_xml import Element
from pcdenoise.io.pose import Pose
from pcdenoise.io.source import Column

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
INVALID: dict[tuple[str, ...], str] = {CARTESIAN: "cartesianInvalidState", SPHERICAL: "sphericalInvalidState"}
"""The fields that say whether a record is a measurement: 0 if it is."""

AZIMUTH = SPHERICAL[1]
BOUNDS = {"cartesianBounds": CARTESIAN, "sphericalBounds": SPHERICAL}
"""What a station says of where its points lie, and in what coordinates."""
AXES_OF_BOUNDS = {"cartesianBounds": ("x", "y", "z"), "sphericalBounds": ("range", "azimuth", "elevation")}
"""The azimuths of a sphere have a start and an end, no minimum."""

_TYPES = {"Float": "double", "Integer": "integer", "ScaledInteger": "scaled", "String": "text"}
_LEAST, _MOST = -(2**63), 2**63 - 1
_MOST_FIELDS, _FEW_VALUES, _MOST_VALUES_PER_BYTE = 256, 4096, 16
"""Fields that have one value alone take no place in the file: beyond a few, so many values at most for each byte there is."""
_LONGEST_FAULT = 60


@dataclass(frozen=True)
class Records:
    """n records: the element that names them, their fields, and where in the container their streams are."""

    element: Element
    fields: Sequence[Field]
    n: int
    container: Container
    vector: Vector

    @classmethod
    def at(cls, element: Element, container: Container, origin: str) -> Records:
        """The records that an element names. Raises ScanError on damage, and where there are fewer than it claims."""
        try:
            fields = [_field(child) for child in prototype(element).children]
            n = _whole(element.attributes["recordCount"])
        except (KeyError, ValueError) as fault:
            said = str(fault)[:_LONGEST_FAULT]
            raise ScanError(f"{origin}: its XML tells no fields of its points ({said}); it is damaged, fetch it again") from None
        if len(fields) > _MOST_FIELDS or len({field.name for field in fields}) < len(fields):
            raise ScanError(f"{origin}: its XML claims {n} points of {len(fields)} fields; it is damaged, fetch it again")
        needed = [e57_file.bytes_of(field, n) for field in fields]
        is_empty = n == 0 or not (any(needed) or any(field.kind == "text" for field in fields))
        vector = e57_file.vector_at(container, offset(element, origin), len(fields), is_empty, origin)
        sizes = [sum(piece.stop - piece.start for piece in some) for some in vector.pieces]
        too_few = any(size < least for size, least in zip(sizes, needed, strict=True))
        if too_few or n * len(fields) > max(_FEW_VALUES, _MOST_VALUES_PER_BYTE * sum(sizes)):
            raise ScanError(f"{origin}: claims {n} points and holds fewer; it is cut off or damaged, fetch it again")
        return cls(element, fields, n, container, vector)

    @property
    def prototype(self) -> Element:
        """The element that names the fields."""
        return prototype(self.element)

    @property
    def streams(self) -> list[bytes]:
        """The stream of each field, without what stands behind its last value."""
        whole = [self.vector.stream(self.container, number) for number in range(len(self.fields))]
        pairs = zip(self.fields, whole, strict=True)
        return [some if field.kind == "text" else some[: e57_file.bytes_of(field, self.n)] for field, some in pairs]

    def index_of(self, name: str) -> int | None:
        """The number of the field of that name."""
        return next((i for i, field in enumerate(self.fields) if field.name == name), None)

    def values(self, name: str) -> Column | None:
        """(n,) values of a field as stored, None where there is no such field."""
        number = self.index_of(name)
        if number is None:
            return None
        return self.fields[number].unpacked(self.vector.stream(self.container, number), self.n)

    def measured(self, name: str) -> Column | None:
        """(n,) values of a field in its unit: scaled integers are float64 then."""
        values, number = self.values(name), self.index_of(name)
        if values is None or number is None or self.fields[number].kind != "scaled":
            return values
        with np.errstate(over="ignore", invalid="ignore"):  # by a scale that no scanner has
            return values * self.fields[number].scale + self.fields[number].offset


@dataclass(frozen=True)
class Station:
    """One setup of a scanner: its records, rows of them in the scan, and its pose."""

    element: Element
    records: Records
    rows: slice
    pose: Pose

    @property
    def systems(self) -> list[tuple[str, ...]]:
        """The coordinates that it has, Cartesian ones first."""
        names = {field.name for field in self.records.fields}
        return [system for system in (CARTESIAN, SPHERICAL) if names.issuperset(system)]

    @property
    def coordinates(self) -> list[Field]:
        """The three fields that say where its points are."""
        return [field for name in self.systems[0] for field in self.records.fields if field.name == name]

    def local(self) -> Points:
        """(n, 3) points in the scanner's own frame."""
        system = self.systems[0]
        values = np.stack([np.asarray(self.records.measured(name), np.float64) for name in system], axis=1)
        if system == CARTESIAN:
            return values
        distance, azimuth, elevation = values.T
        flat = distance * np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)

    def world(self) -> Points:
        """(n, 3) points in the world; NaN where a record says that it is no measurement."""
        points = self.pose.to_world(self.local())
        state = self.records.values(INVALID[self.systems[0]])
        if state is not None:
            points[state != 0] = np.nan
        return points

    def from_world(self, points: Points, system: tuple[str, ...]) -> Points:
        """(m, 3) points of the world in the coordinates of one of the station's systems."""
        local = self.pose.from_world(points)
        if system == CARTESIAN:
            return local
        flat = np.hypot(local[:, 0], local[:, 1])
        azimuth, elevation = np.arctan2(local[:, 1], local[:, 0]), np.arctan2(local[:, 2], flat)
        return np.stack([np.hypot(flat, local[:, 2]), azimuth, elevation], axis=1)

    def step(self) -> float:
        """The length that coordinates are rounded to where they are coarsest; 0 where they are float64."""
        local = self.local()
        reach = float(np.linalg.norm(local[np.isfinite(local).all(axis=1)], axis=1).max(initial=0.0))
        steps = []
        for field in self.coordinates:
            is_angle = field.name in SPHERICAL[1:]
            floats = {"single": float(np.spacing(np.float32(np.pi if is_angle else reach))), "double": 0.0}
            steps.append(floats.get(field.kind, field.scale) * (reach if is_angle else 1.0))
        return max(steps)


def stations_of(container: Container, root: Element, origin: str) -> Iterator[Station]:
    """The stations that have points, in order. Raises ScanError on damage, and where points have no coordinates."""
    data, at, claimed = root.find("data3D"), 0, 0
    for element in data.children if data is not None else []:
        points = element.find("points")
        if points is None:
            continue
        records = Records.at(points, container, origin)
        claimed += records.vector.length
        if claimed > len(container.data):
            raise ScanError(f"{origin}: several stations claim the same points; it is damaged, fetch it again")
        try:
            station = Station(element, records, slice(at, at + records.n), _pose(element.find("pose")))
            for bounds in filter(None, map(element.find, BOUNDS)):
                _ = [end.number() for end in bounds.children]
        except ValueError:
            raise ScanError(f"{origin}: poses or bounds are no numbers; it is damaged, fetch it again") from None
        if not station.systems or any(field.kind == "text" for field in station.coordinates):
            names = ", ".join(field.name for field in records.fields)
            raise ScanError(f"{origin}: points have no coordinates (but {names}); save them as Cartesian ones")
        yield station
        at += records.n


def prototype(points: Element) -> Element:
    """The element that names the fields of records. Raises KeyError without one."""
    found = points.find("prototype")
    if found is None:
        raise KeyError("prototype")
    return found


def offset(element: Element, origin: str) -> int:
    """Where in the file the section is that an element names. Raises ScanError where it says none."""
    try:
        return _whole(element.attributes["fileOffset"])
    except (KeyError, ValueError):
        raise ScanError(f"{origin}: its XML says not where {element.name} is; it is damaged, fetch it again") from None


def _whole(text: str) -> int:
    """A number of places or records. Raises ValueError for anything else."""
    if not (text.isascii() and text.isdigit() and len(text) < 20):
        raise ValueError(f"{text[:_LONGEST_FAULT]!r} is no number of them")
    return int(text)


def _field(element: Element) -> Field:
    """Raises KeyError and ValueError for what is no field."""
    said, kind = element.attributes, _TYPES[element.attributes["type"]]
    if kind == "double":
        _ = float(said.get("minimum", 0)), float(said.get("maximum", 0))  # numbers, if anything
        return Field(element.name, "single" if said.get("precision") == "single" else "double")
    if kind == "text":
        return Field(element.name, "text")
    low, high = int(said.get("minimum", _LEAST)), int(said.get("maximum", _MOST))
    if not _LEAST <= low <= high <= _MOST:
        raise ValueError(f"{element.name} between {low} and {high}")
    scale, start = float(said.get("scale", 1)), float(said.get("offset", 0))
    if not (np.isfinite([scale, start]).all() and scale > 0):
        raise ValueError(f"{element.name} in steps of {scale} from {start}")
    return Field(element.name, "scaled" if kind == "scaled" else "integer", low, high, scale, start)


def _pose(element: Element | None) -> Pose:
    """Rotation by a quaternion, and translation. Raises ValueError for what is no number."""
    if element is None:
        return Pose(np.eye(3), np.eye(3), np.zeros(3))
    translation = np.array([element.number("translation", axis) for axis in "xyz"])
    w, *v = (element.number("rotation", axis, default=float(axis == "w")) for axis in "wxyz")
    length = float(np.hypot(w, np.hypot(v[0], np.hypot(v[1], v[2]))))
    if not (length > 0 and np.isfinite(length) and np.isfinite(translation).all()):
        raise ValueError("no rotation")
    w, (x, y, z) = w / length, np.array(v) / length
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * w * across + 2 * across @ across
    return Pose(rotation.T, rotation, translation)
