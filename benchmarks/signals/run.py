"""Every training signal on the same noisy clouds, network and number of steps, judged on shapes that none of them saw.

    python benchmarks/signals/run.py [--steps 200] [--json FILE] [--work DIR]

A data set of procedural shapes is made, noisy and clean. `supervised` learns from its pairs; `distill`, `split` and `total` see
its noisy files alone; `surfaces` is the ceiling: supervised by the exact surfaces of as many shapes, with fresh noise at every
step. Each starts from nothing, whose own error is the first row. Not here: the signals (pcdenoise.learning).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdenoise import commands
from pcdenoise.config import DenoiseConfig, TrainConfig
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.learning import trainer
from pcdenoise.learning.dataset import Surface
from pcdenoise.learning.run import TrainingSummary
from pcdenoise.learning.supervised import NearestSurface
from pcdenoise.networks import store
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork
from pcdenoise.synthesis.shapes import random_surface

SIGNALS = ("supervised", "distill", "split", "total", "surfaces")
LEVELS = (0.01, 0.02, 0.03)
TRAINING_SEED, JUDGING_SEED = 71, 72
N_TRUTH = 300_000


def judged_shapes(n: int, n_points: int) -> list[tuple[NearestSurface, np.ndarray]]:
    """The exact surface and (N, 3) clean points of shapes in the unit sphere, from a seed that nothing learns from."""
    found = []
    for number in range(n):
        sample = random_surface(np.random.default_rng([JUDGING_SEED, number]), N_TRUTH)
        surface = Surface(sample.points, sample.normals, 2 * (6 / N_TRUTH) ** 0.5)
        found.append((NearestSurface(surface), sample.points[:n_points]))
    return found


def scores(model: store.Model, shapes: list[tuple[NearestSurface, np.ndarray]]) -> dict[str, float]:
    """Mean squared distance to the surface by level of noise, 1e-4 in the unit sphere."""
    found = {}
    for level in LEVELS:
        squared = []
        for number, (truth, clean) in enumerate(shapes):
            noisy = clean + level * np.random.default_rng([JUDGING_SEED, 1, number]).standard_normal(clean.shape)
            moved = denoise(noisy, model, DenoiseConfig(threads=1)).points
            squared.append(float(truth.error(torch.from_numpy(moved).float()).square().mean()))
        found[f"{level:g}"] = 1e4 * float(np.mean(squared))
    return found


def learned(signal: str, data: str, n_shapes: int, steps: int, folder: Path) -> TrainingSummary:
    """One training run from nothing into a model folder."""
    own: dict[str, Any] = {"method": "supervised" if signal == "surfaces" else signal}
    own |= {"data": (f"shapes:{n_shapes}",)} if signal == "surfaces" else {"data": (data,), "pairs": signal == "supervised"}
    return trainer.train(TrainConfig(steps=steps, seed=TRAINING_SEED, threads=1, **own), folder, init=trainer.FROM_NOTHING)


def main() -> None:
    """Trains, judges and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--shapes", type=int, default=16, help="to learn from")
    parser.add_argument("--cloud-points", type=int, default=20_000, help="of a cloud to learn from")
    parser.add_argument("--judged", type=int, default=8, help="shapes to judge on")
    parser.add_argument("--points", type=int, default=10_000, help="of a judged cloud")
    parser.add_argument("--signals", nargs="*", choices=SIGNALS, default=SIGNALS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--work", type=Path, help="keep data and models here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        data = str(work / "data")
        if not (work / "data" / "dataset.json").exists():
            made = [
                "synth",
                f"shapes:{options.shapes}",
                "-o",
                data,
                "--points",
                str(options.cloud_points),
                "--levels",
                "0.4,0.8,1.2",
            ]
            commands.main([*made, "--seed", str(TRAINING_SEED), "--quiet"])
        shapes = judged_shapes(options.judged, options.points)
        untrained = work / "untrained"
        sizes = TrainConfig()
        network = ProjectionNetwork(ProjectionConfig(sizes.channels, sizes.neighbours, sizes.rounds, sizes.landing_rounds))
        store.save(network, untrained, summary="untrained", training={}, scores={}, card="")
        rows = [{"signal": "untrained", "steps": 0, "seconds": 0.0, **scores(store.load(untrained), shapes)}]
        print(f"| signal | {' | '.join(f'{100 * level:g} %' for level in LEVELS)} | s |\n| --- |{' --- |' * (len(LEVELS) + 1)}")
        for signal in options.signals:
            print(_line(rows[-1]), flush=True)
            summary = learned(signal, data, options.shapes, options.steps, work / signal)
            about = {"signal": signal, "steps": summary.steps, "seconds": round(summary.seconds, 1)}
            rows.append({**about, **scores(store.load(work / signal), shapes)})
        print(_line(rows[-1]))
    if options.json:
        options.json.write_text(json.dumps({"points": options.points, "judged": options.judged, "rows": rows}, indent=1) + "\n")


def _line(row: dict[str, Any]) -> str:
    return f"| {row['signal']} | {' | '.join(f'{row[str(level)]:.3f}' for level in LEVELS)} | {row['seconds']:.0f} |"


if __name__ == "__main__":
    main()
