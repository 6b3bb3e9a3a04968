"""LAS and LAZ come back as they were, in every version and point format; damage is one ScanError."""

from __future__ import annotations

import json
import struct
import time
import tracemalloc
from io import BytesIO
from typing import Any

import laspy
import lazrs
import numpy as np
import pytest

import io_samples
from pcdenoise.cloud.scan import Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import las, las_file

ROUND_TRIPS = [(minor, form, compressed) for minor, form in io_samples.LAS_FLAVOURS for compressed in (False, True)]
WKT = io_samples.vlr(b"LASF_Projection", 2112, b'PROJCS["somewhere"]\0\0odd tail', b"crs")
ODD = io_samples.vlr(b"a\0b\xff", 4711, bytes(range(256)), b"\xfe not text")
WIDTH = io_samples.extra_bytes_entry(b"width", 3, options=24, scale=0.01, offset=5.0)
EXTRA = io_samples.vlr(b"LASF_Spec", 4, WIDTH + io_samples.extra_bytes_entry(b"rgb", 23))
N_EXTRA = 2 + 6 + 3
"""width (u2, scaled), rgb (3 u2, a deprecated type) and three bytes nothing describes."""


def written(scan: Scan, **options: Any) -> bytes:
    file = BytesIO()
    las.write(scan, file, **{"compressed": scan.format == "laz", **options})
    return file.getvalue()


def full_file(compressed: bool = False, **options: Any) -> bytes:
    """LAS 1.4 with every kind of attachment, extra bytes described and not."""
    parts: dict[str, Any] = {"n_extra": N_EXTRA, "vlrs": [WKT, EXTRA, ODD], "waveforms": b"\1" * 77, "gap": b"\xdd\xcc"}
    evlrs = [io_samples.evlr(b"long", 1, b"x" * 1000), io_samples.evlr(b"long", 2, b"")]
    return io_samples.las(4, 7, compressed=compressed, **{**parts, "evlrs": evlrs, **options})


@pytest.mark.parametrize(("minor", "form", "compressed"), ROUND_TRIPS)
def test_a_file_whose_points_did_not_move_comes_back_byte_for_byte(minor: int, form: int, compressed: bool) -> None:
    raw = io_samples.las(minor, form, compressed=compressed, n_extra=3, vlrs=[WKT, ODD], gap=b"\xdd\xcc" if minor == 0 else b"")
    assert written(las.read(raw, "sample")) == raw


@pytest.mark.parametrize("compressed", [False, True])
def test_evlrs_waveforms_gaps_and_undescribed_bytes_come_back_byte_for_byte(compressed: bool) -> None:
    raw = full_file(compressed)
    assert written(las.read(raw, "sample")) == raw


@pytest.mark.parametrize(("minor", "form", "compressed"), ROUND_TRIPS)
def test_moving_points_changes_their_integers_and_the_bounds_alone(minor: int, form: int, compressed: bool) -> None:
    raw = io_samples.las(minor, form, compressed=compressed, n_extra=3, vlrs=[WKT, ODD])
    scan = las.read(raw, "sample")
    points = scan.points.copy()
    points[::2] += [12.3456, -7.0, 1.00025]
    out = written(scan.moved_to(points))
    before, after = las_file.parse(raw, "before"), las_file.parse(out, "after")
    assert (before.vlrs, before.gap, before.tail) == (after.vlrs, after.gap, after.tail)
    assert before.header[:179] + before.header[227:] == after.header[:179] + after.header[227:], "all but the bounds"
    assert np.array_equal(before.records[:, 12:], after.records[:, 12:])
    assert np.array_equal(before.records[1::2], after.records[1::2]), "rows that did not move keep their integers"
    back = las.read(out, "after").points
    assert (np.abs(back - points) <= np.array(io_samples.SCALE) / 2 + 1e-9).all()
    assert after.field("bounds").tolist() == np.stack([back.max(axis=0), back.min(axis=0)], axis=1).tolist()


