"""Many inputs, one after the other: a failed one is said and counted, the others go on. Not here: what is done with one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pcdenoise.commands.console import Console
from pcdenoise.commands.files import Job
from pcdenoise.errors import BatchError, PcdenoiseError, of_the_system

Figures = dict[str, Any]
"""Numbers about one input, by name."""


class Batch:
    """Runs one function over jobs and keeps a record of each, in the form of a report's `files`."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.records: list[dict[str, Any]] = []
        self._errors: list[PcdenoiseError] = []

    def run(self, jobs: Sequence[Job], work: Callable[[Job], Figures]) -> None:
        """One record per job, in order. An expected error of one job, or the system's (disk, memory), becomes its record."""
        for job in jobs:
            names = {"input": str(job.source), "output": str(job.target)}
            try:
                self.records.append({**names, "status": "done", "figures": work(job)})
            except Exception as fault:
                error = fault if isinstance(fault, PcdenoiseError) else of_the_system(fault, str(job.source))
                if error is None:
                    raise
                self._errors.append(error)
                self.records.append({**names, "status": "failed", "error": str(error), "exit_code": error.exit_code})
                if len(jobs) > 1:
                    self.console.fault(str(error))

    def close(self) -> None:
        """Raises the error of a single input as it is, and BatchError if any of several failed."""
        if len(self.records) == 1 and self._errors:
            raise self._errors[0]
        if self._errors:
            raise BatchError(f"{len(self._errors)} of {len(self.records)} inputs failed; the others are done")
