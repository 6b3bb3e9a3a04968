"""The command line: one file per command, put together here with the one place where errors become exit codes.

Command modules import the rest of pcdenoise inside their functions, so that --help and completion load neither numpy nor torch.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from pcdenoise import __version__
from pcdenoise.commands import (
    bench,
    denoise,
    eval_chamfer,
    info,
    iterate,
    models,
    options,
    pairs,
    split,
    synth,
    train,
    tune,
    undo,
    verify,
)
from pcdenoise.errors import PcdenoiseError, of_the_system

EXIT_CODES = """\
Exit codes: 0 done · 1 some inputs of a batch failed · 2 usage · 3 unreadable or unwritable file · 4 model does not fit ·
5 a quality gate failed · 130 interrupted, nothing half-written · 141 the reader of stdout left · 143 terminated."""

INTERRUPTED = 130
READER_GONE = 141

app = typer.Typer(name="pcdenoise", no_args_is_help=True, pretty_exceptions_enable=False, epilog=EXIT_CODES)

_COMMANDS: dict[str, Callable[..., None]] = {
    "denoise": denoise.denoise,
    "info": info.info,
    "bench": bench.bench,
    "iterate": iterate.iterate,
    "verify": verify.verify,
    "undo": undo.undo,
    "models": models.models,
    "synth": synth.synth,
    "split": split.split,
    "train": train.train,
    "tune": tune.tune,
    "pairs": pairs.pairs,
    "eval-chamfer": eval_chamfer.eval_chamfer,
}
_SETTINGS: dict[str, Any] = {"auto_envvar_prefix": options.ENVIRONMENT_PREFIX, "help_option_names": ["-h", "--help"]}

for _name, _function in _COMMANDS.items():
    app.command(_name, context_settings=_SETTINGS, no_args_is_help=_name != "models")(_function)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"pcdenoise {__version__}")
        raise typer.Exit


@app.callback(context_settings={"help_option_names": ["-h", "--help"]})
def _pcdenoise(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """Clean a noisy point cloud: points move to where the surface is, and everything else in the file stays as it was."""
    del version


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code. Expected errors become one line on stderr; bugs keep their traceback."""
    _replace_closed_streams()
    with _polite_kills():
        try:
            code = app(args=arguments, prog_name="pcdenoise", standalone_mode=False)
            sys.stdout.flush()
            return _fail("interrupted; nothing is half-written", INTERRUPTED) if code == INTERRUPTED else int(code or 0)
        except PcdenoiseError as error:
            return _fail(str(error), error.exit_code)
        except typer.TyperException as error:
            return _fail(_usage(error), error.exit_code)
        except BrokenPipeError:
            return _without_reader()
        except SystemExit as stop:
            if isinstance(stop.__context__, BrokenPipeError):  # Typer makes it exit code 1
                return _without_reader()
            raise
        except Exception as fault:
            if isinstance(fault.__cause__, KeyboardInterrupt):  # Python 3.11 wraps what comes while a class is being made
                return _fail("interrupted; nothing is half-written", INTERRUPTED)
            if isinstance(fault.__cause__, SystemExit):
                raise fault.__cause__ from None
            known = of_the_system(fault)
            if known is None:
                raise
            if isinstance(fault, OSError) and fault.filename is None:
                _drop_stdout()
            return _fail(str(known), known.exit_code)


@contextmanager
def _polite_kills() -> Iterator[None]:
    """SIGTERM and a closed terminal unwind like Ctrl-C, so that temporary files are removed; what was ignored stays so."""
    numbers = [signal.SIGTERM, *([signal.SIGHUP] if sys.platform != "win32" else [])]
    previous = {number: signal.getsignal(number) for number in numbers if signal.getsignal(number) != signal.SIG_IGN}
    for number in previous:
        signal.signal(number, _terminate)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _replace_closed_streams() -> None:
    """`>&-` leaves no stream, and the first file opened would get its number: reading finds nothing, writing to stdout fails."""
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_RDONLY), "w")
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors == "strict":  # names of files may be beyond the terminal's letters
            stream.reconfigure(errors="backslashreplace")


def _without_reader() -> int:
    """The reader of stdout has what it wanted (`| head`): no word about it, and the exit code that a shell gives for SIGPIPE."""
    _drop_stdout()
    return READER_GONE


def _drop_stdout() -> None:
    """What stdout still holds goes nowhere, so that Python's own last flush does not complain."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int) -> int:
    if message:
        print(f"pcdenoise: {' '.join(message.split())}", file=sys.stderr)
    return code


def _usage(error: typer.TyperException) -> str:
    """Typer's sentence in our form, with where to read on; nothing where Typer has already printed the help."""
    message = error.format_message().strip().rstrip(".")
    if not message:
        return ""
    context = getattr(error, "ctx", None)
    return f"{message[0].lower()}{message[1:]}; see {context.command_path if context else 'pcdenoise'} --help"


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    """Unwinds once; a second signal of the kind does not disturb the tidying up."""
    del frame
    signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)
