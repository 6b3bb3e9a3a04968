"""Points in space to pixels: camera, z-buffer of small spheres. Not here: light (shading.py), titles and panels (pictures.py)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Points
from pcdenoise.evaluation.raster import Canvas, shrink
from pcdenoise.evaluation.shading import shade

Array = NDArray[np.float32]
Rows = NDArray[np.int64]

_BACKDROP = np.array([[0.992, 0.992, 0.992], [0.915, 0.922, 0.935]], dtype=np.float32)  # top, bottom
_LARGEST_RADIUS = 40
_EMPTY = np.iinfo(np.int64).max


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from.

    target       (3,) world point in the middle of the frame.
    axes         (3, 3) rows: right, up and towards the viewer, orthonormal.
    half_height  world units from the middle of the frame to its upper edge, at the target.
    distance     world units from the viewer to the target.
    """

    target: NDArray[np.float64]
    axes: NDArray[np.float64]
    half_height: float
    distance: float

    def zoomed(self, factor: float, target: NDArray[np.float64]) -> Camera:
        """The same viewer with a lens `factor` times longer, turned to another point."""
        return replace(self, target=target, half_height=self.half_height / factor)

    def project(self, points: Points, size: tuple[int, int]) -> tuple[Array, Array, Array]:
        """Pixel positions (N, 2), depths (N,) in world units (larger is farther) and pixels per world unit (N,)."""
        local = ((points - self.target) @ self.axes.T).astype(np.float32)
        width, height = size
        away = np.maximum(self.distance - local[:, 2], np.float32(0.05 * self.distance))
        scale = np.float32(height / 2 / self.half_height * self.distance) / away
        pixels = local[:, :2] * scale[:, None] * np.array([1, -1], np.float32) + np.array([width / 2, height / 2], np.float32)
        return pixels, -local[:, 2], scale


@dataclass(frozen=True)
class Drawing:
    """What `draw` made: the canvas, (H, W, 3), and the row of the point seen in each of its pixels, (H, W), -1 where none is."""

    canvas: Canvas
    owner: Rows


