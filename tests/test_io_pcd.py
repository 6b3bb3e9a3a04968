"""PCD comes back as it was in its three encodings; the compression is LZF."""

from __future__ import annotations

import itertools
import json
import struct
import tracemalloc
from io import BytesIO
from typing import Any

import numpy as np
import pytest

import io_samples
from pcdenoise.cloud.scan import Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import lzf, pcd

FLAVOURS = list(itertools.product(("ascii", "binary", "binary_compressed"), ("F 4", "F 8"), (False, True)))
EVERY_FLAVOUR = pytest.mark.parametrize(("encoding", "dtype", "organised"), FLAVOURS)


def written(scan: Scan, **options: Any) -> bytes:
    file = BytesIO()
    pcd.write(scan, file, **options)
    return file.getvalue()


@EVERY_FLAVOUR
@pytest.mark.parametrize("version", ["0.7", ".5"])
def test_unmoved_points_come_back_byte_for_byte(encoding: str, dtype: str, organised: bool, version: str) -> None:
    raw = io_samples.pcd(encoding, dtype=dtype, organised=organised, version=version)
    assert written(pcd.read(raw, "sample")) == raw


@EVERY_FLAVOUR
def test_moving_points_changes_their_coordinates_and_nothing_else(encoding: str, dtype: str, organised: bool) -> None:
    raw = io_samples.pcd(encoding, dtype=dtype, organised=organised)
    scan = pcd.read(raw, "sample")
    points = scan.points.copy()
    points[1::2] += [0.25, -0.5, 1.0]
    out = written(scan.moved_to(points))
    back = pcd.read(out, "back")
    exact = encoding != "ascii" and dtype == "F 8"
    np.testing.assert_allclose(back.points, points, rtol=0, atol=0 if exact else 1e-6 * np.nanmax(np.abs(points)))
    for name, values in scan.attributes.items():
        assert np.array_equal(back.attributes[name], values, equal_nan=values.dtype.kind == "f"), name
    assert back.source.header.raw == scan.source.header.raw
    if encoding != "ascii":
        home = pcd.read(written(back.moved_to(scan.points)), "home")
        assert home.source.records.array.tobytes() == scan.source.records.array.tobytes(), "moved back, every byte is back"


def test_the_three_encodings_hold_the_same_scan() -> None:
    scans = {encoding: pcd.read(io_samples.pcd(encoding), encoding) for encoding in ("ascii", "binary", "binary_compressed")}
    for scan in scans.values():
        assert list(scan.attributes) == ["red", "green", "blue", "histogram_0", "histogram_1", "histogram_2", "label"]
        np.testing.assert_allclose(scan.points, scans["binary"].points, rtol=1e-5)
        assert np.array_equal(scan.attributes["label"], scans["binary"].attributes["label"])
        assert scan.attributes["red"].dtype == np.uint8
    assert np.array_equal(scans["binary"].attributes["green"], scans["binary_compressed"].attributes["green"])
    assert not scans["binary"].finite[::7].any()


@EVERY_FLAVOUR
def test_new_columns_and_provenance_are_added_without_disturbing_the_rest(encoding: str, dtype: str, organised: bool) -> None:
    scan = pcd.read(io_samples.pcd(encoding, dtype=dtype, organised=organised), "sample")
    move = np.linspace(-1, 1, len(scan))
    out = written(scan.with_attributes(move=move, outlier=move > 0, label=-scan.attributes["label"]), provenance={"a": 1})
    out = written(pcd.read(out, "again"), provenance={"b": 2})
    back = pcd.read(out, "back")
    assert np.array_equal(back.points, scan.points, equal_nan=True)
    assert np.array_equal(back.attributes["move"], move)
    assert np.array_equal(back.attributes["outlier"], move > 0)
    assert np.array_equal(back.attributes["label"], -scan.attributes["label"])
    assert np.array_equal(back.attributes["histogram_1"], scan.attributes["histogram_1"])
    remarks = [line for line in out.splitlines() if line.startswith(b"# pcdenoise ")]
    assert [json.loads(line.removeprefix(b"# pcdenoise ")) for line in remarks] == [{"b": 2}]


@EVERY_FLAVOUR
def test_selected_rows_are_no_longer_organised(encoding: str, dtype: str, organised: bool) -> None:
    scan = pcd.read(io_samples.pcd(encoding, dtype=dtype, organised=organised), "sample")
    keep = np.arange(len(scan)) % 3 != 0
    source = scan.source.selected(keep)
    assert np.array_equal(source.points(), scan.points[keep], equal_nan=True)
    assert np.array_equal(source.columns["label"], scan.attributes["label"][keep])
    assert (source.header.n_points, source.header.height) == (keep.sum(), 1)


def test_packed_colours_can_be_replaced() -> None:
    for encoding in ("binary", "binary_compressed"):
        scan = pcd.read(io_samples.pcd(encoding), "sample")
        back = pcd.read(written(scan.with_attributes(green=np.full(len(scan), 200))), "back")
        assert (back.attributes["green"] == 200).all()
        assert np.array_equal(back.attributes["red"], scan.attributes["red"])
        with pytest.raises(ScanError, match="green"):
            written(scan.with_attributes(green=np.full(len(scan), 256)))


