"""Does learning from one scan pay? The shipped model against itself adapted to a scan with structured noise, and told the noise.

    python benchmarks/adaptation/run.py [--laws quantised beam-bias] [--meshes MESH...] [--budget-s 180] [--json FILE]

Each law is put on procedural shapes, whose surface is known; each mesh is scanned by the simulated HDL-64E with a bias per
beam, and its file says of each point which beam and which pose it is from. The model learns from the noisy file alone, as in
`pcdenoise train --data scan.ply --budget 3m`, and held-out points of the scan decide whether it is kept. `told` is the shipped
model with `--noise`, as who knows the scanner would run it; `adapted` is what came back, `learned` what would have without that
judgement, `aligned` the shipped model with `--align-by beam,pose`. Truth only reports, as shares of the noise.
Not here: the adaptation (pcdenoise.learning.trainer).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pcdenoise
from pcdenoise import io
from pcdenoise.cloud.scan import Scan
from pcdenoise.config import DenoiseConfig, TrainConfig
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.learning import trainer
from pcdenoise.learning.dataset import Surface
from pcdenoise.learning.run import Run
from pcdenoise.learning.supervised import NearestSurface
from pcdenoise.networks import store
from pcdenoise.synthesis.lidar import scan_mesh
from pcdenoise.synthesis.meshes import MeshQueries, load_mesh
from pcdenoise.synthesis.noise import NOISES
from pcdenoise.synthesis.shapes import random_surface

SEED, N_TRUTH, LEVEL, RAY_STD, BIAS_STD = 91, 300_000, 0.02, 0.01, 0.005


@dataclass(frozen=True)
class Case:
    """One scan: noisy (N, 3), a function from (M, 3) points to their true distances, and columns that the file has."""

    name: str
    noisy: np.ndarray
    distance: Callable[[np.ndarray], np.ndarray]
    columns: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def noise(self) -> float:
        """Root mean square distance of the noisy points to the surface."""
        return float(np.sqrt((self.distance(self.noisy) ** 2).mean()))

    def rms(self, points: np.ndarray) -> float:
        """The same of other points, as a share of the noise."""
        return float(np.sqrt((self.distance(points) ** 2).mean())) / self.noise


def cases(laws: list[str], n_shapes: int, n_points: int, meshes: list[Path]) -> Iterator[Case]:
    """Every law on every shape, then every mesh before the scanner."""
    for law in laws:
        for number in range(n_shapes):
            sample = random_surface(np.random.default_rng([SEED, number]), N_TRUTH)
            truth = NearestSurface(Surface(sample.points, sample.normals, 2 * (6 / N_TRUTH) ** 0.5))
            noisy = NOISES[law](sample.points[:n_points], LEVEL, np.random.default_rng([SEED, 1, number]))
            yield Case(f"{law}, shape {number}", noisy, lambda points, t=truth: t.error(torch.from_numpy(points).float()).numpy())
    for path in meshes:
        mesh = load_mesh(path)
        scan = scan_mesh(mesh, np.random.default_rng(SEED), ray_std=RAY_STD, bias_std=BIAS_STD)
        queries = MeshQueries(mesh)
        columns = {"beam": scan.beam.astype("u1"), "pose": scan.pose.astype("u1")}
        yield Case(f"lidar, {path.stem}", scan.points, lambda points, q=queries: q.closest(points).distance, columns)


def trial(case: Case, folder: Path, budget_s: float | None, steps: int | None) -> dict[str, Any]:
    """Errors as shares of the noise: shipped, told, adapted (as judged without truth), learned (whatever the judgement)."""
    scan, output = folder / "scan.ply", folder / "model"
    io.write(Scan(case.noisy, case.columns, format="ply"), scan)
    measured = io.read(scan)
    config = DenoiseConfig(threads=1)
    guessed = denoise(case.noisy, store.load(), config)
    told = denoise(case.noisy, store.load(), config.model_copy(update={"noise": case.noise}))
    about = {"scan": case.name, "points": len(case.noisy), "noise": case.noise, "noise_read": guessed.figures["noise"]}
    about |= {"shipped": case.rms(guessed.points), "told": case.rms(told.points), "aligned": None}
    if case.columns:
        about["aligned"] = case.rms(pcdenoise.denoise(measured, align_by=tuple(case.columns), threads=1).points)
    if steps == 0:
        return {**about, "steps": 0, "adapted": None, "learned": None, "verdict": "nothing was learned"}
    judge = Run.judge

    def remembering(run: Run, *given: Any) -> None:
        store.save(run.average, folder / "learned", summary="", training={}, scores={}, card="")
        judge(run, *given)

    Run.judge = remembering  # type: ignore[method-assign]
    try:
        summary = trainer.train(TrainConfig(data=(str(scan),), budget_s=budget_s, steps=steps, threads=1), output)
    finally:
        Run.judge = judge  # type: ignore[method-assign]
    adapted, learned = (case.rms(pcdenoise.denoise(measured, place, threads=1).points) for place in (output, folder / "learned"))
    about |= {"steps": summary.steps, "seconds": round(summary.seconds, 1)}
    return {**about, "adapted": adapted, "learned": learned, "verdict": summary.verdict}


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--laws", nargs="*", choices=sorted(NOISES), default=["quantised", "beam-bias"])
    parser.add_argument("--meshes", type=Path, nargs="*", default=[], help="to be scanned by the lidar")
    parser.add_argument("--shapes", type=int, default=2)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--budget-s", type=float)
    parser.add_argument("--steps", type=int, help="0: only the shipped model, and told the noise")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.budget_s is None and options.steps is None:
        options.budget_s = 180.0
    rows = []
    print(
        "| scan | noise, as read | shipped | told | aligned | steps | adapted | learned | verdict |" + "\n" + "| --- " * 9 + "|"
    )
    for case in cases(options.laws, options.shapes, options.points, options.meshes):
        with tempfile.TemporaryDirectory() as folder:
            row = trial(case, Path(folder), options.budget_s, options.steps)
        rows.append(row)
        errors = ("shipped", "told", "aligned", "adapted", "learned")
        shown = {name: "–" if row[name] is None else f"{row[name]:.3f}" for name in errors}
        noise = f"{row['noise']:.4f}, {row['noise_read']:.4f}"
        print(
            f"| {row['scan']} | {noise} | {shown['shipped']} | {shown['told']} | {shown['aligned']} | {row['steps']} |"
            f" {shown['adapted']} | {shown['learned']} | {row['verdict']} |",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
