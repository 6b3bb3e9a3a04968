"""KITTI scans (.bin): float32 x, y, z, intensity for each point and nothing else. Known by its suffix only."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points, Scan
from pcdenoise.errors import ScanError
from pcdenoise.io.records import encoded
from pcdenoise.io.source import Column, exactly, moved_rows, narrowest_float, portable

_N_VALUES = 4


@dataclass(frozen=True)
class KittiSource:
    """(N, 4) float32 values of a file."""

    values: NDArray[np.float32]
    columns: Mapping[str, Column]

    def points(self) -> Points:
        """(N, 3) coordinates as stored."""
        with np.errstate(invalid="ignore"):  # a NaN may be a signalling one
            return self.values[:, :3].astype(np.float64)

    def attachments(self) -> list[str]:
        """Nothing."""
        return []

    def payloads(self) -> dict[str, bytes]:
        """Nothing."""
        return {}

    def without(self, names: Collection[str]) -> KittiSource:
        """The file as it is: it has no further columns."""
        return self

    def selected(self, keep: Mask) -> KittiSource:
        """The file with only these points."""
        values = self.values[keep]
        return KittiSource(values, {"intensity": values[:, 3]})


def read(raw: bytes, origin: str) -> Scan:
    """A scan of KITTI bytes. Raises ScanError if they are no whole number of points."""
    if len(raw) % (4 * _N_VALUES):
        raise ScanError(f"{origin}: {len(raw)} bytes are no whole number of KITTI points (16 bytes each); name its real format")
    values = np.frombuffer(raw, "<f4").reshape(-1, _N_VALUES)
    source = KittiSource(values, {"intensity": values[:, 3]})
    return Scan(source.points(), source.columns, "bin", origin, source)


def unstorable(columns: Mapping[str, Column]) -> list[str]:
    """The names of all columns but an intensity that float32 holds exactly."""
    return [name for name, values in columns.items() if name.lower() != "intensity" or exactly(values, "f4") is None]


def coarser(points: Points) -> list[str]:
    """What float32 takes from the coordinates."""
    return [] if narrowest_float(points) == "f4" else ["coordinates beyond float32 precision"]


def write(scan: Scan, file: BinaryIO) -> None:
    """Write a scan as KITTI values; intensity is 0 if the scan has none."""
    values = np.zeros((len(scan), _N_VALUES), "<f4")
    before = np.zeros((len(scan), 3))
    if isinstance(scan.source, KittiSource):
        values[:] = scan.source.values
        before = scan.source.points()
    for i in range(3):
        rows = moved_rows(before[:, i], scan.points[:, i])
        values[rows, i] = encoded(scan.points[rows, i], values.dtype, "xyz"[i])
    intensity = portable(scan.attributes).get("intensity")
    if intensity is not None and exactly(intensity, "f4") is not None:
        values[:, 3] = intensity
    file.write(values.tobytes())
