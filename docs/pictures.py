"""The README's picture: `python docs/pictures.py` writes docs/images/before_after.png anew.

It is what `pcdenoise denoise examples/ground.laz -o clean.laz --picture before_after.png` draws, 1280 pixels wide and in
256 colours, so that the page loads fast. Not here: the drawing itself (pcdenoise.evaluation).
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import pcdenoise
from pcdenoise.commands.cleaning import picture_notes
from pcdenoise.commands.survey import unit_of
from pcdenoise.evaluation.pictures import before_after

ROOT = Path(__file__).resolve().parent.parent
WIDTH, N_COLOURS, N_ROUNDS = 1280, 256, 6


def palette_of(colours: NDArray[np.float64], counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    """(256, 3) colours for (M, 3) colours that occur so often: boxes halved at their median, then a few rounds of k-means."""
    boxes = [np.arange(len(colours))]
    while len(boxes) < N_COLOURS:
        widths = [np.ptp(colours[box], axis=0).max() * np.sqrt(counts[box].sum()) if len(box) > 1 else 0 for box in boxes]
        box = boxes.pop(int(np.argmax(widths)))
        box = box[np.argsort(colours[box, np.ptp(colours[box], axis=0).argmax()], kind="stable")]
        total = np.cumsum(counts[box])
        half = int(np.clip(np.searchsorted(total, total[-1] / 2), 1, len(box) - 1))
        boxes += [box[:half], box[half:]]
    palette = np.stack([np.average(colours[box], axis=0, weights=counts[box]) for box in boxes])
    for _ in range(N_ROUNDS):
        owner = cKDTree(palette).query(colours)[1]
        total = np.maximum(np.bincount(owner, counts, N_COLOURS), 1)
        sums = [np.bincount(owner, counts * colours[:, channel], N_COLOURS) for channel in range(3)]
        palette = np.stack(sums, axis=1) / total[:, None]
    return np.round(palette).astype(np.uint8)


def indexed_png(image: NDArray[np.uint8]) -> bytes:
    """An (H, W, 3) image as a PNG file (ISO/IEC 15948) of 256 colours."""
    height, width, _ = image.shape
    colours, inverse, counts = np.unique(image.reshape(-1, 3), axis=0, return_inverse=True, return_counts=True)
    palette = palette_of(colours.astype(np.float64), counts)
    rows = np.zeros((height, 1 + width), dtype=np.uint8)
    rows[:, 1:] = cKDTree(palette).query(colours)[1].astype(np.uint8)[inverse].reshape(height, width)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = [(b"IHDR", header), (b"PLTE", palette.tobytes()), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


if __name__ == "__main__":
    scan = pcdenoise.read(ROOT / "examples" / "ground.laz")
    result = pcdenoise.denoise(scan)
    unit = unit_of(scan)
    image = before_after(scan.points, result.points, notes=picture_notes(result, unit), unit=unit, width=WIDTH)
    (ROOT / "docs" / "images" / "before_after.png").write_bytes(indexed_png(image))
