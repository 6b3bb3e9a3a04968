"""The supervised signal: how far predictions are from a surface that is known, exactly or as a teacher left it.

Not here: clouds (dataset.py), the loop (trainer.py).
"""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pcdenoise.denoising.pyramid import descend
from pcdenoise.learning.dataset import Surface, TrainingCloud
from pcdenoise.networks.projection import ProjectionNetwork


class NearestSurface:
    """The true surface, known by samples with normals; the target is PointCleanNet's, the point nearest to the prediction."""

    def __init__(self, surface: Surface) -> None:
        self._tree = cKDTree(surface.points, balanced_tree=False, compact_nodes=False)
        self._surface, self._normals = torch.from_numpy(surface.points).float(), torch.from_numpy(surface.normals).float()
        self._disc = surface.disc

    def error(self, points: Tensor) -> Tensor:
        """(M,) distance of (M, 3) points to the tangent disc of the nearest sample."""
        nearest = torch.from_numpy(self._tree.query(points.detach().numpy())[1])
        away, normal = points - self._surface[nearest], self._normals[nearest]
        along = (away * normal).sum(-1)
        across = (away - along[:, None] * normal).square().sum(-1).add(1e-12).sqrt()
        distance: Tensor = (along.square() + (across - self._disc).clamp_min(0).square()).add(1e-12).sqrt()
        return distance


def supervised_loss(network: ProjectionNetwork, cloud: TrainingCloud) -> tuple[Tensor, Tensor]:
    """Loss to descend and the final mean squared error, both relative to the noise of the cloud, whose surface is known."""
    assert cloud.surface is not None
    run = descend(network, *cloud.given, block_points=10**9, threads=1)
    target, loss = NearestSurface(cloud.surface), torch.zeros(())
    for points in run.earlier:
        loss = loss + 0.3 * robust(target.error(points.float()[torch.from_numpy(cloud.seed_judged)]) / cloud.scale)
    start = torch.from_numpy(cloud.seeds if cloud.raw is None else cloud.raw).float()
    final = run.last.float()
    on_surface, still = torch.from_numpy(cloud.on_surface), torch.from_numpy(cloud.judged & cloud.clutter)
    error = target.error(final[on_surface]) / cloud.scale
    loss = loss + robust(error)
    if len(cloud.covered):
        loss = loss + robust(_uncovered(cloud, final[torch.from_numpy(~cloud.clutter)]) / cloud.scale)
    if still.any():
        moved = (final - start)[still].square().sum(-1).add(1e-12).sqrt() / cloud.scale
        loss = loss + 0.5 * float(still.float().mean()) * robust(moved)
    return loss, error.square().mean()


def _uncovered(cloud: TrainingCloud, final: Tensor) -> Tensor:
    """(C,) height of surface samples over the final points next to them: what erodes corners, tips and thin parts."""
    nearest = cKDTree(final.detach().numpy()).query(cloud.covered)[1]
    away = torch.from_numpy(cloud.covered).float() - final[torch.from_numpy(nearest)]
    height: Tensor = (away * torch.from_numpy(cloud.covered_normals).float()).sum(-1).abs()
    return height


def robust(error: Tensor) -> Tensor:
    """Squares for what is scored, magnitudes for edges and small errors, a cap on gross ones."""
    error = torch.where(error > 3, 3 + torch.log1p((error - 3).clamp_min(0)), error)
    return error.square().mean() + 0.3 * error.mean()
