"""The split signal: what is predicted from some noisy points is held to others, which the network has not seen.

Here: the loss and the judgement of weights by it. Not here: which points are held out (dataset.from_noisy).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pcdenoise.cloud.blocks import each_block
from pcdenoise.cloud.neighbours import NeighbourSearch, principal_axes, spatial_order
from pcdenoise.denoising.pyramid import descend
from pcdenoise.learning.dataset import Array, Mask, TrainingCloud
from pcdenoise.learning.supervised import robust
from pcdenoise.networks.projection import ProjectionNetwork

_POINTS = 64
_REACH_STDS = 4.5
"""The cylinder is as wide as the ball in which the noise shows a surface (cloud.noise_level), and never holds fewer points."""
_HEIGHT_STDS = 4.0
_FIT_PARAMETERS = 6
_BLOCK = 256  # places: what is known of their neighbours fits the cache


def split_loss(network: ProjectionNetwork, cloud: TrainingCloud) -> tuple[Tensor, Tensor]:
    """Loss to descend and the mean squared height over held-out points, both relative to the noise.

    The held-out points around a prediction, in a cylinder wide along the normal and narrow along the surface, are fitted by a
    quadric height field; the loss is the prediction's height over it. The noise of the fit is independent of the prediction, so
    that the expected loss is the squared error plus the fit's variance, whatever the network does; the quadric takes curvature
    off, and what is left of it is the -Hσ² of every fit to points that also err along the surface.
    """
    run, target = descend(network, *cloud.given, block_points=10**9, threads=1), HeldOut(cloud.held_out, cloud.noise)
    loss = torch.zeros(())
    for points in run.earlier:
        height = target.known_heights(points.float(), cloud.seed_judged)
        if len(height):
            loss = loss + 0.3 * robust(height.abs() / cloud.scale)
    height = target.known_heights(run.last.float(), cloud.on_surface)
    if not len(height):
        return torch.full((), torch.nan), torch.full((), torch.nan)
    error = height.abs() / cloud.scale
    return loss + robust(error), error.square().mean()


def held_out_error(network: ProjectionNetwork, cloud: TrainingCloud, threads: int) -> float:
    """The error of `split_loss` on a cloud, for comparing weights without truth; NaN where too little is held out."""
    with torch.no_grad():
        last = descend(network, *cloud.given).last
    height = HeldOut(cloud.held_out, cloud.noise, threads).known_heights(last.float(), cloud.on_surface)
    return float((height / cloud.scale).square().mean())


class HeldOut:
    """Heights of points over the quadrics through (H, 3) held-out points near them, under noise of standard deviation `noise`."""

    def __init__(self, points: Array, noise: float, threads: int = 1) -> None:
        self._points, self._noise, self._threads = points[spatial_order(points)], noise, threads
        self._search = NeighbourSearch(self._points, threads) if len(points) >= _POINTS else None

    def known_heights(self, points: Tensor, judged: Mask) -> Tensor:
        """(K,) heights, with gradient, of those of the judged (M, 3) points around which the fit holds."""
        height, known = self.heights(points[torch.from_numpy(judged)])
        return height[torch.from_numpy(known)]

    def heights(self, points: Tensor) -> tuple[Tensor, Mask]:
        """(M,) signed heights of (M, 3) points, with gradient, and (M,) where enough points lie around and agree on a surface."""
        place = points.detach().double().numpy()
        foot, normal, known = self._feet(place)
        height: Tensor = ((points - torch.from_numpy(foot).float()) * torch.from_numpy(normal).float()).sum(-1)
        return height, known

    def _feet(self, place: Array) -> tuple[Array, Array, Mask]:
        """(M, 3) points of the fitted surface over or under each place, (M, 3) normals, (M,) where the fit holds."""
        foot, normal, known = place.copy(), np.zeros_like(place), np.zeros(len(place), dtype=bool)
        if self._search is not None and len(place):
            distances, index = self._search.knn(place, 4 * _POINTS)

            def fit(rows: slice) -> None:
                foot[rows], normal[rows], known[rows] = self._fitted(place[rows], self._points[index[rows]], distances[rows])

            each_block(fit, len(place), self._threads, _BLOCK)
        return foot, normal, known

    def _fitted(self, place: Array, near: Array, distances: Array) -> tuple[Array, Array, Mask]:
        """The same from (M, K, 3) points around and their (M, K) distances, in ascending order."""
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
