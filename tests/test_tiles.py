"""Clouds in cells: a tile gives what the whole gives, streams what is written whole, and goes on after a kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from known_clouds import UTM, cloud, model, varied
from pcdenoise import io
from pcdenoise.cloud.neighbours import NeighbourSearch
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.commands.memory import LEAST, n_bytes
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import cells, denoiser
from pcdenoise.denoising.tiles import Tiles
from pcdenoise.errors import UsageError
from pcdenoise.synthesis.noise import heavy_tailed

ROOT = Path(__file__).resolve().parent.parent


def cleaned_in_cells(points: np.ndarray, folder: Path, config: DenoiseConfig, cell_points: int) -> tuple[np.ndarray, Tiles]:
    def chunks():
        return (points[i : i + 701] for i in range(0, len(points), 701))

    kind = model("seeded") if config.method == "network" else None
    job = Tiles(folder, chunks, kind, config, cell_points, {})
    job.run()
    found = list(job.rows())
    job.figures["std"] = [rows.std for rows in found if rows.std is not None]
    return np.concatenate([np.empty((0, 3)), *(rows.points for rows in found)]), job


CASES = {
    "little noise": (0.3, {}, 1),
    "seeds are drawn": (1.0, {}, 1),
    "another seed": (1.0, {"seed": 5}, 2),
    "several draws": (1.0, {"draws": 3}, 2),
    "passes after passes": (1.0, {"iters": 3, "relax_steps": 0}, 3),
    "until it stops by itself": (0.5, {"iters": "auto"}, 4),
    "noise that grows along the cloud": (0.8, {}, 4),
    "half the way": (0.5, {"strength": 0.5, "max_move": 0.02, "outliers": "flag"}, 5),
    "with uncertainty": (0.5, {"uncertainty": True, "max_move": 0.05}, 7),
    "noise with long tails": (1.2, {"uncertainty": True, "outliers": "flag"}, 9),
    "noise that is known": (0.3, {"noise": 0.02, "iters": 2}, 8),
    "jets": (0.5, {"method": "jet"}, 6),
    "bilateral": (0.5, {"method": "bilateral"}, 6),
}


@pytest.mark.parametrize("name", CASES)
def test_cells_give_what_the_whole_gives(name: str, tmp_path: Path) -> None:
    std_spacings, settings, seed = CASES[name]
    noisy = cloud("torus", 5000, std_spacings, seed)
    rng = np.random.default_rng(seed)
    measured = varied(noisy, 0.5, 3.0)[0] if "grows" in name else noisy.noisy
    if "tails" in name:
        measured = heavy_tailed(noisy.clean, std_spacings * noisy.spacing, rng)
    points = np.concatenate([measured, measured[:20], np.full((3, 3), np.nan)])[rng.permutation(5023)] + UTM
    config = DenoiseConfig(threads=1, **settings)
    whole = denoiser.denoise(points, None if config.method != "network" else model("seeded"), config)
    moved, job = cleaned_in_cells(points, tmp_path / "cells", config, int(rng.integers(700, 1500)))
    assert len(job.cells) >= 4
    # What reaches over the rim is a thousandth of the noise at most; a scanner's quantum is a hundredth or more.
    np.testing.assert_allclose(moved, whole.points, atol=1e-3 * max(std_spacings, 0.3) * noisy.spacing)
    for figure in ("iterations", "points_not_finite", "points_coincident", "points_left_alone", "is_surface"):
        assert job.figures[figure] == whole.figures[figure]
    assert job.figures.get("outliers") == whole.figures.get("outliers")
    assert ("outliers" in whole.figures) == (config.outliers == "flag")
    assert job.figures["noise"] == pytest.approx(whole.figures["noise"], rel=1e-9)
    assert job.figures["move_median"] == pytest.approx(whole.figures["move_median"], rel=1e-3)
    assert bool(job.figures["std"]) == config.uncertainty
    if whole.std is not None:
        np.testing.assert_allclose(np.concatenate(job.figures["std"]), whole.std, atol=2e-3 * whole.figures["noise"])


def odd(name: str) -> np.ndarray:
    """(N, 3) points of which many are equally far from one, or are in the file many times, or fill a cell by themselves."""
    noisy = cloud("torus", 6000, 1.0)
    if name == "rounded to a quarter of the noise":
        step = noisy.spacing / 4
        return np.unique(np.round(noisy.noisy / step) * step, axis=0)
    if name == "every point eight times":
        return np.repeat(noisy.noisy, 8, axis=0)
    if name == "ten places":
        return np.repeat(np.random.default_rng(0).random((10, 3)), 300, axis=0)
    return np.concatenate([noisy.noisy, np.ones((2, 3)) + [[0, 0, 0], [0, 0, np.spacing(1.0)]]])


@pytest.mark.parametrize(
    "name", ["rounded to a quarter of the noise", "every point eight times", "ten places", "a last chunk of one place"]
)
def test_cells_give_what_the_whole_gives_of_odd_clouds(name: str, tmp_path: Path) -> None:
    points, config = odd(name), DenoiseConfig(threads=1)
    whole = denoiser.denoise(points, model("seeded"), config)
    job = Tiles(
        tmp_path / "cells", lambda: np.split(points, [len(points) // 2, len(points) - 2]), model("seeded"), config, 1500, {}
    )
    job.run()
    moved = np.concatenate([rows.points for rows in job.rows()])
    np.testing.assert_allclose(moved, whole.points, atol=1e-3 * max(whole.figures["noise"], 1e-9))
    for figure in ("noise", "move_median", "move_p99"):
        assert job.figures[figure] == pytest.approx(whole.figures[figure], rel=1e-3, abs=1e-12)
    assert job.figures["points_left_alone"] == whole.figures["points_left_alone"]


def test_a_rim_is_needed_for_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = cloud("torus", 5000, 0.5)
    whole = denoiser.denoise(noisy.noisy, model("seeded"), DenoiseConfig(threads=1))
    monkeypatch.setattr(cells, "_RIM_RADII", 0.3)
    monkeypatch.setattr(cells, "_RINGS", 0)
    moved, _ = cleaned_in_cells(noisy.noisy, tmp_path / "cells", DenoiseConfig(threads=1), 1000)
    assert np.abs(moved - whole.points).max() > 0.01 * noisy.spacing


@pytest.mark.parametrize("few", [0, 3, 15, 40])
def test_few_points_and_no_points(few: int, tmp_path: Path, rng: np.random.Generator) -> None:
    points = rng.random((few, 3))
    moved, _ = cleaned_in_cells(points, tmp_path / "cells", DenoiseConfig(threads=1), 1000)
    np.testing.assert_allclose(moved, denoiser.denoise(points, model("seeded"), DenoiseConfig(threads=1)).points, atol=1e-12)


def test_passes_that_are_over_are_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points, config = cloud("torus", 3000, 0.5).noisy, DenoiseConfig(threads=1, iters=4)
    moved, job = cleaned_in_cells(points, tmp_path, config, 1000)
    (tmp_path / "pass_4.json").unlink()
    (tmp_path / "pass_4" / "0.f64").unlink()
    made: list[int] = []
    clean = Tiles.clean
    monkeypatch.setattr(Tiles, "clean", lambda self, cell, number, level: (made.append(number), clean(self, cell, number, level)))
    again, _ = cleaned_in_cells(points, tmp_path, config, 1000)
    assert again.tobytes() == moved.tobytes()
    assert sorted(set(made)) == [3, 4]
    job.remove()


def test_what_is_done_is_not_done_again_and_another_job_starts_anew(tmp_path: Path) -> None:
    points = cloud("torus", 3000, 0.5).noisy
    moved, job = cleaned_in_cells(points, tmp_path, DenoiseConfig(threads=1), 1000)
    stamp = tmp_path / "pass_1" / "0.f64"
    before = stamp.stat().st_mtime_ns
    (tmp_path / "pass_1" / "1.f64").unlink()
    again, _ = cleaned_in_cells(points, tmp_path, DenoiseConfig(threads=1), 1000)
    assert again.tobytes() == moved.tobytes()
    assert stamp.stat().st_mtime_ns == before
    cleaned_in_cells(points, tmp_path, DenoiseConfig(threads=1, seed=1), 1000)
    assert stamp.stat().st_mtime_ns != before
    job.remove()
    assert not tmp_path.exists()


# Files


@pytest.mark.parametrize("format", ["las", "ply"])
def test_a_file_without_points_is_cleaned_in_cells_as_well(format: str, tmp_path: Path) -> None:
    empty, clean = tmp_path / f"empty.{format}", tmp_path / f"clean.{format}"
    io.write(Scan(np.empty((0, 3)), format=format), empty)
    assert main(["denoise", str(empty), "-o", str(clean), "--tile", "1000", "-q"]) == 0
    assert len(io.read(clean)) == 0


def scan_of(n: int, format: str, folder: Path, rng: np.random.Generator) -> Path:
    points = np.round(cloud("torus", n, 0.5).noisy, 4) + [1000, 2000, 30]
    path = folder / f"scan.{format}"
    columns = {"intensity": rng.integers(0, 999, n).astype("u2"), "confidence": rng.random(n).astype("f4")}
    io.write(Scan(points, columns), path, format=format)
    return path


@pytest.mark.parametrize("format", ["las", "laz", "ply", "xyz"])
def test_a_stream_is_written_as_the_whole_is(format: str, tmp_path: Path, rng: np.random.Generator) -> None:
    path = scan_of(3000, format, tmp_path, rng)
    whole = io.read(path)
    shift = rng.normal(scale=0.01, size=whole.points.shape)
    facts = {"how": "so"}
    io.write(whole, tmp_path / f"same.{format}", provenance=facts)
    changed = whole.moved_to(whole.points + shift).with_attributes(displacement=shift[:, 0].astype("f4"))
    io.write(changed, tmp_path / f"whole.{format}", provenance=facts)
    with io.streamed(path) as stream:
        assert stream is not None
        io.write_streamed(stream, stream.pieces(700), tmp_path / f"same_streamed.{format}", provenance=facts)
        assert stream.n_points == 3000

        def moved():
            at = 0
            for piece in stream.pieces(700):
                part = shift[at : at + len(piece)]
                yield piece.moved_to(piece.points + part).with_attributes(displacement=part[:, 0].astype("f4"))
                at += len(piece)

        io.write_streamed(stream, moved(), tmp_path / f"streamed.{format}", provenance=facts)
    assert (tmp_path / f"same_streamed.{format}").read_bytes() == (tmp_path / f"same.{format}").read_bytes()
    assert (tmp_path / f"streamed.{format}").read_bytes() == (tmp_path / f"whole.{format}").read_bytes()


def test_a_stream_is_there_only_where_pieces_can_be_read(tmp_path: Path, milk: Path) -> None:
    for path in ("-", milk):
        with io.streamed(path) as stream:
            assert stream is None


def test_killed_at_any_moment_it_goes_on_to_the_same_bytes(tmp_path: Path, rng: np.random.Generator) -> None:
    path = scan_of(6000, "laz", tmp_path, rng)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}

    def command(name: str, *more: str) -> list[str]:
        options = ["--tile", "1000", "--iters", "2", "--threads", "1", "-q", *more]
        return [sys.executable, "-m", "pcdenoise", "denoise", str(path), "-o", str(tmp_path / name), *options]

    subprocess.run(command("undisturbed.laz"), env=environment, check=True, timeout=300)
    folder = tmp_path / ".killed.laz.cells"
    for n_cells in sorted(rng.choice(11, size=3, replace=False) + 1):
        run = subprocess.Popen(command("killed.laz", "--resume"), env=environment)
        while run.poll() is None and len(list(folder.glob("pass_*/*.f64"))) < n_cells:
            time.sleep(0.005)
        run.send_signal(signal.SIGKILL)
        run.wait()
    assert not (tmp_path / "killed.laz").exists()
    subprocess.run(command("killed.laz", "--resume"), env=environment, check=True, timeout=300)
    assert (tmp_path / "killed.laz").read_bytes() == (tmp_path / "undisturbed.laz").read_bytes()
    assert not folder.exists()


def test_sizes_of_memory() -> None:
    assert n_bytes("2G") == 2 << 30
    assert n_bytes("1.5g") == 3 << 29
    assert n_bytes("800MiB") == 800 << 20
    assert n_bytes(None) >= LEAST
    for wrong in ("2", "G", "-1G", "100M", "1T"):
        with pytest.raises(UsageError, match="--max-memory"):
            n_bytes(wrong)


def test_the_benchmark_of_speed_runs(tmp_path: Path) -> None:
    script = ROOT / "benchmarks" / "speed" / "measure.py"
    command = [sys.executable, str(script), "--quick", "--only", "pcdenoise", "scipy kNN", "-o", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, env=environment, check=True, timeout=300, capture_output=True)
    rows = json.loads((tmp_path / "speed.json").read_text())["rows"]
    assert [(row["name"], row["n"]) for row in rows] == [(name, n) for n in (2000, 4000) for name in ("pcdenoise", "scipy kNN")]
    assert all(row["per_cpu_s"] > 0 and row["peak_bytes"] > 2**20 for row in rows)
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")


def test_cells_are_as_large_as_asked_for_where_many_points_share_a_place(rng: np.random.Generator, tmp_path: Path) -> None:
    wall = rng.random((6000, 3)) * (0, 1, 1)  # the lowest place along the longest axis
    points = np.concatenate([wall, rng.random((4000, 3)) * (10, 1, 1)])
    job = Tiles(tmp_path / "cells", lambda: [points], None, DenoiseConfig(method="mean"), 1000, {})
    sizes = [(tmp_path / "cells" / "start" / f"{cell}.i8").stat().st_size // 8 for cell in job.cells]
    assert sum(sizes) == len(points)
    assert max(sizes) < 2000


def dense_on_sparse(rng: np.random.Generator) -> np.ndarray:
    """(24000, 3) a ball of 20,000 points, spacing about 0.012, on a floor whose points are half a unit apart."""
    ball = rng.normal(size=(20_000, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)
    floor = np.column_stack([rng.uniform(-16, 16, (4000, 2)), np.full(4000, -0.5)])
    return np.concatenate([ball, floor]) + rng.normal(0, 0.003, (24_000, 3))


def test_a_sparse_cell_does_not_take_all_that_is_dense_beside_it(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, config = dense_on_sparse(rng), DenoiseConfig(threads=1)
    monkeypatch.setattr(cells, "_MEDIUM_TILE", 1000)
    moved, job = cleaned_in_cells(points, tmp_path / "cells", config, 2000)
    # In spacings: 2000 points in a cell of twice its width, nine rings of the 24 nearest, 2.8 wide each, around it make
    # (63 + 2 · 25) · (32 + 2 · 25) = 9300, and half as many again where strewn points lie far apart. The whole has 24,000.
    assert max(len(job._tile(cell, 0)[1].points) for cell in job.cells) < 17_000
    whole = denoiser.denoise(points, model("seeded"), config)
    off = np.linalg.norm(moved - whole.points, axis=1) / whole.figures["noise"]
    # As of any cell, but for 24 points on the floor: neighbourhoods are wider where what is sparse looks noisy.
    assert np.quantile(off, 0.999) < 1e-3
    assert off.max() < 1


def test_what_is_nearest_on_disk_is_nearest_in_all(tmp_path: Path, rng: np.random.Generator) -> None:
    points = np.unique(np.round(dense_on_sparse(rng)[::4], 2), axis=0)
    job = Tiles(tmp_path / "cells", lambda: [points], model("seeded"), DenoiseConfig(threads=1), 700, {})
    everything = np.concatenate([job.cells.part(cell, 0).points for cell in job.cells])
    centres = everything[:: len(everything) // 20]
    for k in (1, 40, len(everything) + 1):
        near, distances, rows = job.cells.nearest(centres, k, 0)
        apart = np.sort(np.linalg.norm(everything[None] - centres[:, None], axis=2), axis=1)[:, :k]
        np.testing.assert_allclose(distances, apart, atol=1e-12)
        ordered = everything[job.cells.order(everything)]
        assert np.array_equal(near.points[rows], ordered[NeighbourSearch(ordered).knn(centres, k)[1]]), "of equally near ones too"
    around = job.cells.around(centres[3], 300)
    assert len(around.points) == 300
    assert np.isclose(
        np.linalg.norm(around.points - centres[3], axis=1).max(), np.sort(np.linalg.norm(everything - centres[3], axis=1))[299]
    )
    assert len(job.cells.around(centres[3], 10**9).points) == len(everything)
