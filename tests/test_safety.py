"""Safe by default: what the sources may not call or load, and that every version that a clean install brings is pinned."""

from __future__ import annotations

import ast
import re
from importlib import metadata
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / "src" / "pcdenoise").rglob("*.py"))
NO_MODULES = {
    "pickle", "cPickle", "dill", "joblib", "marshal", "shelve", "socket", "urllib", "http", "ftplib", "smtplib", "requests",
    "httpx", "aiohttp", "ctypes", "code", "runpy", "huggingface_hub",
}  # fmt: skip
"""Modules that run what a file holds, or open connections."""
NO_CALLS = {"eval", "exec", "compile", "__import__", "torch.load", "os.system", "os.popen"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT / "src")))
def test_sources_neither_unpickle_nor_run_text_nor_connect(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        assert not {name.split(".")[0] for name in names} & NO_MODULES, f"{path}:{node.lineno}"
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            assert called not in NO_CALLS, f"{path}:{node.lineno} calls {called}"
            assert arguments.get("shell") != "True", f"{path}:{node.lineno} runs a shell"
            assert arguments.get("allow_pickle", "False") == "False", f"{path}:{node.lineno} unpickles"


def pinned() -> set[str]:
    """The names in constraints.txt that hold for this interpreter, each with one exact version."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    requirements = [Requirement(line) for line in lines if line.strip() and not line.startswith("#")]
    for requirement in requirements:
        assert re.fullmatch(r"==[^*,]+", str(requirement.specifier)), f"{requirement} is no exact version"
    here = [requirement for requirement in requirements if requirement.marker is None or requirement.marker.evaluate()]
    assert len({normal(requirement.name) for requirement in here}) == len(here), "a package is pinned twice"
    return {normal(requirement.name) for requirement in here}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_that_an_install_brings_is_pinned_to_one_version() -> None:
    """What is not pinned could change, or be replaced, without a commit of ours."""
    known, waiting, missing = set(), [("pcdenoise", "dev")], set()
    constraints = pinned()
    while waiting:
        name, extra = waiting.pop()
        if (name, extra) in known:
            continue
        known.add((name, extra))
        if name not in constraints and name not in ("pcdenoise", "setuptools"):
            missing.add(name)
        try:
            requirements = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        for requirement in map(Requirement, requirements):
            environment = {**default_environment(), "extra": extra}
            if requirement.marker is None or requirement.marker.evaluate(environment):
                waiting += [(normal(requirement.name), each) for each in (requirement.extras or {""})]
    unused_on_cpu = {name for name in missing if name.startswith(("nvidia-", "cuda-", "triton"))}
    assert missing - unused_on_cpu == set()
