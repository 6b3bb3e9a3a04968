"""Smooth one-to-one maps of space that carry area vectors with them. Not here: what is warped (solids.py, families.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcdenoise.synthesis.solids import Vectors, Warp


def wave(
    amplitude: NDArray[np.float64],
    wavevector: NDArray[np.float64],
    phase: float,
    *,
    hardness: float = 0.0,
    centre: NDArray[np.float64] | None = None,
    width: float = 1.0,
) -> Warp:
    """p + amplitude f(wavevector . p + phase), f a sine, near a square wave as hardness grows; with a centre, only in a ball.

    `width` is the ball's radius, on which the wave has faded to nothing with two continuous derivatives.
    One-to-one as long as |amplitude . wavevector| (1 + hardness) + 2 |amplitude| / width < 1.
    """

    def warp(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        value, gradient = profile(points)
        return _displaced(points, areas, value, gradient, amplitude)

    def profile(points: Vectors) -> tuple[NDArray[np.float64], Vectors]:
        angle = points @ wavevector + phase
        value, slope = np.sin(angle), np.cos(angle)
        if hardness > 0:
            squared_off = np.tanh(hardness * value)
            slope = slope * (1.0 - squared_off**2) * (hardness / np.tanh(hardness))
            value = squared_off / np.tanh(hardness)
        return value, slope[:, None] * wavevector

    if centre is None:
        return warp
    middle = centre

    def patch(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        offset = points - middle
        room = 1.0 - np.einsum("ij,ij->i", offset, offset) / width**2
        near = np.flatnonzero(room > 0)
        offset, room = offset[near], room[near]
        value, gradient = profile(points[near])
        gradient = (room**3)[:, None] * gradient - (value * room**2 * (6.0 / width**2))[:, None] * offset
        points, areas = points.copy(), areas.copy()
        points[near], areas[near] = _displaced(points[near], areas[near], value * room**3, gradient, amplitude)
        return points, areas

    return patch


def _displaced(
    points: Vectors, areas: Vectors, value: NDArray[np.float64], gradient: Vectors, amplitude: NDArray[np.float64]
) -> tuple[Vectors, Vectors]:
    """p + amplitude value(p): the cofactor matrix of I + amplitude gradient^T is a rank-one update."""
    stretch = 1.0 + gradient @ amplitude
    return points + value[:, None] * amplitude, stretch[:, None] * areas - (areas @ amplitude)[:, None] * gradient


def twist(rate: float) -> Warp:
    """Turn around z by rate * z radians."""

    def warp(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        x, y, z = points.T
        cos, sin = np.cos(rate * z), np.sin(rate * z)
        a, b, c = areas.T
        c = c + rate * (y * a - x * b)
        turned_areas = np.column_stack([cos * a - sin * b, sin * a + cos * b, c])
        return np.column_stack([cos * x - sin * y, sin * x + cos * y, z]), turned_areas

    return warp


def taper(rate: float) -> Warp:
    """Scale x and y by 1 + rate * z; one-to-one while that is positive."""

    def warp(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        x, y, z = points.T
        scale = 1.0 + rate * z
        a, b, c = areas.T
        c = scale**2 * c - rate * scale * (x * a + y * b)
        return np.column_stack([scale * x, scale * y, z]), np.column_stack([scale * a, scale * b, c])

    return warp


def bend(curvature: float) -> Warp:
    """Bend the x axis into a circle of that curvature around the z direction; one-to-one while 1 + curvature * y > 0."""

    def warp(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        x, y, z = points.T
        cos, sin = np.cos(curvature * x), np.sin(curvature * x)
        stretch = 1.0 + curvature * y
        a, b, c = areas[:, 0], areas[:, 1] * stretch, areas[:, 2] * stretch
        radius = y + 1.0 / curvature
        bent_areas = np.column_stack([cos * a + sin * b, cos * b - sin * a, c])
        return np.column_stack([radius * sin, radius * cos - 1.0 / curvature, z]), bent_areas

    return warp


def turned(warp: Warp, rotation: NDArray[np.float64]) -> Warp:
    """The same warp in a rotated frame."""

    def rotated(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        points, areas = warp(points @ rotation, areas @ rotation)
        return points @ rotation.T, areas @ rotation.T

    return rotated
