"""Cleaned files as other programs read them: PDAL where it is installed, else laspy (with LASzip where it is), plyfile, numpy."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pytest

import io_samples
from pcdenoise.commands import main

N = 200
CASES = [(minor, form, kind) for minor, form in io_samples.LAS_FLAVOURS for kind in ("las", "laz", "copc")]
CASES = [(minor, form, kind) for minor, form, kind in CASES if kind != "copc" or form in (6, 7, 8)]
CRS = [io_samples.vlr(b"LASF_Projection", 2112, b'LOCAL_CS["x"]\0'), io_samples.vlr(b"someone", 7, b"\1\2\3")]
WAVEFORMS = bytes(range(200))


def noisy_sheet(point_format: int, n_extra: int) -> np.ndarray:
    """Records of random attributes whose coordinates are a noisy sheet, so that there is something to clean."""
    records = io_samples.las_records(point_format, N, n_extra)
    rng = np.random.default_rng(1)
    steps = np.column_stack([rng.integers(0, 40_000, N), rng.integers(0, 4_000, N), rng.integers(0, 4_000, N)])
    records[:, :12] = steps.astype("<i4").view(np.uint8).reshape(N, 12)
    return records


def las_file(minor: int, form: int, kind: str) -> bytes:
    """A file with described and undescribed extra bytes, VLRs, from 1.4 on EVLRs, and the waveforms that formats with them may
    hold; COPC by its VLR, which is what marks it."""
    described = io_samples.vlr(b"LASF_Spec", 4, io_samples.extra_bytes_entry(b"reflectance", 3))
    copc = [io_samples.vlr(b"copc", 1, bytes(160))] if kind == "copc" else []
    evlrs = [io_samples.evlr(b"someone", 9, b"late"), io_samples.evlr(b"someone", 9, b"later")] if minor == 4 else []
    has_waveforms = form in (4, 5, 9, 10)
    packets = [io_samples.vlr(b"LASF_Spec", 100, bytes(26))] if has_waveforms else []
    return io_samples.las(
        minor, form, compressed=kind != "las", vlrs=[*copc, *CRS, *packets, described], evlrs=evlrs,
        waveforms=WAVEFORMS if has_waveforms else b"", records=noisy_sheet(form, 3),
    )  # fmt: skip


def read_by_laspy(path: Path) -> laspy.LasData:
    backend = [found for found in (laspy.LazBackend.Laszip, laspy.LazBackend.LazrsParallel) if found.is_available()]
    return laspy.read(path, laz_backend=backend[:1] if path.suffix == ".laz" else None)


@pytest.mark.parametrize(("minor", "form", "kind"), CASES)
def test_laspy_reads_every_dimension_vlr_evlr_and_waveform_of_a_cleaned_file_as_before(
    minor: int, form: int, kind: str, tmp_path: Path
) -> None:
    suffix = "las" if kind == "las" else "laz"
    path, out = tmp_path / f"in.{suffix}", tmp_path / f"out.{suffix}"
    path.write_bytes(las_file(minor, form, kind))
    assert main(["denoise", str(path), "-o", str(out), "--method", "mean", "-q", "--threads", "1"]) == 0
    before, after = read_by_laspy(path), read_by_laspy(out)
    assert (after.header.version, after.header.point_format.id) == (before.header.version, form)
    assert np.array_equal(after.header.scales, before.header.scales)
    assert list(after.point_format.dimension_names) == list(before.point_format.dimension_names)
    for name in before.point_format.dimension_names:
        values = np.asarray(before[name]), np.asarray(after[name])
        if name in "XYZ":
            assert (values[0] != values[1]).any()
        else:
            assert values[0].tobytes() == values[1].tobytes(), name
    kept = [(v.user_id, v.record_id, v.record_data_bytes()) for v in before.vlrs if v.user_id not in ("copc", "laszip encoded")]
    found = [
        (v.user_id, v.record_id, v.record_data_bytes()) for v in after.vlrs if v.user_id not in ("pcdenoise", "laszip encoded")
    ]
    assert found == kept
    assert [v.record_data_bytes() for v in after.evlrs or []] == [v.record_data_bytes() for v in before.evlrs or []]
    if form in (4, 5, 9, 10):
        assert out.read_bytes()[after.header.start_of_waveform_data_packet_record :].startswith(WAVEFORMS)
    assert np.allclose(after.header.maxs, np.asarray(after.xyz).max(axis=0))
    assert np.allclose(after.header.mins, np.asarray(after.xyz).min(axis=0))


@pytest.mark.skipif(not shutil.which("pdal"), reason="needs PDAL")
@pytest.mark.parametrize(("minor", "form", "kind"), [case for case in CASES if case[1] in (0, 3, 6, 7, 8) and case[0] >= 2])
def test_pdal_sees_the_same_statistics_of_every_attribute(minor: int, form: int, kind: str, tmp_path: Path) -> None:
    suffix = "las" if kind == "las" else "laz"
    path, out = tmp_path / f"in.{suffix}", tmp_path / f"out.{suffix}"
    path.write_bytes(las_file(minor, form, kind))
    assert main(["denoise", str(path), "-o", str(out), "--method", "mean", "-q"]) == 0

    def statistics(file: Path) -> dict[str, object]:
        told = subprocess.run(["pdal", "info", "--stats", str(file)], capture_output=True, check=True).stdout
        found = json.loads(told)["stats"]["statistic"]
        return {one["name"]: one for one in found if one["name"] not in "XYZ"} | {
            one["name"]: one["count"] for one in found if one["name"] in "XYZ"
        }

    def without_position(told: dict[str, object]) -> dict[str, object]:
        return {
            name: {k: v for k, v in one.items() if k != "position"} if isinstance(one, dict) else one
            for name, one in told.items()
        }

    assert without_position(statistics(out)) == without_position(statistics(path))


@pytest.mark.parametrize("order", ["=", "<", ">"])
@pytest.mark.parametrize("lists", ["none", "even", "ragged"])
def test_plyfile_reads_every_property_and_element_of_a_cleaned_file_as_before(order: str, lists: str, tmp_path: Path) -> None:
    path, out = tmp_path / "in.ply", tmp_path / "out.ply"
    raw = io_samples.ply(order, lists=lists, faces=True, camera=True, n=60)
    path.write_bytes(raw.replace("été".encode(), b"summer"))  # plyfile wants ASCII comments
    assert main(["denoise", str(path), "-o", str(out), "--method", "mean", "-q"]) == 0
    before, after = plyfile.PlyData.read(path), plyfile.PlyData.read(out)
    assert [element.name for element in after] == [element.name for element in before]
    for element in before:
        for name in (one.name for one in element.properties):
            values = element[name], after[element.name][name]
            if name not in ("x", "y", "z"):
                assert all(np.array_equal(one, other) for one, other in zip(*values, strict=True)), name
    assert (after["vertex"]["x"] != before["vertex"]["x"]).any()


@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t"])
@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_numpy_reads_every_column_of_a_cleaned_text_as_before(
    delimiter: str, eol: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    path, out = tmp_path / "in.txt", tmp_path / "out.txt"
    table = np.column_stack([rng.normal(size=(100, 3)), rng.integers(0, 9, (100, 2))])
    rows = [delimiter.join([*(f"{value:.3f}" for value in row[:3]), *(f"{value:.0f}" for value in row[3:])]) for row in table]
    path.write_bytes((eol.join([delimiter.join(["x", "y", "z", "a", "b"]), *rows]) + eol).encode())
    assert main(["denoise", str(path), "-o", str(out), "--method", "mean", "-q"]) == 0
    after = np.loadtxt(out, delimiter=None if delimiter == " " else delimiter, skiprows=1)
    assert np.array_equal(after[:, 3:], table[:, 3:])
    assert (np.abs(after[:, :3] - table[:, :3]) > 0.001).any()
    assert out.read_bytes().count(eol.encode()) == 101
