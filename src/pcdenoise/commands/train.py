"""`pcdenoise train`: a model from shapes or scans. Not here: the loop, the losses and the data (learning)."""

from __future__ import annotations

import re
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pcdenoise.commands import options, outputs
from pcdenoise.commands.console import Console
from pcdenoise.commands.files import refuse_unwritable
from pcdenoise.commands.options import configured, option
from pcdenoise.errors import UsageError

_prior = partial(option, rich_help_panel="Learning from noisy scans")
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def train(
    output: Annotated[Path, option("--output", "-o", metavar="DIR", help="The model folder to write.")],
    data: Annotated[
        list[str],
        option(
            "--data",
            metavar="SOURCE",
            envvar="PCDENOISE_TRAIN_DATA",
            help="shapes:N (procedural), a mesh, a folder of meshes or one made by synth; else noisy scans,"
            " folders of scans, synth folders. Repeat to mix. Default: shapes:400.",
        ),
    ] = ["shapes:400"],  # noqa: B006
    method: Annotated[
        Literal["supervised", "split", "distill", "total"] | None,
        option("--method", help="Learn from known surfaces (supervised) or noisy points alone (the rest). Scans: distill."),
    ] = None,
    network: Annotated[
        Literal["projection", "mcconv"], option("--network", help="The network's form; mcconv is that of Total Denoising.")
    ] = "projection",
    pairs: Annotated[
        bool, option("--pairs", help="supervised: learn from the noisy and clean clouds of synth folders, not from their meshes.")
    ] = False,
    neighbours: Annotated[int, option("--neighbours", help="projection: how many neighbours a point looks at.")] = 32,
    messages: Annotated[
        int | None, option("--messages", help="projection: channels of a message; with --init as many as there, or more.")
    ] = None,
    learning_rate: Annotated[
        float | None,
        option(
            "--learning-rate",
            help="The highest; by default 0.003 for projection, a tenth of it to adapt a model, 0.005 for mcconv.",
        ),
    ] = None,
    prior: Annotated[
        Literal["full", "space", "none"],
        _prior("--prior", help="What makes a neighbour a likely target: near in space and colour, in space, or neither."),
    ] = "space",
    kernel: Annotated[
        Literal["gaussian", "wendland", "imq"], _prior("--kernel", help="How chances fall with distance.")
    ] = "gaussian",
    alpha: Annotated[
        float | None, _prior("--alpha", help="Width of the kernel, in radii; by default the best one in the paper.")
    ] = None,
    beta: Annotated[float, _prior("--beta", help="Weight of colour against space.")] = 4.0,
    unit: Annotated[
        float | None,
        _prior("--unit", metavar="LENGTH", help="What the network calls 1, in the scans' unit; their diagonal if not given."),
    ] = None,
    part_points: Annotated[int, _prior("--part-points", min=1000, help="Cut larger scans to parts of so many points.")] = 150_000,
    laps: Annotated[
        int, _prior("--laps", min=1, max=20, help="distill: teachers in turn, the starting model, then what was learned by then.")
    ] = 2,
    steps: Annotated[int | None, option("--steps", min=1, help="Stop after so many steps.")] = None,
    budget: Annotated[
        str | None,
        option(
            "--budget", metavar="TIME", help="Learn for so long: 90s, 20m, 1.5h, then judge for up to a minute. By default 20m."
        ),
    ] = None,
    init: Annotated[
        str | None, option("--init", metavar="NAME|DIR", help="Start from this model, or none; scans: default.")
    ] = None,
    resume: Annotated[bool, option("--resume", help="Go on where an interrupted run in the same folder stopped.")] = False,
    report: options.Report = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 1,
    threads: options.Threads = None,
    quiet: options.Quiet = False,
) -> None:
    """Train a model. Ctrl-C keeps what was learned so far.

    From scans alone, the shipped model is adapted to their noise, and kept as it was unless that helps on points it has not seen.

    Example: pcdenoise train -o my_model --budget 20m
    """
    from pcdenoise.config import TrainConfig
    from pcdenoise.learning import ranks, trainer

    settings = configured(
        TrainConfig, data=data, method=method, network=network, pairs=pairs, neighbours=neighbours, messages=messages,
        learning_rate=learning_rate, prior=prior, kernel=kernel, alpha=alpha, beta=beta, unit=unit, part_points=part_points,
        laps=laps, steps=steps, budget_s=_seconds(budget), seed=seed, threads=threads,
    )  # fmt: skip
    refuse_unwritable([output / "config.json"], overwrite or resume)
    refuse_unwritable([report], overwrite)
    console = Console(quiet or not ranks.is_first())
    with console.progress("train") as on_progress:
        summary = trainer.train(settings, output, init=init, resume=resume, overwrite=overwrite, on_progress=on_progress)
    if report and ranks.is_first():
        _save_report(report, output, asdict(summary), overwrite)
    console.note(f"{output}: {summary}")


def _save_report(path: Path, output: Path, figures: dict[str, Any], overwrite: bool) -> None:
    """Figures of a run and settings as it settled them, as HTML with its curve."""
    from pcdenoise.evaluation.charts import curve
    from pcdenoise.evaluation.report import Page
    from pcdenoise.learning.run import curve_of
    from pcdenoise.networks import store

    model = store.load(output)
    settings = {**model.config.training, "model": model.name, "model_sha256": model.sha256}

    lines = curve_of(output)
    errors = {"": [line["error"] for line in lines]}
    chart = curve(
        errors, title="Root mean square distance to the targets, of the noise", x_label="Step", x=[line["step"] for line in lines]
    )
    files = [{"input": ", ".join(settings["data"] or []), "output": str(output), "status": "done", "figures": figures}]
    outputs.save_report(path, "train", settings, files, Page(charts=[chart] if lines else []), overwrite=overwrite)


def _seconds(text: str | None) -> float | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh])", text.strip())
    if match is None:
        raise UsageError(f"--budget {text}: give a number and a unit, such as 90s, 20m or 1.5h")
    return float(match[1]) * _SECONDS[match[2]]
