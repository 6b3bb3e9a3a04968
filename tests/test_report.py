"""A report says what was measured: valid JSON and CSV, a page that needs nothing else, clouds that come out as they went in."""

from __future__ import annotations

import base64
import csv
import json
import re
import zlib
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pcdenoise.errors import ScanError, UsageError
from pcdenoise.evaluation import charts, report, scene
from pcdenoise.evaluation.colours import Scalar, displacement

REPORT = {
    "command": "denoise",
    "version": "0",
    "settings": {"iters": 3, "seed": 0, "model": Path("models") / "default", "threads": None},
    "figures": {"noise_std_m": np.float32(0.5), "left": float("nan"), "n_points": np.int64(7)},
    "files": [
        {"input": "a.las", "figures": {"seconds_s": 1.5, "far": float("inf")}},
        {"input": 'b, "c".las', "error": "unreadable", "values": np.arange(2)},
    ],
}


def test_json_is_strict_and_names_its_schema(tmp_path: Path) -> None:
    report.write_report(tmp_path / "r.json", REPORT)

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    read = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"), parse_constant=refuse)
    assert read["schema"] == "pcdenoise-report/1"
    assert read["figures"] == {"noise_std_m": 0.5, "left": None, "n_points": 7}
    assert read["settings"] == {"iters": 3, "seed": 0, "model": str(Path("models") / "default"), "threads": None}
    assert read["files"][0]["figures"]["far"] is None
    assert read["files"][1]["values"] == [0, 1]


def test_json_takes_dataclasses_and_refuses_what_it_cannot_say() -> None:
    @dataclass
    class Level:
        std: float

    assert report.plain({"level": Level(0.25), 3: {1}}) == {"level": {"std": 0.25}, "3": [1]}
    with pytest.raises(TypeError, match="object cannot be written"):
        report.plain({"x": object()})


