"""The paper's tables and figures can be rebuilt, at a scale that proves nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
RUN = ROOT / "benchmarks" / "paper" / "run.py"
ALL = {
    "performance", "data-amount", "noise-level", "advanced", "kernels", "levels", "upgrade",
    "error-histogram", "convergence", "iterations", "colour-edge",
}  # fmt: skip


def run(*arguments: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, str(RUN), *arguments], env=environment, check=True, timeout=600, capture_output=True)


def test_a_table_of_the_paper_is_rebuilt_with_the_papers_numbers_beside_ours(tmp_path: Path) -> None:
    run("upgrade", "--quick", "-o", str(tmp_path))
    found = json.loads((tmp_path / "upgrade.json").read_text())
    assert found["paper"] == {"PointNet patches": {"Sup.": 1.36, "Ours": 1.34}}
    assert [cell["column"] for cell in found["cells"]] == ["Sup.", "Ours"]
    for cell in found["cells"]:
        assert cell["oracle"] <= min(cell["fixed"], cell["auto"], cell["noisy"])
    assert (tmp_path / "upgrade.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_one_command_rebuilds_all_of_them(tmp_path: Path) -> None:
    run("all", "--quick", "-o", str(tmp_path))
    assert {path.stem for path in tmp_path.glob("*.json")} == ALL
    assert {path.stem for path in tmp_path.glob("*.png")} == ALL
