"""Work on all rows of a cloud in blocks that fit the cache, spread over threads. Not here: what is done with a block."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

BLOCK_POINTS = 1024
"""What is known of so many points and their neighbours fits the cache; half as many cost more in calls than the cache saves."""


def each_block(work: Callable[[slice], None], n: int, threads: int, block_points: int = BLOCK_POINTS) -> None:
    """Calls `work` with the rows of each block.

    A block's work is done by one thread, since threads that wait for each other after every small operation cost more than
    they do.
    """
    with ThreadPoolExecutor(threads if threads > 0 else os.cpu_count()) as pool:
        for _ in pool.map(work, blocks(n, block_points)):
            pass


def blocks(n: int, block_points: int) -> list[slice]:
    """The rows of n points, so many at a time."""
    return [slice(i, min(i + block_points, n)) for i in range(0, n, block_points)]
