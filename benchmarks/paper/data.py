"""What is learned from and what is judged: meshes, generated or given, and the paper's clouds of them.

Generated ones need no file from outside: superellipsoids, supertoroids, knotted tubes and bumpy balls, a number giving a shape.
Not here: learning, errors (lab.py).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pcdenoise import io
from pcdenoise.cloud.scan import Points, Scan
from pcdenoise.errors import UsageError
from pcdenoise.synthesis import lidar, noise
from pcdenoise.synthesis.meshes import MESH_SUFFIXES, Mesh, lambert_rgb, load_mesh, sample_mesh

LEVELS = (0.5, 1.0, 1.5)
"""Noise, in percent of the bounding box's diagonal."""
BIAS_STD = 0.005
"""Of each laser of the lidar, in diagonals, whatever the noise of a ray."""
Law = Literal["gaussian", "lidar"]
_POSES = 6
_FIRST_TEST_SHAPE = 1000

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Item:
    """A mesh, an evenly spaced coloured cloud of it, and a noisy cloud per level; under Gaussian noise rows correspond."""

    name: str
    mesh: Mesh
    clean: Scan
    noisy: dict[float, Scan]


@dataclass(frozen=True)
class Shapes:
    """Where meshes come from: a folder, whose meshes are shuffled once and the first of them kept for tests, or nowhere."""

    folder: Path | None = None

    def meshes(self, n: int, *, test: bool, n_test: int, boxes: bool = False) -> list[tuple[str, Mesh]]:
        """n meshes by name, either to test or to learn from. boxes: with flat faces and straight edges instead."""
        first = _FIRST_TEST_SHAPE if test else 0
        if boxes:
            return [(f"box_{number}", box(number)) for number in range(first, first + n)]
        if self.folder is None:
            return [(f"shape_{number}", shape(number)) for number in range(first, first + n)]
        files = sorted(entry for entry in self.folder.iterdir() if entry.suffix.lower() in MESH_SUFFIXES)
        np.random.default_rng(0).shuffle(files)  # type: ignore[arg-type]
        chosen = files[:n_test][:n] if test else files[n_test:][:n]
        if len(chosen) < n:
            raise UsageError(f"{self.folder}: {len(files)} meshes; {n_test} to test and {n} to learn from are asked for")
        return [(file.stem, load_mesh(file)) for file in chosen]


def shape(number: int) -> Mesh:
    """One of four families of closed surfaces with random proportions; the same for the same number."""
    rng = np.random.default_rng([41, number])
    sizes = rng.uniform(0.5, 1, 3)
    flat, round_ = rng.uniform(0.15, 1, 2)
    kind = number % 4
    if kind == 0:  # superellipsoid, from a rounded box to a ball
        return _grid(
            lambda u, v: sizes * np.stack([_c(v, flat) * _c(u, round_), _c(v, flat) * _s(u, round_), _s(v, flat)], -1), 0.5
        )
    if kind == 1:  # supertoroid
        hole = rng.uniform(1.5, 3)
        return _grid(
            lambda u, v: sizes * np.stack([(hole + _c(v, flat)) * _c(u, 1), (hole + _c(v, flat)) * _s(u, 1), _s(v, round_)], -1),
            1,
        )
    if kind == 2:  # a tube along a torus knot
        return _tube(int(rng.integers(2, 4)), float(rng.uniform(0.2, 0.35)))
    waves = rng.integers(2, 6, 2)
    height = rng.uniform(0.05, 0.15)

    def bumpy(u: Array, v: Array) -> Array:
        radius = 1 + height * np.sin(waves[0] * u) * np.cos(v) * np.sin(waves[1] * v)
        return radius[..., None] * sizes * np.stack([_c(v, 1) * _c(u, 1), _c(v, 1) * _s(u, 1), _s(v, 1)], -1)

    return _grid(bumpy, 0.5)


