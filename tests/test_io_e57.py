"""E57: read as it is, written as it was but for what moved; the second program is libE57Format, where pye57 is installed."""

from __future__ import annotations

import io as memory
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import io_samples
from pcdenoise import io
from pcdenoise.commands import main
from pcdenoise.errors import ScanError
from pcdenoise.io import e57, e57_file
from pcdenoise.io.e57_file import Field
from pcdenoise.io.e57_stations import Records

KINDS = ("single", "double", "scaled", "integer", "spherical", "invalid")
TOKENS = [b'"', b"<", b"nan", b"1e309", b"-1", b"9" * 30, b"\xff" * 8]
EVERY_KIND = pytest.mark.parametrize("kind", KINDS)
IMAGE = bytes(range(256)) * 9


def sample(kind: str, **more: object) -> bytes:
    return io_samples.e57(kind, n_stations=2, image=IMAGE, groups=True, **more)  # type: ignore[arg-type]


def written(scan: io.Scan, **more: object) -> bytes:
    file = memory.BytesIO()
    e57.write(scan, file, **more)  # type: ignore[arg-type]
    return file.getvalue()


def step_of(scan: io.Scan) -> float:
    """How far rounding to the file's numbers may put a point along an axis, with float64's own rounding."""
    return 0.51 * 3**0.5 * scan.source.step() + 8 * float(np.spacing(np.nanmax(np.abs(scan.points))))


