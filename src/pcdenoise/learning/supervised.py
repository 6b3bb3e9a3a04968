"""The supervised signal: how far predictions are from a surface that is known exactly.

Not here: clouds (dataset.py), the loop (trainer.py).
"""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pcdenoise.denoising.pyramid import descend
from pcdenoise.learning.dataset import N_DENSE, TrainingCloud
from pcdenoise.networks.projection import ProjectionNetwork

_DISC = 2.0 * (6.0 / N_DENSE) ** 0.5
"""Radius of the tangent disc that a surface sample stands for: twice the samples' distance on a surface in the unit sphere."""


class NearestSurface:
    """The true surface, known by samples with normals; the target is PointCleanNet's, the point nearest to the prediction."""

    def __init__(self, cloud: TrainingCloud) -> None:
        self._tree = cKDTree(cloud.surface, balanced_tree=False, compact_nodes=False)
        self._surface, self._normals = torch.from_numpy(cloud.surface).float(), torch.from_numpy(cloud.normals).float()

    def error(self, points: Tensor) -> Tensor:
        """(M,) distance of (M, 3) points to the tangent disc of the nearest sample."""
        nearest = torch.from_numpy(self._tree.query(points.detach().numpy())[1])
        away, normal = points - self._surface[nearest], self._normals[nearest]
        along = (away * normal).sum(-1)
        across = (away - along[:, None] * normal).square().sum(-1).add(1e-12).sqrt()
        distance: Tensor = (along.square() + (across - _DISC).clamp_min(0).square()).add(1e-12).sqrt()
        return distance


def supervised_loss(network: ProjectionNetwork, cloud: TrainingCloud) -> tuple[Tensor, Tensor]:
    """Loss to descend and the final mean squared error, both relative to the noise of the cloud."""
    run = descend(network, cloud.seeds, cloud.count, cloud.raw, cloud.noise, block_points=10**9, threads=1)
    steps = [points.float() for points in run.seeds]
    target, loss = NearestSurface(cloud), torch.zeros(())
    for points in steps if run.landed is not None else steps[:-1]:
        loss = loss + 0.3 * _robust(target.error(points[torch.from_numpy(cloud.seed_judged)]) / cloud.scale)
    start = torch.from_numpy(cloud.seeds if cloud.raw is None else cloud.raw).float()
    final = steps[-1] if run.landed is None else run.landed.float()
    on_surface, still = torch.from_numpy(cloud.on_surface), torch.from_numpy(cloud.judged & cloud.clutter)
    error = target.error(final[on_surface]) / cloud.scale
    loss = loss + _robust(error)
    if len(cloud.covered):
        loss = loss + _robust(_uncovered(cloud, final[torch.from_numpy(~cloud.clutter)]) / cloud.scale)
    if still.any():
        moved = (final - start)[still].square().sum(-1).add(1e-12).sqrt() / cloud.scale
        loss = loss + 0.5 * float(still.float().mean()) * _robust(moved)
    return loss, error.square().mean()


def _uncovered(cloud: TrainingCloud, final: Tensor) -> Tensor:
    """(C,) height of surface samples over the final points next to them: what erodes corners, tips and thin parts."""
    nearest = cKDTree(final.detach().numpy()).query(cloud.covered)[1]
    away = torch.from_numpy(cloud.covered).float() - final[torch.from_numpy(nearest)]
    height: Tensor = (away * torch.from_numpy(cloud.covered_normals).float()).sum(-1).abs()
    return height


def _robust(error: Tensor) -> Tensor:
    """Squares for what is scored, magnitudes for edges and small errors, a cap on gross ones."""
    error = torch.where(error > 3, 3 + torch.log1p((error - 3).clamp_min(0)), error)
    return error.square().mean() + 0.3 * error.mean()
