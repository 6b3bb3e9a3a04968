"""Pictures show what is there: geometry lands where it should, noise and its removal are visible, awkward clouds do no harm."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from pcdenoise.errors import ScanError, UsageError
from pcdenoise.evaluation import charts, pictures, raster
from pcdenoise.evaluation.colours import Scalar, srgb
from pcdenoise.evaluation.framing import camera_for
from pcdenoise.evaluation.lettering import _STROKES, glyph
from pcdenoise.evaluation.splats import Camera, draw, local_spacing

SIZE = (160, 120)


def sphere(rng: np.random.Generator, n: int, noise: float = 0.0) -> np.ndarray:
    points = rng.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * (1 + noise * rng.normal(size=(n, 1)))


def front(half_height: float = 1.5, distance: float = 1e6) -> Camera:
    """Looking along -y from far away: x to the right, z up, one world unit is 40 pixels of 120 high."""
    return Camera(np.zeros(3), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), half_height, distance)


def backdrop(image: np.ndarray) -> np.ndarray:
    """(H, W) which pixels look like the empty picture of the same size."""
    empty = pictures.render(np.empty((0, 3)), size=(image.shape[1], image.shape[0]))
    return (np.abs(image.astype(int) - empty) <= 1).all(axis=2)


def decoded(png: bytes) -> np.ndarray:
    """The pixels of a PNG file by a decoder of its own, for 8-bit RGB with filters 0 and 2."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, chunks = 8, {}
    while at < len(png):
        (length,) = struct.unpack(">I", png[at : at + 4])
        kind, data = png[at + 4 : at + 8], png[at + 8 : at + 8 + length]
        assert struct.unpack(">I", png[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + data)
        chunks[kind] = data
        at += 12 + length
    width, height, depth, colour, *rest = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert (depth, colour, rest) == (8, 2, [0, 0, 0])
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), dtype=np.uint8).reshape(height, 1 + 3 * width)
    above, image = np.zeros(3 * width, dtype=np.uint8), []
    for row in rows:
        assert row[0] in (0, 2)
        above = row[1:] + above if row[0] == 2 else row[1:]
        image.append(above)
    return np.stack(image).reshape(height, width, 3)


def test_a_png_holds_exactly_the_pixels_given(rng: np.random.Generator, tmp_path: Path) -> None:
    image = rng.integers(0, 256, size=(17, 23, 3), dtype=np.uint8)
    pictures.write_png(tmp_path / "picture.png", image)
    np.testing.assert_array_equal(decoded((tmp_path / "picture.png").read_bytes()), image)


def test_a_png_is_not_overwritten_unasked_and_leaves_no_part_behind(tmp_path: Path) -> None:
    target = tmp_path / "picture.png"
    target.write_bytes(b"mine")
    with pytest.raises(ScanError, match="exists already"):
        pictures.write_png(target, np.zeros((2, 2, 3), dtype=np.uint8), overwrite=False)
    with pytest.raises(ScanError, match="cannot be written"):
        pictures.write_png(tmp_path / "no such folder" / "picture.png", np.zeros((2, 2, 3), dtype=np.uint8))
    assert target.read_bytes() == b"mine"
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]


def test_a_sphere_covers_the_disc_it_projects_to(rng: np.random.Generator) -> None:
    image = pictures.render(sphere(rng, 20_000), view=front(), size=SIZE)
    covered = ~backdrop(image)
    # radius 40 pixels; dots of 20 000 points on 4 pi stand out by a spacing of sqrt(4 pi / 20 000) = 0.025 = 1 pixel
    assert covered.sum() == pytest.approx(np.pi * 41**2, rel=0.05)
    rows, columns = np.nonzero(covered)
    assert (rows.mean(), columns.mean()) == pytest.approx((59.5, 79.5), abs=0.5)
    assert np.hypot(rows - 59.5, columns - 79.5).max() < 40 + 2.5


def test_what_is_nearer_hides_what_is_farther(rng: np.random.Generator) -> None:
    plate = np.column_stack([rng.uniform(-1, 1, 4000), np.zeros(4000), rng.uniform(-1, 1, 4000)])
    both = np.concatenate([plate - [0, 0.5, 0], plate + [0, 0.5, 0]])  # the viewer is at -y
    red_and_blue = np.repeat(np.array([[255, 0, 0], [0, 0, 255]], dtype=np.uint8), 4000, axis=0)
    middle = pictures.render(both, colour=red_and_blue, view=front(), size=SIZE)[30:90, 50:110].astype(int)
    assert (middle[..., 0] > middle[..., 2]).mean() > 0.98  # pinholes: exp(-pi 1.15²) of a random covering, 1.5 %


