"""Where the inputs of a batch are worked on: in this process, in worker processes of this machine, or on a Dask cluster.

Each engine takes jobs and a function that survives pickling, and gives outcomes in order of completion. What a worker says
on stderr travels with its outcome. Not here: what is done with an input (the commands), records and exit codes (batch.py).
"""

from __future__ import annotations

import io
import logging
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
from multiprocessing import active_children, get_context
from typing import Any

from pcdenoise.commands.files import Job
from pcdenoise.errors import PcdenoiseError, ScanError, UsageError, of_the_system

Figures = dict[str, Any]
"""Numbers about one input, by name."""
Work = Callable[[Job], Figures]


@dataclass(frozen=True)
class Outcome:
    """What became of a job: its figures, or the error that a user can be told; said: lines for stderr."""

    job: Job
    figures: Figures | None = None
    error: PcdenoiseError | None = None
    said: str = ""


Engine = Callable[[Sequence[Job], Work], Iterator[Outcome]]


def here(jobs: Sequence[Job], work: Work) -> Iterator[Outcome]:
    """One after the other, in this process."""
    return (_outcome(work, job) for job in jobs)


def _outcome(work: Work, job: Job) -> Outcome:
    """Runs one job; an expected error, or the system's (disk, memory), is its outcome."""
    try:
        return Outcome(job, figures=work(job))
    except Exception as fault:
        error = fault if isinstance(fault, PcdenoiseError) else of_the_system(fault, str(job.source))
        if error is None:
            raise
        return Outcome(job, error=error)


def _far_outcome(work: Work, job: Job) -> Outcome:
    """The same where nobody sees stderr."""
    with redirect_stderr(io.StringIO()) as said:
        outcome = _outcome(work, job)
    return Outcome(job, outcome.figures, outcome.error, said.getvalue())


def in_processes(n_workers: int) -> Engine:
    """So many inputs at a time, each in a process of its own that lives on for the next.

    A worker that is killed (out of memory) takes its input down once: whatever was at work then is tried again alone, and what
    kills its worker again has failed. An interrupt ends all workers, which tidy up.
    """

    def run(jobs: Sequence[Job], work: Work) -> Iterator[Outcome]:
        waiting = deque(jobs)
        while waiting:
            suspects: list[Job] = []
            with _pool(n_workers) as pool:
                running: dict[Future[Outcome], Job] = {}
                while (waiting or running) and not suspects:
                    while waiting and len(running) < n_workers:
                        job = waiting.popleft()
                        running[pool.submit(_far_outcome, work, job)] = job
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        job = running.pop(future)
                        if isinstance(future.exception(), BrokenProcessPool):
                            suspects.append(job)
                        else:
                            yield future.result()
                suspects += running.values()
            for job in suspects:
                yield _alone(job, work)

    return run


def _alone(job: Job, work: Work) -> Outcome:
    try:
        with _pool(1) as pool:
            return pool.submit(_far_outcome, work, job).result()
    except BrokenProcessPool:
        fault = f"{job.source}: its worker was killed twice; it may need more memory: give fewer --workers or less --max-memory"
        return Outcome(job, error=ScanError(fault))


class _pool(ProcessPoolExecutor):
    """Processes that are ended, not waited for, when an exception leaves the block."""

    def __init__(self, n_workers: int) -> None:
        super().__init__(n_workers, mp_context=get_context("spawn"), initializer=_unwind_when_terminated)

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is not None and not issubclass(kind, BrokenProcessPool):
            self.shutdown(wait=False, cancel_futures=True)
            for process in active_children():
                process.terminate()
        super().__exit__(kind, error, trace)


def _unwind_when_terminated() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to all; the parent decides
    signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))


def chosen(n_workers: int, engine: str, address: str | None) -> Engine:
    """The engine that a command line asks for. Raises UsageError for one that is not there."""
    if engine == "dask":
        return on_dask(address, n_workers)
    if address is not None:
        raise UsageError(f"--scheduler {address}: only --engine dask has one; add it")
    return in_processes(n_workers) if n_workers > 1 else here


def on_dask(address: str | None, n_workers: int) -> Engine:
    """On the cluster whose scheduler is at the address, or on a local one of so many workers. Files must be visible to workers.

    The scheduler moves the inputs of a lost worker to others; an input that has lost several has failed.
    """
    try:
        import distributed
    except ImportError:
        raise UsageError("--engine dask needs Dask; install it with: pip install 'pcdenoise[dask]'") from None

    def run(jobs: Sequence[Job], work: Work) -> Iterator[Outcome]:
        here = {"n_workers": n_workers, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
        where = {"address": address} if address else here
        try:
            client = distributed.Client(**where, set_as_default=False, timeout="20s")  # type: ignore[no-untyped-call]
        except (OSError, ValueError) as fault:
            raise UsageError(f"--scheduler {address}: no scheduler answers ({fault}); check the address") from None
        with client:
            futures = {client.submit(partial(_far_outcome, work), job, pure=False): job for job in jobs}
            for future in distributed.as_completed(futures, loop=client.loop):  # type: ignore[no-untyped-call]
                try:
                    yield future.result()
                except distributed.KilledWorker:
                    said = f"{futures[future].source}: the workers that tried it were lost; see their logs, and their memory"
                    yield Outcome(futures[future], error=ScanError(said))

    return run
