"""Every file of a folder through info, denoise and verify, then faults, signals and mutated files: nothing lost, hung or crashed.

    python benchmarks/robustness/run.py FOLDER [--minutes 15] [--kills 40] [--json FILE]

Exit code 0 if nothing was lost, hung or crashed, else 5. Not here: what is right for one odd file (the tests say that).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import pcdenoise.denoising.denoiser
import pcdenoise.evaluation.report
import pcdenoise.networks.store  # noqa: F401
from pcdenoise import commands, io
from pcdenoise.cloud.scan import Scan
from pcdenoise.errors import ScanError

COMMAND = [sys.executable, "-m", "pcdenoise"]
TIME_LIMIT_S, TIME_PER_MILLION_POINTS_S = 10.0, 120.0
MEMORY_FLOOR, MEMORY_PER_BYTE, MEMORY_PER_POINT = 700 << 20, 40, 4000
EXPECTED_CODES = {0, 3}
FAST = ["--method", "mean", "-q", "--threads", "1"]
LARGEST_SEED = 200_000
"""Bytes of the largest file that is mutated."""


@dataclass
class Tally:
    """What was tried, and every fault in a sentence."""

    counts: Counter[str] = field(default_factory=Counter)
    formats: Counter[str] = field(default_factory=Counter)
    refused: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    largest_mb: float = 0.0
    slowest_s: float = 0.0

    def judge(self, name: str, done: Done, codes: set[int]) -> None:
        """One fault for each promise that a process broke."""
        self.largest_mb, self.slowest_s = max(self.largest_mb, done.peak / 2**20), max(self.slowest_s, done.seconds)
        if done.hung:
            self.faults.append(f"{name}: hung")
        elif done.code not in codes:
            self.faults.append(f"{name}: exit code {done.code}: {done.stderr[-200:]}")
        if "Traceback" in done.stderr or "Exception ignored" in done.stderr:
            self.faults.append(f"{name}: traceback: {done.stderr[-200:]}")
        if done.code == 3 and len(done.stderr.splitlines()) != 1:
            self.faults.append(f"{name}: {len(done.stderr.splitlines())} lines on stderr instead of one")

    def check(self, name: str, holds: bool, what: str) -> None:
        """A fault unless the promise holds."""
        if not holds:
            self.faults.append(f"{name}: {what}")


@dataclass(frozen=True)
class Done:
    """How a process ended: exit code (negative: killed by a signal), both streams, seconds, peak memory in bytes."""

    code: int
    stdout: str
    stderr: str
    seconds: float
    peak: int
    hung: bool


def run(
    arguments: list[str],
    limit_s: float,
    *,
    stdout: Any = None,
    disturb: Callable[[int], object] | None = None,
    after_s: float = 0,
    file_size: int = 0,
    room: int = 0,
) -> Done:
    """The command line in a process of its own, with a time limit, on request disturbed or with limits of file sizes and memory.

    disturb: is called with the process' number after so many seconds. Such a process starts from nothing, so that imports are hit
    too; the others are forks of this one, which has loaded the libraries already.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        started, hung, disturbed = time.monotonic(), False, disturb is None
        target = out if stdout is None else stdout
        pid = _started(arguments, target, errors) if disturb else _forked(arguments, target, errors, file_size, room)
        while not (ended := os.wait4(pid, os.WNOHANG))[0]:
            elapsed = time.monotonic() - started
            if disturb and not disturbed and elapsed > after_s:
                disturb(pid)
                disturbed = True
            if elapsed > limit_s and not hung:
                os.kill(pid, signal.SIGKILL)
                hung = True
            time.sleep(0.005)
        _, status, usage = ended
        out.seek(0)
        errors.seek(0)
        texts = [stream.read().decode(errors="replace") for stream in (out, errors)]
        cpu_s = usage.ru_utime + usage.ru_stime
        return Done(os.waitstatus_to_exitcode(status), *texts, cpu_s, usage.ru_maxrss * 1024, hung)


def _started(arguments: list[str], stdout: Any, stderr: Any) -> int:
    process = subprocess.Popen([*COMMAND, *arguments], stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr)
    process.returncode = 0  # waited for above, not by Popen
    return process.pid


