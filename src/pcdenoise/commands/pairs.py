"""`pcdenoise pairs`: noisy and pseudo-clean clouds for other programs that learn from pairs. Not here: the prior (learning)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pcdenoise.commands import options
from pcdenoise.commands.batch import Batch, Figures
from pcdenoise.commands.console import Console, counted
from pcdenoise.commands.files import Job, expand, format_of, plan, refuse_folder, refuse_unwritable, target_name
from pcdenoise.commands.options import option
from pcdenoise.errors import UsageError


def pairs(
    inputs: options.Inputs,
    output: Annotated[Path, option("--output", "-o", metavar="DIR", help="The folder for the pairs.")],
    draws: Annotated[int, option("--draws", min=1, help="Pseudo-clean clouds for each scan.")] = 10,
    prior: Annotated[
        Literal["full", "space"], option("--prior", help="What makes a neighbour likely: space and colour, or space alone.")
    ] = "space",
    radius: Annotated[
        float | None, option("--radius", help="How far a sample may be, in the file's unit; 5 % of the diagonal if not given.")
    ] = None,
    to: Annotated[
        Literal["npz", "ply", "xyz"], option("--to", help="npz: arrays noisy and clean in one file; else a file for each cloud.")
    ] = "npz",
    format: options.FormatRead = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    quiet: options.Quiet = False,
) -> None:
    """Write noisy clouds with samples that may pass for clean ones, row for row, to train any supervised denoiser without truth.

    Use every draw about equally often: what is learned is their mean. The loss must compare row with row.

    Example: pcdenoise pairs scan.ply -o pairs/ --draws 20
    """
    from io import BytesIO

    import numpy as np

    from pcdenoise import io
    from pcdenoise.cloud.scan import Scan
    from pcdenoise.evaluation.output import write_whole
    from pcdenoise.learning.scans import colours_of
    from pcdenoise.learning.upgrade import prior_for, pseudo_clean

    refuse_folder(output)
    console = Console(quiet)
    jobs = plan(expand(inputs), f"{output}/", format=to)

    def draw_from(job: Job) -> Figures:
        scan = io.read(job.source, format=format_of(job.source, format))
        points = scan.points[scan.finite]
        colours = colours_of(scan)[scan.finite] if prior == "full" else None
        if len(points) < 2:
            raise UsageError(f"{job.source}: has {counted(len(points), 'point')}; a pair needs neighbours")
        chosen = prior_for(points, radius)
        kind = "" if to == "npz" else "_clean"
        targets = [output / target_name(job.source, f"_{draw:04d}{kind}", to) for draw in range(1, draws + 1)]
        noisy = [] if to == "npz" else [output / target_name(job.source, "_noisy", to)]
        refuse_unwritable([*targets, *noisy], overwrite)
        output.mkdir(parents=True, exist_ok=True)
        number = jobs.index(job)
        for draw, target in enumerate(targets):
            rng = np.random.default_rng([seed, number, draw])
            clean = pseudo_clean(points, colours, prior=chosen, rng=rng)
            if to == "npz":
                memory = BytesIO()
                np.savez(memory, noisy=points, clean=clean)
                write_whole(target, memory.getvalue(), overwrite=overwrite)
            else:
                io.write(Scan(clean, format=to), target, overwrite=overwrite)
        for target in noisy:
            io.write(Scan(points, format=to), target, overwrite=overwrite)
        console.note(f"{output}: {counted(draws, 'pair')} of {counted(len(points), 'point')} from {job.source}")
        return {"points": len(points), "pairs": draws}

    batch = Batch(console)
    batch.run(jobs, draw_from)
    batch.close()
