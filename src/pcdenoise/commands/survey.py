"""What is known about a scan before it is cleaned: noise, density, traps, and what cleaning will cost.

`info` prints it and `denoise --dry-run` plans with it. Not here: how the noise is measured (cloud.noise_level).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from pcdenoise.commands.files import attachments

if TYPE_CHECKING:
    from pcdenoise.cloud.noise_level import NoiseLevel
    from pcdenoise.cloud.scan import Points, Scan
    from pcdenoise.io.crs import Crs

N_NEIGHBOURS = 16
"""Nearest points whose disc gives the density."""

_COST = (40e-6, 1.2, 1050, 0.07e9)
"""CPU seconds that one pass of the shipped model takes for a point and a run beside that, bytes of memory likewise: a line
through `benchmarks/speed/measure.py --sizes 50K 800K`. To be set anew when the pass becomes faster."""
_COST_IN_TORCH = (90e-6, 5.0, 950, 0.36e9)
"""The same where nothing was compiled."""
_DRAW = 0.4  # of a pass: what one more draw of seeds takes

_MOST_JUDGED = 200_000  # points of which outliers are counted
_BLOCKS = 4  # compact parts of the cloud that they are taken from
_MANY_OUTLIERS = 1e-3
_MOST_DEGREES = (180.0, 90.0)


def survey(scan: Scan, seed: int = 0, threads: int = -1, *, unround: bool = True) -> dict[str, Any]:
    """Facts of a scan in its own unit, JSON-ready: counts, extent, density, noise and its spread, system, warnings, cost.

    density          points per square unit of surface.
    noise            std along the normal, as the default model would clean by; 5 % of the places lie below noise_p5, 5 % above
                     noise_p95.
    surface_share    of the points around which a surface shows.
    outlier_share    of points that are no sample of any surface, from up to 200 000 points.
    rounded_axis, rounding_step    where depths were rounded: noise, spacing and density are of points back between the steps.
    """
    import numpy as np

    from pcdenoise import io
    from pcdenoise.cloud import noise_level
    from pcdenoise.cloud.neighbours import NeighbourSearch, distinct, spatial_order
    from pcdenoise.cloud.scan import check_extent

    points = scan.points[scan.finite]
    check_extent(points)
    extent = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    first, _ = distinct(points)
    system = io.coordinate_system(scan)
    found: dict[str, Any] = {
        "format": scan.format,
        "points": len(scan),
        "not_finite": len(scan) - len(points),
        "duplicates": len(points) - len(first),
        "low": points.min(axis=0).tolist() if len(points) else None,
        "high": points.max(axis=0).tolist() if len(points) else None,
        "extent": extent.tolist(),
        "diagonal": float(np.linalg.norm(extent)),
        "attributes": {name: str(values.dtype) for name, values in scan.attributes.items()},
        "beside": attachments(scan),
        "crs": None if system is None else vars(system),
        "unit": unit_of(scan),
        "coordinate_step": io.coordinate_step(scan),
    }
    if len(first) < 2:
        return found | {"warnings": traps(scan, None)}
    points, level, rounded = as_cleaned(points, seed, threads, unround=unround)
    places = points[first]
    places = places[spatial_order(places)]
    probes = places[np.sort(np.random.default_rng(seed).choice(len(places), min(noise_level.N_PROBES, len(places)), False))]
    k = min(N_NEIGHBOURS, len(places))
    radius = float(np.median(NeighbourSearch(places, threads).knn(probes, k)[0][:, -1]))
    around = noise_level.around(points, level, probes, seed, threads)
    known = around[np.isfinite(around)]
    found |= {
        "spacing": level.spacing,
        "density": (k - 1) / (math.pi * radius**2),
        "noise": level.std,
        "noise_share_of_diagonal": level.std / found["diagonal"],
        "noise_p5": float(np.quantile(known, 0.05)) if len(known) else None,
        "noise_p95": float(np.quantile(known, 0.95)) if len(known) else None,
        "surface_share": len(known) / len(around),
        "is_surface": level.is_surface,
        "scale_points": level.scale_points,
        "outlier_share": _outlier_share(places, threads),
        "suggested_model": "default" if level.is_surface else None,
        "suggested_iters": 1 if level.is_surface else 0,
        **rounded,
        **cost(len(scan), 2 if rounded else 1),
    }
    said = traps(scan, level.std if level.is_surface else None)
    if rounded:
        step = f"{rounded['rounded_axis']} was rounded, in steps of {rounded['rounding_step']:.2g} at most points"
        said.append(f"{step}; denoise brings depths back between the steps, and the noise told here is what is left then")
    if found["outlier_share"] > _MANY_OUTLIERS:
        said.append("many points belong to no surface; --outliers flag marks them, --outliers remove leaves them out")
    return found | {"warnings": said}


def as_cleaned(
    points: Points, seed: int = 0, threads: int = -1, *, unround: bool = True
) -> tuple[Points, NoiseLevel, dict[str, Any]]:
    """(N, 3) finite points as the default model would be given them, their noise, and figures of depths that were rounded."""
    from pcdenoise.config import DenoiseConfig
    from pcdenoise.denoising.correction import unrounded
    from pcdenoise.denoising.denoiser import level_of
    from pcdenoise.networks import store

    config = DenoiseConfig.model_validate({"seed": seed, "threads": threads if threads > 0 else None, "unround": unround})
    correction = unrounded(points, config)
    return points + correction.shift, level_of(points, store.load(), config, correction), correction.figures


def cost(n_points: int, n_passes: float = 1, n_draws: int = 1) -> dict[str, float]:
    """Processor seconds and bytes of memory that cleaning so many points takes, roughly: machines differ."""
    from pcdenoise.networks import fused

    cpu_s_per_point, start_cpu_s, bytes_per_point, start_bytes = _COST if fused.IS_BUILT else _COST_IN_TORCH
    n_passes *= 1 + _DRAW * (n_draws - 1)
    return {
        "expected_cpu_s": start_cpu_s + cpu_s_per_point * n_points * n_passes,
        "expected_memory_mb": (start_bytes + bytes_per_point * n_points) / 1e6,
    }


def cost_text(found: dict[str, Any]) -> str:
    """`about 18 CPU s, 1.7 GB` of a survey."""
    seconds, megabytes = found["expected_cpu_s"], found["expected_memory_mb"]
    time = f"{seconds:.0f} CPU s" if seconds < 120 else f"{seconds / 60:.0f} CPU min"
    return f"about {time}, {megabytes / 1000:.1f} GB" if megabytes >= 1000 else f"about {time}, {megabytes:.0f} MB"


def _outlier_share(places: Points, threads: int) -> float:
    """Of distinct points in spatial order; of large clouds from a few compact parts."""
    import numpy as np

    from pcdenoise.denoising import outliers

    size = _MOST_JUDGED // _BLOCKS
    starts = [0] if len(places) <= _MOST_JUDGED else np.linspace(0, len(places) - size, _BLOCKS).astype(int).tolist()
    parts = [places] if len(starts) == 1 else [places[start : start + size] for start in starts]
    return float(np.mean([outliers.find(part, threads=threads).mean() for part in parts]))


def traps(scan: Scan, noise: float | None) -> list[str]:
    """What about a scan is likely to spoil a result, each with what to do about it; noise is None where no surface shows."""
    from pcdenoise import io

    said = []
    points = scan.points[scan.finite]
    system = io.coordinate_system(scan)
    if system and (misfit := _misfit(system, points)):
        said.append(
            f"the file's coordinate system cannot be right: it {misfit}; no unit is shown, correct the system at its source"
        )
        system = None
    elif (system and system.unit == "degree") or (system is None and _looks_like_degrees(points)):
        said.append("x and y are degrees and heights are not, so that distances mean nothing; project the scan to metres first")
    elif system and system.unit and system.vertical_unit and system.unit != system.vertical_unit:
        said.append(f"x and y are in {system.unit}, heights in {system.vertical_unit}; convert one of them first")
    if noise is None:
        return said
    if (step := io.coordinate_step(scan)) and noise < step:
        said.append(f"the noise is below the file's step of {step:g}, and moves below half of it vanish; write .ply to keep them")
    if (step := _float32_step(points)) > noise / 4:
        fix = "export from the source in float64, or with an offset"
        said.append(f"coordinates were rounded to float32, in steps of {step:g} so far from the origin; {fix}")
    return said


def _misfit(system: Crs, points: Points) -> str:
    return system.misfit(points.min(axis=0).tolist(), points.max(axis=0).tolist()) if len(points) else ""


def unit_of(scan: Scan) -> str:
    """The unit of a scan's coordinates, or nothing where its file names none or one that cannot be right."""
    from pcdenoise import io

    if scan.format == "e57":
        return "m"  # as its standard says
    system = io.coordinate_system(scan)
    return "" if system is None or _misfit(system, scan.points[scan.finite]) else system.unit


def _looks_like_degrees(points: Points) -> bool:
    """Longitude and latitude by their range: a small patch far from the origin that is a hundred times as high as it is wide."""
    import numpy as np

    if not len(points):
        return False
    low, high = points.min(axis=0), points.max(axis=0)
    largest, extent = np.maximum(np.abs(low), np.abs(high)), high - low
    wide = float(extent[:2].max())
    in_range = largest[0] <= _MOST_DEGREES[0] and largest[1] <= _MOST_DEGREES[1]
    return bool(in_range and 0 < wide < 0.02 * largest[:2].min() and extent[2] > 100 * wide)


def _float32_step(points: Points) -> float:
    """The step of float32 at the farthest coordinate if all coordinates are float32 values, else 0."""
    import numpy as np

    if not len(points) or not (points.astype(np.float32) == points).all():
        return 0.0
    return float(np.spacing(np.abs(points).max().astype(np.float32)))
