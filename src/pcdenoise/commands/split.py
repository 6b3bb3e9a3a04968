"""`pcdenoise split`: a large scan in parts, to train on some and clean others. Not here: how parts are chosen (cloud)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pcdenoise.commands import options
from pcdenoise.commands.batch import Batch, Figures
from pcdenoise.commands.console import Console, counted
from pcdenoise.commands.files import Job, expand, format_of, plan, refuse_folder, refuse_unwritable, target_name
from pcdenoise.commands.options import option


def split(
    inputs: options.Inputs,
    output: Annotated[Path, option("--output", "-o", metavar="DIR", help="The folder for the parts.")],
    points: Annotated[int, option("--points", min=16, help="Most points of a part.")] = 150_000,
    format: options.Format = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    quiet: options.Quiet = False,
) -> None:
    """Cut scans to compact parts of a bounded size; rows keep their order and everything they carry.

    Parts are halves of halves along the longest side. Rows that are not finite are left out.

    Example: pcdenoise split street.laz -o parts/ --points 150000
    """
    import numpy as np

    from pcdenoise import io
    from pcdenoise.cloud.neighbours import parts

    refuse_folder(output)
    console = Console(quiet)

    def cut(job: Job) -> Figures:
        scan = io.read(job.source, format=format_of(job.source, format))
        rows = np.flatnonzero(scan.finite)
        pieces = [rows[piece] for piece in parts(scan.points[rows], points)]
        numbers = range(1, len(pieces) + 1)
        targets = [output / target_name(job.source, f"_{number:04d}", format, scan.format) for number in numbers]
        refuse_unwritable(targets, overwrite)
        output.mkdir(parents=True, exist_ok=True)
        for piece, target in zip(pieces, targets, strict=True):
            chosen = np.zeros(len(scan), dtype=bool)
            chosen[piece] = True
            io.write(io.select(scan, chosen), target, format=format_of(target, format), overwrite=overwrite)
        console.note(f"{output}: {counted(len(scan), 'point')} of {job.source} in {counted(len(pieces), 'part')}")
        return {"points": len(scan), "parts": len(pieces)}

    batch = Batch(console)
    batch.run(plan(expand(inputs), f"{output}/", format=format), cut)
    batch.close()
