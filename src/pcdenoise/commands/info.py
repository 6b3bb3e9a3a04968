"""`pcdenoise info`: what a scan is and how noisy it is. Not here: how the noise is estimated (cloud.noise_level)."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdenoise.commands import options
from pcdenoise.commands.batch import Batch, Figures
from pcdenoise.commands.console import Console, facts, figure
from pcdenoise.commands.files import Job, attachments, expand, format_of

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Scan

N_NEIGHBOURS = 16
"""Nearest points whose disc gives the density."""


def info(
    inputs: options.Inputs,
    format: options.Format = None,
    as_json: options.Json = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    threads: options.Threads = None,
) -> None:
    """Say what scans are and how noisy: points, extent, spacing, density, noise, attributes, and how to clean them.

    Example: pcdenoise info scan.laz
    """
    from pcdenoise import io

    batch = Batch(Console())

    def describe(job: Job) -> Figures:
        facts_ = survey(io.read(job.source, format=format_of(job.source, format)), seed=seed, threads=threads or -1)
        if not as_json:
            print(_as_text(job.source, facts_), end="\n\n" if len(jobs) > 1 else "\n")
        return facts_

    jobs = [Job(source, source) for source in expand(inputs)]
    batch.run(jobs, describe)
    if as_json:
        done = [{"input": record["input"], **record["figures"]} for record in batch.records if record["status"] == "done"]
        print(json.dumps(done, indent=2))
    batch.close()


def survey(scan: Scan, seed: int = 0, threads: int = -1) -> dict[str, Any]:
    """Facts of a scan in its own unit: counts, extent, spacing, density (points per unit of surface), noise, attributes."""
    import numpy as np

    from pcdenoise.cloud import noise_level
    from pcdenoise.cloud.neighbours import NeighbourSearch
    from pcdenoise.cloud.scan import check_extent

    points = scan.points[scan.finite]
    check_extent(points)
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    distinct = np.unique(points, axis=0)
    facts_: dict[str, Any] = {
        "format": scan.format,
        "points": len(scan),
        "not_finite": len(scan) - len(points),
        "duplicates": len(points) - len(distinct),
        "low": points.min(axis=0).tolist() if len(points) else None,
        "high": points.max(axis=0).tolist() if len(points) else None,
        "extent": extent.tolist(),
        "diagonal": float(np.linalg.norm(extent)),
        "attributes": {name: str(values.dtype) for name, values in scan.attributes.items()},
        "beside": attachments(scan),
        "coordinate_step": coordinate_step(scan),
    }
    if len(distinct) < 2:
        return facts_
    level = noise_level.estimate(points, seed=seed, threads=threads)
    probes = distinct[
        np.random.default_rng(seed).choice(len(distinct), size=min(noise_level.N_PROBES, len(distinct)), replace=False)
    ]
    k = min(N_NEIGHBOURS, len(distinct))
    radius = float(np.median(NeighbourSearch(distinct, threads).knn(probes, k)[0][:, -1]))
    return facts_ | {
        "spacing": level.spacing,
        "density": (k - 1) / (math.pi * radius**2),
        "noise": level.std,
        "noise_share_of_diagonal": level.std / facts_["diagonal"],
        "is_surface": level.is_surface,
        "scale_points": level.scale_points,
    }


def coordinate_step(scan: Scan) -> float | None:
    """The power of ten, 1 to 1e-8, that all coordinates are multiples of (LAS, decimals of a text), from up to 10 000 rows."""
    import numpy as np

    some = scan.points[scan.finite][:: max(1, len(scan) // 10_000)]
    for decimals in range(9) if len(some) else ():
        scaled = some * 10.0**decimals
        if (np.abs(scaled - np.rint(scaled)) <= 1e-6 + 8 * np.finfo(np.float64).eps * np.abs(scaled)).all():
            return float(10.0**-decimals)
    return None


def _as_text(path: Path, found: dict[str, Any]) -> str:
    pairs = [
        ("file", f"{path} ({found['format']})"),
        (
            "points",
            f"{found['points']:,}" + _but(found["duplicates"], "duplicates") + _but(found["not_finite"], "without coordinates"),
        ),
        ("extent", " x ".join(figure(length) for length in found["extent"])),
    ]
    if "noise" in found:
        pairs += [
            ("spacing", f"{figure(found['spacing'])} to the nearest point, median"),
            ("density", f"{figure(found['density'])} points per square unit of surface"),
            ("noise", _noise(found)),
        ]
    if step := found["coordinate_step"]:
        pairs.append(("step", f"{step:g}: coordinates are multiples of it, moves below half of it vanish"))
    names = ", ".join(f"{name} ({dtype})" for name, dtype in found["attributes"].items())
    pairs.append(("attributes", names or "none"))
    if found["beside"]:
        pairs.append(("beside them", ", ".join(found["beside"])))
    return facts([*pairs, ("next", _suggestion(path, found))])


def _but(count: int, what: str) -> str:
    return f", {count:,} {what}" if count else ""


def _noise(found: dict[str, Any]) -> str:
    if not found["is_surface"]:
        return "no surface at any scale: leaves, clutter, a filled volume, or too few points to tell"
    spacings = found["noise"] / found["spacing"]
    return f"{figure(found['noise'])} ({found['noise_share_of_diagonal']:.3%} of the diagonal, {spacings:.2g} spacings)"


def _suggestion(path: Path, found: dict[str, Any]) -> str:
    if not found.get("is_surface"):
        return "nothing to clean: denoise would leave these points where they are"
    return f"pcdenoise denoise {shlex.quote(str(path))} -o {shlex.quote(f'{path.stem}_clean{path.suffix}')}"
