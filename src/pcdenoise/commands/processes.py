"""Worker processes of this machine, each for one input at a time. Not here: the other engines, what is done with an input."""

from __future__ import annotations

import signal
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import Any

from pcdenoise.commands.files import Job
from pcdenoise.commands.workers import Engine, Outcome, Work, far_outcome
from pcdenoise.errors import ScanError
from pcdenoise.whole_files import tidy


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
                is_broken = False
                while (waiting or running) and not is_broken:
                    try:
                        while waiting and len(running) < n_workers:
                            running[pool.submit(far_outcome, work, waiting[0])] = waiting[0]
                            waiting.popleft()
                    except BrokenProcessPool:  # by a worker that was waiting for this job
                        is_broken = True
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        job = running.pop(future)
                        if isinstance(future.exception(), BrokenProcessPool):
                            is_broken = True
                            suspects.append(job)
                        else:
                            yield future.result()
                if is_broken:
                    _kill_others()
                suspects += running.values()
            for job in suspects:
                tidy(job.target)
                yield _alone(job, work)

    return run


def _alone(job: Job, work: Work) -> Outcome:
    try:
        with _pool(1) as pool:
            return pool.submit(far_outcome, work, job).result()
    except BrokenProcessPool:
        tidy(job.target)
        fault = f"{job.source}: its worker was killed twice; it may need more memory: give fewer --workers or less --max-memory"
        return Outcome(job, error=ScanError(fault))


def _kill_others() -> None:
    """Ends the workers that are left of a broken pool, which asks them to end and waits until they have.

    One at work takes that for the end of its job and goes on to the next; there it waits forever if the worker that was killed
    had the lock of the queue. What it was at is tidied up by the parent, as what the killed one was at.
    """
    for process in active_children():
        process.kill()


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