@pytest.mark.parametrize(("minor", "form"), io_samples.LAS_FLAVOURS)
def test_attributes_are_what_laspy_reads(minor: int, form: int) -> None:
    raw = io_samples.las(minor, form, n_extra=N_EXTRA, vlrs=[EXTRA])
    scan = las.read(raw, "sample")
    reference = laspy.read(BytesIO(raw))
    for name in reference.point_format.dimension_names:
        if name in ("X", "Y", "Z"):
            continue
        expected = np.asarray(reference[name])
        for k, column in enumerate(expected.reshape(len(scan), -1).T):
            ours = scan.attributes.get(name if expected.ndim == 1 else f"{name}_{k}", scan.attributes.get(f"extra_bytes_{k}"))
            assert ours is not None
            assert np.array_equal(ours, column, equal_nan=ours.dtype.kind == "f"), name
    assert np.array_equal(scan.points, reference.xyz)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_new_column_becomes_extra_bytes_that_laspy_reads(compressed: bool, rng: np.random.Generator) -> None:
    scan = las.read(full_file(compressed), "sample")
    n = len(scan)
    columns = {"move": rng.normal(size=n), "outlier": rng.random(n) > 0.5, "count": np.arange(n, dtype="<i4")}
    out = written(scan.with_attributes(**columns))
    reference = laspy.read(BytesIO(out))
    assert np.array_equal(reference["move"], columns["move"])
    assert np.array_equal(reference["outlier"], columns["outlier"])
    assert np.array_equal(reference["count"], columns["count"])
    back = las.read(out, "back")
    for name, values in scan.attributes.items():
        assert np.array_equal(back.attributes[name], values, equal_nan=values.dtype.kind == "f"), name
    assert back.source.file.tail == scan.source.file.tail


def test_a_standard_dimension_can_be_replaced_and_refuses_what_it_cannot_hold() -> None:
    scan = las.read(full_file(), "sample.las")
    flagged = scan.with_attributes(classification=np.full(len(scan), 7), withheld=np.arange(len(scan)) % 2)
    back = las.read(written(flagged), "back")
    assert (back.attributes["classification"] == 7).all()
    assert np.array_equal(back.attributes["withheld"], np.arange(len(scan)) % 2)
    assert np.array_equal(back.attributes["synthetic"], scan.attributes["synthetic"]), "neighbouring bits stay"
    with pytest.raises(ScanError, match="dimension withheld"):
        written(scan.with_attributes(withheld=np.full(len(scan), 2)))
    with pytest.raises(ScanError, match="dimension intensity"):
        written(scan.with_attributes(intensity=np.full(len(scan), 0.5)))


def test_provenance_is_one_vlr_and_every_pointer_follows_it() -> None:
    scan = las.read(full_file(), "sample")
    once = written(scan, provenance={"model": "a", "note": "é"})
    twice = written(las.read(once, "once"), provenance={"model": "b" * 100})
    file = las_file.parse(twice, "twice")
    notes = [json.loads(data) for data in file.vlr(b"pcdenoise", 1)]
    assert [note.pop("header_before").keys() >= {"software", "bounds"} for note in notes] == [True], "the way back for undo"
    assert notes == [{"model": "b" * 100}]
    assert file.field("software").startswith(b"pcdenoise ")
    assert file.evlrs() == scan.source.file.evlrs()
    assert twice[int(file.field("waveforms_start")) :][:77] == b"\1" * 77
    reference = laspy.read(BytesIO(twice))
    assert [record.record_data_bytes() for record in reference.evlrs] == [b"x" * 1000, b""]


def test_a_move_beyond_the_integers_names_the_row_and_a_way_out() -> None:
    scan = las.read(io_samples.las(2, 0), "far.las")
    points = scan.points.copy()
    points[3, 1] += 1e9
    with pytest.raises(ScanError, match=r"row 3 has y = .*write \.ply"):
        written(scan.moved_to(points))
    points[3, 1] = np.nan
    with pytest.raises(ScanError, match="row 3"):
        written(scan.moved_to(points))


def test_las_becomes_laz_and_back_without_a_trace() -> None:
    raw = full_file()
    scan = las.read(raw, "sample")
    compressed = written(scan, compressed=True)
    assert las.is_compressed(compressed)
    assert written(las.read(compressed, "laz"), compressed=False) == raw


