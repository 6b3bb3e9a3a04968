"""Where a station of a terrestrial scanner stood: the way between its own frame and the world. Not here: how a file says it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Points


@dataclass(frozen=True)
class Pose:
    """world = local · turn + shift, points being rows; local = (world - shift) · back. turn, back (3, 3), shift (3,)."""

    turn: NDArray[np.float64]
    back: NDArray[np.float64]
    shift: NDArray[np.float64]

    @property
    def is_home(self) -> bool:
        """Whether world and local coordinates are the same."""
        return not ((self.turn != np.eye(3)).any() or self.shift.any())

    def to_world(self, local: Points) -> Points:
        """(n, 3) local points in the world; a copy."""
        return local.copy() if self.is_home else local @ self.turn + self.shift

    def from_world(self, points: Points) -> Points:
        """(n, 3) points of the world in the station's own frame; a copy."""
        return points.copy() if self.is_home else (points - self.shift) @ self.back
