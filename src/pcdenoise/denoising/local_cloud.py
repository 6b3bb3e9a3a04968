"""The points that a pass works on, around their own origin, and the way back to the rows they came from.

Not here: what is done to them (denoiser.py), the same for scans that do not fit in memory (tiles.py).
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import Identity, coordinate_hash, distinct_by, drawn_by, nearest_to, spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel, estimate_at, probes
from pcdenoise.cloud.scan import Mask, Points, check_extent
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import taken_off
from pcdenoise.denoising.correction import Correction
from pcdenoise.networks.store import Model

N_CENTRAL = 1 << 16
"""Points whose median becomes the local frame's origin."""


class LocalCloud:
    """The distinct finite points of an input in spatial order around their own origin, and the way back to its rows.

    start, corrected, reached (D, 3): as measured; as the passes are given them; where the passes so far led them from there.
    """

    def __init__(
        self,
        points: Points,
        model: Model | None,
        config: DenoiseConfig,
        level: NoiseLevel | None = None,
        correction: Correction | None = None,
    ) -> None:
        self.config, self.rows = config, points
        self.threads = config.threads or os.cpu_count() or 1
        self.finite: Mask = np.logical_and.reduce(np.isfinite(points), axis=1)
        usable = points[self.finite]
        check_extent(usable)
        identity = coordinate_hash(usable, 0)
        first, place = distinct_by(identity)
        self.origin = origin_of(usable[first[:N_CENTRAL]])  # `distinct_by` sorts by the hash, so these are drawn by it
        distinct = usable[first] - self.origin
        order = spatial_order(distinct)
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        self._first, self._row = np.flatnonzero(self.finite)[first[order]], back[place]
        self.start: Points = distinct[order]
        self.corrected: Points = self.start if correction is None else self.start + self.of_rows(correction.shift)
        self.reached = self.corrected
        self.identity: Identity = identity[first][order]
        self.probes = probes(drawn_by(self.identity, config.seed))
        level = level or self._level(model)
        rounding = None if correction is None else correction.rounding
        left = None if rounding is None else lambda points: rounding.left(points + self.origin)
        self.level: NoiseLevel = replace(level, least=left)
        self.diagonal = float(np.linalg.norm(np.ptp(self.start, axis=0))) if len(self.start) else 0.0

    def _level(self, model: Model | None) -> NoiseLevel:
        """The noise as neighbours disagree by it, then, where a network cleans, as a pass takes it off some of the points."""
        model = model if self.config.method == "network" else None
        read = estimate_at(self.corrected, self.probes, self.threads, self.config.noise)
        first = np.argsort(drawn_by(self.identity[self.probes], self.config.seed))[: taken_off.N_SAMPLES]
        centres = self.corrected[self.probes[first]]
        return taken_off.level_by(read, centres, self._around, model, self.config.seed, self.threads)

    def _around(self, centre: Points, most: int) -> taken_off.Sample:
        rows = nearest_to(centre, self.corrected, self.identity, most)
        return self.corrected[rows], self.identity[rows]

    def of_rows(self, values: NDArray[Any]) -> NDArray[Any]:
        """(D, …) values of the distinct points, from those of all rows (N, …)."""
        return values[self._first]

    def to_rows(self, values: NDArray[Any], missing: Any) -> NDArray[Any]:
        """Values of the distinct points (D, …) spread to all rows (N, …); positions get their origin back."""
        rows = np.full((len(self.finite), *values.shape[1:]), missing, dtype=values.dtype)
        rows[self.finite] = values[self._row] + self.origin if values.ndim == 2 else values[self._row]
        return rows

    def unmoved(self, moved: Points) -> Mask:
        """(N,) input rows that stay where they are."""
        still: Mask = np.logical_and.reduce(moved == self.start, axis=1)
        return self.to_rows(still, True)

    def placed(self, moved: Points) -> Points:
        """(N, 3) input rows at their new places; those that stay keep every bit, which the way over the origin may cost."""
        return np.where(self.unmoved(moved)[:, None], self.rows, self.to_rows(moved, np.nan))


def origin_of(points: Points) -> Points:
    """(3,) whole numbers in the middle of (N, 3) points, those of the N_CENTRAL smallest hashes: the local frame's origin."""
    return np.round(np.median(points, axis=0)) if len(points) else np.zeros(3)
