"""Training on the processes that torchrun started: who has which clouds, and one gradient for all. Not here: the loop."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, distributed

from pcdenoise.errors import PcdenoiseError, in_one_line

_THREADS_PER_MAKER = 4


@dataclass(frozen=True)
class Ranks:
    """One of `count` processes that learn together, each from its own clouds; the first one saves and logs."""

    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process saves and logs."""
        return self.rank == 0

    def number(self, step: int) -> int:
        """Of the cloud that this process learns from in a step: clouds are dealt out one by one."""
        return step * self.count + self.rank

    def agreed(self, value: float) -> float:
        """The first process's value, on all."""
        if self.count == 1:
            return value
        shared = torch.tensor([value], dtype=torch.float64)
        with _said_in_one_line():
            distributed.broadcast(shared, 0)
        return float(shared)

    def averaged(self, tensors: Sequence[Tensor], figures: Sequence[float], weight: float) -> list[float]:
        """Replaces tensors by their mean over all processes, each by its weight (nothing changes where all are 0).

        Gives the sums of the figures and then of the weight. Every process gets the same bits.
        """
        if self.count == 1:
            return [*figures, weight]
        flat = torch.cat([weight * tensor.reshape(-1) for tensor in tensors])
        sums = torch.tensor([*figures, weight], dtype=torch.float64)
        with _said_in_one_line():
            distributed.all_reduce(flat)
            distributed.all_reduce(sums)
        if sums[-1] > 0:
            means = torch.split(flat / sums[-1].float(), [tensor.numel() for tensor in tensors])
            for tensor, mean in zip(tensors, means, strict=True):
                tensor.copy_(mean.view_as(tensor))
        return [float(total) for total in sums]

    def n_makers(self, threads: int | None) -> int:
        """How many processes make clouds for this one: one for every four threads that it may use."""
        usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        here = int(os.environ.get("LOCAL_WORLD_SIZE", self.count))
        return max(1, (threads or usable // here) // _THREADS_PER_MAKER)

    def wait(self) -> None:
        """Until all processes are here."""
        self.agreed(0.0)


def is_first() -> bool:
    """Whether this process is alone or the first of those that torchrun started."""
    return int(os.environ.get("RANK", "0")) == 0


@contextmanager
def joined() -> Iterator[Ranks]:
    """The processes of this run, as torchrun's variables tell; one alone without them."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Ranks()
        return
    is_joined = distributed.is_initialized()
    if not is_joined:
        distributed.init_process_group("gloo")
    try:
        yield Ranks(distributed.get_rank(), distributed.get_world_size())
    finally:
        if not is_joined:
            distributed.destroy_process_group()


@contextmanager
def _said_in_one_line() -> Iterator[None]:
    """A process that is lost is no bug of this one's."""
    try:
        yield
    except RuntimeError as fault:
        said = in_one_line(fault)
        raise PcdenoiseError(f"another process of this training is lost ({said}); start all again with --resume") from None