def test_csv_has_a_row_for_each_file_and_a_column_for_each_key(tmp_path: Path) -> None:
    report.write_report(tmp_path / "r.csv", REPORT)
    with (tmp_path / "r.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["input", "figures.seconds_s", "figures.far", "error", "values"]
    assert [row["input"] for row in rows] == ["a.las", 'b, "c".las']
    assert (rows[0]["figures.seconds_s"], rows[0]["figures.far"], rows[0]["error"]) == ("1.5", "", "")
    assert json.loads(rows[1]["values"]) == [0, 1]


def test_the_suffix_decides_and_an_unknown_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.json, \.csv or \.html"):
        report.write_report(tmp_path / "r.xlsx", REPORT)
    report.write_report(tmp_path / "r.HTML", REPORT)
    assert (tmp_path / "r.HTML").read_text(encoding="utf-8").startswith("<!doctype html>")


@pytest.mark.parametrize("name", ["r.json", "r.csv", "r.html"])
def test_a_report_is_never_half_written_nor_overwritten_unasked(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(ScanError, match="exists already"):
        report.write_report(tmp_path / name, REPORT, overwrite=False)
    with pytest.raises(TypeError):
        report.write_report(tmp_path / name, {"figures": {"x": object()}, "files": [{"x": object()}]})
    assert (tmp_path / name).read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 1


class Page(HTMLParser):
    """Every element with its attributes, the text, and whether each element that opens is closed."""

    VOID = frozenset({"meta", "input", "img", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in {"script", "style"}:
            self.text += data


@pytest.fixture
def clouds(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    before = rng.normal(size=(3000, 3)) + [515_396.0, 4_918_348.0, 2324.0]
    return before, before + rng.normal(scale=0.01, size=before.shape)


def written(path: Path, **page: object) -> Page:
    report.write_html(path, title="T", **{key: REPORT[key] for key in ("figures", "settings")}, page=report.Page(**page))
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_is_whole_and_loads_nothing(tmp_path: Path, clouds: tuple[np.ndarray, np.ndarray]) -> None:
    pictures = {"<em>one</em>": np.zeros((4, 5, 3), dtype=np.uint8)}
    curve = charts.curve({"a": [1, 2]}, title="C")
    page = written(tmp_path / "r.html", before=clouds[0], after=clouds[1], pictures=pictures, charts=[curve])
    assert not page.open
    for tag, attributes in page.elements:
        assert tag not in {"link", "iframe", "object", "embed", "base"}
        for name in ("src", "href", "srcset", "poster", "action"):
            assert (attributes.get(name) or "data:").startswith("data:")
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|@import|url\(|\{\{", text)
    assert "default-src 'none'" in text
    assert "<em>one</em>" in page.text


def test_every_control_has_a_label(tmp_path: Path, clouds: tuple[np.ndarray, np.ndarray]) -> None:
    written(tmp_path / "r.html", before=clouds[0])
    text = re.sub(r"\s+", " ", (tmp_path / "r.html").read_text(encoding="utf-8"))
    for control in re.findall(r"<(?:input|select)[^>]*>", text):
        assert "aria-label" in control or re.search(rf"<label[^>]*>[^<]+{re.escape(control)}", text), control
    for button in re.findall(r"<button[^>]*>([^<]*)</button>", text):
        assert button.strip()


def test_text_from_files_cannot_become_markup(tmp_path: Path, clouds: tuple[np.ndarray, np.ndarray]) -> None:
    nasty = "</script><script>alert(1)</script>"
    colours, tables = {nasty: clouds[0][:, 2]}, {nasty: [{nasty: nasty}]}
    content = report.Page(before=clouds[0], colours=colours, tables=tables, names=(nasty, "b"), lead=nasty)
    report.write_html(tmp_path / "r.html", title=nasty, figures={nasty: nasty}, page=content)
    page = Page((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert sum(tag == "script" for tag, _ in page.elements) == 3
    assert nasty in page.text


def test_figures_stand_on_the_page_as_people_write_them(tmp_path: Path) -> None:
    page = written(tmp_path / "r.html", tables={"Steps": [{"moved_m": 0.25, "kept": True}, {"moved_m": None, "kept": False}]})
    for words in ("Noise std (m)", "0.5", "Moved (m)", "yes", "no", "\u2013"):
        assert words in page.text
    assert '<td class="number">0.5</td>' in (tmp_path / "r.html").read_text()  # numbers are not broken
    assert not any(attributes.get("id") == "viewer" and "hidden" not in attributes for _, attributes in page.elements)


def unpacked(description: dict, data: str) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
    """Clouds and colours by a decoder of its own, after the layout that scene.py describes."""
    stream = np.frombuffer(zlib.decompress(base64.b64decode(data)), dtype=np.uint8).astype(np.int64)
    at = 0

    def take(n: int) -> np.ndarray:
        nonlocal at
        at += n
        return stream[at - n : at]

    steps: list[np.ndarray] = []
    for place, cloud in enumerate(description["clouds"]):
        planes = take(9 * cloud["n"]).reshape(3, 3, cloud["n"])
        folded = planes[:, 0] | planes[:, 1] << 8 | planes[:, 2] << 16
        difference = ((folded >> 1) ^ -(folded & 1)).T
        steps.append(steps[0] + difference if place and cloud["paired"] else difference.cumsum(axis=0))
    take(description["clouds"][0]["n"])
    colours = {}
    for colour in description["colours"]:
        n = description["clouds"][colour["clouds"][0]]["n"]
        colours[colour["name"]] = take(3 * n).reshape(3, n).T if colour["kind"] == "rgb" else take(n)
    assert at == len(stream)
    return steps, colours


def rows_of(points: np.ndarray, steps: np.ndarray, description: dict) -> np.ndarray:
    """For each unpacked row the row of `points` it came from, which must be within half a step on every axis."""
    distance, rows = cKDTree(points).query(steps * description["step"] + description["low"])
    assert distance.max() <= np.sqrt(3) / 2 * description["step"] * 1.001
    return rows


def test_clouds_and_colours_come_out_as_they_went_in(clouds: tuple[np.ndarray, np.ndarray], rng: np.random.Generator) -> None:
    before, after = clouds
    rgb = rng.integers(0, 256, size=(3000, 3), dtype=np.uint8)
    height = Scalar(np.where(np.arange(3000) % 7 == 0, np.nan, before[:, 2]), low=2320, high=2330)
    description, data = scene.pack({"a": before, "b": after}, {"rgb": rgb, "height": height, "none": None})
    (first, second), colours = unpacked(description, data)
    step = description["step"]
    rows = rows_of(before, first, description)
    assert sorted(rows) == list(range(3000))
    assert step < 2e-5  # 20 units in a million steps
    np.testing.assert_allclose((second - first) * step, (after - before)[rows], atol=1.01 * step)
    np.testing.assert_array_equal(colours["rgb"], rgb[rows])
    unknown = colours["height"] == 255
    np.testing.assert_array_equal(unknown, rows % 7 == 0)
    np.testing.assert_allclose(2320 + 10 * colours["height"][~unknown] / 254, before[rows, 2][~unknown], atol=10 / 254 / 2 + 1e-6)
    assert set(colours) == {"rgb", "height"}


def test_rows_that_are_nowhere_in_one_cloud_are_left_out_of_all(clouds: tuple[np.ndarray, np.ndarray]) -> None:
    before, after = (cloud.copy() for cloud in clouds)
    before[5] = np.nan
    after[9] = np.inf
    before[11] += 1e7
    description, data = scene.pack({"a": before, "b": after}, {})
    assert [cloud["n"] for cloud in description["clouds"]] == [2997, 2997]
    assert [cloud["total"] for cloud in description["clouds"]] == [3000, 3000]
    (first, second), _ = unpacked(description, data)
    assert np.abs(second - first).max() * description["step"] < 0.1


def test_many_points_are_thinned_evenly_and_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "MOST_POINTS", 1000)
    x, y = np.meshgrid(np.arange(100.0), np.arange(100.0))
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(10_000)])
    description, data = scene.pack({"a": grid}, {})
    assert description["clouds"][0] == {"name": "a", "n": 1000, "total": 10_000, "paired": True}
    (first,), _ = unpacked(description, data)
    counts = np.histogram2d(*(first[:, :2] * description["step"]).T, bins=5)[0]
    assert counts.min() >= 30  # 40 in each of 25 squares; a square boundary shares at most a row of cells with its neighbour
    assert counts.max() <= 50


def test_clouds_of_other_rows_stand_beside_the_first(clouds: tuple[np.ndarray, np.ndarray]) -> None:
    before, after = clouds
    description, data = scene.pack({"a": before, "b": after[:2000]}, {"error": np.arange(2000.0)})
    assert [cloud["paired"] for cloud in description["clouds"]] == [True, False]
    assert description["colours"][0]["clouds"] == [1]
    steps, _ = unpacked(description, data)
    assert [len(cloud) for cloud in steps] == [3000, 2000]
    with pytest.raises(UsageError, match="17 rows fit no cloud"):
        scene.pack({"a": before}, {"error": np.arange(17.0)})


def test_clouds_of_as_many_rows_need_not_be_the_same_points(clouds: tuple[np.ndarray, np.ndarray]) -> None:
    before, after = clouds
    description, data = scene.pack({"a": before, "b": after[::-1]}, {"x": before[:, 0]}, same_points=False)
    assert [cloud["paired"] for cloud in description["clouds"]] == [True, False]
    assert description["colours"][0]["clouds"] == [0]
    (first, second), colours = unpacked(description, data)
    rows_of(after, second, description)
    rows = rows_of(before, first, description)
    assert np.corrcoef(colours["x"], before[rows, 0])[0, 1] > 0.99


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("points", [np.empty((0, 3)), np.zeros((1, 3)), np.full((5, 3), np.nan)], ids=["empty", "one", "nowhere"])
def test_degenerate_clouds_make_a_page(tmp_path: Path, points: np.ndarray) -> None:
    page = written(tmp_path / "r.html", before=points, after=points)
    assert not page.open


def test_displacement_is_known_only_where_both_ends_are() -> None:
    before = np.array([[0.0, 0, 0], [1, 1, 1], [np.inf, 0, 0]])
    after = np.array([[3.0, 4, 0], [np.nan, 1, 1], [np.inf, 0, 0]])
    moved = displacement(before, after, "m")
    assert moved is not None
    np.testing.assert_array_equal(moved.values, [5, np.nan, np.nan])
    assert moved.label == "Displacement (m)"
    assert displacement(before, after[:2]) is None


def test_a_page_names_its_scan_and_shows_only_settings_that_were_made(tmp_path: Path) -> None:
    path = tmp_path / "r.html"
    files = [{"input": "folder/a.las", "output": "-", "status": "done", "figures": {"move_median": 0.1}}]
    report.write_report(path, {"command": "denoise", "settings": {"iters": 3, "radius": None}, "figures": {}, "files": files})
    page = path.read_text()
    assert "pcdenoise denoise: a.las" in page
    assert "Passes" in page
    assert "Radius" not in page
    report.write_report(path, {"command": "denoise", "figures": {}, "files": files * 2})
    assert "Move, median" in path.read_text()
    assert "Output" not in path.read_text()
