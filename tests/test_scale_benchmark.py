"""The simulated survey: tiles under kills come out as without them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_tiles_on_workers_that_are_killed_come_out_as_without_kills() -> None:
    script = ROOT / "benchmarks" / "scale" / "run.py"
    tiny = ["survey", "--tiles", "4", "--points", "4000", "--shards", "2", "--kills", "1", "--options=--method mean"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, str(script), *tiny], env=environment, capture_output=True, timeout=300, check=True)
    figures = json.loads(done.stdout)
    assert figures["outputs_equal"]
    assert not figures["faults"]
    assert figures["starts"] == 2 + figures["kills"]
    assert figures["points"] == 16_000
    assert figures["points_per_cpu_s"] > 0
