"""`pcdenoise tune`: the best parameters of a classical filter on noisy clouds whose truth is known. Not here: the search."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pcdenoise.commands import options
from pcdenoise.commands.console import Console, counted
from pcdenoise.commands.files import refuse_unwritable
from pcdenoise.commands.options import argument, option
from pcdenoise.errors import ScanError, UsageError


def tune(
    data: Annotated[list[Path], argument(metavar="DIR...", help="Data sets made by pcdenoise synth, to train on, not to test.")],
    method: Annotated[Literal["mean", "bilateral", "jet"], option("--method", help="The filter.")],
    output: Annotated[
        Path | None, option("--output", "-o", metavar="FILE", help="Write a TOML file that denoise --config reads.")
    ] = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    threads: options.Threads = None,
    quiet: options.Quiet = False,
) -> None:
    """Find the parameters with which a classical filter comes nearest to the clean clouds of a data set.

    Lengths are shares of a cloud's bounding-box diagonal. No parameters mean that the automatic choice was best.

    Example: pcdenoise tune data/ --method bilateral -o bilateral.toml
    """
    from pcdenoise.denoising import classical
    from pcdenoise.evaluation.output import write_whole
    from pcdenoise.learning.scans import noisy_and_clean

    refuse_unwritable([output], overwrite)
    for path in data:
        if not path.exists():
            raise ScanError(f"{path}: no such file or folder; check the path")
    pairs = list(noisy_and_clean(data))
    if not pairs:
        raise UsageError(f"{', '.join(map(str, data))}: no noisy cloud with a clean one; give folders made by pcdenoise synth")
    with Console(quiet).progress("tune") as on_progress:
        on_progress(f"{method}, {counted(len(pairs), 'cloud')}", 0.0)
        found = classical.tune(pairs, method, threads=threads or -1)
    named = {"neighbours" if name == "k" else name: value for name, value in found.items()}
    lines = ["[denoise]", f'method = "{method}"', *(f"{name} = {value:.6g}" for name, value in named.items())]
    text = "\n".join(lines) + "\n"
    if output is None:
        print(text, end="")
    else:
        write_whole(output, text.encode(), overwrite=overwrite)
        Console(quiet).note(
            f"{output}: {', '.join(lines[2:]) or 'the automatic choice is best'}, from {counted(len(pairs), 'cloud')}"
        )
