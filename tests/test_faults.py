"""Disks that fill, readers that leave, kills, no memory: the target is the old or the whole new one, with the right exit code."""

from __future__ import annotations

import fcntl
import io as streams
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from pcdenoise import whole_files
from pcdenoise.commands import main
from pcdenoise.commands.files import Job
from pcdenoise.commands.processes import in_processes
from pcdenoise.commands.workers import Figures
from pcdenoise.denoising import plan, tiles
from pcdenoise.errors import PcdenoiseError, of_the_system
from pcdenoise.io import files
from pcdenoise.networks import store

ROOT = Path(__file__).resolve().parent.parent
FAST = ["--method", "mean", "-q"]
Run = Callable[..., subprocess.CompletedProcess[bytes]]

_LIMITED = """
import resource, sys
from pcdenoise.commands import main
small, large, out = sys.argv[1:]
assert main(["denoise", small, "-o", out, "--overwrite", "--method", "mean", "-q", "--threads", "1"]) == 0
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
sys.exit(main(["denoise", large, small, "-o", out, "--overwrite", "--method", "mean", "-q", "--threads", "1"]))
"""


@pytest.fixture
def scan(tmp_path: Path, rng: np.random.Generator) -> Path:
    """200 noisy points of a plane in a folder of their own."""
    folder = tmp_path / "in"
    folder.mkdir()
    np.savetxt(folder / "scan.xyz", rng.normal(size=(200, 3)) * [1, 1, 0.01], fmt="%.4f")
    return folder / "scan.xyz"


def one_line(captured: str) -> str:
    assert captured.count("\n") == 1, captured
    return captured


def interrupted_write(target: Path, fault: BaseException) -> None:
    with whole_files.replaced(target) as file:
        file.write(b"half")
        raise fault