def test_selected_rows_have_their_counts_and_bounds_in_the_header() -> None:
    scan = las.read(io_samples.las(3, 3, vlrs=[WKT]), "sample")
    keep = np.arange(len(scan)) % 3 != 1
    source = scan.source.selected(keep)
    out = written(Scan(source.points(), source.columns, "las", "sample", source))
    reference = laspy.read(BytesIO(out))
    assert np.array_equal(reference.xyz, scan.points[keep])
    assert np.array_equal(reference.header.number_of_points_by_return[:5], np.bincount(reference.return_number, minlength=6)[1:6])
    assert np.allclose(reference.header.maxs, scan.points[keep].max(axis=0))


def test_copc_is_read_and_written_back_as_plain_laz() -> None:
    hierarchy = [io_samples.evlr(b"copc", 1000, b"h" * 32), io_samples.evlr(b"other", 5, b"keep me")]
    raw = io_samples.las(4, 6, compressed=True, vlrs=[io_samples.vlr(b"copc", 1, bytes(160)), WKT], evlrs=hierarchy)
    file = las_file.parse(written(las.read(raw, "sample")), "plain")
    assert [las_file.vlr_identity(record)[0] for record in file.vlrs] == [b"LASF_Projection", b"laszip encoded"]
    assert file.evlrs() == hierarchy[1:]


def test_laz_refuses_waveforms_that_lazrs_would_scramble_and_las_holds_them(rng: np.random.Generator) -> None:
    records = io_samples.las_records(9, 200, 0)
    records[:, 15] = rng.integers(0, 4, 200) << 4
    records[:, 30:] = rng.integers(0, 256, (200, 29))
    scan = las.read(io_samples.las(4, 9, records=records), "wave.las")
    assert np.array_equal(las_file.parse(written(scan), "back").records, records)
    with pytest.raises(ScanError, match=r"write \.las"):
        written(scan, compressed=True)


@pytest.mark.parametrize("form", [4, 5])
def test_waveform_packets_are_marked_as_laszip_marks_them(form: int) -> None:
    """As lazrs marks them, LASzip refuses the file: "WAVEPACKET13 has version > 1"."""
    raw = io_samples.las(3, form, n_extra=3)
    packed = written(las.read(raw, "sample"), compressed=True)
    assert struct.pack("<HHH", 9, 29, 1) in packed
    assert struct.pack("<HHH", 9, 29, 2) not in packed
    assert written(las.read(packed, "back"), compressed=False) == raw


def test_laz_whose_chunk_table_stands_at_the_end_is_read() -> None:
    raw = io_samples.las(2, 1, compressed=True, n=200)
    start = int(las_file.parse(raw, "sample").field("points_start"))
    streamed = raw[:start] + struct.pack("<q", -1) + raw[start + 8 :] + raw[start : start + 8]
    assert np.array_equal(las_file.parse(streamed, "streamed").records, las_file.parse(raw, "sample").records)


def test_a_scan_from_elsewhere_becomes_las_that_laspy_reads(rng: np.random.Generator) -> None:
    n = 50
    attributes = {
        "intensity": rng.integers(0, 65536, n), "red": rng.integers(0, 256, n), "green": rng.integers(0, 256, n),
        "blue": rng.integers(0, 256, n), "nx": rng.normal(size=n).astype("f4"), "user_data": rng.normal(size=n),
    }  # fmt: skip
    scan = Scan(rng.normal(size=(n, 3)) * [100, 10, 1] + [5e5, 4.6e6, 30], attributes)
    reference = laspy.read(BytesIO(written(scan, compressed=True)))
    extent = float(np.ptp(scan.points, axis=0).max())
    assert np.abs(reference.xyz - scan.points).max() <= 1e-8 * extent, "the scale's promise"
    assert np.array_equal(reference.intensity, attributes["intensity"])
    assert np.array_equal(reference.red, attributes["red"] * 256)
    assert np.array_equal(reference["nx"], attributes["nx"])
    assert np.array_equal(reference["user_data_"], attributes["user_data"]), "beside the dimension that cannot hold it"
    assert reference.header.point_count == reference.header.number_of_points_by_return[0] == n
    assert (reference.header.version.minor, reference.header.point_format.id) == (4, 7)


