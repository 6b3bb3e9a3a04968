"""What is done about moves: relaxation toward even spacing, low frequencies taken back.

Not here: moves along the normal (the network's), the limit on any move (cloud.scan).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pcdenoise.cloud.neighbours import NeighbourSearch, pairs_within, thinned
from pcdenoise.cloud.scan import Points, within
from pcdenoise.denoising import blocks
from pcdenoise.networks.projection import Edges, planes, smallest_eigenvector

_NEIGHBOURS = 12
_STEP = 0.35  # of the local spacing, at most, per step
_PUSHING = 1.6  # local spacings: who is further away does not push
_REACH_STDS = 1.0
"""How far a point may slide in all, in standard deviations of the noise: isotropic noise has displaced it by so much along
the surface too, so a clean cloud stays as it is."""
_SHEET = (0.25, 0.4)
"""Planarity, (√λ₂ - √λ₁) / √λ₃ of the covariance's ascending eigenvalues, at which points begin to slide and slide in full:
one in a hundred neighbourhoods of a surface has less than 0.4, half of those in a volume or on a wire less than 0.21."""
_BLOCK = 2 * blocks.BLOCK_POINTS
_LOW_PASS_STD = 0.4 * 2**0.5  # of its radius, as released
_LOW_PASS_POINTS = 256  # within its radius: more are thinned


def relax(points: Points, noise_std: float, steps: int, threads: int = -1) -> Points:
    """Evens the spacing of (N, 3) finite, distinct points on a surface; row i stays row i, N < 4 comes back as it was.

    Each step pushes a point away from neighbours that are nearer than the local mean, inside the tangent plane of its
    neighbourhood; at the end all land on the surface again. Where that is no sheet (wires, volumes, corners) points stay, or
    spreading them would change the shape. Neighbours are found once: the few that push are among the twelve nearest before
    and after, since nobody slides past them.
    """
    if len(points) <= 3 or noise_std <= 0 or steps == 0:
        return points
    k = min(_NEIGHBOURS, len(points) - 1)
    distances, found = NeighbourSearch(points, threads).knn(points, k + 1)
    index = torch.from_numpy(found.astype(np.int32))
    spacing = torch.from_numpy(distances[:, k:] / np.sqrt(k / 2.5))
    del distances, found

    def over(work: blocks.Work) -> tuple[Tensor, ...]:
        return blocks.in_blocks(work, len(points), threads, _BLOCK)

    with blocks.torch_threads(1), torch.no_grad():
        start = _by_axis(torch.from_numpy(points))
        normal, sheet = over(lambda rows: _tangents(start, index[rows], rows))
        normal = _by_axis(normal)
        agreement = over(lambda rows: (_agreement(normal, index[rows, 1:], rows) * sheet[rows],))[0]
        current = start
        for _ in range(steps):
            pushed = over(lambda rows: (_push(current, normal, agreement, spacing, index[rows, 1:], rows),))[0]  # noqa: B023
            current = _by_axis(torch.from_numpy(within(_REACH_STDS * noise_std, points, pushed.numpy())))
        landed = over(lambda rows: (_landed(current, start, normal, sheet, index[rows], rows),))[0]
    return within(_REACH_STDS * noise_std, points, landed.numpy())


def without_low_frequencies(points: Points, moves: Points, radius: float, rng: np.random.Generator) -> Points:
    """(N, 3) moves of (N, 3) finite points less the Gaussian mean of the moves of all others within the radius.

    "Total Denoising", Iteration: noise moves neighbours against each other, shrinking moves them alike, pass after pass. Where
    there are very many neighbours, a random sample stands for them. Points without neighbours keep their move.
    """
    sums, weights = np.zeros_like(moves), np.zeros(len(moves))
    _, kept = thinned(points, points, radius, _LOW_PASS_POINTS, rng)
    for centre, other in pairs_within(points[kept], points, radius):
        squared = ((points[centre] - points[kept[other]]) ** 2).sum(axis=1)
        weight = np.where(kept[other] == centre, 0, np.exp(-squared / (2 * (_LOW_PASS_STD * radius) ** 2)))
        weights += np.bincount(centre, weight, minlength=len(moves))
        for axis in range(3):
            sums[:, axis] += np.bincount(centre, weight * moves[kept[other], axis], minlength=len(moves))
    left: Points = moves - sums / np.maximum(weights, 1e-300)[:, None]
    return left


def _by_axis(vectors: Tensor) -> Tensor:
    """(N, 3) vectors that lie axis by axis in memory."""
    return vectors.t().contiguous().t()


def _near(vectors: Tensor, index: Tensor) -> list[Tensor]:
    """x, y and z (M, K) of the vectors in (M, K) rows."""
    flat = index.reshape(-1)
    return [axis.index_select(0, flat).view(index.shape) for axis in vectors.unbind(1)]


def _dot(one: list[Tensor], other: list[Tensor]) -> Tensor:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _each(vectors: Tensor, rows: slice) -> list[Tensor]:
    """x, y and z (M, 1) of the vectors in some rows."""
    return [axis[rows, None] for axis in vectors.unbind(1)]


def _tangents(points: Tensor, index: Tensor, rows: slice) -> tuple[Tensor, Tensor]:
    """(M, 3) unit normals and (M, 1) from 0, no surface (a wire, a volume), to 1, a sheet."""
    near = _near(points, index)
    offset = torch.stack([axis - own for axis, own in zip(near, _each(points, rows), strict=True)]).permute(1, 2, 0)
    weight = torch.full(index.shape, 1 / index.shape[1], dtype=points.dtype)
    plane = planes(Edges(offset, index, weight, torch.ones(len(index), 1, dtype=points.dtype)))
    thin, middle, wide = _each(plane.shape, slice(None))
    planarity = (middle - thin) / wide.clamp_min(1e-300)
    return plane.normal, ((planarity - _SHEET[0]) / (_SHEET[1] - _SHEET[0])).clamp(0, 1)


def _agreement(normal: Tensor, index: Tensor, rows: slice) -> Tensor:
    """(M, K) squared cosines between a point's normal and its neighbours'."""
    return _dot(_near(normal, index), _each(normal, rows)).square_()


def _push(points: Tensor, normal: Tensor, strength: Tensor, spacing: Tensor, index: Tensor, rows: slice) -> Tensor:
    """(M, 3) points one step further: repulsion in the tangent plane, faded where normals disagree."""
    own, upright, reach = _each(points, rows), _each(normal, rows), spacing[rows]
    away = [mine - theirs for mine, theirs in zip(own, _near(points, index), strict=True)]
    distance = _dot(away, away).sqrt_().clamp_min_(1e-300)
    weight = (distance.reciprocal() - 1 / (_PUSHING * reach)).clamp_min_(0).mul_(strength[rows])
    push = [reach * (weight * axis).sum(1, keepdim=True) for axis in away]
    height = _dot(push, upright)
    push = [axis - height * up for axis, up in zip(push, upright, strict=True)]
    step = _STEP * reach / torch.maximum(_dot(push, push).sqrt_(), reach).clamp_min_(1e-300)
    return torch.cat([at + step * axis for at, axis in zip(own, push, strict=True)], dim=1)


def _landed(points: Tensor, start: Tensor, normal: Tensor, sheet: Tensor, index: Tensor, rows: slice) -> Tensor:
    """(M, 3) points back on the surface through the starting points: the projection network's step with plane normals alone.

    A slide along a tangent plane leaves a curved surface by κt²/2. The mean height of the neighbours over the own plane and
    the mean depth under their planes err by that much to either side, so that their half sum meets the surface.
    """
    own, theirs = _each(points, rows), _near(normal, index)
    offset = [there - mine for there, mine in zip(_near(start, index), own, strict=True)]
    squared = _dot(offset, offset)
    weight = (1 - squared / squared.amax(1, keepdim=True).clamp_min(1e-300)).square_().add_(1e-12)
    weight /= weight.sum(1, keepdim=True)
    tilted = [weight * axis for axis in theirs]
    spread = {(i, j): (tilted[i] * theirs[j]).sum(1) for i in range(3) for j in range(i, 3)}
    matrix = torch.stack([spread[min(i, j), max(i, j)] for i in range(3) for j in range(3)], dim=1).view(-1, 3, 3)
    upright = _each(smallest_eigenvector(-matrix)[1], slice(None))
    over = (weight * _dot(offset, upright)).sum(1, keepdim=True)
    depth = _dot(offset, theirs)
    share = 0.5 * sheet[rows]
    moved = [
        at + share * ((axis * depth).sum(1, keepdim=True) + over * up) for at, axis, up in zip(own, tilted, upright, strict=True)
    ]
    return torch.cat(moved, dim=1)
