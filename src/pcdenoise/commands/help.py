"""Typer's help without what it imports and pcdenoise's help never shows, in whole paragraphs. Not here: what the help says.

`typer.rich_utils` imports Rich's Markdown and tracebacks, and with them Pygments and a Markdown parser, for settings that
pcdenoise does not use: a third of the time that help takes (https://github.com/fastapi/typer/pull/1128 names it as left to do).
"""

from __future__ import annotations

import inspect
import sys
from contextlib import suppress
from types import ModuleType

from typer import core

_UNUSED = {"rich.markdown": "Markdown", "rich.traceback": "Traceback"}


def paragraphs(docstring: str) -> str:
    """A docstring with each paragraph in one line: where lines end is for the terminal to say, not for the source."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in inspect.cleandoc(docstring).split("\n\n"))


def import_rich_help() -> None:
    """Imports `typer.rich_utils` with empty classes in the place of those two, which others still import whole.

    A Typer that wants more of them finds it missing here, and imports everything itself when it prints the help.
    """
    if not getattr(core, "HAS_RICH", True):
        return
    stood_in = [module for module in _UNUSED if module not in sys.modules]
    for module in stood_in:
        name = _UNUSED[module]
        sys.modules[module] = ModuleType(module)
        setattr(sys.modules[module], name, type(name, (), {}))
    try:
        with suppress(ImportError, AttributeError, TypeError):
            import typer.rich_utils  # noqa: F401
    finally:
        for module in stood_in:
            del sys.modules[module]
