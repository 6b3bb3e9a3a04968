"""By which columns the points of a scanner's scans are off together: asked of the scans alone, when a model is adapted to them.

Not here: how groups are aligned (denoising/alignment.py), what the network learns (trainer.py).
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations
from pathlib import Path

import numpy as np

from pcdenoise import io
from pcdenoise.cloud.neighbours import parts
from pcdenoise.cloud.scan import Scan
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.alignment import Groups, groups_of
from pcdenoise.denoising.denoiser import alignment_of
from pcdenoise.errors import ScanError
from pcdenoise.learning.scans import FEWEST_POINTS, files_of
from pcdenoise.networks.store import Model

COLUMNS = (
    "beam", "ring", "laser", "laser_id", "channel", "scanner_channel", "scan_direction_flag", "pose", "station", "scan_id",
    "line", "point_source_id",
)  # fmt: skip
"""What files call the part of a scanner, or of a survey, that a point comes from. Not what it hit: leaves and roofs lie where
they lie."""
_PAIRS_GAIN = 1.5
"""Two columns must gain so many times what one does: without the second there are more points to a group, and to a scan."""
_MOST_COLUMNS = 4
_MOST_SCANS = 3
_MOST_POINTS = 100_000
"""Of a larger scan, one part stands for all."""


def shared_by(data: tuple[str, ...], model: Model, seed: int, threads: int | None) -> tuple[str, ...]:
    """The columns, one or two, by which the first scans in `data` are best aligned; none where groups agree by all of them.

    Best: the likelihood of what cleaning takes off rises most, less what so many offsets would raise it by chance.
    """
    gains: dict[tuple[str, ...], float] = defaultdict(float)
    config = DenoiseConfig.model_validate({"seed": seed, "threads": threads})
    for path, _ in list(files_of([Path(text) for text in data]))[:_MOST_SCANS]:
        scan = _some_of(io.read(path))
        groupings = _groupings(scan)
        if len(scan) < FEWEST_POINTS or not groupings:
            continue
        found = alignment_of(scan.points, list(groupings.values()), model, config)
        for names, alignment in zip(groupings, found, strict=True):
            gains[names] += alignment.gain
    best = max(gains, key=lambda names: gains[names] / _PAIRS_GAIN ** len(names), default=())
    return best if gains.get(best, 0.0) > 0 else ()


def _some_of(scan: Scan) -> Scan:
    finite = np.flatnonzero(scan.finite)
    rows = finite[next(parts(scan.points[finite], _MOST_POINTS))]
    return Scan(scan.points[rows], {name: values[rows] for name, values in scan.attributes.items()}, scan.format, scan.origin)


def _groupings(scan: Scan) -> dict[tuple[str, ...], Groups]:
    """Every known column that has more than one value, and every two of these, unless that makes the same groups once more."""
    names = [name for name in scan.attributes if name.lower() in COLUMNS and len(np.unique(scan.attributes[name])) > 1]
    names = names[:_MOST_COLUMNS]
    found: dict[tuple[str, ...], Groups] = {}
    for some in [*combinations(names, 1), *combinations(names, 2)]:
        try:
            groups = groups_of(scan, some)
        except ScanError:  # too many groups for so few points
            continue
        if not any(groups.max() == other.max() and _agree(groups, other) for other in found.values()):
            found[some] = groups
    return found


def _agree(groups: Groups, other: Groups) -> bool:
    """Whether two groupings with as many groups put the same points together."""
    return bool(np.unique(np.stack([groups, other]), axis=1).shape[1] == groups.max() + 1)
