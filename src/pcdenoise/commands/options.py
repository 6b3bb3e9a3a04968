"""Options that commands share, and where values come from: flag, environment, --config file, default, in this order."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer
from typer.core import TyperCommand
from typer.main import get_command

from pcdenoise.errors import UsageError

if TYPE_CHECKING:
    from pydantic import BaseModel

    ConfigModel = TypeVar("ConfigModel", bound=BaseModel)

ENVIRONMENT_PREFIX = "PCDENOISE"
"""--max-move is also PCDENOISE_MAX_MOVE."""

_LARGEST_CONFIG = 1 << 20

option = partial(typer.Option, show_envvar=False)
common = partial(option, rich_help_panel="Common")
argument = partial(typer.Argument, show_envvar=False)


class Command(TyperCommand):
    """A command that names the config file where a value that it refuses came from there."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As Typer does. Raises UsageError for a value of the config file that is not of its option's type."""
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as fault:
            if fault.param is None or not _is_from_config(ctx, fault.param.name):
                raise
            said = fault.format_message().rstrip(".")
            raise UsageError(f"{ctx.params['config']}: {said[0].lower()}{said[1:]}; correct it there") from None

    def invoke(self, ctx: Any) -> Any:
        """As Typer does, where messages about an option's value start with the option."""
        try:
            return super().invoke(ctx)
        except UsageError as fault:
            flag = re.match(r"--([a-z][a-z-]*)", str(fault))
            if flag is None or not _is_from_config(ctx, _identifier(flag[1])):
                raise
            raise UsageError(f"{ctx.params['config']}: {fault}") from None


def _is_from_config(context: typer.Context, name: str | None) -> bool:
    source = context.get_parameter_source(name or "")
    return source is not None and source.name == "DEFAULT_MAP"


def _apply_config(context: typer.Context, path: Path | None) -> Path | None:
    """Makes the file's values the defaults of the options that are read after it."""
    if path is not None:
        context.default_map = _defaults_from(path, context)
    return path


def _defaults_from(path: Path, context: typer.Context) -> dict[str, Any]:
    """The settings of a TOML file for one command. Top-level keys hold for every command, tables for the command they name."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        if path.stat().st_size > _LARGEST_CONFIG:
            raise ValueError(f"larger than {_LARGEST_CONFIG} bytes")
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{path}: not a readable TOML file ({_one_line(error)}); check the path and what it holds") from None
    from pcdenoise.commands import app

    commands: dict[str, Any] = vars(get_command(app()))["commands"]
    options = {name: {parameter.name for parameter in command.params} - {"config"} for name, command in commands.items()}
    everywhere = {_identifier(key): value for key, value in settings.items() if not isinstance(value, dict)}
    tables = {key: {_identifier(k): v for k, v in value.items()} for key, value in settings.items() if isinstance(value, dict)}

    for key in everywhere:
        if not any(key in names for names in options.values()):
            raise UsageError(f"{path}: no command has an option {_flag(key)}; remove the key or correct it")
    for table, values in tables.items():
        if table not in options:
            raise UsageError(f"{path}: there is no command {table}; tables are named {', '.join(options)}")
        for key in values:
            if key not in options[table]:
                raise UsageError(f"{path}: {table} has no option {_flag(key)}; see pcdenoise {table} --help")
    called = str(context.command.name)
    takes_many = {p.name: p.nargs == -1 or getattr(p, "multiple", False) for p in context.command.params}
    merged = {**everywhere, **tables.get(called, {})}
    return {key: _as_typed(value, takes_many[key]) for key, value in merged.items() if key in options[called]}


def _as_typed(value: Any, takes_many: bool) -> Any:
    """A value as it stands on a command line: a list for what may be given several times, else with commas between."""
    if isinstance(value, bool):
        return value
    words = [str(item) for item in value] if isinstance(value, list) else [str(value)]
    return words if takes_many else ",".join(words)


def _identifier(key: str) -> str:
    """The parameter behind an option's name; `json` is a module where `as_json` is needed."""
    return "as_json" if key == "json" else key.replace("-", "_")


def _flag(name: str) -> str:
    return "--json" if name == "as_json" else "--" + name.replace("_", "-")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def configured(model: type[ConfigModel], **values: Any) -> ConfigModel:
    """A frozen configuration from option values. Raises UsageError that names the first wrong flag, its fault and its value."""
    from pydantic import ValidationError

    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors()[0]
        name = _flag(str(first["loc"][0]).removesuffix("_s")) if first["loc"] else "options"  # of budget_s, which is --budget
        message = first["msg"].removeprefix("Value error, ")
        message = f"{message[0].lower()}{message[1:]}".replace("input should be", "must be")
        raise UsageError(f"{name}: {message}, got {first['input']!r}") from None


def _suffix_known(option_name: str, suffixes: tuple[str, ...], what: str, *, or_folder: bool = False) -> Callable[[Any], Any]:
    """A callback that refuses a file of another suffix before any work is done; or_folder: none at all may be a folder's name."""

    def check(value: Any) -> Any:
        suffix = Path(str(value or "")).suffix.lower()
        is_folder = or_folder and (not suffix or Path(str(value)).is_dir())
        if value and suffix not in suffixes and not is_folder:
            raise UsageError(f"{option_name} {value}: {what} is written as {', '.join(suffixes)}; choose such a suffix")
        return value

    return check


report_known = _suffix_known("--report", (".json", ".csv", ".html", ".htm"), "a report")
picture_known = _suffix_known("--picture", (".png",), "a picture", or_folder=True)

Inputs = Annotated[
    list[str], argument(metavar="IN...", help="Scans: files, folders, patterns like 'tiles/*.laz', or - for stdin.")
]
Output = Annotated[str, option("--output", "-o", metavar="OUT", help="A file, a folder (for several inputs), or - for stdout.")]
Config = Annotated[
    Path | None,
    common("--config", is_eager=True, callback=_apply_config, metavar="FILE", help="TOML file with values for any options."),
]
OneOutput = Annotated[str, option("--output", "-o", metavar="OUT", help="A file, or - for stdout.")]
_Formats = Literal["las", "laz", "ply", "xyz", "pcd", "bin", "e57", "ptx"]
_OF_NAMELESS = "Format of - and of files without a known suffix"
Format = Annotated[_Formats | None, option("--format", help=f"{_OF_NAMELESS}; into a folder: convert to it.")]
FormatRead = Annotated[_Formats | None, option("--format", help=f"{_OF_NAMELESS}.")]
"""For commands that write no scan, or one file."""
Model = Annotated[
    str | None, option("--model", metavar="NAME|DIR", help="A shipped model (see pcdenoise models) or a model folder.")
]
Report = Annotated[
    Path | None,
    option("--report", callback=report_known, metavar="FILE", help="Write figures and settings to a .json, .csv or .html file."),
]
Picture = Annotated[
    str, option("--picture", callback=picture_known, metavar="OUT", help="Write a .png picture: a file, or a folder for several.")
]
Noise = Annotated[
    float | None,
    option("--noise", metavar="STD", help="Noise as a standard deviation in the file's unit; estimated if not given."),
]
Overwrite = Annotated[bool, option("--overwrite", help="Replace files that exist.")]
Seed = Annotated[int, common("--seed", min=0, help="Same seed, same bytes.")]
Threads = Annotated[int | None, common("--threads", min=1, help="Threads to use; all cores if not given.")]
Quiet = Annotated[bool, common("--quiet", "-q", help="Only errors on stderr.")]
Verbose = Annotated[bool, common("--verbose", "-v", help="More on stderr.")]
Json = Annotated[bool, option("--json", help="Print JSON instead of a table.")]
