"""Many inputs on many workers: what is lost with a worker is done by another, and shares together are the whole."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest

from known_clouds import cloud
from pcdenoise import io
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import files, main, workers
from pcdenoise.errors import UsageError

ROOT = Path(__file__).resolve().parent.parent
N_TILES = 8
FILTER = ["--method", "mean", "--iters", "3", "--threads", "1"]
"""Spares each worker the start of torch; that a network gets to a worker has a test of its own."""


@pytest.fixture(scope="module")
def tiles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scans, no two of one size."""
    folder = tmp_path_factory.mktemp("tiles")
    for number in range(N_TILES):
        io.write(Scan(cloud("torus", 1000 + 500 * number, 0.5, number).noisy), folder / f"{number}.ply")
    return folder


@pytest.fixture(scope="module")
def plain(tiles: Path) -> dict[str, bytes]:
    """What one process makes of each of them."""
    assert main(["denoise", str(tiles), "-o", f"{tiles.parent / 'plain'}/", *FILTER, "-q"]) == 0
    return contents(tiles.parent / "plain")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("[!.]*"))}


def started(tiles: Path, target: Path, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "pcdenoise", "denoise", tiles.name, "-o", f"{target}/", *FILTER, *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, cwd=tiles.parent, env=environment, stderr=subprocess.PIPE)


def kill_one(run: subprocess.Popen[bytes], target: Path, pids: Callable[[], list[int]]) -> None:
    """SIGKILL to a worker once a first tile is done and not yet the last."""
    while run.poll() is None and not list(target.glob("[!.]*")):
        time.sleep(0.005)
    assert run.poll() is None, run.stderr and run.stderr.read()
    os.kill(pids()[0], signal.SIGKILL)
    assert len(list(target.glob("[!.]*"))) < N_TILES


@pytest.fixture
def cluster() -> Iterator[object]:
    """A Dask scheduler and two worker processes on this machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster


def test_a_dask_cluster_finishes_though_a_worker_is_killed(
    tiles: Path, plain: dict[str, bytes], cluster: object, tmp_path: Path
) -> None:
    pids = [nanny.pid for nanny in cluster.workers.values()]  # type: ignore[attr-defined]
    address = cluster.scheduler_address  # type: ignore[attr-defined]
    run = started(tiles, tmp_path / "far", "--engine", "dask", "--scheduler", address)
    kill_one(run, tmp_path / "far", lambda: pids)
    assert run.wait(300) == 0, run.stderr and run.stderr.read()
    assert contents(tmp_path / "far") == plain


def test_worker_processes_finish_though_one_is_killed(tiles: Path, plain: dict[str, bytes], tmp_path: Path) -> None:
    psutil = pytest.importorskip("psutil")
    run = started(tiles, tmp_path / "far", "--workers", "2")

    def children() -> list[int]:
        return [child.pid for child in psutil.Process(run.pid).children() if "spawn_main" in " ".join(child.cmdline())]

    kill_one(run, tmp_path / "far", children)
    assert run.wait(300) == 0, run.stderr and run.stderr.read()
    assert contents(tmp_path / "far") == plain


_ONE_IDLE_ONE_AT_WORK = """
import os, signal, time
from pathlib import Path
from pcdenoise.commands.files import Job
from pcdenoise.commands.processes import in_processes

HERE = Path(__file__).parent

def work(job):
    if job.source.name == "long" and not (HERE / "begun").exists():
        (HERE / "begun").touch()
        time.sleep(600)
    return {"pid": os.getpid()}

if __name__ == "__main__":
    outcomes = in_processes(2)([Job(HERE / name, HERE / f"{name}.out") for name in ("short", "long")], work)
    idle = next(outcomes).figures["pid"]
    while not (HERE / "begun").exists():
        time.sleep(0.01)
    time.sleep(0.5)
    os.kill(idle, signal.SIGKILL)
    print([outcome.job.source.name for outcome in outcomes])
"""


def test_a_worker_that_is_killed_while_it_waits_holds_nobody_up(tmp_path: Path) -> None:
    """It has the lock of the queue that jobs come by, which nobody gives back; the other is at work and must not wait for it."""
    script = tmp_path / "script.py"
    script.write_text(_ONE_IDLE_ONE_AT_WORK)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    run = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True, timeout=120)
    assert run.stdout.strip() == "['long']", run.stderr


def test_a_network_cleans_the_same_once_it_has_been_sent_to_a_worker(tiles: Path, tmp_path: Path) -> None:
    cleaned = {}

    def sent(jobs: Sequence[files.Job], work: workers.Work) -> Iterator[workers.Outcome]:
        for job in jobs:
            cleaned["here"] = work(job)
            cleaned["there"] = pickle.loads(pickle.dumps(partial(workers.far_outcome, work)))(job).figures
            yield workers.Outcome(job, figures=cleaned["here"])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "chosen", lambda *_: sent)
        assert main(["denoise", str(tiles / "0.ply"), "-o", str(tmp_path / "0.ply"), "-q"]) == 0
    for figures in cleaned.values():
        del figures["seconds"]
    assert cleaned["here"] == cleaned["there"]


def test_shares_together_are_the_whole_and_each_tile_is_in_one(tiles: Path, plain: dict[str, bytes], tmp_path: Path) -> None:
    for number in (1, 2, 3):
        command = ["denoise", str(tiles), "-o", f"{tmp_path / 'all'}/", *FILTER, "-q"]
        assert main([*command, "--shard", f"{number}/3"]) == 0  # a tile in two shares would be refused: it exists
    assert contents(tmp_path / "all") == plain


def test_every_number_of_shares_deals_each_file_once_and_evenly(tiles: Path) -> None:
    sources = sorted(tiles.glob("*.ply"))
    for n in range(1, N_TILES + 2):
        shares = [files.shard(sources, f"{number}/{n}") for number in range(1, n + 1)]
        assert sorted(source for share in shares for source in share) == sources
        sizes = [sum(source.stat().st_size for source in share) for share in shares]
        assert max(sizes) - min(sizes) <= max(source.stat().st_size for source in sources)


def test_two_inputs_of_one_name_are_refused_though_they_are_in_different_shares(tiles: Path, tmp_path: Path) -> None:
    (tmp_path / "0.ply").write_bytes((tiles / "0.ply").read_bytes())
    sources = [tiles / "0.ply", tmp_path / "0.ply"]
    with pytest.raises(UsageError, match="would both become"):
        files.plan(sources, f"{tmp_path / 'out'}/", share=sources[:1])


def test_a_share_without_files_does_nothing_and_one_file_may_have_a_name(tiles: Path, tmp_path: Path) -> None:
    command = ["denoise", str(tiles / "0.ply"), "-o", str(tmp_path / "clean.ply"), "--method", "mean", "-q", "--shard"]
    assert main([*command, "2/2"]) == 0
    assert not list(tmp_path.iterdir())
    assert main([*command, "1/2"]) == 0
    assert len(io.read(tmp_path / "clean.ply")) == 1000


@pytest.mark.parametrize("options", [["--workers", "2"], ["--engine", "dask"]])
def test_workers_have_no_standard_input(options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["denoise", "-", "-o", str(tmp_path / "a.ply"), *options]) == 2
    assert "standard input" in capsys.readouterr().err
