"""Writes docs/reference/commands.md from the command line itself, so that it cannot say anything else. Run by `make docs`.

python docs/reference.py            write the page
python docs/reference.py --check    exit 1 if the page is not what the code says
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import typer.main

from pcdenoise.commands import EXIT_CODES, app, options

PAGE = Path(__file__).parent / "reference" / "commands.md"


def page() -> str:
    """The whole page as Markdown."""
    group: Any = typer.main.get_command(app)
    parts = [
        "# Commands",
        "Written by `make docs` from the code; do not edit by hand.",
        f"Every option is also an environment variable (`--max-move` is `{options.ENVIRONMENT_PREFIX}_MAX_MOVE`; where it "
        "differs, the table says so) and a key of the TOML file that `--config` names. A flag beats the variable, "
        "the variable beats the file, the file beats the default.",
        EXIT_CODES,
        *(_command(name, command) for name, command in group.commands.items()),
    ]
    return "\n\n".join(parts) + "\n"


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
    if "--check" not in sys.argv:
        PAGE.parent.mkdir(exist_ok=True)
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    return 0 if PAGE.read_text(encoding="utf-8") == page() else 1


if __name__ == "__main__":
    sys.exit(main())