def _forked(arguments: list[str], stdout: Any, stderr: Any, file_size: int, room: int) -> int:
    if pid := os.fork():
        return pid
    code = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(stdout if isinstance(stdout, int) else stdout.fileno(), 1)
        os.dup2(stderr.fileno(), 2)
        if file_size:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
        if room:
            size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + room
            resource.setrlimit(resource.RLIMIT_AS, (size, size))
        code = commands.main(arguments)
    except SystemExit as stop:
        code = int(stop.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def through_all_commands(path: Path, folder: Path, tally: Tally) -> None:
    """info, denoise with the network, verify; in bounded time and memory, refused by all or by none.

    This process reads nothing itself: the threads that lazrs would start in it do not survive the forks.
    """
    tally.counts["files"] += 1
    target = folder / path.name.replace(".copc", "")
    threads = ["--threads", "1"]
    steps = {
        "info": ["info", str(path), "--json", *threads],
        "denoise": ["denoise", str(path), "-o", str(target), "--overwrite", "-q", *threads],
        "verify": ["verify", str(path), str(target)],
    }
    n_points, is_refused = 0, False
    for name, arguments in steps.items():
        done = run(arguments, 300)  # wall time, for what waits; CPU time is what is judged
        title = f"{name} {path.name}"
        tally.judge(title, done, EXPECTED_CODES)
        if name == "info":
            is_refused = done.code == 3
            n_points = 0 if done.code else json.loads(done.stdout)[0]["points"]
            tally.formats["refused" if is_refused else io.SUFFIXES[path.suffix.lower()]] += 1
        tally.seconds[title] = round(done.seconds, 2)
        limit_s = TIME_LIMIT_S + TIME_PER_MILLION_POINTS_S * n_points / 1e6
        most = MEMORY_FLOOR + MEMORY_PER_BYTE * path.stat().st_size + MEMORY_PER_POINT * n_points
        tally.check(title, done.seconds <= limit_s, f"took {done.seconds:.1f} CPU s")
        tally.check(title, done.peak <= most, f"took {done.peak / 2**20:.0f} MB")
        if is_refused:
            tally.refused[path.name] = done.stderr.strip()
            tally.check(title, done.code == 3 and not target.exists(), "was not refused")
            if name == "denoise":
                break
        elif name == "denoise" and done.code == 3:  # as when a move leads beyond LAS' integers
            tally.refused[path.name] = done.stderr.strip()
            tally.check(title, not target.exists(), "was refused and written")
            break
        else:
            tally.check(title, done.code == 0, f"readable, but {done.stderr[-200:]}")
    target.unlink(missing_ok=True)
    tally.check(path.name, not list(folder.iterdir()), "something is left beside the output")


def faults(scan: Path, folder: Path, tally: Tally) -> None:
    """Full disk, folders that cannot be written, inputs that are not there, readers that leave; the old file stays."""
    target = folder / f"out{scan.suffix}"

    def injected(name: str, arguments: list[str], codes: set[int], stdout: Any = None, **limits: Any) -> None:
        target.write_bytes(b"old")
        done = run(arguments, 60, stdout=stdout, **limits)
        tally.counts["faults injected"] += 1
        tally.judge(name, done, codes)
        tally.check(name, target.read_bytes() == b"old", "the old file is gone")
        tally.check(name, [path.name for path in folder.iterdir()] == [target.name], "something is left beside the output")

    to_target = ["denoise", str(scan), "-o", str(target), "--overwrite", *FAST]
    for size in (1000, 5000, scan.stat().st_size // 2):
        injected(f"files of at most {size} bytes", to_target, {3}, file_size=size)
    injected("a full device", ["denoise", str(scan), "-o", "/dev/full", "--format", "ply", *FAST], {3})
    with open("/dev/full", "wb") as full:
        injected("a full stdout", ["denoise", str(scan), "-o", "-", "--format", "ply", *FAST], {3}, stdout=full)
        injected("a full stdout of info", ["info", str(scan)], {3}, stdout=full)
    for name, place in (("proc", "/proc/none/out.ply"), ("a file as folder", f"{scan}/out.ply")):
        injected(f"a target in {name}", ["denoise", str(scan), "-o", place, *FAST], {3})
    injected("an input that has gone", ["denoise", str(folder / "gone.las"), "-o", str(target), "--overwrite", *FAST], {3})
    injected("a batch with a broken input", ["denoise", str(scan), "/dev/zero", "-o", f"{folder}/", "--dry-run"], {3})
    for n_read in (0, 10):
        reader, writer = os.pipe()
        shut = subprocess.Popen(["head", "-c", str(n_read)], stdin=reader, stdout=subprocess.DEVNULL)
        os.close(reader)
        shut.wait() if n_read == 0 else None
        injected(
            f"a reader that leaves after {n_read} bytes",
            ["denoise", str(scan), "-o", "-", "--format", "ply", *FAST],
            {0, 141},
            stdout=writer,
        )
        os.close(writer)
        shut.wait()
    large = folder.with_name(folder.name + ".xyz")
    rng = np.random.default_rng(0)
    np.savetxt(large, np.column_stack([rng.random((200_000, 2)), rng.normal(0, 0.002, 200_000)]), fmt="%.6f")
    for method in ("network", "mean", "jet"):
        for megabytes in (1, 8, 32):
            arguments = ["denoise", str(large), "-o", str(target), "--overwrite", "-q", "--threads", "1", "--method", method]
            injected(f"{megabytes} MB of memory for {method}", arguments, {3}, room=megabytes << 20)
    large.unlink()
    target.unlink()


def signals(scan: Path, folder: Path, n: int, rng: random.Random, tally: Tally) -> None:
    """Signals at random moments of a run: the target is the old or the complete new file, and the exit code is right."""
    target = folder / f"out{scan.suffix}"
    arguments = ["denoise", str(scan), "-o", str(target), "--overwrite", *FAST]
    began = time.monotonic()
    run(arguments, 300, disturb=signal_of(signal.SIGTERM), after_s=float("inf"))
    new, wall_s = target.read_bytes(), time.monotonic() - began
    for i in range(n):
        number = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP)[i % 4]
        target.write_bytes(b"old")
        moment = rng.uniform(0.05, 1.2 * wall_s)
        done = run(arguments, 120, disturb=signal_of(number), after_s=moment)
        tally.counts["signals"] += 1
        name = f"{number.name} after {moment:.2f} s"
        tally.judge(name, done, {0, -number, 128 + number})
        content = target.read_bytes()
        tally.check(name, content == new or (content == b"old" and done.code != 0), "the target is neither old nor new")
        left = [path.name for path in folder.iterdir() if path != target]
        if number == signal.SIGKILL:  # nobody can tidy up after it but the next run, which does so after a minute
            tally.check(name, set(left) <= {f".{target.name}.part"}, f"{left} is left")
            for part in folder.glob(".*.part"):
                os.utime(part, (0, 0))
        else:
            tally.check(name, not left, f"{left} is left")
    run(arguments, 120)
    tally.check("a run after all signals", [path.name for path in folder.iterdir()] == [target.name], "leftovers stay")
    target.unlink()


def signal_of(number: int) -> Callable[[int], object]:
    """Sends a process that signal."""
    return lambda pid: os.kill(pid, number)


def kill_a_worker(pid: int) -> None:
    """SIGKILL to the youngest child of a process, which is one of its workers if it has any."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    if children:
        os.kill(int(children[-1]), signal.SIGKILL)


def in_cells(folder: Path, n_signals: int, rng: random.Random, tally: Tally) -> None:
    """The same for scans in cells and in workers: after every fault the next run, with --resume, gives the undisturbed bytes."""
    source, target = folder / "in", folder / "out"
    generator = np.random.default_rng(0)
    source.mkdir()
    for k, suffix in enumerate(("las", "laz", "ply", "xyz")):
        x, y = generator.random((2, 5000 + 500 * k))
        points = np.column_stack([x, y, 0.1 * np.sin(6 * x) + generator.normal(0, 0.005, len(x))]).round(5)
        io.write(Scan(points), source / f"{suffix}.{suffix}")
    raw = {path.name: path.read_bytes() for path in source.iterdir()}
    arguments = ["denoise", str(source), "-o", f"{target}/", "--tile", "1000", *FAST]
    began = time.monotonic()
    done = run(arguments, 300, disturb=signal_of(signal.SIGTERM), after_s=float("inf"))
    wall_s = time.monotonic() - began
    tally.judge("in cells", done, {0})
    expected = {path.name: path.read_bytes() for path in target.iterdir()}

    def disturbed(name: str, codes: set[int], *more: str, **how: Any) -> None:
        shutil.rmtree(target)
        target.mkdir()
        done = run([*arguments, *more], 120, **how)
        if done.code == 1:  # a batch goes on, with a line for each input that failed and one at the end
            tally.check(name, len(done.stderr.splitlines()) <= len(raw) + 1, f"said {done.stderr[-300:]}")
        tally.judge(name, done, codes)
        for path in target.iterdir():
            is_part = path.name.startswith(".") and path.name.endswith((".cells", ".part"))
            tally.check(name, is_part or path.read_bytes() == expected[path.name], f"{path.name} is neither whole nor absent")
        for name_, content in raw.items():
            (source / name_).write_bytes(content)
        for part in target.glob(".*.part"):  # what SIGKILL left: old enough for the next run
            os.utime(part, (0, 0))
        again = run([*arguments, "--resume"], 120)
        tally.judge(f"resume after {name}", again, {0})
        found = {path.name: path.read_bytes() for path in target.iterdir() if path.is_file()}
        tally.check(f"resume after {name}", found == expected, "gave other bytes")
        tally.check(f"resume after {name}", {path.name for path in target.iterdir()} == set(expected), "something is left")

    for size in (10_000, 40_000, 100_000):
        tally.counts["faults injected"] += 1
        disturbed(f"cells of at most {size} bytes", {0, 1}, file_size=size)
    for megabytes in (1, 4, 16):
        tally.counts["faults injected"] += 1
        # lazrs, in Rust, ends the process where memory is out
        disturbed(f"{megabytes} MB of memory for cells", {0, 1, -signal.SIGABRT}, room=megabytes << 20)

    def cut(pid: int) -> None:
        for path in source.iterdir():
            if path.suffix != ".xyz":  # half a text is a text
                os.truncate(path, path.stat().st_size // 2)

    for _ in range(4):
        tally.counts["faults injected"] += 1
        moment = rng.uniform(0.3, 0.9) * wall_s
        disturbed(f"inputs cut after {moment:.2f} s", {0, 1}, disturb=cut, after_s=moment)
    for _ in range(4):
        tally.counts["faults injected"] += 1
        moment = rng.uniform(0.3, 0.9) * wall_s
        more = ("--workers", "2", "--threads", "1")
        disturbed(f"a worker killed after {moment:.2f} s", {0}, *more, disturb=kill_a_worker, after_s=moment)
    for k in range(n_signals):
        tally.counts["signals"] += 1
        number = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP)[k % 4]
        more = ("--workers", "2") if k % 8 >= 4 and number != signal.SIGKILL else ()
        moment = rng.uniform(0.3, 1.0) * wall_s
        name = f"{number.name} after {moment:.2f} s in cells"
        disturbed(name, {0, -number, 128 + number}, *more, disturb=signal_of(number), after_s=moment)


def mutated(raw: bytes, rng: random.Random) -> bytes:
    """The bytes with a few numbers, pieces or the end changed, mostly near the start, where headers are."""
    broken = bytearray(raw)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(min(len(broken), 600) if rng.random() < 0.7 else len(broken))
        match rng.randrange(6):
            case 0:
                broken[at : at + 4] = rng.choice([b"\xff" * 4, bytes(4), b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xf8\x7f"])
            case 1:
                broken[at] ^= 1 << rng.randrange(8)
            case 2:
                del broken[at : at + rng.randint(1, 64)]
            case 3:
                broken[at:at] = broken[at : at + rng.randint(1, 64)] * rng.randint(1, 3)
            case 4:
                broken[at:at] = rng.choice([b"nan", b"-1e999", b"99999999999999999999", b"\n\n", b"\0", b"list uchar int ", b'"'])
            case _:
                del broken[max(at, 1) if rng.random() < 0.3 else len(broken) :]
        if not broken:
            break
    return bytes(broken)


def fuzz(paths: list[Path], minutes: float, rng: random.Random, tally: Tally) -> None:
    """Mutated files read, moved and written in this process: ScanError or a round trip, in bounded time."""
    seeds = [(path.name, path.read_bytes()) for path in paths if 0 < path.stat().st_size <= LARGEST_SEED]
    with tempfile.TemporaryDirectory() as name:
        end, folder = time.monotonic() + 60 * minutes, Path(name)
        while time.monotonic() < end and seeds:
            source, raw = rng.choice(seeds)
            broken = mutated(raw, rng)
            path = folder / f"fuzz{Path(source).suffix}"
            path.write_bytes(broken)
            tally.counts["mutated files"] += 1
            started = time.process_time()
            try:
                round_trip(path, folder / f"back{path.suffix}")
            except ScanError as fault:
                tally.counts["mutated files refused"] += 1
                tally.check(source, "\n" not in str(fault), "a message of several lines")
            except Exception as fault:
                kept = Path(tempfile.gettempdir()) / f"pcdenoise-fault-{hashlib.sha256(broken).hexdigest()[:12]}{path.suffix}"
                kept.write_bytes(broken)
                tally.faults.append(f"fuzz {source}: {type(fault).__name__} {fault}; kept as {kept}")
            tally.check(f"fuzz {source}", time.process_time() - started < TIME_LIMIT_S, "took more than 10 CPU s")


def round_trip(path: Path, back: Path) -> None:
    """Reads, moves, writes and reads again: the same rows and attributes byte for byte. Raises ScanError if it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scan = io.read(path)
    with np.errstate(all="ignore"):
        io.write(scan.moved_to(scan.points + 0.001), back, overwrite=True)
    again = io.read(back)
    assert len(again) == len(scan), f"{len(scan)} rows became {len(again)}"
    for name, values in scan.attributes.items():
        native = values.dtype.newbyteorder("=")
        assert values.astype(native).tobytes() == again.attributes[name].astype(native).tobytes(), name


def scans(folder: Path) -> Iterator[Path]:
    """Every file below a folder that has a scan's suffix."""
    return (path for path in sorted(folder.rglob("*")) if path.is_file() and io.is_scan(path))


def main() -> int:
    """Runs it all and prints the tally."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="+", help="folders of scans, broken ones too")
    parser.add_argument("--minutes", type=float, default=15, help="minutes of mutated files")
    parser.add_argument("--kills", type=int, default=40, help="signals at random moments")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the tally here")
    options = parser.parse_args()
    paths = [path for folder in options.folder for path in scans(folder)]
    tally, rng = Tally(), random.Random(options.seed)
    sample = Path(__file__).resolve().parents[2] / "examples" / "milk.pcd"

    def stage(work: Callable[[Path], None]) -> None:
        folder = Path(tempfile.mkdtemp())
        print(f"{time.strftime('%H:%M:%S')}  {len(tally.faults)} faults so far", file=sys.stderr, flush=True)
        try:
            work(folder)
        finally:
            shutil.rmtree(folder)

    stage(lambda folder: faults(sample, folder, tally))
    stage(lambda folder: [through_all_commands(path, folder, tally) for path in paths] and None)
    stage(lambda folder: signals(sample, folder, options.kills, rng, tally))
    stage(lambda folder: in_cells(folder, -(-options.kills // 2), rng, tally))
    fuzz(paths, options.minutes, rng, tally)
    n_mutated, n_refused = tally.counts["mutated files"], tally.counts["mutated files refused"]
    print(f"files tried      {tally.counts['files']}, {len(tally.refused)} of them refused in one line")
    print(f"formats          {', '.join(f'{name} {n}' for name, n in sorted(tally.formats.items()))}")
    print(f"faults injected  {tally.counts['faults injected']}")
    print(f"signals          {tally.counts['signals']}")
    print(f"fuzz minutes     {options.minutes:g}: {n_mutated} files, {n_refused} refused")
    slowest = sorted(tally.seconds.items(), key=lambda pair: -pair[1])[:5]
    print(f"slowest          {', '.join(f'{name} {seconds:.1f} CPU s' for name, seconds in slowest)}")
    print(f"most             {tally.slowest_s:.1f} CPU s, {tally.largest_mb:.0f} MB")
    print("\n".join(tally.faults) or "nothing lost, hung or crashed")
    if options.json:
        options.json.write_text(json.dumps({**vars(tally), "minutes": options.minutes, "seed": options.seed}, indent=1) + "\n")
    return 5 if tally.faults else 0


if __name__ == "__main__":
    sys.exit(main())
