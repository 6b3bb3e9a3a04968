"""Where the inputs of a batch are worked on: in this process, on a Dask cluster, or in processes of this machine (processes.py).

Each engine takes jobs and a function that survives pickling, and gives outcomes in order of completion. What a worker says
on stderr travels with its outcome. Not here: what is done with an input (the commands), records and exit codes (batch.py).
"""

from __future__ import annotations

import io
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
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


def far_outcome(work: Work, job: Job) -> Outcome:
    """The same where nobody sees stderr."""
    with redirect_stderr(io.StringIO()) as said:
        outcome = _outcome(work, job)
    return Outcome(job, outcome.figures, outcome.error, said.getvalue())


def chosen(n_workers: int, engine: str, address: str | None) -> Engine:
    """The engine that a command line asks for. Raises UsageError for one that is not there."""
    if engine == "dask":
        return on_dask(address, n_workers)
    if address is not None:
        raise UsageError(f"--scheduler {address}: only --engine dask has one; add it")
    if n_workers == 1:
        return here
    from pcdenoise.commands.processes import in_processes  # --help does not need multiprocessing

    return in_processes(n_workers)


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
            futures = {client.submit(partial(far_outcome, work), job, pure=False): job for job in jobs}
            for future in distributed.as_completed(futures, loop=client.loop):  # type: ignore[no-untyped-call]
                try:
                    yield future.result()
                except distributed.KilledWorker:
                    said = f"{futures[future].source}: the workers that tried it were lost; see their logs, and their memory"
                    yield Outcome(futures[future], error=ScanError(said))

    return run
