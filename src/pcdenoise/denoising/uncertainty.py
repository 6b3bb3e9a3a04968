"""How far each cleaned point may still be off, without ground truth. Not here: cleaning (denoiser.py), files (commands).

After a pass neighbours agree on a surface better than the raw points did, and by how much says how well they know it: what a
plane through the nearest cleaned points leaves is what is left of the noise among them and what curvature, edges and thin parts
make hard. It is less than the error, since neighbours err together, so that the noise comes in as well:

    error std = FACTOR * noise^(1 - EXPONENT) * thickness^EXPONENT

Both constants were fitted by benchmarks/uncertainty/run.py on procedural shapes, and tested on others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch
from pcdenoise.cloud.scan import Points

FACTOR, EXPONENT = 0.455, 0.304
NEIGHBOURS = 24
"""Nearest cleaned points, the point itself among them, through which the plane goes."""
_PLANE_PARAMETERS = 3
_AT_ONCE = 1 << 14


def estimate(
    cloud: Points, start: Points, reached: Points, final: Points, noise: NDArray[np.float64], threads: int = -1
) -> NDArray[np.float64]:
    """(N,) standard deviation along the normal of what points are still off, in their unit; for clouds that show a surface.

    cloud (M, 3)    all cleaned points around, these among them, in spatial order.
    start, reached, final (N, 3)   the points before all passes, where these led, and what strength and limit left of the way:
                    who goes a part of it keeps the rest of the noise, and who stays all of it.
    noise (N,)      standard deviation of the noise before all passes, at each of these points.
    """
    off = FACTOR * noise ** (1 - EXPONENT) * thickness(cloud, reached, threads) ** EXPONENT
    whole, gone = (np.linalg.norm(places - start, axis=1) for places in (reached, final))
    share = np.divide(gone, whole, out=np.zeros(len(start)), where=whole > 0)
    std: NDArray[np.float64] = np.hypot(share * off, (1 - share) * noise)
    return std


def thickness(cloud: Points, at: Points, threads: int = -1) -> NDArray[np.float64]:
    """(N,) standard deviation across the plane through the NEIGHBOURS points of (M, 3) nearest to each of (N, 3) places."""
    search = NeighbourSearch(cloud, threads)
    across = np.empty(len(at))
    for begin in range(0, len(at), _AT_ONCE):
        rows = slice(begin, begin + _AT_ONCE)
        near = cloud[search.nearest(at[rows], NEIGHBOURS)]
        near -= near.mean(axis=1, keepdims=True)
        smallest = np.linalg.eigvalsh(near.transpose(0, 2, 1) @ near)[:, 0]
        across[rows] = np.sqrt(np.maximum(smallest, 0) / max(near.shape[1] - _PLANE_PARAMETERS, 1))
    return across
