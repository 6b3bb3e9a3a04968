"""What is taken back before a scan is cleaned, and what is said of that: rounding of depths, offsets of groups.

Not here: how far (denoising/rounding.py, denoising/alignment.py).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from pcdenoise.commands.console import Console, counted, figure
from pcdenoise.commands.options import option
from pcdenoise.errors import UsageError

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Mask, Points, Scan
    from pcdenoise.config import DenoiseConfig
    from pcdenoise.denoising.correction import Correction
    from pcdenoise.denoising.denoiser import Progress
    from pcdenoise.networks.store import Model

AlignBy = Annotated[
    str | None,
    option(
        "--align-by",
        metavar="NAME,...|none",
        help="Points that agree in these columns (beam, scan_direction_flag, point_source_id) are off together: first shift"
        " such groups onto each other. A model adapted by train says so itself.",
    ),
]
Unround = Annotated[
    bool,
    option("--unround/--keep-rounded", help="Bring depths that a depth camera rounded to steps back between the steps."),
]
_MOST_GROUPS = 50  # of which --verbose says how they are shifted


def columns(text: str | None) -> tuple[str, ...] | None:
    """Names with commas between; nothing for none; None where nothing is said."""
    if text is None:
        return None
    if text == "none":
        return ()
    names = tuple(word.strip() for word in text.split(","))
    if not all(names):
        raise UsageError(f"--align-by {text}: give names of columns with commas between, such as beam,pose, or none")
    return names


def correction(
    scan: Scan, seen: Mask, model: Model | None, config: DenoiseConfig, console: Console, on_progress: Progress
) -> Correction:
    """What is taken back of the rows before they are cleaned; in its figures aligned_by as well.

    seen (N,): rows that have a say; the others stay. Raises ScanError for columns that the settings name and the scan has not.
    """
    import numpy as np

    from pcdenoise.denoising import denoiser
    from pcdenoise.denoising.alignment import columns_asked_for, groups_asked_for

    groups = groups_asked_for(scan, model, config, lambda fault: console.note(f"{fault}; cleaned as it is"))
    if groups is not None:
        on_progress("aligning", 0.0)
    found = denoiser.correction_of(scan.points[seen], None if groups is None else groups[seen], model, config).to_rows(seen)
    if groups is None:
        return found
    names = columns_asked_for(model, config)
    rows, sizes = np.unique(groups, return_index=True, return_counts=True)[1:]
    for row, n in zip(rows[:_MOST_GROUPS], sizes, strict=False):
        values = ", ".join(f"{name} {scan.attributes[name][row]}" for name in names)
        console.detail(f"{values}: {counted(int(n), 'point')} shifted by {', '.join(map(figure, found.offset[row]))}")
    if len(rows) > _MOST_GROUPS:
        console.detail(f"and {len(rows) - _MOST_GROUPS:,} more groups")
    return replace(found, figures=found.figures | {"aligned_by": ",".join(names)})


def note_unshifted(source: str, some: Points, model: Model | None, config: DenoiseConfig, console: Console) -> None:
    """Says that nothing is shifted in a scan that is cleaned in cells, where some of its points or its model ask for that."""
    import numpy as np

    from pcdenoise.denoising import rounding
    from pcdenoise.denoising.alignment import columns_asked_for

    if config.unround and rounding.find(some[np.logical_and.reduce(np.isfinite(some), axis=1)], config.threads or -1):
        console.note(f"{source}: depths that a camera rounded stay so: cleaned in cells; raise --max-memory or leave out --tile")
    if names := columns_asked_for(model, config):
        console.note(f"{source}: not aligned by {','.join(names)} as the model asks: cleaned in cells")
