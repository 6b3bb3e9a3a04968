"""The command line: one file per command, put together here with the one place where errors become exit codes.

Command modules import the rest of pcdenoise inside their functions, so that --help and completion load neither numpy nor torch.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
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
from pcdenoise.errors import PcdenoiseError, ScanError

EXIT_CODES = """\
Exit codes: 0 done · 1 some inputs of a batch failed · 2 usage · 3 unreadable or unwritable file · 4 model does not fit ·
5 a quality gate failed · 130 interrupted, nothing half-written."""

INTERRUPTED = 130

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
    previous = signal.signal(signal.SIGTERM, _terminate)
    try:
        code = app(args=arguments, prog_name="pcdenoise", standalone_mode=False)
        sys.stdout.flush()
        return _fail("interrupted; nothing is half-written", INTERRUPTED) if code == INTERRUPTED else int(code or 0)
    except PcdenoiseError as error:
        return _fail(str(error), error.exit_code)
    except typer.TyperException as error:
        return _fail(_usage(error), error.exit_code)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", ScanError.exit_code)
    except MemoryError:
        return _fail("out of memory; free some, or split the scan into tiles", ScanError.exit_code)
    finally:
        signal.signal(signal.SIGTERM, previous)


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
    """A polite kill unwinds like Ctrl-C, so that temporary files are removed."""
    del frame
    sys.exit(128 + number)
