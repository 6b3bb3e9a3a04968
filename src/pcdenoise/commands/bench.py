"""`pcdenoise bench`: which method is best on the user's own scan. Not here: how it is judged (evaluation.unseen)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcdenoise.commands import options, outputs
from pcdenoise.commands.batch import Batch, Figures
from pcdenoise.commands.console import Console, figure, table
from pcdenoise.commands.files import STREAM, Job, expand, format_of, refuse_unwritable
from pcdenoise.commands.options import configured, option
from pcdenoise.errors import ScanError, UsageError

if TYPE_CHECKING:
    from pcdenoise.cloud.noise_level import NoiseLevel
    from pcdenoise.cloud.scan import Points
    from pcdenoise.config import DenoiseConfig
    from pcdenoise.evaluation.report import Page
    from pcdenoise.networks.store import Model

    Smoother = Callable[[Points], Points]

FEWEST_POINTS = 200
_NEIGHBOURS = 24


def bench(
    inputs: options.Inputs,
    model: Annotated[
        list[str] | None, option("--model", metavar="NAME|DIR", help="A model to compare, once for each; all shipped ones else.")
    ] = None,
    added: Annotated[
        str, option("--added", metavar="TIMES,...", help="Noise added on top, in multiples of the scan's own.")
    ] = "0,1,2",
    points: Annotated[int, option("--points", min=FEWEST_POINTS, help="Of a larger scan, a compact part of so many.")] = 40_000,
    format: options.FormatRead = None,
    report: options.Report = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    threads: options.Threads = None,
    quiet: options.Quiet = False,
) -> None:
    """Compare our models with mean, bilateral, jet and Open3D's smoothers on your own scan, in one table.

    A scan has no truth, so a random half of it is held back and judges what each method makes of the other half: no method sees
    its noise, and what it cannot know is subtracted. Known noise is added to the half that is cleaned, for a ladder. Error is the
    distance of cleaned points from the surface (root mean square), in the scan's unit; lower is better.
    The row "as it is" shows the noise that was there. Classical methods use their defaults, fitted to the noise.

    Example: pcdenoise bench scan.laz --report bench.html
    """
    from pcdenoise import io
    from pcdenoise.evaluation.report import Page
    from pcdenoise.networks import store

    times = _times(added)
    refuse_unwritable([report], overwrite)
    console = Console(quiet)
    jobs = [Job(source, STREAM) for source in expand(inputs)]
    models = {name: store.load(name) for name in model or [entry.name for entry in store.available()]}

    def compare(job: Job) -> Figures:
        scan = io.read(job.source, format=format_of(job.source, format))
        trial = _Trial.of(scan.points[scan.finite], points, seed, threads or -1, job.source)
        rows = []
        with console.progress(job.source.name) as on_progress:
            methods = list(_methods(models, trial.level, seed, threads))
            for place, (name, smoother) in enumerate(methods):
                on_progress(name, place / len(methods))
                rows += [{"method": name, **trial.run(smoother, share, seed)} for share in times]
        return {"points": len(trial.given), "noise": trial.level.std, "rows": rows}

    def show(job: Job, found: Figures) -> None:
        print(_as_text(job.source, found, times), end="\n\n" if len(jobs) > 1 else "\n")

    batch = Batch(console)
    batch.run(jobs, compare, show=show)
    if report:
        settings = {
            "models": list(models),
            "models_sha256": [loaded.sha256 for loaded in models.values()],
            "added": times,
            "points": points,
            "seed": seed,
            "threads": threads,
        }
        done = [record for record in batch.records if record["status"] == "done"]
        lines = [{"input": record["input"], **line} for record in done for line in _by_method(record["figures"]["rows"])]
        page: Page = Page(
            tables={"Methods": lines} if done else {},
            lead="Distance of cleaned points from a surface through points that no method saw.",
        )
        figures = {
            "scans": len(done),
            "failed": outputs.n_failed(batch.records),
            "methods": len({row["method"] for row in lines}),
        }
        outputs.save_report(report, "bench", settings, _by_row(batch.records), page, figures=figures, overwrite=overwrite)
    batch.close()


@dataclass(frozen=True)
class _Trial:
    """One scan: the half that methods get, the judge made of the other, the noise."""

    given: Points
    judge: Any
    level: NoiseLevel

    @classmethod
    def of(cls, points: Points, most: int, seed: int, threads: int, source: Path) -> _Trial:
        """Raises ScanError for a scan that is too small or shows no surface: there is nothing to compare."""
        from pcdenoise.cloud import noise_level
        from pcdenoise.cloud.neighbours import distinct
        from pcdenoise.evaluation.unseen import Unseen, halves

        points = points[distinct(points)[0]]
        if len(points) < FEWEST_POINTS:
            raise ScanError(f"{source}: {len(points)} points are too few to hold some back; bench needs {FEWEST_POINTS}")
        given, held = halves(points - points.mean(axis=0), most, seed)
        level = noise_level.estimate(given, seed, threads)
        judge = Unseen(held, seed, threads)
        if not level.is_surface or not len(judge.centres):
            raise ScanError(f"{source}: shows no surface to judge by (leaves, clutter?); choose another scan")
        return cls(given, judge, level)

    def run(self, smoother: Smoother, share: float, seed: int) -> dict[str, float]:
        """Error, processor seconds and evenness of a method on the given half with so many times the noise added."""
        import numpy as np

        from pcdenoise.evaluation.chamfer import evaluate

        noise = np.random.default_rng([seed, 1]).standard_normal(self.given.shape)
        noisy = self.given + share * self.level.std * noise
        started = time.process_time()
        cleaned = smoother(noisy)
        spent = time.process_time() - started
        evenness = evaluate(cleaned)["spacing_variation"]
        return {"added": share, "error": self.judge.error(cleaned), "cpu_s": spent, "spacing_variation": evenness}


def _methods(models: dict[str, Model], level: NoiseLevel, seed: int, threads: int | None) -> Iterator[tuple[str, Smoother]]:
    """Name and function of everything that is compared; Open3D's only where it loads."""
    from functools import partial

    from pcdenoise.config import DenoiseConfig
    from pcdenoise.denoising import classical

    config = configured(DenoiseConfig, seed=seed, threads=threads)
    yield "as it is", _as_it_is
    for name, model in models.items():
        yield f"network {name}", _network(model, config)
    n_threads = threads or -1
    yield "mean", partial(classical.mean, threads=n_threads)
    yield "bilateral", partial(classical.bilateral, threads=n_threads)
    yield "jet", partial(classical.jet, threads=n_threads)
    yield from _of_open3d(level)


