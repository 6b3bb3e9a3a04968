"""A class or a region is cleaned; every other row keeps each bit, and the region comes out as if the whole were cleaned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from io_samples import las, las_records
from known_clouds import cloud, model, moves
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.denoising.part import denoise_part

CONFIG = DenoiseConfig(threads=2)


@pytest.fixture
def ground_and_wall() -> tuple[np.ndarray, np.ndarray]:
    """8 000 noisy points of a floor (class 2) and, 4 noise stds above it, as many of another layer (class 3)."""
    floor, layer = cloud("plane", 8000, 0.5, seed=1), cloud("plane", 8000, 0.5, seed=2)
    above = layer.noisy + [0, 0, 4 * 0.5 * floor.spacing]
    return np.concatenate([floor.noisy, above]), np.repeat([2, 3], 8000)


def test_a_region_comes_out_as_if_the_whole_were_cleaned() -> None:
    noisy = 0.2 * cloud("plane", 12_000, 0.5).noisy
    movable = np.logical_and(noisy[:, 0] > 0.15, noisy[:, 1] > 0.1)
    whole = denoise(noisy, model("seeded"), CONFIG)
    part = denoise_part(noisy, movable, np.ones_like(movable), model("seeded"), CONFIG)
    assert 100 < movable.sum() < part.figures["points_seen"] < len(noisy)
    assert np.array_equal(part.points[~movable], noisy[~movable])
    assert moves(part.points, whole.points)[movable].max() < 1e-3 * whole.figures["noise"]


def test_what_is_not_seen_has_no_say(ground_and_wall: tuple[np.ndarray, np.ndarray]) -> None:
    points, classes = ground_and_wall
    floor = classes == 2
    alone = denoise(points[floor], model("seeded"), CONFIG).points
    part = denoise_part(points, floor, floor, model("seeded"), CONFIG)
    assert np.array_equal(part.points[~floor], points[~floor])
    assert np.abs(part.points[floor] - alone).max() < 1e-9
    seen = denoise_part(points, floor, np.ones_like(floor), model("seeded"), CONFIG)
    assert np.array_equal(seen.points[~floor], points[~floor])
    assert np.abs(seen.points[floor] - alone).max() > 0.01 * part.figures["noise"]


def test_nothing_selected_is_nothing_moved(ground_and_wall: tuple[np.ndarray, np.ndarray]) -> None:
    points, _ = ground_and_wall
    nothing = np.zeros(len(points), np.bool_)
    part = denoise_part(points, nothing, ~nothing, model("seeded"), CONFIG)
    assert np.array_equal(part.points, points)
    assert part.figures["points_selected"] == 0


def test_only_class_and_roi_leave_every_other_record_of_a_las_as_it_is(tmp_path: Path) -> None:
    records = las_records(6, 3000, 0)
    wave = np.column_stack(
        [np.random.default_rng(0).integers(0, 60_000, (3000, 2)), np.random.default_rng(1).integers(0, 400, 3000)]
    )
    records[:, :12] = wave.astype("<i4").view(np.uint8).reshape(3000, 12)
    records[:, 16] = np.arange(3000) % 3 + 1
    before, after = tmp_path / "before.las", tmp_path / "after.las"
    before.write_bytes(las(4, 6, records=records))
    scan = pcdenoise.read(before)
    middle = np.median(scan.points[:, 0])
    box = f"{middle},0,1e9,1e9"
    command = ["denoise", str(before), "-o", str(after), "--method", "jet", "--only-class", "2,3", "--roi", box, "-q"]
    assert main(command) == 0
    cleaned = pcdenoise.read(after)
    moved = (cleaned.points != scan.points).any(axis=1)
    chosen = np.isin(scan.attributes["classification"], [2, 3]) & (scan.points[:, 0] >= middle)
    assert not moved[~chosen].any()
    assert moved[chosen].mean() > 0.9
    assert np.array_equal(cleaned.source.file.records[~chosen], scan.source.file.records[~chosen])


def test_a_selection_of_nothing_is_said_and_the_scan_written_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after = tmp_path / "before.las", tmp_path / "after.las"
    before.write_bytes(las(4, 6, records=las_records(6, 300, 0)))
    assert main(["denoise", str(before), "-o", str(after), "--only-class", "255", "--roi", "0,0,1,1"]) == 0
    assert "before.las: no point is asked for by --only-class 255 and --roi; written as it is" in capsys.readouterr().err
    assert np.array_equal(pcdenoise.read(after).source.file.records, pcdenoise.read(before).source.file.records)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--only-class", "ground"], 2, "2,6"),
        (["--only-class", "2"], 3, "has no classes"),
        (["--context", "all"], 2, "--only-class"),
        (["--roi", "1,2,3"], 2, "four or six"),
        (["--roi", "0,0,-1,1"], 2, "below"),
    ],
)
def test_a_selection_that_cannot_be_is_one_line_that_says_why(
    arguments: list[str], code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = tmp_path / "scan.ply"
    pcdenoise.write(Scan(cloud("plane", 300, 0.5).noisy), scan)
    assert main(["denoise", str(scan), "-o", str(tmp_path / "out.ply"), "--method", "jet", "-q", *arguments]) == code
    said = capsys.readouterr().err
    assert words in said
    assert len(said.splitlines()) == 1
