"""Pixels: canvas, lines, words, colour maps and the PNG file. Not here: points in space (splats.py), compositions (pictures.py).

A canvas is an (H, W, 3) float32 array of sRGB values from 0 to 1; an image is its uint8 form.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcdenoise.evaluation.lettering import CAPITAL_HEIGHT, LETTER_GAP, glyph

Canvas = NDArray[np.float32]
Image = NDArray[np.uint8]
Colour = tuple[float, float, float]

INK: Colour = (0.13, 0.15, 0.19)
FAINT_INK: Colour = (0.43, 0.46, 0.51)
RULE: Colour = (0.83, 0.84, 0.86)
PAPER: Colour = (0.985, 0.984, 0.98)

COLOUR_MAPS = {
    # light to dark, lightness falls evenly: 0 looks like bare clay, large is unmistakable
    "heat": "efe9df f8dcae fbbf7d f89a5c ee7150 d94a55 b52f66 862170 561a6b 2c1351",
    "viridis": "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725",
    # dark blue, pale middle, dark red: for values with a sign
    "balance": "1b3a6b 2f62a3 5f91c4 a3c3de e9ecec f2c9b0 e0926f c2554a 8c1f36",
}


def colour_map(values: ArrayLike, name: str = "heat") -> NDArray[np.float32]:
    """Values from 0 to 1 (clipped; NaN becomes grey) as (..., 3) sRGB. Maps: 'heat', 'viridis', 'balance'."""
    table = np.array([[int(word[i : i + 2], 16) / 255 for i in (0, 2, 4)] for word in COLOUR_MAPS[name].split()])
    position = np.asarray(values, dtype=np.float64)
    stops = np.linspace(0, 1, len(table))
    colours = np.stack([np.interp(position, stops, table[:, channel]) for channel in range(3)], axis=-1)
    colours[np.isnan(position)] = 0.72
    return colours.astype(np.float32)


def blank(width: int, height: int, colour: Colour = PAPER) -> Canvas:
    """An even canvas."""
    return np.full((height, width, 3), colour, dtype=np.float32)


def blend(canvas: Canvas, x: int, y: int, coverage: NDArray[np.float32], colour: ArrayLike) -> None:
    """Lay a colour, (3,) or (h, w, 3), over the canvas at pixel (x, y) as far as (h, w) `coverage` says; the rest is cut off."""
    top, left = max(0, -y), max(0, -x)
    bottom, right = max(top, canvas.shape[0] - y), max(left, canvas.shape[1] - x)
    paint = np.broadcast_to(np.asarray(colour, dtype=np.float32), (*coverage.shape, 3))[top:bottom, left:right]
    coverage = coverage[top:bottom, left:right, None]
    region = canvas[y + top : y + top + len(paint), x + left : x + left + paint.shape[1]]
    region += coverage * (paint - region)


def paste(canvas: Canvas, x: int, y: int, picture: Canvas, radius: float = 0) -> None:
    """Put a picture on the canvas with its upper left corner at pixel (x, y), its corners rounded."""
    height, width = picture.shape[:2]
    blend(canvas, x, y, _rounded(np.arange(width) + 0.5, np.arange(height) + 0.5, width, height, radius), picture)


def fill(
    canvas: Canvas, x: float, y: float, width: float, height: float, colour: Colour, radius: float = 0, opacity: float = 1
) -> None:
    """A rectangle with rounded corners."""
    left, top = int(np.floor(x)), int(np.floor(y))
    columns, rows = np.arange(left, int(np.ceil(x + width))) + 0.5, np.arange(top, int(np.ceil(y + height))) + 0.5
    blend(canvas, left, top, opacity * _rounded(columns - x, rows - y, width, height, radius), colour)


def frame(canvas: Canvas, x: float, y: float, width: float, height: float, colour: Colour, thickness: float = 1.5) -> None:
    """The outline of a rectangle."""
    stroke(canvas, polyline([(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)]), colour, thickness)


def _rounded(x: NDArray[Any], y: NDArray[Any], width: float, height: float, radius: float) -> NDArray[np.float32]:
    """Coverage of the pixels at (x, y) by a rounded rectangle from (0, 0): how far they lie within its outline."""
    beyond_x = np.abs(x - width / 2)[None, :] - (width / 2 - radius)
    beyond_y = np.abs(y - height / 2)[:, None] - (height / 2 - radius)
    outside = np.hypot(np.maximum(beyond_x, 0), np.maximum(beyond_y, 0)) + np.minimum(np.maximum(beyond_x, beyond_y), 0)
    return np.clip(0.5 + radius - outside, 0, 1).astype(np.float32)


def dots(canvas: Canvas, centres: ArrayLike, radius: float, colour: Colour, opacity: float = 1.0) -> None:
    """Round dots at (N, 2) pixel positions; where they overlap they do not add up."""
    centres = np.asarray(centres, dtype=np.float64).reshape(-1, 2)
    coverage = np.zeros(canvas.shape[:2], dtype=np.float32)
    home = np.floor(centres).astype(np.int64)
    reach = int(np.ceil(radius)) + 1
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            x, y = home[:, 0] + dx, home[:, 1] + dy
            inside = (x >= 0) & (y >= 0) & (x < canvas.shape[1]) & (y < canvas.shape[0])
            distance = np.hypot(x + 0.5 - centres[:, 0], y + 0.5 - centres[:, 1])
            np.maximum.at(coverage, (y[inside], x[inside]), np.clip(0.5 + radius - distance, 0, 1)[inside].astype(np.float32))
    blend(canvas, 0, 0, opacity * coverage, colour)


def stroke(canvas: Canvas, segments: ArrayLike, colour: Colour, thickness: float = 1.5) -> None:
    """Round-capped line segments (S, 2, 2) of pixel coordinates, drawn as one shape so that joints do not darken."""
    lines = np.asarray(segments, dtype=np.float64).reshape(-1, 2, 2)
    if not len(lines):
        return
    corner = np.floor(lines.min(axis=(0, 1)) - thickness).astype(int)
    width, height = np.ceil(lines.max(axis=(0, 1)) + thickness).astype(int) - corner
    distance = np.full((height, width), np.inf)
    for start, end in lines - corner:
        reach = thickness / 2 + 1
        x0, y0 = np.maximum(np.floor(np.minimum(start, end) - reach), 0).astype(int)
        x1, y1 = np.ceil(np.maximum(start, end) + reach).astype(int)
        window = distance[y0:y1, x0:x1]
        x, y = np.arange(x0, x0 + window.shape[1]) + 0.5, np.arange(y0, y0 + window.shape[0])[:, None] + 0.5
        along = end - start
        t = np.clip(((x - start[0]) * along[0] + (y - start[1]) * along[1]) / max(along @ along, 1e-12), 0, 1)
        np.minimum(window, np.hypot(x - start[0] - t * along[0], y - start[1] - t * along[1]), out=window)
    blend(canvas, int(corner[0]), int(corner[1]), np.clip(0.5 + thickness / 2 - distance, 0, 1).astype(np.float32), colour)


def polyline(points: ArrayLike) -> NDArray[np.float64]:
    """The (N - 1, 2, 2) segments through (N, 2) points."""
    chain = np.asarray(points, dtype=np.float64)
    return np.stack([chain[:-1], chain[1:]], axis=1)


def text_width(words: str, size: float) -> float:
    """Width in pixels of `words` set with capitals `size` pixels tall."""
    return (sum(glyph(letter)[1] + LETTER_GAP for letter in words) - LETTER_GAP) * size / CAPITAL_HEIGHT if words else 0.0


def write(
    canvas: Canvas,
    x: float,
    y: float,
    words: str,
    size: float = 11,
    colour: Colour = INK,
    *,
    anchor: float = 0,
    bold: bool = False,
) -> None:
    """Set `words` on the baseline y with capitals `size` pixels tall; anchor 0 starts at x, 0.5 centres on it, 1 ends there."""
    unit = size / CAPITAL_HEIGHT
    pen = x - anchor * text_width(words, size)
    for letter in words:
        segments, width = glyph(letter)
        stroke(canvas, segments * (unit, -unit) + (pen, y), colour, unit * (1.25 if bold else 0.9))
        pen += (width + LETTER_GAP) * unit


def shrink(canvas: Canvas, factor: int) -> Canvas:
    """The mean of every factor x factor block: the antialiasing of a canvas drawn too large."""
    height, width = canvas.shape[0] // factor, canvas.shape[1] // factor
    blocks = canvas[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    shrunk: Canvas = blocks.mean(axis=(1, 3), dtype=np.float32)
    return shrunk


def to_image(canvas: Canvas) -> Image:
    """The canvas as (H, W, 3) uint8."""
    return (np.clip(canvas, 0, 1) * 255 + 0.5).astype(np.uint8)


def png_bytes(image: Image) -> bytes:
    """An (H, W, 3) uint8 image as a PNG file (ISO/IEC 15948), each row stored as its difference to the row above."""
    height, width, _ = image.shape
    rows = np.full((height, 1 + width * 3), 2, dtype=np.uint8)
    pixels = image.reshape(height, -1)
    rows[0, 1:] = pixels[0]
    rows[1:, 1:] = pixels[1:] - pixels[:-1]

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