def test_light_falls_from_above(rng: np.random.Generator) -> None:
    image = pictures.render(sphere(rng, 20_000), view=front(), size=SIZE).mean(axis=2)
    assert image[30:45, 70:90].mean() > 1.3 * image[75:90, 70:90].mean()


def roughness(image: np.ndarray) -> float:
    """Mean absolute difference of neighbouring pixels over the middle of the picture."""
    light = image[40:80, 60:100].mean(axis=2)
    return float(np.abs(np.diff(light, axis=1)).mean())


def test_noise_is_seen_at_a_glance(rng: np.random.Generator) -> None:
    place = np.arange(8000) + 0.5  # evenly spaced along the golden spiral
    z, turn = 1 - place / 4000, np.pi * (1 + np.sqrt(5)) * place
    clean = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    noisy = clean * (1 + 0.03 * rng.normal(size=(8000, 1)))
    rough, smooth = (roughness(pictures.render(points, view=front(), size=SIZE)) for points in (noisy, clean))
    assert rough > 2 * smooth


def test_world_coordinates_lose_nothing_in_a_picture(rng: np.random.Generator) -> None:
    points = sphere(rng, 3000, noise=0.02)
    far_away = points + [515_396.0, 4_918_348.0, 2324.0]  # a double there has steps of 1e-9, a float of 0.5
    np.testing.assert_allclose(pictures.render(far_away, size=SIZE).astype(int), pictures.render(points, size=SIZE), atol=40)
    assert np.mean(pictures.render(far_away, size=SIZE) != pictures.render(points, size=SIZE)) < 0.02


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.zeros((1, 3)),
        np.zeros((50, 3)),
        np.full((4, 3), np.nan),
        np.array([[0, 0, 0], [1, 1, 1], [np.nan, 0, 0], [np.inf, 0, 0]]),
        np.column_stack([np.linspace(0, 1, 100), np.zeros(100), np.zeros(100)]),
        np.column_stack([np.linspace(0, 1, 100), np.zeros(100), np.zeros(100)]) + 1e7,
    ],
    ids=["empty", "one point", "one place", "no number", "some numbers", "a line", "a line far away"],
)
@pytest.mark.filterwarnings("error")
def test_degenerate_clouds_give_a_picture(points: np.ndarray) -> None:
    assert pictures.render(points, size=SIZE).shape == (120, 160, 3)
    assert pictures.render(points, colour=np.arange(len(points)), size=SIZE).shape == (120, 160, 3)
    image = pictures.before_after(points, points, width=400)
    assert image.dtype == np.uint8
    assert image.shape[1] == 400


def test_one_far_outlier_does_not_shrink_the_picture(rng: np.random.Generator) -> None:
    points = sphere(rng, 5000)
    with_outlier = np.concatenate([points, [[500.0, 500.0, 500.0]]])
    areas = [(~backdrop(pictures.render(cloud, view=(0, 10), size=SIZE))).sum() for cloud in (points, with_outlier)]
    assert areas[1] == pytest.approx(areas[0], rel=0.05)


def test_the_frame_holds_nearly_all_points(rng: np.random.Generator) -> None:
    points = sphere(rng, 5000) * [3, 1, 0.5]
    for size in ((160, 120), (120, 160)):
        pixels, _, _ = camera_for(points, size).project(points, size)
        inside = ((pixels >= 0) & (pixels < size)).all(axis=1)
        assert inside.mean() > 0.998  # framed by the 0.1 and 99.9 percentiles with a margin
        assert np.ptp(pixels, axis=0).max() > 0.6 * max(size)


def test_cameras_are_rigid_and_flat_land_is_seen_from_above(rng: np.random.Generator) -> None:
    land = np.column_stack([rng.uniform(0, 100, 5000), rng.uniform(0, 60, 5000), rng.normal(0, 0.5, 5000)])
    camera = camera_for(land, SIZE)
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.axes) == pytest.approx(1)
    assert np.degrees(np.arcsin(camera.axes[2, 2])) > 30


def test_a_depth_camera_is_followed(rng: np.random.Generator) -> None:
    wall = np.column_stack([rng.uniform(-1, 1, 4000), rng.uniform(-1, 1, 4000), rng.normal(3, 0.1, 4000)])  # z forward, y down
    camera = camera_for(wall, SIZE)
    assert camera.axes[2, 2] < -0.9  # towards the viewer is towards the sensor
    assert camera.axes[1, 1] < -0.9


