"""`pcdenoise denoise`: scans in, clean scans out. Not here: how one of them is cleaned (cleaning.py)."""

from __future__ import annotations

import os
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pcdenoise.commands import aligning, files, options, outputs, selection
from pcdenoise.commands import workers as workers_
from pcdenoise.commands.batch import Batch
from pcdenoise.commands.cleaning import Cleaning, cells_of, refuse_model
from pcdenoise.commands.console import Console, figure, table
from pcdenoise.commands.files import STREAM, Job, expand, plan, refuse_unwritable
from pcdenoise.commands.memory import n_bytes
from pcdenoise.commands.options import configured, option
from pcdenoise.commands.verify import MaxDrift
from pcdenoise.errors import UsageError

if TYPE_CHECKING:
    from pcdenoise.config import DenoiseConfig

Method = Annotated[
    Literal["network", "mean", "bilateral", "jet"], option("--method", help="The learned model or a classical filter.")
]
_filter = partial(option, rich_help_panel="Classical filters; pcdenoise tune finds values")
Neighbours = Annotated[int | None, _filter("--neighbours", min=1, help="mean, jet: nearest points; by default by noise.")]
Radius = Annotated[float | None, _filter("--radius", help="bilateral: share of the bounding box's diagonal.")]
SigmaD = Annotated[float | None, _filter("--sigma-d", help="bilateral: fall with distance, a share of the diagonal.")]
SigmaN = Annotated[float | None, _filter("--sigma-n", help="bilateral: fall with height, a share of the diagonal.")]
_many = partial(option, rich_help_panel="Many scans, many machines")
Unshrink = Annotated[
    bool | None,
    option("--unshrink/--shrink", help="Take moves that whole regions share back; by default with mcconv models only."),
]
Iters = Annotated[str, option("--iters", metavar="N|auto", help="Passes; auto stops when the next would not help.")]
Draws = Annotated[
    int,
    option(
        "--draws",
        min=1,
        max=64,
        help="Mean over so many random choices: less error where there is much noise; 4 take twice the time.",
    ),
]

_UNTOLD = Path("?")
"""The output of a plan that names none."""


