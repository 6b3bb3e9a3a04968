"""Families of random bodies to train on: mechanical, thin, organic, open. Not here: what they are built from (parts.py)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcdenoise.synthesis.parts import bending, box, cylinder, engraving, extrusion, orientation, placed, turned_part
from pcdenoise.synthesis.solids import Blob, Body, Extrusion, Lathe, Part, Solid, Torus, Vectors, Warp, directions, rectangle
from pcdenoise.synthesis.warps import wave

Array = NDArray[np.float64]


def random_body(rng: np.random.Generator) -> Body:
    """A random warped body of about unit size: what `random_surface` samples."""
    family = (_mechanical, _thin, _organic, _open)[rng.choice(4, p=(0.4, 0.16, 0.22, 0.22))]
    body = family(rng)
    while len(points := body.scatter(1000, rng)) < 50:  # a cut may leave next to nothing
        body = family(rng)
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    size = float(np.linalg.norm(points - centre, axis=1).max())

    def to_unit(points: Vectors, areas: Vectors) -> tuple[Vectors, Vectors]:
        return (points - centre) / size, areas / size**2

    warpiness, roughness = {_mechanical: (0.35, 0.25), _thin: (0.5, 0.15), _organic: (0.7, 0.7), _open: (0.5, 0.5)}[family]
    warps: list[Warp] = [*body.warps, to_unit]
    if rng.random() < warpiness:
        warps += [bending(rng) for _ in range(rng.integers(1, 4))]
    if rng.random() < roughness:
        warps += engraving(rng)
    return Body(body.parts, body.cuts, warps)


def _mechanical(rng: np.random.Generator) -> Body:
    """A base with parts and cut-outs attached, mostly at right angles."""
    aligned = rng.random() < 0.8
    parts: list[Part] = []
    for i in range(rng.integers(1, 7)):
        solid = extrusion(rng) if rng.random() < 0.6 else turned_part(rng)
        size = 1.0 if i == 0 else rng.uniform(0.2, 0.9)
        stretch = size * np.exp(rng.normal(0, 0.25, 3)) if isinstance(solid, Extrusion) else np.full(3, size)
        parts.append(placed(solid, _anchor(parts, rng), orientation(rng, aligned), stretch))
    for _ in range(rng.choice(5, p=(0.35, 0.25, 0.2, 0.1, 0.1))):
        hole = turned_part(rng) if rng.random() < 0.6 else extrusion(rng)
        depth = np.append(np.full(2, rng.uniform(0.06, 0.4)), rng.uniform(0.1, 2.0))
        parts.append(placed(hole, _anchor(parts[:1], rng), orientation(rng, aligned), depth, carved=True))
    return Body(parts)


def _thin(rng: np.random.Generator) -> Body:
    """Parts a few per cent thick, often close to each other."""
    thickness = rng.uniform(0.02, 0.12)
    return Body((_fins, _lattice, _plates, _pipes)[rng.integers(4)](rng, thickness))


def _fins(rng: np.random.Generator, thickness: float) -> list[Part]:
    """Parallel plates on a base, 1.5 to 5 thicknesses from one to the next."""
    turn = orientation(rng, aligned=False)
    gap = thickness * rng.uniform(1.5, 5.0)
    n = int(np.clip(2.0 / gap, 2, rng.integers(3, 13)))
    height, width = rng.uniform(0.3, 1.2), rng.uniform(0.4, 1.4)
    base = box((n * gap, rng.uniform(0.5, 1.5), thickness * 2), rotation=turn)
    return [base, *(box((thickness, width, height), ((i - (n - 1) / 2) * gap, 0.0, height / 2), turn) for i in range(n))]


def _lattice(rng: np.random.Generator, thickness: float) -> list[Part]:
    """Round and square rods along three axes."""
    turn = orientation(rng, aligned=False)
    rods = []
    for axis in np.repeat(np.arange(3), rng.integers(1, 4, 3)):
        place = rng.uniform(-0.7, 0.7, 3)
        place[axis] = 0
        rod: Solid = cylinder(0.5) if rng.random() < 0.5 else Extrusion(rectangle(1, 1), 1.0)
        frame = turn @ np.roll(np.eye(3), axis + 1, axis=0).T
        rods.append(placed(rod, turn @ place, frame, np.array([thickness, thickness, 2.0]) * rng.uniform(0.7, 1.3)))
    return rods


def _plates(rng: np.random.Generator, thickness: float) -> list[Part]:
    """Thin profiles through each other."""
    aligned = rng.random() < 0.6
    plates: list[Part] = []
    for _ in range(rng.integers(1, 6)):
        size = np.append(rng.uniform(0.4, 1.4, 2), thickness)
        plates.append(placed(extrusion(rng, height=1.0), _anchor(plates, rng), orientation(rng, aligned), size))
    return plates


def _pipes(rng: np.random.Generator, thickness: float) -> list[Part]:
    """Open tubes with walls half a thickness wide."""
    pipes: list[Part] = []
    for _ in range(rng.integers(1, 4)):
        radius, half = rng.uniform(0.15, 0.5), rng.uniform(0.4, 1.0)
        inner = radius - thickness / 2
        wall = Lathe(np.array([(inner, -half), (radius, -half), (radius, half), (inner, half)]))
        pipes.append(Part(wall, _anchor(pipes, rng), orientation(rng, aligned=True)))
    return pipes


def _organic(rng: np.random.Generator) -> Body:
    """Star-shaped blobs, ellipsoids, rings and capsules grown onto each other."""
    parts: list[Part] = []
    for i in range(rng.integers(1, 6)):
        size = 1.0 if i == 0 else rng.uniform(0.25, 0.8)
        place, turn = _anchor(parts, rng), orientation(rng, aligned=False)
        kind = rng.choice(4, p=(0.5, 0.2, 0.15, 0.15))
        if kind == 0:
            n = int(rng.integers(2, 9))
            waves = directions(n, rng) * rng.uniform(1.0, rng.choice([4.0, 16.0]), (n, 1))
            amplitudes = rng.dirichlet(np.ones(n)) * rng.uniform(0.2, 1.2) / np.maximum(2.0, np.linalg.norm(waves, axis=1))
            blob = Blob(1.0, waves, amplitudes, rng.uniform(0, 2 * np.pi, n))
            parts.append(placed(blob, place, turn, size * rng.uniform(0.5, 1.0, 3)))
        elif kind == 1:
            parts.append(placed(Blob(), place, turn, size * rng.uniform(0.2, 1.0, 3)))
        elif kind == 2:
            parts.append(placed(Torus(1.0, rng.uniform(0.1, 0.6)), place, turn, np.full(3, 0.7 * size)))
        else:
            radius, length = size * rng.uniform(0.08, 0.4), size * rng.uniform(0.5, 1.8)
            parts.append(placed(cylinder(1.0), place, turn, np.array([radius, radius, length])))
            for end in (-0.5, 0.5):
                parts.append(placed(Blob(), place + turn[:, 2] * end * length, turn, np.full(3, radius)))
    return Body(parts)


UP = np.array([0.0, 0.0, 1.0])
SLAB = ((2.1, 2.1, 0.5), (0.0, 0.0, -0.25))
"""A box whose top is seen between x, y = -1 and 1 once the rest of it is cut away by SLAB_CUTS."""
SLAB_CUTS = [(np.array([x, y, 0.0]), 1.0) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))] + [(-UP, 0.4)]


def _open(rng: np.random.Generator) -> Body:
    """Surfaces with borders."""
    return (_terrain, _facade, _room, _cut_open)[rng.choice(4, p=(0.25, 0.2, 0.2, 0.35))](rng)


def _terrain(rng: np.random.Generator) -> Body:
    """A rolling height field with steps and boulders."""
    parts = [box(*SLAB)]
    for _ in range(rng.integers(0, 6)):
        place = np.append(rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.05, 0.05))
        if rng.random() < 0.6:
            angle = rng.uniform(0, 2 * np.pi)
            turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
            parts.append(placed(extrusion(rng, height=1.0), place, turn, rng.uniform((0.2, 0.2, 0.1), (1.5, 1.5, 0.8))))
        else:
            parts.append(placed(Blob(), place, orientation(rng, aligned=False), rng.uniform(0.1, 0.5, 3)))
    hills = []
    for k in rng.uniform(1, 6, 3):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        hills.append(wave(UP * 0.5 / k, np.array([np.cos(angle), np.sin(angle), 0.0]) * k, phase))
    return Body(parts, SLAB_CUTS, hills)


def _facade(rng: np.random.Generator) -> Body:
    """The front of a wall with rows of window recesses and a ledge under some."""
    parts = [box(*SLAB)]
    columns, rows = rng.integers(1, 6, 2)
    pitch = np.array([1.8 / columns, 1.8 / rows])
    width, height = pitch * rng.uniform(0.35, 0.8, 2)
    depth = rng.uniform(0.03, 0.25)
    for column, row in np.ndindex(columns, rows):
        x, y = (np.array([column, row]) + 0.5) * pitch - 0.9
        if rng.random() < 0.85:
            parts.append(box((width, height, 2 * depth), (x, y, 0.0), carved=True))
        if rng.random() < 0.15:
            parts.append(box((1.2 * width, 0.2 * height, rng.uniform(0.1, 0.5)), (x, y - 0.6 * height, 0.0)))
    return Body(parts, SLAB_CUTS)


def _room(rng: np.random.Generator) -> Body:
    """A corner seen from inside: floor, two walls, windows, furniture."""
    parts = [box(np.roll((2.4, 2.4, 0.35), axis), np.roll((-0.15, -0.15, -1.175), axis)) for axis in range(3)]
    for _ in range(rng.integers(0, 6)):
        place = np.where(rng.random(3) < 0.5, rng.normal(-1.0, 0.02, 3), rng.uniform(-1.0, 0.6, 3))
        solid = extrusion(rng) if rng.random() < 0.7 else turned_part(rng)
        parts.append(placed(solid, place, orientation(rng, rng.random() < 0.7), np.full(3, rng.uniform(0.15, 0.7))))
    for _ in range(rng.integers(0, 3)):
        size = (2 * rng.uniform(0.03, 0.2), *rng.uniform(0.2, 0.8, 2))
        parts.append(box(size, (-1.0, *rng.uniform(-0.5, 0.5, 2)), carved=True))
    near = [(axis, float(rng.uniform(-0.2, 1.0))) for axis in np.eye(3)]
    return Body(parts, [*near, *((-axis, 1.3) for axis in np.eye(3))])


def _cut_open(rng: np.random.Generator) -> Body:
    """A closed body of another family cut by one or two planes."""
    body = (_mechanical, _thin, _organic)[rng.integers(3)](rng)
    points = body.scatter(300, rng)
    normals = directions(int(rng.integers(1, 3)), rng)
    return Body(body.parts, [(normal, float(np.quantile(points @ normal, rng.uniform(0.45, 0.85)))) for normal in normals])


def _anchor(parts: Sequence[Part], rng: np.random.Generator) -> Array:
    """A random place just off the boundary of one of the parts, so that no two faces coincide; the origin when there is none."""
    if not parts:
        return np.zeros(3)
    anchor: Array = parts[int(rng.integers(len(parts)))].boundary(1, rng)[0][0]
    return anchor + rng.normal(0.0, 0.02, 3)
