"""`pcdenoise split`: a large scan in parts, to train on some and clean others. Not here: how parts are chosen (cloud)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pcdenoise.commands import options
from pcdenoise.commands.console import Console
from pcdenoise.commands.files import expand, format_of, refuse_existing
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

    console = Console(quiet)
    output.mkdir(parents=True, exist_ok=True)
    for source in expand(inputs):
        scan = io.read(source, format=format_of(source, format))
        rows = np.flatnonzero(scan.finite)
        pieces = [rows[piece] for piece in parts(scan.points[rows], points)]
        suffix = f".{format}" if format else source.suffix
        targets = [output / f"{source.stem}_{number:04d}{suffix}" for number in range(1, len(pieces) + 1)]
        refuse_existing(targets, overwrite)
        for piece, target in zip(pieces, targets, strict=True):
            chosen = np.zeros(len(scan), dtype=bool)
            chosen[piece] = True
            io.write(io.select(scan, chosen), target, format=format_of(target, format), overwrite=overwrite)
        console.note(f"{output}: {len(scan):,} points of {source} in {len(pieces)} parts")
