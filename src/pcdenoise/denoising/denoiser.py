"""One pass over a cloud, passes in a row, and when to stop.

Not here: files (commands), the network's run (pyramid.py), filters (classical.py).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud import drift
from pcdenoise.cloud.neighbours import distinct, spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel, estimate
from pcdenoise.cloud.scan import Mask, Points, check_extent
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import classical, outliers
from pcdenoise.denoising.held_out import HeldOut
from pcdenoise.denoising.relaxation import relax, within, without_low_frequencies
from pcdenoise.errors import ModelError, UsageError
from pcdenoise.networks.store import Model

if TYPE_CHECKING:
    from pcdenoise.networks.mcconv import MCConvNetwork
    from pcdenoise.networks.projection import ProjectionNetwork

FEWEST_POINTS = 16
"""Smaller clouds come back as they were: no surface can be told from them."""
_MOST_PASSES = 10
_SHRINKING = 0.035
"""Radius over which moves that all points share are taken back, in the network's units of length; as released."""
_DECODED_AT_ONCE = 65_536
_FURTHEST_STDS = 5.0
"""Longest move of one pass along the normal: what is further from the surface is no noise but an outlier or another thing."""
_WORTHWHILE = 2e-4
"""`auto` goes on while a pass lowers the residual over held-out points by this share; see docs/decisions/paper.md."""
_NOTHING = 1e-6
"""Of the spacing: a residual that falls by less is that of a cloud without noise."""

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is done, 0 to 1."""


@dataclass(frozen=True)
class Step:
    """The cloud after one pass, and its figures: iteration, move_median, move_max, roughness_before, roughness_after, held_out.

    held_out, where it was looked at, is the residual of `held_out.HeldOut`: noise and error together. Roughness is the estimated
    noise: what neighbours disagree by. After a pass it says how smooth the cloud is, not how far it still is from the truth.
    """

    points: Points
    figures: dict[str, Any]


@dataclass(frozen=True)
class Result:
    """A cleaned cloud: points (N, 3), outlier (N,), left_alone (N,) rows that were not moved, figures for the report, steps."""

    points: Points
    outlier: Mask
    left_alone: Mask
    figures: dict[str, Any]
    steps: list[Step] = field(default_factory=list)


def denoise(
    points: Points,
    model: Model | None,
    config: DenoiseConfig,
    on_progress: Progress | None = None,
    *,
    level: NoiseLevel | None = None,
) -> Result:
    """Moves (N, 3) float64 points onto the surface they were measured on; row i stays row i.

    Rows that are not finite stay as they are; exact duplicates move together; the network leaves a cloud in which no scale
    shows a surface as it is. Raises UsageError when the network is asked for without a model.
    """
    cloud = _Cloud(points, config, level)
    found = np.zeros(len(points), dtype=bool)
    if config.outliers != "keep" and len(cloud.start) >= FEWEST_POINTS:
        found = cloud.to_rows(outliers.find(cloud.start, threads=cloud.threads), False)
    steps = list(_passes(cloud, model, config, on_progress or (lambda _task, _share: None)))
    moved = steps[-1].points if steps else cloud.start
    unmoved = cloud.unmoved(moved)
    length = np.linalg.norm(moved - cloud.start, axis=1) if len(moved) else np.zeros(1)
    drifted = drift.measure(cloud.start, moved, config.seed, cloud.threads)
    figures = {
        "noise": cloud.level.std,
        "spacing": cloud.level.spacing,
        "is_surface": cloud.level.is_surface,
        "iterations": len(steps),
        "move_median": float(np.median(length)),
        "move_p99": float(np.quantile(length, 0.99)),
        "move_max": float(length.max()),
        "drift": drifted.size,
        "drift_inward": drifted.inward,
        "points_left_alone": int(unmoved.sum()),
        "points_not_finite": int((~cloud.finite).sum()),
        "points_coincident": int(cloud.finite.sum()) - len(cloud.start),
        "outliers": int(found.sum()),
    }
    placed = [Step(cloud.placed(step.points), step.figures) for step in steps]
    return Result(placed[-1].points if placed else points.copy(), found, unmoved, figures, placed)


def iterate(points: Points, model: Model | None, config: DenoiseConfig) -> Iterator[Step]:
    """Pass after pass, each fed with the last one's output: (N, 3) points and figures of every step."""
    cloud = _Cloud(points, config)
    for step in _passes(cloud, model, config, lambda _task, _share: None, is_judged=True):
        yield Step(cloud.placed(step.points), step.figures)


