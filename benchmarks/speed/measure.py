"""Points per CPU second and peak memory of pcdenoise and its peers on a generated street, in one run on one machine.

    python benchmarks/speed/measure.py --quick -o speed/
    python benchmarks/speed/measure.py --sizes 10K 100K 1M -o speed/ --peer-python "CGAL jet=venv-cgal/bin/python"
    python benchmarks/speed/measure.py --sizes 1M 20M --max-memory 2G --only pcdenoise -o speed-20m/

Writes speed.json and speed.png. What is missing on the machine is left out and said. Not here: the street (street.py), the
peers' own calls (peers.py).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from peers import PEERS
from street import street, write

from pcdenoise import __version__
from pcdenoise.evaluation.charts import curve
from pcdenoise.evaluation.pictures import write_png

HERE = Path(__file__).resolve().parent
SIZES = ["10K", "50K", "200K", "800K"]
QUICK = ["2K", "4K"]
OURS, TRAIN = "pcdenoise", "pcdenoise train"
LARGEST_FOR_PEERS = 5_000_000  # a point takes them about a kilobyte


def main() -> None:
    """Measures everything on every size and writes what came of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="points, K or M: 10K 1M 20M")
    parser.add_argument("--quick", action="store_true", help="two tiny clouds: whether it runs, not how fast")
    parser.add_argument("--only", nargs="+", choices=[OURS, TRAIN, *PEERS], default=[OURS, TRAIN, *PEERS])
    parser.add_argument("--max-memory", help="passed to pcdenoise denoise")
    parser.add_argument("--train-steps", type=int, default=4, help="clouds that training learns from")
    parser.add_argument("--peer-python", nargs="*", default=[], metavar="PEER=PYTHON", help="interpreter that has the peer")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder")
    options = parser.parse_args()
    pythons = dict(pair.split("=", 1) for pair in options.peer_python)
    rows: list[dict[str, Any]] = []
    load_before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        for size in QUICK if options.quick else options.sizes:
            n = int(float(size[:-1]) * {"K": 1e3, "M": 1e6}[size[-1].upper()])
            scan, cloud = Path(folder, "street.laz"), Path(folder, "street.npy")
            write(n, scan)
            for name in options.only:
                if name in PEERS and n <= LARGEST_FOR_PEERS:
                    np.save(cloud, np.concatenate(list(street(n))))
                    found = run([pythons.get(name, sys.executable), str(HERE / "peers.py"), name, str(cloud)])
                    figures = [line for line in found.pop("stdout").splitlines() if line.startswith("{")]  # peers print too
                    found |= json.loads(figures[0]) if found["exit_code"] == 0 else {}
                elif name == OURS:
                    limit = ["--max-memory", options.max_memory] if options.max_memory else []
                    command = [sys.executable, "-m", "pcdenoise", "denoise", str(scan), "-o", str(Path(folder, "clean.laz"))]
                    found = run([*command, "--overwrite", "-q", *limit])
                else:
                    continue
                rows.append(report(name, n, found))
        if TRAIN in options.only:
            steps = 1 if options.quick else options.train_steps
            model = Path(folder, "model")
            found = run([sys.executable, "-m", "pcdenoise", "train", "-o", str(model), "--steps", str(steps), "-q"])
            rows.append(report(TRAIN, steps, found, "clouds"))
    options.output.mkdir(parents=True, exist_ok=True)
    done = {"pcdenoise": __version__, "machine": machine(), "load_before": load_before, "rows": rows}
    (options.output / "speed.json").write_text(json.dumps(done, indent=1) + "\n")
    write_png(options.output / "speed.png", picture(rows), overwrite=True)


def run(command: list[str], environment: dict[str, str] | None = None) -> dict[str, Any]:
    """CPU seconds, wall seconds and peak memory of a process and its exit code; what it printed."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
    assert process.stdout is not None
    assert process.stderr is not None
    printed, complaint = process.stdout.read(), process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return {
        "exit_code": process.returncode,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "wall_s": time.perf_counter() - started,
        "peak_bytes": usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
        "stdout": printed.decode(),
        "fault": complaint.decode().strip().splitlines()[-1:] if process.returncode else [],
    }


def report(name: str, n: int, found: dict[str, Any], unit: str = "points") -> dict[str, Any]:
    """A row of the result; prints it as well."""
    row = {"name": name, "n": n, "unit": unit, **{key: value for key, value in found.items() if key != "stdout"}}
    if row["exit_code"] == 0:
        row["per_cpu_s"] = n / row["cpu_s"]
        print(f"{name:20} {n:>10,} {unit}  {row['cpu_s']:8.2f} CPU s  {row['per_cpu_s']:12,.1f} {unit}/CPU s", end="")
        print(f"  {row['peak_bytes'] / 2**20:7,.0f} MB", flush=True)
    else:
        print(f"{name:20} {n:>10,} {unit}  left out: {' '.join(row['fault'])}", flush=True)
    return row


def picture(rows: list[dict[str, Any]]) -> np.ndarray:
    """Points per CPU second over the number of points, one line for each tool."""
    rows = [row for row in rows if row["unit"] == "points" and row["exit_code"] == 0]
    sizes = sorted({row["n"] for row in rows})
    series = {name: np.full(len(sizes), np.nan) for name in dict.fromkeys(row["name"] for row in rows)}
    for row in rows:
        series[row["name"]][sizes.index(row["n"])] = row["per_cpu_s"] / 1000
    places = np.log10(sizes)
    return curve(series, title="Speed", label="1000 points / CPU s", x_label="log10 points", x=places).image()


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {"cpu": cpu_name(), "cores": os.cpu_count(), "python": platform.python_version(), "system": platform.platform()}


def cpu_name() -> str:
    """The processor's name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


if __name__ == "__main__":
    main()
