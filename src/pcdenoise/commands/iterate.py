"""`pcdenoise iterate`: every pass of a denoising run, to look at. Not here: when to stop (denoising)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcdenoise.commands import aligning, options, outputs
from pcdenoise.commands.cleaning import chosen_model, named_model
from pcdenoise.commands.console import Console, counted, figure, table
from pcdenoise.commands.denoise import Draws, Iters, Method, Neighbours, Radius, SigmaD, SigmaN, Unshrink
from pcdenoise.commands.eval_chamfer import points_to_compare
from pcdenoise.commands.files import format_of, refuse_folder, refuse_unwritable, target_name
from pcdenoise.commands.options import argument, configured, option

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Points, Scan
    from pcdenoise.synthesis.meshes import Mesh


def iterate(
    source: Annotated[Path, argument(metavar="IN", help="The scan.")],
    output: Annotated[Path, option("--output", "-o", metavar="DIR", help="The folder for every pass.")],
    model: options.Model = None,
    method: Method = "network",
    iters: Iters = "5",
    draws: Draws = 1,
    noise: options.Noise = None,
    align_by: aligning.AlignBy = None,
    unround: aligning.Unround = True,
    unshrink: Unshrink = None,
    neighbours: Neighbours = None,
    radius: Radius = None,
    sigma_d: SigmaD = None,
    sigma_n: SigmaN = None,
    clean: Annotated[Path | None, option("--clean", metavar="FILE", help="Also show the error against this clean cloud.")] = None,
    mesh: Annotated[Path | None, option("--mesh", metavar="FILE", help="Also show the error against this surface.")] = None,
    format: options.Format = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    threads: options.Threads = None,
    quiet: options.Quiet = False,
) -> None:
    """Write the scan after every pass, with a table, a strip of pictures (passes.png) and a page with a 3D viewer (report.html).

    An error against a given truth is shown and never used to choose anything.

    Example: pcdenoise iterate scan.laz -o steps/ --iters 5
    """
    import numpy as np

    from pcdenoise import io
    from pcdenoise.config import DenoiseConfig
    from pcdenoise.denoising import denoiser
    from pcdenoise.synthesis.meshes import load_mesh

    settings = configured(
        DenoiseConfig, method=method, iters=iters, draws=draws, noise=noise, align_by=aligning.columns(align_by),
        unround=unround, unshrink=unshrink, neighbours=neighbours, radius=radius, sigma_d=sigma_d, sigma_n=sigma_n, seed=seed,
        threads=threads,
    )  # fmt: skip
    strip, report = output / "passes.png", output / "report.html"
    refuse_folder(output)
    refuse_unwritable([strip, report], overwrite)
    scan = io.read(source, format=format_of(source, format))

    def target(number: int) -> Path:
        return output / target_name(source, f"_{number}", format, scan.format)

    refuse_unwritable([] if settings.iters == "auto" else [target(1 + number) for number in range(settings.iters)], overwrite)
    truth = _Truth(points_to_compare(clean, format) if clean else None, load_mesh(mesh) if mesh else None)
    weights = chosen_model(model, settings)
    named = {**settings.model_dump(mode="json"), **named_model(weights)}
    passes = [_Pass(scan.points, truth.errors(scan.points))]
    console = Console(quiet)
    with console.progress(source.name) as on_progress:
        correction = aligning.correction(scan, np.ones(len(scan), bool), weights, settings, console, on_progress)
        steps = denoiser.iterate(scan.points, weights, settings, correction=correction)
        for number, step in enumerate(steps, start=1):
            on_progress(f"pass {number}", 0.0 if settings.iters == "auto" else number / settings.iters)
            output.mkdir(parents=True, exist_ok=True)
            io.write(
                scan.moved_to(step.points), target(number), format=format_of(target(number), format), overwrite=overwrite,
                provenance=outputs.provenance("iterate", {**named, "pass": number}),
            )  # fmt: skip
            figures = {name: value for name, value in step.figures.items() if name != "iteration"}
            passes.append(_Pass(step.points, {**figures, **truth.errors(step.points)}))
    output.mkdir(parents=True, exist_ok=True)  # a scan without a surface has no pass
    print(_as_text(passes))
    _save_strip(strip, scan, passes, overwrite)
    _save_report(report, scan, passes, {**named, **correction.figures}, overwrite)
    console.note(f"{output}: {counted(len(passes) - 1, 'pass', 'passes')}, {strip.name}, {report.name}")


@dataclass(frozen=True)
class _Pass:
    """The points after a pass (the first entry: before any) and what is known about it."""

    points: Points
    figures: dict[str, Any]


@dataclass(frozen=True)
class _Truth:
    """What the user knows about the surface; for showing errors, never for choosing."""

    clean: Points | None
    mesh: Mesh | None

    def errors(self, points: Points) -> dict[str, float]:
        """The metrics of (N, 3) points that the truth allows, none without a truth."""
        import numpy as np

        from pcdenoise.evaluation.chamfer import evaluate

        if self.clean is None and self.mesh is None:
            return {}
        return evaluate(points[np.isfinite(points).all(axis=1)], self.clean, self.mesh)


def _finite(scan: Scan) -> Points:
    return scan.points[scan.finite]


def _as_text(passes: list[_Pass]) -> str:
    names = list(dict.fromkeys(name for entry in passes for name in entry.figures))
    rows = [[str(number), *(_cell(entry.figures.get(name)) for name in names)] for number, entry in enumerate(passes)]
    return table(["pass", *(name.replace("_", " ") for name in names)], rows)


def _cell(value: Any) -> str:
    return figure(value) if isinstance(value, float) else "" if value is None else str(value)


def _save_strip(path: Path, scan: Scan, passes: list[_Pass], overwrite: bool) -> None:
    from pcdenoise.evaluation.framing import camera_for
    from pcdenoise.evaluation.pictures import render, strip, write_png

    size = (480, 360)
    camera, colour = camera_for(_finite(scan), size), outputs.rgb(scan)
    images = [render(entry.points, colour=colour, view=camera, size=size) for entry in passes]
    write_png(path, strip(images, ["Before", *(f"Pass {number}" for number in range(1, len(passes)))]), overwrite=overwrite)


def _save_report(path: Path, scan: Scan, passes: list[_Pass], settings: dict[str, Any], overwrite: bool) -> None:
    from pcdenoise.evaluation.charts import curve
    from pcdenoise.evaluation.report import Page, in_words

    last = passes[-1]
    numbers = range(len(passes))
    names = [name for name, value in last.figures.items() if isinstance(value, float) and not name.endswith("_before")]
    charts = [
        curve(
            {"": [entry.figures.get(name, float("nan")) for entry in passes]},
            title=in_words(name),
            x_label="Pass",
        )
        for name in names
    ]
    steps = {f"Pass {number}": passes[number].points for number in numbers[1:-1]}
    rows = [{"pass": number, **passes[number].figures} for number in numbers if passes[number].figures]
    page = Page(scan.points, last.points, steps=steps, colours=outputs.colours(scan), charts=charts, tables={"Passes": rows})
    files = [{"input": scan.origin, "status": "done", "figures": {"passes": len(passes) - 1, **last.figures}}]
    outputs.save_report(path, "iterate", settings, files, page, overwrite=overwrite)