def test_a_full_disk_leaves_the_old_file_and_the_batch_goes_on(scan: Path, tmp_path: Path, rng: np.random.Generator) -> None:
    """The limit lets the small scan through and stops the large one in the middle of its output."""
    large, small, out = scan.with_name("a_large.xyz"), scan.with_name("small.xyz"), tmp_path / "out"
    large.write_bytes(scan.read_bytes())
    small.write_bytes(b"".join(scan.read_bytes().splitlines(keepends=True)[:40]))
    out.mkdir()
    (out / "a_large.xyz").write_bytes(b"old")
    done = subprocess.run(
        [sys.executable, "-c", _LIMITED, small, large, f"{out}/"],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "a_large.xyz: cannot be written (File too large)" in done.stderr.splitlines()[0]
    assert (out / "a_large.xyz").read_bytes() == b"old"
    assert sorted(path.name for path in out.iterdir()) == ["a_large.xyz", "small.xyz"]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (MemoryError(), "scan.xyz: out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"), "scan.xyz: out of memory"),
        (RuntimeError("can't start new thread"), "scan.xyz: out of memory"),
        (OSError(5, "Input/output error"), "scan.xyz: Input/output error"),
        (PermissionError(13, "Permission denied", "/out"), "/out: Permission denied"),
    ],
)
def test_what_the_system_refuses_one_input_is_one_line_and_the_others_go_on(
    fault: Exception, words: str, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = scan.with_name("zz.xyz")
    other.write_bytes(scan.read_bytes())
    read = pcdenoise.io.read

    def failing(path: Path, **options: str | None) -> pcdenoise.Scan:
        if Path(path).name == "scan.xyz":
            raise fault
        return read(path, **options)

    monkeypatch.setattr(pcdenoise.io, "read", failing)
    assert main(["denoise", str(scan), "-o", str(tmp_path / "one.xyz"), *FAST]) == 3
    assert words in one_line(capsys.readouterr().err)
    assert main(["denoise", str(scan.parent), "-o", f"{tmp_path}/out/", *FAST]) == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["zz.xyz"]


def test_a_bug_is_no_fault_of_the_system() -> None:
    for bug in (ValueError("no"), RuntimeError("shapes do not match"), BrokenPipeError(32, "Broken pipe")):
        assert of_the_system(bug) is None


def test_an_input_that_vanishes_after_the_command_has_found_it_is_named(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def gone(path: Path, **_: str | None) -> pcdenoise.Scan:
        scan.unlink()
        return read(path)

    read = pcdenoise.io.read
    monkeypatch.setattr(pcdenoise.io, "read", gone)
    assert main(["denoise", str(scan), "-o", str(tmp_path / "out.xyz"), *FAST]) == 3
    assert "scan.xyz: no such file" in one_line(capsys.readouterr().err)


@pytest.mark.parametrize("target", ["/proc/none/out.xyz", "{scan}/out.xyz", "{scan}/"])
def test_a_place_that_cannot_be_written_is_one_line(target: str, scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["denoise", str(scan), "-o", target.format(scan=scan), *FAST]) == 3
    one_line(capsys.readouterr().err)
    assert [path.name for path in scan.parent.iterdir()] == ["scan.xyz"]


def test_signals_at_any_moment_leave_the_old_or_the_whole_new_file(scan: Path, rng: np.random.Generator) -> None:
    """One process, many writes: a thread sends SIGTERM at random moments while the target is replaced over and over."""
    target = scan.with_name("out.bin")
    seen = set()

    class Killed(BaseException):
        pass

    def kill(number: int, frame: object) -> None:
        raise Killed

    before = signal.signal(signal.SIGUSR1, kill)
    try:
        for moment in rng.uniform(0, 0.004, 60).tolist():
            target.write_bytes(b"old")
            sender = threading.Timer(moment, os.kill, (os.getpid(), signal.SIGUSR1))
            try:
                sender.start()
                with whole_files.replaced(target) as file:
                    for _ in range(20):
                        file.write(b"new!" * 1000)
                        file.flush()
                time.sleep(1)
            except Killed:
                pass
            sender.join()
            content = target.read_bytes()
            assert content in (b"old", b"new!" * 20_000)
            seen.add(content[:3])
            assert {path.name for path in scan.parent.iterdir()} == {"scan.xyz", "out.bin"}
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert b"old" in seen or b"new" in seen


def test_what_a_killed_run_left_is_removed_by_the_next_one_unless_it_is_still_written_to(tmp_path: Path) -> None:
    target, part = tmp_path / "out.las", tmp_path / ".out.las.part"

    def names_after_a_write() -> list[str]:
        with whole_files.replaced(target) as file:
            file.write(b"new")
        return sorted(path.name for path in tmp_path.iterdir())

    part.write_bytes(b"half")
    assert names_after_a_write() == [".out.las.part", "out.las"], "young: another run may be about to lock it"
    os.utime(part, (0, 0))
    with part.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert names_after_a_write() == [".out.las.part", "out.las"], "locked: another run writes to it"
    os.utime(part, (0, 0))
    assert names_after_a_write() == ["out.las"]
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize("name", ["点" * 80 + ".xyz", "a" * 250, "\udcff.xyz"])
def test_the_longest_and_oddest_names_can_be_written(name: str, tmp_path: Path) -> None:
    with whole_files.replaced(tmp_path / name) as file:
        file.write(b"new")
    assert (tmp_path / name).read_bytes() == b"new"
    with pytest.raises(KeyboardInterrupt):
        interrupted_write(tmp_path / name, KeyboardInterrupt())
    assert len(list(tmp_path.iterdir())) == 1


def test_a_second_kill_does_not_disturb_the_tidying_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("pcdenoise.commands._run", killed)
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_while_a_library_makes_its_classes_is_no_bug(
    number: int, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Python 3.11 makes a RuntimeError of what is raised in __set_name__, and a traceback was printed."""

    class Slow:
        def __set_name__(self, owner: type, name: str) -> None:
            os.kill(os.getpid(), number)

    def loads(_: object) -> None:
        type("Library", (), {"slow": Slow()})

    monkeypatch.setattr("pcdenoise.commands._run", loads)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        found: object = main([])
    except SystemExit as stop:
        found = stop.code
    except KeyboardInterrupt:  # from 3.12 on, as it is; Typer catches that one
        found = 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert found == code
    assert "Traceback" not in capsys.readouterr().err


def test_a_signal_that_was_ignored_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        monkeypatch.setattr("pcdenoise.commands._run", lambda _: os.kill(os.getpid(), signal.SIGHUP))
        assert main([]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder in which nobody can make a file")
@pytest.mark.parametrize(
    ("command", "target"),
    [
        ("denoise {scan} -o {target}", "clean.xyz"),
        ("denoise {scan} -o {target}", "new/clean.xyz"),
        ("denoise {scan} -o {scan}.xyz --report {target}", "report.json"),
        ("info {scan} --picture {target}", "scan.png"),
        ("bench {scan} --report {target}", "report.json"),
        ("undo {scan} -o {target}", "raw.las"),
        ("train --data {scan} -o {model} --report {target}", "report.json"),
        ("split {scan} -o {target}", "parts/"),
        ("pairs {scan} -o {target}", "pairs/"),
        ("iterate {scan} -o {target}", "passes/"),
        ("tune {scan} --method mean -o {target}", "tuned.toml"),
        ("synth shapes:1 -o {target}", "data/"),
        ("train --data {scan} -o {target}", "model/"),
        ("eval-chamfer {scan} --clean {scan} --report {target}", "report.json"),
    ],
)
def test_a_folder_that_takes_no_file_is_told_before_any_scan_is_read(
    command: str, target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, target = tmp_path / "scan.xyz", f"/proc/{target}"
    scan.write_text("no scan")
    assert main(command.format(scan=scan, target=target, model=tmp_path / "model").split()) == 3
    said = capsys.readouterr().err
    assert said.startswith(f"pcdenoise: {target.rstrip('/')}")
    assert ": cannot be written (" in said
    assert [path.name for path in tmp_path.iterdir()] == ["scan.xyz"]


SHELL = {
    "denoise {scan} -o - --format xyz -q --method mean > /dev/full": (3, "stdout: cannot be written"),
    "info {scan} > /dev/full": (3, "stdout: No space left on device"),
    "info {scan} >&-": (3, "Bad file descriptor"),
    "denoise {scan} -o {scan}.ply -q --method mean 2>&-": (0, ""),
    "info {scan}.none 2>&-": (3, ""),
    "info - <&-": (3, "stdin: is empty"),
    "info {scan} | true": (141, ""),
    "denoise {scan} -o - --format xyz -q --method mean | true": (141, ""),
}
"""Command line -> exit code and what stderr says, which is one line or nothing."""


@pytest.mark.parametrize("line", SHELL)
def test_streams_that_are_full_closed_or_left_end_with_the_right_code(line: str, scan: Path) -> None:
    code, words = SHELL[line]
    command, pipe, rest = line.format(scan=scan).partition(" | ")
    script = f"{sys.executable} -m pcdenoise {command}{' | (exec <&-; ' + rest + ')' if pipe else ''}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, timeout=300
    )
    assert done.returncode == code, done.stderr
    assert words in done.stderr
    assert done.stderr.count("\n") == bool(words), done.stderr


def test_endless_and_special_inputs_are_told_or_waited_for_in_bounded_memory(
    scan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", "/dev/zero", "--format", "las"]) == 3
    assert "is a device" in one_line(capsys.readouterr().err)
    pipe = scan.with_name("pipe.xyz")
    os.mkfifo(pipe)
    writer = threading.Thread(target=lambda: pipe.write_bytes(scan.read_bytes()))
    writer.start()
    assert main(["info", str(pipe), "--json"]) == 0
    writer.join()
    assert main(["info", str(scan.parent), "--json"]) == 0, "a pipe in a folder is no scan of it"

    class Endless(streams.RawIOBase):
        def read(self, size: int = -1) -> bytes:
            return b"1 2 3\n" * (size // 6)

    monkeypatch.setattr(os, "sysconf", lambda name: 1 << 13)  # a machine with 64 MB
    with pytest.raises(PcdenoiseError, match="more than memory holds"):
        files._stream_bytes(Endless(), "stdin")  # type: ignore[arg-type]


def test_links_in_circles_are_entered_once_and_hidden_files_are_left_alone(
    scan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = scan.parent
    for name in ("one", "two"):
        (folder / name).symlink_to(folder)  # two ways round: 2^40 paths before the system gives up
    (folder / "._scan.xyz").write_bytes(b"\0\5\26\7 what a Mac leaves beside a file")
    (folder / "self.xyz").symlink_to(folder / "self.xyz")
    (folder / "deep").mkdir()
    (folder / "deep" / "b.xyz").write_bytes(scan.read_bytes())
    monkeypatch.chdir(folder.parent)
    from pcdenoise.commands.files import expand

    assert [str(path) for path in expand(["in/**/*.xyz"])] == ["in/deep/b.xyz", "in/scan.xyz"]
    assert expand([f"{folder}/**"]) == [folder / "deep" / "b.xyz", scan]
    assert [str(path) for path in expand(["**/deep/*.xyz"])] == ["in/deep/b.xyz"]
    assert expand(["in/"]) == [Path("in/scan.xyz")]
    assert main(["info", "in/self.xyz"]) == 3
    assert "in/self.xyz" in one_line(capsys.readouterr().err)


def test_a_folder_whose_folders_may_hold_scans_names_the_pattern_for_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    above = tmp_path / "above"
    (above / "visible").mkdir(parents=True)
    assert main(["info", str(above)]) == 3
    assert f"give '{above.as_posix()}/**'" in one_line(capsys.readouterr().err)
    (above / "visible").rename(above / ".hidden")  # which no pattern enters
    assert main(["info", str(above)]) == 3
    assert "/**" not in one_line(capsys.readouterr().err)


def test_a_name_that_is_no_utf8_is_shown_and_reported(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd = scan.with_name("\udcff.xyz")
    scan.rename(odd)
    for suffix in ("json", "csv", "html"):
        report = scan.with_name(f"report.{suffix}")
        assert (
            main(["denoise", str(odd), "-o", f"{scan.parent}/", "--suffix", "_c", "--overwrite", "--report", str(report), *FAST])
            == 0
        )
        assert b"\\udcff" in report.read_bytes() or suffix == "html"  # a page names no file
    assert scan.with_name("\udcff_c.xyz").exists()


# Scans in cells, and in workers

IN_CELLS = ["--tile", "1000", "--threads", "1", *FAST]


def surface(folder: Path, format: str, n: int = 3000) -> Path:
    """A noisy wave of n points."""
    rng = np.random.default_rng(3)
    x, y = rng.random((2, n))
    path = folder / f"wave.{format}"
    pcdenoise.write(pcdenoise.Scan(np.column_stack([x, y, 0.1 * np.sin(6 * x) + rng.normal(0, 0.005, n)]).round(5)), path)
    return path


def undisturbed(path: Path, folder: Path) -> bytes:
    """What cells make of a scan, nothing in the way."""
    target = folder / f"undisturbed{path.suffix}"
    assert main(["denoise", str(path), "-o", str(target), *IN_CELLS]) == 0
    return target.read_bytes()


@pytest.mark.parametrize("moment", ["after the plan", "while it is written"])
@pytest.mark.parametrize("harm", ["cut", "emptied", "changed", "longer"])
@pytest.mark.parametrize("format", ["las", "laz", "ply", "xyz"])
def test_an_input_that_is_cut_or_changed_between_passes_is_one_line_and_the_next_run_starts_anew(
    format: str, harm: str, moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file is mapped: a look beyond its new end would end the process; rows that changed would be put into other cells."""
    path, out = surface(tmp_path, format), tmp_path / f"out.{format}"
    raw, expected = path.read_bytes(), undisturbed(path, tmp_path)
    name = "level" if moment == "after the plan" else "rows"
    sound = getattr(tiles.Tiles, name)

    def harmed(job: tiles.Tiles, *number: int) -> object:
        found = sound(job, *number)
        if path.read_bytes() == raw:
            with path.open("rb+") as file:
                file.truncate({"cut": len(raw) // 2, "emptied": 0}.get(harm, len(raw)))
                if harm in ("changed", "longer"):
                    file.seek(-1 if harm == "changed" else 0, 2)
                    file.write(b"7")
            os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
        return found

    with monkeypatch.context() as patch:
        patch.setattr(tiles.Tiles, name, harmed)
        assert main(["denoise", str(path), "-o", str(out), *IN_CELLS]) == 3
    said = one_line(capsys.readouterr().err)
    assert f"wave.{format}: " in said
    assert "while it was" in said
    assert not out.exists()
    path.write_bytes(raw)
    assert main(["denoise", str(path), "-o", str(out), *IN_CELLS, "--resume"]) == 0
    assert out.read_bytes() == expected
    assert not [one.name for one in tmp_path.iterdir() if one.name.startswith(".")]


_CELLS_ON_A_SMALL_DISK = """
import resource, sys
from pcdenoise.commands import main
for size in (10_000, 25_000, 30_000, 120_000, -1):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, -1))
    print(main(sys.argv[1:]), flush=True)
"""


def test_a_disk_that_fills_while_cells_are_cleaned_is_one_line_and_resuming_gives_the_same_bytes(tmp_path: Path) -> None:
    path = surface(tmp_path, "ply")
    expected, out = undisturbed(path, tmp_path), tmp_path / "out.ply"
    done = subprocess.run(
        [sys.executable, "-c", _CELLS_ON_A_SMALL_DISK, "denoise", path, "-o", out, *IN_CELLS, "--resume"],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, timeout=300, check=False,
    )  # fmt: skip
    codes = done.stdout.split()
    assert codes[:2] == ["3", "3"], done.stderr
    assert codes[-1] == "0"
    assert done.stderr.count("\n") == codes.count("3")
    assert "File too large" in done.stderr
    assert out.read_bytes() == expected
    assert sorted(one.name for one in tmp_path.iterdir()) == ["out.ply", "undisturbed.ply", "wave.ply"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_cells_are_cleaned_leaves_them_for_resume(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = surface(tmp_path, "las"), tmp_path / "out.las"
    expected = undisturbed(path, tmp_path)
    clean = tiles.Tiles.clean
    cleaned: list[int] = []

    def interrupted(job: tiles.Tiles, cell: int, *rest: object) -> None:
        if len(cleaned) == 1:
            os.kill(os.getpid(), number)
        clean(job, cell, *rest)  # type: ignore[arg-type]
        cleaned.append(cell)

    monkeypatch.setattr(tiles.Tiles, "clean", interrupted)
    # A shell's background job may have been told to ignore any of them.
    before = signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    try:
        code = main(["denoise", str(path), "-o", str(out), *IN_CELLS])
    except SystemExit as stop:
        code = int(stop.code or 0)
    finally:
        signal.signal(number, before)
    assert code == 128 + number
    assert not out.exists()
    cells = tmp_path / ".out.las.cells"
    kept = {one: one.stat().st_mtime_ns for one in cells.glob("pass_1/*.f64")}
    assert len(kept) == 1
    monkeypatch.setattr(tiles.Tiles, "clean", clean)
    monkeypatch.setattr(tiles.Tiles, "remove", lambda job: None)
    assert main(["denoise", str(path), "-o", str(out), *IN_CELLS, "--resume"]) == 0
    assert {one: one.stat().st_mtime_ns for one in kept} == kept, "cleaned again"
    assert out.read_bytes() == expected


def test_a_plan_of_cells_goes_on_where_it_is_sound_and_loses_nothing_where_it_cannot_be_read(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, kept = rng.random((500, 3)), tmp_path / "pass_1" / "0.f64"

    def again() -> plan.Plan:
        kept.parent.mkdir(exist_ok=True)
        kept.touch()
        return plan.plan_in(tmp_path, lambda: [points], {"name": ("a", 1)}, 100, seed=1)

    first = plan.plan_in(tmp_path, lambda: [points], {"name": ("a", 1)}, 100, seed=1)
    assert again() == first
    assert kept.exists()
    said = json.loads((tmp_path / "plan.json").read_text())
    (tmp_path / "plan.json").write_text(json.dumps({**said, "cell_points": "x"}))
    assert again() == first
    assert not kept.exists(), "of a damaged plan"
    monkeypatch.setattr(Path, "read_bytes", lambda _path: (_ for _ in ()).throw(OSError(5, "Input/output error")))
    with pytest.raises(OSError, match="Input/output error"):
        again()
    assert kept.exists()


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b"{}", b"\xff", b'{"job": {}, "cell_points": "x"}'])
def test_a_plan_of_cells_that_is_damaged_is_made_anew(damage: bytes, tmp_path: Path) -> None:
    path = surface(tmp_path, "ply")
    expected, cells = undisturbed(path, tmp_path), tmp_path / ".out.ply.cells"
    (cells / "pass_1").mkdir(parents=True)
    (cells / "plan.json").write_bytes(damage)
    (cells / "pass_1" / "0.f64").write_bytes(b"of another scan")
    assert main(["denoise", str(path), "-o", str(tmp_path / "out.ply"), *IN_CELLS, "--resume"]) == 0
    assert (tmp_path / "out.ply").read_bytes() == expected


@pytest.mark.parametrize("target", ["/proc/none/out.ply", "{folder}/wave.ply/out.ply"])
def test_cells_where_nothing_can_be_written_are_one_line(target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = surface(tmp_path, "ply")
    assert main(["denoise", str(path), "-o", target.format(folder=tmp_path), *IN_CELLS]) == 3
    one_line(capsys.readouterr().err)
    assert [one.name for one in tmp_path.iterdir()] == ["wave.ply"]


def work_with_faults(job: Job) -> Figures:
    """What a worker may meet, by the name of the input."""
    if job.source.name == "memory":
        resource = pytest.importorskip("resource")
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        limit = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (size + (64 << 20), limit[1]))
        try:
            np.ones(1 << 28)
        finally:
            resource.setrlimit(resource.RLIMIT_AS, limit)
    elif job.source.name == "killed":
        part = job.target.with_name(f".{job.target.name}.part").open("wb")  # as `replaced` would, and open to the end
        part.write(b"half")
        part.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"points": 1}


def test_workers_out_of_memory_or_killed_twice_fail_their_input_alone(tmp_path: Path) -> None:
    jobs = [Job(Path(name), tmp_path / "out" / name) for name in ("a", "memory", "b", "killed", "c")]
    (tmp_path / "out").mkdir()
    found = {outcome.job.source.name: outcome for outcome in in_processes(2)(jobs, work_with_faults)}
    assert found.keys() == {"a", "b", "c", "memory", "killed"}
    assert {name for name, outcome in found.items() if outcome.error is None} == {"a", "b", "c"}
    assert "memory: out of memory" in str(found["memory"].error)
    assert "killed: its worker was killed twice" in str(found["killed"].error)
    assert not list((tmp_path / "out").iterdir())


def test_a_model_that_cannot_be_saved_leaves_the_old_one(tmp_path: Path) -> None:
    model = store.load()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(PcdenoiseError, match="cannot be saved") as fault:
        store.save(model.network, tmp_path / "file", summary="", training={}, scores={}, card="")
    assert fault.value.exit_code == 4
