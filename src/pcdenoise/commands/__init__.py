"""The command line: one file per command, put together here with the one place where errors become exit codes.

A command's module is imported when the command is called, and imports the rest of pcdenoise inside its functions, so that
--help loads neither other commands nor numpy.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from glob import glob
from importlib import import_module
from io import TextIOWrapper
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from pcdenoise import __version__
from pcdenoise.commands import options
from pcdenoise.commands.help import import_rich_help, paragraphs
from pcdenoise.errors import PcdenoiseError, of_the_system

EXIT_CODES = """\
Exit codes: 0 done · 1 some inputs of a batch failed · 2 usage · 3 unreadable or unwritable file · 4 model does not fit ·
5 a quality gate failed · 130 interrupted, nothing half-written · 141 the reader of stdout left · 143 terminated."""

INTERRUPTED = 130
READER_GONE = 141

_SUMMARIES = {
    "denoise": "Move noisy points to the surface they were measured on.",
    "info": "Say what scans are and how noisy: extent, spacing, density, noise and where it is, traps, and how to clean them.",
    "bench": "Compare our models with mean, bilateral, jet and Open3D's smoothers on your own scan, in one table.",
    "iterate": "Write the scan after every pass, with a table, a strip of pictures (passes.png) and a page with a 3D viewer"
    " (report.html).",
    "verify": "Prove that every row and attribute survived, byte for byte, and say how far points moved. Exit code 5 if not.",
    "undo": "Take a cleaned scan back to the original, exactly; needs a scan written by denoise --displacement.",
    "models": "List the models that ship, with their scores, or print one's card: training data, noise, all scores, licence.",
    "synth": "Make a data set: of each surface a clean cloud with colours, evenly spaced, a noisy one per level, and its mesh.",
    "split": "Cut scans to compact parts of a bounded size; rows keep their order and everything they carry.",
    "train": "Train a model. Ctrl-C keeps what was learned so far.",
    "tune": "Find the parameters with which a classical filter comes nearest to the clean clouds of a data set.",
    "pairs": "Write noisy clouds with samples that may pass for clean ones, row for row, to train any supervised denoiser"
    " without truth.",
    "eval-chamfer": "Measure results against a clean cloud, a mesh, or both; the last row is the mean over several results.",
}
"""Every command in the order of --help, with the first paragraph of its own help."""

_HELP: dict[str, Any] = {"help_option_names": ["-h", "--help"]}
_COMPLETION = "_PCDENOISE_COMPLETE"


def app(imported: Collection[str] = tuple(_SUMMARIES)) -> typer.Typer:
    """All commands; those that are not imported are a name and a summary, which is what --help shows of them."""
    group = typer.Typer(name="pcdenoise", no_args_is_help=True, pretty_exceptions_enable=False, epilog=EXIT_CODES)
    group.callback(context_settings=_HELP)(_pcdenoise)
    for name, summary in _SUMMARIES.items():
        if name in imported:
            _import_into(group, name)
        else:
            group.command(name, help=summary)(_not_imported)
    return group


def _import_into(group: typer.Typer, name: str) -> None:
    """Adds the command that is the function of this name in the module of this name."""
    word = name.replace("-", "_")
    settings = {**_HELP, "auto_envvar_prefix": options.ENVIRONMENT_PREFIX}
    command = getattr(import_module(f"{__name__}.{word}"), word)
    said = paragraphs(command.__doc__)
    add = group.command(name, cls=options.Command, help=said, context_settings=settings, no_args_is_help=name != "models")
    add(command)


def _not_imported() -> None:
    raise AssertionError("a command is imported before it is called")


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"pcdenoise {__version__}")
        raise typer.Exit


def _pcdenoise(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """Clean a noisy point cloud: points move to where the surface is, and everything else in the file stays as it was."""
    del version


def _run(arguments: Sequence[str]) -> Any:
    """A command that is named first is all there is: other commands take time to be imported, Typer's group imports pydantic."""
    if not arguments or not {"-h", "--help"}.isdisjoint(arguments):
        import_rich_help()
    if arguments and arguments[0] in _SUMMARIES:
        alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        _import_into(alone, arguments[0])
        return alone(args=arguments[1:], prog_name=f"pcdenoise {arguments[0]}", standalone_mode=False)
    imported = _SUMMARIES if _COMPLETION in os.environ else set(arguments)
    return app(imported)(args=arguments, prog_name="pcdenoise", standalone_mode=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code. Expected errors become one line on stderr; bugs keep their traceback."""
    _replace_closed_streams()
    with _polite_kills():
        try:
            code = _run(_typed() if arguments is None else arguments)
            sys.stdout.flush()
            return _interrupted() if code == INTERRUPTED else int(code or 0)
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
        except KeyboardInterrupt:  # while a command's module is imported; Typer knows of it later
            return _interrupted()
        except Exception as fault:
            if isinstance(fault.__cause__, KeyboardInterrupt):  # Python 3.11 wraps what comes while a class is being made
                return _interrupted()
            if isinstance(fault.__cause__, SystemExit):
                raise fault.__cause__ from None
            known = of_the_system(fault)
            if known is None:
                raise
            if isinstance(fault, OSError) and fault.filename is None:
                _drop_stdout()
            return _fail(str(known), known.exit_code)


def _typed() -> list[str]:
    """What stands on the command line, with patterns expanded where the shell does not: on Windows."""
    given = sys.argv[1:]
    return [found for text in given for found in (sorted(glob(text)) or [text])] if os.name == "nt" else given


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


def _interrupted() -> int:
    return _fail("interrupted; nothing is half-written", INTERRUPTED)


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