class _Cloud:
    """The distinct finite points of an input in spatial order around their own origin, and the way back to its rows."""

    def __init__(self, points: Points, config: DenoiseConfig, level: NoiseLevel | None = None) -> None:
        self.config, self.rows = config, points
        self.threads = config.threads or os.cpu_count() or 1
        self.finite: Mask = np.logical_and.reduce(np.isfinite(points), axis=1)
        usable = points[self.finite]
        check_extent(usable)
        self.origin = np.round(np.median(usable, axis=0)) if len(usable) else np.zeros(3)
        usable = usable - self.origin
        first, place = distinct(usable)
        order = spatial_order(usable[first])
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        self.start: Points = usable[first][order]
        self._row = back[place]
        self.level: NoiseLevel = level or estimate(self.start, config.seed, self.threads)
        self.diagonal = float(np.linalg.norm(np.ptp(self.start, axis=0))) if len(self.start) else 0.0

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

    def limited(self, moved: Points) -> Points:
        """Moves scaled by the strength and cut to the longest that is allowed."""
        blended = self.start + self.config.strength * (moved - self.start)
        return blended if self.config.max_move is None else within(self.config.max_move, self.start, blended)


def _passes(
    cloud: _Cloud, model: Model | None, config: DenoiseConfig, on_progress: Progress, is_judged: bool = False
) -> Iterator[Step]:
    """Every pass goes on from where the last one led, not from what strength and limit leave of it.

    `is_judged`: each pass is also made on half of the points and judged by the other half, as `auto` does anyway.
    """
    no_surface = config.method == "network" and not cloud.level.is_surface
    if len(cloud.start) < FEWEST_POINTS or config.strength == 0 or no_surface:
        return
    auto = config.iters == "auto"
    n_passes = _MOST_PASSES if config.iters == "auto" else config.iters
    held_out = HeldOut(cloud.start, cloud.level, config.seed, cloud.threads) if auto or is_judged else None
    least = np.inf
    points, level = cloud.start, cloud.level
    for number in range(1, n_passes + 1):
        task = f"pass {number}" if auto or n_passes > 1 else "cleaning"
        judgement = {}
        if held_out is not None:
            residual = held_out.after(partial(_fresh_pass, cloud=cloud, model=model))
            if auto and residual > (1 - _WORTHWHILE) * least - _NOTHING * cloud.level.spacing:
                return
            judgement, least = {"held_out": residual}, residual
        moved = _one_pass(points, level, cloud, model, partial(on_progress, task))
        after = estimate(moved, config.seed, cloud.threads)
        length = np.linalg.norm(moved - points, axis=1)
        figures = {
            "iteration": number,
            "roughness_before": level.std,
            "roughness_after": after.std,
            "move_median": float(np.median(length)),
            "move_max": float(length.max()),
            **judgement,
        }
        points, level = moved, after
        yield Step(cloud.limited(points), figures)


def _fresh_pass(points: Points, cloud: _Cloud, model: Model | None) -> Points:
    """One pass over points whose noise nobody has measured yet."""
    return _one_pass(points, estimate(points, cloud.config.seed, cloud.threads), cloud, model, lambda _share: None)


