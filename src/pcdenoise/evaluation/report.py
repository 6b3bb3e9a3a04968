"""A run's figures as a file: JSON, CSV or a page with a 3D viewer. Not here: packing of clouds (scene.py).

The JSON schema `pcdenoise-report/1` is one object:

    schema      "pcdenoise-report/1"
    command     the command that wrote it
    version     of pcdenoise
    settings    object: every argument and configuration value that shaped the result, with seed, model name and hash
    figures     object: numbers about the whole run
    files       array of objects, one for each input: input, output, status, figures

Other keys may follow. A number that is not finite is null, a name ends in its unit where it has one (`noise_std_m`), and no key
changes its meaning within a version of the schema.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from html import escape
from importlib import resources
from os import PathLike
from pathlib import PurePath
from typing import Any

import numpy as np

from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError
from pcdenoise.evaluation.charts import Chart, histogram, short
from pcdenoise.evaluation.colours import Colour, Scalar, displacement
from pcdenoise.evaluation.output import write_whole
from pcdenoise.evaluation.raster import Image, png_bytes
from pcdenoise.evaluation.scene import pack

SCHEMA = "pcdenoise-report/1"
Report = Mapping[str, Any]
_WORDS = {
    "move_median": "move, median", "move_p95": "move, 95 % below", "move_p99": "move, 99 % below", "move_max": "move, longest",
    "is_surface": "shows a surface", "drift_inward": "drift, inward", "roughness_before": "scatter before",
    "roughness_after": "scatter after", "iters": "passes", "iterations": "passes",
    "cd": "Chamfer distance (1e-4, unit sphere)", "p2s": "to the surface (1e-4, unit sphere)",
    "p2m": "to and from the surface (1e-4, unit sphere)", "td": "Total Denoising's error (% of the diagonal)",
    "shrinkage": "shrinkage (% of the diagonal)", "normal_error": "error of normals (\u00b0)",
    "estimated_error_before": "error before, estimated", "estimated_error_after": "error after, estimated", "cpu_s": "CPU (s)",
}  # fmt: skip
"""How a page says what JSON calls so."""
_UNITS = {"m": "m", "mm": "mm", "s": "s", "percent": "%", "mb": "MB", "deg": "\u00b0"}


@dataclass(frozen=True)
class Page:
    """What an HTML report shows besides figures and settings.

    before, after   (N, 3) clouds of the viewer.
    same_points     whether row i is the same point in both: false for a prediction and its truth, which are shown side by side.
    steps           named (N, 3) clouds between them, in order: the iterations.
    names           what the viewer calls before and after.
    colours         named colours, each (N,), (N, 3) or a Scalar; the displacement is added where it is known.
    charts          histograms and curves; where there are none, one of the displacement is added.
    pictures        named (H, W, 3) uint8 images.
    tables          named lists of rows, each a mapping with the same keys.
    lead            a line under the title.
    unit            of the coordinates.
    """

    before: Points | None = None
    after: Points | None = None
    steps: Mapping[str, Points] = field(default_factory=dict)
    names: tuple[str, str] = ("Before", "After")
    colours: Mapping[str, Colour] = field(default_factory=dict)
    charts: Sequence[Chart] = ()
    pictures: Mapping[str, Image] = field(default_factory=dict)
    tables: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    lead: str = ""
    unit: str = ""
    same_points: bool = True


def write_report(path: str | PathLike[str], report: Report, page: Page | None = None, *, overwrite: bool = True) -> None:
    """Write `report` as its suffix says: .json, .csv (one row for each of its files) or .html (with `page`).

    Raises UsageError for another suffix and ScanError if the file cannot be written."""
    suffix = PurePath(path).suffix.lower()
    if suffix == ".json":
        write_json(path, report, overwrite=overwrite)
    elif suffix == ".csv":
        write_csv(path, report.get("files", []), overwrite=overwrite)
    elif suffix in {".html", ".htm"}:
        page = page or Page()
        files = report.get("files", [])
        tables = page.tables or ({"Files": [_line(record) for record in files]} if len(files) > 1 else {})
        name = f": {PurePath(str(files[0]['input'])).name}" if len(files) == 1 and files[0].get("input") else ""
        title = str(report.get("title") or f"pcdenoise {report.get('command', '')}{name}".strip())
        write_html(
            path,
            title=title,
            figures=report.get("figures", {}),
            settings=report.get("settings", {}),
            page=replace(page, tables=tables),
            overwrite=overwrite,
        )
    else:
        raise UsageError(f"{path}: a report is written as .json, .csv or .html; choose one of these suffixes")


def write_json(path: str | PathLike[str], report: Report, *, overwrite: bool = True) -> None:
    """The report as JSON of schema `pcdenoise-report/1`; arrays become lists. Raises TypeError for what JSON cannot hold."""
    text = json.dumps({"schema": SCHEMA, **plain(report)}, indent=2, ensure_ascii=False, allow_nan=False)
    _write(path, text + "\n", overwrite)


def write_csv(path: str | PathLike[str], rows: Iterable[Mapping[str, Any]], *, overwrite: bool = True) -> None:
    """Rows as CSV (RFC 4180): nested keys joined with dots, columns in order of appearance, empty where there is no number."""
    flat = [_flat(plain(row)) for row in rows]
    columns = list(dict.fromkeys(key for row in flat for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\r\n")
    writer.writeheader()
    writer.writerows({key: json.dumps(value) if isinstance(value, list) else value for key, value in row.items()} for row in flat)
    _write(path, text.getvalue(), overwrite)


def write_html(
    path: str | PathLike[str],
    *,
    title: str,
    figures: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    page: Page | None = None,
    overwrite: bool = True,
) -> None:
    """One page that works offline: viewer (if the page has a cloud), figures, charts, settings, tables, pictures."""
    page = page or Page()
    scene, data = _scene(page)
    charts = list(page.charts) or _displacement_chart(page)
    side = [_card("Figures", _table(figures)) if figures else ""]
    side += [_card(chart.title, chart.svg(), "chart") for chart in charts]
    wide = [_card(name, _grid(rows), "wide") for name, rows in page.tables.items()]
    chosen = {key: value for key, value in (settings or {}).items() if value not in (None, "")}
    if chosen:
        (wide if scene else side).append(_card("Settings", _table(chosen), "wide settings" if scene else ""))
    if page.pictures:
        wide.append(_card("Pictures", "".join(_figure(name, image) for name, image in page.pictures.items()), "wide", "pictures"))
    template = resources.files("pcdenoise.evaluation").joinpath("viewer.html").read_text(encoding="utf-8")
    parts = {
        "title": escape(title),
        "lead": escape(page.lead),
        "alone": "" if scene else "alone",
        "side": f'<div class="side">{"".join(side)}</div>' if any(side) else "",
        "wide": "".join(wide),
        "footer": "Made by pcdenoise. Everything is in this file: it needs no network and sends nothing.",
        "scene": json.dumps(scene, allow_nan=False).replace("<", "\\u003c"),
        "data": data,
    }
    _write(path, re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template), overwrite)


def plain(value: Any) -> Any:
    """The value in types that JSON has. Raises TypeError for anything else."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if hasattr(value, "model_dump"):
        return plain(value.model_dump(mode="json"))
    raise TypeError(f"report: {type(value).__name__} cannot be written; give numbers, text, lists or mappings")


