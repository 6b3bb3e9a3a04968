"""What is taken back before the passes: errors that whole parts of a scan share, so that no neighbour shows them.

Not here: how rounded depths (rounding.py) and groups that are off (alignment.py) are found, the passes (denoiser.py).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcdenoise.cloud.scan import Mask, Points, check_extent
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import rounding
from pcdenoise.denoising.alignment import Alignment, Groups
from pcdenoise.denoising.rounding import Rounding


@dataclass(frozen=True)
class Correction:
    """By how much each of N rows is moved before the passes, and why.

    unrounding (N, 3): between the steps of rounded depths; rounding: how they were rounded, None where none was. offset (N, 3):
    with its group onto the others. figures, for reports: rounded_axis, rounding_step; groups, offset (root mean square).
    """

    unrounding: Points
    offset: Points
    rounding: Rounding | None
    figures: dict[str, Any]

    @property
    def shift(self) -> Points:
        """(N, 3) both together."""
        return self.unrounding + self.offset

    def of_rows(self, rows: Any) -> Correction:
        """That of some rows, by their numbers or a mask."""
        return replace(self, unrounding=self.unrounding[rows], offset=self.offset[rows])

    def to_rows(self, seen: Mask) -> Correction:
        """That of the rows that are seen, as one of all rows (N,): the others stay."""
        unrounding, offset = np.zeros((2, len(seen), 3))
        unrounding[seen], offset[seen] = self.unrounding, self.offset
        return replace(self, unrounding=unrounding, offset=offset)

    def then(self, alignment: Alignment, group: Groups) -> Correction:
        """And groups (N,) aligned."""
        offset = alignment.shift[group]
        size = float(np.sqrt((offset**2).sum(axis=1).mean())) if len(offset) else 0.0
        return replace(self, offset=offset, figures=self.figures | {"groups": len(alignment), "offset": size})


def unrounded(points: Points, config: DenoiseConfig) -> Correction:
    """Of (N, 3) points: depths that a camera rounded come back between their steps, unless they are to stay."""
    finite = np.logical_and.reduce(np.isfinite(points), axis=1)
    usable, (moved, still) = points[finite], np.zeros((2, len(points), 3))
    check_extent(usable)
    threads = config.threads or os.cpu_count() or 1
    found = rounding.find(usable, threads) if config.unround else None
    if found is not None:
        moved[finite] = rounding.shift(usable, found, threads)
    if found is None or not moved.any():
        return Correction(still, still, None, {})
    return Correction(moved, still, found, found.figures)
