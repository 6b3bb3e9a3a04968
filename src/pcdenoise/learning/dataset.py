"""Clouds to learn from: noisy points, their seeds, and where the true surface is. Not here: losses and the training loop."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import count
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.cloud.noise_level import estimate
from pcdenoise.denoising.pyramid import coarsen, share_of_seeds
from pcdenoise.errors import ScanError, UsageError
from pcdenoise.synthesis import noise
from pcdenoise.synthesis.meshes import MESH_SUFFIXES, load_mesh, sample_mesh
from pcdenoise.synthesis.shapes import in_unit_sphere, random_surface

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

N_DENSE = 200_000
"""Samples by which a training surface is known: 0.5 % of its bounding sphere apart."""
N_SEEDS = 6_000
N_RAW = 48_000
N_LANDING = 4_000
"""Most seeds, raw points and landing points of one training cloud; larger ones are cut to a ball."""
_LAWS = {
    "gaussian": 0.64,
    "rays": 0.08,
    "heavy-tailed": 0.1,
    "laplace": 0.04,
    "anisotropic": 0.06,
    "beam-bias": 0.04,
    "quantised": 0.04,
}
"""How often each law of noise is met."""


@dataclass(frozen=True)
class TrainingCloud:
    """One noisy cloud, ready for the network.

    seeds (M, 3), count (M,); raw (F, 3): points that land on the seeds. Where every point is its own seed, both are None.
    surface (S, 3), normals (S, 3): the true surface. seed_judged (M,): seeds of the surface, far enough from the cut.
    covered (C, 3), covered_normals (C, 3): samples of the surface that final points should come close to.
    judged, clutter (F,): final points far enough from the cut, and those that belong to no surface and should stay.
    noise: estimated standard deviation; scale: what errors are divided by.
    """

    seeds: Array
    count: Array | None
    raw: Array | None
    surface: Array
    normals: Array
    covered: Array
    covered_normals: Array
    seed_judged: Mask
    judged: Mask
    clutter: Mask
    noise: float
    scale: float

    @property
    def on_surface(self) -> Mask:
        """(F,) final points that are judged by their distance to the surface."""
        return self.judged & ~self.clutter


def draw_cloud(surface: Array, normals: Array, neighbours: int, rng: np.random.Generator) -> TrainingCloud:
    """A noisy cloud of random density, noise law and level from the (S, 3) samples of a surface in the unit sphere."""
    n_points = int(np.exp(rng.uniform(np.log(4_000), np.log(150_000))))
    std = 0.0 if rng.random() < 0.04 else float(np.exp(rng.uniform(np.log(0.0015), np.log(0.036))))
    clean, clutter = _with_clutter(surface[_sampling(surface, n_points, rng)], rng)
    noisy, clutter = _with_outliers(_noise(clean, std, rng), clutter, rng)

    level = estimate(noisy, threads=1)
    share = share_of_seeds(level, neighbours) * float(np.exp(0.15 * rng.standard_normal()))
    share = min(share, 1.0)
    limit = N_SEEDS if share == 1 else min(N_RAW, int(N_SEEDS / share))
    centre = noisy[rng.choice(np.flatnonzero(~clutter))]
    distance = np.linalg.norm(noisy - centre, axis=1)
    cut = len(noisy) > limit
    radius = float(np.partition(distance, limit)[limit]) if cut else np.inf
    kept = np.flatnonzero(distance < radius)
    kept = kept[spatial_order(noisy[kept])]
    noisy, clutter = noisy[kept], clutter[kept]
    near = np.linalg.norm(surface - centre, axis=1) < radius + 0.2

    def inside(points: Array) -> Mask:
        judged: Mask = np.linalg.norm(points - centre, axis=1) < 0.75 * radius
        return judged

    to_cover = np.flatnonzero(np.linalg.norm(surface - centre, axis=1) < 0.6 * radius)
    to_cover = rng.permutation(to_cover)[:N_LANDING]
    truth = surface[near], normals[near], surface[to_cover], normals[to_cover]
    estimated = level.std * float(np.exp(0.1 * rng.standard_normal()))
    scale = max(std, 0.5 * level.std, 0.1 * level.spacing, 1e-6)
    if share == 1:
        judged = inside(noisy)
        return TrainingCloud(noisy, None, None, *truth, judged & ~clutter, judged, clutter, estimated, scale)
    seeds = coarsen(noisy, share, seed=int(rng.integers(2**31)), threads=1)
    seed_judged = inside(seeds.points)
    if clutter.any():
        seed_judged &= cKDTree(noisy[clutter]).query(seeds.points)[0] > 2 * level.spacing
    landing = np.sort(rng.permutation(np.flatnonzero(inside(noisy)))[:N_LANDING])
    judged = np.ones(len(landing), dtype=bool)
    return TrainingCloud(
        seeds.points, seeds.count, noisy[landing], *truth, seed_judged, judged, clutter[landing], estimated, scale
    )


def _sampling(surface: Array, n_points: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Rows of the surface samples: uniform, or with a density that varies smoothly up to tenfold."""
    if rng.random() < 0.65:
        return rng.choice(len(surface), size=n_points, replace=False)
    kept = noise.thin(surface, rng, contrast=rng.uniform(2, 10))
    return rng.choice(kept, size=min(n_points, len(kept)), replace=False)


def _noise(clean: Array, std: float, rng: np.random.Generator) -> Array:
    """Noisy points: the same normal law everywhere at most times, a level that varies over the cloud or another law at others."""
    if rng.random() < 0.15:
        wave = np.sin(clean @ rng.standard_normal(3) * rng.uniform(0.5, 3) + rng.uniform(0, 6.3))
        varied: Array = clean + (noise.gaussian(clean, std, rng) - clean) * np.exp(0.4 * wave)[:, None]
        return varied
    law = rng.choice(list(_LAWS), p=list(_LAWS.values()))
    return noise.NOISES[law](clean, std, rng)


