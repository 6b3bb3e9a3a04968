"""Many small tiles on workers that get killed, and what a point costs then: the figures behind docs/explanation/scale.md.

    python benchmarks/scale/run.py survey --tiles 200 --points 20000 --shards 4 --kills 8
    python benchmarks/scale/run.py kills --points 20000 --kills 10

survey: tiles of a generated street are cleaned by one undisturbed process, then by shares (`--shard`) that are killed with
SIGKILL at random moments and started again with --resume, as an array job would be. kills: one scan in cells on disk, killed
once at each of some moments between start and end, then resumed. Both compare every output byte for byte, print JSON, and exit
with 1 if a byte differs. Not here: the speed of one pass (benchmarks/speed). Needs Linux or macOS.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "speed"))
from street import write

_LOOK_EVERY_S = 0.02
_UNIT = 1024 if sys.platform != "darwin" else 1


@dataclass
class Cost:
    """What some processes took in all: CPU seconds, the largest resident size of one, starts, kills, most bytes of cells."""

    cpu_s: float = 0.0
    peak_bytes: int = 0
    starts: int = 0
    kills: int = 0
    cell_bytes: int = 0
    faults: list[str] = field(default_factory=list)


def main() -> int:
    """Runs one of the two and prints its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["survey", "kills"])
    parser.add_argument("--tiles", type=int, default=200)
    parser.add_argument("--points", type=int, default=20_000, help="of a tile, or of the one scan")
    parser.add_argument("--shards", type=int, default=4, help="processes at a time")
    parser.add_argument("--kills", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--options", type=str.split, default=[], help="for pcdenoise denoise: --options='--method mean'")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = (survey if given.what == "survey" else kills)(given, Path(folder))
    print(json.dumps(figures, indent=1))
    return 0 if figures["outputs_equal"] else 1


def survey(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Unit costs of an undisturbed run, and what kills add."""
    (folder / "tiles").mkdir()
    for number in range(given.tiles):
        write(given.points, folder / "tiles" / f"{number:04}.laz")
    n = given.tiles * given.points
    plain, disturbed = Cost(), Cost()
    cell_points = max(1000, given.points // 4)
    started = time.perf_counter()
    _until_done([_command(folder, "plain", cell_points, given.options)], folder / "plain", plain, 0, random.Random(given.seed))
    plain_s = time.perf_counter() - started
    shares = [
        [*_command(folder, "shards", cell_points, given.options), "--shard", f"{number}/{given.shards}"]
        for number in range(1, given.shards + 1)
    ]
    started = time.perf_counter()
    _until_done(shares, folder / "shards", disturbed, given.kills, random.Random(given.seed), plain_s / given.shards)
    shards_s = time.perf_counter() - started
    sizes = {name: sum(path.stat().st_size for path in (folder / name).glob("[!.]*")) for name in ("tiles", "plain")}
    return {
        "points": n,
        "tiles": given.tiles,
        "points_per_cpu_s": n / plain.cpu_s,
        "points_per_cpu_s_when_killed": n / disturbed.cpu_s,
        "kills": disturbed.kills,
        "starts": disturbed.starts,
        "cpu_s_per_kill": (disturbed.cpu_s - plain.cpu_s) / max(1, disturbed.kills),
        "wall_s": {"plain": plain_s, "shards": shards_s},
        "peak_bytes_of_a_process": max(plain.peak_bytes, disturbed.peak_bytes),
        "cell_bytes_per_point": plain.cell_bytes / given.points,
        "input_bytes_per_point": sizes["tiles"] / n,
        "output_bytes_per_point": sizes["plain"] / n,
        "faults": plain.faults + disturbed.faults,
        "outputs_equal": _contents(folder / "plain") == _contents(folder / "shards")
        and len(list((folder / "plain").iterdir())) == given.tiles,
    }


def kills(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One scan in some ten cells, killed once at each of some moments, whole runs apart from each other."""
    (folder / "tiles").mkdir()
    write(given.points, folder / "tiles" / "scan.laz")
    cell_points = max(1000, given.points // 10)
    rng = random.Random(given.seed)
    started = time.perf_counter()
    _until_done([_command(folder, "plain", cell_points, given.options)], folder / "plain", Cost(), 0, rng)
    whole_s = time.perf_counter() - started
    trials = []
    for number in range(given.kills):
        target = f"killed_{number}"
        command = _command(folder, target, cell_points, given.options)
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        moment = whole_s * rng.random()
        time.sleep(moment)
        was_running = process.poll() is None
        process.kill()
        process.wait()
        n_cells = len(list((folder / target).glob(".*.cells/pass_*/*.f64")))
        _until_done([command], folder / target, Cost(), 0, rng)
        same = _contents(folder / target) == _contents(folder / "plain")
        left = [path.name for path in (folder / target).iterdir() if path.suffix == ".cells"]
        trials.append({"at_s": moment, "was_running": was_running, "cells_done": n_cells, "same": same, "left": left})
    return {"whole_s": whole_s, "trials": trials, "outputs_equal": all(trial["same"] and not trial["left"] for trial in trials)}


def _command(folder: Path, target: str, cell_points: int, options: list[str]) -> list[str]:
    clean = ["denoise", str(folder / "tiles"), "-o", f"{folder / target}/", "--resume", "-q", "--threads", "1"]
    return [sys.executable, "-m", "pcdenoise", *clean, "--tile", str(cell_points), *options]


def _until_done(
    commands: list[list[str]], target: Path, cost: Cost, n_kills: int, rng: random.Random, expected_s: float = 0.0
) -> None:
    """All commands side by side; a random one is killed at each of some random moments, and what was killed starts again."""
    began = time.perf_counter()
    moments = sorted(expected_s * rng.random() for _ in range(n_kills))
    running: dict[int, list[str]] = {}

    def start(command: list[str]) -> None:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        process.returncode = 0  # waited for below
        running[process.pid] = command
        cost.starts += 1

    for command in commands:
        start(command)
    while running:
        if moments and time.perf_counter() - began > moments[0]:
            moments.pop(0)
            os.kill(rng.choice(list(running)), signal.SIGKILL)
            cost.kills += 1
        cost.cell_bytes = max(cost.cell_bytes, _cell_bytes(target) // len(commands))
        for pid in list(running):
            ended, status, usage = os.wait4(pid, os.WNOHANG)
            if ended:
                command, code = running.pop(pid), os.waitstatus_to_exitcode(status)
                cost.cpu_s += usage.ru_utime + usage.ru_stime
                cost.peak_bytes = max(cost.peak_bytes, usage.ru_maxrss * _UNIT)
                if code == -signal.SIGKILL:
                    start(command)
                elif code:
                    cost.faults.append(f"exit code {code}: {' '.join(command[2:])}")
        time.sleep(_LOOK_EVERY_S)


def _cell_bytes(target: Path) -> int:
    """What the cells below a folder take; those that go while they are looked at do not count."""
    try:
        return sum(path.stat().st_size for path in target.glob(".*.cells/*/*"))
    except FileNotFoundError:
        return 0


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("[!.]*"))}


if __name__ == "__main__":
    sys.exit(main())
