"""What a point may be coloured by: its own RGB, a number, or nothing. Not here: the maps themselves (raster.py)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcdenoise.cloud.scan import Points

CLAY = np.array([0.90, 0.84, 0.76], dtype=np.float32)
"""sRGB of points without a colour."""


@dataclass(frozen=True)
class Scalar:
    """A number per point as a colour.

    values      (N,), NaN where unknown.
    label       what they are, with the unit.
    map         one of raster.COLOUR_MAPS; 'balance' is symmetric about 0.
    low, high   the values at the ends of the map; by default the 2nd and 98th percentile, the lower one 0 where it is near.
    """

    values: NDArray[np.float64]
    label: str = ""
    map: str = "heat"
    low: float | None = None
    high: float | None = None

    def range(self) -> tuple[float, float]:
        """The values at the two ends of the map, different and finite."""
        known = self.values[np.isfinite(self.values)]
        low, high = np.percentile(known, [2, 98]) if len(known) else (0.0, 1.0)
        if self.map == "balance":
            low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
        elif 0 < low < 0.3 * high:
            low = 0.0
        low, high = float(low if self.low is None else self.low), float(high if self.high is None else self.high)
        return low, high if high > low else low + max(abs(low), 1e-9)

    def fractions(self) -> NDArray[np.float64]:
        """The values as positions on the map, 0 to 1, NaN where unknown."""
        low, high = self.range()
        return np.clip((np.where(np.isfinite(self.values), self.values, np.nan) - low) / (high - low), 0, 1)


def displacement(before: Points, after: Points, unit: str = "") -> Scalar | None:
    """How far each point moved, NaN where it was or is nowhere; None if the clouds have different rows."""
    if before.shape != after.shape:
        return None
    known = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    moved = np.full(len(before), np.nan)
    moved[known] = np.linalg.norm(after[known] - before[known], axis=1)
    return Scalar(moved, f"Displacement ({unit})" if unit else "Displacement")


Colour: TypeAlias = Scalar | ArrayLike | None
"""(N, 3) RGB as integers of 8 or 16 bit or floats from 0 to 1, (N,) numbers, a Scalar, or None for clay."""


def srgb(colours: NDArray[Any]) -> NDArray[np.float32]:
    """(N, 3) colours of any of the usual ranges as floats from 0 to 1; 16-bit files that hold 8-bit values are common."""
    white = 1 if np.issubdtype(colours.dtype, np.floating) else 255 if colours.max(initial=0) <= 255 else 65535
    shares: NDArray[np.float32] = np.clip(colours.astype(np.float32) / np.float32(white), 0, 1)
    return shares
