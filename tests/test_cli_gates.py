"""Gates and proofs: the drift gate, what verify compares beside columns, a way back that is exact."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from io_samples import LAS_FLAVOURS, XYZ, evlr, extra_bytes_entry, las, pcd, ply, vlr
from known_clouds import cloud
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.commands.undo import restored, with_displacement

NOTE = vlr(b"somebody", 7, b"a note", b"notes")


@pytest.fixture
def sphere(tmp_path: Path) -> tuple[Path, Path]:
    """A noisy sphere, and the same rows without noise but 3 % smaller: six times the noise of half a percent."""
    noisy = cloud("sphere", 4000, 0.1)
    before, after = tmp_path / "before.ply", tmp_path / "after.ply"
    pcdenoise.write(Scan(noisy.noisy), before)
    pcdenoise.write(Scan(0.97 * noisy.clean), after)
    return before, after


def test_verify_fails_with_5_for_a_sphere_that_shrank_and_passes_without_the_gate(
    sphere: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = map(str, sphere)
    assert main(["verify", before, after, "--json"]) == 0
    findings = json.loads(capsys.readouterr().out)
    assert findings["drift_inward"] == pytest.approx(0.03, rel=0.1)
    assert main(["verify", before, after, "--max-drift", "0.3"]) == 5
    assert "drifted by" in capsys.readouterr().err
    assert main(["verify", before, after, "--max-drift", "100"]) == 0
    for noise, code in ((findings["drift"] / 0.35, 5), (findings["drift"] / 0.25, 0)):
        assert main(["verify", before, after, "--max-drift", "0.3", "--noise", str(noise)]) == code
    assert main(["verify", before, after, "--noise", "0"]) == 2


def test_denoise_writes_nothing_that_drifts_beyond_the_gate(sphere: tuple[Path, Path], tmp_path: Path) -> None:
    """The mean of 24 points shrinks a sphere of little noise by more than the noise; jets keep it."""
    before, out = str(sphere[0]), tmp_path / "out.ply"
    assert main(["denoise", before, "-o", str(out), "--method", "mean", "--max-drift", "0.3", "-q"]) == 5
    assert not out.exists()
    assert main(["denoise", before, "-o", str(out), "--method", "jet", "--max-drift", "0.3", "-q"]) == 0
    assert out.exists()


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda raw: raw.replace(b"a note", b"a lie!"), "VLR somebody/7: changed"),
        (lambda raw: raw.replace(b"more of it", b"less of it"), "EVLR somebody/8: changed"),
    ],
)
def test_verify_compares_the_content_of_vlrs_and_evlrs(
    change: object, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = las(4, 6, vlrs=[NOTE], evlrs=[evlr(b"somebody", 8, b"more of it")])
    before, after = tmp_path / "before.las", tmp_path / "after.las"
    before.write_bytes(raw)
    after.write_bytes(raw)
    assert main(["verify", str(before), str(after)]) == 0
    after.write_bytes(change(raw))  # type: ignore[operator]
    assert main(["verify", str(before), str(after)]) == 5
    assert name in capsys.readouterr().err


def test_verify_says_what_to_do_where_rows_were_removed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after = tmp_path / "before.xyz", tmp_path / "after.xyz"
    before.write_text("0 0 0\n1 0 0\n0 1 0\n")
    after.write_text("0 0 0\n0 1 0\n")
    assert main(["verify", str(before), str(after)]) == 5
    assert "3 rows became 2, so none can be compared; clean with --outliers flag" in capsys.readouterr().err


def test_verify_allows_a_text_no_more_than_its_decimals_round(tmp_path: Path, rng: np.random.Generator) -> None:
    points = np.round(rng.uniform(0, 1000, (200, 3)), 6)
    before, after = tmp_path / "before.xyz", tmp_path / "after.xyz"
    np.savetxt(before, points, fmt="%.6f")
    points[7, 1] += 0.0008
    np.savetxt(after, points, fmt="%.6f")
    assert main(["verify", str(before), str(after), "--max-move", "0.0001"]) == 5
    assert main(["verify", str(before), str(after), "--max-move", "0.0008"]) == 0


def undone(raw: bytes, suffix: str, folder: Path, rng: np.random.Generator) -> bytes:
    """A file moved with its places kept, written with provenance, read and taken back."""
    original, moved, back = (folder / f"{name}{suffix}" for name in ("original", "moved", "back"))
    original.write_bytes(raw)
    scan = pcdenoise.read(original)
    step = np.where(scan.finite[:, None], rng.uniform(0.02, 0.3, scan.points.shape), 0)
    pcdenoise.write(with_displacement(scan.points, scan.moved_to(scan.points + step)), moved, provenance={"command": "denoise"})
    assert not np.array_equal(pcdenoise.read(moved).points, scan.points, equal_nan=True)
    pcdenoise.write(restored(pcdenoise.read(moved)), back)
    return back.read_bytes()


@pytest.mark.parametrize(("minor", "form"), [(minor, form) for minor, form in LAS_FLAVOURS if form not in (4, 5, 9, 10)])
def test_undo_of_a_las_gives_back_every_byte(minor: int, form: int, tmp_path: Path, rng: np.random.Generator) -> None:
    extra = vlr(b"LASF_Spec", 4, extra_bytes_entry(b"reflectance", 3), b"by the scanner")
    evlrs = [evlr(b"somebody", 8, b"more of it")] if minor == 4 else []
    for raw in (las(minor, form, vlrs=[NOTE], evlrs=evlrs), las(minor, form, n_extra=2, vlrs=[extra, NOTE], gap=b"gap")):
        assert undone(raw, ".las", tmp_path, rng) == raw
        for path in tmp_path.iterdir():
            path.unlink()


@pytest.mark.parametrize("lists", ["none", "even", "ragged"])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_undo_of_a_binary_ply_gives_back_every_byte(
    byte_order: str, lists: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    raw = ply(byte_order, dtype="double", lists=lists, faces=True, camera=True)
    assert undone(raw, ".ply", tmp_path, rng) == raw


def test_undo_of_a_binary_pcd_gives_back_every_byte(tmp_path: Path, rng: np.random.Generator) -> None:
    raw = pcd("binary", dtype="F 8", organised=True)
    assert undone(raw, ".pcd", tmp_path, rng) == raw


@pytest.mark.parametrize("name", ["header in another order", "semicolons", "cloudcompare", "pts", "nan rows"])
def test_undo_of_a_text_with_a_fixed_number_of_decimals_gives_back_every_byte(
    name: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    assert undone(XYZ[name], ".pts" if name == "pts" else ".xyz", tmp_path, rng) == XYZ[name]


def test_undo_of_a_file_that_was_cleaned_twice_gives_back_the_first_result(tmp_path: Path, rng: np.random.Generator) -> None:
    raw = las(4, 6, vlrs=[NOTE])
    once = tmp_path / "once.las"
    (tmp_path / "raw.las").write_bytes(raw)
    scan = pcdenoise.read(tmp_path / "raw.las")
    pcdenoise.write(scan.moved_to(scan.points + 0.1), once, provenance={"command": "denoise", "settings": {"seed": 3}})
    (tmp_path / "again").mkdir()
    assert undone(once.read_bytes(), ".las", tmp_path / "again", rng) == once.read_bytes()
