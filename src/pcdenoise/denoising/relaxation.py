"""Tangential relaxation: points slide along the surface toward even spacing, within what the noise can have displaced them.

Not here: moves along the normal (the network's).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import NeighbourSearch
from pcdenoise.cloud.scan import Points

_NEIGHBOURS = 12
_STEP = 0.35  # of the local spacing, at most, per step
_REACH_STDS = 2.0
"""How far a point may slide in all, in standard deviations of the noise: isotropic noise has displaced it by so much along
the surface too, so a clean cloud stays as it is."""
_BLOCK = 65_536


def relax(points: Points, noise_std: float, steps: int, threads: int = -1) -> Points:
    """Evens the spacing of (N, 3) finite, distinct points on a surface; row i stays row i, N < 4 comes back as it was.

    Each step pushes a point away from neighbours that are nearer than the local mean, inside the tangent plane of its
    neighbourhood, and then lands it on its neighbours' planes again, so that curved surfaces keep their shape.
    """
    if len(points) <= 3 or noise_std <= 0 or steps == 0:
        return points
    k = min(_NEIGHBOURS, len(points) - 1)
    reach = _REACH_STDS * noise_std
    start, current = points, points.copy()
    distances, index = NeighbourSearch(points, threads).knn(points, k + 1)
    normals, spacing = np.empty_like(points), distances[:, k] / np.sqrt(k / 2.5)
    for block in _blocks(len(points)):
        normals[block] = _normals(points, index[block])
    for step in range(steps):
        if step == steps // 2:
            index = NeighbourSearch(current, threads).knn(current, k + 1)[1]
        moved = np.empty_like(current)
        for block in _blocks(len(points)):
            moved[block] = current[block] + _push(current, normals, spacing, index, block)
        slide = moved - start
        length = np.linalg.norm(slide, axis=1, keepdims=True)
        current = start + slide * np.minimum(1, reach / np.maximum(length, 1e-300))
    return current


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
    step: Points = _STEP * push * np.minimum(1, reach[:, None] / np.maximum(length, 1e-300))
    return step


def _normals(points: Points, index: NDArray[np.int64]) -> Points:
    near = points[index] - points[index[:, 0], None]
    near -= near.mean(axis=1, keepdims=True)
    normals: Points = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0]
    return normals
