"""Noisy scans and noisy/clean pairs as training data, in parts of a bounded size and in the network's unit of length.

Not here: meshes and procedural surfaces (sources.py), targets (priors.py), losses.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcdenoise import io
from pcdenoise.cloud.neighbours import distinct, parts, spatial_order
from pcdenoise.cloud.noise_level import NoiseLevel, estimate
from pcdenoise.cloud.scan import Points, Scan
from pcdenoise.config import TrainConfig
from pcdenoise.denoising.seeds import Seeds, coarsen, share_of_seeds
from pcdenoise.errors import ScanError, UsageError
from pcdenoise.learning.ahead import CloudsAhead
from pcdenoise.learning.dataset import N_LANDING, N_RAW, N_SEEDS, PROCEDURAL
from pcdenoise.learning.priors import Prior

DATASET = "dataset.json"
FEWEST_POINTS = 100
PATCH_RADIUS = 0.05
"""Within which targets are drawn, in the network's unit of length."""


@dataclass(frozen=True)
class Part:
    """Where a part of the training data is kept: arrays points (N, 3), colour (N, 3) or (0, 3), clean (M, 3) or (0, 3)."""

    path: Path

    def load(self) -> tuple[Points, NDArray[np.float64] | None, Points | None]:
        """(N, 3) points in the network's unit, (N, 3) colours from 0 to 1, (M, 3) clean samples; None for what is not known."""
        with np.load(self.path) as arrays:
            points, colour, clean = (arrays[name].astype(np.float64) for name in ("points", "colour", "clean"))
        return points, colour if len(colour) else None, clean if len(clean) else None


@dataclass(frozen=True)
class ScanCloud:
    """One training cloud in the network's unit of length, ready for either network.

    points (N, 3); rows (Q,): of the points whose prediction is judged; targets (Q, 3), or None where `clean` (M, 3) is known.
    noise: its estimated standard deviation. seeds: the projection network's, or None where every point is its own.
    """

    points: Points
    rows: NDArray[np.int64]
    targets: Points | None
    clean: Points | None
    noise: float
    seeds: Seeds | None

    @property
    def n_points(self) -> int:
        """How many points a step on this cloud learns from."""
        return len(self.points)


def parts_from(config: TrainConfig, cache: Path) -> list[Part]:
    """Cuts all scans in `config.data` (files, folders of scans, folders made by synth) to parts and keeps them in `cache`.

    Raises UsageError when there is none, when colours or clean clouds are asked for that are not there, and when a scan is to be
    cut but the unit of length is its own diagonal.
    """
    found: list[Part] = []
    for scan_path, clean_path in files_of([Path(text) for text in config.data]):
        scan = io.read(scan_path)
        finite = scan.finite
        rows = np.flatnonzero(finite)[distinct(scan.points[finite])[0]]
        rows = rows[spatial_order(scan.points[rows])]
        if len(rows) < FEWEST_POINTS:
            continue
        colour = colours_of(scan)[rows] if config.method == "total" and config.prior == "full" else np.zeros((0, 3))
        is_supervised = config.method == "supervised"
        if is_supervised and clean_path is None:
            raise UsageError(f"{scan_path}: supervised learning needs its clean cloud; give folders made by pcdenoise synth")
        clean = io.read(clean_path).points if is_supervised and clean_path is not None else np.zeros((0, 3))
        points = scan.points[rows]
        low, high = points.min(axis=0), points.max(axis=0)
        unit = config.unit or float(np.linalg.norm(high - low)) or 1.0
        pieces = list(parts(points, config.part_points))
        if len(pieces) > 1 and config.unit is None:
            raise UsageError(
                f"{scan_path}: its {len(points):,} points are cut to parts, so the network's unit must be a length;"
                " give --unit, such as 5 for a street in metres, or a larger --part-points"
            )
        for piece in pieces:
            if len(piece) < FEWEST_POINTS:
                continue
            middle = (points[piece].min(axis=0) + points[piece].max(axis=0)) / 2
            truth = clean[_near(clean, points[piece], 2 * PATCH_RADIUS * unit)]
            if is_supervised and not len(truth):
                raise UsageError(f"{clean_path}: lies nowhere near {scan_path}; clean and noisy clouds must be of one frame")
            path = cache / f"part_{len(found)}.npz"
            np.savez(
                path,
                points=((points[piece] - middle) / unit).astype(np.float32),
                colour=colour[piece].astype(np.float32) if len(colour) else colour,
                clean=((truth - middle) / unit).astype(np.float32),
            )
            found.append(Part(path))
    if not found:
        names = ", ".join(config.data)
        raise UsageError(f"{names}: no scan with {FEWEST_POINTS} points or more; give scans, folders of scans, or synth folders")
    return found


def _near(clean: Points, points: Points, radius: float) -> NDArray[np.bool_]:
    if not len(clean):
        return np.zeros(0, dtype=bool)
    near: NDArray[np.bool_] = cKDTree(points).query(clean, distance_upper_bound=radius)[0] < np.inf
    return near


