"""CPU seconds until pcdenoise shows its help, and until `pcdenoise denoise` has read the first points of a scan.

    python benchmarks/speed/start_up.py -o start-up/
    python benchmarks/speed/start_up.py --runs 3 --scan examples/ground.laz -o start-up/

Writes start_up.json: the least of several runs in turn, imports included, beside an interpreter that does nothing; for sources
that Python has compiled before, as an installation has them, and in the environment as it is. Not here: speed (measure.py).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from measure import machine, run

from pcdenoise import __version__

GROUND = Path(__file__).resolve().parents[2] / "examples" / "ground.laz"
UNTIL_READ = """
import os, sys, time
from pcdenoise.commands import main
from pcdenoise.io import laz
decompressed = laz.decompressed

def until_the_first(*arguments):
    next(decompressed(*arguments))
    print(time.process_time(), flush=True)
    os._exit(0)

laz.decompressed = until_the_first
sys.exit(main(sys.argv[1:]) or "no points were decoded")
"""


def main() -> None:
    """Measures both and an empty program in turn, so that a busy minute falls on all alike."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10, help="the least of so many counts")
    parser.add_argument("--scan", type=Path, default=GROUND, help="a .laz file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder")
    options = parser.parse_args()
    load_before = os.getloadavg()[0]
    least: dict[tuple[str, bool], float] = {}
    with tempfile.TemporaryDirectory() as folder:
        denoise = ["denoise", str(options.scan), "-o", str(Path(folder, "clean.laz"))]
        programs = {
            "python, nothing": ["-c", "pass"],
            "--help": ["-m", "pcdenoise", "--help"],
            "denoise, first points read": ["-c", UNTIL_READ, *denoise],
        }
        as_it_is = dict(os.environ)
        compiled = {**as_it_is, "PYTHONPYCACHEPREFIX": str(Path(folder, "compiled"))}
        compiled.pop("PYTHONDONTWRITEBYTECODE", None)
        for _ in range(options.runs + 1):  # the first compiles
            for name, program in programs.items():
                for environment in (as_it_is, compiled):
                    found = run([sys.executable, *program], environment)
                    if found["exit_code"]:
                        sys.exit(f"{name}: {' '.join(found['fault'])}")
                    cpu_s = float(found["stdout"]) if UNTIL_READ in program else found["cpu_s"]
                    case = name, environment is compiled
                    least[case] = min(cpu_s, least.get(case, cpu_s))
    rows: list[dict[str, Any]] = [
        {"name": name, "is_compiled": is_compiled, "runs": options.runs, "cpu_s": cpu_s}
        for (name, is_compiled), cpu_s in least.items()
    ]
    for row in rows:
        print(f"{row['name']:30} {'compiled' if row['is_compiled'] else 'as it is':10} {row['cpu_s']:6.2f} CPU s")
    options.output.mkdir(parents=True, exist_ok=True)
    done = {"pcdenoise": __version__, "machine": machine(), "load_before": load_before, "rows": rows}
    (options.output / "start_up.json").write_text(json.dumps(done, indent=1) + "\n")


if __name__ == "__main__":
    main()
