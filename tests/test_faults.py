"""Disks that fill, readers that leave, kills, no memory: the target is the old or the whole new one, with the right exit code."""

from __future__ import annotations

import fcntl
import io as streams
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
    def killed(**_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("pcdenoise.commands.app", killed)
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_signal_that_was_ignored_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        monkeypatch.setattr("pcdenoise.commands.app", lambda **_: os.kill(os.getpid(), signal.SIGHUP))
        assert main([]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


SHELL = {
    "denoise {scan} -o - --format xyz -q --method mean > /dev/full": (3, "stdout: cannot be written"),
    "info {scan} > /dev/full": (3, "No space left on device"),
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


def test_a_model_that_cannot_be_saved_leaves_the_old_one(tmp_path: Path) -> None:
    model = store.load()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(PcdenoiseError, match="cannot be saved") as fault:
        store.save(model.network, tmp_path / "file", summary="", training={}, scores={}, card="")
    assert fault.value.exit_code == 4
