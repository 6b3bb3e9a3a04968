"""One pass over a cloud, passes in a row, and when to stop.

Not here: files (commands), what a network does in a pass (network_pass.py), filters (classical.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud import drift
from pcdenoise.cloud.neighbours import Identity, spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel, by_place, estimate_at
from pcdenoise.cloud.scan import Mask, Points, within
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import classical, network_pass, outliers, taken_off, uncertainty
from pcdenoise.denoising.alignment import Alignment, Groups, align, heights
from pcdenoise.denoising.correction import Correction, unrounded
from pcdenoise.denoising.local_cloud import LocalCloud
from pcdenoise.denoising.relaxation import relax, without_low_frequencies
from pcdenoise.denoising.risk import Risk
from pcdenoise.errors import UsageError
from pcdenoise.networks.store import Model, ProjectionSettings

FEWEST_POINTS = 16
"""Smaller clouds come back as they were: no surface can be told from them."""
_MOST_PASSES = 10
_SHRINKING = 0.035
"""Radius over which moves that all points share are taken back, in the network's units of length; as released."""
_WORTHWHILE = 2e-3
"""`auto` goes on while a pass lowers the estimated error by this share; see docs/decisions/paper.md."""
_NOTHING = 1e-6
"""Of the spacing: an error that falls by less is that of a cloud without noise."""
_DRAWS_APART = 1_000_003  # between the seeds of two draws, so that runs with seeds next to each other share none

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is done, 0 to 1."""


@dataclass(frozen=True)
class Step:
    """The cloud after one pass, and its figures: iteration, move_median, move_max, roughness_before, roughness_after.

    estimated_error_before and _after, where they were looked at, are those of `risk.Risk`. Roughness is the estimated noise: what
    neighbours disagree by. After a pass it says how smooth the cloud is, not how far it still is from the truth.
    """

    points: Points
    figures: dict[str, Any]


@dataclass(frozen=True)
class Result:
    """A cleaned cloud: points (N, 3), outlier (N,), left_alone (N,) rows that were not moved, figures for the report, steps.

    std (N,), if the configuration asks for it: standard deviation of what each point is still off along the normal, in the
    points' unit; NaN for rows that are not finite and where there is no surface.
    """

    points: Points
    outlier: Mask
    left_alone: Mask
    figures: dict[str, Any]
    steps: list[Step] = field(default_factory=list)
    std: NDArray[np.float64] | None = None


def denoise(
    points: Points,
    model: Model | None,
    config: DenoiseConfig,
    on_progress: Progress | None = None,
    *,
    level: NoiseLevel | None = None,
    correction: Correction | None = None,
) -> Result:
    """Moves (N, 3) float64 points onto the surface they were measured on; row i stays row i.

    level: the noise, if it is known. correction: what is taken back of the rows before the passes, see `correction_of`.
    Rows that are not finite stay as they are; exact duplicates move together; the network leaves a cloud in which no scale
    shows a surface as it is. Raises UsageError when the network is asked for without a model.
    """
    cloud = LocalCloud(points, model, config, level, correction)
    found = np.zeros(len(points), dtype=bool)
    if config.outliers != "keep" and len(cloud.start) >= FEWEST_POINTS:
        found = cloud.to_rows(outliers.find(cloud.corrected, level=cloud.level.as_read, threads=cloud.threads), False)
    steps = list(_passes(cloud, model, config, on_progress or (lambda _task, _share: None)))
    moved = steps[-1].points if steps else limited(cloud.start, cloud.corrected, config)
    unmoved = cloud.unmoved(moved)
    length = cloud.to_rows(np.linalg.norm(moved - cloud.start, axis=1), np.nan)[cloud.finite] if len(moved) else np.zeros(1)
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
    }
    if config.outliers != "keep":
        figures["outliers"] = int(found.sum())
    std = None
    if config.uncertainty:
        off = np.full(len(moved), np.nan)
        if cloud.level.is_surface:
            noise = by_place(cloud.corrected, cloud.identity, cloud.level.as_read, cloud.threads)
            cleaned = cloud.reached[spatial_order(cloud.reached)]
            off = uncertainty.estimate(cleaned, cloud.start, cloud.reached, moved, noise, cloud.threads)
        std = cloud.to_rows(off, np.nan)
    placed = [Step(cloud.placed(step.points), step.figures) for step in steps]
    return Result(placed[-1].points if placed else cloud.placed(moved), found, unmoved, figures, placed, std)


def level_of(points: Points, model: Model | None, config: DenoiseConfig, correction: Correction | None = None) -> NoiseLevel:
    """The noise level by which `denoise` would clean (N, 3) points."""
    return LocalCloud(points, model, config, correction=correction).level


def alignment_of(points: Points, groupings: list[Groups], model: Model | None, config: DenoiseConfig) -> list[Alignment]:
    """By how much each group of (N, 3) points is off against the others, by one grouping (N,) or another.

    Of rows that coincide the first one counts. No group is moved where there is nothing to clean or no surface.
    """
    unmoved = [Alignment.none(groups) for groups in groupings]
    if all(len(alignment) < 2 for alignment in unmoved):
        return unmoved
    cloud = LocalCloud(points, model, config)
    if not most_passes(len(cloud.start), cloud.level, config):
        return unmoved
    plain = config.model_copy(update={"relax_steps": 0})

    def cleaned(points: Points) -> Points:
        return one_pass(points, cloud.identity, cloud.level, cloud.diagonal, model, plain, cloud.threads)

    first = heights(cloud.start, cleaned(cloud.start), cloud.threads)
    pairs = zip(groupings, unmoved, strict=True)
    return [align(cloud.start, cloud.of_rows(groups), none, first, cleaned, cloud.threads) for groups, none in pairs]


def correction_of(points: Points, group: Groups | None, model: Model | None, config: DenoiseConfig) -> Correction:
    """What is taken back of (N, 3) points before the passes: rounding, then by how much groups (N,), if any, are off."""
    found = unrounded(points, config)
    if group is None:
        return found
    alignment = alignment_of(points + found.shift, [group], model, config)[0]
    return found.then(alignment, group)


def iterate(
    points: Points,
    model: Model | None,
    config: DenoiseConfig,
    *,
    correction: Correction | None = None,
) -> Iterator[Step]:
    """Pass after pass, each fed with the last one's output: (N, 3) points and figures of each. correction: as in `denoise`."""
    cloud = LocalCloud(points, model, config, correction=correction)
    for step in _passes(cloud, model, config, lambda _task, _share: None, is_judged=True):
        yield Step(cloud.placed(step.points), step.figures)