def _write(path: str | PathLike[str], text: str, overwrite: bool) -> None:
    write_whole(path, text.encode("utf-8", "backslashreplace"), overwrite=overwrite)  # names of files may be no UTF-8


def _flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _line(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record of a batch as a row of a table: its figures beside its names, without an output that was not written."""
    named = {key: value for key, value in plain(record).items() if key != "figures" and value not in (None, "", "-")}
    return {**named, **(record.get("figures") or {})}


def _scene(page: Page) -> tuple[dict[str, Any] | None, str]:
    """Description and data of the viewer, or None and nothing without a cloud."""
    if page.before is None:
        return None, ""
    clouds = {page.names[0]: page.before, **page.steps, **({page.names[1]: page.after} if page.after is not None else {})}
    colours = dict(page.colours)
    if (moved := _displacement(page)) is not None and "displacement" not in colours:
        colours["displacement"] = moved
    return pack(clouds, colours, page.unit, same_points=page.same_points)


def _displacement(page: Page) -> Scalar | None:
    if page.before is None or page.after is None or not page.same_points:
        return None
    return displacement(page.before, page.after, page.unit)


def _displacement_chart(page: Page) -> list[Chart]:
    moved = _displacement(page)
    return [] if moved is None else [histogram(moved.values, title="How far points moved", label=moved.label)]


def _card(title: str, body: str, kind: str = "", inner: str = "scroll") -> str:
    return f'<section class="card {kind}"><h2>{escape(title)}</h2><div class="{inner}">{body}</div></section>'


def _figure(name: str, image: Image) -> str:
    shape = ' class="panorama"' if image.shape[1] > 1.6 * image.shape[0] else ""
    source = base64.b64encode(png_bytes(image)).decode("ascii")
    picture = f'<img src="data:image/png;base64,{source}" alt="{escape(name)}">'
    return f"<figure{shape}>{picture}<figcaption>{escape(name)}</figcaption></figure>"


def _table(values: Mapping[str, Any]) -> str:
    """Two columns; what is nested is listed under its own names joined with the outer one."""
    rows = "".join(
        f'<tr><th scope="row">{_name(key)}</th><td{_kind(_is_number(value))}>{_cell(value)}</td></tr>'
        for key, value in _flat(plain(values)).items()
    )
    return f'<table class="pairs"><tbody>{rows}</tbody></table>'


def _grid(rows: Sequence[Mapping[str, Any]]) -> str:
    flat = [_flat(plain(row)) for row in rows]
    columns = list(dict.fromkeys(key for row in flat for key in row))
    numeric = {key for key in columns if any(_is_number(row.get(key)) for row in flat)}
    kinds = {key: _kind(key in numeric) for key in columns}
    head = "".join(f'<th scope="col"{kinds[key]}>{_name(key)}</th>' for key in columns)
    body = "".join("<tr>" + "".join(f"<td{kinds[key]}>{_cell(row.get(key))}</td>" for key in columns) + "</tr>" for row in flat)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _kind(is_number: bool) -> str:
    """The class of a cell that stands to the right and is not broken."""
    return ' class="number"' if is_number else ""


def in_words(key: str) -> str:
    """A key of a report as a page says it: `noise_std_m` is `Noise std (m)`."""
    words = _WORDS.get(key, key).replace(".", ": ").split("_")
    if len(words) > 1 and words[-1] in _UNITS:
        words[-1] = f"({_UNITS[words[-1]]})"
    name = " ".join(words)
    return name[:1].upper() + name[1:]


def _name(key: str) -> str:
    return escape(in_words(key))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value in (None, ""):
        return "\u2013"
    if isinstance(value, list):
        return ", ".join(f"{item:g}" if _is_number(item) else _cell(item) for item in value)
    return short(value) if _is_number(value) else escape(str(value))
