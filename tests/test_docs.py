"""The documentation cannot lie: its commands run, its links lead somewhere, its reference is the code's."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
BLOCK = re.compile(r"^```(console|bash|python)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


def commands_of(page: Path) -> list[str]:
    """Shell text of every `console` ($ lines) and `bash` block, and every `python` block as a heredoc, in page order."""
    blocks = []
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if kind == "console":
            blocks.append("\n".join(line[2:] for line in text.splitlines() if line.startswith("$ ")))
        elif kind == "python":
            blocks.append(f"python - <<'PYTHON'\n{text}PYTHON")
        else:
            blocks.append(text)
    return blocks


def is_for_the_clone(block: str) -> bool:
    """make, git and pip set things up in a clone; they are run by CI (.ci/run), by test_demo and by nothing twice."""
    return all(re.match(r"(make|git|pip|cd|sudo apt|#)\b", line) for line in block.splitlines() if line.strip())


@pytest.fixture
def reader_of_the_docs(tmp_path: Path) -> Path:
    """An empty folder with the shipped examples, and a PATH that finds this checkout's pcdenoise."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    shims = tmp_path / ".bin"
    shims.mkdir()
    for name, command in (("pcdenoise", f"{sys.executable} -m pcdenoise"), ("python", sys.executable)):
        (shims / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        (shims / name).chmod(0o755)
    return tmp_path


@pytest.mark.parametrize("page", [page for page in PAGES if commands_of(page)], ids=lambda page: str(page.relative_to(ROOT)))
def test_every_documented_command_runs(page: Path, reader_of_the_docs: Path) -> None:
    blocks = [block for block in commands_of(page) if not is_for_the_clone(block)]
    script = "set -eu\n" + "\n".join(blocks)
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("PCDENOISE_")}
    path = f"{reader_of_the_docs / '.bin'}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=reader_of_the_docs,
        env={**inherited, "PATH": path, "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, f"{script}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_that_is_there(page: Path) -> None:
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        if not re.match(r"[a-z]+:", target):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def load_reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_what_the_code_says() -> None:
    for path, text in load_reference().pages().items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name}: run `make docs`"


@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is a developer's extra")
def test_the_pages_build_without_a_warning(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "-q",
        "-f",
        str(ROOT / "mkdocs.yml"),
        "-d",
        str(tmp_path / "site"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "tutorial" / "index.html").exists()


def test_every_command_and_every_option_has_help_and_the_list_of_commands_says_the_same() -> None:
    import typer.main

    from pcdenoise.commands import _SUMMARIES, app

    for name, command in typer.main.get_command(app()).commands.items():  # type: ignore[attr-defined]
        assert command.help.split("\n\n")[0] == _SUMMARIES[name], name
        assert "\n" not in command.help.replace("\n\n", ""), f"{name}: the terminal breaks lines, not the source"
        for parameter in command.params:
            assert parameter.help, f"{name} {parameter.name}"


@pytest.mark.slow
def test_make_demo_cleans_the_shipped_scan_and_leaves_a_picture(tmp_path: Path) -> None:
    """The recipe of `make demo` in a copy of the tree, with this interpreter's environment in the place of a new one."""
    for name in ("Makefile", "examples", "src", "pyproject.toml", "constraints.txt"):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        else:
            shutil.copy2(source, tmp_path / name)
    shims = tmp_path / ".venv" / "bin"
    shims.mkdir(parents=True)
    for name, command in (("pcdenoise", f"{sys.executable} -m pcdenoise"), ("python", sys.executable)):
        (shims / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        (shims / name).chmod(0o755)
    (tmp_path / ".venv" / "run.stamp").touch()
    done = subprocess.run(
        ["make", "demo"], cwd=tmp_path, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path / "src")}
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "demo" / "ground_clean.laz").stat().st_size > 100_000
    assert (tmp_path / "demo" / "before_after.png").read_bytes().startswith(b"\x89PNG")
    assert "before_after.png" in done.stdout + done.stderr
