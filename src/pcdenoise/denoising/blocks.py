"""Work on all rows of a cloud in blocks that fit the cache, spread over threads. Not here: what is done with a block."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from torch import Tensor

BLOCK_POINTS = 1024
"""With 24 neighbours and 32 channels of float32 a block's messages take 3 MB; twice as many leave the cache, and half as many
cost more in calls than the cache saves."""

Work = Callable[[slice], tuple[Tensor, ...]]


def each_block(work: Callable[[slice], None], n: int, threads: int, block_points: int = BLOCK_POINTS) -> None:
    """Calls `work` with the rows of each block.

    A block's work is done by one thread, since threads that wait for each other after every small operation cost more than
    they do.
    """
    with ThreadPoolExecutor(threads if threads > 0 else os.cpu_count()) as pool:
        for _ in pool.map(work, _blocks(n, block_points)):
            pass


def in_blocks(work: Work, n: int, threads: int, block_points: int = BLOCK_POINTS) -> tuple[Tensor, ...]:
    """What `work` gives for the rows of each block, (B, …) each, put together to (n, …); n >= 1.

    Without gradients every result goes to its place at once, so that nothing but the results outlives its block.
    """
    blocks = _blocks(n, block_points)
    if len(blocks) == 1:
        return work(blocks[0])
    with_gradient = torch.is_grad_enabled()  # known to this thread alone
    if with_gradient:
        return tuple(map(torch.cat, zip(*map(work, blocks), strict=True)))
    first = work(blocks[0])
    whole = tuple(part.new_empty((n, *part.shape[1:])) for part in first)

    def put(block: slice, parts: tuple[Tensor, ...]) -> None:
        for place, part in zip(whole, parts, strict=True):
            place[block] = part

    def one(block: slice) -> None:
        with torch.no_grad():
            put(block, first if block.start == 0 else work(block))

    each_block(one, n, threads, block_points)
    return whole


def _blocks(n: int, block_points: int) -> list[slice]:
    return [slice(i, min(i + block_points, n)) for i in range(0, n, block_points)]


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Torch with so many threads of its own; one for blocks, which are spread over threads already and would wait for them."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