def _one_pass(points: Points, level: NoiseLevel, cloud: _Cloud, model: Model | None, on_share: Callable[[float], None]) -> Points:
    """One pass over (N, 3) points that are the cloud's, or some of them, on their way."""
    config, threads = cloud.config, cloud.threads
    if config.method != "network":
        moved = _filtered(points, cloud.diagonal, config, threads)
        return _unshrunk(points, moved, cloud.diagonal, config) if config.unshrink else moved
    if model is None:
        raise UsageError("--method network needs a model; give --model, or choose --method jet")
    from pcdenoise.networks.mcconv import MCConvNetwork

    if isinstance(model.network, MCConvNetwork):
        unit = model.network.config.unit or cloud.diagonal
        moved = _mcconv_pass(points, unit, model.network, config.seed, threads, on_share)
        moved = moved if config.unshrink is False else _unshrunk(points, moved, unit, config)
    else:
        moved = _projection_pass(points, level, model.network, config.seed, threads, on_share)
        moved = _unshrunk(points, moved, cloud.diagonal, config) if config.unshrink else moved
    return relax(within(_FURTHEST_STDS * level.std, points, moved), level.std, config.relax_steps, threads)


def _filtered(points: Points, diagonal: float, config: DenoiseConfig, threads: int) -> Points:
    if config.method == "bilateral":
        shares = (config.radius, config.sigma_d, config.sigma_n)
        return classical.bilateral(points, *(None if share is None else share * diagonal for share in shares), threads=threads)
    return classical.FILTERS[config.method](points, config.neighbours, threads=threads)


def _unshrunk(points: Points, moved: Points, unit: float, config: DenoiseConfig) -> Points:
    return points + without_low_frequencies(points, moved - points, _SHRINKING * unit, np.random.default_rng(config.seed))


@contextmanager
def _torch_threads(number: int) -> Iterator[None]:
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _mcconv_pass(
    points: Points, unit: float, network: MCConvNetwork, seed: int, threads: int, on_share: Callable[[float], None]
) -> Points:
    """In the network's frame. Only the first level, which is small, is looked at as a whole; the points follow in blocks."""
    import torch

    rng = np.random.default_rng(seed)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    local = torch.from_numpy((points - centre) / unit)
    moves = []
    with _torch_threads(threads), torch.no_grad():
        code = network.encode(local, rng)
        for start in range(0, len(points), _DECODED_AT_ONCE):
            moves.append(network.decode(code, local[start : start + _DECODED_AT_ONCE], rng).double().numpy())
            on_share(min((start + _DECODED_AT_ONCE) / len(points), 1.0))
    move = np.concatenate(moves)
    if not np.isfinite(move).all():
        raise ModelError("the network gave positions that are not numbers; use another model, or --method jet")
    return points + unit * move


def _projection_pass(
    points: Points, level: NoiseLevel, network: ProjectionNetwork, seed: int, threads: int, on_share: Callable[[float], None]
) -> Points:
    import torch

    from pcdenoise.denoising.pyramid import coarsen, descend, share_of_seeds

    share = share_of_seeds(level, network.config.neighbours)
    done, counting = 0, Lock()
    seeds, count, cell = points, None, np.arange(len(points))
    if share < 1:
        coarse = coarsen(points, share, seed, threads)
        seeds, count, cell = coarse.points, coarse.count, coarse.cell
    total = len(seeds) * sum(network.config.rounds) + (len(points) * network.config.landing_rounds if share < 1 else 0)

    def on_block(n: int) -> None:
        nonlocal done
        with counting:
            done += n
            on_share(done / total)

    # `descend` has threads of its own; torch's would wait for each other.
    with _torch_threads(1), torch.no_grad():
        descent = descend(network, seeds, count, points if share < 1 else None, level.std, threads=threads, on_block=on_block)
        moved: Points = (descent.seeds[-1] if descent.landed is None else descent.landed).numpy()
    trust = descent.trust.numpy().astype(np.float64)[cell, None]
    return points + trust * (moved - points)
