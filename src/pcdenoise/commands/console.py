"""What a person sees while a command runs: notes and progress on stderr, tables for stdout. Not here: files, exit codes."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

OnProgress = Callable[[str, float], None]
"""Called with the name of the stage and its finished share, 0 to 1."""

LINE_EVERY_S = 10.0
"""How often a log (anything but a terminal) gets a line of progress."""


@dataclass(frozen=True)
class Console:
    """stderr with three levels: quiet (errors only), normal, verbose."""

    quiet: bool = False
    verbose: bool = False

    def note(self, text: str) -> None:
        """One line for a person, unless quiet."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def detail(self, text: str) -> None:
        """One line for the curious, only if verbose."""
        if self.verbose:
            self.note(text)

    def fault(self, text: str) -> None:
        """One line that even quiet shows: what failed, and that the rest goes on."""
        print(f"pcdenoise: {text}", file=sys.stderr, flush=True)

    @contextmanager
    def progress(self, title: str) -> Iterator[OnProgress]:
        """A bar with rate and time left on a terminal, a line every ten seconds in a log, nothing if quiet."""
        if self.quiet:
            yield _ignore
        elif sys.stderr.isatty():
            with _bar(title) as on_progress:
                yield on_progress
        else:
            yield _log_lines(title, self.note)


def table(headers: Sequence[str], rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> str:
    """Aligned plain-text columns, those numbered in `left` to the left; reads well on a terminal, in a log and in an e-mail."""
    cells = [list(headers), *(list(row) for row in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(headers))]

    def line(row: Sequence[str]) -> str:
        aligned = (text.ljust(widths[i]) if i in left else text.rjust(widths[i]) for i, text in enumerate(row))
        return "  ".join(aligned).rstrip()

    return "\n".join([line(headers), line(["-" * width for width in widths]), *map(line, rows)])


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """`name  value` lines with the values in one column."""
    width = max(len(name) for name, _ in pairs)
    return "\n".join(f"{name.ljust(width)}  {value}".rstrip() for name, value in pairs)


def figure(value: float) -> str:
    """Four significant digits, plain where a person reads it plainly: 0.001234, 12.35, 5.1e-07."""
    return f"{value:.4g}"


def counted(n: int, one: str, several: str = "") -> str:
    """A number of things: `1 pass`, `12,575 points`."""
    return f"{n:,} {one if n == 1 else several or one + 's'}"


def _ignore(stage: str, share: float) -> None:
    del stage, share


def _log_lines(title: str, note: Callable[[str], None]) -> OnProgress:
    last = time.monotonic()

    def on_progress(stage: str, share: float) -> None:
        nonlocal last
        if time.monotonic() - last >= LINE_EVERY_S:
            last = time.monotonic()
            note(f"{title}: {stage} {share:.0%}")

    return on_progress


@contextmanager
def _bar(title: str) -> Iterator[OnProgress]:
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(compact=True))
    with Progress(*columns, console=RichConsole(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=1.0)

        def on_progress(stage: str, share: float) -> None:
            bar.update(task, description=f"{title}: {stage}", completed=share)

        yield on_progress