def limited(start: Points, moved: Points, config: DenoiseConfig) -> Points:
    """Moves scaled by the strength and cut to the longest that is allowed."""
    blended = start + config.strength * (moved - start)
    return blended if config.max_move is None else within(config.max_move, start, blended)


def most_passes(n_points: int, level: NoiseLevel, config: DenoiseConfig) -> int:
    """How many passes there are at most over so many distinct points; none where there is nothing to clean."""
    no_surface = config.method == "network" and not level.is_surface
    if n_points < FEWEST_POINTS or config.strength == 0 or no_surface:
        return 0
    return _MOST_PASSES if config.iters == "auto" else config.iters


def is_worthwhile(before: float, after: float, spacing: float) -> bool:
    """Whether a pass with these estimated errors before and after it is one that `auto` makes. All in the points' unit."""
    return after <= (1 - _WORTHWHILE) * before - _NOTHING * spacing


class Judge:
    """Points that stand for a cloud, and what they say of pass after pass. Under `auto` they say which are worth making."""

    def __init__(
        self, risk: Risk, level: NoiseLevel, diagonal: float, model: Model | None, config: DenoiseConfig, threads: int
    ) -> None:
        self._risk, self._spacing = risk, level.spacing
        self._model, self._config, self._diagonal, self._threads = model, config, diagonal, threads

    @property
    def points(self) -> Points:
        """(N, 3) where the passes so far led them."""
        return self._risk.points

    def figures(self, level: NoiseLevel, on_share: Callable[[float], None] = lambda _share: None) -> dict[str, float] | None:
        """The estimated errors around one more pass over a cloud of that level; None where `auto` makes it no more."""

        def next_pass(points: Points) -> Points:
            identity = self._risk.identity
            return one_pass(points, identity, level, self._diagonal, self._model, self._config, self._threads, on_share)

        before, after = self._risk.after(next_pass)
        if self._config.iters == "auto" and not is_worthwhile(before, after, self._spacing):
            return None
        return {"estimated_error_before": before, "estimated_error_after": after}


