"""A scan in memory. Not here: files (io), neighbours (neighbours.py)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.errors import ScanError

Points = NDArray[np.float64]
"""(N, 3) world coordinates."""
Mask = NDArray[np.bool_]
"""(N,) per-point truth values."""
_EXTENTS = (1e-15, 1e15)


def within(reach: float | NDArray[np.float64], start: Points, moved: Points) -> Points:
    """(N, 3) moved points, but none further than `reach` from its start, a length for all or (N,) one for each."""
    slide = moved - start
    length = np.linalg.norm(slide, axis=1)
    cut: Points = start + slide * (reach / np.maximum(length, np.maximum(reach, 1e-300)))[:, None]
    return cut


@dataclass(frozen=True)
class Scan:
    """N points in file order and all that the file said about them.

    points      (N, 3) float64, file units; rows may be NaN or infinite (organised clouds): see `finite`.
    attributes  name -> (N,) array in the file's own dtype, everything per point except x, y, z.
    format      'las', 'laz', 'ply', 'xyz', 'pcd', 'bin', 'e57' or 'ptx'.
    origin      where it was read from, for messages.
    source      what the format's own module needs to write the file back as it was; opaque to everyone else.
    added       names of attributes that were not in the file (displacement, outlier flag, …).
    """

    points: Points
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    format: str = "xyz"
    origin: str = "<memory>"
    source: Any = field(default=None, repr=False)
    added: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype != np.float64:
            raise ScanError(f"{self.origin}: points must be (N, 3) float64, got {self.points.shape} {self.points.dtype}")
        for name, values in self.attributes.items():
            if len(values) != len(self.points):
                raise ScanError(f"{self.origin}: attribute {name} has {len(values)} rows, the scan has {len(self.points)}")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def finite(self) -> Mask:
        """(N,) rows whose three coordinates are numbers."""
        finite: Mask = np.logical_and.reduce(np.isfinite(self.points), axis=1)
        return finite

    def moved_to(self, points: Points) -> Scan:
        """The same rows at other places: same N, same order, same attributes. Raises ScanError on another shape."""
        if points.shape != self.points.shape:
            raise ScanError(f"{self.origin}: {len(self.points)} points went in, {len(points)} came out; rows must stay rows")
        return replace(self, points=np.ascontiguousarray(points, dtype=np.float64))

    def with_attributes(self, **values: NDArray[Any]) -> Scan:
        """The scan with new per-point columns, written as LAS extra bytes, PLY properties, text columns, PCD or E57 fields."""
        added = self.added + tuple(name for name in values if name not in self.added)
        return replace(self, attributes={**self.attributes, **values}, added=added)


def check_extent(points: Points) -> None:
    """Raises ScanError if the largest extent of (N, 3) finite points is so large or small that squares of lengths are lost."""
    with np.errstate(over="ignore"):
        extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if extent and not _EXTENTS[0] <= extent <= _EXTENTS[1]:
        raise ScanError(
            f"coordinates span {extent:.3g}, beyond any scan; rescale them or remove the rows that are no measurements"
        )
