"""One call to read, one to write: formats told apart, nothing half-written, nothing dropped unasked."""

from __future__ import annotations

import io as streams
import itertools
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import io_samples
from pcdenoise import io
from pcdenoise.cloud.scan import Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import files

SAMPLES = {
    "scan.las": io_samples.las(4, 7),
    "scan.laz": io_samples.las(3, 3, compressed=True),
    "scan.ply": io_samples.ply(">"),
    "text.ply": io_samples.ply("=", dtype="double"),
    "scan.pcd": io_samples.pcd("binary_compressed"),
    "scan.XYZ": io_samples.XYZ["columns"],
    "scan.csv": io_samples.XYZ["semicolons"],
    "scan.e57": io_samples.e57("double", n=60),
    "scan.ptx": io_samples.PTX["colours"],
    "scan.bin": np.random.default_rng(0).normal(size=(50, 4)).astype("<f4").tobytes(),
}
EVERY_SAMPLE = pytest.mark.parametrize("name", SAMPLES)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a file of every format."""
    for name, raw in SAMPLES.items():
        (tmp_path / name).write_bytes(raw)
    return tmp_path


@EVERY_SAMPLE
def test_every_format_is_read_by_suffix_and_written_back_as_it_was(folder: Path, name: str) -> None:
    scan = io.read(folder / name)
    target = folder / ("copy." + name)
    io.write(scan, target)
    assert target.read_bytes() == SAMPLES[name]
    assert io.losses(scan, scan.format) == []
    assert scan.origin == str(folder / name)
    assert io.is_scan(target)


@EVERY_SAMPLE
def test_selected_rows_are_the_same_in_memory_and_on_disk(folder: Path, name: str) -> None:
    scan = io.read(folder / name)
    scan = scan.with_attributes(number=np.arange(len(scan), dtype="f4")) if scan.format not in ("bin", "ptx") else scan
    keep = np.arange(len(scan)) % 2 == 0
    chosen = io.select(scan, keep)
    assert np.array_equal(chosen.points, scan.points[keep], equal_nan=True)
    io.write(chosen, folder / name, overwrite=True)
    back = io.read(folder / name)
    assert np.array_equal(back.points, chosen.points, equal_nan=True)
    assert len(back.attributes) >= len(scan.attributes) - (name == "scan.XYZ")
    if scan.format not in ("bin", "ptx", "xyz"):
        assert np.array_equal(back.attributes["number"], np.arange(len(scan))[keep])


def test_select_wants_one_mark_a_row_and_works_without_a_file() -> None:
    scan = Scan(np.zeros((3, 3)), {"a": np.arange(3)})
    assert io.select(scan, np.array([True, False, True])).attributes["a"].tolist() == [0, 2]
    with pytest.raises(ScanError, match="3 points, 2 marks"):
        io.select(scan, np.ones(2, np.bool_))


PAIRS = list(itertools.product(SAMPLES, (".las", ".laz", ".ply", ".pcd", ".xyz", ".csv", ".pts", ".bin", ".e57", ".ptx")))


@pytest.mark.parametrize(("name", "suffix"), PAIRS)
def test_conversion_keeps_coordinates_and_columns_or_says_what_it_drops(folder: Path, name: str, suffix: str) -> None:
    scan = io.read(folder / name)
    scan = io.select(scan, scan.finite)
    target = folder / f"converted{suffix}"
    format = io.SUFFIXES[suffix]
    if lost := io.losses(scan, format):
        with pytest.raises(ScanError, match=lost[0]):
            io.write(scan, target)
        assert not target.exists()
    io.write(scan, target, drop_attributes=True)
    back = io.read(target)
    extent = float(np.ptp(scan.points, axis=0).max())
    coarse = float(np.abs(scan.points).max()) * 1.2e-7 if suffix == ".bin" else 1e-8 * extent
    assert np.abs(back.points - scan.points).max() <= coarse
    if suffix == ".bin":
        assert "coordinates beyond float32 precision" in lost or extent < 1000
        return
    lowered = {column.lower(): values for column, values in back.attributes.items()}
    ordered = list(back.attributes.values())
    for k, (column, values) in enumerate(scan.attributes.items()):
        if f"column {column}" in lost:
            continue
        named = [lowered[name] for name in (column + "_", _expected(column), column.lower()) if name in lowered]
        kept = ordered[k] if suffix == ".pts" else named[0]
        if _expected(column) not in ("red", "green", "blue"):
            assert np.array_equal(kept.astype(values.dtype), values, equal_nan=values.dtype.kind == "f"), column
        else:
            assert np.allclose(kept / max(1, kept.max()), values / max(1, values.max()), atol=1 / 255)


def _expected(column: str) -> str:
    return {"r": "red", "g": "green", "b": "blue", "normal_x": "nx"}.get(column.lower(), column.lower())


def test_losses_name_faces_reference_system_and_columns(folder: Path) -> None:
    (folder / "mesh.ply").write_bytes(io_samples.ply("<", faces=True, lists="ragged"))
    crs = io_samples.vlr(b"LASF_Projection", 2112, b"WKT")
    evlrs = [io_samples.evlr(b"a", 1, b"")]
    (folder / "crs.las").write_bytes(io_samples.las(4, 6, vlrs=[crs, io_samples.vlr(b"me", 9, b"")], evlrs=evlrs, waveforms=b"w"))
    assert io.losses(io.read(folder / "mesh.ply"), "las") == ["2 face elements", "list property neighbours"]
    lost = io.losses(io.read(folder / "crs.las"), "ply")
    assert lost == ["coordinate reference system", "VLR me/9", "1 EVLRs", "waveform packets"]
    text = Scan(np.zeros((1, 3)), {"tree": np.array(["oak"])})
    assert [io.losses(text, format) for format in ("las", "ply", "pcd", "xyz", "bin")] == [["column tree"]] * 5
    grid = _read_bytes(folder, "grid.pcd", io_samples.pcd("binary", organised=True))
    assert io.losses(grid, "xyz") == ["organisation in 10 rows", "viewpoint"]


def _read_bytes(folder: Path, name: str, raw: bytes) -> Scan:
    (folder / name).write_bytes(raw)
    return io.read(folder / name)


@pytest.mark.parametrize(
    ("name", "raw", "message"),
    [
        ("is_ply.las", SAMPLES["scan.ply"], "taken for las but its content is ply"),
        ("is_text.ply", b"1 2 3\n", "taken for ply but its content is text"),
        ("is_las.txt", SAMPLES["scan.las"], "taken for xyz but its content is las"),
        ("is_noise.pcd", bytes(range(200)), "content is of no known format"),
        ("is_empty.xyz", b"", "is empty"),
        ("is_other.doc", b"1 2 3\n", "no suffix tells its format"),
        ("is_odd.bin", b"123", "no whole number of KITTI points"),
    ],
)
def test_a_name_that_its_content_does_not_confirm_is_refused(tmp_path: Path, name: str, raw: bytes, message: str) -> None:
    with pytest.raises(ScanError, match=message):
        _read_bytes(tmp_path, name, raw)


def test_utf16_is_told_apart_from_noise_and_a_misfit_names_the_target(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="UTF-16"):
        _read_bytes(tmp_path, "wide.xyz", "1 2 3\n".encode("utf-16"))
    with pytest.raises(ScanError, match=r"nan\.las: row 1 has no finite"):
        io.write(Scan(np.array([[0.0, 0, 0], [np.nan, 0, 0]])), tmp_path / "nan.las")
    assert not (tmp_path / "nan.las").exists()


def test_a_format_can_be_named_and_must_be_known(folder: Path) -> None:
    (folder / "noname").write_bytes(SAMPLES["scan.pcd"])
    assert io.read(folder / "noname", format="pcd").format == "pcd"
    with pytest.raises(ScanError, match="format e58 is unknown"):
        io.read(folder / "noname", format="e58")


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(ScanError, match=r"none\.las: no such file"):
        io.read(tmp_path / "none.las")
    (tmp_path / "dir.las").mkdir()
    with pytest.raises(ScanError, match=r"dir\.las: is a folder"):
        io.read(tmp_path / "dir.las")
    scan = Scan(np.zeros((2, 3)))
    with pytest.raises(ScanError, match=r"dir\.las: is a folder"):
        io.write(scan, tmp_path / "dir.las", overwrite=True)
    with pytest.raises(ScanError, match="does not exist; create it"):
        io.write(scan, tmp_path / "nowhere" / "a.las")
    with pytest.raises(ScanError, match=r"\.copc"):
        io.write(scan, tmp_path / "a.copc.laz")


def test_an_existing_file_stays_unless_overwriting_is_allowed(tmp_path: Path) -> None:
    target = tmp_path / "scan.xyz"
    target.write_text("precious")
    target.chmod(0o640)
    with pytest.raises(ScanError, match="exists already"):
        io.write(Scan(np.ones((2, 3))), target)
    assert target.read_text() == "precious"
    io.write(Scan(np.ones((2, 3))), target, overwrite=True)
    assert len(io.read(target)) == 2
    assert target.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["scan.xyz"]


@pytest.mark.parametrize(
    ("fault", "seen"),
    [(KeyboardInterrupt(), KeyboardInterrupt), (OSError(28, "No space left on device"), ScanError), (ValueError(), ValueError)],
)
def test_a_failure_in_the_middle_leaves_the_old_file_and_nothing_else(tmp_path: Path, fault: Any, seen: Any) -> None:
    target = tmp_path / "scan.las"
    target.write_bytes(b"old")

    def write_half() -> None:
        with files.written(target, overwrite=True) as file:
            file.write(b"half")
            raise fault

    with pytest.raises(seen):
        write_half()
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["scan.las"]


def test_writing_through_a_link_replaces_what_it_points_to(tmp_path: Path) -> None:
    (tmp_path / "real.xyz").write_text("1 2 3\n")
    (tmp_path / "link.xyz").symlink_to(tmp_path / "real.xyz")
    io.write(Scan(np.ones((2, 3))), tmp_path / "link.xyz", overwrite=True)
    assert (tmp_path / "link.xyz").is_symlink()
    assert len(io.read(tmp_path / "real.xyz")) == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_device_is_one_line() -> None:
    with pytest.raises(ScanError, match="/dev/full: cannot be written"):
        io.write(Scan(np.ones((2, 3))), "/dev/full", format="las")


class FakeStream:
    """A standard stream with a binary buffer, on a terminal or not."""

    def __init__(self, raw: bytes = b"", terminal: bool = False) -> None:
        self.buffer = streams.BytesIO(raw)
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@EVERY_SAMPLE
def test_a_dash_reads_stdin_and_writes_stdout(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", FakeStream(SAMPLES[name]))
    scan = io.read("-", format="bin" if name.endswith("bin") else None)
    assert scan.origin == "stdin"
    stdout = FakeStream()
    monkeypatch.setattr(sys, "stdout", stdout)
    io.write(scan, "-", format=scan.format)
    assert stdout.buffer.getvalue() == SAMPLES[name]


def test_terminals_are_not_waited_for_and_get_no_binary(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", FakeStream(terminal=True))
    with pytest.raises(ScanError, match="nothing is piped in"):
        io.read("-")
    stdout = FakeStream(terminal=True)
    monkeypatch.setattr(sys, "stdout", stdout)
    with pytest.raises(ScanError, match="is a terminal"):
        io.write(Scan(np.ones((2, 3))), "-", format="las")
    with pytest.raises(ScanError, match="name the format"):
        io.write(Scan(np.ones((2, 3))), "-")
    assert stdout.buffer.getvalue() == b""
    io.write(Scan(np.ones((2, 3))), "-", format="xyz")
    assert stdout.buffer.getvalue().count(b"\n") == 2
