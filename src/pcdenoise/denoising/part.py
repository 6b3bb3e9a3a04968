"""Cleaning some rows of a cloud while others stay: a class, a region. Not here: what a class or a region is (commands)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.correction import Correction
from pcdenoise.denoising.denoiser import Progress, Result, denoise, level_of
from pcdenoise.networks.store import Model

_REACH_SPACINGS = 64.0
"""How far away a point can have a say in one pass, in spacings of the cloud, where the surface shows at once."""


def denoise_part(
    points: Points,
    movable: Mask,
    seen: Mask,
    model: Model | None,
    config: DenoiseConfig,
    on_progress: Progress | None = None,
    *,
    correction: Correction | None = None,
) -> Result:
    """`denoise`, but only `movable` rows (N,) move, and only `seen` rows (N,) have a say; every other row keeps each bit.

    The noise is that of all seen rows. Of these, only the ones near a movable row are worked on: within 64 spacings for each
    pass, more where a surface shows only in large neighbourhoods. So a region comes out as if the whole cloud were cleaned.
    Figures are of the movable rows; noise, spacing, drift and steps are of all rows that were worked on.
    """
    usable = np.logical_and.reduce(np.isfinite(points), axis=1)
    movable = movable & seen
    level = level_of(points[seen], model, config, None if correction is None else correction.of_rows(seen))
    worked = seen & usable
    if (movable & usable).any():
        passes = 10 if config.iters == "auto" else config.iters
        reach = _REACH_SPACINGS * level.spacing * passes * max(1.0, np.sqrt(level.scale_points / 16))
        low, high = points[movable & usable].min(axis=0) - reach, points[movable & usable].max(axis=0) + reach
        worked &= np.logical_and.reduce((points >= low) & (points <= high), axis=1)
    else:
        worked &= False
    rows = np.flatnonzero(worked)
    before = None if correction is None else correction.of_rows(rows)
    result = denoise(points[rows], model, config, on_progress, level=level, correction=before)

    chosen = movable[rows]
    moved, outlier, left_alone = points.copy(), np.zeros(len(points), np.bool_), np.ones(len(points), np.bool_)
    moved[rows[chosen]] = result.points[chosen]
    outlier[rows[chosen]] = result.outlier[chosen]
    left_alone[rows[chosen]] = result.left_alone[chosen]
    std = None
    if result.std is not None:
        std = np.full(len(points), np.nan)
        std[rows[chosen]] = result.std[chosen]
    length = np.linalg.norm((moved - points)[rows[chosen]], axis=1)
    figures = {
        **result.figures,
        "move_median": float(np.median(length)) if len(length) else 0.0,
        "move_p99": float(np.quantile(length, 0.99)) if len(length) else 0.0,
        "move_max": float(length.max(initial=0.0)),
        "points_left_alone": int(left_alone[movable].sum()),
        "points_not_finite": int((~usable[movable]).sum()),
        **({"outliers": int(outlier.sum())} if "outliers" in result.figures else {}),
        "points_selected": int(movable.sum()),
        "points_seen": len(rows),
    }
    return replace(result, points=moved, outlier=outlier, left_alone=left_alone, figures=figures, std=std)
