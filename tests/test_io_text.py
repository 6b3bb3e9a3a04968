"""Text scans come back as they were in every dialect; wrong lines are named."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest

import io_samples
from pcdenoise.cloud.scan import Scan
from pcdenoise.errors import ScanError
from pcdenoise.io import lines, text, xyz

DIALECTS = pytest.mark.parametrize("dialect", io_samples.XYZ)


def written(scan: Scan, **options: str) -> bytes:
    file = BytesIO()
    xyz.write(scan, file, **options)
    return file.getvalue()


def fields(raw: bytes) -> list[list[str]]:
    """Lines and what is between delimiters, blanks kept: an independent, naive reading."""
    for delimiter in b";\t " if b"1,5;" in raw else b";,\t ":
        raw = raw.replace(bytes([delimiter]), b"|")
    return [line.split("|") for line in raw.decode().splitlines()]


@DIALECTS
def test_a_text_whose_points_did_not_move_comes_back_byte_for_byte(dialect: str) -> None:
    raw = io_samples.XYZ[dialect]
    assert written(xyz.read(raw, "sample")) == raw


@DIALECTS
def test_moving_a_row_changes_its_three_numbers_alone(dialect: str) -> None:
    raw = io_samples.XYZ[dialect]
    scan = xyz.read(raw, "sample")
    points = scan.points.copy()
    points[2] += [0.25, -0.5, 0.125]
    out = written(scan.moved_to(points))
    extent = float(np.ptp(points[scan.finite], axis=0).max())
    np.testing.assert_allclose(xyz.read(out, "back").points, points, rtol=0, atol=1e-6 * extent)
    before, after = fields(raw), fields(out)
    assert [len(row) for row in before] == [len(row) for row in after]
    changes = [(i, k) for i, row in enumerate(before) for k, field in enumerate(row) if field != after[i][k]]
    assert len(changes) == 3
    assert len({i for i, _ in changes}) == 1, "one line"


@DIALECTS
def test_selected_rows_keep_their_lines(dialect: str) -> None:
    raw = io_samples.XYZ[dialect]
    scan = xyz.read(raw, "sample")
    source = scan.source.selected(np.array([True, False, True]))
    out = written(Scan(source.points(), source.columns, "xyz", "sample", source))
    back = xyz.read(out, "back")
    assert np.array_equal(back.points, scan.points[::2], equal_nan=True)
    for name in scan.attributes.keys() & back.attributes.keys():
        assert np.array_equal(back.attributes[name], scan.attributes[name][::2])
    kept = [line for line in out.splitlines() if line in raw.splitlines()]
    assert len(kept) >= len(raw.splitlines()) - 2, "all other lines are the same, but for a count"


@DIALECTS
def test_a_new_column_is_appended_to_every_row_and_named_where_columns_have_names(dialect: str) -> None:
    scan = xyz.read(io_samples.XYZ[dialect], "sample")
    out = written(scan.with_attributes(outlier=np.array([True, False, True]), move=np.array([0.1, -1e-20, np.nan])))
    back = xyz.read(out, "back")
    assert np.array_equal(back.points, scan.points, equal_nan=True)
    if dialect != "uneven":
        names = list(back.attributes)[-2:]
        assert np.array_equal(back.attributes[names[0]], [1, 0, 1])
        assert np.array_equal(back.attributes[names[1]], [0.1, -1e-20, np.nan], equal_nan=True)
    assert ("outlier" in back.attributes) == (scan.source.names_end is not None)


def test_columns_are_found_by_name_and_keep_names_and_kinds() -> None:
    scan = xyz.read(io_samples.XYZ["header in another order"], "sample")
    assert scan.points.tolist() == [[1.3, 2.2, 3.1], [4.3, 5.2, 6.1], [7.3, 8.2, 9.1]]
    assert scan.attributes["Intensity"].tolist() == [7, 8, 9]
    assert scan.attributes["Intensity"].dtype == np.int64
    quotes = xyz.read(io_samples.XYZ["quotes"], "sample")
    assert quotes.attributes["name"].tolist() == ["a, b", "c", "d"]
    assert xyz.read(io_samples.XYZ["columns"], "sample").attributes["column_5"].tolist() == [0.5, 0.25, 0.125]
    assert xyz.read(io_samples.XYZ["big integers"], "sample").attributes["column_4"][0] == 9007199254740993


def test_units_in_brackets_do_not_hide_a_coordinate_and_wide_padding_is_no_number() -> None:
    scan = xyz.read(b"t,Z [m],Y (m),x\n1,2,3,4\n5,6,7,8\n", "sample")
    assert scan.points.tolist() == [[4, 3, 2], [8, 7, 6]]
    wide = b"1,2," + b" " * 5000 + b"3\n4,5,6\n# careful\n7,8,9\n"
    assert xyz.read(wide.replace(b" " * 4000, b""), "padded").points.tolist()[0] == [1, 2, 3]
    with pytest.raises(ScanError, match="not a number"):
        xyz.read(wide, "too wide")


@pytest.mark.parametrize(
    ("title", "axes"),
    [
        ("id,Easting,Northing,Height,label", (1, 2, 3)),
        ("ID,E,N,H", (1, 2, 3)),
        ("Northing [m],Easting [m],Elevation [m],class", (1, 0, 2)),
        ("e,n,h,x,y,z", (3, 4, 5)),
        ("z,northing,easting", (2, 1, 0)),
    ],
)
def test_surveyors_names_of_coordinates_are_known_and_xyz_comes_first(title: str, axes: tuple[int, int, int]) -> None:
    rows = np.arange(60.0).reshape(10, 6)[:, : title.count(",") + 1] ** 2
    raw = title + "\n" + "\n".join(",".join(f"{value:.1f}" for value in row) for row in rows) + "\n"
    scan = xyz.read(raw.encode(), "survey.csv")
    assert np.array_equal(scan.points, rows[:, axes])
    assert len(scan.attributes) == rows.shape[1] - 3


@pytest.mark.parametrize("first", [0, 1, 1000])
def test_a_column_that_counts_rows_is_no_coordinate(first: int, rng: np.random.Generator) -> None:
    numbers = rng.random((50, 3))
    counted = "".join(f"{first + i} {x:.3f} {y:.3f} {z:.3f}\n" for i, (x, y, z) in enumerate(numbers))
    assert "its first column counts the rows" in io_samples.refusal(xyz.read, counted.encode(), "a.txt")
    named = xyz.read(b"id x y z\n" + counted.encode(), "a.txt")
    assert np.abs(named.points - numbers).max() <= 5e-4 + 1e-12
    profile = "".join(f"{i} {x:.3f} {y:.3f}\n" for i, (x, y, _) in enumerate(numbers))
    assert xyz.read(profile.encode(), "profile.txt").points[:, 0].tolist() == list(range(50))


def test_an_attribute_of_the_file_can_be_replaced() -> None:
    raw = io_samples.XYZ["header in another order"]
    out = written(xyz.read(raw, "sample").with_attributes(Intensity=np.array([70, 80, 90])))
    assert out == raw.replace(b"\n7,", b"\n70,").replace(b"\n8,", b"\n80,").replace(b"\n9,", b"\n90,")


def test_moved_coordinates_keep_the_decimals_of_their_column_but_resolve_a_millionth_of_the_extent() -> None:
    raw = b"0.0 0.000000 5\n1000.0 1.000000 6\n2000.0 2.000000 7\n"
    scan = xyz.read(raw, "sample")
    moved = written(scan.moved_to(scan.points + 0.12345678901234)).splitlines()
    assert moved[1] == b"1000.123 1.123457 6.123"


@pytest.mark.parametrize(
    "raw",
    [
        b"1;2;3;4\n1,5;2,5;3,5;4\n4,5;5,5;6,5;0,5\n",  # whole numbers first
        b"x;y;z;p\n1;2;3;0,5\n# v1.2 done.\n1,5;2,5;3,5;0,25\n",
        b"P1.1;x;y;z;note\nP1.1;1,5;2,5;3,5;a, b 1.2\nP1.2;1;2;3;01.02.2024\n",
    ],
)
def test_decimal_commas_are_seen_where_other_fields_and_lines_have_points(raw: bytes) -> None:
    scan = xyz.read(raw, "sample")
    assert [1.5, 2.5, 3.5] in scan.points.tolist()
    assert written(scan) == raw
    assert all(text in raw.decode() for values in scan.attributes.values() if values.dtype.kind == "U" for text in values)
    keep = scan.points[:, 0] == 1  # rows of whole numbers alone
    assert source_bytes(scan.source.selected(keep)).count(b"\n") == raw.count(b"\n") - int((~keep).sum())


def source_bytes(source: xyz.XyzSource) -> bytes:
    return source.head + source.rows.as_in_file(source.rows.body)


@pytest.mark.parametrize("title", ["Projekt 12, Halle", "Scan 3, hall A"])
def test_a_title_with_a_comma_is_a_title(title: str) -> None:
    assert xyz.read(f"{title}\n1.5 2.5 3.5\n".encode(), "sample").points.tolist() == [[1.5, 2.5, 3.5]]


def test_columns_with_names_in_latin_1_are_taken_out_with_their_names() -> None:
    raw = "x y z Stärke Code\n1.5 2.5 3.5 1 7\n".encode("latin-1")
    source = xyz.read(raw, "sample").source.without(["Stärke"])
    assert source_bytes(source) == b"x y z Code\n1.5 2.5 3.5 7\n"


def test_new_names_stand_under_those_of_columns_that_had_none() -> None:
    raw = b"x y z\n1.5 2.5 3.5 7\n4.5 5.5 6.5 8\n"
    out = written(xyz.read(raw, "sample").with_attributes(std=np.array([0.5, 0.25])))
    assert out.splitlines()[:2] == [b"x y z column_4 std", b"1.5 2.5 3.5 7 0.5"]
    back = xyz.read(out, "back")
    assert back.attributes["column_4"].tolist() == [7, 8]
    assert back.attributes["std"].tolist() == [0.5, 0.25]
    assert source_bytes(back.source.without(["std"])) == raw.replace(b"z", b"z column_4")


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"X,Y,Z\n3,467,-6,181,-0,660\n", "line 2: has 6 fields under 3 names"),
        (b"Nr;A;B;C\n3;1,5;2,5;3,5\n9;4,5;5,5;6,5\n", "its first column is Nr"),
    ],
)
def test_columns_that_cannot_be_told_apart_are_refused(raw: bytes, message: str) -> None:
    with pytest.raises(ScanError, match=message):
        xyz.read(raw, "sample")


def test_points_that_became_no_numbers_are_written_as_such() -> None:
    scan = xyz.read(b"1.5 2.5 3.5\n4.5 5.5 6.5\n", "sample")
    assert written(scan.moved_to(np.array([[1.5, 2.5, 3.5], [np.nan, np.inf, 6.5]]))).splitlines()[1] == b"nan inf 6.5"


def test_far_from_the_origin_no_more_digits_are_printed_than_near_it(rng: np.random.Generator) -> None:
    points = np.round(rng.random((100, 3)) * 20, 3)
    for offset in (0, 4_512_000):
        raw = "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in (points + offset).tolist()).encode()
        scan = xyz.read(raw, "sample")
        row = written(scan.moved_to(scan.points + 1e-4 * rng.random((100, 3)))).splitlines()[0].decode()
        assert [len(field.partition(".")[2]) for field in row.split()] == [5, 5, 5]  # a millionth of twenty units


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"1 2 3\n4 5\n7 8 9\n", r"line 2: has 2 columns"),
        (b"1 2 3\n# two\n4 oops 6\n", r"line 3: 'oops' is not a number"),
        (b"x,y,z\n1,2,3\n4,,6\n", r"line 3: '' is not a number"),
        (b"4\n1 2 3\n4 5 6\n", r"claims 4 points, the file holds 2"),
        (b"1,5;2,5;3,5\n4,5;5.5;6,5\n", r"line 2: '5.5' is not a number"),
        (b"1,5;2,5\n", r"line 1: has fewer than three numbers"),
        (b"1 2\n3 4\n", r"line 1: has fewer than three numbers"),
        (b"only words\n" * 5, "three numbers"),
        (b"\xff\xfe1\x00 \x002\x00", "UTF-16"),
        (b"1 " * 5000 + b"\n", "5000 columns"),
        (b"x" * 200_000, "200000 bytes"),
    ],
)
def test_wrong_text_is_one_line_that_names_the_file_and_the_place(raw: bytes, message: str) -> None:
    with pytest.raises(ScanError, match=message) as caught:
        xyz.read(raw, "wrong.xyz")
    assert str(caught.value).startswith("wrong.xyz: ")


@pytest.mark.parametrize("delimiter", ["; ", "\t", " "])
def test_decimal_commas_are_read_and_written(delimiter: str) -> None:
    rows = ["12,25 4000,125 3,5 7", "13,25 4001,125 4,5 8", "# a remark, too", "14,25 4002,125 5,5 9"]
    raw = "\r\n".join(["x y z Class", *rows]).replace(" ", delimiter).encode()
    scan = xyz.read(raw, "sample")
    assert scan.points.tolist() == [[12.25, 4000.125, 3.5], [13.25, 4001.125, 4.5], [14.25, 4002.125, 5.5]]
    assert scan.attributes["Class"].tolist() == [7, 8, 9]
    assert written(scan) == raw
    moved = scan.points + [[0, 0, 0.25]] * 3
    assert written(scan.moved_to(moved)).replace(b"3,75", b"3,5").replace(b"4,75", b"4,5").replace(b"5,75", b"5,5") == raw
    longer = scan.with_attributes(std=np.array([0.5, 0.25, 0.125]))
    assert written(longer).splitlines()[1].endswith(f"{delimiter[0]}0,5".encode())
    source = xyz.read(written(longer), "back").source.without(["std"])
    assert source_bytes(source) == raw
    assert source.selected(np.array([True, False, True])).points()[:, 0].tolist() == [12.25, 14.25]
    assert np.concatenate([piece.points for piece in xyz.XyzStream(raw, "sample").pieces(2)]).tolist() == scan.points.tolist()


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_list_of_points_from_a_total_station_is_read_by_its_names(encoding: str) -> None:
    raw = "Punkt;Rechtswert;Hochwert;Höhe [m];Code\nP1;4512006,37;5403002,698;320,079;7\n".encode(encoding)
    scan = xyz.read(raw, "sample")
    assert scan.points.tolist() == [[4512006.37, 5403002.698, 320.079]]
    assert {name: values.tolist() for name, values in scan.attributes.items()} == {"Punkt": ["P1"], "Code": [7]}
    assert written(scan) == raw


def test_the_careful_reader_and_numpy_agree(rng: np.random.Generator) -> None:
    values = rng.normal(size=(500, 4)) * 10.0 ** rng.integers(-12, 12, (500, 4))
    raw = "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in values.tolist()).encode()
    quick = xyz.read(raw, "quick")
    careful = xyz.read(raw.replace(b"\n", b"\n# remark\n"), "careful")
    assert np.array_equal(quick.points, values[:, :3])
    assert np.array_equal(careful.points, values[:, :3])
    assert np.array_equal(careful.attributes["column_4"], values[:, 3])


def test_rows_beyond_one_block_are_read_and_rewritten(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "_BLOCK_BYTES", 100)
    raw = b"".join(b"%d, %d , 7,%s\n" % (2 * i, -i, b"w" * (i % 50)) for i in range(200))
    scan = xyz.read(raw, "sample")
    assert scan.points[:, 0].tolist() == list(range(0, 400, 2))
    moved = scan.points.copy()
    moved[::3, 1] += 0.5
    assert np.array_equal(xyz.read(written(scan.moved_to(moved)), "back").points, moved)


def test_a_splice_is_what_python_would_do(rng: np.random.Generator) -> None:
    for _ in range(50):
        raw = rng.bytes(60)
        edges = np.sort(rng.choice(61, 8, replace=False)).tolist()
        spans = list(zip(edges[0::2], edges[1::2], strict=True))
        pieces = [rng.bytes(int(n)) for n in rng.integers(0, 5, 4)]
        expected, at = b"", 0
        for (start, end), piece in zip(spans, pieces, strict=True):
            expected, at = expected + raw[at:start] + piece, end
        lengths = np.array([len(piece) for piece in pieces])
        joined = np.frombuffer(b"".join(pieces), np.uint8)
        starts, ends = np.array(spans).T
        out = lines.spliced(np.frombuffer(raw, np.uint8), starts, ends - starts, joined, np.cumsum(lengths) - lengths, lengths)
        assert out.tobytes() == expected + raw[at:]


@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".pts"])
def test_a_scan_from_elsewhere_becomes_text_that_reads_back(suffix: str, rng: np.random.Generator) -> None:
    points = rng.normal(size=(20, 3)) * 100 + [5e5, 4.6e6, 30]
    attributes = {"red": np.arange(20) * 256, "green": np.arange(20) * 256, "blue": np.arange(20) * 256, "t": rng.random(20)}
    out = written(Scan(points, attributes), suffix=suffix)
    back = xyz.read(out, "back")
    assert np.abs(back.points - points).max() <= 1e-9 * np.ptp(points, axis=0).max()
    columns = list(back.attributes.values())
    assert columns[0].tolist() == list(range(20)), "16-bit colours that are 8-bit ones become them"
    assert np.array_equal(columns[3], attributes["t"])
    assert out.startswith({".xyz": b"# x y z red", ".csv": b"x,y,z,red", ".pts": b"20\n"}[suffix])


def test_random_damage_never_ends_in_anything_but_a_scan_error(rng: np.random.Generator) -> None:
    n_read = 0
    for _ in range(300):
        broken = bytearray(io_samples.XYZ[str(rng.choice(list(io_samples.XYZ)))])
        for at in rng.integers(0, len(broken), rng.integers(1, 4)).tolist():
            broken[at : at + 1] = rng.choice([b"\n", b'"', b"\xa0", b",", b"\x1c", b" ", b"e", b"-", rng.bytes(1)])
        message = io_samples.refusal(xyz.read, bytes(broken), "broken")
        assert "\n" not in message
        if not message:
            scan = xyz.read(bytes(broken), "broken")
            assert written(scan) == bytes(broken)
            written(scan.moved_to(scan.points + 1))
            n_read += 1
    assert n_read
