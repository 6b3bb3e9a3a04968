"""The signal of "Total Denoising": predictions against neighbours drawn by the prior, or against clean points where known.

Not here: how targets are drawn (priors.py), the losses' formulas (losses.py), the loop (trainer.py).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pcdenoise.denoising.pyramid import descend
from pcdenoise.learning.losses import annealed_exponent, annealed_l0, anti_clustering
from pcdenoise.learning.scans import PATCH_RADIUS, ScanCloud
from pcdenoise.networks.mcconv import MCConvNetwork
from pcdenoise.networks.projection import ProjectionNetwork
from pcdenoise.networks.store import Network

_LOWEST_EXPONENT = 0.1  # below, single points that meet their target dominate a step
_EPSILON = 1e-3 * PATCH_RADIUS


def total_loss(
    network: Network, cloud: ScanCloud, progress: float, *, regulariser: float, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Loss to descend and the mean squared distance to the targets over the squared noise.

    The exponent falls from 2 to 0 as `progress` goes from 0 to 1 ("Total Denoising", Training). `regulariser`: share of the
    anti-clustering term, 0.1 in the released code. Supervised clouds have the clean point nearest to the prediction as target
    (PointCleanNet), at the same loss.
    """
    exponent = annealed_exponent(progress, _LOWEST_EXPONENT)
    predicted = predict(network, cloud, rng)
    if cloud.clean is None:
        assert cloud.targets is not None
        target = torch.from_numpy(cloud.targets).float()
    else:
        nearest = cKDTree(cloud.clean).query(predicted.detach().numpy())[1]
        target = torch.from_numpy(cloud.clean[nearest]).float()
    loss = (1 - regulariser) * annealed_l0(predicted, target, exponent, epsilon=_EPSILON)
    if regulariser > 0:
        clustered = anti_clustering(predicted, cloud.points[cloud.rows], PATCH_RADIUS, released_exponent=exponent)
        loss = loss + regulariser * clustered
    error = (predicted.detach() - target).square().sum(dim=1).mean() / max(cloud.noise, 1e-6) ** 2
    return loss, error


def predict(network: Network, cloud: ScanCloud, rng: np.random.Generator) -> Tensor:
    """(Q, 3) where the network puts the judged points, with gradients to its weights."""
    if isinstance(network, MCConvNetwork):
        points = torch.from_numpy(cloud.points).float()
        predicted: Tensor = (points + network(points, rng))[torch.from_numpy(cloud.rows)]
        return predicted
    return _projected(network, cloud)


def _projected(network: ProjectionNetwork, cloud: ScanCloud) -> Tensor:
    if cloud.seeds is None:
        run = descend(network, cloud.points, None, None, cloud.noise, block_points=10**9, threads=1)
        return run.seeds[-1].float()[torch.from_numpy(cloud.rows)]
    seeds, raw = cloud.seeds, cloud.points[cloud.rows]
    run = descend(network, seeds.points, seeds.count, raw, cloud.noise, block_points=10**9, threads=1)
    assert run.landed is not None
    return run.landed.float()