def _as_it_is(points: Points) -> Points:
    return points


def _network(model: Model, config: DenoiseConfig) -> Smoother:
    from pcdenoise.denoising.denoiser import denoise

    return lambda points: denoise(points, model, config).points


def _of_open3d(level: NoiseLevel) -> Iterator[tuple[str, Smoother]]:
    """Open3D 0.20's smoothers in the neighbourhoods that ours get; none where it is absent, does not load or is older."""
    try:
        import open3d as o3d
    except (ImportError, OSError):
        return
    cloud = o3d.geometry.PointCloud
    radius = 4 * max(level.std, level.spacing)
    ball = o3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=256)
    calls = {
        "smooth_mls": (ball,),
        "smooth_bilateral": (ball, radius / 2, 3 * level.std),
        "smooth_laplacian": (1, 0.5, _NEIGHBOURS),
        "smooth_taubin": (10, 0.5, -0.53, _NEIGHBOURS),
    }
    for name, arguments in calls.items():
        if hasattr(cloud, name):
            yield f"Open3D {name.removeprefix('smooth_')}", _open3d_smoother(o3d, name, arguments)


def _open3d_smoother(o3d: Any, name: str, arguments: tuple[Any, ...]) -> Smoother:
    def smooth(points: Points) -> Points:
        import numpy as np

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            smoothed: Points = np.asarray(getattr(cloud, name)(*arguments).points)
        return smoothed

    return smooth


def _by_method(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each method on one scan: its errors side by side, then means over the noises of CPU seconds and evenness."""
    lines = []
    for name in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == name]
        errors = {_error_at(row["added"]): row["error"] for row in own}
        means = {key: sum(row[key] for row in own) / len(own) for key in ("cpu_s", "spacing_variation")}
        lines.append({"method": name, **errors, **means})
    return lines


def _error_at(share: float) -> str:
    return f"error +{share:g}x"


def _by_row(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records of a report: one for each method and noise on a scan, and one for a scan that failed."""
    found = []
    for record in records:
        rows = record["figures"]["rows"] if record["status"] == "done" else []
        found += [{**record, "figures": row} for row in rows] or [record]
    return found


def _as_text(source: Path, found: Figures, times: list[float]) -> str:
    """The rows of `_by_method` for a person, the best error of each noise marked."""
    rows = _by_method(found["rows"])
    names = [_error_at(share) for share in times]
    best = {name: min(row[name] for row in rows) for name in names}
    lines = [
        [
            row["method"],
            *(figure(row[name]) + (" *" if row[name] == best[name] else "  ") for name in names),
            f"{row['cpu_s']:.2f}",
            figure(row["spacing_variation"]),
        ]
        for row in rows
    ]
    head = f"{source}: {found['points']:,} points cleaned, as many held back; noise {figure(found['noise'])}"
    headers = ["method", *(f"{name}  " for name in names), "CPU s", "evenness"]
    foot = (
        "error: distance from the surface, lower is better, * best; evenness: std / mean of spacing, lower is more even; "
        "CPU and evenness are means over the noises"
    )
    return "\n".join([head, table(headers, lines), foot])


def _times(text: str) -> list[float]:
    try:
        times = [float(word) for word in text.split(",")]
    except ValueError:
        times = [-1.0]
    if not all(0 <= share <= 100 for share in times):
        raise UsageError(f"--added {text}: give multiples of the noise from 0 to 100 with commas between, such as 0,1,2")
    return list(dict.fromkeys(times))
