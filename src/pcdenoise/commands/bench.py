"""`pcdenoise bench`: which method is best on the user's own scan. Not here: how it is judged (evaluation.unseen)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcdenoise.commands import options, outputs
from pcdenoise.commands.console import Console, figure, table
from pcdenoise.commands.files import expand, format_of, refuse_existing
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
    format: options.Format = None,
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

    times = _times(added)
    refuse_existing([report], overwrite)
    console = Console(quiet)
    records: list[dict[str, Any]] = []
    for source in expand(inputs):
        scan = io.read(source, format=format_of(source, format))
        trial = _Trial.of(scan.points[scan.finite], points, seed, threads or -1, source)
        rows = []
        with console.progress(source.name) as on_progress:
            methods = list(_methods(model, trial.level, seed, threads))
            for place, (name, smoother) in enumerate(methods):
                on_progress(name, place / len(methods))
                rows += [{"method": name, **trial.run(smoother, share, seed)} for share in times]
        records += [{"input": str(source), "output": "", "status": "done", "figures": row} for row in rows]
        print(_as_text(source, rows, times, trial), end="\n\n" if len(inputs) > 1 else "\n")
    if report:
        settings = {"models": model, "added": times, "points": points, "seed": seed, "threads": threads}
        tables = {"Methods": _by_method(records)}
        page: Page = Page(tables=tables, lead="Distance of cleaned points from a surface through points that no method saw.")
        figures = {
            "scans": len({record["input"] for record in records}),
            "methods": len({row["method"] for row in tables["Methods"]}),
        }
        outputs.save_report(report, "bench", settings, records, page, figures=figures, overwrite=overwrite)


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


def _methods(models: list[str] | None, level: NoiseLevel, seed: int, threads: int | None) -> Iterator[tuple[str, Smoother]]:
    """Name and function of everything that is compared; Open3D's only where it loads."""
    from functools import partial

    from pcdenoise.config import DenoiseConfig
    from pcdenoise.denoising import classical
    from pcdenoise.networks import store

    config = configured(DenoiseConfig, seed=seed, threads=threads)
    yield "as it is", _as_it_is
    for name in models or [entry.name for entry in store.available()]:
        yield f"network {name}", _network(store.load(name), config)
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


def _by_method(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each scan and method, its errors side by side."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for record in records:
        figures = record["figures"]
        row = rows.setdefault((record["input"], figures["method"]), {"input": record["input"], "method": figures["method"]})
        row[f"error +{figures['added']:g}x"] = figures["error"]
        row |= {"cpu_s": round(figures["cpu_s"], 3), "spacing_variation": figures["spacing_variation"]}
    return list(rows.values())


def _as_text(source: Path, rows: list[dict[str, Any]], times: list[float], trial: _Trial) -> str:
    best = {share: min(row["error"] for row in rows if row["added"] == share) for share in times}
    lines = []
    for name in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == name]
        errors = [figure(row["error"]) + (" *" if row["error"] == best[row["added"]] else "  ") for row in own]
        lines.append([name, *errors, f"{sum(row['cpu_s'] for row in own) / len(own):.2f}", figure(own[0]["spacing_variation"])])
    head = f"{source}: {len(trial.given):,} points cleaned, as many held back; noise {figure(trial.level.std)}"
    headers = ["method", *(f"error +{share:g}x  " for share in times), "CPU s", "evenness"]
    foot = "error: distance from the surface, lower is better, * best; evenness: std / mean of spacing, lower is more even"
    return "\n".join([head, table(headers, lines), foot])


def _times(text: str) -> list[float]:
    try:
        times = [float(word) for word in text.split(",")]
    except ValueError:
        times = [-1.0]
    if not all(0 <= share <= 100 for share in times):
        raise UsageError(f"--added {text}: give multiples of the noise from 0 to 100 with commas between, such as 0,1,2")
    return list(dict.fromkeys(times))