@pytest.mark.parametrize("bits", range(65))
def test_packed_integers_come_back_whatever_their_length(bits: int) -> None:
    rng = np.random.default_rng(bits)
    low = -int(rng.integers(0, 1 << 40)) if bits < 64 else -(2**63)
    field = Field("", "integer", low, low + (1 << bits) - 1)
    assert field.bits == bits
    values = np.array(
        [field.low, field.high, *(field.low + int(v) % (1 << bits) for v in rng.integers(0, 2**63, 70_001))], np.int64
    )
    stream = field.packed(values)
    assert len(stream) == e57_file.bytes_of(field, len(values))
    found = field.unpacked(stream, len(values))
    assert (found == values).all()
    if bits % 8:  # the first bits are those of a sum of shifted values, as the standard has it
        said = sum((int(value) - low) << bits * i for i, value in enumerate(values[:9]))
        assert stream.startswith(said.to_bytes(200, "little")[: 9 * bits // 8])


def test_checksums_are_those_of_the_definition() -> None:
    pages = np.random.default_rng(0).integers(0, 256, (5000, 16), dtype=np.uint8)
    expected = [io_samples._crc32c(page.tobytes()) for page in pages]
    assert e57_file._checksums(pages).tolist() == expected
    assert io_samples._crc32c(b"123456789") == 0xE3069283  # the check value of CRC-32C


@EVERY_KIND
def test_a_file_is_written_as_it_was_if_nothing_moved(kind: str) -> None:
    raw = sample(kind)
    scan = e57.read(raw, "a.e57")
    assert len(scan) == 600
    assert written(scan) == raw
    assert scan.attributes["station"].tolist() == [0] * 300 + [1] * 300
    assert scan.attributes["returnCount"].tolist() == [1] * 600
    assert scan.attributes["intensity"].min() >= -3
    assert scan.finite.all() == (kind != "invalid")


@EVERY_KIND
def test_moved_points_are_where_they_were_put_and_all_else_is_as_it_was(kind: str) -> None:
    raw = sample(kind)
    scan = e57.read(raw, "a.e57")
    points = scan.points.copy()
    points[1::5] += np.random.default_rng(1).uniform(-2, 2, points[1::5].shape)
    points[4] += 9000  # beyond all bounds
    moved = e57.read(written(scan.moved_to(points), provenance={"by": "a < b & c"}), "b.e57")
    still = np.ones(len(scan), bool)
    still[1::5] = still[4] = False
    assert np.array_equal(moved.points[still], scan.points[still], equal_nan=True)
    assert np.nanmax(np.abs(moved.points - points)) <= step_of(moved)
    for name, values in scan.attributes.items():
        assert np.array_equal(moved.attributes[name], values), name
        assert moved.attributes[name].dtype == values.dtype
    assert moved.source.payloads() == scan.source.payloads()
    assert json.loads(moved.source.root.find("pcdenoise:provenance").text) == {"by": "a < b & c"}
    assert b"provenance" not in moved.source.without([]).xml


def test_bounds_hold_all_points_and_move_outward_only() -> None:
    scan = e57.read(io_samples.e57("double"), "a.e57")
    points = scan.points.copy()
    points[0, 0] = 77.25
    xml = e57.read(written(scan.moved_to(points)), "b.e57").source.xml.decode()
    assert '<xMaximum type="Float">77.25</xMaximum>' in xml
    assert '<xMinimum type="Float">-1e-1</xMinimum>' in xml
    assert 'maximum="77.25"' in xml
    assert "<temperature type='Float'>2e1</temperature> <!-- a > b -->" in xml


@EVERY_KIND
def test_columns_are_added_and_taken_away_again(kind: str) -> None:
    scan = e57.read(sample(kind), "a.e57")
    rng = np.random.default_rng(2)
    new = {
        "displacement": rng.normal(size=600), "flag": rng.random(600) > 0.5, "far": rng.integers(-9, 9, 600).astype("i2"),
        "red": rng.integers(0, 256, 600, dtype="u1"), "nx": rng.random(600).astype("f4"), "1 odd name": rng.random(600),
    }  # fmt: skip
    more = e57.read(written(scan.with_attributes(**new)), "b.e57")
    assert np.array_equal(more.points, scan.points, equal_nan=True)
    for name, values in {**new, "_1_odd_name": new["1 odd name"], **scan.attributes}.items():
        if name != "1 odd name":
            assert np.array_equal(more.attributes[name], values), name
    assert more.source.payloads() == scan.source.payloads()
    groups = more.source.root.find("data3D", "vectorChild", "pointGroupingSchemes", "groupingByLine", "groups")
    records = Records.at(groups, more.source.container, "b.e57")
    assert records.values("startPointIndex").tolist() == [0, 150]
    back = io.without(more, [name for name in more.attributes if name not in scan.attributes])
    assert list(back.attributes) == list(scan.attributes)
    again = e57.read(written(back), "c.e57")
    assert np.array_equal(again.points, scan.points, equal_nan=True)
    assert all(np.array_equal(again.attributes[name], values) for name, values in scan.attributes.items())
    assert again.source.payloads() == scan.source.payloads()


@EVERY_KIND
def test_rows_that_are_kept_are_as_they_were_and_groups_of_rows_go(kind: str) -> None:
    scan = e57.read(sample(kind), "a.e57")
    keep = np.random.default_rng(3).random(600) > 0.4
    kept = e57.read(written(io.select(scan, keep)), "b.e57")
    assert np.array_equal(kept.points, scan.points[keep], equal_nan=True)
    assert all(np.array_equal(kept.attributes[name], values[keep]) for name, values in scan.attributes.items())
    assert b"pointGroupingSchemes" not in kept.source.xml
    assert kept.source.payloads()["images"] == scan.source.payloads()["images"]
    assert len(e57.read(written(io.select(scan, np.zeros(600, bool))), "c.e57")) == 0


def test_poses_turn_and_shift_stations() -> None:
    alone, both = (e57.read(io_samples.e57("double", n_stations=n), "a.e57") for n in (1, 2))
    assert np.array_equal(both.points[:300], alone.points)
    local = both.source.stations[1].local()
    turned = local @ np.array([[0.28, -0.96, 0], [0.96, 0.28, 0], [0, 0, 1]]).T + [100, 0, 0]  # 0.8 + 0.6 k
    assert np.abs(both.points[300:] - turned).max() < 1e-12
    assert both.source.attachments() == ["poses of stations"]
    named = with_xml(io_samples.e57("double"), b"{station 0}", b"{station X}")
    assert e57.read(named, "b.e57").source.payloads() != alone.source.payloads()


def test_columns_and_rows_of_a_scan_from_elsewhere_come_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    points = np.round(rng.normal(5e5, 100, (500, 3)), 3)
    points[7] = np.nan
    columns = {
        "red": rng.integers(0, 256, 500, dtype="u2") * np.uint16(256), "green": np.zeros(500, "u2"), "blue": np.zeros(500, "u2"),
        "intensity": rng.random(500).astype("f4"), "classification": np.arange(500, dtype="u2"), "gps_time": rng.random(500),
        "name": np.array(["a"] * 500), "huge": np.full(500, 2**64 - 1, "u8"),
    }  # fmt: skip
    scan = io.Scan(points, columns)
    assert io.losses(scan, "e57") == ["column name", "column huge"]
    path, again = tmp_path / "a.e57", tmp_path / "b.e57"
    io.write(scan, path, drop_attributes=True, provenance={"a": 1})
    io.write(scan, again, drop_attributes=True, provenance={"a": 1})
    assert path.read_bytes() == again.read_bytes()
    back = io.read(path)
    assert np.array_equal(back.points, points, equal_nan=True)
    assert (back.attributes["red"] == columns["red"] // 256).all()
    assert all((back.attributes[name] == columns[name]).all() for name in ("intensity", "classification", "gps_time"))


@EVERY_KIND
def test_libe57_reads_what_is_written_as_we_do(kind: str, tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    scan = e57.read(sample(kind), "a.e57")
    points = scan.points.copy()
    points[1::5] += np.random.default_rng(1).uniform(-2, 2, points[1::5].shape)
    points[4] += 9000
    moved = scan.moved_to(points)
    files = {
        "as it was": sample(kind), "moved": written(moved, provenance={"a": 1}),
        "more": written(moved.with_attributes(further=np.arange(600.0)), provenance={"a": 1}),
        "fewer": written(io.select(moved, np.arange(600) % 3 > 0)), "new": written(io.Scan(scan.points, scan.attributes)),
    }  # fmt: skip
    for name, raw in files.items():
        path = tmp_path / "scan.e57"
        path.write_bytes(raw)
        ours, theirs = e57.read(raw, name), pye57.E57(str(path))
        assert theirs.scan_count == len(ours.source.stations)
        for number, station in enumerate(ours.source.stations):
            found = theirs.read_scan_raw(number, ignore_unsupported_fields=True)
            for axis in station.systems[0]:
                assert np.allclose(found[axis], station.records.measured(axis), rtol=0, atol=1e-9), (name, axis)
            assert (found["intensity"] == ours.attributes["intensity"][station.rows]).all(), name
        theirs.close()


def test_we_read_what_libe57_writes_as_it_does(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    rng = np.random.default_rng(6)
    path = tmp_path / "theirs.e57"
    file = pye57.E57(str(path), mode="w")
    n = 30_000  # several packets
    for turn in (0.0, 0.4):
        data = {f"cartesian{axis}": rng.normal(size=n) for axis in "XYZ"} | {"intensity": rng.random(n)}
        data |= {f"color{name}": rng.integers(0, 256, n) for name in ("Red", "Green", "Blue")} | {
            "rowIndex": np.arange(n) % 113,
            "columnIndex": np.arange(n) // 113,
        }
        file.write_scan_raw(data, rotation=np.array([np.cos(turn), 0, np.sin(turn), 0]), translation=np.array([turn, 3e5, 1.0]))
    file.close()
    scan, theirs = io.read(path), pye57.E57(str(path))
    for number in range(2):
        found = theirs.read_scan(number, intensity=True, colors=True, transform=True, ignore_missing_fields=True)
        rows = scan.attributes["station"] == number
        for axis, name in enumerate("XYZ"):
            assert np.abs(found[f"cartesian{name}"] - scan.points[rows, axis]).max() < 1e-9
        assert (found["colorRed"] == scan.attributes["red"][rows]).all()
        assert (theirs.read_scan_raw(number)["rowIndex"] == scan.attributes["rowIndex"][rows]).all()
    theirs.close()
    assert written(scan) == path.read_bytes()


DAMAGES = {
    "cut off in the header": (lambda raw: raw[:40], "ends before its header"),
    "cut off": (lambda raw: raw[:2048], "the file holds 2048"),
    "a wrong bit": (lambda raw: raw[:1500] + bytes([raw[1500] ^ 4]) + raw[1501:], "1 of"),
    "another version": (lambda raw: raw[:8] + b"\2" + raw[9:], "is E57 of version 2.0"),
    "odd pages": (lambda raw: raw[:40] + b"\7" + raw[41:], "in pages of"),
}
REPLACED = {
    "more points": (b'recordCount="300"', b'recordCount="900"', "claims 900 points and holds fewer"),
    "fewer than none": (b'recordCount="300"', b'recordCount="-30"', "is no number of them"),
    "no number": (b'recordCount="300"', b'recordCount="3x0"', "tells no fields"),
    "no place": (b'fileOffset = "48"', b'fileOffset = "4x"', "says not where"),
    "another place": (b'fileOffset = "48"', b'fileOffset = "40"', "names a section at byte 40"),
    "beyond the end": (b'fileOffset = "48"', b'fileOffset = "9999999"', "names a section at byte 9999999"),
    "a place before the file": (b'fileOffset = "48"', b'fileOffset = "-99999999"', "says not where"),
    "a number of other digits": (b'recordCount="300"', 'recordCount="８"'.encode(), "is no number of them"),
    "unknown type": (b"cartesianX type=\"Float\"", b"cartesianX type=\"Bloat\"", "tells no fields"),
    "no coordinates": (b"cartesianX", b"cartesianQ", "points have no coordinates"),
    "bounds the wrong way round": (b'minimum="-3"', b'minimum="3000"', "tells no fields"),
    "fewer bits": (b'maximum="1000"', b'maximum="4000000"', "holds fewer"),
    "no end": (b"</e57Root>", b"<e57Root>", "its XML is damaged"),
    "a document type": (b"<e57Root ", b"<!DOCTYPE a [<!ENTITY b 'c'>]><e57Root ", "declares a document type"),
    "fields alike": (b"cartesianY", b"cartesianX", "damaged"),
    "a pose of nothing": (b"<w type='Float'>8e-1</w>", b"<w type='Float'>nan</w>", "poses or bounds are no numbers"),
    "bounds of nothing": (b"-1e-1</xMinimum>", b"low</xMinimum>", "poses or bounds are no numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(name: str) -> None:
    damage, message = DAMAGES[name]
    raw = io_samples.e57("single", n_stations=2)
    said = io_samples.refusal(e57.read, damage(raw), "a.e57")
    assert message in said
    assert said.startswith("a.e57: ")


def with_xml(raw: bytes, old: bytes, new: bytes) -> bytes:
    """The file with other XML, its pages, length and checksums right."""
    logical = io_samples.e57_logical(raw)
    xml = logical[logical.index(b"<?xml") :].rstrip(b"\0")
    assert old in xml
    changed = logical[: logical.index(b"<?xml")] + xml.replace(old, new)
    n_pages = -(-len(changed) // 1020)
    head = bytearray(changed)
    head[16:24] = (n_pages * 1024).to_bytes(8, "little")
    head[32:40] = (len(xml) + (len(new) - len(old)) * xml.count(old)).to_bytes(8, "little")
    return io_samples.e57_pages(bytes(head))


@pytest.mark.parametrize("name", REPLACED)
def test_a_lie_in_the_xml_is_named(name: str) -> None:
    old, new, message = REPLACED[name]
    said = io_samples.refusal(e57.read, with_xml(io_samples.e57("single", n_stations=2), old, new), "a.e57")
    assert message in said
    assert "\n" not in said


def test_stations_that_share_their_points_do_not_multiply_them() -> None:
    raw = io_samples.e57("single", n=5000)
    logical = io_samples.e57_logical(raw)
    start, stop = logical.index(b"  <vectorChild"), logical.index(b"</data3D>")
    station = logical[start:stop]
    said = io_samples.refusal(e57.read, with_xml(raw, station, 50 * station), "a.e57")
    assert "several stations claim the same points" in said


def test_xml_deeper_or_longer_than_any_is_refused() -> None:
    raw = io_samples.e57("single", n=10)
    for more, message in ((b"<a>" * 90 + b"</a>" * 90, "more or deeper"), (b"<a/>" * (1 << 20), "more or deeper")):
        said = io_samples.refusal(e57.read, with_xml(raw, b"</e57Root>", more + b"</e57Root>"), "a.e57")
        assert message in said


@pytest.mark.parametrize("n_constant", [3, 120])
def test_values_that_take_no_place_do_not_fill_the_memory(n_constant: int) -> None:
    n, layout = 8000, e57_file.Layout()
    fields = [Field(f"cartesian{axis}", "integer", 0, 1) for axis in "XYZ"]
    fields += [Field(f"a{i}", "integer", 2**62, 2**62) for i in range(n_constant)]
    at = layout.add_vector(fields, [field.packed(np.full(n, field.low)) for field in fields], n)
    prototype = "".join(f'<{field.name} type="Integer" minimum="{field.low}" maximum="{field.high}"/>' for field in fields)
    points = f'<points type="CompressedVector" fileOffset="{at}" recordCount="{n}"><prototype>{prototype}</prototype></points>'
    raw = e57_file.closed(layout.data, f"<e57Root><data3D><vectorChild>{points}</vectorChild></data3D></e57Root>".encode())
    if n_constant == 3:
        assert len(e57.read(raw, "a.e57")) == n
    else:
        assert "claims 8000 points and holds fewer" in io_samples.refusal(e57.read, raw, "a.e57")


def test_an_image_named_many_times_is_held_once() -> None:
    raw = io_samples.e57("single", n=10, image=bytes(100_000))
    logical = io_samples.e57_logical(raw)
    start, stop = logical.index(b"<visualReference"), logical.index(b"</vectorChild></images2D>")
    scan = e57.read(with_xml(raw, logical[start:stop], 50 * logical[start:stop]), "a.e57")
    assert len(scan.source.payloads()["images"]) == 100_016
    more = written(scan.with_attributes(further=np.arange(10.0)))
    assert len(more) < 150_000
    assert e57.read(more, "b.e57").source.payloads()["images"] == scan.source.payloads()["images"]


def test_whole_numbers_keep_every_digit_when_some_are_replaced() -> None:
    scan = e57.read(io_samples.e57("single"), "a.e57")
    wide = scan.attributes["who:wide"].copy()
    assert np.abs(wide).max() > 2**61
    wide[3] = 2**60 + 1
    back = e57.read(written(scan.with_attributes(**{"who:wide": wide})), "b.e57")
    assert (back.attributes["who:wide"] == wide).all()
    unsigned = io.Scan(np.zeros((3, 3)), {"wide": np.array([0, 1, 2**32], np.int64)})
    assert io.losses(e57.read(written(unsigned), "c.e57"), "e57") == []


def test_bounds_of_angles_and_floats_keep_what_they_held() -> None:
    scan = e57.read(io_samples.e57("spherical"), "a.e57")
    before = scan.source.stations[0].records.measured("sphericalAzimuth")
    turned = e57.read(written(scan.moved_to(scan.points * 1.0001)), "b.e57").source.stations[0].records
    assert np.abs(turned.measured("sphericalAzimuth") - before).max() < 1e-12
    scan = e57.read(io_samples.e57("double"), "a.e57")
    low = scan.source.stations[0].records.prototype.children[0].attributes["minimum"]
    points = scan.points.copy()
    points[0, 0] = 99.5
    after = e57.read(written(scan.moved_to(points)), "b.e57").source.stations[0].records.prototype.children[0].attributes
    assert (after["minimum"], after["maximum"]) == (low, "99.5")


def test_other_prefixes_stay_what_they_were() -> None:
    raw = with_xml(io_samples.e57("single"), b"xmlns:who='urn:who'", b"xmlns:who='urn:who' xmlns:nor='urn:nor'")
    scan = e57.read(raw, "a.e57")
    assert b"xmlns:nor='urn:nor'" in e57.read(written(scan, provenance={"a": 1}), "b.e57").source.xml


@pytest.mark.parametrize("with_structure", [False, True])
def test_sections_that_are_no_points_are_moved_whole(with_structure: bool) -> None:
    raw = io_samples.e57("single", groups=True, image=IMAGE)
    if with_structure:
        nested = b'<pointCount type="Integer" minimum="0" maximum="65535"/>'
        raw = with_xml(raw, nested, nested + b'<cartesianBounds type="Structure"><xMinimum type="Float"/></cartesianBounds>')
    scan = e57.read(raw, "a.e57")
    more = e57.read(written(scan.with_attributes(further=np.arange(300.0))), "b.e57")
    assert (more.attributes["further"] == np.arange(300)).all()
    assert more.source.payloads() == scan.source.payloads()


def low_level(path: Path, sizes: list[int]) -> None:
    """A file of libE57Format's own low level: stations of so many points, each with a text."""
    libe57 = pytest.importorskip("pye57").libe57
    file = libe57.ImageFile(str(path), "w")
    root, data = file.root(), libe57.VectorNode(file, True)
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(file, "{file}"))
    root.set("data3D", data)
    for n in sizes:
        station, prototype = libe57.StructureNode(file), libe57.StructureNode(file)
        for axis in "XYZ":
            prototype.set(f"cartesian{axis}", libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE, -1e9, 1e9))
        points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
        station.set("guid", libe57.StringNode(file, "{station}"))
        station.set("points", points)
        data.append(station)
        values = [np.arange(n, dtype=float) + i for i in range(3)]
        buffers = libe57.VectorSourceDestBuffer()
        for axis, some in zip("XYZ", values, strict=True):
            buffers.append(libe57.SourceDestBuffer(file, f"cartesian{axis}", some if n else np.zeros(1), max(n, 1), True, True))
        writer = points.writer(buffers)
        if n:
            writer.write(n)
        writer.close()
    file.close()


def test_stations_without_points_are_read_from_libe57_and_by_it(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    path, few = tmp_path / "in.e57", tmp_path / "few.e57"
    low_level(path, [5, 0, 7])
    scan = io.read(path)
    assert scan.attributes["station"].tolist() == [0] * 5 + [2] * 7
    assert written(scan) == path.read_bytes()
    io.write(io.select(scan, np.arange(12) >= 5), few)
    theirs = pye57.E57(str(few))
    assert [theirs.get_header(number).point_count for number in range(3)] == [0, 0, 7]
    assert theirs.read_scan_raw(2)["cartesianX"].tolist() == list(range(7))
    theirs.close()


@settings(max_examples=80, deadline=None, database=None)
@given(data=st.data())
def test_a_damaged_file_with_right_checksums_gives_a_sound_scan_or_one_line(data: st.DataObject) -> None:
    logical = bytearray(io_samples.e57_logical(data.draw(st.sampled_from([io_samples.e57(kind, n=40) for kind in KINDS]))))
    for _ in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(48, len(logical) - 1))
        new = data.draw(
            st.one_of(st.sampled_from([b'"', b"<", b"nan", b"1e309", b"-1", b"9" * 30, b"\xff" * 8]), st.binary(max_size=6))
        )
        logical[at : at + len(new)] = new
    raw = io_samples.e57_pages(bytes(logical[: len(logical) // 1020 * 1020]))
    try:
        scan = e57.read(raw, "fuzzed")
    except ScanError as fault:
        assert "\n" not in str(fault)
        assert str(fault).startswith("fuzzed")
        return
    assert scan.points.shape == (len(scan), 3)
    assert all(len(values) == len(scan) for values in scan.attributes.values())
    written(scan.moved_to(np.where(scan.finite[:, None], scan.points + 1, scan.points)), provenance={"a": 1})


def test_a_scan_is_cleaned_verified_and_taken_back_to_the_last_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    sheet = np.column_stack([rng.uniform(0, 5, (4000, 2)), np.zeros(4000)])
    noisy = sheet + rng.normal(0, 0.02, sheet.shape)
    path, clean = tmp_path / "in.e57", tmp_path / "out" / "clean.e57"
    io.write(io.Scan(noisy, {"intensity": rng.random(4000).astype("f4")}), path)
    assert main(["denoise", str(path), "-o", str(clean), "--displacement", "-q", "--threads", "1"]) == 0
    assert np.std(io.read(clean).points[:, 2]) < 0.5 * np.std(noisy[:, 2])
    assert main(["verify", str(path), str(clean)]) == 0
    back = tmp_path / "back.e57"
    assert main(["undo", str(clean), "-o", str(back)]) == 0
    assert np.array_equal(io.read(back).points, io.read(path).points)