def denoise(
    inputs: options.Inputs,
    output: options.Output = "",
    model: options.Model = None,
    method: Method = "network",
    iters: Iters = "1",
    draws: Draws = 1,
    noise: options.Noise = None,
    align_by: aligning.AlignBy = None,
    unround: aligning.Unround = True,
    unshrink: Unshrink = None,
    neighbours: Neighbours = None,
    radius: Radius = None,
    sigma_d: SigmaD = None,
    sigma_n: SigmaN = None,
    strength: Annotated[float, option("--strength", help="Share of the move that is made, 0 to 1.")] = 1.0,
    max_move: Annotated[
        float | None, option("--max-move", help="Longest move of a point, in the file's unit, before the file's own rounding.")
    ] = None,
    max_drift: MaxDrift = None,
    outliers: Annotated[
        Literal["keep", "flag", "remove"], option("--outliers", help="Points far from any surface: keep, mark, or leave out.")
    ] = "keep",
    only_class: selection.OnlyClass = "",
    context: selection.Context = "class",
    roi: selection.Roi = "",
    displacement: Annotated[
        bool, option("--displacement", help="Store where each point was and how far it moved; undo needs it.")
    ] = False,
    colour: Annotated[
        bool, option("--colour", help="Smooth red, green and blue as well, along the cleaned surface; edges stay.")
    ] = False,
    uncertainty: Annotated[
        bool, option("--uncertainty", help="Store how far each point may still be off: a standard deviation, in the file's unit.")
    ] = False,
    max_memory: Annotated[
        str | None,
        option("--max-memory", metavar="SIZE", help="Never hold more than this: 800M, 2G; half of what is free if not given."),
    ] = None,
    tile: Annotated[int | None, option("--tile", min=1000, help="Clean in cells on disk, of so many points.")] = None,
    resume: Annotated[
        bool, option("--resume", help="Keep outputs that are there, and go on with the cells of a scan where a run was killed.")
    ] = False,
    workers: Annotated[
        int, _many("--workers", min=1, help="So many inputs at a time, each in a process; memory and threads are shared out.")
    ] = 1,
    shard: Annotated[
        str | None, _many("--shard", metavar="I/N", help="Only the I-th of N shares of the inputs, for N jobs like this one.")
    ] = None,
    engine: Annotated[
        Literal["local", "dask"], _many("--engine", help="Where workers run: on this machine, or on a Dask cluster.")
    ] = "local",
    scheduler: Annotated[
        str | None,
        _many("--scheduler", metavar="ADDRESS", help="Of the Dask cluster, such as tcp://head:8786; else a local one."),
    ] = None,
    format: options.Format = None,
    suffix: Annotated[str, option("--suffix", help="Put between name and extension when the output is a folder.")] = "",
    overwrite: options.Overwrite = False,
    drop_attributes: Annotated[
        bool, option("--drop-attributes", help="Allow a conversion to lose what the new format cannot hold.")
    ] = False,
    report: options.Report = None,
    picture: options.Picture = "",
    dry_run: Annotated[bool, option("--dry-run", help="Print what would be done and write nothing.")] = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    threads: options.Threads = None,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Move noisy points to the surface they were measured on.

    Rows, their order and all attributes stay; where there is no surface (leaves, wires, clutter) points stay where they are.

    Example: pcdenoise denoise scan.laz -o clean.laz --picture before_after.png
    """
    from pcdenoise.config import DenoiseConfig

    settings = configured(
        DenoiseConfig, method=method, iters=iters, draws=draws, noise=noise, align_by=aligning.columns(align_by),
        unround=unround, strength=strength, max_move=max_move, outliers=outliers, unshrink=unshrink, neighbours=neighbours,
        radius=radius, sigma_d=sigma_d, sigma_n=sigma_n, uncertainty=uncertainty, seed=seed, threads=threads,
    )  # fmt: skip
    console, sources = Console(quiet, verbose), expand(inputs)
    share = files.shard(sources, shard) if shard else sources
    if not output and not dry_run:
        raise UsageError("-o is missing; say where the result goes: -o clean.las, -o folder/ or -o -")
    run = workers_.chosen(workers, engine, scheduler)
    is_far = run is not workers_.here
    if is_far:
        n_threads = 1 if engine == "dask" else max(1, (os.cpu_count() or 1) // workers)
        settings = settings.model_copy(update={"threads": settings.threads or n_threads})
    jobs = plan(sources, output, suffix=suffix, format=format, share=share) if output else [Job(at, _UNTOLD) for at in share]
    files.refuse_unknown([job.target for job in jobs if output], format)
    drawn = plan(sources, picture, format="png", share=share, option="--picture") if picture else []
    if is_far and any(STREAM in (job.source, job.target) for job in jobs):
        raise UsageError("-: workers have neither standard input nor output; name files, or leave --workers and --engine out")
    if engine == "dask":
        jobs, drawn = files.absolute(jobs), files.absolute(drawn)
    done = [job for job in jobs if resume and job.target != STREAM and job.target.exists()]
    jobs = [job for job in jobs if job not in done]
    pictures = {job.source: job.target for job in drawn if job.source in {job.source for job in jobs}}
    targets = [*(job.target for job in jobs if output), *pictures.values(), report]
    refuse_unwritable(targets, overwrite or resume)
    for job in [] if dry_run else done if resume else jobs:
        shutil.rmtree(cells_of(job), ignore_errors=True)
    chosen = selection.Selection.of(only_class, context, roi)
    refuse_model(model, settings)
    cleaning = Cleaning(
        config=settings, selection=chosen, model_name=model, console=console, format=format, overwrite=overwrite or is_far,
        drop_attributes=drop_attributes, displacement=displacement, max_drift=max_drift, pictures=pictures,
        max_bytes=n_bytes(max_memory) // workers, tile=tile, colour=colour, is_reported=report is not None,
    )  # fmt: skip
    if len(jobs) > 1 or is_far or dry_run:
        _ = cleaning.model  # one that is missing ends the run here, not each of its inputs
    batch = Batch(console)
    if dry_run:
        batch.run(jobs, cleaning.look)
        print(_plan_text(batch.records, done, settings))
        batch.close()
        return
    batch.run(jobs, cleaning.clean, run)
    if report:
        page = cleaning.pages[0] if len(jobs) == len(cleaning.pages) == 1 else None
        outputs.save_report(report, "denoise", cleaning.settings, batch.records, page, overwrite=overwrite)
    batch.close()


def _plan_text(records: list[dict[str, Any]], done: list[Job], settings: DenoiseConfig) -> str:
    """What a run would do, input by input: those that were looked at, and those that have their outputs."""
    from pcdenoise.commands.survey import cost, cost_text

    rows, warnings = [], []
    draws = settings.draws if settings.method == "network" else 1
    for record in records:
        if record["status"] == "failed":
            rows.append([record["input"], *[""] * 5, record["output"], record["error"].removeprefix(f"{record['input']}: ")])
            continue
        found = record["figures"]
        rows.append(
            [
                record["input"],
                f"{found['points']:,}",
                figure(found.get("spacing", 0.0)),
                figure(settings.noise or found["noise"]) if found.get("is_surface") else "no surface",
                str(settings.iters),
                cost_text(cost(found["points"], 3 if settings.iters == "auto" else settings.iters, draws)),
                record["output"],
                "ready",
            ]
        )
        warnings += [f"warning: {record['input']}: {text}" for text in found["warnings"]]
    rows += [[str(job.source), *[""] * 5, str(job.target), "there already"] for job in done]
    headers = ["input", "points", "spacing", "noise", "passes", "cost", "output", "status"]
    return "\n".join([table(headers, rows, left={0, 6, 7}), *warnings])
