"""PTX: every line comes back but for the coordinates that moved; stations are put where their poses say."""

from __future__ import annotations

import io as memory
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import io_samples
from pcdenoise import io
from pcdenoise.commands import main
from pcdenoise.errors import ScanError
from pcdenoise.io import ptx

EVERY_SAMPLE = pytest.mark.parametrize("name", io_samples.PTX)


def written(scan: io.Scan) -> bytes:
    file = memory.BytesIO()
    ptx.write(scan, file)
    return file.getvalue()


@EVERY_SAMPLE
def test_a_file_is_written_as_it_was_if_nothing_moved(name: str) -> None:
    raw = io_samples.PTX[name]
    scan = ptx.read(raw, "a.ptx")
    assert written(scan) == raw
    assert (~scan.finite).sum() == raw.count(b"0 0 0 0.5")
    assert ("station" in scan.attributes) == (name in ("two stations", "one with colours"))


@EVERY_SAMPLE
def test_moved_points_are_where_they_were_put_and_other_lines_are_as_they_were(name: str) -> None:
    raw = io_samples.PTX[name]
    scan = ptx.read(raw, "a.ptx")
    points = scan.points.copy()
    points[1::2] += np.random.default_rng(1).uniform(-0.01, 0.01, points[1::2].shape)
    out = written(scan.moved_to(points))
    back = ptx.read(out, "b.ptx")
    extent = float(np.nanmax(np.abs(np.concatenate([station.local for station in scan.source.stations]))))
    assert np.nanmax(np.abs(back.points - points)) <= 2e-6 * extent  # a step of a millionth at most, stretched by two
    assert np.array_equal(back.points[::2], scan.points[::2], equal_nan=True)
    assert all((back.attributes[column] == values).all() for column, values in scan.attributes.items())
    changed = sum(one != other for one, other in zip(raw.splitlines(), out.splitlines(), strict=True))
    assert changed == int(scan.finite[1::2].sum())


def test_poses_turn_stretch_and_shift_rows_from_the_left() -> None:
    scan = ptx.read(io_samples.PTX["two stations"], "a.ptx")
    expected = [600000 + 0.8 * 37.24 - 0.6 * 49.31, 800000 + 0.6 * 37.24 + 0.8 * 49.31, 400 + 2 * 15.83]
    np.testing.assert_allclose(scan.points[0], expected, atol=1e-9)
    assert scan.points[6].tolist() == [37.24, 49.31, 15.83]
    assert scan.source.attachments() == ["poses of stations", "grids of stations"]


def test_rows_are_taken_out_with_their_lines_and_a_station_without_rows_goes() -> None:
    scan = ptx.read(io_samples.PTX["two stations"], "a.ptx")
    keep = np.array([1, 0, 0, 1, 1, 0] + [0] * 6, bool)
    kept = io.select(scan, keep)
    assert written(kept).startswith(b"3\n1\n600000")
    assert np.array_equal(ptx.read(written(kept), "b.ptx").points, scan.points[keep])
    assert np.array_equal(io.select(scan, ~keep).points, scan.points[~keep], equal_nan=True)
    with pytest.raises(ScanError, match="a PTX cannot be empty"):
        io.select(scan, np.zeros(12, bool))


def test_a_scan_from_elsewhere_comes_back_but_for_what_ptx_has_no_place_for(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    points = np.round(rng.normal(0, 50, (200, 3)), 4)
    points[5] = np.nan
    columns = {"intensity": rng.random(200), "classification": np.zeros(200, "u1")}
    columns |= {name: rng.integers(0, 256, 200, dtype="u1") for name in ("red", "green", "blue")}
    scan = io.Scan(points, columns)
    assert io.losses(scan, "ptx") == ["column classification"]
    io.write(scan, tmp_path / "a.ptx", drop_attributes=True)
    back = io.read(tmp_path / "a.ptx")
    np.testing.assert_allclose(back.points, points, atol=1e-6)
    assert all((back.attributes[name] == columns[name]).all() for name in ("intensity", "red", "green", "blue"))
    assert io.losses(io.Scan(points, {"intensity": np.arange(200)}), "ptx") == ["column intensity"]


DAMAGES = {
    b"2\n3\n0 0 0\n": (b"2\n9\n0 0 0\n", "line 1 claims 18 points, there are 6"),
    b"0 0 1 0\n": (b"0 0 0 0\n", "line 7: the station's pose flattens all points"),
    b"0 0 0 0.5\n": (b"0 0 0\n", "a.ptx"),
    b"37.24 49.31 15.830 0.034912\n": (b"37.24 49.31 15.830 0.034912 7\n", "line 11 has 5 numbers"),
    b"36.33 ": (b"x ", "a.ptx: line 12"),
    b"2\n3\n": (b"-2\n-3\n", "are no grid"),
}


@pytest.mark.parametrize("old", DAMAGES)
def test_damage_is_named_with_its_line(old: bytes) -> None:
    new, message = DAMAGES[old]
    raw = io_samples.PTX["bare"]
    assert old in raw
    said = io_samples.refusal(ptx.read, raw.replace(old, new, 1), "a.ptx")
    assert message in said
    assert "\n" not in said


def test_more_than_a_station_and_less_than_two_is_refused() -> None:
    said = io_samples.refusal(ptx.read, io_samples.PTX["bare"] + b"7 8 9 0.5\n", "a.ptx")
    assert "line 17 does not begin the ten lines of a station" in said


@settings(max_examples=80, deadline=None, database=None)
@given(data=st.data())
def test_a_damaged_file_gives_a_sound_scan_or_one_line(data: st.DataObject) -> None:
    raw = bytearray(data.draw(st.sampled_from(list(io_samples.PTX.values()))))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw) - 1))
        new = data.draw(st.sampled_from([b"\n", b"1e309", b"nan", b"-1", b"999999999999", b"", b"0", b"\0", b" ", b"x"]))
        raw[at : at + data.draw(st.integers(0, 6))] = new
    try:
        scan = ptx.read(bytes(raw), "fuzzed")
    except ScanError as fault:
        assert "\n" not in str(fault)
        assert str(fault).startswith("fuzzed")
        return
    assert all(len(values) == len(scan) for values in scan.attributes.values())


def test_a_scan_is_told_by_its_content_cleaned_and_verified(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(8)
    noisy = np.column_stack([rng.uniform(1, 6, (3000, 2)), 2 + rng.normal(0, 0.02, 3000)])
    rows = b"".join(b"%.4f %.4f %.4f 0.25\n" % tuple(row) for row in noisy.tolist())
    head = io_samples.PTX["two stations"].splitlines(keepends=True)[:10]
    path, clean = tmp_path / "in.ptx", tmp_path / "clean.ptx"
    path.write_bytes(b"60\n50\n" + b"".join(head[2:]) + rows)
    (tmp_path / "in.xyz").write_bytes(path.read_bytes())
    assert main(["info", str(tmp_path / "in.xyz")]) == 3
    assert "its content is ptx" in capsys.readouterr().err
    assert main(["denoise", str(path), "-o", str(clean), "-q", "--threads", "1"]) == 0
    assert main(["verify", str(path), str(clean)]) == 0
    height = io.read(clean).points[:, 2]  # the pose stretches heights to twice what they are
    assert np.std(height) < 0.5 * 2 * 0.02