def _passes(
    cloud: LocalCloud, model: Model | None, config: DenoiseConfig, on_progress: Progress, is_judged: bool = False
) -> Iterator[Step]:
    """Every pass goes on from where the last one led, not from what strength and limit leave of it.

    `is_judged`: the error before and after each pass is estimated, as `auto` does anyway, at the cost of another pass.
    """
    points, level, judge = cloud.corrected, cloud.level, None
    n_passes = most_passes(len(points), level, config)
    if n_passes and (config.iters == "auto" or is_judged):
        risk = Risk(points, cloud.identity, level.as_read, config.seed, cloud.threads)
        judge = Judge(risk, level, cloud.diagonal, model, config, cloud.threads)
    for number in range(1, n_passes + 1):
        task = "cleaning" if config.iters == 1 else f"pass {number}"
        on_share = partial(on_progress, task)
        judgement = judge.figures(level, on_share) if judge is not None else {}
        if judgement is None:
            return
        if judge is not None and len(judge.points) == len(points):
            moved = judge.points
        else:
            moved = one_pass(points, cloud.identity, level, cloud.diagonal, model, config, cloud.threads, on_share)
        after = estimate_at(moved, cloud.probes, cloud.threads)
        length = np.linalg.norm(moved - points, axis=1)
        figures = {
            "iteration": number,
            "roughness_before": level.as_read.std,
            "roughness_after": after.std,
            "move_median": float(np.median(length)),
            "move_max": float(length.max()),
            **judgement,
        }
        points, level = moved, after
        cloud.reached = moved
        yield Step(limited(cloud.start, points, config), figures)


def one_pass(
    points: Points,
    identity: Identity,
    level: NoiseLevel,
    diagonal: float,
    model: Model | None,
    config: DenoiseConfig,
    threads: int,
    on_share: Callable[[float], None] = lambda _share: None,
) -> Points:
    """(N, 3) distinct points in spatial order one pass on: a cloud of that noise and diagonal, or some of it, on its way.

    Strength and limit are not applied.
    """
    if config.method != "network":
        moved = _filtered(points, level, diagonal, config, threads)
        return _unshrunk(points, moved, diagonal, config) if config.unshrink else moved
    if model is None:
        raise UsageError("--method network needs a model; give --model, or choose --method jet")
    noise: float | NDArray[np.float64] = level.std
    seeds = [(config.seed + _DRAWS_APART * number) % 2**64 for number in range(config.draws)]
    if isinstance(model.config.settings, ProjectionSettings):
        moved, noise = network_pass.projection(points, identity, level, model, seeds, threads, on_share)
        moved = _unshrunk(points, moved, diagonal, config) if config.unshrink else moved
    else:
        unit = model.config.settings.unit or diagonal
        moved = network_pass.mcconv(points, unit, model, seeds, threads, on_share)
        moved = moved if config.unshrink is False else _unshrunk(points, moved, unit, config)
    return relax(within(taken_off.FURTHEST_STDS * noise, points, moved), noise, config.relax_steps, threads)


def _filtered(points: Points, level: NoiseLevel, diagonal: float, config: DenoiseConfig, threads: int) -> Points:
    """What is not given follows from the level, not from these points, which may be a part."""
    if config.method == "bilateral":
        shares = (config.radius, config.sigma_d, config.sigma_n)
        lengths = (None if share is None else share * diagonal for share in shares)
        return classical.bilateral(points, *lengths, level=level, threads=threads)
    return classical.FILTERS[config.method](points, config.neighbours, level=level, threads=threads)


def _unshrunk(points: Points, moved: Points, unit: float, config: DenoiseConfig) -> Points:
    return points + without_low_frequencies(points, moved - points, _SHRINKING * unit, np.random.default_rng(config.seed))
