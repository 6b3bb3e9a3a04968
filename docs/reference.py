"""Writes the pages of docs/reference that say what the code says, from the code itself. Run by `make docs`.

python docs/reference.py            write the pages
python docs/reference.py --check    exit 1 if a page is not what the code says
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import typer.main

import pcdenoise
from pcdenoise.commands import EXIT_CODES, app, options

FOLDER = Path(__file__).parent / "reference"
WRITTEN = "Written by `make docs` from the code; do not edit by hand."


def pages() -> dict[Path, str]:
    """Every generated page as Markdown."""
    return {FOLDER / "commands.md": commands(), FOLDER / "settings.md": settings(), FOLDER / "python.md": python()}


def commands() -> str:
    """Every command with its options."""
    group: Any = typer.main.get_command(app())
    parts = [
        "# Commands",
        WRITTEN,
        f"Every option is also an environment variable (`--max-move` is `{options.ENVIRONMENT_PREFIX}_MAX_MOVE`; where it "
        "differs, the table says so) and a key of the TOML file that `--config` names. A flag beats the variable, "
        "the variable beats the file, the file beats the default.",
        EXIT_CODES,
        *(_command(name, command) for name, command in group.commands.items()),
    ]
    return "\n\n".join(parts) + "\n"


def settings() -> str:
    """Every field of the configurations with type, default and meaning."""
    parts = ["# Settings", WRITTEN, "Frozen, checked, unknown names refused. Commands have them as options, Python as keywords."]
    for name in ("DenoiseConfig", "TrainConfig"):
        model = getattr(pcdenoise, name)
        rows = [
            f"| `{field}` | `{_cell(str(annotation))}` | `{info.default!r}` | {_cell(info.description or '')} |"
            for (field, info), annotation in zip(
                model.model_fields.items(), map(model.__annotations__.get, model.model_fields), strict=True
            )
        ]
        table = "\n".join(["| name | type | default | what |", "| --- | --- | --- | --- |", *rows])
        parts += [f"## {name}", inspect.cleandoc(model.__doc__), table]
    return "\n\n".join(parts) + "\n"


def python() -> str:
    """Every public name with its signature and what its docstring says, after the page's own introduction."""
    parts = [(FOLDER / "python_introduction.txt").read_text(encoding="utf-8").strip(), WRITTEN]
    for name in pcdenoise.__all__:
        value = getattr(pcdenoise, name)
        said = inspect.cleandoc(value.__doc__ or "")
        signature = "" if inspect.isclass(value) else f"```text\n{name}{_signature(value)}\n```"
        parts += [f"## {name}", *([signature] if signature else []), f"```text\n{said}\n```"]
        if inspect.isclass(value) and not hasattr(value, "model_fields"):
            parts += [
                f"- `.{method}{_signature(function)}`: {inspect.cleandoc(function.__doc__).splitlines()[0]}"
                for method, function in vars(value).items()
                if inspect.isfunction(function) and not method.startswith("_")
            ]
    return "\n\n".join(parts) + "\n"


def _signature(function: Any) -> str:
    """With annotations as they stand in the code, one parameter a line where there are many."""
    names = inspect.signature(function).parameters
    words = [str(parameter).replace("'", "") for name, parameter in names.items() if name != "self"]
    starred = next((place for place, p in enumerate(names.values()) if p.kind is p.KEYWORD_ONLY), None)
    if starred is not None:
        words.insert(starred, "*")
    result = str(inspect.signature(function).return_annotation).replace("'", "")
    one_line = f"({', '.join(words)}) -> {result}"
    return one_line if len(one_line) < 100 else "(\n    " + ",\n    ".join(words) + f",\n) -> {result}"


def _command(name: str, command: Any) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    flags = [p for p in command.params if p.param_type_name == "option"]
    usage = " ".join([f"pcdenoise {name}", *(p.metavar or p.name.upper() for p in arguments), "[OPTIONS]"])
    text, _, example = inspect.cleandoc(command.help).partition("Example: ")
    rows = [f"| `{p.metavar or p.name.upper()}` | {_cell(p.help)} | |" for p in arguments]
    rows += [f"| {_flag(p)} | {_cell(p.help)}{_variable(p)} | {_default(p)} |" for p in flags]
    blocks = [
        f"## {name}",
        text.strip(),
        f"```text\n{usage}\n```",
        "\n".join(["| option | what | default |", "| --- | --- | --- |", *rows]),
    ]
    if example:
        blocks.insert(2, f"```text\n{example.strip()}\n```")
    return "\n\n".join(blocks)


def _flag(parameter: Any) -> str:
    names = ", ".join(f"`{flag}`" for flag in parameter.opts)
    if parameter.is_flag:
        return names
    if parameter.type_descriptor.is_choice:
        return names + " " + _cell("`" + "|".join(parameter.type_descriptor.choices) + "`")
    return f"{names} `{_cell(parameter.metavar or parameter.bare_type().upper())}`"


def _variable(parameter: Any) -> str:
    return f" Variable: `{parameter.envvar}`." if parameter.envvar else ""


def _default(parameter: Any) -> str:
    return "" if parameter.is_flag or parameter.default in (None, "", ()) else f"`{parameter.default}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main() -> int:
    if "--check" in sys.argv:
        return 0 if all(path.read_text(encoding="utf-8") == text for path, text in pages().items()) else 1
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
