"""What there is to learn from: procedural surfaces, meshes and noisy scans, each as draws of training clouds.

Whoever learns without truth never sees a surface: of shapes and meshes it gets one noisy cloud each. Not here: what becomes of
them (dataset.py), how a teacher cleans them (distill.py).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcdenoise import io
from pcdenoise.cloud.neighbours import distinct
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.correction import unrounded
from pcdenoise.errors import ScanError, UsageError
from pcdenoise.learning.dataset import N_DENSE, PROCEDURAL, Array, Surface, is_learned_from, measured
from pcdenoise.learning.scans import DATASET, files_of
from pcdenoise.synthesis.meshes import MESH_SUFFIXES, load_mesh, sample_mesh
from pcdenoise.synthesis.shapes import in_unit_sphere, random_surface

_FEWEST_POINTS = 500
_PART_POINTS = 120_000
_MOST_PARTS = 32
"""Larger scans are learned from in so many balls of so many points, spread over them at random."""

Surfaces = list[Callable[[], Surface]]
NoisyClouds = list[Callable[[], Array]]
"""Functions that give noisy points in the unit sphere, always the same ones: (N, 3), or (N, 4) of scans, where the last column is
1 for those to learn from and 0 for those to judge by (dataset.learned_from)."""


def are_scans(data: Sequence[str]) -> bool:
    """Whether there is nothing but noisy scans to learn from."""
    return all(not PROCEDURAL.fullmatch(text) and not _meshes(_existing(text)) for text in data)


def surfaces_from(data: Sequence[str], seed: int, cache: Path) -> list[Surfaces]:
    """One list for each of `data`: `shapes:N`, N procedural surfaces; a mesh; all meshes in a folder, searched to the bottom.

    Raises UsageError for data without a mesh. Samples are kept in the folder `cache`, since sampling a surface costs more than
    learning from it.
    """
    return [_surfaces(text, seed, _folder(cache / str(number))) for number, text in enumerate(data)]


def noisy_from(data: Sequence[str], seed: int, cache: Path) -> list[NoisyClouds]:
    """One list for each of `data`: noisy scans (files, folders, the noisy files of a synth folder), or one noisy cloud, measured
    once and for all, of each surface that `surfaces_from` would give.

    Raises UsageError for data without a scan of 500 points.
    """
    found: list[NoisyClouds] = []
    for number, text in enumerate(data):
        folder = _folder(cache / str(number))
        if PROCEDURAL.fullmatch(text) or (not (_existing(text) / DATASET).is_file() and _meshes(_existing(text))):
            surfaces = _surfaces(text, seed, folder)
            clouds = [partial(_measured, surface, [seed, 3, number, n]) for n, surface in enumerate(surfaces)]
            found.append([partial(_kept, folder / f"noisy_{n}.npy", cloud) for n, cloud in enumerate(clouds)])
        else:
            found.append([partial(_loaded, path) for path in _parts_of_scans(_existing(text), seed, folder)])
    return found


def _surfaces(text: str, seed: int, cache: Path) -> Surfaces:
    if asked := PROCEDURAL.fullmatch(text):
        samplers = [partial(_procedural, seed, n) for n in range(int(asked[1]))]
    else:
        meshes = _meshes(_existing(text))
        if not meshes:
            raise UsageError(
                f"{text}: no mesh to learn from; give a folder of meshes or shapes:400, or learn from scans with --method distill"
            )
        samplers = [partial(_from_mesh, file) for file in meshes]
    return [partial(_surface, cache / f"{n}.npy", sampler) for n, sampler in enumerate(samplers)]


def _existing(text: str) -> Path:
    if not Path(text).exists():
        raise ScanError(f"{text}: no such file or folder; check --data, or give shapes:400 for procedural surfaces")
    return Path(text)


def _meshes(path: Path) -> list[Path]:
    return [file for file in (sorted(path.rglob("*")) if path.is_dir() else [path]) if _is_mesh(file)]


def _is_mesh(path: Path) -> bool:
    """By suffix; a PLY may as well be a point cloud and must say that it has faces."""
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in MESH_SUFFIXES
    with path.open("rb") as file:
        return b"element face" in file.read(8192)


def _parts_of_scans(path: Path, seed: int, folder: Path) -> list[Path]:
    """Files, one for each part: points in the unit sphere, and whether they are to learn from."""
    parts: list[Path] = []
    for file, _ in files_of([path]):
        scan = io.read(file)
        points = scan.points[scan.finite]
        points = points[distinct(points)[0]]
        if len(points) < _FEWEST_POINTS:
            continue
        points = points + unrounded(points, DenoiseConfig.model_validate({})).shift
        rng = np.random.default_rng([seed, 5, len(parts)])
        n_parts = 1 if len(points) <= _PART_POINTS else min(_MOST_PARTS, 2 * len(points) // _PART_POINTS)
        learned = is_learned_from(points)
        for centre in points[rng.choice(len(points), size=n_parts, replace=False)]:
            distance = np.linalg.norm(points - centre, axis=1)
            rows = np.arange(len(points)) if n_parts == 1 else np.argpartition(distance, _PART_POINTS)[:_PART_POINTS]
            parts.append(folder / f"noisy_{len(parts)}.npy")
            save_array(parts[-1], np.column_stack([in_unit_sphere(points[rows]), learned[rows]]).astype(np.float32))
    if not parts:
        raise UsageError(f"{path}: no scan with {_FEWEST_POINTS} points or more; give scans, a folder of them, or shapes:200")
    return parts


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _kept(path: Path, make: Callable[[], Array]) -> Array:
    if not path.exists():
        save_array(path, make().astype(np.float32))
    return _loaded(path)


def _loaded(path: Path) -> Array:
    kept: Array = np.load(path).astype(np.float64)
    return kept


def save_array(path: Path, array: NDArray[np.float32]) -> None:
    """Writes a file of a cache that several processes fill: it appears whole, and whoever is last does no harm."""
    part = path.with_suffix(f".{os.getpid()}.npy")
    np.save(part, array)
    part.replace(path)


def _surface(path: Path, sample: Callable[[], Array]) -> Surface:
    both = _kept(path, sample)
    return Surface(both[:, :3], both[:, 3:])


def _procedural(seed: int, number: int) -> Array:
    sample = random_surface(np.random.default_rng([seed, number]), N_DENSE)
    return np.concatenate([sample.points, sample.normals], axis=1)


def _from_mesh(path: Path) -> Array:
    sample = sample_mesh(load_mesh(path), N_DENSE, np.random.default_rng(0))
    return np.concatenate([in_unit_sphere(sample.points), sample.normals], axis=1)


def _measured(surface: Callable[[], Surface], seeds: list[int]) -> Array:
    return measured(surface(), np.random.default_rng(seeds))