def draw(
    points: Points,
    colour: Array,
    radius: Array,
    camera: Camera,
    size: tuple[int, int],
    *,
    oversampling: int = 2,
    light: float = 1.0,
) -> Drawing:
    """Finite points (N, 3) as lit spheres of (N,) world `radius` and (N, 3) sRGB `colour`; size is (width, height) in pixels.

    `oversampling` is how many times finer than the result it is drawn; `light` is the strength of the shading, see shading.shade.
    """
    width, height = size[0] * oversampling, size[1] * oversampling
    backdrop = _BACKDROP[0] + np.linspace(0, 1, height, dtype=np.float32)[:, None, None] * (_BACKDROP[1] - _BACKDROP[0])
    canvas = np.broadcast_to(backdrop, (height, width, 3)).copy()
    pixels, depth, scale = camera.project(points, (width, height))
    reach = np.clip(radius * scale, 0.7, _LARGEST_RADIUS)
    inside = (np.abs(pixels - (width / 2, height / 2)) < np.array([width / 2, height / 2]) + reach[:, None]).all(axis=1)
    rows = np.flatnonzero(inside & (depth > -0.9 * camera.distance))
    if not len(rows):
        return Drawing(shrink(canvas, oversampling), np.full(size[::-1], -1))
    pixels, reach = pixels[rows], reach[rows]
    left, top = np.maximum(np.floor((pixels - reach[:, None]).min(axis=0)), 0).astype(int)
    right, bottom = np.minimum(np.ceil((pixels + reach[:, None]).max(axis=0)) + 1, (width, height)).astype(int)
    pixels -= np.array([left, top], dtype=np.float32)
    zoom = height / 2 / camera.half_height
    seen, surface = _splat(pixels, depth[rows] * zoom, reach, (right - left, bottom - top))
    v, u = np.nonzero(seen >= 0)
    front = seen[v, u]
    tilt = np.stack([u + 0.5 - pixels[front, 0], pixels[front, 1] - v - 0.5], axis=1) / np.maximum(reach[front], 1)[:, None]
    tilt /= np.maximum(np.linalg.norm(tilt, axis=1, keepdims=True), 1)
    tilt *= 0.45 * np.clip((reach[front] - 1) / 3, 0, 1)[:, None]
    lit = shade(surface, tilt.astype(np.float32), colour[rows[front]], float(np.median(reach)), height // 40, light)
    canvas[top + v, left + u] = lit
    owner = np.full((height, width), -1)
    owner[top + v, left + u] = rows[front]
    return Drawing(shrink(canvas, oversampling), owner[::oversampling, ::oversampling])


def _splat(pixels: Array, depth: Array, radius: Array, size: tuple[int, int]) -> tuple[Rows, Array]:
    """Which sphere is nearest in every pixel, (H, W), -1 for none, and how far, (H, W), infinite for none; all in pixels.

    One pass per pixel offset, over the spheres large enough to reach it; depth and row share one integer: one minimum carries
    both.
    """
    width, height = size
    order = np.argsort(-radius)
    pixels, depth, radius = pixels[order], depth[order], radius[order]
    margin = 2 * int(radius[0]) + 2  # of pixels around the picture, so that no sphere and no window reaches beyond
    stride = width + 2 * margin
    home = (np.floor(pixels[:, 1]).astype(np.int64) + margin) * stride + np.floor(pixels[:, 0]).astype(np.int64) + margin
    bulge = 0.7 * radius
    nearest = float((depth - bulge).min())
    step = (2**31 - 2) / max(float(depth.max()) - nearest, 1e-12)
    best = np.full((height + 2 * margin, stride), _EMPTY)
    flat = best.reshape(-1)
    rows = np.arange(len(order))
    reach = int(radius[0])
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            offset = float(np.hypot(dx, dy))
            n = int(np.searchsorted(-radius, -offset, side="right")) if offset else len(order)
            if n:
                front = depth[:n] - bulge[:n] * np.sqrt(np.maximum(1 - (offset / np.maximum(radius[:n], 1)) ** 2, 0))
                np.minimum.at(flat, home[:n] + (dy * stride + dx), ((front - nearest) * step).astype(np.int64) << 32 | rows[:n])
    gap = int(np.ceil(0.75 * np.median(radius)))
    if gap <= 6:  # small dots are to look like a surface: close pinholes through which its far side shows
        closed = -_window_minimum(-_window_minimum(best, gap), gap)
        best = np.where(best - closed > int(3 * gap * step) << 32, closed, best)
    best = best[margin:-margin, margin:-margin]
    covered = best != _EMPTY
    owner = np.where(covered, order[np.where(covered, best & 0xFFFFFFFF, 0)], -1)
    return owner, np.where(covered, (best >> 32) / step + nearest, np.inf).astype(np.float32)


def _window_minimum(values: Rows, radius: int) -> Rows:
    """Least value in the square window around every pixel, (H, W), of a picture that may wrap round at its edges."""
    for axis in (0, 1):
        reach = 0
        while reach < radius:
            step = min(reach + 1, radius - reach)
            values = np.minimum(np.roll(values, step, axis), np.roll(values, -step, axis))
            reach += step
    return values


def local_spacing(points: Points) -> Array:
    """Distance between neighbours around each of N finite points, (N,) world units, good enough to size a dot.

    The side of the smallest octree cell with 24 points over the root of their number; the median of three shifted octrees,
    since a surface may cut a cell only in a corner.
    """
    if not len(points):
        return np.empty(0, dtype=np.float32)
    shifts = (0.0, 0.083, 0.251) if len(points) < 300_000 else (0.083,)
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()), float(np.abs(high).max()) * 1e-9, 1e-12) * 1.34
    return np.median([_octree_spacing((points - low) / side + shift, side) for shift in shifts], axis=0).astype(np.float32)


def _octree_spacing(unit: Points, side: float, n_levels: int = 16, crowd: int = 24) -> Array:
    """`local_spacing` by one octree, whose cells are runs of the sorted Morton codes of points in the unit cube."""
    cells = (unit * 2**n_levels).astype(np.uint64)
    for bits, mask in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        cells = (cells | (cells << np.uint64(bits))) & np.uint64(mask)
    code = cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2))
    order = np.argsort(code)
    code = code[order]
    spacing = np.full(len(unit), side / np.sqrt(len(unit)), dtype=np.float32)
    for level in range(1, n_levels):
        cell = code >> np.uint64(3 * (n_levels - level))
        starts = np.flatnonzero(np.r_[True, cell[1:] != cell[:-1]])
        counts = np.diff(np.r_[starts, len(unit)])
        if counts.max() < crowd:
            break
        per_cell = np.where(counts >= crowd, side / 2**level / np.sqrt(counts), np.inf)
        spacing = np.minimum(spacing, np.repeat(per_cell, counts)).astype(np.float32)
    unsorted = np.empty_like(spacing)
    unsorted[order] = spacing
    return unsorted
