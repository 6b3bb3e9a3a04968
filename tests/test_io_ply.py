"""PLY comes back as it was: every encoding, element, list and comment; plyfile reads what is written."""

from __future__ import annotations

import itertools
import json
import tracemalloc
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData

import io_samples
from pcdenoise.cloud.scan import Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import ply

FLAVOURS: dict[str, dict[str, Any]] = {
    f"{order} {dtype} lists {lists}{' faces' if faces else ''}{' camera' if camera else ''}": {
        "byte_order": order, "dtype": dtype, "lists": lists, "faces": faces, "camera": camera,
    }
    for order, dtype, lists, faces, camera in itertools.product(
        "=<>", ("float", "double"), ("none", "even", "ragged"), (False, True), (False, True)
    )
}  # fmt: skip
EVERY_FLAVOUR = pytest.mark.parametrize("flavour", FLAVOURS)


def written(scan: Scan, **options: Any) -> bytes:
    file = BytesIO()
    ply.write(scan, file, **options)
    return file.getvalue()


pytestmark = pytest.mark.filterwarnings("ignore:loadtxt. input contained no data:UserWarning:plyfile")


def by_plyfile(raw: bytes) -> PlyData:
    """plyfile's reading; it refuses remarks that are not ASCII, which others write."""
    return PlyData.read(BytesIO(raw.replace("été".encode(), b"summer")))


@EVERY_FLAVOUR
@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_a_file_whose_points_did_not_move_comes_back_byte_for_byte(flavour: str, eol: str) -> None:
    raw = io_samples.ply(**FLAVOURS[flavour], eol=eol)
    assert written(ply.read(raw, "sample")) == raw


@EVERY_FLAVOUR
def test_points_and_attributes_are_what_plyfile_reads(flavour: str) -> None:
    raw = io_samples.ply(**FLAVOURS[flavour])
    scan = ply.read(raw, "sample")
    vertex = by_plyfile(raw)["vertex"]
    assert np.allclose(scan.points, np.stack([vertex[axis] for axis in "xyz"], axis=1), rtol=1e-7)
    assert list(scan.attributes) == ["intensity", "label"]
    for name, values in scan.attributes.items():
        assert np.array_equal(values, vertex[name])
        assert values.dtype == vertex[name].dtype.newbyteorder("=")


@EVERY_FLAVOUR
def test_moving_points_changes_their_coordinates_and_nothing_else(flavour: str) -> None:
    raw = io_samples.ply(**FLAVOURS[flavour])
    scan = ply.read(raw, "sample")
    points = scan.points.copy()
    points[::3] += [0.5, -1.25, 2.0]
    out = written(scan.moved_to(points))
    back = ply.read(out, "back")
    step = 1e-6 * np.ptp(points, axis=0).max() if flavour.startswith("=") or "float" in flavour else 0.0
    assert np.abs(back.points - points).max() <= step
    assert np.array_equal(back.points[1::3], scan.points[1::3])
    assert written(back.moved_to(back.points)) == out
    if not flavour.startswith("="):
        assert len(out) == len(raw)
        assert written(back.moved_to(scan.points)) == raw, "moved back, every byte is back"
    before, after = by_plyfile(raw), by_plyfile(out)
    for element in before.elements:
        for prop in element.properties:
            if prop.name not in "xyz":
                pairs = zip(element[prop.name], after[element.name][prop.name], strict=True)
                assert all(np.array_equal(one, other) for one, other in pairs), prop.name


@EVERY_FLAVOUR
def test_new_columns_and_provenance_are_added_without_disturbing_the_rest(flavour: str) -> None:
    raw = io_samples.ply(**FLAVOURS[flavour])
    scan = ply.read(raw, "sample")
    move = np.linspace(-1, 1, len(scan))
    out = written(scan.with_attributes(move=move, outlier=move > 0, label=-scan.attributes["label"]), provenance={"a": 1})
    out = written(ply.read(out, "again"), provenance={"note": "é"})
    data = by_plyfile(out)
    assert np.array_equal(data["vertex"]["move"], move)
    assert np.array_equal(data["vertex"]["outlier"], move > 0)
    assert np.array_equal(data["vertex"]["label"], -scan.attributes["label"])
    assert [element.name for element in data.elements] == [element.name for element in by_plyfile(raw).elements]
    remarks = [line for line in out[: out.index(b"end_header")].splitlines() if line.startswith(b"comment pcdenoise ")]
    assert [json.loads(line.removeprefix(b"comment pcdenoise ")) for line in remarks] == [{"note": "é"}]
    assert written(ply.read(out, "back")) == out


@pytest.mark.parametrize("byte_order", list("=<>"))
@pytest.mark.parametrize("lists", ["none", "even", "ragged"])
def test_selected_rows_are_the_rows_kept(byte_order: Any, lists: str) -> None:
    raw = io_samples.ply(byte_order, lists=lists)
    scan = ply.read(raw, "sample")
    keep = np.arange(len(scan)) % 4 > 1
    source = scan.source.selected(keep)
    out = written(Scan(source.points(), source.columns, "ply", "sample", source))
    vertex = by_plyfile(out)["vertex"]
    assert vertex.count == keep.sum()
    assert np.array_equal(vertex["label"], scan.attributes["label"][keep])
    if lists != "none":
        kept = itertools.compress(by_plyfile(raw)["vertex"]["neighbours"], keep)
        assert all(np.array_equal(one, other) for one, other in zip(vertex["neighbours"], kept, strict=True))


