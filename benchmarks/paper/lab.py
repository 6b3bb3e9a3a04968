"""Who cleans, what it learned from, and how far its passes come: trained and judged once, kept in the output folder.

Not here: meshes and clouds (data.py), which experiments there are (experiments.py).
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from data import LEVELS, Item, Law, Shapes, items, write_dataset
from pointnet import CleanPairs, PatchNet, learn, one_pass

from pcdenoise.cloud.neighbours import coordinate_hash
from pcdenoise.cloud.noise_level import estimate
from pcdenoise.cloud.scan import Points
from pcdenoise.config import DenoiseConfig, TrainConfig
from pcdenoise.denoising import classical, denoiser
from pcdenoise.denoising.risk import Risk
from pcdenoise.evaluation.chamfer import point_errors
from pcdenoise.learning.scans import noisy_and_clean
from pcdenoise.learning.trainer import train
from pcdenoise.learning.upgrade import PseudoCleanPairs
from pcdenoise.networks import store
from pcdenoise.synthesis.meshes import Mesh

FIXED_PASSES = {"mcconv": 3, "pointnet": 3}
"""After how many passes the error at a fixed iteration is taken: so many where it is the paper's way to repeat, else one."""
TRAINED = ("mcconv", "projection", "pointnet")
_TUNED_ON = 3
"""Noisy clouds of a training set that a filter is tuned on: one of each level, each of another shape."""
_PATCHES_PER_CLOUD = 4
"""Steps of the patch network, which sees 256 points in each, for one step of a network that sees all."""

Method = Literal["mcconv", "projection", "pointnet", "mean", "bilateral", "jet"]
Signal = Literal["none", "space", "full", "supervised"]
Errors = list[dict[str, Any]]
"""One for each test cloud: shape, level, passes (error before the first and after each pass, in % of the diagonal), auto."""


@dataclass(frozen=True)
class Scale:
    """How large everything is. steps: clouds that a network learns from; passes: most that are judged.

    By default as large as lets every table be done within two hours of one processor core.
    """

    points: int = 2500
    train_shapes: int = 6
    test_shapes: int = 3
    steps: int = 120
    passes: int = 4


@dataclass(frozen=True)
class Subject:
    """A filter, or a network with what it learned from. shapes: the share of the training set's, or all; level: one, or all."""

    method: Method
    signal: Signal = "supervised"
    kernel: str = "gaussian"
    alpha: float | None = None
    shapes: float | None = None
    level: float | None = None
    law: Law = "gaussian"
    boxes: bool = False

    @property
    def name(self) -> str:
        """A file name that says all of it."""
        parts = asdict(self)
        if self.method not in TRAINED:
            parts |= {"signal": None, "kernel": None}
        parts["boxes"] = "boxes" if self.boxes else None
        return "-".join(f"{part:.3g}" if isinstance(part, float) else part for part in parts.values() if part is not None)


