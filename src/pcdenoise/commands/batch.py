"""Many inputs, one after the other: a failed one is said and counted, the others go on. Not here: what is done with one."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from pcdenoise.commands.console import Console
from pcdenoise.commands.files import Job
from pcdenoise.commands.workers import Engine, Figures, Outcome, Work, here
from pcdenoise.errors import BatchError, PcdenoiseError

__all__ = ["Batch", "Figures"]


class Batch:
    """Runs one function over jobs and keeps a record of each, in the form of a report's `files`."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.records: list[dict[str, Any]] = []
        self._errors: list[PcdenoiseError] = []

    def run(
        self, jobs: Sequence[Job], work: Work, engine: Engine = here, show: Callable[[Job, Figures], None] | None = None
    ) -> None:
        """One record per job, in the jobs' order, whatever the order in which they are done.

        show: prints what was found about a job. A stdout that takes no more is no fault of the job, and ends the run.
        """
        records: dict[Job, dict[str, Any]] = {}
        for outcome in engine(jobs, work):
            if outcome.said and not self.console.quiet:
                print(outcome.said, end="", file=sys.stderr, flush=True)
            if show and outcome.figures is not None:
                show(outcome.job, outcome.figures)
            records[outcome.job] = self._record(outcome, is_single=len(jobs) == 1)
        self.records += [records[job] for job in jobs]

    def _record(self, outcome: Outcome, is_single: bool) -> dict[str, Any]:
        names = {"input": str(outcome.job.source), "output": str(outcome.job.target)}
        if outcome.error is None:
            return {**names, "status": "done", "figures": outcome.figures}
        self._errors.append(outcome.error)
        if not is_single:
            self.console.fault(str(outcome.error))
        return {**names, "status": "failed", "error": str(outcome.error), "exit_code": outcome.error.exit_code}

    def close(self) -> None:
        """Raises the error of a single input as it is, and BatchError if any of several failed."""
        if len(self.records) == 1 and self._errors:
            raise self._errors[0]
        if self._errors:
            raise BatchError(f"{len(self._errors)} of {len(self.records)} inputs failed; the others are done")
