"""Laws of measurement noise: what a scanner does to true points. Not here: the ray-cast scanner (lidar.py).

Every law in NOISES is (points (N, 3), std, rng) -> (N, 3): rows stay rows, std is the root mean square of the error along its own
directions, in the unit of the points. A law that needs a scanner position draws one outside the cloud.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.synthesis.solids import directions

Noise = Callable[[Points, float, np.random.Generator], Points]


def gaussian(points: Points, std: float, rng: np.random.Generator) -> Points:
    """The same normal error of standard deviation std along every axis."""
    noisy: Points = points + std * rng.standard_normal(points.shape)
    return noisy


def anisotropic(points: Points, std: float, rng: np.random.Generator) -> Points:
    """One normal law for all points, std along its worst axis and 0.1 to 1 std along two others, at random angles."""
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    stretch = std * np.array([1.0, *rng.uniform(0.1, 1.0, 2)])
    noisy: Points = points + (rng.standard_normal(points.shape) * stretch) @ axes.T
    return noisy


def along_rays(points: Points, std: float, rng: np.random.Generator) -> Points:
    """A normal error of the range only, as seen from one position."""
    return points + std * rng.standard_normal((len(points), 1)) * _rays(points, rng)


def laplace(points: Points, std: float, rng: np.random.Generator) -> Points:
    """A double-exponential error along every axis: many small ones, more large ones than normal."""
    return points + rng.laplace(scale=std / np.sqrt(2), size=points.shape)


def heavy_tailed(points: Points, std: float, rng: np.random.Generator, freedom: float = 4.0) -> Points:
    """A multivariate Student error: a point's three axes are off together; variance std², fourth moment infinite at freedom 4."""
    spread = np.sqrt((freedom - 2) / rng.chisquare(freedom, (len(points), 1)))
    noisy: Points = points + std * spread * rng.standard_normal(points.shape)
    return noisy


def beam_bias(points: Points, std: float, rng: np.random.Generator, n_beams: int = 64) -> Points:
    """A constant range error for each beam of a fan seen from one position, and half of its variance again ray by ray."""
    rays = _rays(points, rng)
    height = rays @ directions(1, rng)[0]
    beam = np.clip(((height - height.min()) / max(float(np.ptp(height)), 1e-12) * n_beams).astype(np.int64), 0, n_beams - 1)
    error = rng.standard_normal(n_beams)[beam] * np.sqrt(2 / 3) + rng.standard_normal(len(points)) * np.sqrt(1 / 3)
    noisy: Points = points + std * error[:, None] * rays
    return noisy


def quantised(points: Points, std: float, rng: np.random.Generator) -> Points:
    """Coordinates rounded to a grid of step std √12 at a random offset: a uniform error of that standard deviation."""
    step = std * np.sqrt(12)
    offset = rng.random(3) * step
    noisy: Points = np.round((points - offset) / step) * step + offset if step > 0 else points.copy()
    return noisy


def misregistered(points: Points, std: float, rng: np.random.Generator, n_passes: int = 3) -> Points:
    """Several passes over the same place, each shifted as a whole, and a normal error of half that variance on every point."""
    shift = rng.standard_normal((n_passes, 3)) * np.sqrt(2 / 3)
    error = shift[rng.integers(n_passes, size=len(points))] + rng.standard_normal(points.shape) * np.sqrt(1 / 3)
    noisy: Points = points + std * error
    return noisy


NOISES: dict[str, Noise] = {
    "gaussian": gaussian,
    "anisotropic": anisotropic,
    "rays": along_rays,
    "laplace": laplace,
    "heavy-tailed": heavy_tailed,
    "beam-bias": beam_bias,
    "quantised": quantised,
    "misregistered": misregistered,
}
"""Laws by the name that `synth --noise` knows them by."""


def outliers(points: Points, share: float, rng: np.random.Generator, reach: float = 0.1) -> tuple[Points, Mask]:
    """Points (N, 3) with about that share of rows replaced, and which (N,) they are.

    Half are strewn over the bounding box grown by `reach` diagonals on every side, half fly off their own place by about `reach`.
    """
    wrong: Mask = rng.random(len(points)) < share
    n = int(wrong.sum())
    low, high = points.min(axis=0), points.max(axis=0)
    margin = reach * float(np.linalg.norm(high - low))
    strewn = low - margin + rng.random((n, 3)) * (high - low + 2 * margin)
    flown = points[wrong] + margin * rng.exponential(size=(n, 1)) * directions(n, rng)
    result = points.copy()
    result[wrong] = np.where(rng.random((n, 1)) < 0.5, strewn, flown)
    return result, wrong


def thin(points: Points, rng: np.random.Generator, contrast: float = 10.0) -> NDArray[np.int64]:
    """Rows (M,), ascending, of a random subset whose density varies smoothly, `contrast`-fold between its extremes.

    About a third of the points stay at a contrast of 10.
    """
    centred = points - points.mean(axis=0)
    size = max(float(np.abs(centred).max()), np.finfo(np.float64).tiny)
    waves = directions(3, rng) * rng.uniform(1.0, 5.0, (3, 1))
    field = np.sin(centred @ waves.T / size + rng.uniform(0, 2 * np.pi, 3)).sum(axis=1)
    span = max(float(np.ptp(field)), np.finfo(np.float64).tiny)
    keep = contrast ** (-(field - field.min()) / span)
    return np.flatnonzero(rng.random(len(points)) < keep)


def _rays(points: Points, rng: np.random.Generator) -> Points:
    """(N, 3) unit directions from a random scanner position, three bounding radii away from the centre."""
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    radius = max(float(np.linalg.norm(points - centre, axis=1).max()), np.finfo(np.float64).tiny)
    rays: Points = points - (centre + 3 * radius * directions(1, rng)[0])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays
