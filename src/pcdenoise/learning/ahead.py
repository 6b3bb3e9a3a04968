"""Training clouds made ahead of time by other processes, in a fixed order. Not here: what a cloud is (dataset.py, scans.py)."""

from __future__ import annotations

import signal
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import count
from multiprocessing import get_context
from typing import Generic, TypeVar

from pcdenoise.errors import PcdenoiseError

_AHEAD = 6  # clouds that wait for each process that makes them

CloudT = TypeVar("CloudT")


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class CloudsAhead(ABC, Generic[CloudT]):
    """An endless series of training clouds, made ahead of time by other processes."""

    @abstractmethod
    def cloud(self, number: int, neighbours: int) -> CloudT:
        """The number-th cloud; it depends on nothing but the source and these."""

    def clouds(self, first: int, neighbours: int, stride: int = 1, n_makers: int = 1) -> Generator[CloudT, None, None]:
        """Endless clouds from the first-th on, every stride-th, made by so many processes, or by this one when asked for."""
        if n_makers == 0:
            for number in count(first, stride):
                yield self.cloud(number, neighbours)
        ahead = _AHEAD * n_makers
        with ProcessPoolExecutor(n_makers, get_context("spawn"), _leave_interrupts_to_the_parent) as makers:
            waiting = deque(makers.submit(self.cloud, first + i * stride, neighbours) for i in range(ahead))
            try:
                for number in count(first + ahead * stride, stride):
                    yield waiting.popleft().result()
                    waiting.append(makers.submit(self.cloud, number, neighbours))
            except BrokenProcessPool:
                raise PcdenoiseError("a process that makes clouds to learn from was killed; free memory, then --resume") from None
            finally:
                makers.shutdown(cancel_futures=True)
