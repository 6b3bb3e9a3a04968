"""The paper's tables can be rebuilt: one of them, at a scale that proves nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_a_table_of_the_paper_is_rebuilt_with_the_papers_numbers_beside_ours(tmp_path: Path) -> None:
    script = ROOT / "benchmarks" / "paper" / "run.py"
    command = [sys.executable, str(script), "upgrade", "--quick", "-o", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, env=environment, check=True, timeout=300, capture_output=True)
    found = json.loads((tmp_path / "upgrade.json").read_text())
    assert found["paper"] == {"PointNet patches": {"Sup.": 1.36, "Ours": 1.34}}
    assert [cell["column"] for cell in found["cells"]] == ["Sup.", "Ours"]
    for cell in found["cells"]:
        assert cell["oracle"] <= min(cell["fixed"], cell["auto"], cell["noisy"])
    assert (tmp_path / "upgrade.png").read_bytes().startswith(b"\x89PNG")
