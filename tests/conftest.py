"""What every test may ask for: a seeded generator, the shipped scan, the command line, extra data where there is some."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that starts at the same place in every test."""
    return np.random.default_rng(20190)


@pytest.fixture(scope="session")
def milk() -> Path:
    """The shipped real scan: a milk carton seen by a Kinect, 12 575 points with colour."""
    return ROOT / "examples" / "milk.pcd"


@pytest.fixture(scope="session")
def extra_data() -> Path:
    """A folder of further scans, meshes and broken files; tests that ask for it are skipped where it is absent."""
    folder = Path(os.environ.get("PCDENOISE_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no extra data: set PCDENOISE_DATA to a folder that holds some")
    return folder


@pytest.fixture(scope="session")
def run() -> Callable[..., subprocess.CompletedProcess[bytes]]:
    """Runs the command line in a process of its own: run("info", path, input=b"...", cwd=..., env={...})."""

    def run_pcdenoise(
        *arguments: object, env: dict[str, str] | None = None, **options: object
    ) -> subprocess.CompletedProcess[bytes]:
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("PCDENOISE_")}
        return subprocess.run(
            [sys.executable, "-m", "pcdenoise", *map(str, arguments)],
            capture_output=True,
            env={**inherited, "PYTHONPATH": str(ROOT / "src"), "NO_COLOR": "1", **(env or {})},
            timeout=300,
            check=False,
            **options,  # type: ignore[call-overload]
        )

    return run_pcdenoise
