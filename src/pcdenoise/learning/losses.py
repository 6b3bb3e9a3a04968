"""Losses of unsupervised training, as pure functions of predictions. Not here: where targets come from (priors.py), optimisers.

Lengths are in the network's frame, where the bounding-box diagonal is 1.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pcdenoise.cloud.neighbours import Indices, pairs_within
from pcdenoise.cloud.scan import Points


def annealed_exponent(progress: float, lowest: float = 1e-8) -> float:
    """Exponent γ of the loss at a share of training from 0 to 1: from 2, whose minimum is the mean, to 0, the mode."""
    return max(2 * (1 - progress), lowest)


def annealed_l0(prediction: Tensor, target: Tensor, exponent: float, *, epsilon: float = 1e-8, per_axis: bool = False) -> Tensor:
    """Mean over (N, 3) points of (‖f - q‖ + ε)^γ, after Lehtinen et al., "Noise2Noise" (2018), section 3.2.

    Rotating predictions and targets together leaves the value as it is. `per_axis` sums (|f - q| + ε)^γ over the axes, as the
    released code does: equal for γ = 2 (up to ε), but below 2 an error along an axis costs less than a slanted one of the same
    length. For γ < 1 the slope grows as (‖f - q‖ + ε)^(γ - 1) where a prediction meets its target: raise ε, say to a thousandth
    of the patch radius, if single points should not dominate a step.
    """
    error = prediction - target
    if per_axis:
        return (error.abs() + epsilon).pow(exponent).sum(dim=1).mean()
    length = (error.square().sum(dim=1) + torch.finfo(error.dtype).tiny).sqrt()
    return (length + epsilon).pow(exponent).mean()


def anti_clustering(prediction: Tensor, points: Points, radius: float, *, released_exponent: float | None = None) -> Tensor:
    """Mean over points of the distance from a prediction to the farthest prediction of its patch; keeps samples equidistant.

    "Total Denoising", Iteration. The patch of (N, 3) noisy point i are the points within the radius of it; gradients reach both
    ends of each distance. With the loss's current exponent γ, `released_exponent` takes squared distances times r^(γ - 2), as the
    released code does to keep the two terms in balance. Invariant to rotation.
    """
    farthest = torch.from_numpy(_farthest(prediction.detach().cpu().double().numpy(), points, radius))
    apart = (prediction - prediction[farthest.to(prediction.device)]).square().sum(dim=1)
    if released_exponent is not None:
        balanced: Tensor = apart.mean() * float(radius ** (released_exponent - 2))
        return balanced
    return (apart + torch.finfo(apart.dtype).tiny).sqrt().mean()


def _farthest(prediction: Points, points: Points, radius: float) -> Indices:
    """(N,) for each point the row within the radius whose prediction is farthest from its own."""
    rows = np.arange(len(points))
    for centre, other in pairs_within(points, points, radius):
        apart = ((prediction[centre] - prediction[other]) ** 2).sum(axis=1)
        order = np.lexsort((apart, centre))
        last = np.flatnonzero(np.diff(centre[order], append=-1))
        rows[centre[order[last]]] = other[order[last]]
    return rows
