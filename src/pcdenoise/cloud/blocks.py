"""Work on all rows of a cloud in blocks that fit the cache, spread over threads, and arrays for compiled code.

Not here: what is done with a block.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def address(values: NDArray[Any] | None, kind: type[np.generic]) -> int:
    """Where the numbers of an array lie, for compiled code, which takes them as they are; 0 for none.

    Raises TypeError for numbers of another kind and for those that do not lie row by row.
    """
    if values is None:
        return 0
    if values.dtype != kind or not values.flags.c_contiguous:
        raise TypeError(f"compiled code takes dense arrays of {kind.__name__}, not {values.dtype} with strides {values.strides}")
    return values.ctypes.data
