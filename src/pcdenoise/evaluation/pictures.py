"""Pictures of clouds for people: one, before and after, iterations. Not here: points to pixels (splats.py), charts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Points
from pcdenoise.errors import UsageError
from pcdenoise.evaluation import charts, raster
from pcdenoise.evaluation.colours import CLAY, Colour, Scalar, displacement, srgb
from pcdenoise.evaluation.framing import camera_for
from pcdenoise.evaluation.output import write_whole
from pcdenoise.evaluation.raster import FAINT_INK, INK, Canvas, Image
from pcdenoise.evaluation.shading import box_mean
from pcdenoise.evaluation.splats import Camera, Drawing, draw, local_spacing

Array = NDArray[np.float32]

BEFORE_INK, AFTER_INK = (0.86, 0.45, 0.27), (0.09, 0.30, 0.47)
_DOT = 1.15  # radius of a dot over the distance between neighbours: closes the surface
_STRETCHES, _FILLED = (1, 2, 5, 10, 20), 0.6  # how much larger heights of a section may be, and how much of it they may fill

View: TypeAlias = Camera | tuple[float, float] | None
"""A camera, (azimuth, elevation) in degrees, or None for a good one."""


def write_png(path: str | PathLike[str], image: Image, *, overwrite: bool = True) -> None:
    """Write an (H, W, 3) uint8 image. Raises ScanError if the file cannot be written."""
    write_whole(path, raster.png_bytes(image), overwrite=overwrite)


def render(points: Points, *, colour: Colour = None, view: View = None, size: tuple[int, int] = (960, 720)) -> Image:
    """A cloud of (N, 3) points as a lit picture of size (width, height): (height, width, 3) uint8.

    Rows that are not finite are left out. `view` is a Camera, (azimuth, elevation) in degrees, or None for a good one; numbers as
    colour bring their scale along. Raises UsageError if there is not one colour per point.
    """
    cloud = _Cloud.of(points, colour)
    canvas = cloud.draw(_camera(view, cloud.points, size), size).canvas
    if cloud.scalar is not None:
        _colour_bar(canvas, cloud.scalar, 24, size[1] - 30, min(260, size[0] - 48))
    return raster.to_image(canvas)


def before_after(
    before: Points,
    after: Points,
    *,
    colour: Colour = None,
    view: View = None,
    width: int = 1560,
    titles: tuple[str, str] = ("Before", "After"),
    notes: tuple[str, str] = ("", ""),
    unit: str = "",
) -> Image:
    """Two clouds side by side from one camera, below them the spot where the noise shows best, enlarged, (H, width, 3) uint8.

    If both have the same rows, a third column shows how far each point moved and a section through that spot. `unit` is the
    unit of the coordinates; `notes` stand small under the titles.
    """
    moved = displacement(before, after, unit)
    n_panels = 2 if moved is None else 3
    edge, gap, header, caption = 32, 20, 68, 40
    panel = (width - 2 * edge - (n_panels - 1) * gap) // n_panels
    size, detail_size = (panel, int(panel * (0.75 if moved is None else 0.9))), (panel, int(panel * 0.46))
    clouds = [_Cloud.of(before, colour), _Cloud.of(after, colour)]
    if moved is not None:
        clouds.append(_Cloud.of(after, moved))
    camera = _camera(view, clouds[1].points, size)
    drawings = [cloud.draw(camera, size) for cloud in clouds]
    spot = _telling_spot((clouds[0], drawings[0]), (clouds[1], drawings[1]), camera, detail_size)
    close_ups = [cloud.draw(spot.camera, detail_size).canvas for cloud in clouds[:2]]
    captions = [f"Detail, {panel / spot.window[0]:.1f} times larger"] * 2
    if moved is not None:
        section, stretch = _section(clouds[0].points, clouds[1].points, spot, detail_size, titles, unit)
        close_ups.append(section)
        captions.append("Section through the surface there" + (f", heights {stretch} times larger" if stretch > 1 else ""))
    canvas = raster.blank(width, header + size[1] + caption + detail_size[1] + edge)
    for column, drawing in enumerate(drawings):
        x = edge + column * (panel + gap)
        raster.write(canvas, x, 36, (*titles, "What moved")[column], 15, bold=True)
        raster.write(canvas, x, 58, (*notes, "")[column], 9.5, FAINT_INK)
        left, top = spot.pixel - np.array(spot.window) / 2
        raster.frame(drawing.canvas, left, top, spot.window[0], spot.window[1], INK)
        if (scalar := clouds[column].scalar) is not None:
            _colour_bar(canvas, scalar, x + panel - 230, 46, 230)
        raster.paste(canvas, x, header, drawing.canvas, radius=10)
        y = header + size[1] + caption
        raster.write(canvas, x, y - 14, captions[column], 9.5, FAINT_INK)
        raster.paste(canvas, x, y, close_ups[column], radius=10)
    return raster.to_image(canvas)


def strip(images: Sequence[Image], titles: Sequence[str] = (), notes: Sequence[str] = (), *, columns: int = 4) -> Image:
    """Pictures of one size in rows of at most `columns`, each with a title and a note above it: the iterations of a run."""
    if not images:
        raise UsageError("strip: no images; give at least one")
    edge, gap, header = 28, 16, 52
    height, width = images[0].shape[:2]
    n_columns = min(columns, len(images))
    n_rows = -(-len(images) // n_columns)
    canvas = raster.blank(2 * edge + n_columns * (width + gap) - gap, edge + n_rows * (height + header + gap) - gap // 2)
    for place, image in enumerate(images):
        x, y = edge + place % n_columns * (width + gap), edge // 2 + place // n_columns * (height + header + gap)
        raster.write(canvas, x, y + 20, titles[place] if place < len(titles) else "", 13, bold=True)
        raster.write(canvas, x, y + 40, notes[place] if place < len(notes) else "", 9, FAINT_INK)
        raster.paste(canvas, x, y + header, image.astype(np.float32) / np.float32(255), radius=8)
    return raster.to_image(canvas)


@dataclass(frozen=True)
class _Cloud:
    """Finite points ready to draw: (N, 3) sRGB, (N,) world radius, the scale of their colour if it has one."""

    points: Points
    rgb: Array
    radius: Array
    scalar: Scalar | None
    light: float

    @classmethod
    def of(cls, points: Points, colour: Colour) -> _Cloud:
        finite = np.isfinite(points).all(axis=1)
        kept = points[finite]
        spacing = local_spacing(kept)
        usual = np.median(spacing) if len(spacing) else 1
        radius = _DOT * np.clip(spacing, 0.5 * usual, 2.5 * usual)
        if colour is None:
            return cls(kept, np.broadcast_to(CLAY, kept.shape), radius, None, 1.0)
        given = colour.values if isinstance(colour, Scalar) else np.asarray(colour)
        if len(given) != len(points):
            raise UsageError(f"colour: {len(given)} rows for {len(points)} points; give one per point")
        if given.ndim == 2:
            return cls(kept, srgb(given)[finite], radius, None, 0.55)
        scalar = colour if isinstance(colour, Scalar) else Scalar(given.astype(np.float64))
        return cls(kept, raster.colour_map(scalar.fractions()[finite], scalar.map), radius, scalar, 0.85)

    def draw(self, camera: Camera, size: tuple[int, int]) -> Drawing:
        return draw(self.points, self.rgb, self.radius, camera, size, light=self.light)


@dataclass(frozen=True)
class _Spot:
    """A place worth a closer look: pixel and window (width, height) in the whole picture, its own camera and half width."""

    pixel: NDArray[np.float64]
    window: tuple[float, float]
    camera: Camera
    half_width: float
    spacing: float


def _camera(view: View, points: Points, size: tuple[int, int]) -> Camera:
    return view if isinstance(view, Camera) else camera_for(points, size, view)


def _telling_spot(before: tuple[_Cloud, Drawing], after: tuple[_Cloud, Drawing], camera: Camera, panel: tuple[int, int]) -> _Spot:
    """Where a window of the picture loses most of its scatter, shows some shape and lies within a surface, not among leaves.

    Scatter is how far the points seen lie before or behind the mean depth around them, in spacings.
    """
    cloud, drawing = after
    size = drawing.canvas.shape[1::-1]
    zoom = size[1] / 2 / camera.half_height
    spacing = float(np.median(cloud.radius)) / _DOT if len(cloud.radius) else camera.half_height
    width = float(np.clip(60 * spacing * zoom, size[0] / 8, size[0] / 2.8))
    window = (width, width * panel[1] / panel[0])
    reach = int(window[1] / 2)
    near = max(2, int(1.5 * spacing * zoom))

    def scatter(cloud: _Cloud, drawing: Drawing) -> NDArray[np.float64]:
        seen = drawing.owner >= 0
        depth = np.zeros(seen.shape)
        depth[seen] = (cloud.points[drawing.owner[seen]] - camera.target) @ camera.axes[2] / spacing
        share, around = box_mean(np.stack([seen.astype(np.float64), depth]), near)
        inside = share > 0.999  # the means of an even slope cancel, those of a window cut off by an outline do not
        off = np.where(inside, np.minimum(np.abs(depth - around), 5), 0)
        whole, total = box_mean(np.stack([inside.astype(np.float64), off]), reach)
        mean: NDArray[np.float64] = total / np.maximum(whole, 0.05)
        return mean

    light = drawing.canvas.mean(axis=2, dtype=np.float64)
    shape = box_mean(np.abs(box_mean(light, reach // 4 + 1) - box_mean(light, reach // 2 + 2)), reach)
    owners = np.stack([before[1].owner, drawing.owner])
    covered = box_mean((owners >= 0).astype(np.float64), int(width / 2)).min(axis=0)
    rough, smooth = scatter(*before), scatter(*after)
    score = (rough - smooth) / (smooth + 0.1) * (0.25 + np.minimum(shape / 0.04, 1)) * covered**12
    score[drawing.owner < 0] = -np.inf
    half_x, half_y = int(width / 2) + 2, reach + 2
    score[:half_y], score[-half_y:], score[:, :half_x], score[:, -half_x:] = -np.inf, -np.inf, -np.inf, -np.inf
    y, x = np.unravel_index(int(score.argmax()), score.shape)
    target = cloud.points[drawing.owner[y, x]] if drawing.owner[y, x] >= 0 else camera.target
    close = camera.zoomed(size[1] / window[1], target)
    return _Spot(np.array([x, y]) + 0.5, window, close, width / zoom / 2, spacing)


def _section(
    before: Points, after: Points, spot: _Spot, size: tuple[int, int], titles: tuple[str, str], unit: str
) -> tuple[Canvas, int]:
    """The points of a thin slab across the surface at the spot, seen along the surface: noise is the width of the band.

    Heights are drawn so many times larger, the second value, that the band shows and still fits.
    """
    canvas = raster.blank(*size, (1.0, 1.0, 1.0))
    centre = spot.camera.target
    near = after[((after - centre) ** 2).sum(axis=1) < (0.3 * spot.half_width) ** 2]
    if len(near) < 3:
        return canvas, 1
    right, up, back = spot.camera.axes
    normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
    normal *= np.sign(normal @ back) or 1.0
    sideways = right if abs(right @ normal) < 0.9 else up
    along = sideways - sideways @ normal * normal
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    zoom = size[0] / 2 / spot.half_width
    slabs = []
    for points in (before, after):
        offset = points - centre
        place, height = offset @ along * zoom, offset @ normal * zoom
        slabs.append(
            np.stack([place, height])[
                :, (np.abs(offset @ across) < spot.spacing) & (np.abs(place) < size[0] / 2) & (np.abs(height) < size[1] / 2)
            ]
        )
    middle, room = _relief(slabs[0][1])
    stretch = max((times for times in _STRETCHES if times * room < _FILLED * size[1]), default=1)
    for (place, height), ink in zip(slabs, (BEFORE_INK, AFTER_INK), strict=True):
        pixels = np.stack([place + size[0] / 2, size[1] / 2 - stretch * (height - middle)], axis=1)
        raster.dots(canvas, pixels, 2.6, ink, 0.85)
    for row, (name, ink) in enumerate(zip(titles, (BEFORE_INK, AFTER_INK), strict=True)):
        raster.dots(canvas, [(24, 22 + 20 * row)], 4, ink)
        raster.write(canvas, 36, 26 + 20 * row, name, 9)
    _length_bar(canvas, zoom, unit)
    return canvas, stretch


def _relief(heights: NDArray[np.float64]) -> tuple[float, float]:
    """The middle of heights and the distance between their ends, without the few that lie far off."""
    if not len(heights):
        return 0.0, 0.0
    low, high = np.percentile(heights, [1, 99])
    return float(low + high) / 2, float(high - low)


def _length_bar(canvas: Canvas, zoom: float, unit: str) -> None:
    """A round length of about a fifth of the canvas at its lower left."""
    length = charts.round_step(canvas.shape[1] / 5 / zoom)
    x, y = 20, canvas.shape[0] - 18
    raster.stroke(canvas, [[(x, y), (x + length * zoom, y)]], INK, 2)
    raster.write(canvas, x, y - 9, f"{charts.short(length)} {unit}".strip(), 9)


def _colour_bar(canvas: Canvas, scalar: Scalar, x: int, y: int, width: int) -> None:
    """The colours of a scalar from left to right with the values at both ends and in the middle, and its label above."""
    low, high = scalar.range()
    ramp = raster.colour_map(np.linspace(0, 1, width), scalar.map)
    raster.paste(canvas, x, y - 10, np.repeat(ramp[None], 10, axis=0), radius=5)
    raster.write(canvas, x, y - 20, scalar.label, 9.5, INK)
    for part in (0.0, 0.5, 1.0):
        raster.write(canvas, x + part * width, y + 14, charts.short(low + part * (high - low)), 8.5, FAINT_INK, anchor=part)
