"""`pcdenoise undo`: a cleaned scan back at its places. How `denoise --displacement` stores them lives here too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcdenoise.commands import options
from pcdenoise.commands.files import format_of, refuse_unwritable
from pcdenoise.errors import ScanError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from pcdenoise.cloud.scan import Mask, Points, Scan

ORIGINAL = ("original_x", "original_y", "original_z")
DISPLACEMENT = "displacement"
"""Columns that `denoise --displacement` adds: the place before, and the distance from it, in the file's unit."""
COLOUR = ("red", "green", "blue")
ORIGINAL_COLOUR = ("original_red", "original_green", "original_blue")
"""Columns that `--displacement` adds beside these if `--colour` changed the colours."""
UNCERTAINTY, OUTLIER = "uncertainty", "outlier"
"""Columns that `denoise --uncertainty` and `--outliers flag` add, after those: standard deviation of what the point may still be
off, in the file's unit; 1 for an outlier."""
_AFTERWARDS = (UNCERTAINTY, OUTLIER)
_ADDED = {
    "--displacement": {**dict.fromkeys((*ORIGINAL, *ORIGINAL_COLOUR), "f8"), DISPLACEMENT: "f4"},
    "--uncertainty": {UNCERTAINTY: "f4"},
    "--outliers flag": {OUTLIER: "u1"},
}
"""Columns by the option that adds them, or, the colours, that `undo` would take for its own."""


def undo(
    clean: Annotated[Path, typer.Argument(metavar="CLEAN", help="A scan written with --displacement.")],
    output: options.OneOutput,
    format: options.FormatRead = None,
    overwrite: options.Overwrite = False,
    config: options.Config = None,
) -> None:
    """Take a cleaned scan back to the original, exactly; needs a scan written by denoise --displacement.

    The columns that it added and the note on how it was made go too: a LAS, binary PLY or binary PCD is the original byte for
    byte. Compressed files and E57 hold the same and may be packed otherwise, and stations of an E57 that are turned are the same
    to float64's last digits; a number in a text may gain zeros at its end.

    Example: pcdenoise undo clean.laz -o original.laz
    """
    from pcdenoise import io

    target = Path(output)
    refuse_unwritable([target], overwrite)
    scan = restored(io.read(clean, format=format_of(clean, format)))
    target.parent.mkdir(parents=True, exist_ok=True)
    io.write(scan, target, format=format_of(target, format), overwrite=overwrite)


def with_displacement(before: Points, after: Scan) -> Scan:
    """The moved scan with four more columns: each row's (N, 3) place before, float64 and so exact, and how far it moved."""
    import numpy as np

    length = np.nan_to_num(np.linalg.norm(after.points - before, axis=1), nan=0.0, posinf=0.0)
    columns = {name: before[:, axis].copy() for axis, name in enumerate(ORIGINAL)}
    return after.with_attributes(**columns, **{DISPLACEMENT: length.astype(np.float32)})


def with_colours(before: Scan, after: Scan, *, undoable: bool, threads: int | None = None) -> Scan:
    """The moved scan with its colours smoothed where points moved; undoable: the old ones stay in three more columns.

    Raises ScanError without colours.
    """
    import numpy as np

    from pcdenoise.denoising.colour import smoothed

    refuse_colourless(after)
    old = np.stack([after.attributes[name] for name in COLOUR], axis=1)
    moved = (before.points != after.points).any(axis=1)
    new = np.where(moved[:, None], smoothed(after.points, old, threads or -1), old)
    coloured = replace(after, attributes={**after.attributes, **{name: new[:, i].copy() for i, name in enumerate(COLOUR)}})
    kept = {name: old[:, i].copy() for i, name in enumerate(ORIGINAL_COLOUR)} if undoable else {}
    return coloured.with_attributes(**kept)


def with_uncertainty(after: Scan, std: NDArray[np.float64]) -> Scan:
    """The moved scan with one more column."""
    return after.with_attributes(**{UNCERTAINTY: std.astype("f4")})


def with_outliers(after: Scan, outlier: Mask) -> Scan:
    """The moved scan with one more column."""
    return after.with_attributes(**{OUTLIER: outlier.astype("u1")})


def columns_to_add(scan: Scan, options: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of zeros like those that options will add. Raises ScanError where one is there already, and would be lost."""
    import numpy as np

    added: dict[str, NDArray[Any]] = {}
    for option in options:
        for name, kind in _ADDED[option].items():
            if name in scan.attributes:
                raise ScanError(f"{scan.origin}: has a column {name} already; undo or rename it first, or leave out {option}")
            if name not in ORIGINAL_COLOUR:
                added[name] = np.broadcast_to(np.zeros(1, kind), len(scan))
    return added


def refuse_colourless(scan: Scan) -> None:
    """Raises ScanError for a scan without colours to smooth."""
    if not set(COLOUR) <= set(scan.attributes):
        raise ScanError(f"{scan.origin}: has no {', '.join(COLOUR)}; leave out --colour")


def restored(scan: Scan) -> Scan:
    """The scan before it was moved, without the columns that cleaning added: the places and what follows them of ours.

    A text without a header does not keep names: there the last four columns are taken, or four with one or two after them (the
    uncertainty, the outliers), if they agree with the coordinates. Raises ScanError if places are not there.
    """
    import numpy as np

    from pcdenoise import io

    present = list(scan.attributes)
    places = [*ORIGINAL, DISPLACEMENT]
    if set(places) <= set(present):
        after = set(present[present.index(DISPLACEMENT) :]) & set(_AFTERWARDS)
        added = [name for name in present if name in {*places, *ORIGINAL_COLOUR, *after}]
    else:
        added = _last_columns(scan)
        places = added[:4]
    if not added:
        raise ScanError(
            f"{scan.origin}: no places before the move are stored; only what denoise --displacement wrote can be undone"
        )
    before = np.stack([scan.attributes[name].astype(np.float64) for name in places[:3]], axis=1)
    if set(ORIGINAL_COLOUR) <= set(present):
        colours = {name: scan.attributes[original] for name, original in zip(COLOUR, ORIGINAL_COLOUR, strict=True)}
        scan = replace(scan, attributes={**scan.attributes, **colours})
    return io.without(scan, added).moved_to(before)


def _last_columns(scan: Scan) -> list[str]:
    """The names of the last columns of a text, if the fourth is the distance between the coordinates and the first three."""
    names = list(scan.attributes)
    if scan.format != "xyz":
        return []
    lasts = (names[-n:] for n in range(4, 5 + len(_AFTERWARDS)) if n <= len(names))
    return next((last for last in lasts if _is_displacement(scan, last[:4])), [])


def _is_displacement(scan: Scan, names: list[str]) -> bool:
    import numpy as np

    *before, displacement = (np.asarray(scan.attributes[name], dtype=np.float64) for name in names)
    length = np.linalg.norm(scan.points - np.stack(before, axis=1), axis=1)
    tolerance = 1e-3 * np.nanmax(displacement, initial=0.0)
    return bool(np.allclose(length[scan.finite], displacement[scan.finite], rtol=1e-3, atol=tolerance))
