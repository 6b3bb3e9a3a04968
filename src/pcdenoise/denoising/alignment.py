"""Offsets that groups of points share: each beam, sweep, flight line or station off by its own, as the scan itself shows.

Neighbours of the same group err alike, so that no filter sees it; neighbours of other groups do not. Where groups lie side by
side, what cleaning takes off a point is its own noise, which averages out over its group, and the group's offset, which does not.
Not here: which columns to try (learning/structure.py), the passes (denoiser.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.blocks import each_block
from pcdenoise.cloud.neighbours import NeighbourSearch, principal_axes
from pcdenoise.cloud.scan import Points, Scan
from pcdenoise.config import DenoiseConfig
from pcdenoise.errors import ScanError
from pcdenoise.networks.store import Model

Groups = NDArray[np.int64]
"""(N,) the number of each point's group, from 0 on."""

_NEIGHBOURS = 32
_MOST_TURNS = 8
_SURE_STDS = 5.0
"""Offsets are looked for where the groups' mean heights are further apart than noise alone would have them, by so many stds."""
_WORTHWHILE = 1e-3
"""A turn is made for good if it lowers the log variance, and what was spent on parameters, by so much."""
_FURTHEST_STDS = 3.0
_TILT = 0.01
"""Mean square of the angle, in radians, by which normals are off: a plane must not tell offsets within itself."""
_FLOOR = 0.1
"""Of the median variance: no place counts as if it were known better than that."""
_FEWEST_POINTS = 8
"""On average of a group: a column with more values than that allows says when a point was measured, not by what."""


def check_columns(scan: Scan, names: Sequence[str]) -> None:
    """Raises ScanError for the first of these names that is no column of the scan."""
    if missing := [name for name in names if name not in scan.attributes]:
        there = ", ".join(scan.attributes) or "none"
        raise ScanError(f"{scan.origin}: has no column {missing[0]} to align by; its columns: {there}")


def groups_of(scan: Scan, names: Sequence[str]) -> Groups:
    """(N,) the same number for rows that agree in all the columns of these names. Raises ScanError for columns without groups."""
    check_columns(scan, names)
    groups = np.zeros(len(scan), np.int64)
    for name in names:
        values = np.unique(scan.attributes[name], return_inverse=True)[1].reshape(-1)
        groups = np.unique(groups * (int(values.max(initial=0)) + 1) + values, return_inverse=True)[1].reshape(-1)
    n_groups = int(groups.max(initial=0)) + 1
    if n_groups > 1 and len(scan) < _FEWEST_POINTS * n_groups:
        raise ScanError(
            f"{scan.origin}: {len(scan):,} points make {n_groups:,} groups by {', '.join(names)};"
            " align by columns that many points share"
        )
    return groups


def columns_asked_for(model: Model | None, config: DenoiseConfig) -> tuple[str, ...]:
    """The columns to align by: those of the settings, or else what the model was adapted to."""
    of_model = model.config.align_by if model is not None else ()
    return of_model if config.align_by is None else config.align_by


def groups_asked_for(
    scan: Scan, model: Model | None, config: DenoiseConfig, on_fault: Callable[[str], None] = lambda _fault: None
) -> Groups | None:
    """The groups (N,) that a scan is to be aligned by, if there are any.

    A scan need not have what a model names: then `on_fault` hears why there are no groups. Raises ScanError for what the settings
    name.
    """
    names = columns_asked_for(model, config)
    try:
        return groups_of(scan, names) if names else None
    except ScanError as fault:
        if config.align_by is not None:
            raise
        on_fault(str(fault))
        return None


@dataclass(frozen=True)
class Alignment:
    """shift (G, 3): by which each group is to be moved, mean zero over the points, and zero for all where the groups agree.

    gain: by how much the heights' log-likelihood rises, less the number of parameters (Akaike), times two; 0 for no shift.
    """

    shift: Points
    gain: float

    @classmethod
    def none(cls, group: Groups) -> Alignment:
        """No shift of any of the groups (N,)."""
        return cls(np.zeros((int(group.max(initial=0)) + 1, 3)), 0.0)

    def __len__(self) -> int:
        return len(self.shift)


@dataclass(frozen=True)
class Heights:
    """How high (N,) points lie over what they were cleaned to, against normals (N, 3) and beyond what neighbours share.

    What all points of a place have in common is the filter's error, not an offset. near (N, K): rows of the neighbours.
    """

    height: NDArray[np.float64]
    normals: Points
    near: NDArray[np.int32]


