"""`pcdenoise train`: a model from shapes or scans. Not here: the loop, the losses and the data (learning)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pcdenoise.commands import options
from pcdenoise.commands.console import Console
from pcdenoise.commands.files import refuse_existing
from pcdenoise.commands.options import configured, option
from pcdenoise.errors import UsageError

_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def train(
    output: Annotated[Path, option("--output", "-o", metavar="DIR", help="The model folder to write.")],
    data: Annotated[
        list[str],
        option(
            "--data",
            metavar="SOURCE",
            envvar="PCDENOISE_TRAIN_DATA",
            help="shapes:N (procedural), a mesh, a folder of meshes or one made by synth; repeat to mix. Default: shapes:400.",
        ),
    ] = ["shapes:400"],  # noqa: B006
    method: Annotated[Literal["supervised"], option("--method", help="What the model learns from.")] = "supervised",
    network: Annotated[Literal["projection"], option("--network", help="The network's form.")] = "projection",
    neighbours: Annotated[int, option("--neighbours", help="How many neighbours a point looks at.")] = 32,
    learning_rate: Annotated[float, option("--learning-rate", help="The highest; it warms up and decays to a hundredth.")] = 3e-3,
    steps: Annotated[int | None, option("--steps", min=1, help="Stop after so many steps.")] = None,
    budget: Annotated[str | None, option("--budget", metavar="TIME", help="Stop after so long: 90s, 20m, 1.5h.")] = None,
    init: Annotated[str | None, option("--init", metavar="NAME|DIR", help="Start from this model.")] = None,
    resume: Annotated[bool, option("--resume", help="Go on where an interrupted run in the same folder stopped.")] = False,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 1,
    threads: options.Threads = None,
    quiet: options.Quiet = False,
) -> None:
    """Train a model. Ctrl-C keeps what was learned so far.

    Example: pcdenoise train -o my_model --budget 20m
    """
    from pcdenoise.config import TrainConfig
    from pcdenoise.learning import trainer

    settings = configured(
        TrainConfig, data=data, method=method, network=network, neighbours=neighbours, learning_rate=learning_rate,
        steps=steps, budget_s=_seconds(budget), seed=seed, threads=threads,
    )  # fmt: skip
    refuse_existing([output / "config.json"], overwrite or resume)
    console = Console(quiet)
    with console.progress("train") as on_progress:
        summary = trainer.train(settings, output, init=init, resume=resume, on_progress=on_progress)
    console.note(f"{output}: {summary}")


def _seconds(text: str | None) -> float | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh])", text.strip())
    if match is None:
        raise UsageError(f"--budget {text}: give a number and a unit, such as 90s, 20m or 1.5h")
    return float(match[1]) * _SECONDS[match[2]]