def test_columns_of_a_text_find_their_dimension_by_name() -> None:
    columns = {"GpsTime": np.array([1.5, 2.5]), "PointSourceId": np.array([7, 8]), "return_number": np.array([1, 2])}
    reference = laspy.read(BytesIO(written(Scan(np.array([[0.0, 0, 0], [1, 1, 1]]), columns))))
    assert reference.gps_time.tolist() == [1.5, 2.5]
    assert reference.point_source_id.tolist() == [7, 8]
    assert np.asarray(reference.return_number).tolist() == [1, 2]
    assert list(reference.point_format.extra_dimension_names) == []


def patched(raw: bytes, at: int, form: str, value: float) -> bytes:
    return raw[:at] + struct.pack(form, value) + raw[at + struct.calcsize(form) :]


SMALL = io_samples.las(4, 6)
SMALL_LAZ = io_samples.las(4, 6, compressed=True)
OLD_LAZ = io_samples.las(2, 0, compressed=True)
DAMAGED = {
    "more points than the file holds": (patched(SMALL, 247, "<Q", 41), "claims 41 points, the file holds 40"),
    "billions of points": (patched(SMALL, 247, "<Q", 1 << 60), "holds 40"),
    "billions of compressed points": (patched(SMALL_LAZ, 247, "<Q", 1 << 60), "claims"),
    "more compressed points than there are": (patched(OLD_LAZ, 107, "<I", 60_000), "claims 60000 points"),
    "the largest number of points": (patched(SMALL, 247, "<Q", (1 << 64) - 1), "holds 40"),
    "the largest number of compressed points": (patched(SMALL_LAZ, 247, "<Q", (1 << 64) - 1), "claims"),
    "2^63 points": (patched(SMALL, 247, "<Q", 1 << 63), "holds 40"),
    "EVLRs at the largest number": (patched(patched(SMALL, 235, "<Q", (1 << 64) - 1), 243, "<I", 0xFFFFFFFF), "EVLRs start"),
    "cut in the points": (SMALL[:-7], "holds 39"),
    "cut in the compressed points": (SMALL_LAZ[:700], "compressed points"),
    "cut in the header": (SMALL[:300], "header"),
    "a header too short for its version": (patched(SMALL, 94, "<H", 227), "header of 227 bytes"),
    "an unknown point format": (patched(SMALL, 104, "<B", 55), "point format 55"),
    "records shorter than their format": (patched(SMALL, 105, "<H", 12), "12 bytes a point"),
    "points that start beyond the end": (patched(SMALL, 96, "<I", 1 << 31), "points start"),
    "a scale of zero": (patched(SMALL, 131, "<d", 0.0), "scale or offset"),
    "a scale that is no number": (patched(SMALL, 139, "<d", float("nan")), "scale or offset"),
    "EVLRs beyond the end": (patched(patched(SMALL, 235, "<Q", 1 << 50), 243, "<I", 1), "EVLRs start"),
    "LAS of the future": (patched(SMALL, 25, "<B", 9), r"LAS 1\.9"),
    "compressed without a laszip VLR": (patched(SMALL, 104, "<B", 0x86), "no laszip VLR"),
    "another record length in the laszip VLR": (patched(SMALL_LAZ, 105, "<H", 31), "laszip VLR"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damage_is_one_line_that_names_the_file_and_costs_no_memory(damage: str) -> None:
    raw, message = DAMAGED[damage]
    tracemalloc.start()
    with pytest.raises(ScanError, match=message) as caught:
        las.read(raw, "broken.las")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith("broken.las: ")
    assert "\n" not in str(caught.value)
    assert peak < 20e6


@pytest.mark.parametrize(("at", "form"), [(100, "<I"), (243, "<I")], ids=["VLRs", "EVLRs"])
def test_a_false_count_of_records_does_not_stop_reading(at: int, form: str) -> None:
    raw = patched(full_file(), at, form, 0xFFFFFFF0)
    assert written(las.read(raw, "sample")) == raw


def test_chunks_and_layers_that_claim_gigabytes_never_reach_lazrs() -> None:
    start = int(las_file.parse(SMALL_LAZ, "sample").field("points_start"))
    hostile = patched(SMALL_LAZ, start + 8 + 30 + 4, "<I", 0xFFFFFFF0)
    with pytest.raises(ScanError, match="layers larger"):
        las.read(hostile, "broken.laz")


def test_layers_that_no_chunk_table_accounts_for_never_reach_lazrs() -> None:
    """Two kilobytes once made lazrs set 1.3 GB aside: the table was moved to where it read as one of no chunks."""
    start = int(las_file.parse(SMALL_LAZ, "sample").field("points_start"))
    zeros = SMALL_LAZ + bytes(16)
    hostile = patched(patched(zeros, start, "<q", len(SMALL_LAZ)), start + 8 + 30 + 4, "<I", 0x4E000000)
    with pytest.raises(ScanError, match="empty chunk table"):
        las.read(hostile, "broken.laz")


CHUNK_TABLES = {
    "two billion chunks": lambda raw, table: patched(raw, table + 4, "<I", 1 << 31),
    "as many chunks as there are bytes": lambda raw, table: patched(raw, table + 4, "<I", len(raw) // 2),
    "a table past the end": lambda raw, table: patched(raw, points_start(raw), "<q", len(raw) + 1000),
    "a table at the largest number": lambda raw, table: patched(raw, points_start(raw), "<q", (1 << 63) - 1),
    "a table before the start": lambda raw, table: patched(raw, points_start(raw), "<q", -5),
    "a table inside the points": lambda raw, table: patched(raw, points_start(raw), "<q", points_start(raw) + 8),
}


def points_start(raw: bytes) -> int:
    return int(struct.unpack_from("<I", raw, 96)[0])


@pytest.mark.parametrize("raw", [SMALL_LAZ, OLD_LAZ], ids=["layered", "old"])
@pytest.mark.parametrize("name", CHUNK_TABLES)
def test_a_false_chunk_table_costs_no_memory_and_gives_the_points_or_one_line(name: str, raw: bytes) -> None:
    resource = pytest.importorskip("resource")
    table = struct.unpack_from("<q", raw, points_start(raw))[0]
    sound = las.read(raw, "sound").points
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    try:
        assert np.array_equal(las.read(CHUNK_TABLES[name](raw, table), "broken.laz").points, sound)
    except ScanError as fault:
        assert "\n" not in str(fault)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kilobytes"
    assert time.process_time() - began < 1


def test_a_panic_inside_lazrs_is_a_scan_error_and_an_interrupt_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    class PanicException(BaseException):
        """Stands in for pyo3_runtime.PanicException, which cannot be imported."""

    for raised, expected in ((PanicException, ScanError), (KeyboardInterrupt, KeyboardInterrupt)):

        def panicking(*_: object, fault: type[BaseException] = raised) -> None:
            raise fault

        monkeypatch.setattr(lazrs, "ParLasZipDecompressor", panicking)
        with pytest.raises(expected):
            las.read(SMALL_LAZ, "broken.laz")


@pytest.mark.parametrize("raw", [full_file(), full_file(True), OLD_LAZ], ids=["las", "laz", "old laz"])
def test_random_damage_never_ends_in_anything_but_a_scan_error(raw: bytes, rng: np.random.Generator) -> None:
    n_read = 0
    for _ in range(150):
        broken = bytearray(raw)
        for at in rng.integers(0, 500 if rng.random() < 0.7 else len(raw), rng.integers(1, 5)).tolist():
            broken[at : at + 4] = rng.choice([b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", rng.bytes(4)])
        end = len(raw) if rng.random() < 0.7 else rng.integers(len(raw))
        message = io_samples.refusal(las.read, bytes(broken[:end]), "broken")
        assert "\n" not in message
        n_read += not message
    assert n_read, "some damage is harmless; if none was, this test would test nothing"
