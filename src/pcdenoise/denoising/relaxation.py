"""What is done about moves: relaxation toward even spacing, low frequencies taken back, the limit on any move.

Not here: moves along the normal (the network's).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch, pairs_within, thinned
from pcdenoise.cloud.scan import Points

_NEIGHBOURS = 12
_STEP = 0.35  # of the local spacing, at most, per step
_REACH_STDS = 1.0
"""How far a point may slide in all, in standard deviations of the noise: isotropic noise has displaced it by so much along
the surface too, so a clean cloud stays as it is."""
_SHEET = (0.25, 0.4)
"""Planarity, (√λ₂ - √λ₁) / √λ₃ of the covariance's ascending eigenvalues, at which points begin to slide and slide in full:
one in a hundred neighbourhoods of a surface has less than 0.4, half of those in a volume or on a wire less than 0.21."""
_BLOCK = 65_536
_LOW_PASS_STD = 0.4 * 2**0.5  # of its radius, as released
_LOW_PASS_POINTS = 256  # within its radius: more are thinned


def relax(points: Points, noise_std: float, steps: int, threads: int = -1) -> Points:
    """Evens the spacing of (N, 3) finite, distinct points on a surface; row i stays row i, N < 4 comes back as it was.

    Each step pushes a point away from neighbours that are nearer than the local mean, inside the tangent plane of its
    neighbourhood; at the end all land on the surface again. Where that is no sheet (wires, volumes, corners) points stay, or
    spreading them would change the shape.
    """
    if len(points) <= 3 or noise_std <= 0 or steps == 0:
        return points
    k = min(_NEIGHBOURS, len(points) - 1)
    reach = _REACH_STDS * noise_std
    start, current = points, points.copy()
    search = NeighbourSearch(points, threads)
    distances, index = search.knn(points, k + 1)
    normals, sheet, spacing = np.empty_like(points), np.empty(len(points)), distances[:, k] / np.sqrt(k / 2.5)
    for block in _blocks(len(points)):
        normals[block], sheet[block] = _tangents(points, index[block])
    for step in range(steps):
        if step == steps // 2:
            index = NeighbourSearch(current, threads).knn(current, k + 1)[1]
        moved = np.empty_like(current)
        for block in _blocks(len(points)):
            moved[block] = current[block] + sheet[block, None] * _push(current, normals, spacing, index, block)
        current = within(reach, start, moved)
    distances, index = search.knn(current, k)
    landed = np.empty_like(current)
    for block in _blocks(len(points)):
        landed[block] = current[block] + sheet[block, None] * _height(
            current[block], points, normals, distances[block], index[block]
        )
    return within(reach, start, landed)


def within(reach: float, start: Points, moved: Points) -> Points:
    """(N, 3) moved points, but none further than `reach` from its start."""
    slide = moved - start
    length = np.linalg.norm(slide, axis=1, keepdims=True)
    cut: Points = start + slide * (reach / np.maximum(length, max(reach, 1e-300)))
    return cut


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


def _blocks(n: int) -> list[slice]:
    return [slice(i, min(i + _BLOCK, n)) for i in range(0, n, _BLOCK)]


def _push(points: Points, normals: Points, spacing: NDArray[np.float64], index: NDArray[np.int64], block: slice) -> Points:
    """(M, 3) one step: repulsion in the tangent plane, faded where normals disagree."""
    own, normal, reach = points[block], normals[block], spacing[block]
    near = index[block, 1:]
    away = own[:, None] - points[near]
    distance = np.maximum(np.sqrt((away**2).sum(axis=2)), 1e-300)
    theirs = normals[near]
    agreement = np.einsum("mi,mki->mk", normal, theirs) ** 2
    strength = agreement * np.maximum(1 - distance / (1.6 * reach[:, None]), 0)
    push = np.einsum("mk,mki->mi", strength * reach[:, None] / distance, away)
    push -= (push * normal).sum(axis=1, keepdims=True) * normal
    length = np.linalg.norm(push, axis=1, keepdims=True)
    step: Points = _STEP * push * (reach[:, None] / np.maximum(np.maximum(length, reach[:, None]), 1e-300))
    return step


def _height(points: Points, start: Points, normals: Points, distances: NDArray[np.float64], index: NDArray[np.int64]) -> Points:
    """(M, 3) moves back onto the surface through the starting points: the projection network's step with plane normals alone.

    A slide along a tangent plane leaves a curved surface by κt²/2. The mean height of the neighbours over the own plane and
    the mean depth under their planes err by that much to either side, so that their half sum meets the surface.
    """
    weight = np.maximum(1 - (distances / np.maximum(distances[:, -1:], 1e-300)) ** 2, 0) ** 2 + 1e-12
    weight /= weight.sum(axis=1, keepdims=True)
    theirs, offset = normals[index], start[index] - points[:, None]
    own = np.linalg.eigh(np.einsum("mk,mki,mkj->mij", weight, theirs, theirs))[1][:, :, 2]
    depth = (offset * theirs).sum(axis=2)
    under = np.einsum("mk,mki->mi", weight * depth, theirs)
    over = (weight * (offset @ own[:, :, None])[:, :, 0]).sum(axis=1, keepdims=True) * own
    move: Points = 0.5 * (under + over)
    return move


def _tangents(points: Points, index: NDArray[np.int64]) -> tuple[Points, NDArray[np.float64]]:
    """(M, 3) unit normals and (M,) from 0, no surface (a wire, a volume), to 1, a sheet."""
    near = points[index] - points[index[:, 0], None]
    near -= near.mean(axis=1, keepdims=True)
    eigenvalues, frames = np.linalg.eigh(near.transpose(0, 2, 1) @ near)
    thin, middle, wide = np.sqrt(np.maximum(eigenvalues, 0)).T
    planarity = (middle - thin) / np.maximum(wide, 1e-300)
    return frames[:, :, 0], np.clip((planarity - _SHEET[0]) / (_SHEET[1] - _SHEET[0]), 0, 1)
