"""Whether cleaning moved the surface itself: shrinking, swelling, an offset. Not here: limits and exit codes (commands).

Noise moves points to both sides of a surface, so that over a neighbourhood its removal adds up to nothing. What is left of the
mean displacement along the normal is a move of the surface: its drift. No truth and no orientation of normals is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pcdenoise.cloud.neighbours import NeighbourSearch, distinct, principal_axes, spatial_order
from pcdenoise.cloud.scan import Points

N_PROBES = 2000
"""Places that are looked at; the root mean square over them has a scatter of about two percent."""

K_NEIGHBOURS = 128
"""Points whose displacement is averaged at a place. Unbiased cleaning of noise std shows a drift of at most std / sqrt(128)."""


@dataclass(frozen=True)
class Drift:
    """How far a surface moved along its normal, in the points' unit.

    size    root mean square over places of the mean displacement of the nearest K_NEIGHBOURS points.
    inward  mean of it toward the inside of curves, weighted by curvature: above 0 for a surface that shrank, whichever way
            normals point, and below for one that swelled. Flat places have no inside and do not count.
    """

    size: float
    inward: float


def measure(before: Points, after: Points, seed: int = 0, threads: int = -1) -> Drift:
    """The drift between (N, 3) finite points and the same rows after cleaning, at a cost that hardly grows with N.

    Fewer than K_NEIGHBOURS distinct points are one neighbourhood; fewer than 8 have no drift. On a sphere of radius R that is
    scaled by 1 - e, size and inward are both e R to within the share (r / R)^2 of a neighbourhood of radius r.
    """
    rows = distinct(after)[0]
    if len(rows) < 8:
        return Drift(0.0, 0.0)
    rows = rows[spatial_order(after[rows])]
    points, moves = after[rows], after[rows] - before[rows]
    rng = np.random.default_rng(seed)
    probes = points[np.sort(rng.choice(len(points), size=min(N_PROBES, len(points)), replace=False))]
    k = min(K_NEIGHBOURS, len(points))
    indices = NeighbourSearch(points, threads).knn(probes, k)[1]
    near = points[indices] - points[indices].mean(axis=1, keepdims=True)
    frames = principal_axes(near)  # (M, 3, 3); the first axis is the normal
    height = np.einsum("mki,mi->mk", near, frames[:, :, 0])
    span = (near**2).sum(axis=2) - height**2
    span -= span.mean(axis=1, keepdims=True)
    bend = (height * span).sum(axis=1) / np.maximum((span**2).sum(axis=1), np.finfo(np.float64).tiny)
    along = np.einsum("mi,mi->m", moves[indices].mean(axis=1), frames[:, :, 0])
    weight = np.abs(bend).sum()
    return Drift(float(np.sqrt((along**2).mean())), float((bend * along).sum() / weight) if weight > 0 else 0.0)