def test_rows_that_faces_refer_to_are_not_removed() -> None:
    scan = ply.read(io_samples.ply("<", faces=True), "mesh.ply")
    with pytest.raises(ScanError, match=r"mesh\.ply: .*--outliers flag"):
        scan.source.selected(np.ones(len(scan), np.bool_))


def test_integer_coordinates_move_by_whole_numbers_only() -> None:
    for order in "=<":
        scan = ply.read(io_samples.ply(order, dtype="int"), "grid.ply")
        assert np.array_equal(ply.read(written(scan.moved_to(scan.points + 2)), "back").points, scan.points + 2)
        with pytest.raises(ScanError, match="y is stored as int32"):
            written(scan.moved_to(scan.points + [0, 0.5, 0]))


def test_a_scan_from_elsewhere_keeps_its_precision_and_its_colours(rng: np.random.Generator) -> None:
    far = rng.normal(size=(10, 3)) + 4.6e6
    count = np.arange(10)
    attributes: dict[str, Any] = {
        "R": count * 25, "G": count, "B": count, "time": count + 2**40, "normal_x": rng.random(10), "odd name": np.ones(10, "f2"),
    }  # fmt: skip
    vertex = by_plyfile(written(Scan(far, attributes)))["vertex"]
    assert np.array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), far)
    assert [prop.val_dtype for prop in vertex.properties] == ["f8", "f8", "f8", "u1", "u1", "u1", "f8", "f8", "f4"]
    assert [prop.name for prop in vertex.properties][3:] == ["red", "green", "blue", "time", "nx", "odd_name"]
    near = Scan(far.astype(np.float32).astype(np.float64))
    assert by_plyfile(written(near))["vertex"].properties[0].val_dtype == "f4"
    assert ply.unstorable({"text": np.array(["a"]), "huge": np.array([2**60 + 1]), "fine": np.array([2**52])}) == ["text", "huge"]


BINARY, TEXT = io_samples.ply("<", lists="ragged", faces=True), io_samples.ply("=", faces=True)
DAMAGED = {
    "no end of the header": (BINARY.replace(b"end_header", b"end header"), "no end_header"),
    "another first line": (b"plx" + BINARY[3:], "'ply'"),
    "an unknown type": (BINARY.replace(b"float y", b"real y"), "'real'"),
    "a property twice": (BINARY.replace(b"float z", b"float x"), "same name"),
    "no z": (BINARY.replace(b"float z", b"float w"), "no x, y and z"),
    "no vertices": (TEXT.replace(b"element vertex", b"element points"), "no vertex element"),
    "a length that is a float": (BINARY.replace(b"list uchar", b"list float"), "lengths as floats"),
    "billions of vertices": (BINARY.replace(b"vertex 30", b"vertex 3000000000"), "claims 3000000000 vertex rows"),
    "billions of lines": (TEXT.replace(b"vertex 30", b"vertex 3000000000"), "claims 3000000000 vertex rows"),
    "an absurd count": (TEXT.replace(b"vertex 30", b"vertex " + b"9" * 40), "header is wrong"),
    "cut in the vertices": (BINARY[: len(BINARY) // 2], "file holds|past the end"),
    "cut in the faces": (TEXT[: TEXT.rindex(b"\n", 0, -2)], "claims 2 face rows, the file holds 1"),
    "a row too short": (TEXT.replace(b" -3\n", b"\n"), "has 4 columns"),
    "a word for a number": (TEXT.replace(b" -3\n", b" three\n"), "'three' is not a number"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damage_is_one_line_that_names_the_file_and_costs_no_memory(damage: str) -> None:
    raw, message = DAMAGED[damage]
    tracemalloc.start()
    with pytest.raises(ScanError, match=message) as caught:
        ply.read(raw, "broken.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(caught.value).startswith("broken.ply: ")
    assert "\n" not in str(caught.value)
    assert peak < 20e6


BIG_ENDIAN = io_samples.ply(">", lists="even", camera=True)


@pytest.mark.parametrize("raw", [TEXT, BINARY, BIG_ENDIAN], ids=["text", "ragged", "big-endian"])
def test_random_damage_never_ends_in_anything_but_a_scan_error(raw: bytes, rng: np.random.Generator) -> None:
    n_read = 0
    for _ in range(150):
        broken = bytearray(raw)
        for at in rng.integers(0, len(raw), rng.integers(1, 4)).tolist():
            broken[at : at + 1] = rng.choice([b"\xff" * 4, b"\0" * 4, b" ", b"\n", b"9999", rng.bytes(1)])
        end = len(raw) if rng.random() < 0.7 else rng.integers(len(raw))
        message = io_samples.refusal(lambda raw: written(ply.read(raw, "broken")), bytes(broken[:end]))
        assert "\n" not in message
        n_read += not message
    assert n_read, "some damage is harmless; if none was, this test would test nothing"
