"""Light on a depth picture: normals, hollows, crevices, lamp. Not here: how the depth picture came about (splats.py).

Depths are (H, W) float32 in pixels, larger is farther, infinite where nothing is. All of it is O(pixels), whatever the number
of points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_LAMP = np.array([-0.46, 0.54, 0.70], dtype=np.float32)  # unit direction towards it: right, up, viewer
_LAMP_LIGHT, _SKY_LIGHT, _FLOOR_LIGHT = np.array([[0.86, 0.80, 0.71], [0.30, 0.33, 0.38], [0.20, 0.18, 0.17]], dtype=np.float32)
_GAMMA = 2.2


def shade(depth: Array, tilt: Array, colour: Array, spacing: float, wide: int, strength: float) -> Array:
    """Lit sRGB colours, (P, 3), of the P covered pixels of a depth picture in row order.

    tilt      (P, 2) what a single sphere adds to the normal: right and up, 0 where points are to look like one surface.
    colour    (P, 3) sRGB of the material.
    spacing   distance between neighbouring points in pixels: sizes the windows.
    wide      pixels that the large hollows of the picture measure.
    strength  1 for clay, less for colours that were photographed with light in them.
    """
    covered = np.isfinite(depth)
    coarse = depth[::2, ::2] * np.float32(0.5)

    def fine(picture: Array) -> Array:
        return picture.repeat(2, axis=0)[: len(depth)].repeat(2, axis=1)[:, : depth.shape[1]][covered]

    normal = fine(_normals(coarse, int(np.clip(1.1 * spacing, 3, 40))))
    normal[:, :2] += tilt
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    open_sky = 1 - 0.6 * fine(_hollowness(coarse, int(np.clip(1.5 * spacing, 3, 60))))
    open_sky *= 1 - 0.5 * fine(_hollowness(coarse, max(wide, 3)))
    lamp = np.clip((normal @ _LAMP + 0.15) / 1.15, 0, 1) * (0.5 + 0.5 * open_sky)
    upward = (normal[:, 1] + 1) / 2 * open_sky
    light = lamp[:, None] * _LAMP_LIGHT + upward[:, None] * _SKY_LIGHT + (open_sky - upward)[:, None] * _FLOOR_LIGHT
    light *= 1 - 0.75 * _crevices(depth)[covered][:, None]
    light += (1 - strength) * (0.95 - light)
    lit: Array = np.clip(colour * np.clip(light, 0, 1.3) ** np.float32(1 / _GAMMA), 0, 1)
    return lit


def box_mean(values: NDArray[np.float64], radius: int) -> NDArray[np.float64]:
    """Mean over the square window around every pixel, (..., H, W); beyond the edge counts as 0."""
    side = 2 * radius + 1
    edges = [(0, 0)] * (values.ndim - 2) + [(radius + 1, radius)] * 2
    table = np.pad(values, edges).cumsum(axis=-2).cumsum(axis=-1)
    upper, lower = table[..., :-side, :], table[..., side:, :]
    mean: NDArray[np.float64] = (lower[..., side:] - lower[..., :-side] - upper[..., side:] + upper[..., :-side]) / side**2
    return mean


def _normals(depth: Array, radius: int) -> Array:
    """Surface normals, (H, W, 3) right, up, viewer.

    The planes fitted to nine overlapping windows around a pixel are mixed with weights that favour those which fit (Kuwahara's
    filter), so that edges and outlines stay sharp.
    """
    covered = np.isfinite(depth)
    height, width = depth.shape
    v, u = np.mgrid[:height, :width] - np.array([height, width])[:, None, None] / 2
    z = np.where(covered, depth, 0)
    moments = np.stack([np.ones_like(u), u, v, z, u * u, v * v, u * v, u * z, v * z, z * z])
    share, *sums = box_mean(covered * moments, radius)
    mu, mv, mz, uu, vv, uv, uz, vz, zz = sums / np.where(share > 0, share, 1)
    uu, vv, uv = uu - mu * mu + 0.1, vv - mv * mv + 0.1, uv - mu * mv
    uz, vz, zz = uz - mu * mz, vz - mv * mz, zz - mz * mz
    determinant = uu * vv - uv * uv
    right, down = (vv * uz - uv * vz) / determinant, (uu * vz - uv * uz) / determinant
    misfit = np.maximum(zz - right * uz - down * vz, 0)
    weight = np.where(share > 0.15, share, 0) / (misfit + (0.25 * radius) ** 2) ** 2
    mixed = np.pad(np.stack([weight, weight * right, weight * down]), ((0, 0), (radius, radius), (radius, radius)))
    for axis in (1, 2):  # nine windows, as three rows of three
        mixed = mixed + np.roll(mixed, radius, axis) + np.roll(mixed, -radius, axis)
    mixed = box_mean(mixed[:, radius:-radius, radius:-radius], radius // 2)
    mixed[1:] /= mixed[0] + 3 / radius**4  # where no plane fits, face the viewer
    normal = np.stack([mixed[1], -mixed[2], np.ones_like(u)], axis=-1)
    unit: Array = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    return unit


def _hollowness(depth: Array, radius: int) -> Array:
    """How far a pixel lies behind its surroundings, (H, W), in window radii, 0 to 1: ambient occlusion (Luft et al. 2006)."""
    covered = np.isfinite(depth)
    z = np.where(covered, depth, 0)
    share, around = box_mean(box_mean(np.stack([covered, z]).astype(np.float64), radius), radius)
    return np.where(covered, np.clip((z - around / np.maximum(share, 1e-9)) / radius, 0, 1), 0).astype(np.float32)


def _crevices(depth: Array) -> Array:
    """Darkness between neighbouring spheres, (H, W), 0 to 1: how far a pixel lies behind the middle of two opposite neighbours.

    That is eye-dome lighting with the slope taken out."""
    z = np.pad(np.where(np.isfinite(depth), depth, np.float32(1e9)), 1, mode="edge")
    total = np.zeros_like(depth)
    height, width = depth.shape
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one, other = z[1 + dy :, 1 + dx :][:height, :width], z[1 - dy :, 1 - dx :][:height, :width]
        total += np.clip(z[1:-1, 1:-1] - (one + other) / 2, 0, 2)
    darkness: Array = 1 - np.exp(-0.35 * total)
    return darkness
