"""`pcdenoise verify`: proof that cleaning changed coordinates and nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcdenoise.commands import options
from pcdenoise.commands.console import figure, table
from pcdenoise.commands.files import format_of
from pcdenoise.commands.options import configured, option
from pcdenoise.errors import GateError

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Scan

MaxDrift = Annotated[
    float | None,
    option(
        "--max-drift", min=0, help="Fail if the surface itself moved, by more than so many times the noise; 0.3 is a good limit."
    ),
]


def verify(
    before: Annotated[Path, typer.Argument(metavar="BEFORE", help="The scan that went in.")],
    after: Annotated[Path, typer.Argument(metavar="AFTER", help="The scan that came out.")],
    max_move: Annotated[
        float | None, option("--max-move", min=0, help="Fail if a point moved farther, in the file's unit, rounding apart.")
    ] = None,
    max_drift: MaxDrift = None,
    noise: options.Noise = None,
    format: options.FormatRead = None,
    as_json: options.Json = False,
    config: options.Config = None,
) -> None:
    """Prove that every row and attribute survived, byte for byte, and say how far points moved. Exit code 5 if not.

    Compared are all columns, and what is beside them: VLRs and EVLRs of LAS with their content, faces of PLY, a viewpoint.
    Where rows were removed (denoise --outliers remove) nothing can be compared; --outliers flag keeps them.
    Drift is how far the surface moved as a whole: removing noise moves points to both sides and leaves it near 0.

    Example: pcdenoise verify scan.laz clean.laz --max-move 0.05 --max-drift 0.3
    """
    from pcdenoise import io
    from pcdenoise.config import DenoiseConfig

    noise = configured(DenoiseConfig, noise=noise).noise
    cleaned = io.read(after, format=format_of(after, format))
    findings = compare(io.read(before, format=format_of(before, format)), cleaned, noise)
    print(json.dumps(findings, indent=2) if as_json else _as_text(findings))
    if findings["lost"]:
        raise GateError(f"{after}: not everything of {before} survived: {'; '.join(findings['lost'])}")
    if max_move is not None and findings["move"]["max"] > max_move + io.rounding(cleaned):
        raise GateError(f"{after}: a point moved by {findings['move']['max']:.6g}, the limit is {max_move:g}")
    if findings["drift"] is not None:
        check_drift(after, findings["drift"], findings["noise_before"], max_drift)


def check_drift(path: Path, drift: float, noise: float, limit: float | None) -> None:
    """Raises GateError if a surface drifted by more than `limit` times the noise that was to be removed."""
    if limit is not None and drift > limit * noise:
        share = f", {figure(drift / noise)} of the noise" if noise > 0 else " without any noise"
        fix = "use fewer passes, less --strength or another --method"
        raise GateError(f"{path}: the surface drifted by {figure(drift)}{share}; the limit is {figure(limit)}; {fix}")


def compare(before: Scan, after: Scan, noise: float | None = None) -> dict[str, Any]:
    """What two scans share: attributes row by row, what is beside them, distances moved, drift, and a list of what was lost.

    noise: the standard deviation that there was, in the scans' unit, where somebody knows it; else as `info` reads it.
    """
    import numpy as np

    from pcdenoise.cloud import drift
    from pcdenoise.commands.survey import as_cleaned

    if len(before) != len(after):
        flag = "clean with --outliers flag rather than remove, or " if len(after) < len(before) else ""
        fix = f"{flag}verify the file that it came from"
        lost = [f"{len(before)} rows became {len(after)}, so none can be compared; {fix}"]
        return {
            "rows": [len(before), len(after)], "attributes": {}, "beside": {}, "added": [], "move": {},
            "drift": None, "drift_inward": None, "noise_before": None, "lost": lost,
        }  # fmt: skip
    attributes = {}
    for name, values in before.attributes.items():
        other = after.attributes.get(name)
        if other is None:
            attributes[name] = "missing"
        elif values.dtype.newbyteorder("=") != other.dtype.newbyteorder("="):
            attributes[name] = f"{values.dtype} became {other.dtype}"
        else:
            n_changed = int(_rows_that_differ(values, other).sum())
            attributes[name] = f"{n_changed} rows changed" if n_changed else "same"
    lost = [f"{name}: {verdict}" for name, verdict in attributes.items() if verdict != "same"]
    kept = _payloads(after)
    beside = {
        name: "missing" if name not in kept else "same" if kept[name] == payload else "changed"
        for name, payload in _payloads(before).items()
    }
    lost += [f"{name}: {verdict}" for name, verdict in beside.items() if verdict != "same"]
    if not np.array_equal(before.finite, after.finite):
        lost.append("rows without numbers (NaN, infinite) are not the same rows")
    both = before.finite & after.finite
    move = np.linalg.norm(after.points[both] - before.points[both], axis=1)
    noise = noise or as_cleaned(before.points[both])[1].std
    drifted = drift.measure(before.points[both], after.points[both])
    return {
        "rows": [len(before), len(after)],
        "attributes": attributes,
        "beside": beside,
        "added": [name for name in after.attributes if name not in before.attributes],
        "move": {
            "share": float((move > 0).mean()) if len(move) else 0.0,
            "median": float(np.median(move)) if len(move) else 0.0,
            "p95": float(np.quantile(move, 0.95)) if len(move) else 0.0,
            "max": float(move.max(initial=0.0)),
        },
        "drift": drifted.size,
        "drift_inward": drifted.inward,
        "noise_before": noise,
        "lost": lost,
    }


def _payloads(scan: Scan) -> dict[str, bytes]:
    return scan.source.payloads() if scan.source is not None else {}


def _rows_that_differ(values: Any, other: Any) -> Any:
    """(N,) whether the bytes of two columns of one dtype differ; NaN equals the same NaN."""
    import numpy as np

    as_bytes = [np.ascontiguousarray(column.astype(column.dtype.newbyteorder("="))) for column in (values, other)]
    rows = [column.view(np.uint8).reshape(len(column), column.dtype.itemsize) for column in as_bytes]
    return (rows[0] != rows[1]).any(axis=1)


def _as_text(findings: dict[str, Any]) -> str:
    n_before, n_after = findings["rows"]
    rows = [["rows", f"{n_before:,}" if n_before == n_after else f"{n_before:,} -> {n_after:,}"]]
    rows += [[name, verdict] for name, verdict in findings["attributes"].items()]
    rows += [[name, verdict] for name, verdict in findings["beside"].items()]
    rows += [[name, "added"] for name in findings["added"]]
    rows += [[f"move, {name}", f"{value:.1%}" if name == "share" else figure(value)] for name, value in findings["move"].items()]
    if (drift := findings["drift"]) is not None:
        noise = findings["noise_before"]
        share = f", {figure(drift / noise)} of the noise before" if noise > 0 else ""
        rows += [["drift", f"{figure(drift)}{share}"], ["drift, inward", figure(findings["drift_inward"])]]
    return table(["what", "before and after"], rows, left={0, 1})