class Lab:
    """Trains, cleans and judges at one scale; everything is kept in `folder` and made once."""

    def __init__(self, folder: Path, scale: Scale, shapes: Shapes, threads: int = 1) -> None:
        self.scale, self.shapes, self.threads = scale, shapes, threads
        settings = {**asdict(scale), "meshes": str(shapes.folder or "generated")}
        self.folder = folder / "cache" / hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:10]
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "scale.json").write_text(json.dumps(settings) + "\n")
        self.test_items, self._train_items = cache(self._test_items), cache(self._items_to_learn)

    def judged(self, subject: Subject, seed: int) -> Errors:
        """How the passes of a subject err on every test cloud of its law; training and noise have the seed."""
        path = self.folder / "errors" / f"{subject.name}-{seed}.json"
        if not path.exists():
            self._say(f"judging {subject.name}, seed {seed}")
            rows: Errors = []
            for item in self.test_items(subject.law, subject.boxes, seed):
                for level, noisy in item.noisy.items():
                    clouds, auto = self.passes(subject, seed, noisy.points)
                    errors = [paper_error(points, item) for points in clouds]
                    rows.append({"shape": item.name, "level": level, "passes": errors, "auto": auto})
            path.parent.mkdir(exist_ok=True)
            path.write_text(json.dumps(rows) + "\n")
        found: Errors = json.loads(path.read_text())
        return found

    def passes(self, subject: Subject, seed: int, points: Points) -> tuple[list[Points], int]:
        """A cloud before the first and after every pass, and after which one the automatic stop, which has no truth, stops."""
        steps = self._patch_steps(subject, seed, points) if subject.method == "pointnet" else self._steps(subject, seed, points)
        clouds, auto, spacing, goes_on = [points], 0, estimate(points, seed, self.threads).spacing, True
        for moved, before, after in steps:
            clouds.append(moved)
            goes_on = goes_on and denoiser.is_worthwhile(before, after, spacing)
            auto += goes_on
        return clouds, auto

    def _steps(self, subject: Subject, seed: int, points: Points) -> Iterator[tuple[Points, float, float]]:
        model, settings = None, {}
        if subject.method in TRAINED:
            model = store.load(str(self.model(subject, seed)))
        else:
            settings = {"method": subject.method, **self.tuned(subject, seed)}
        config = DenoiseConfig(iters=self.scale.passes, seed=seed, threads=self.threads, **settings)
        steps = denoiser.iterate(points, model, config)
        return ((step.points, step.figures["estimated_error_before"], step.figures["estimated_error_after"]) for step in steps)

    def _patch_steps(self, subject: Subject, seed: int, points: Points) -> Iterator[tuple[Points, float, float]]:
        """As `denoiser.iterate` goes, for a network that pcdenoise does not know."""
        network, diagonal = PatchNet(), float(np.linalg.norm(np.ptp(points, axis=0)))
        network.load_state_dict(torch.load(self.model(subject, seed) / "weights.pt", weights_only=True))
        risk = Risk(points, coordinate_hash(points, 0), estimate(points, seed, self.threads), seed, self.threads)
        for _ in range(self.scale.passes):
            before, after = risk.after(lambda some: one_pass(network, some, diagonal))
            yield risk.points, before, after

    def tuned(self, subject: Subject, seed: int) -> dict[str, float]:
        """Settings of a filter that are best on the training set."""
        path = self.folder / "tuned" / f"{subject.name}-{seed}.json"
        if not path.exists():
            self._say(f"tuning {subject.name}, seed {seed}")
            pairs = list(noisy_and_clean([self._dataset(subject, seed)]))[:: len(LEVELS) + 1][:_TUNED_ON]
            found = classical.tune(pairs, subject.method, threads=self.threads)
            path.parent.mkdir(exist_ok=True)
            path.write_text(json.dumps({"neighbours" if name == "k" else name: value for name, value in found.items()}))
        settings: dict[str, float] = json.loads(path.read_text())
        return settings

    def model(self, subject: Subject, seed: int) -> Path:
        """The folder of a trained network."""
        folder = self.folder / "models" / f"{subject.name}-{seed}"
        if not folder.exists():
            self._say(f"training {subject.name}, seed {seed}")
            part = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(part, ignore_errors=True)
            if subject.method == "pointnet":
                self._learn_patches(subject, seed, part)
            else:
                train(self._training(subject, seed), part, init="none")
            part.rename(folder)
        return folder

    def along_training(self, subject: Subject, seed: int, marks: Sequence[int]) -> list[float]:
        """Mean error on the test clouds, at the fixed iteration, of a network after so many of its steps."""
        path = self.folder / "errors" / f"along-{subject.name}-{seed}.json"
        if not path.exists():
            self._say(f"training {subject.name}, seed {seed}, with pauses")
            part, errors = path.with_name(f"{path.name}.part"), []
            shutil.rmtree(part, ignore_errors=True)
            for number, mark in enumerate(marks):
                pause = _Pause(mark / self.scale.steps)
                with suppress(_Paused):
                    train(self._training(subject, seed), part, init="none", resume=number > 0, on_progress=pause.check)
                errors.append(self._error_of(store.load(str(part)), subject, seed))
            shutil.rmtree(part)
            path.parent.mkdir(exist_ok=True)
            path.write_text(json.dumps(errors))
        found: list[float] = json.loads(path.read_text())
        return found

    def _error_of(self, model: store.Model, subject: Subject, seed: int) -> float:
        config = DenoiseConfig(iters=fixed_passes(subject), seed=seed, threads=self.threads)
        items = self.test_items(subject.law, subject.boxes, seed)
        return float(
            np.mean(
                [
                    paper_error(denoiser.denoise(noisy.points, model, config).points, item)
                    for item in items
                    for noisy in item.noisy.values()
                ]
            )
        )

    def _training(self, subject: Subject, seed: int) -> TrainConfig:
        data = (str(self._dataset(subject, seed)),)
        common = {"network": subject.method, "data": data, "steps": self.scale.steps, "seed": seed, "threads": self.threads}
        if subject.signal == "supervised":
            return TrainConfig(method="supervised", pairs=True, **common)
        return TrainConfig(method="total", prior=subject.signal, kernel=subject.kernel, alpha=subject.alpha, **common)

    def _learn_patches(self, subject: Subject, seed: int, folder: Path) -> None:
        made = self._train_items(subject.law, subject.boxes, seed)
        clouds = [(noisy.points, item.clean.points) for item in made for noisy in item.noisy.values()]
        pairs: CleanPairs | PseudoCleanPairs = CleanPairs(clouds, seed)
        if subject.signal != "supervised":
            pairs = PseudoCleanPairs([noisy for noisy, _ in clouds], seed=seed)
        torch.manual_seed(seed)
        torch.set_num_threads(self.threads)
        network = PatchNet()
        learn(network, pairs, _PATCHES_PER_CLOUD * self.scale.steps, seed)
        folder.mkdir(parents=True)
        torch.save(network.state_dict(), folder / "weights.pt")

    def _dataset(self, subject: Subject, seed: int) -> Path:
        """The folder that a subject learns from: the whole training set of a seed, or a part of it."""
        whole = replace(Subject("mean"), law=subject.law, boxes=subject.boxes, shapes=subject.shapes, level=subject.level)
        folder = self.folder / "data" / f"{whole.name}-{seed}"
        if not (folder / "dataset.json").exists():
            made = self._train_items(subject.law, subject.boxes, seed)
            made = made[: max(1, round((subject.shapes or 1) * len(made)))]
            if subject.level is not None:
                made = [replace(item, noisy={subject.level: item.noisy[subject.level]}) for item in made]
            write_dataset(made, folder)
        return folder

    def _items_to_learn(self, law: Law, boxes: bool, seed: int) -> list[Item]:
        meshes = self.shapes.meshes(self.scale.train_shapes, test=False, n_test=self.scale.test_shapes, boxes=boxes)
        return items(meshes, law, LEVELS, self.scale.points, [seed, 0])

    def _test_items(self, law: Law, boxes: bool, seed: int) -> list[Item]:
        meshes = self.shapes.meshes(self.scale.test_shapes, test=True, n_test=self.scale.test_shapes, boxes=boxes)
        return items(meshes, law, LEVELS, self.scale.points, [seed, 1])

    def _say(self, words: str) -> None:
        print(words, flush=True)


def fixed_passes(subject: Subject) -> int:
    """How many passes the error at a fixed iteration is taken after."""
    return FIXED_PASSES.get(subject.method, 1)


def paper_error(points: Points, item: Item) -> float:
    """Mean distance prediction to mesh plus clean samples to prediction, in % of the mesh's diagonal: `td` of evaluate."""
    mesh: Mesh = item.mesh
    there, back = point_errors(points, mesh=mesh).mean(), point_errors(item.clean.points, clean=points).mean()
    return 100 * float(there + back) / mesh.diagonal


class _Paused(Exception):
    """A training has come as far as it was to come; it can be resumed."""


@dataclass(frozen=True)
class _Pause:
    """until: share of the training after which it pauses."""

    until: float

    def check(self, _words: str, progress: float) -> None:
        if self.until <= progress < 1:
            raise _Paused
