"""`pcdenoise info`: what a scan is and how noisy it is. Not here: the facts themselves (survey.py)."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcdenoise.commands import options
from pcdenoise.commands.batch import Batch, Figures
from pcdenoise.commands.console import Console, facts, figure
from pcdenoise.commands.files import Job, beside, expand, format_of, refuse_unwritable, target_name
from pcdenoise.commands.options import option
from pcdenoise.commands.survey import cost_text, survey

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pcdenoise.cloud.scan import Scan


def info(
    inputs: options.Inputs,
    picture: Annotated[
        str,
        option(
            "--picture",
            callback=options.picture_known,
            metavar="OUT",
            help="Draw where the noise is: a .png, or a folder for several.",
        ),
    ] = "",
    noise_map: Annotated[
        str, option("--noise-map", metavar="OUT", help="Write the scan with a column noise: a file, or a folder for several.")
    ] = "",
    format: options.FormatRead = None,
    as_json: options.Json = False,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    threads: options.Threads = None,
) -> None:
    """Say what scans are and how noisy: extent, spacing, density, noise and where it is, traps, and how to clean them.

    Example: pcdenoise info scan.laz --picture noise.png
    """
    from pcdenoise import io

    batch = Batch(Console())
    sources = expand(inputs)
    pictures = beside(sources, picture, "--picture", format="png", suffix="_noise")
    maps = beside(sources, noise_map, "--noise-map", suffix="_noise")
    refuse_unwritable([*pictures.values(), *maps.values()], overwrite)

    def describe(job: Job) -> Figures:
        scan = io.read(job.source, format=format_of(job.source, format))
        found = survey(scan, seed=seed, threads=threads or -1)
        if job.source in {**pictures, **maps}:
            noise = _noise_of_rows(scan, seed, threads or -1)
            if target := pictures.get(job.source):
                _draw(target, scan, noise, found["unit"], overwrite)
            if target := maps.get(job.source):
                target.parent.mkdir(parents=True, exist_ok=True)
                marked = scan.with_attributes(noise=noise.astype("f4"))
                io.write(marked, target, format=format_of(target, format), overwrite=overwrite)
        return found

    def show(job: Job, found: Figures) -> None:
        print(_as_text(job.source, found), end="\n\n" if len(jobs) > 1 else "\n")

    jobs = [Job(source, source) for source in sources]
    batch.run(jobs, describe, show=None if as_json else show)
    if as_json:
        done = [{"input": record["input"], **record["figures"]} for record in batch.records if record["status"] == "done"]
        print(json.dumps(done, indent=2))
    batch.close()


def _noise_of_rows(scan: Scan, seed: int, threads: int) -> NDArray[np.float64]:
    """(N,) noise std around each row, NaN where no surface shows or the row has no coordinates."""
    import numpy as np

    from pcdenoise.cloud import noise_level
    from pcdenoise.commands.survey import as_cleaned

    points, level, _ = as_cleaned(scan.points[scan.finite], seed, threads)
    values = np.full(len(scan), np.nan)
    values[scan.finite] = noise_level.around(points, level, seed=seed, threads=threads)
    return values


def _draw(path: Path, scan: Scan, noise: NDArray[np.float64], unit: str, overwrite: bool) -> None:
    import numpy as np

    from pcdenoise.evaluation.colours import Scalar
    from pcdenoise.evaluation.pictures import render, write_png

    label = f"Noise ({unit})" if unit else "Noise"
    if np.isnan(noise[scan.finite]).any():
        label += "; grey: no surface shows"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, render(scan.points, colour=Scalar(noise, label)), overwrite=overwrite)


def _as_text(path: Path, found: dict[str, Any]) -> str:
    from pcdenoise.io.crs import Crs

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
        if found["noise_p5"] is not None:
            shown = f"; a surface shows around {found['surface_share']:.0%} of the points"
            pairs.append(("noise map", f"{figure(found['noise_p5'])} to {figure(found['noise_p95'])} at 5 % and 95 %{shown}"))
        pairs.append(("outliers", f"{found['outlier_share']:.3%} of the points"))
    if system := found["crs"]:
        doubt = "" if found["unit"] == system["unit"] else "; not to be believed, see the warning"
        pairs.append(("system", f"{Crs(**system)}{doubt}"))
    if step := found["coordinate_step"]:
        pairs.append(("step", f"{step:g}: coordinates are multiples of it, {_step_share(found)}"))
    names = ", ".join(f"{name} ({dtype})" for name, dtype in found["attributes"].items())
    pairs.append(("attributes", names or "none"))
    if found["beside"]:
        pairs.append(("beside them", ", ".join(found["beside"])))
    pairs += [("warning", text) for text in found["warnings"]]
    if found.get("is_surface"):
        pairs.append(("cost", f"{cost_text(found)} for a pass with the default model; one pass does nearly all"))
    return facts([*pairs, ("next", _suggestion(path, found))])


def _step_share(found: dict[str, Any]) -> str:
    share = found.get("noise", 0.0) / found["coordinate_step"]
    return f"the noise is {figure(share)} of them" if found.get("is_surface") else "moves below half of it vanish"


def _but(count: int, what: str) -> str:
    return f", {count:,} {what}" if count else ""


def _noise(found: dict[str, Any]) -> str:
    if not found["is_surface"]:
        return "no surface at any scale: leaves, clutter, a filled volume, or too few points to tell"
    spacings = found["noise"] / found["spacing"]
    unit = found["unit"]
    share = f"{found['noise_share_of_diagonal']:.3%} of the diagonal, {spacings:.2g} spacings"
    return f"{figure(found['noise'])}{' ' if unit else ''}{unit} ({share})"


def _suggestion(path: Path, found: dict[str, Any]) -> str:
    if not found.get("is_surface"):
        return "nothing to clean: denoise would leave these points where they are"
    return f"pcdenoise denoise {shlex.quote(str(path))} -o {shlex.quote(target_name(path, '_clean', found=found['format']))}"
