"""Clouds packed for the viewer: thinned, quantised, compressed. Not here: the page (report.py), the drawing (viewer.html).

The pack is base64 of a zlib stream of bytes. Every cloud is 3 axes x 3 byte planes of zigzag integers, lowest byte first: in
steps of `step` from `low`, the difference to the row before, or, for a later cloud with the same rows, to the first cloud. Then
a byte per point of the first cloud for its dot size, then the colours, a byte (scalars, 255 unknown) or three planes (RGB) per
point.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.cloud.scan import Mask, Points
from pcdenoise.errors import UsageError
from pcdenoise.evaluation.colours import CLAY, Colour, Scalar, srgb
from pcdenoise.evaluation.framing import camera_for
from pcdenoise.evaluation.raster import COLOUR_MAPS
from pcdenoise.evaluation.splats import local_spacing

MOST_POINTS = 500_000
_MOST_ROWS = 1_500_000  # of all clouds of a page together
_BOX_STEPS = 2**20 - 1  # a millimetre in a kilometre
_UNKNOWN = 255

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]
Corner = NDArray[np.float64]


def pack(
    clouds: Mapping[str, Points], colours: Mapping[str, Colour], unit: str = "", *, same_points: bool = True
) -> tuple[dict[str, Any], str]:
    """Named clouds, the first one the original, as (description, base64 data) for viewer.html.

    Clouds of as many rows as the first are its stages, if `same_points`; others are shown beside it. A colour belongs to the
    first cloud of its number of rows, and to that one's stages. At most MOST_POINTS points of a cloud go in, evenly thinned;
    rows that are not finite or far away do not. Raises UsageError if a colour fits no cloud.
    """
    points = list(clouds.values())
    paired = [place == 0 or (same_points and len(cloud) == len(points[0])) for place, cloud in enumerate(points)]
    low, high = _box(points)
    step = float((high - low).max()) / _BOX_STEPS or 1.0
    rows = _shown_rows(points, paired, low, high)
    steps = [np.rint((cloud[kept] - low) / step).astype(np.int64) for cloud, kept in zip(points, rows, strict=True)]
    spacing = local_spacing(points[0][rows[0]])
    usual = float(np.median(spacing)) if len(spacing) else 1.0
    parts = [
        _zigzag(cloud, steps[0] if pair and place else None)
        for place, (cloud, pair) in enumerate(zip(steps, paired, strict=True))
    ]
    parts.append(np.rint(127 + 64 * np.log2(np.clip(spacing / usual, 0.5, 2.5))).astype(np.uint8))
    described = []
    for name, colour in colours.items():
        if colour is not None:
            n = len(_values(colour))
            fit = next((place for place, cloud in enumerate(points) if len(cloud) == n), None)
            if fit is None:
                raise UsageError(f"colour {name}: {n} rows fit no cloud; give one per point")
            description, planes = _colour(name, colour, rows[fit])
            shown_on = [place for place, pair in enumerate(paired) if place == fit or (pair and fit == 0)]
            described.append({**description, "clouds": shown_on})
            parts.append(planes)
    description = {
        "clouds": [
            {"name": name, "n": len(kept), "total": len(cloud), "paired": pair}
            for name, kept, cloud, pair in zip(clouds, rows, points, paired, strict=True)
        ],
        "step": step,
        "low": low.tolist(),
        "spacing": usual,
        "clay": CLAY.tolist(),
        "unit": unit,
        "colours": described,
        "camera": _camera(points[0][rows[0]], low, step),
    }
    data = zlib.compress(np.concatenate([part.ravel() for part in parts]).tobytes(), 6)
    return description, base64.b64encode(data).decode("ascii")


def _shown_rows(points: list[Points], paired: list[bool], low: Corner, high: Corner) -> list[Integers]:
    """The rows of each cloud that go in; the same ones for all paired clouds, those that are usable in every one."""
    usable = [_within(cloud, low, high) for cloud in points]
    in_all = np.asarray(np.stack([mask for mask, pair in zip(usable, paired, strict=True) if pair]).all(axis=0))
    most = min(MOST_POINTS, _MOST_ROWS // len(points))
    first = _thinned(points[0], in_all, most)
    return [first if pair else _thinned(cloud, mask, most) for cloud, mask, pair in zip(points, usable, paired, strict=True)]


def _camera(points: Points, low: Corner, step: float) -> dict[str, Any]:
    """A good view of a square frame, in steps from the corner of the box, and which signed axis is the vertical of the cloud."""
    camera = camera_for(points, (1, 1))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    right, up, _ = camera.axes
    return {
        "target": ((camera.target - low) / step).tolist(),
        "axes": camera.axes.tolist(),
        "up": axes[np.argmax(axes @ up - 9 * np.abs(axes @ right))].tolist(),
        "half_height": camera.half_height / step,
        "distance": camera.distance / step,
    }


def _box(clouds: list[Points]) -> tuple[Corner, Corner]:
    """The corners of a box around all points but those farther out than twice the extent of the middle 98 %."""
    every = np.concatenate([cloud[:: max(len(cloud) // 100_000, 1)] for cloud in clouds])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        return np.zeros(3), np.ones(3)
    low, high = np.percentile(every, [1, 99], axis=0)
    reach = 2 * max(float((high - low).max()), 1e-9 * max(float(np.abs(every).max()), 1.0))
    seen = [cloud[_within(cloud, low - reach, high + reach)] for cloud in clouds]
    lows, highs = [cloud.min(axis=0) for cloud in seen if len(cloud)], [cloud.max(axis=0) for cloud in seen if len(cloud)]
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _within(points: Points, low: Corner, high: Corner) -> Mask:
    """(N,) which rows lie in the box; NaN does not."""
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def _thinned(points: Points, usable: Mask, most: int) -> Integers:
    """At most `most` of the usable rows, neighbours after one another, evenly taken along that order."""
    rows = np.flatnonzero(usable)
    rows = rows[spatial_order(points[rows])] if len(rows) else rows
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def _zigzag(steps: Integers, base: Integers | None) -> Bytes:
    """(N, 3) integers as (3, 3, N) byte planes of their differences to the row before, or to `base`."""
    difference = np.diff(steps, axis=0, prepend=0) if base is None else steps - base
    folded = (difference << 1) ^ (difference >> 63)
    return np.stack([[(folded[:, axis] >> shift) & 255 for shift in (0, 8, 16)] for axis in range(3)]).astype(np.uint8)


def _values(colour: Colour) -> NDArray[Any]:
    return colour.values if isinstance(colour, Scalar) else np.asarray(colour)


def _colour(name: str, colour: Colour, rows: Integers) -> tuple[dict[str, Any], Bytes]:
    """What the viewer needs to know of a colour, and its bytes for the kept rows."""
    values = _values(colour)
    if values.ndim == 2:
        return {"name": name, "kind": "rgb"}, (srgb(values[rows]) * 255 + 0.5).astype(np.uint8).T
    scalar = colour if isinstance(colour, Scalar) else Scalar(values.astype(np.float64), map="viridis")
    low, high = scalar.range()
    fractions = scalar.fractions()[rows]
    coded = np.where(np.isnan(fractions), _UNKNOWN, np.rint(np.nan_to_num(fractions) * (_UNKNOWN - 1))).astype(np.uint8)
    stops = COLOUR_MAPS[scalar.map].split()
    return {"name": name, "kind": "scalar", "label": scalar.label or name, "low": low, "high": high, "stops": stops}, coded
