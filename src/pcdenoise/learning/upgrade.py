"""Any torch denoiser that expects clean targets, trained from noisy clouds alone, without a change to its code.

Here: noisy clouds and samples of the prior that pass for clean ones. Not here: any denoiser, any loop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from pcdenoise.cloud.scan import Points
from pcdenoise.learning.priors import Prior

PATCH_SHARE = 0.05
"""Radius within which a clean point is looked for, as a share of the bounding-box diagonal, unless a prior names its own."""

Colours = NDArray[np.float64]


def pseudo_clean(
    points: Points, colours: Colours | None = None, *, prior: Prior | None = None, rng: np.random.Generator
) -> Points:
    """(N, 3) points that may pass for clean ones of (N, 3) finite noisy points: row i for row i, another draw at every call.

    "Total Denoising", Upgrading: resample by the prior, pretend that it is the clean cloud. colours (N, 3), from 0 to 1, make
    neighbours of another colour unlikely. A prior's radius is in the points' unit; by default it is 5 % of the diagonal.
    Right for losses that compare row with row (L2, L1, ...). A loss that looks for the nearest clean point would find the noisy
    point itself, since that is another one's sample.
    """
    return (prior or prior_for(points)).targets(points, colours, rng)


def prior_for(points: Points, radius: float | None = None) -> Prior:
    """The default prior for (N, 3) points: Gaussian, with that radius or 5 % of their bounding box's diagonal."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    return Prior((PATCH_SHARE * diagonal or 1.0) if radius is None else radius)


class PseudoCleanPairs(IterableDataset[tuple[Tensor, Tensor]]):
    """Endless epochs of (noisy, pseudo-clean) float32 tensors, both (N, 3): one pair per cloud and epoch, sampled anew each time.

    Give it to a DataLoader in place of the data set that a supervised denoiser learns from. Clouds come in an order of their own
    in every epoch; `centred` moves each to the middle of its bounding box and scales its diagonal to one. One seed, one series,
    whatever the number of workers; with `epochs` it ends.
    """

    def __init__(
        self,
        clouds: Sequence[Points] | Sequence[tuple[Points, Colours | None]],
        *,
        prior: Prior | None = None,
        epochs: int | None = None,
        centred: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__()
        pairs = [cloud if isinstance(cloud, tuple) else (cloud, None) for cloud in clouds]
        self.clouds = [(_centred(points) if centred else points, colours) for points, colours in pairs]
        self.prior, self.epochs, self.seed = prior, epochs, seed

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        worker = get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        epoch = 0
        while self.clouds and (self.epochs is None or epoch < self.epochs):
            order = np.random.default_rng([self.seed, epoch]).permutation(len(self.clouds))
            for place in range(first, len(order), step):
                points, colours = self.clouds[order[place]]
                clean = pseudo_clean(points, colours, prior=self.prior, rng=np.random.default_rng([self.seed, epoch, place]))
                yield torch.from_numpy(points).float(), torch.from_numpy(clean).float()
            epoch += 1


def _centred(points: Points) -> Points:
    low, high = points.min(axis=0), points.max(axis=0)
    centred: Points = (points - (low + high) / 2) / (float(np.linalg.norm(high - low)) or 1.0)
    return centred
