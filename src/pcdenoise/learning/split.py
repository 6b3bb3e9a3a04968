"""The split signal: what is predicted from some noisy points is held to others, which the network has not seen.

Here: the loss and the judgement of weights by it. Not here: which points are held out (dataset.from_noisy).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pcdenoise.cloud.neighbours import principal_axes
from pcdenoise.denoising.pyramid import descend
from pcdenoise.learning.dataset import Array, Mask, TrainingCloud
from pcdenoise.learning.supervised import robust
from pcdenoise.networks.projection import ProjectionNetwork

_POINTS = 64
_REACH_STDS = 4.5
"""The cylinder is as wide as the ball in which the noise shows a surface (cloud.noise_level), and never holds fewer points."""
_HEIGHT_STDS = 4.0
_FIT_PARAMETERS = 6


def split_loss(network: ProjectionNetwork, cloud: TrainingCloud) -> tuple[Tensor, Tensor]:
    """Loss to descend and the mean squared height over held-out points, both relative to the noise.

    The held-out points around a prediction, in a cylinder wide along the normal and narrow along the surface, are fitted by a
    quadric height field; the loss is the prediction's height over it. The noise of the fit is independent of the prediction, so
    that the expected loss is the squared error plus the fit's variance, whatever the network does; the quadric takes curvature
    off, and what is left of it is the -Hσ² of every fit to points that also err along the surface.
    """
    run = descend(network, *cloud.given, block_points=10**9, threads=1)
    steps = [points.float() for points in run.seeds]
    final = steps[-1] if run.landed is None else run.landed.float()
    target, loss = HeldOut(cloud.held_out, cloud.noise), torch.zeros(())
    for points in steps if run.landed is not None else steps[:-1]:
        height, known = target.heights(points[torch.from_numpy(cloud.seed_judged)])
        if known.any():
            loss = loss + 0.3 * robust(height[known].abs() / cloud.scale)
    height, known = target.heights(final[torch.from_numpy(cloud.on_surface)])
    if not known.any():
        return torch.full((), torch.nan), torch.full((), torch.nan)
    error = height[known].abs() / cloud.scale
    return loss + robust(error), error.square().mean()


def held_out_error(network: ProjectionNetwork, cloud: TrainingCloud) -> float:
    """The error of `split_loss` on a cloud, for comparing weights without truth; NaN where too little is held out."""
    with torch.no_grad():
        return float(split_loss(network, cloud)[1])


class HeldOut:
    """Heights of points over the quadrics through (H, 3) held-out points near them, under noise of standard deviation `noise`."""

    def __init__(self, points: Array, noise: float) -> None:
        self._points, self._noise = points, noise
        self._tree = cKDTree(points)

    def heights(self, points: Tensor) -> tuple[Tensor, Mask]:
        """(M,) signed heights of (M, 3) points, with gradient, and (M,) where enough points lie around and agree on a surface."""
        place = points.detach().double().numpy()
        foot, normal, known = self._feet(place)
        height: Tensor = ((points - torch.from_numpy(foot).float()) * torch.from_numpy(normal).float()).sum(-1)
        return height, known

    def _feet(self, place: Array) -> tuple[Array, Array, Mask]:
        """(M, 3) points of the fitted surface over or under each place, (M, 3) normals, (M,) where the fit holds."""
        if len(place) == 0 or len(self._points) < _POINTS:
            return place, np.zeros_like(place), np.zeros(len(place), dtype=bool)
        distances, index = self._tree.query(place, k=min(4 * _POINTS, len(self._points)))
        near = self._points[index]
        wide = np.maximum(distances[:, _POINTS - 1], _REACH_STDS * self._noise)
        inside = distances <= wide[:, None]
        centre = (near * inside[:, :, None]).sum(axis=1) / inside.sum(axis=1)[:, None]
        spread = (near - centre[:, None]) * inside[:, :, None]
        frames = principal_axes(spread)
        height, u, v = np.moveaxis((near - place[:, None]) @ frames, 2, 0)
        across = (u**2 + v**2) / np.minimum(wide, distances[:, -1])[:, None] ** 2
        # The cylinder: near along the surface, and up or down as far as noise goes around the middle of what is there.
        flat = across < 0.6
        middle = np.nanmedian(np.where(flat & inside, height, np.nan), axis=1, keepdims=True)
        flat &= np.abs(height - middle) < _HEIGHT_STDS * self._noise + 0.3 * wide[:, None]
        weight = flat * (1 - across / 0.6).clip(0)
        scale = wide[:, None]
        design = np.stack([np.ones_like(u), u / scale, v / scale, (u / scale) ** 2, u * v / scale**2, (v / scale) ** 2], axis=-1)
        weighted = (design * weight[:, :, None]).transpose(0, 2, 1)
        fit = np.linalg.solve(weighted @ design + 1e-9 * np.eye(_FIT_PARAMETERS), weighted @ height[:, :, None])
        left = np.sqrt((weight * (height - (design @ fit)[:, :, 0]) ** 2).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9))
        known = (flat.sum(axis=1) >= 3 * _FIT_PARAMETERS) & (left < 2 * self._noise + 1e-9)
        slope = fit[:, 1:3, 0] / scale
        local = np.stack([np.ones(len(place)), -slope[:, 0], -slope[:, 1]], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        normal = np.einsum("mij,mj->mi", frames, local)
        return place + fit[:, 0] * frames[:, :, 0], normal, known
