"""What no E57 file had before: columns as fields, and a scan from elsewhere as a file of one station.

Not here: files that are E57 already (e57.py).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pcdenoise.cloud.scan import Scan
from pcdenoise.io import e57_file
from pcdenoise.io.e57_file import Field, Layout
from pcdenoise.io.e57_stations import AXES_OF_BOUNDS, CARTESIAN, INVALID
from pcdenoise.io.e57_xml import a_number, a_text
from pcdenoise.io.source import Column, colours_as_bytes, free_name, is_number, narrowest_float, portable

NAMES = {
    "colorRed": "red", "colorGreen": "green", "colorBlue": "blue",
    "nor:normalX": "nx", "nor:normalY": "ny", "nor:normalZ": "nz",
}  # fmt: skip
"""Fields whose attributes have the names that other formats have for them."""
OURS, OUR_NAMESPACE = "pcdenoise:", "https://pypi.org/project/pcdenoise"
NAMESPACES = {"pcdenoise": OUR_NAMESPACE, "nor": "http://www.libe57.org/E57_NOR_surface_normals.txt"}
"""Of fields that the standard does not know, by their prefix."""
PROVENANCE = OURS + "provenance"

_STANDARD = ("intensity", "rowIndex", "columnIndex", "returnIndex", "returnCount", "timeStamp", "isTimeStampInvalid",
             "isIntensityInvalid", "isColorInvalid", *INVALID.values())  # fmt: skip
_FIELDS = {name: field for field, name in NAMES.items()} | {name: name for name in _STANDARD}


def storable(columns: Mapping[str, Column]) -> dict[str, Column]:
    """The columns that E57 has a number type for: all but text and uint64."""
    return {name: values for name, values in columns.items() if is_number(values) and e57_file.number_type(values.dtype)}


def added(columns: Mapping[str, Column], taken: Collection[str]) -> list[tuple[Field, bytes]]:
    """Fields for columns that a file has not, and their streams."""
    made: list[tuple[Field, bytes]] = []
    for name, values in columns.items():
        field = e57_file.number_type(values.dtype)
        assert field is not None, "unstorable columns are left out before"
        label = _FIELDS.get(name, OURS + re.sub(r"[^\w.-]|^(?=[\d.-])", "_", name, flags=re.ASCII))
        field = replace(field, name=free_name(label, [*taken, *(other.name for other, _ in made)]))
        made.append((field, field.packed(values)))
    return made


def described(field: Field) -> str:
    """A field as prototypes name it."""
    if field.kind in ("single", "double"):
        return f'<{field.name} type="Float" precision="{field.kind}"/>'
    least = min(max(0, field.low), field.high)  # the prototype's own value has to lie within its bounds
    return f'<{field.name} type="Integer" minimum="{field.low}" maximum="{field.high}">{least}</{field.name}>'


def created(scan: Scan, provenance: Mapping[str, Any] | None) -> bytes:
    """A new file of one station without a pose; rows that are not finite are marked as no measurements."""
    kind = Field("", "single" if narrowest_float(scan.points[scan.finite]) == "f4" else "double")
    points = np.where(scan.finite[:, None], scan.points, 0.0)
    table = [(replace(kind, name=name), kind.packed(points[:, axis])) for axis, name in enumerate(CARTESIAN)]
    if not scan.finite.all():
        state = Field(INVALID[CARTESIAN], "integer", 0, 2)
        table.append((state, state.packed(np.where(scan.finite, 0, 2))))
    columns = storable(colours_as_bytes(portable(scan.attributes)))
    columns = {name: values for name, values in columns.items() if name not in [field.name for field, _ in table]}
    table += added(columns, [field.name for field, _ in table])
    layout = Layout()
    at = layout.add_vector([field for field, _ in table], [stream for _, stream in table], len(scan))
    known = scan.points[scan.finite] if scan.finite.any() else np.zeros((1, 3))
    ends = [(axis, values) for axis, values in zip(AXES_OF_BOUNDS["cartesianBounds"], known.T, strict=True)]
    limits = "".join(
        _limits(group, {field: columns[name] for name, field in _FIELDS.items() if name in columns and field.startswith(group)})
        for group in ("intensity", "color")
    )
    spaces = "".join(f' xmlns:{short}="{name}"' for short, name in NAMESPACES.items())
    prototype = "".join(described(field) for field, _ in table)
    bounds = "".join(
        a_number(axis + "Minimum", float(values.min())) + a_number(axis + "Maximum", float(values.max())) for axis, values in ends
    )
    made_by = "" if provenance is None else a_text(PROVENANCE, json.dumps(provenance))
    import uuid

    digest = hashlib.sha256(layout.data).hexdigest()
    file_id, station_id = (
        f"{{{uuid.uuid5(uuid.NAMESPACE_URL, f'{OUR_NAMESPACE}/{part}/{digest}')}}}" for part in ("file", "station")
    )
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0"{spaces}>\n'
        f"{a_text('formatName', 'ASTM E57 3D Imaging Data File')}{a_text('guid', file_id)}"
        f"{a_number('versionMajor', 1, 'Integer')}{a_number('versionMinor', 0, 'Integer')}\n"
        '<data3D type="Vector" allowHeterogeneousChildren="1">\n<vectorChild type="Structure">'
        f"{a_text('guid', station_id)}{limits}"
        f'<cartesianBounds type="Structure">{bounds}</cartesianBounds>\n'
        f'<points type="CompressedVector" fileOffset="{at}" recordCount="{len(scan)}">'
        f'<prototype type="Structure">{prototype}</prototype>'
        '<codecs type="Vector" allowHeterogeneousChildren="1"></codecs></points>\n'
        f"</vectorChild>\n</data3D>\n{made_by}</e57Root>\n"
    )
    return e57_file.closed(layout.data, xml.encode())


def _limits(group: str, columns: Mapping[str, Column]) -> str:
    """The element that says between what values the colours or the intensities of a station lie."""
    parts = []
    for field, values in columns.items():
        kind = "Float" if values.dtype.kind == "f" else "Integer"
        known = values[np.isfinite(values)] if kind == "Float" else values
        ends = (known.min(), known.max()) if len(known) else (0, 0)
        if group == "color":
            ends = (0, np.iinfo(values.dtype).max if kind == "Integer" else 1)
        parts += [a_number(field + end, value.item() if hasattr(value, "item") else value, kind)
                  for end, value in zip(("Minimum", "Maximum"), ends, strict=True)]  # fmt: skip
    return f'<{group}Limits type="Structure">{"".join(parts)}</{group}Limits>' if parts else ""