def box(number: int) -> Mesh:
    """An upright box around the origin with random proportions."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    sizes = np.random.default_rng([43, number]).uniform(0.5, 1, 3)
    quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    return Mesh(corners * sizes, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int64))


def _c(angle: Array, power: float) -> Array:
    rounded: Array = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power
    return rounded


def _s(angle: Array, power: float) -> Array:
    return _c(angle - np.pi / 2, power)


def _grid(place, turn: float, n: int = 96) -> Mesh:  # type: ignore[no-untyped-def]
    """The surface that `place` makes of longitudes u and of v, which goes round (turn 1) or from pole to pole (turn 0.5)."""
    closed = turn == 1
    u = np.linspace(0, 2 * np.pi, n, endpoint=False)
    v = np.linspace(0, 2 * np.pi, n, endpoint=False) if closed else np.linspace(-np.pi / 2, np.pi / 2, n // 2)
    vertices = place(*np.meshgrid(u, v, indexing="ij"))
    rows = np.arange(n * len(v)).reshape(n, len(v))
    across, up = np.roll(rows, -1, axis=0), np.roll(rows, -1, axis=1)
    both = np.roll(up, -1, axis=0)
    some = slice(None) if closed else slice(None, -1)
    a, b, c, d = (corner[:, some].ravel() for corner in (rows, across, both, up))
    return _merged(vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def _merged(vertices: Array, faces: NDArray[np.int64]) -> Mesh:
    """Equal vertices, as at the poles, made one, and the faces that vanish left out."""
    unique, place = np.unique(vertices.round(9), axis=0, return_inverse=True)
    faces = place.reshape(-1)[faces]
    return Mesh(unique, faces[~(faces == np.roll(faces, 1, axis=1)).any(axis=1)])


def _tube(turns: int, radius: float) -> Mesh:
    def knot(t: Array) -> Array:
        ring = 2 + np.cos((2 * turns - 1) * t)
        return np.stack([ring * np.cos(turns * t), ring * np.sin(turns * t), np.sin((2 * turns - 1) * t)], -1)

    def around(u: Array, v: Array) -> Array:
        ahead = knot(u + 1e-4) - knot(u - 1e-4)
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        outward = knot(u) * [1, 1, 0]
        side = outward - (outward * ahead).sum(-1, keepdims=True) * ahead
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        return knot(u) + radius * (np.cos(v)[..., None] * side + np.sin(v)[..., None] * np.cross(ahead, side))

    return _grid(around, 1, 192)


def items(meshes: Sequence[tuple[str, Mesh]], law: Law, levels: Sequence[float], n_points: int, seed: list[int]) -> list[Item]:
    """The paper's clouds of some meshes: Poisson-disk samples with *Simple* Gaussian noise, or *Advanced*, a lidar's scans.

    A scan that has more than n_points keeps so many of its points, drawn at random. Colours: three directional lights.
    """
    made = []
    for number, (name, mesh) in enumerate(meshes):
        rng = np.random.default_rng([*seed, number])
        sample = sample_mesh(mesh, n_points, rng)
        clean = coloured(sample.points, sample.normals, rng)
        noisy = {}
        for level in levels:
            if law == "gaussian":
                noisy[level] = clean.moved_to(noise.gaussian(clean.points, level / 100 * mesh.diagonal, rng))
                continue
            scan = lidar.scan_mesh(mesh, rng, ray_std=level / 100, bias_std=BIAS_STD, n_poses=_POSES)
            rows = np.sort(rng.permutation(len(scan))[:n_points])
            noisy[level] = coloured(scan.points[rows], scan.normals[rows], rng)
        made.append(Item(name, mesh, clean, noisy))
    return made


def coloured(points: Points, normals: Array, rng: np.random.Generator) -> Scan:
    """A scan with the colours of a lit white surface."""
    red, green, blue = lambert_rgb(normals, rng).T
    return Scan(points, {"red": red, "green": green, "blue": blue}, format="ply")


def write_dataset(made: Sequence[Item], folder: Path) -> None:
    """A folder as `pcdenoise synth` makes it, which training reads."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for item in made:
        io.write(item.clean, folder / f"{item.name}_clean.ply", overwrite=True)
        noisy = []
        for level, scan in item.noisy.items():
            noisy.append({"file": f"{item.name}_{level:g}.ply", "level_percent": level})
            io.write(scan, folder / noisy[-1]["file"], overwrite=True)
        entries.append({"name": item.name, "clean": f"{item.name}_clean.ply", "noisy": noisy})
    (folder / "dataset.json").write_text(json.dumps({"schema": 1, "items": entries}, indent=1) + "\n")