def _with_clutter(clean: Array, rng: np.random.Generator) -> tuple[Array, Mask]:
    """At times adds foliage (balls of points) and wires that a denoiser must leave alone."""
    n = len(clean)
    if rng.random() > 0.15:
        return clean, np.zeros(n, dtype=bool)
    spacing = np.sqrt(6.0 / n)
    parts = [clean]
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.1, 0.4)
        centre = rng.standard_normal(3) * 0.8
        step = spacing * rng.uniform(1, 3)
        if rng.random() < 0.6:
            ball = rng.standard_normal((int(min(0.3 * n, 4 * (size / step) ** 3)) + 8, 3))
            ball *= size * rng.random((len(ball), 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
            parts.append(centre + ball)
        else:
            along = np.arange(-1, 1, spacing * rng.uniform(0.3, 1.2))[:, None]
            bend = rng.standard_normal(3) * 0.2
            parts.append(centre + along * rng.standard_normal(3) * 0.7 + along**2 * bend)
    points = np.concatenate(parts)
    return points, np.arange(len(points)) >= n


def _with_outliers(noisy: Array, clutter: Mask, rng: np.random.Generator) -> tuple[Array, Mask]:
    """At times up to 2 % gross errors; they count as clutter."""
    if rng.random() > 0.2:
        return noisy, clutter
    result, wrong = noise.outliers(noisy, rng.uniform(0.001, 0.02), rng, reach=rng.uniform(0.01, 0.1))
    return result, clutter | wrong


Surfaces = list[Callable[[], tuple[Array, Array]]]
"""Training surfaces, each a function that gives (S, 3) points and (S, 3) unit normals in the unit sphere."""

PROCEDURAL = re.compile(r"shapes:([1-9]\d{0,5})")
"""How a number of procedural surfaces is asked for, here and in `pcdenoise synth`."""


def surfaces_from(data: Sequence[str], seed: int, cache: Path) -> list[Surfaces]:
    """One list for each of `data`: `shapes:N`, N procedural surfaces; a mesh; all meshes in a folder, searched to the bottom.

    Raises UsageError for data without a mesh. Samples are kept in the folder `cache`, since sampling a surface costs more than
    learning from it.
    """
    return [_surfaces(text, seed, cache / str(number)) for number, text in enumerate(data)]


def _surfaces(text: str, seed: int, cache: Path) -> Surfaces:
    cache.mkdir()
    if asked := PROCEDURAL.fullmatch(text):
        return [partial(_cached, cache / f"{n}.npy", partial(_procedural, seed, n)) for n in range(int(asked[1]))]
    path = Path(text)
    if not path.exists():
        raise ScanError(f"{text}: no such file or folder; check --data, or give shapes:400 for procedural surfaces")
    meshes = [file for file in (sorted(path.rglob("*")) if path.is_dir() else [path]) if _is_mesh(file)]
    if not meshes:
        raise UsageError(
            f"{text}: no mesh to learn from; give a folder of meshes, shapes:400, or a folder made by pcdenoise synth"
        )
    return [partial(_cached, cache / f"{n}.npy", partial(_from_mesh, file)) for n, file in enumerate(meshes)]


def _is_mesh(path: Path) -> bool:
    """By suffix; a PLY may as well be a point cloud and must say that it has faces."""
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in MESH_SUFFIXES
    with path.open("rb") as file:
        return b"element face" in file.read(8192)


def _cached(path: Path, sample: Callable[[], tuple[Array, Array]]) -> tuple[Array, Array]:
    if not path.exists():
        part = path.with_suffix(".part.npy")
        np.save(part, np.concatenate(sample(), axis=1).astype(np.float32))
        part.replace(path)
    both = np.load(path).astype(np.float64)
    return both[:, :3], both[:, 3:]


def _procedural(seed: int, number: int) -> tuple[Array, Array]:
    sample = random_surface(np.random.default_rng([seed, number]), N_DENSE)
    return sample.points, sample.normals


def _from_mesh(path: Path) -> tuple[Array, Array]:
    sample = sample_mesh(load_mesh(path), N_DENSE, np.random.default_rng(0))
    return in_unit_sphere(sample.points), sample.normals


class CloudSource:
    """An endless series of training clouds over some lists of surfaces, each list as often as the others.

    The n-th cloud depends on seed and n alone.
    """

    def __init__(self, surfaces: list[Surfaces], seed: int) -> None:
        self.surfaces, self.seed = surfaces, seed

    def cloud(self, number: int, neighbours: int) -> TrainingCloud:
        """The number-th cloud: one of the surfaces, turned at random, with its own density and noise."""
        rng = np.random.default_rng([self.seed, 7, number])
        surfaces = self.surfaces[int(rng.integers(len(self.surfaces)))]
        surface, normals = surfaces[int(rng.integers(len(surfaces)))]()
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        return draw_cloud(surface @ turn, normals @ turn, neighbours, rng)

    def clouds(self, first: int, neighbours: int, ahead: int = 6) -> Iterator[TrainingCloud]:
        """Endless clouds from the first-th on, made ahead of time by one other process."""
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as makers:
            waiting = deque(makers.submit(self.cloud, first + i, neighbours) for i in range(ahead))
            try:
                for number in count(first + ahead):
                    yield waiting.popleft().result()
                    waiting.append(makers.submit(self.cloud, number, neighbours))
            finally:
                makers.shutdown(cancel_futures=True)