def test_spacing_is_that_of_a_grid() -> None:
    x, y = np.meshgrid(np.arange(100) * 0.1, np.arange(100) * 0.1)
    spacing = local_spacing(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    # a cell of L spacings holds up to (L + 1)² points, at least 24: 0.1 L / (L + 1) or more; cut by a border, a third of them
    assert np.median(spacing) == pytest.approx(0.1, rel=0.15)
    assert spacing.min() > 0.079
    assert spacing.max() < 0.2


def test_row_order_does_not_show(rng: np.random.Generator) -> None:
    points = sphere(rng, 2000, noise=0.01)
    colour = np.full((2000, 3), 0.5, dtype=np.float32)
    radius = np.full(2000, 0.03, dtype=np.float32)
    shuffled = points[rng.permutation(2000)]
    one, other = (draw(cloud, colour, radius, front(), SIZE).canvas for cloud in (points, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_the_detail_is_taken_where_points_moved(rng: np.random.Generator) -> None:
    plate = np.column_stack([rng.uniform(-1, 1, 30_000), np.zeros(30_000), rng.uniform(-1, 1, 30_000)])
    before = plate.copy()
    rough = plate[:, 0] > 0.2
    before[rough, 1] += rng.normal(0, 0.03, rough.sum())
    clouds = [pictures._Cloud.of(points, None) for points in (before, plate)]
    drawings = [cloud.draw(front(), SIZE) for cloud in clouds]
    spot = pictures._telling_spot(*zip(clouds, drawings, strict=True), front(), (160, 74))
    assert spot.camera.target[0] > 0.2


def test_the_detail_is_not_taken_among_leaves_that_stay_as_they_were(rng: np.random.Generator) -> None:
    """A bush in front of one half of a plate: it is rougher than any noise, but only the other half becomes smoother."""
    plate = np.column_stack([rng.uniform(-1, 1, 30_000), np.zeros(30_000), rng.uniform(-1, 1, 30_000)])
    bush = np.column_stack([rng.uniform(-1, -0.2, 8000), rng.uniform(-0.4, 0, 8000), rng.uniform(-1, 1, 8000)])
    noise = np.zeros((38_000, 3))
    noise[:30_000, 1] = rng.normal(0, 0.01, 30_000)
    noise[30_000:] = rng.normal(0, 0.002, (8000, 3))
    after = np.concatenate([plate, bush])
    clouds = [pictures._Cloud.of(points, None) for points in (after + noise, after)]
    spot = pictures._telling_spot(*[(cloud, cloud.draw(front(), SIZE)) for cloud in clouds], front(), (160, 74))
    assert spot.camera.target[0] > -0.2


def test_a_flat_section_is_stretched_and_a_steep_one_is_not(rng: np.random.Generator) -> None:
    flat = np.column_stack([rng.uniform(-1, 1, 20_000), np.zeros(20_000), rng.uniform(-1, 1, 20_000)])
    spot = pictures._Spot(np.array([80.0, 60.0]), (160.0, 74.0), front(), 0.5, 0.01)
    stretches = []
    for height in (0.002, 0.15):
        curved = flat + np.sin(6 * flat[:, :1]) * [0, height, 0]
        stretches.append(pictures._section(curved, curved, spot, (160, 74), ("a", "b"), "")[1])
    assert stretches[0] > 5
    assert stretches[1] == 1


def test_before_after_has_a_third_column_only_for_the_same_rows(rng: np.random.Generator) -> None:
    noisy, clean = sphere(rng, 1500, noise=0.03), sphere(rng, 1500)
    three, two = pictures.before_after(noisy, clean, width=600), pictures.before_after(noisy, clean[:1400], width=600)
    assert three.shape[1] == two.shape[1] == 600
    assert three.shape[0] < two.shape[0]  # narrower panels


def test_a_strip_keeps_every_picture_whole(rng: np.random.Generator) -> None:
    tiles = [np.full((30, 40, 3), 10 * k, dtype=np.uint8) for k in range(5)]
    strip = pictures.strip(tiles, titles=["a", "b"], columns=3)
    for k in range(1, 5):
        assert (strip == 10 * k).all(axis=2).sum() > 0.9 * 30 * 40
    with pytest.raises(UsageError, match="no images"):
        pictures.strip([])


def test_colours_must_have_a_row_per_point(rng: np.random.Generator) -> None:
    with pytest.raises(UsageError, match="5 rows for 10 points"):
        pictures.render(sphere(rng, 10), colour=np.arange(5), size=SIZE)


def test_rgb_is_read_in_every_usual_range() -> None:
    for top, dtype in ((255, np.uint8), (65535, np.uint16), (255, np.uint16), (1, np.float64)):
        assert (srgb(np.full((2, 3), top, dtype)) == 1).all()


def test_colour_maps_run_evenly_from_light_to_dark_and_unknown_is_grey() -> None:
    light = raster.colour_map(np.linspace(0, 1, 50), "heat") @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) < 0).all()
    np.testing.assert_allclose(raster.colour_map([-1.0, 2.0]), raster.colour_map([0.0, 1.0]))
    assert np.ptp(raster.colour_map([np.nan])) == 0


def test_scales_end_at_round_percentiles_and_signed_ones_are_symmetric() -> None:
    values = np.concatenate([np.linspace(0.0, 1.0, 1001), [np.nan, 1e9]])
    assert Scalar(values).range() == pytest.approx((0, 0.98), abs=0.005)
    low, high = Scalar(np.linspace(-1, 3, 100), map="balance").range()
    assert low == -high
    low, high = Scalar(np.full(5, 7.0)).range()
    assert high > low


def test_every_letter_has_strokes_and_words_are_as_wide_as_they_say() -> None:
    assert {chr(code) for code in range(33, 127)} <= set(_STROKES)
    for letter in _STROKES:
        segments, width = glyph(letter)
        assert len(segments)
        assert 0 <= width < 9
    canvas = raster.blank(300, 40)
    raster.write(canvas, 10, 28, "Hag 0.25", 14)
    columns = np.flatnonzero((canvas < 0.9).any(axis=(0, 2)))
    assert columns[0] == pytest.approx(10, abs=2)
    assert columns[-1] == pytest.approx(10 + raster.text_width("Hag 0.25", 14), abs=2)


def test_drawing_beyond_the_canvas_is_cut_off() -> None:
    canvas = raster.blank(20, 10)
    raster.fill(canvas, -50, -50, 200, 200, (0, 0, 0))
    raster.stroke(canvas, [[(-30, 5), (60, 5)]], (1, 1, 1), 4)
    raster.dots(canvas, [(-3, -3), (25, 5)], 2, (1, 0, 0))
    raster.write(canvas, 15, 5, "long words", 9)
    raster.fill(canvas, 100, 100, 5, 5, (1, 1, 1))
    assert canvas.shape == (10, 20, 3)
    assert canvas[0, 0].max() == 0


def test_histogram_bars_add_up_to_the_share_within_the_range(rng: np.random.Generator) -> None:
    values = np.append(rng.exponential(size=4000), [np.nan, np.inf])
    chart = charts.histogram(values, title="t")
    bars = [bar for bar in chart.bars if bar.role == "series0"]
    rules = sorted(line.points[0, 1] for line in chart.lines if line.role == "rule")
    top = max(float(label.words) for label in chart.labels if label.anchor == 1 and label.words.replace(".", "").isdigit())
    percent = sum(bar.height for bar in bars) / (rules[-1] - rules[0]) * top
    assert percent == pytest.approx(99.5, abs=0.1)
    assert any("0.5 % lie beyond" in label.words for label in chart.labels)


def test_a_curve_bridges_gaps_and_falls_on_the_page_where_numbers_fall() -> None:
    chart = charts.curve({"move": [4.0, np.nan, 1.0], "left": [2.0, 2.0, 2.0]}, title="t")
    first, second = (line.points for line in chart.lines if line.role != "rule")
    assert len(first) == 2
    assert first[0, 1] < second[0, 1] < first[1, 1]  # higher values are nearer to the top, where y is smaller
    assert chart.image(1).shape == (chart.height, chart.width, 3)
    assert charts.curve({}, title="t").image(1).shape == (chart.height, chart.width, 3)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0, "0"), (-0.0, "0"), (0.0123456, "0.0123"), (12, "12"), (48_200, "48,200"), (1234.6, "1235"), (-0.5, "\u22120.5"),
        (1.5e-7, "1.5e\u221207"), (1e20, "1e+20"), (float("nan"), "\u2013"), (float("inf"), "\u2013"),
    ],
)  # fmt: skip
def test_numbers_are_set_for_people(value: float, words: str) -> None:
    assert charts.short(value) == words


@pytest.mark.parametrize(("length", "step"), [(1, 1), (0.99, 0.5), (4.9, 2), (5, 5), (37, 20), (0.0021, 0.002)])
def test_steps_of_axes_are_round(length: float, step: float) -> None:
    assert charts.round_step(length) == pytest.approx(step)


def test_real_scans_give_pictures_with_something_on_them(extra_data: Path) -> None:
    laspy = pytest.importorskip("laspy")
    scan = laspy.read(extra_data / "scans" / "ign_test_data_77055_627755_LA93_IGN69.laz")
    image = pictures.render(np.asarray(scan.xyz), size=SIZE)
    assert 0.1 < (~backdrop(image)).mean() < 0.9
