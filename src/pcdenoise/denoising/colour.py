"""Colours smoothed along a cleaned surface, their edges kept. Not here: positions (denoiser.py), how colours are stored (io).

The bilateral filter of Tomasi and Manduchi, "Bilateral filtering for gray and color images" (1998), with the nearest cleaned
points in place of pixels. A neighbour counts by how near it is, and by how likely noise alone makes its colour differ: the
difference is measured in stds of the colour noise, which the scan itself shows. A point keeps 1 / (1 + RANGE_STDS²) of its own
error, since it weighs neighbours by its own colour, and the mean over the n others leaves 1 / √n.

Limits: texture as fine as the spacing passes for noise where there is little else; edges below about RANGE_STDS stds are blurred.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch, spatial_order
from pcdenoise.cloud.scan import Points

Colours = NDArray[Any]
"""(N, 3) red, green, blue in any dtype and range."""

NEIGHBOURS, RANGE_STDS = 48, 3.0
_NEAREST = 4  # whose differences show the noise
_NORMAL_MEDIAN = 0.6745
_STEP_STD = 12**-0.5  # of the rounding of whole numbers: no noise is below
_BLOCK_POINTS = 1 << 13


def noise_std(points: Points, colours: Colours, threads: int = -1) -> NDArray[np.float64]:
    """(3,) standard deviation of the noise of each channel, in its own unit.

    From the median difference to the nearest of (N, 3) finite points in spatial order: most neighbours are not across an edge.
    """
    values = colours.astype(np.float64)
    near = NeighbourSearch(points, threads).nearest(points, _NEAREST + 1)[:, 1:]
    differences = np.abs(values[near] - values[:, None]).reshape(-1, 3)
    std: NDArray[np.float64] = np.median(differences, axis=0) / (_NORMAL_MEDIAN * np.sqrt(2))
    return np.maximum(std, _STEP_STD) if colours.dtype.kind in "ui" else std


def smoothed(points: Points, colours: Colours, threads: int = -1) -> Colours:
    """Colours of (N, 3) cleaned points without their noise: same rows, dtype and range, no value beyond those around it.

    Rows whose coordinates are not finite keep theirs, and so do all in a channel without noise and clouds of fewer than five.
    """
    rows = np.flatnonzero(np.logical_and.reduce(np.isfinite(points), axis=1))
    result = colours.copy()
    if len(rows) <= _NEAREST:
        return result
    rows = rows[spatial_order(points[rows])]
    places, values = points[rows], colours[rows].astype(np.float64)
    noise = noise_std(places, colours[rows], threads)
    noisy = noise > 0
    shares = values[:, noisy] / (RANGE_STDS * noise[noisy])
    search, cleaned = NeighbourSearch(places, threads), values.copy()
    for begin in range(0, len(rows), _BLOCK_POINTS):
        block = slice(begin, begin + _BLOCK_POINTS)
        distances, near = search.knn(places[block], NEIGHBOURS)
        weight = (1 - (distances / np.maximum(distances[:, -1:], np.finfo(float).tiny)) ** 2) ** 2
        weight *= np.exp(-0.5 * ((shares[near] - shares[block, None]) ** 2).sum(axis=2))
        mean = np.einsum("nk,nkc->nc", weight, values[near]) / weight.sum(axis=1, keepdims=True)
        cleaned[block, noisy] = mean[:, noisy]
    result[rows] = np.rint(cleaned) if colours.dtype.kind in "ui" else cleaned
    return result
