"""Where to look from: which way is up, which side to show, how much to include. Not here: how it is drawn (splats.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.scan import Points
from pcdenoise.evaluation.shading import box_mean
from pcdenoise.evaluation.splats import Camera, draw, local_spacing

Vector = NDArray[np.float64]

_X, _Y, _Z = np.eye(3)
_LONG_LENS = 5.0  # distance of the viewer in half-heights of the frame
_MARGIN = 1.18
_SAMPLE = 20_000
_AZIMUTHS = (-35, 35, 55, 125, 145, -145, -125, -55)


def camera_for(points: Points, size: tuple[int, int], direction: tuple[float, float] | None = None) -> Camera:
    """A good place to look at finite points (N, 3) from, for a picture of (width, height).

    `direction` is (azimuth, elevation) in degrees around the vertical, azimuth 0 looking along +y (along -z if y is up). Without
    it, a scan taken by a depth camera at the origin is seen from beside that camera, flat land from above, anything else from the
    side with most relief; models have their front at azimuth 0, so that counts half as much again. The vertical is z, unless the
    points stand on a foot in y. Isolated points do not count for the frame.
    """
    if not len(points):
        return Camera(np.zeros(3), _axes(_Z, 0, 20), 1.0, _LONG_LENS)
    sample = points[:: max(len(points) // _SAMPLE, 1)]
    spacing = local_spacing(sample)
    crowded = sample[spacing <= 6 * np.median(spacing)]
    if direction is not None:
        return _framed(crowded, _axes(_vertical(crowded), *direction), size)
    sensor = _sensor_axes(crowded)
    if sensor is not None:
        return _framed(crowded, sensor, size)
    up = _vertical(crowded)
    low, high = np.percentile(crowded, [1, 99], axis=0)
    sideways = (high - low)[up == 0].max()
    elevation = float(np.clip(45 - 60 * ((high - low) @ up) / max(sideways, 1e-12), 14, 38))
    views = {azimuth: _framed(crowded, _axes(up, azimuth, elevation), size) for azimuth in _AZIMUTHS}
    return views[max(views, key=lambda azimuth: _relief(crowded, views[azimuth], size) * (1.5 if abs(azimuth) < 90 else 1))]


def _axes(up: Vector, azimuth: float, elevation: float) -> Vector:
    """Right, up, towards the viewer for a direction in degrees."""
    east, north = (_X, _Y) if up[2] else (_X, -_Z)
    a, e = np.radians([azimuth, elevation])
    back = np.cos(e) * (np.sin(a) * east - np.cos(a) * north) + np.sin(e) * up
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _vertical(points: Points) -> Vector:
    """z; or y where many points lie at the lowest y, few at the highest, and z has no such foot (most models of graphics)."""
    low, high = np.percentile(points, [0.2, 99.8], axis=0)
    height = (points - low) / np.maximum(high - low, 1e-12)
    foot, head = (height < 0.04).mean(axis=0), (height > 0.96).mean(axis=0)
    flat = (high - low)[2] < 0.35 * (high - low)[:2].max()
    stands_in_y = foot[1] > max(0.05 if flat else 0.035, (2.2 if flat else 1.2) * head[1], 1.8 * foot[2])
    return _Y if stands_in_y else _Z


def _sensor_axes(points: Points) -> Vector | None:
    """Axes of a view from near the origin, if all points lie in a cone about z in front of it, as depth cameras deliver them."""
    distance = np.linalg.norm(points, axis=1)
    if not distance.min() > 0:
        return None
    mean = (points / distance[:, None]).mean(axis=0)
    depth = points[:, 2] * np.sign(mean[2])
    extent = np.ptp(np.percentile(points, [1, 99], axis=0), axis=0)
    if abs(mean[2]) < 0.85 or depth.min() < 0.2 * depth.mean() or np.linalg.norm(extent) < 0.1 * distance.mean():
        return None
    up, back = -_Y * np.sign(mean[2]), -_Z * np.sign(mean[2])
    right = np.cross(up, back)
    a, e = np.radians([18, 10])
    back = np.cos(e) * (np.cos(a) * back + np.sin(a) * right) + np.sin(e) * up
    right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
    return np.stack([right, np.cross(back, right), back])


def _framed(points: Points, axes: Vector, size: tuple[int, int]) -> Camera:
    """The camera along `axes` with nearly all points in its frame: first as if from infinity, then from where that puts it."""
    origin = points.mean(axis=0)
    right, up, towards = ((points - origin) @ axes.T).T
    smallest = 1e-9 * max(float(np.abs(points).max()), 1e-3)
    distance = np.inf
    for _ in range(2):
        nearer = 1 / (1 - np.minimum(towards / distance, 0.9))
        (left, low), (far_right, high) = np.percentile(np.stack([right * nearer, up * nearer]), [0.1, 99.9], axis=1)
        half_height = _MARGIN / 2 * max(high - low, (far_right - left) * size[1] / size[0], smallest)
        distance = _LONG_LENS * half_height + float(np.percentile(towards, 99.9))
    return Camera(origin + (left + far_right) / 2 * axes[0] + (low + high) / 2 * axes[1], axes, half_height, distance)


def _relief(points: Points, camera: Camera, size: tuple[int, int]) -> float:
    """How much there is to see: the contrast of the light at the size of features, summed over the picture."""
    small = (max(size[0] * 120 // max(size), 1), max(size[1] * 120 // max(size), 1))
    radius = 1.2 * local_spacing(points)
    drawing = draw(points, np.full((len(points), 3), 0.8, dtype=np.float32), radius, camera, small, oversampling=1)
    brightness = np.stack([drawing.owner >= 0, drawing.canvas.mean(axis=2) * (drawing.owner >= 0)]).astype(np.float64)
    fine, coarse = box_mean(brightness, 2), box_mean(brightness, 8)
    features = np.abs(fine[1] / np.maximum(fine[0], 1e-9) - coarse[1] / np.maximum(coarse[0], 1e-9))
    return float(features[drawing.owner >= 0].sum())
