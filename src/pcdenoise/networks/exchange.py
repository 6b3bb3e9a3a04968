"""The costliest step of the projection network, messages along all edges, with its derivative by hand.

The same values as layer by layer through autograd, at a third of the time of a training step: work goes in cache-sized parts,
in place, and no intermediate result but the two that the derivative needs is written to memory. Not here: what the layers mean
(projection.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_ROWS = 256  # 24 edges of 32 channels each: 0.8 MB a tensor


class Pooled(NamedTuple):
    """message (M, K, C) of every edge; mean and most (M, C): their weighted mean and maximum over the edges of a point."""

    message: Tensor
    mean: Tensor
    most: Tensor


def exchange(
    features: Tensor,
    own: Tensor,
    heard: Tensor,
    source: Tensor,
    weight: Tensor,
    first: tuple[Tensor, Tensor],
    second: tuple[Tensor, Tensor],
) -> Pooled:
    """relu(W₂ relu(W₁ e + own + heard) + b₂) for every edge, pooled over the edges of a point.

    features (M, K, F) of the edges; own (M, C); heard (N, C), read at source (M, K); weight (M, K) of sum one; first (C, F) and
    (C,), second (C, C) and (C,): the layers' weights and biases. No gradient reaches `weight`.
    """
    learning = torch.is_grad_enabled()  # not known inside
    return Pooled(*_Exchange.apply(learning, features, own, heard, source, weight, *first, *second))  # type: ignore[no-untyped-call]


def _parts(n: int) -> Iterator[slice]:
    return (slice(start, min(start + _ROWS, n)) for start in range(0, n, _ROWS))


class _Exchange(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, learning: bool, features: Tensor, own: Tensor, heard: Tensor, source: Tensor, weight: Tensor,
        weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        (m, k, _), c = features.shape, own.shape[1]
        hidden, message = own.new_empty(m if learning else min(m, _ROWS), k, c), own.new_empty(m, k, c)
        mean, most = own.new_empty(m, c), own.new_empty(m, c)
        share = weight / weight.amax(-1, keepdim=True).clamp_min(1e-12)
        for part in _parts(m):
            at_edges = hidden[part] if learning else hidden[: part.stop - part.start]
            before, after = at_edges.view(-1, c), message[part].view(-1, c)
            torch.mm(features[part].flatten(0, 1), weight1.t(), out=before)
            at_edges.add_((own[part] + bias1)[:, None])
            before.add_(heard.index_select(0, source[part].flatten())).relu_()
            torch.mm(before, weight2.t(), out=after)
            after.add_(bias2).relu_()
            mean[part] = torch.bmm(weight[part, None], message[part])[:, 0]
            most[part] = (message[part] * share[part, :, None]).amax(1)
        if learning:
            ctx.save_for_backward(features, source, weight, share, weight1, weight2, hidden, message, most)
        ctx.n_sources = len(heard)
        ctx.set_materialize_grads(False)
        return message, mean, most

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, of_message: Tensor | None, of_mean: Tensor | None, of_most: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        features, source, weight, share, weight1, weight2, hidden, message, most = ctx.saved_tensors
        (m, k, f), c = features.shape, most.shape[1]
        of_weight1, of_weight2 = torch.zeros_like(weight1), torch.zeros_like(weight2)
        of_bias2 = weight1.new_zeros(c)
        of_own, of_heard = most.new_empty(m, c), most.new_zeros(ctx.n_sources, c)
        of_features = torch.empty_like(features) if ctx.needs_input_grad[1] else None
        for part in _parts(m):
            before, after = hidden[part].view(-1, c), message[part].view(-1, c)
            relative = share[part, :, None]
            gradient = torch.zeros_like(message[part]) if of_message is None else of_message[part].clone()
            if of_most is not None:
                gradient += (message[part] * relative == most[part, None]) * (of_most[part, None] * relative)
            if of_mean is not None:
                gradient += weight[part, :, None] * of_mean[part, None]
            flat = torch.ops.aten.threshold_backward(gradient.view(-1, c), after, 0)
            of_weight2.addmm_(flat.t(), before)
            of_bias2 += flat.sum(0)
            flat = torch.ops.aten.threshold_backward(flat @ weight2, before, 0)
            of_weight1.addmm_(flat.t(), features[part].flatten(0, 1))
            of_own[part] = flat.view(-1, k, c).sum(1)
            of_heard.index_add_(0, source[part].flatten(), flat)
            if of_features is not None:
                torch.mm(flat, weight1, out=of_features[part].view(-1, f))
        return None, of_features, of_own, of_heard, None, None, of_weight1, of_own.sum(0), of_weight2, of_bias2
