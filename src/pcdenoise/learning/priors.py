"""Targets to learn from when only noisy points exist: for each point, a neighbour drawn by a prior. Not here: losses, training.

Hermosilla, Ritschel, Ropinski, "Total Denoising" (2019), Unique Modes, Algorithm 1 and supplement: a neighbour q of the noisy
point y is picked at random within the radius r and accepted with probability k(q - y), so that near ones, in space and in colour,
are likelier to be taken for what y should have been.

What a network then regresses to is known. On a surface of mean curvature H under Gaussian noise of standard deviation σ, with a
Gaussian kernel of standard deviation s (`gaussian_std`), the mean target of a point at height h is h σ²/(σ² + s²) - H s²: it
keeps part of the noise, more the narrower the kernel is, and drifts inward, more the wider it is.

By default no point is its own target (a blind spot). The released code allows it, and at 6 000 points one target in ten is: the
annealed loss, which seeks the mode, then learns to leave every point where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import Indices, pairs_within, thinned
from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError

Floats = NDArray[np.float64]

_BANDWIDTH = 0.4 * 2**0.5  # of the Gaussian in units of α r, as released; its peak of 0.705 is a probability

KERNELS: Mapping[str, Callable[[Floats], Floats]] = {
    "gaussian": lambda squared: np.exp(-squared / (2 * _BANDWIDTH**2)) / (_BANDWIDTH * (2 * np.pi) ** 0.5),
    "wendland": lambda squared: np.maximum(1 - squared, 0) ** 4 * (1 + 4 * squared),
    "imq": lambda squared: 1 / np.sqrt(1 + 25 * squared**2),
    "uniform": lambda squared: np.ones_like(squared),
    "wendland-released": lambda squared: np.maximum(1 - np.sqrt(squared), 0) ** 4 * (1 + 4 * np.sqrt(squared)),
    "imq-released": lambda squared: 1 / np.sqrt(1 + 25 * squared),
}
"""Acceptance by ‖W d‖², as the supplement has it. `uniform`: no prior. `-released`: of ‖W d‖, as the released code has it."""

ALPHA: Mapping[str, float] = dict.fromkeys(KERNELS, 0.5) | {"wendland": 1.0, "imq": 1.0}
"""Width of each kernel in radii: the best one of the supplement's table, and 0.5 as released."""


@dataclass(frozen=True)
class Prior:
    """Which noisy neighbours may stand for what a point should have been.

    radius: of the ball they are drawn from, in the points' unit; in the paper 5 % of the bounding-box diagonal.
    alpha: kernel width in radii (default: `ALPHA`). beta: weight of features, ‖W d‖² = ‖Δx‖² / (α r)² + β² ‖Δc‖².
    blind_spot: the point itself is no candidate. n_candidates: about how many random neighbours are tried.
    Raises UsageError for an unknown kernel and for values that are not positive.
    """

    radius: float
    kernel: str = "gaussian"
    alpha: float | None = None
    beta: float = 4.0
    blind_spot: bool = True
    n_candidates: int = 64

    def __post_init__(self) -> None:
        if self.kernel not in KERNELS:
            raise UsageError(f"kernel: {self.kernel} is not offered; use one of {', '.join(KERNELS)}")
        for name, value in (("radius", self.radius), ("alpha", self.width), ("beta", self.beta)):
            if not value > 0:
                raise UsageError(f"{name}: must be above 0, got {value}")

    @property
    def width(self) -> float:
        """α."""
        return ALPHA[self.kernel] if self.alpha is None else self.alpha

    def targets(self, points: Points, features: Floats | None, rng: np.random.Generator) -> Points:
        """(N, 3) targets, one other noisy point for each of (N, 3) finite points: `points` at the `rows`."""
        targets: Points = points[self.rows(points, features, rng)]
        return targets

    def rows(self, points: Points, features: Floats | None, rng: np.random.Generator) -> Indices:
        """(N,) rows drawn for (N, 3) finite points.

        features: (N, F), colours from 0 to 1, or None for a prior in space alone. Of the neighbours tried the first one accepted
        is taken; if there is none, one is drawn in proportion to its chance; a point without any is its own target.
        """
        rows = np.arange(len(points))
        _, candidates = thinned(points, points, self.radius, self.n_candidates, rng)
        for centre, candidate in pairs_within(points[candidates], points, self.radius):
            other = candidates[candidate]
            squared = ((points[other] - points[centre]) ** 2).sum(axis=1) / (self.width * self.radius) ** 2
            if features is not None:
                squared += self.beta**2 * ((features[other] - features[centre]) ** 2).sum(axis=1)
            chance = np.where(self.blind_spot & (other == centre), 0, KERNELS[self.kernel](squared))
            winner = _first_accepted(centre, chance, rng)
            rows[centre[winner]] = other[winner]
        return rows


def gaussian_std(radius: float, alpha: float = ALPHA["gaussian"]) -> float:
    """Standard deviation of the Gaussian kernel along each axis, in the unit of the radius."""
    return _BANDWIDTH * alpha * radius


def _first_accepted(centre: Indices, chance: Floats, rng: np.random.Generator) -> Indices:
    """For each run of equal centres, the position of the first candidate accepted when they are tried in random order.

    Where none is accepted they race with rates in proportion to their chances; where all chances are zero nobody wins.
    """
    late = np.full(len(chance), np.inf)
    np.divide(rng.exponential(size=len(chance)), chance, out=late, where=chance > 1e-200)
    turn = np.where(rng.random(len(chance)) < chance, rng.random(len(chance)), 1 + late)
    first = np.flatnonzero(np.diff(centre, prepend=-1))
    earliest = np.minimum.reduceat(turn, first) if len(first) else turn
    winners: Indices = np.flatnonzero((turn == np.repeat(earliest, np.diff(first, append=len(turn)))) & np.isfinite(turn))
    return winners
