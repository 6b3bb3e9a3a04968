"""Random building blocks of about unit size: profiles, turned parts, orientations, warps. Not here: bodies (families.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcdenoise.synthesis.solids import Blob, Extrusion, Lathe, Part, Solid, Torus, Warp, directions, rectangle
from pcdenoise.synthesis.warps import bend, taper, turned, twist, wave

Array = NDArray[np.float64]


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), rotation: Array | None = None, *, carved: bool = False) -> Part:
    """A box whose centre is given in the rotated frame."""
    turn = np.eye(3) if rotation is None else rotation
    width, depth, height = np.asarray(size, dtype=np.float64)
    return Part(Extrusion(rectangle(width, depth), height), turn @ np.asarray(centre), turn, carved=carved)


def placed(solid: Solid, centre: Array, rotation: Array, scale: Array, *, carved: bool = False) -> Part:
    """A scaled part; the scale goes into the dimensions where the solid has them, so that boundary samples are not wasted."""
    if isinstance(solid, Extrusion):
        return Part(Extrusion(solid.polygon * scale[:2], solid.height * scale[2]), centre, rotation, carved=carved)
    if isinstance(solid, Lathe) and scale[0] == scale[1]:
        return Part(Lathe(solid.profile * scale[1:]), centre, rotation, carved=carved)
    return Part(solid, centre, rotation, scale, carved)


def cylinder(radius: float) -> Lathe:
    return Lathe(np.array([(0, -0.5), (radius, -0.5), (radius, 0.5), (0, 0.5)]))


def extrusion(rng: np.random.Generator, height: float | None = None) -> Extrusion:
    """A profile of about unit size: box, wedge, n-gon, L, T, U, H, stairs, star or gear."""
    kind = rng.choice(9, p=(0.34, 0.14, 0.12, 0.08, 0.07, 0.07, 0.06, 0.06, 0.06))
    t = rng.uniform(0.12, 0.4)
    u = rng.uniform(0.12, 0.4)
    if kind == 0:
        outline = rectangle(1, rng.uniform(0.3, 1))
    elif kind == 1:
        outline = np.array([(-0.5, -0.5), (0.5, -0.5), (rng.uniform(-0.6, 0.6), 0.5)])
    elif kind == 2:
        outline = _star(int(rng.integers(5, 9)), 0.5 * np.ones(1))
    elif kind == 3:
        outline = np.array([(0, 0), (1, 0), (1, t), (u, t), (u, 1), (0, 1)]) - 0.5
    elif kind == 4:
        left, right = 0.5 - t / 2, 0.5 + t / 2
        outline = np.array([(left, 0), (right, 0), (right, 1 - u), (1, 1 - u), (1, 1), (0, 1), (0, 1 - u), (left, 1 - u)]) - 0.5
    elif kind == 5:
        outline = np.array([(0, 0), (1, 0), (1, 1), (1 - t, 1), (1 - t, u), (t, u), (t, 1), (0, 1)]) - 0.5
    elif kind == 6:
        half = np.array([(0.5, -0.5), (0.5, -0.5 + t), (u / 2, -0.5 + t), (u / 2, 0.5 - t), (0.5, 0.5 - t), (0.5, 0.5)])
        outline = np.concatenate([half, -half])
    elif kind == 7:
        n = int(rng.integers(3, 7))
        steps = np.repeat(np.arange(n + 1) / n, 2)
        outline = np.column_stack([1 - steps[:-1], steps[1:]])[:-1]
        outline = np.concatenate([[(0.0, 0.0), (1.0, 0.0)], outline]) - 0.5
    else:
        n = int(rng.integers(5, 13))
        inner = rng.uniform(0.25, 0.42)
        outline = _star(n, np.array([0.5, inner]) if rng.random() < 0.4 else np.array([0.5, 0.5, inner, inner]))
    return Extrusion(outline, rng.uniform(0.15, 1.2) if height is None else height)


def _star(n: int, radii: Array) -> Array:
    """n repeats of the radii around a circle, as a polygon."""
    angle = np.arange(n * len(radii)) * (2 * np.pi / (n * len(radii)))
    outline: Array = np.tile(radii, n)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return outline


def turned_part(rng: np.random.Generator) -> Solid:
    """Something from a lathe, of about unit size: cylinder, cone, frustum, pipe, stepped shaft, bowl, ball or ring."""
    kind = rng.choice(8, p=(0.25, 0.1, 0.1, 0.15, 0.15, 0.05, 0.1, 0.1))
    radius, half = rng.uniform(0.15, 0.6), rng.uniform(0.1, 0.6)
    if kind == 6:
        return Blob(0.5)
    if kind == 7:
        return Torus(0.5, rng.uniform(0.05, 0.3))
    if kind == 3:
        inner = radius * rng.uniform(0.4, 0.93)
        return Lathe(np.array([(inner, -half), (radius, -half), (radius, half), (inner, half)]))
    if kind == 4:
        heights = np.repeat(np.sort(rng.uniform(-0.6, 0.6, rng.integers(3, 7))), 2)[1:-1]
        radii = np.repeat(rng.uniform(0.1, 0.6, len(heights) // 2), 2)
        return Lathe(np.concatenate([[(0, heights[0])], np.column_stack([radii, heights]), [(0, heights[-1])]]))
    if kind == 5:
        angle = np.linspace(0, np.pi / 2, 40)
        arc = np.column_stack([np.sin(angle), -np.cos(angle)]) * 0.6
        return Lathe(np.concatenate([arc, arc[::-1] * rng.uniform(0.75, 0.95)]))
    top = {0: radius, 1: 0.0, 2: radius * rng.uniform(0.2, 0.9)}[int(kind)]
    return Lathe(np.array([(0, -half), (radius, -half), (top, half), (0, half)]))


def orientation(rng: np.random.Generator, aligned: bool) -> Array:
    """A rotation (3, 3): one of the 24 of the cube, or any."""
    matrix: Array = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    if aligned:
        matrix = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
    return matrix * float(np.sign(np.linalg.det(matrix)))


def bending(rng: np.random.Generator) -> Warp:
    """A large smooth warp of a body in the unit sphere."""
    kind = rng.integers(4)
    if kind == 0:
        along, across = directions(2, rng)
        k = 2 * np.pi / rng.uniform(1.0, 6.0)
        return wave(along * rng.uniform(0.1, 0.6) / k, across * k, rng.uniform(0, 2 * np.pi))
    if kind == 1:
        warp = twist(rng.uniform(-1.5, 1.5))
    elif kind == 2:
        warp = taper(rng.uniform(-0.5, 0.5))
    else:
        warp = bend(rng.choice([-1, 1]) * rng.uniform(0.1, 0.6))
    return turned(warp, orientation(rng, aligned=rng.random() < 0.5))


def engraving(rng: np.random.Generator) -> list[Warp]:
    """Surface detail: waves, grooves or local ripples along random directions."""
    kind = rng.integers(3)
    n = int(rng.integers(3, 15)) if kind == 2 else int(rng.integers(1, 6))
    slopes = rng.uniform(0.2, 0.4, n) if kind == 2 else rng.dirichlet(np.ones(n)) * rng.uniform(0.2, 0.8)
    warps = []
    for slope in slopes:
        along, across = directions(2, rng)
        k = 2 * np.pi / np.exp(rng.uniform(np.log(0.06), np.log(0.7)))
        phase = rng.uniform(0, 2 * np.pi)
        if kind == 0:
            warps.append(wave(along * slope / k, across * k, phase))
        elif kind == 1:
            hardness = rng.uniform(1, 3)
            warps.append(wave(along * slope / (0.5 + 0.5 * hardness) / k, across * k, phase, hardness=hardness))
        else:
            centre = directions(1, rng)[0] * rng.uniform(0.3, 1.0)
            width = rng.uniform(0.15, 0.6)
            warps.append(wave(along * slope * min(1 / k, width / 6), across * k, phase, centre=centre, width=width))
    return warps
