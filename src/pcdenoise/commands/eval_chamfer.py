"""`pcdenoise eval-chamfer`: how far results are from the truth. Not here: the metrics (evaluation.chamfer)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcdenoise.commands import options, outputs
from pcdenoise.commands.batch import Batch, Figures
from pcdenoise.commands.console import Console, counted, figure, table
from pcdenoise.commands.files import STREAM, Job, beside, expand, format_of, refuse_unwritable
from pcdenoise.commands.options import option
from pcdenoise.errors import ScanError, UsageError

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Points
    from pcdenoise.evaluation.report import Page
    from pcdenoise.synthesis.meshes import Mesh


def eval_chamfer(
    inputs: options.Inputs,
    clean: Annotated[Path | None, option("--clean", metavar="FILE", help="The clean cloud.")] = None,
    mesh: Annotated[Path | None, option("--mesh", metavar="FILE", help="The true surface, for exact distances.")] = None,
    error_ply: Annotated[
        str,
        option("--error-ply", metavar="OUT", help="Write errors as a coloured PLY: a file, or a folder for several."),
    ] = "",
    picture: Annotated[str, option("--picture", metavar="OUT", help="Write the histogram of errors as PNG, likewise.")] = "",
    format: options.FormatRead = None,
    report: options.Report = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    quiet: options.Quiet = False,
) -> None:
    """Measure results against a clean cloud, a mesh, or both; the last row is the mean over several results.

    cd is the Chamfer distance of the PU-Net protocol, p2s and p2m are its distances to the surface, td is the metric of Total
    Denoising. All are best at 0. Rows without coordinates are left out.

    Example: pcdenoise eval-chamfer result.ply --clean clean.ply --mesh surface.ply
    """
    from pcdenoise.synthesis.meshes import load_mesh

    if clean is None and mesh is None:
        raise UsageError("there is no truth to compare with; give --clean FILE, --mesh FILE or both")
    sources = expand(inputs)
    coloured = beside(sources, error_ply, "--error-ply", format="ply", suffix="_error")
    pictures = beside(sources, picture, "--picture", format="png", suffix="_error")
    refuse_unwritable([*coloured.values(), *pictures.values(), report], overwrite)
    clean_points = points_to_compare(clean, format) if clean else None
    measuring = _Measuring(clean_points, load_mesh(mesh) if mesh else None, format, coloured, pictures, overwrite)
    batch = Batch(Console(quiet))
    batch.run([Job(source, STREAM) for source in sources], measuring.measure)
    if outputs.n_failed(batch.records) < len(sources):
        print(_as_text(batch.records))
    if report:
        settings = {"clean": clean and str(clean), "mesh": mesh and str(mesh)}
        page = measuring.pages[0] if len(batch.records) == len(measuring.pages) == 1 else None
        outputs.save_report(report, "eval-chamfer", settings, batch.records, page, overwrite=overwrite)
    batch.close()


def points_to_compare(path: Path, format: str | None) -> Points:
    """(N, 3) points of a file, without those that have no coordinates. Raises ScanError if they are too few for any metric."""
    from pcdenoise import io

    scan = io.read(path, format=format_of(path, format))
    points = scan.points[scan.finite]
    if len(points) < 2:
        raise ScanError(f"{path}: has {counted(len(points), 'point')} with coordinates, and errors need two; check what wrote it")
    return points


@dataclass(frozen=True)
class _Measuring:
    """The truth, and where each result's coloured cloud and histogram go."""

    clean: Points | None
    mesh: Mesh | None
    format: str | None
    coloured: dict[Path, Path]
    pictures: dict[Path, Path]
    overwrite: bool
    pages: list[Page] = field(default_factory=list)

    def measure(self, job: Job) -> Figures:
        """The metrics of one result; its error cloud and histogram are written on the way."""
        import numpy as np

        from pcdenoise import io
        from pcdenoise.cloud.scan import Scan
        from pcdenoise.evaluation.chamfer import evaluate, point_errors
        from pcdenoise.evaluation.charts import histogram
        from pcdenoise.evaluation.colours import Scalar
        from pcdenoise.evaluation.pictures import write_png
        from pcdenoise.evaluation.raster import colour_map
        from pcdenoise.evaluation.report import Page

        points = points_to_compare(job.source, self.format)
        metrics = evaluate(points, self.clean, self.mesh)
        errors = Scalar(point_errors(points, self.clean, self.mesh), "Distance to the truth")
        chart = histogram(errors.values, title="Errors", label=errors.label)
        if target := self.coloured.get(job.source):
            red, green, blue = np.round(255 * colour_map(errors.fractions(), errors.map)).astype(np.uint8).T
            attributes = {"red": red, "green": green, "blue": blue, "error": errors.values}
            target.parent.mkdir(parents=True, exist_ok=True)
            io.write(Scan(points, attributes, format="ply"), target, overwrite=self.overwrite)
        if target := self.pictures.get(job.source):
            target.parent.mkdir(parents=True, exist_ok=True)
            write_png(target, chart.image(), overwrite=self.overwrite)
        self.pages[:] = [Page(points, self.clean, names=("Result", "Truth"), colours={"error": errors}, charts=[chart])]
        return metrics


def _as_text(records: list[dict[str, Any]]) -> str:
    """One row per result and, for several, their mean; each column with its unit."""
    from pcdenoise.evaluation.chamfer import UNITS

    done = [record for record in records if record["status"] == "done"]
    names = [name for name in UNITS if done and name in done[0]["figures"]]
    rows = [[record["input"], *(figure(record["figures"][name]) for name in names)] for record in done]
    if len(done) > 1:
        means = [sum(record["figures"][name] for record in done) / len(done) for name in names]
        rows.append(["mean", *(figure(value) for value in means)])
    units = ["", *(UNITS[name].split(" of ")[0].split(",")[0] for name in names)]
    return table(["result", *names], [units, *rows])
