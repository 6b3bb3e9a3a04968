"""The training loop: clouds in, a network out. Not here: clouds (dataset.py), targets (priors.py), model folders (networks.store)."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pcdenoise.learning.dataset import TrainingCloud
from pcdenoise.denoising.pyramid import descend
from pcdenoise.networks.projection import ProjectionNetwork


class NearestSurface:
    """Distance vectors to the true surface, known by samples with normals: PointCleanNet's target, the surface point nearest to the prediction."""

    def __init__(self, cloud: TrainingCloud) -> None:
        self._tree = cKDTree(cloud.surface, balanced_tree=False, compact_nodes=False)
        self._surface, self._normals = torch.from_numpy(cloud.surface).float(), torch.from_numpy(cloud.normals).float()
        self._disc = 2.0 * math.sqrt(6.0 / 200_000)

    def error(self, points: Tensor) -> Tensor:
        """(M,) distance of (M, 3) points to the tangent disc of the nearest sample."""
        nearest = torch.from_numpy(self._tree.query(points.detach().numpy())[1])
        away, normal = points - self._surface[nearest], self._normals[nearest]
        along = (away * normal).sum(-1)
        across = (away - along[:, None] * normal).square().sum(-1).add(1e-12).sqrt()
        return (along.square() + (across - self._disc).clamp_min(0).square()).add(1e-12).sqrt()


def supervised_loss(network: ProjectionNetwork, cloud: TrainingCloud) -> tuple[Tensor, Tensor]:
    """Loss to descend and the final mean squared error, both relative to the noise of the cloud."""
    run = descend(network, cloud.seeds, cloud.count, cloud.raw, cloud.noise, block_points=10**9, threads=1)
    steps = [points.float() for points in run.seeds]
    target, loss = NearestSurface(cloud), torch.zeros(())
    for points in steps if run.landed is not None else steps[:-1]:
        loss = loss + 0.3 * _robust(target.error(points[torch.from_numpy(cloud.seed_judged)]) / cloud.scale)
    start = torch.from_numpy(cloud.seeds if cloud.raw is None else cloud.raw).float()
    final = steps[-1] if run.landed is None else run.landed.float()
    on_surface, still = torch.from_numpy(cloud.judged & ~cloud.clutter), torch.from_numpy(cloud.judged & cloud.clutter)
    error = target.error(final[on_surface]) / cloud.scale
    loss = loss + _robust(error)
    if still.any():
        moved = (final - start)[still].square().sum(-1).add(1e-12).sqrt() / cloud.scale
        loss = loss + 0.5 * float(still.float().mean()) * _robust(moved)
    return loss, error.square().mean()


def _robust(error: Tensor) -> Tensor:
    """Squares for what is scored, magnitudes for edges and small errors, a cap on gross ones."""
    error = torch.where(error > 3, 3 + torch.log1p((error - 3).clamp_min(0)), error)
    return error.square().mean() + 0.3 * error.mean()


def fit(
    network: ProjectionNetwork,
    clouds: Iterable[TrainingCloud],
    budget_s: float,
    learning_rate: float,
    checkpoint: Callable[[ProjectionNetwork, int], None],
    log: Callable[[dict[str, float]], None],
) -> ProjectionNetwork:
    optimiser = torch.optim.AdamW(network.parameters(), lr=learning_rate, betas=(0.9, 0.98), weight_decay=1e-4)
    average = copy.deepcopy(network)
    began, losses, finals, n_points = time.monotonic(), [], [], 0
    for step, cloud in enumerate(clouds):
        passed = (time.monotonic() - began) / budget_s
        if passed >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = learning_rate * min(1, (step + 1) / 100) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * passed)))
        loss, final = supervised_loss(network, cloud)
        if not torch.isfinite(loss) or not (cloud.judged & ~cloud.clutter).any():
            continue
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        keep = min(0.998, step / (step + 10))
        with torch.no_grad():
            for slow, fast in zip(average.parameters(), network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)
        losses.append(float(loss.detach()))
        finals.append(float(final.detach()))
        n_points += len(cloud.seeds) + len(cloud.judged)
        if step % 100 == 99:
            log({"step": step + 1, "loss": float(np.mean(losses)), "final": float(np.mean(finals)), "points": n_points, "seconds": time.monotonic() - began})
            losses, finals = [], []
            checkpoint(average, step + 1)
    return average
