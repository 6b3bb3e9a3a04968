"""The house keeps its shape: what is imported when, what ships, what modules say about themselves."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from pcdenoise import commands

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / "src" / "pcdenoise").rglob("*.py"))
COMMANDS = list(commands._SUMMARIES)
HEAVY = {"torch", "open3d", "scipy", "laspy", "plyfile", "safetensors", "numpy", "pydantic", "markdown_it"}

_REPORT_MODULES = """
import sys
from pcdenoise.commands import main
code = main(sys.argv[1:])
print("MODULES", *sorted(sys.modules))
sys.exit(code)
"""


def modules_after(code: str, *arguments: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after running code, with pcdenoise's own under their full names."""
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True, cwd=ROOT / "src")
    names = {name for line in done.stdout.splitlines() if line.startswith("MODULES") for name in line.split()[1:]}
    return {name if name.startswith("pcdenoise.") else name.split(".")[0] for name in names}


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help_loads_nothing_heavy(command: str | None) -> None:
    arguments = ["--help"] if command is None else [command, "--help"]
    loaded = modules_after(_REPORT_MODULES, *arguments)
    assert "typer" in loaded
    assert not loaded & HEAVY
    assert ("pcdenoise.commands.bench" in loaded) == (command == "bench")


def test_importing_the_package_loads_nothing_heavy_and_names_load_on_use() -> None:
    assert not modules_after("import sys, pcdenoise; print('MODULES', *sys.modules)") & HEAVY
    loaded = modules_after("import sys, pcdenoise; pcdenoise.Scan; print('MODULES', *sys.modules)")
    assert "numpy" in loaded
    assert "torch" not in loaded


def test_every_public_name_of_the_package_exists() -> None:
    import pcdenoise

    for name in pcdenoise.__all__:
        assert getattr(pcdenoise, name).__doc__
    with pytest.raises(AttributeError, match="no_such_name"):
        pcdenoise.no_such_name  # noqa: B018


def test_reading_and_classical_filters_work_where_torch_is_not_installed() -> None:
    code = """
import sys
sys.modules["torch"] = sys.modules["open3d"] = None
import pcdenoise.io, pcdenoise.denoising.classical, pcdenoise.evaluation.chamfer, pcdenoise.synthesis.shapes
print("MODULES", *[name for name, module in sys.modules.items() if module])
"""
    assert not modules_after(code) & {"torch", "open3d"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_every_module_opens_with_what_lives_in_it(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not tree.body or ast.get_docstring(tree), f"{path} has no docstring"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_library_code_neither_prints_nor_exits_nor_swallows(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    in_commands = "commands" in path.parts or path.name == "__main__.py"
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler):
            caught = ast.unparse(node.type) if node.type else "everything"
            raised = any(isinstance(inner, ast.Raise) for inner in ast.walk(node))
            assert raised or caught not in {"everything", "Exception", "BaseException"}, f"{path}:{node.lineno} swallows {caught}"
        if isinstance(node, ast.Call) and not in_commands:
            assert ast.unparse(node.func) not in {"print", "sys.exit", "exit", "input"}, f"{path}:{node.lineno}"


@pytest.mark.slow
def test_the_wheel_holds_the_models_the_viewer_and_the_licence(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, tmp_path)
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "."]
    subprocess.run(build, check=True, capture_output=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("pcdenoise-*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    shipped = [path for path in (ROOT / "src" / "pcdenoise" / "models").rglob("*") if path.is_file()]
    assert shipped
    for path in [*shipped, ROOT / "src" / "pcdenoise" / "evaluation" / "viewer.html", ROOT / "src" / "pcdenoise" / "py.typed"]:
        assert str(path.relative_to(ROOT / "src")) in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "examples/", "docs/")) for name in names)
