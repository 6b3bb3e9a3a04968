"""The costliest step of the projection network, messages along all edges, with its derivative by hand.

Compiled code does it at a fifth of the time that torch takes layer by layer through autograd (exchange.c), where it was built and
for the sizes that it is made for. Elsewhere torch does it in cache-sized parts, in place, and writes no intermediate result to
memory but the two that the derivative needs. Not here: what the layers mean (projection.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pcdenoise.cloud.blocks import each_block
from pcdenoise.networks.fused import MESSAGES, MOST_NEIGHBOURS

try:
    from pcdenoise.networks import _exchange
except ImportError:
    IS_BUILT = False
else:
    IS_BUILT = True

_N_FEATURES = 8  # of an edge, in the compiled code
_ROWS = 256  # 24 edges of 32 channels each: 0.8 MB a tensor


class Pooled(NamedTuple):
    """mean and most (M, C): weighted mean and maximum of the messages over the edges of a point; known (3, M, K): what the head
    makes of each message, None without one."""

    mean: Tensor
    most: Tensor
    known: Tensor | None


Layer = tuple[Tensor, Tensor]
"""Weights (outputs, inputs) and biases (outputs,)."""


def exchange(
    features: Tensor, own: Tensor, heard: Tensor, source: Tensor, weight: Tensor, first: Layer, second: Layer, head: Layer | None
) -> Pooled:
    """Messages relu(W₂ relu(W₁ e + own + heard) + b₂) along every edge, pooled over the edges of a point.

    features (M, K, F) of the edges; own (M, C); heard (N, C), read at source (M, K); weight (M, K) of sum one; first (C, F),
    second (C, C) and head (3, C) the layers. No gradient reaches `weight`.
    """
    learning = torch.is_grad_enabled()  # not known inside
    made = _Compiled if _is_compiled(features, own) else _InTorch
    nothing = (own.new_zeros(0, own.shape[1]), own.new_zeros(0))
    mean, most, known = made.apply(  # type: ignore[no-untyped-call]
        learning, features, own, heard, source, weight, *first, *second, *(head or nothing)
    )
    return Pooled(mean, most, known if head is not None else None)


def _is_compiled(features: Tensor, own: Tensor) -> bool:
    _, k, f = features.shape
    fits = own.shape[1] in MESSAGES and f == _N_FEATURES and k <= MOST_NEIGHBOURS
    return IS_BUILT and fits and features.dtype == own.dtype == torch.float32


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, _learning: bool, features: Tensor, own: Tensor, heard: Tensor, source: Tensor, weight: Tensor,
        weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor, head: Tensor, head_bias: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        (m, k, _), c = features.shape, own.shape[1]
        layers = [weight1.t(), bias1, weight2.t(), bias2, weight2, head, head_bias]
        given = [tensor.contiguous() for tensor in (features.permute(2, 0, 1), own, heard, source.int(), weight, *layers)]
        made = [own.new_empty(m, c), own.new_empty(m, c), own.new_empty(len(head), m, k)]
        _spread(lambda rows, _part: _exchange.forward(_given(given, made), rows.start, rows.stop), m)
        ctx.save_for_backward(*given)
        ctx.set_materialize_grads(False)
        return made[0], made[1], made[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *of_made: Tensor | None) -> tuple[Tensor | None, ...]:
        given, made = ctx.saved_tensors, (None, None, None)  # which are made anew
        features, own, heard, head, head_bias = given[0], given[1], given[2], given[10], given[11]
        (f, m, _), (n, c), n_parts = features.shape, heard.shape, torch.get_num_threads()
        of_features = torch.empty_like(features) if ctx.needs_input_grad[1] else None
        of_own = torch.empty_like(own)
        sums = [own.new_zeros(n_parts, *shape) for shape in ((n, c), (f, c), (c, c), (c,), head.shape, head_bias.shape)]
        of_made = tuple(None if of is None or not of.numel() else of.contiguous() for of in of_made)

        def work(rows: slice, part: int) -> None:
            to = [*of_made, of_features, of_own, *(some[part] for some in sums)]
            _exchange.backward(_given(given, made), rows.start, rows.stop, *map(_at, to))

        _spread(work, m)
        back = None if of_features is None else of_features.permute(1, 2, 0)
        of_heard, of_first, of_second, of_bias, of_head, of_head_bias = (some.sum(0) for some in sums)
        return None, back, of_own, of_heard, None, None, of_first.t(), of_own.sum(0), of_second, of_bias, of_head, of_head_bias


def _spread(work: Callable[[slice, int], None], m: int) -> None:
    """Calls `work` with as many rows for each thread, and the thread's number."""
    n_parts = torch.get_num_threads()
    size = max(1, -(-m // n_parts))
    each_block(lambda rows: work(rows, rows.start // size), m, n_parts, size)


def _given(given: Any, made: Any) -> _exchange.Exchange:
    (_, m, k), width = given[0].shape, given[1].shape[1]
    return *map(_at, given), *map(_at, made), m, k, width


def _at(tensor: Tensor | None) -> int:
    """Where its numbers are; 0 for none."""
    return 0 if tensor is None or not tensor.numel() else tensor.data_ptr()


class _InTorch(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, learning: bool, features: Tensor, own: Tensor, heard: Tensor, source: Tensor, weight: Tensor,
        weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor, head: Tensor, head_bias: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        (m, k, _), c = features.shape, own.shape[1]
        n_kept = m if learning else min(m, _ROWS)
        hidden, message = own.new_empty(n_kept, k, c), own.new_empty(n_kept, k, c)
        mean, most, known = own.new_empty(m, c), own.new_empty(m, c), own.new_empty(len(head), m, k)
        share = weight / weight.amax(-1, keepdim=True).clamp_min(1e-12)
        for part in _parts(m):
            kept = part if learning else slice(0, part.stop - part.start)
            at_edges, said = hidden[kept], message[kept]
            before, after = at_edges.view(-1, c), said.view(-1, c)
            torch.mm(features[part].flatten(0, 1), weight1.t(), out=before)
            at_edges.add_((own[part] + bias1)[:, None])
            before.add_(heard.index_select(0, source[part].flatten())).relu_()
            torch.mm(before, weight2.t(), out=after)
            after.add_(bias2).relu_()
            mean[part] = torch.bmm(weight[part, None], said)[:, 0]
            most[part] = (said * share[part, :, None]).amax(1)
            known[:, part] = (head @ after.t() + head_bias[:, None]).view(len(head), part.stop - part.start, k)
        if learning:
            ctx.save_for_backward(features, source, weight, share, weight1, weight2, head, hidden, message, most)
        ctx.n_sources = len(heard)
        ctx.set_materialize_grads(False)
        return mean, most, known

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_mean: Tensor | None, of_most: Tensor | None, of_known: Tensor | None) -> tuple[Tensor | None, ...]:
        features, source, weight, share, weight1, weight2, head, hidden, message, most = ctx.saved_tensors
        (m, k, f), c = features.shape, most.shape[1]
        of_weight1, of_weight2, of_head = torch.zeros_like(weight1), torch.zeros_like(weight2), torch.zeros_like(head)
        of_bias2 = weight1.new_zeros(c)
        of_own, of_heard = most.new_empty(m, c), most.new_zeros(ctx.n_sources, c)
        of_features = torch.empty_like(features) if ctx.needs_input_grad[1] else None
        for part in _parts(m):
            before, after = hidden[part].view(-1, c), message[part].view(-1, c)
            relative = share[part, :, None]
            gradient = torch.zeros_like(message[part])
            if of_known is not None:
                by_known = of_known[:, part].flatten(1)
                torch.mm(by_known.t(), head, out=gradient.view(-1, c))
                of_head.addmm_(by_known, after)
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
        of_head_bias = head.new_zeros(len(head)) if of_known is None else of_known.sum((1, 2))
        of_layers = of_weight1, of_own.sum(0), of_weight2, of_bias2, of_head, of_head_bias
        return None, of_features, of_own, of_heard, None, None, *of_layers


def _parts(n: int) -> Iterator[slice]:
    return (slice(start, min(start + _ROWS, n)) for start in range(0, n, _ROWS))