def files_of(data: list[Path]) -> Iterator[tuple[Path, Path | None]]:
    """Every scan, and its clean counterpart where a data set names one."""
    for path in data:
        index = path / DATASET
        if index.is_file():
            try:
                items = json.loads(index.read_text(encoding="utf-8"))["items"]
                yield from ((path / noisy["file"], path / item["clean"]) for item in items for noisy in item["noisy"])
            except (ValueError, KeyError, TypeError) as fault:
                raise ScanError(f"{index}: not a data set's index ({type(fault).__name__}); make it again with synth") from None
        elif path.is_dir():
            yield from ((file, None) for file in sorted(path.rglob("*")) if file.is_file() and io.is_scan(file))
        elif path.exists():
            yield path, None
        elif not PROCEDURAL.fullmatch(str(path)):
            raise ScanError(f"{path}: no such file or folder; check --data")


def noisy_and_clean(data: list[Path]) -> Iterator[tuple[Points, Points]]:
    """(N, 3) noisy and (M, 3) clean points of every pair in folders made by `pcdenoise synth`, the noisy ones' diagonal 1."""
    for noisy_path, clean_path in files_of(data):
        if clean_path is None:
            continue
        noisy, clean = (scan.points[scan.finite] for scan in (io.read(noisy_path), io.read(clean_path)))
        low, high = noisy.min(axis=0), noisy.max(axis=0)
        unit = float(np.linalg.norm(high - low)) or 1.0
        yield (noisy - low) / unit, (clean - low) / unit


def colours_of(scan: Scan) -> NDArray[np.float64]:
    """(N, 3) red, green, blue from 0 to 1, stored as bytes, as bytes in 16 bits, as 16 bits or as shares. Raises UsageError."""
    if any(name not in scan.attributes for name in ("red", "green", "blue")):
        raise UsageError(f"{scan.origin}: has no colour, which --prior full needs; use --prior space")
    stored = np.stack([scan.attributes[name] for name in ("red", "green", "blue")], axis=1)
    largest = float(stored.max(initial=0))
    full = 1.0 if stored.dtype.kind == "f" and largest <= 1 else 255.0 if largest <= 255 else 65535.0
    colours: NDArray[np.float64] = stored.astype(np.float64) / full
    return colours


class ScanSource(CloudsAhead[ScanCloud]):
    """An endless series of clouds from parts of scans, each part once per round; the n-th depends on seed and n alone."""

    def __init__(self, found: list[Part], config: TrainConfig) -> None:
        self.found, self.config = found, config

    def cloud(self, number: int, neighbours: int) -> ScanCloud:
        """The number-th cloud, with its own draw of targets. `neighbours`: the projection network's; 0 for mcconv."""
        lap, place = divmod(number, len(self.found))
        rng = np.random.default_rng([self.config.seed, 11, number])
        order = np.random.default_rng([self.config.seed, 13, lap]).permutation(len(self.found))
        points, colour, clean = self.found[order[place]].load()
        level = estimate(points, seed=self.config.seed, threads=1)
        if self.config.method == "supervised":
            targets = points
        else:
            targets = prior_of(self.config).targets(points, colour, rng)
            clean = None
        rows, seeds = np.arange(len(points)), None
        if neighbours:
            points, targets, rows, seeds = _cut(points, targets, level, neighbours, rng)
        return ScanCloud(points, rows, None if clean is not None else targets[rows], clean, level.std, seeds)


def prior_of(config: TrainConfig) -> Prior:
    """The prior that a configuration names, in the network's unit of length; `none` draws evenly from the patch."""
    kernel = "uniform" if config.prior == "none" else config.kernel
    return Prior(PATCH_RADIUS, kernel, config.alpha, config.beta, blind_spot=config.blind_spot)


def _cut(
    points: Points, targets: Points, level: NoiseLevel, neighbours: int, rng: np.random.Generator
) -> tuple[Points, Points, NDArray[np.int64], Seeds | None]:
    """What fits one step of the projection network: a ball of the points, their targets, judged rows, and seeds."""
    share = share_of_seeds(level, neighbours)
    limit = N_SEEDS if share == 1 else min(N_RAW, int(N_SEEDS / share))
    inner = np.ones(len(points), dtype=bool)
    if len(points) > limit:
        distance = np.linalg.norm(points - points[rng.integers(len(points))], axis=1)
        radius = np.partition(distance, limit)[limit]
        kept = distance < radius
        points, targets, inner = points[kept], targets[kept], distance[kept] < 0.75 * radius
    rows = np.flatnonzero(inner)
    if share == 1:
        return points, targets, rows, None
    seeds = coarsen(points, share, seed=int(rng.integers(2**31)), threads=1)
    return points, targets, np.sort(rng.permutation(rows)[:N_LANDING]), seeds