def test_ascii_colours_are_floats_of_the_same_bits_or_whole_numbers() -> None:
    head = b"VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"
    for text in (b"4.2108e+06", b"1249934592"):
        attributes = pcd.read(head + b"1 2 3 " + text + b"\n", "sample").attributes
        word = struct.unpack("<I", struct.pack("<f", 4.2108e6))[0] if b"e" in text else 1249934592
        assert [int(attributes[name][0]) for name in ("red", "green", "blue")] == list(word.to_bytes(4, "big")[1:])


def test_a_scan_from_elsewhere_keeps_its_precision_and_packs_its_colours(rng: np.random.Generator) -> None:
    points = rng.normal(size=(10, 3)) + 4.6e6
    count = np.arange(10)
    attributes = {"red": count, "green": count + 1, "blue": count + 2, "nx": rng.random(10), "huge": count * 2**50}
    out = written(Scan(points, attributes))
    back = pcd.read(out, "back")
    assert np.array_equal(back.points, points)
    assert [field.name for field in back.source.header.fields] == ["x", "y", "z", "normal_x", "huge", "rgb"]
    for name in ("red", "green", "blue", "huge"):
        assert np.array_equal(back.attributes[name], attributes[name])


RUNS = {
    "nothing": b"", "one": b"a", "run": b"aaaa" * 5000, "period": b"abc" * 100, "zeros": bytes(70_000),
    "noise": np.random.default_rng(0).bytes(9000), "ramp": np.arange(9000, dtype="<f4").tobytes(),
}  # fmt: skip


@pytest.mark.parametrize("run", RUNS)
def test_lzf_gives_back_what_it_packed(run: str) -> None:
    data = RUNS[run]
    packed = lzf.compress(data)
    assert lzf.decompress(packed, len(data)) == data
    assert len(packed) <= len(data) * 33 / 32 + 2


def test_lzf_reads_a_stream_made_by_hand() -> None:
    assert lzf.decompress(b"\x02abc" + b"\x20\x02" + b"\xe0\x05\x00", 3 + 3 + 14) == b"abcabc" + b"c" * 14


BINARY, TEXT, PACKED = (io_samples.pcd(encoding) for encoding in ("binary", "ascii", "binary_compressed"))
DAMAGED = {
    "no DATA line": (BINARY.replace(b"DATA", b"DATE"), "DATA line"),
    "an unknown encoding": (BINARY.replace(b"DATA binary", b"DATA wishful"), "DATA wishful"),
    "no z": (BINARY.replace(b"x y _ z", b"x y _ w"), "no single fields x, y and z"),
    "sizes of other fields": (BINARY.replace(b"SIZE 4 ", b"SIZE "), "make them equal"),
    "an impossible type": (BINARY.replace(b"SIZE 4 ", b"SIZE 3 "), "TYPE F SIZE 3"),
    "a count that is a word": (BINARY.replace(b"POINTS 60", b"POINTS many"), "POINTS many"),
    "two numbers of points": (BINARY.replace(b"POINTS 60", b"POINTS 59"), "POINTS is 59 but"),
    "billions of values": (BINARY.replace(b"COUNT 1", b"COUNT 99999999999"), "values a point"),
    "billions of points": (BINARY.replace(b"60", b"6000000000"), "claims 6000000000 points"),
    "billions of lines": (TEXT.replace(b" 60\n", b" 6000000000\n"), "claims 6000000000"),
    "billions of packed points": (PACKED.replace(b"60", b"6000000000"), "header claims"),
    "cut in the points": (BINARY[:-3], "holds 59"),
    "cut in the packed points": (PACKED[:-3], "are there; it is cut off"),
    "cut before the packed points": (PACKED[: PACKED.index(b"DATA") + 27], "ends before its points"),
    "packed points that unpack to fewer": (PACKED[:-33] + b"\x00" * 33, "compressed data"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damage_is_one_line_that_names_the_file_and_costs_no_memory(damage: str) -> None:
    raw, message = DAMAGED[damage]
    tracemalloc.start()
    with pytest.raises(ScanError, match=message) as caught:
        pcd.read(raw, "broken.pcd")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith("broken.pcd: ")
    assert "\n" not in str(caught.value)
    assert peak < 20e6


@pytest.mark.parametrize("raw", [TEXT, BINARY, PACKED], ids=["ascii", "binary", "binary_compressed"])
def test_random_damage_never_ends_in_anything_but_a_scan_error(raw: bytes, rng: np.random.Generator) -> None:
    n_read = 0
    for _ in range(150):
        broken = bytearray(raw)
        for at in rng.integers(0, len(raw), rng.integers(1, 4)).tolist():
            broken[at : at + 1] = rng.choice([b"\xff" * 4, b"\0" * 4, b" ", b"\n", b"9999", rng.bytes(1)])
        end = len(raw) if rng.random() < 0.7 else rng.integers(len(raw))
        message = io_samples.refusal(lambda raw: written(pcd.read(raw, "broken")), bytes(broken[:end]))
        assert "\n" not in message
        n_read += not message
    assert n_read, "some damage is harmless; if none was, this test would test nothing"