def heights(points: Points, cleaned: Points, threads: int) -> Heights:
    """Of (N, 3) points in spatial order and where a pass led them."""
    near, normals = NeighbourSearch(cleaned, threads).nearest(cleaned, _NEIGHBOURS), np.empty_like(cleaned)
    height, beyond = np.empty(len(points)), np.empty(len(points))

    def measure(rows: slice) -> None:
        around = cleaned[near[rows]]
        around -= around.mean(axis=1, keepdims=True)
        normals[rows] = principal_axes(around)[:, :, 0]
        height[rows] = np.einsum("ni,ni->n", points[rows] - cleaned[rows], normals[rows])

    def compare(rows: slice) -> None:
        shared = (height[near[rows], None] * normals[near[rows]]).mean(axis=1)
        beyond[rows] = height[rows] - np.einsum("ni,ni->n", shared, normals[rows])

    each_block(measure, len(points), threads)
    each_block(compare, len(points), threads)
    return Heights(beyond, normals, near)


def align(
    points: Points, group: Groups, unmoved: Alignment, first: Heights, one_pass: Callable[[Points], Points], threads: int
) -> Alignment:
    """The shifts of groups (N,) that leave the least of what cleaning takes off (N, 3) distinct points in spatial order.

    unmoved: no shift, of every group there is; one may be without points. first: the heights then. one_pass: cleans points,
    the same way at every turn.
    Least squares of height over normal (point to plane), group by group and turn by turn; the offsets' own variance, which
    the heights show, holds back those that are hardly known (empirical Bayes), and points count by how well their
    surroundings agree.
    """
    found, n_groups = unmoved, len(unmoved)
    shift, freedom, best, gain = unmoved.shift, 0.0, np.inf, 0.0
    local = (first.height[first.near] ** 2).mean(axis=1)
    local += max(_FLOOR * float(np.median(local)), np.finfo(np.float64).tiny)
    size = np.bincount(group, minlength=n_groups)
    for turn in range(_MOST_TURNS):
        moved = points + shift[group]
        said = _said(heights(moved, one_pass(moved), threads) if turn else first, local, group, n_groups)
        if not said.variance > 0:
            break
        score = float(np.log(said.variance)) + 2 * freedom / said.n_points
        if turn and score >= best - _WORTHWHILE:
            break
        gain += said.n_points * (best - score) if turn else 0.0
        found, best = Alignment(shift, gain), score
        if turn == 0 and said.spread_stds < _SURE_STDS:
            break
        solved = said.offset(shift)
        if solved is None:
            break
        offset, freedom = solved
        shift = (size[:, None] * offset).sum(axis=0) / size.sum() - offset
    return found


@dataclass(frozen=True)
class _Said:
    """What heights say about the offset of each group, as normal equations: known (G, 3, 3) and said (G, 3).

    variance: of a height. n_points: how many points tell groups apart.
    """

    known: NDArray[np.float64]
    said: NDArray[np.float64]
    variance: float
    n_points: float

    @property
    def spread_stds(self) -> float:
        """How much more the groups differ than noise makes them, in stds of what noise does."""
        by_noise = self.variance * float(np.sqrt(2 * (self.known**2).sum()))
        return (float((self.said**2).sum()) - self.variance * self._trace.sum()) / by_noise if by_noise > 0 else 0.0

    @property
    def _trace(self) -> NDArray[np.float64]:
        trace: NDArray[np.float64] = np.trace(self.known, axis1=1, axis2=2)
        return trace

    def offset(self, shift: Points) -> tuple[Points, float] | None:
        """(G, 3) offsets against where groups were before the shift (G, 3), and how many parameters they spend; None for none."""
        said = self.said - np.einsum("gij,gj->gi", self.known, shift)
        prior = (float((said**2).sum()) - self.variance * self._trace.sum()) / float((self.known**2).sum())
        if not prior > 0:
            return None
        held = self.known + (self.variance / prior + _TILT * self._trace)[:, None, None] * np.eye(3)
        spent = np.trace(np.linalg.solve(held, self.known), axis1=1, axis2=2).sum()
        return np.linalg.solve(held, said[:, :, None])[:, :, 0], float(spent)


def _said(seen: Heights, local: NDArray[np.float64], group: Groups, n_groups: int) -> _Said:
    """local (N,): variance of heights around each point. Points count by it, and by how many neighbours are of other groups."""
    trust = (1 / local) / (1 / local).mean()
    height = np.clip(seen.height, -_FURTHEST_STDS * np.sqrt(local), _FURTHEST_STDS * np.sqrt(local))
    others = (group[seen.near] != group[:, None]).mean(axis=1)
    n_points = max(float(others.sum()), 1.0)
    variance = float((trust * others * height**2).sum()) / n_points
    rows, height = (np.sqrt(trust) * others)[:, None] * seen.normals, np.sqrt(trust) * height
    known, said = np.empty((n_groups, 3, 3)), np.empty((n_groups, 3))
    for i in range(3):
        said[:, i] = np.bincount(group, rows[:, i] * height, n_groups)
        for j in range(i, 3):
            known[:, i, j] = known[:, j, i] = np.bincount(group, rows[:, i] * rows[:, j], n_groups)
    return _Said(known, said, variance, n_points)
