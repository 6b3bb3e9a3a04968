"""A synthetic street of any length, written piece by piece: road, house fronts with windows, parked cars. Not here: measuring."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

SPACING_M = 0.05
NOISE_M = 0.02
OFFSET_M = np.array([4.5e5, 4.5e6, 100.0])
PIECE = 200_000
_WIDTHS_M = {"road": 20.0, "fronts": 20.0, "cars": 3.0}  # metres of surface across the street, both sides together
METRES_PER_PIECE = PIECE * SPACING_M**2 / sum(_WIDTHS_M.values())


def street(n: int, seed: int = 0) -> Iterator[NDArray[np.float64]]:
    """(≤ 200 000, 3) points in metres after the other, n in all, at UTM coordinates; the density is the same for any n."""
    for piece, first in enumerate(range(0, n, PIECE)):
        yield _piece(min(PIECE, n - first), piece * METRES_PER_PIECE, np.random.default_rng([seed, piece])) + OFFSET_M


def _piece(n: int, start_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    x = start_m + rng.random(n) * METRES_PER_PIECE * n / PIECE
    width = np.array(list(_WIDTHS_M.values()))
    kind = rng.choice(3, size=n, p=width / width.sum())
    side, across, up = np.where(rng.random(n) < 0.5, -1.0, 1.0), rng.random(n), rng.random(n)
    road_y = 20 * across - 10
    road = np.stack([x, road_y, 0.1 * np.sin(x / 7) + 0.05 * np.cos(road_y)], axis=1)
    is_window = (x % 4 < 1.5) & (10 * up % 3 > 1) & (10 * up % 3 < 2.4)
    fronts = np.stack([x, side * (10 + 0.3 * is_window), 10 * up], axis=1)
    ball = rng.standard_normal((n, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ball[:, 2] = np.abs(ball[:, 2])
    cars = np.stack([np.floor(x / 8) * 8 + 4, 7 * side, np.zeros(n)], axis=1) + ball * [2, 0.9, 1.4]
    points: NDArray[np.float64] = np.stack([road, fronts, cars])[kind, np.arange(n)]
    return points + NOISE_M * rng.standard_normal((n, 3))


def write(n: int, path: Path) -> None:
    """A LAZ file of n points in steps of a millimetre, with an intensity each; needs no more memory for more points."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 1e-3), OFFSET_M
    with laspy.open(path, mode="w", header=header) as file:
        for number, points in enumerate(street(n)):
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            record.x, record.y, record.z = points.T
            record.intensity = (np.arange(len(points)) + number) % 65536
            file.write_points(record)
