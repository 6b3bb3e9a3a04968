"""What a run leaves beside its scans: reports, pictures, provenance. Not here: how they are drawn or laid out (evaluation)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdenoise import __version__

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from pcdenoise.cloud.scan import Points, Scan
    from pcdenoise.evaluation.colours import Colour
    from pcdenoise.evaluation.report import Page


def provenance(command: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """How a file was made, for the file itself: what shaped the result, and nothing that may differ between runs that agree."""
    shaping = {name: value for name, value in settings.items() if name != "threads"}
    return {"software": "pcdenoise", "version": __version__, "command": command, "settings": shaping}


def save_report(
    path: Path,
    command: str,
    settings: Mapping[str, Any],
    files: Sequence[Mapping[str, Any]],
    page: Page | None,
    *,
    overwrite: bool,
    figures: Mapping[str, Any] | None = None,
) -> None:
    """Writes a report of schema `pcdenoise-report/1`; without figures of the run they are those of a single input."""
    from pcdenoise.evaluation.report import write_report

    if figures is None:
        figures = files[0].get("figures", {}) if len(files) == 1 else {"inputs": len(files), "failed": n_failed(files)}
    report = {"command": command, "version": __version__, "settings": settings, "figures": figures, "files": files}
    write_report(path, report, page, overwrite=overwrite)


def n_failed(files: Sequence[Mapping[str, Any]]) -> int:
    """How many records of a batch are failures."""
    return sum(record["status"] == "failed" for record in files)


def rgb(scan: Scan) -> NDArray[Any] | None:
    """(N, 3) the scan's colours as stored, or None if it has none or all points have the same."""
    import numpy as np

    names = ("red", "green", "blue")
    if any(name not in scan.attributes for name in names):
        return None
    colours: NDArray[np.generic] = np.stack([scan.attributes[name] for name in names], axis=1)
    return colours if (colours != colours[:1]).any() else None


def colours(scan: Scan) -> dict[str, Colour]:
    """What a viewer may colour the scan by: its RGB and its intensity, where it has them."""
    found: dict[str, Colour] = {}
    if (colour := rgb(scan)) is not None:
        found["RGB"] = colour
    if "intensity" in scan.attributes:
        found["intensity"] = scan.attributes["intensity"]
    return found


def save_before_after(path: Path, scan: Scan, after: Points, *, notes: tuple[str, str], overwrite: bool, unit: str = "") -> None:
    """A picture of a scan and of the same rows cleaned, side by side, each with a note; unit: of the coordinates."""
    from pcdenoise.evaluation.pictures import before_after, write_png

    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, before_after(scan.points, after, colour=rgb(scan), notes=notes, unit=unit), overwrite=overwrite)
