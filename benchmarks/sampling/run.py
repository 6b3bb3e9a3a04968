"""Uneven sampling: the shipped model and jets on clouds whose density varies tenfold, and on even ones of as many points.

    python benchmarks/sampling/run.py [--shapes 5] [--json FILE]

Procedural shapes, whose surface is known, under Gaussian noise. Error: mean squared distance to the surface, 1e-4 in the unit
sphere; `sparse` and `dense`: of the tenth of the points with the largest and the smallest reach. Not here: the methods.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdenoise.cloud.neighbours import knn
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.learning.dataset import Surface
from pcdenoise.learning.supervised import NearestSurface
from pcdenoise.networks import store
from pcdenoise.synthesis.noise import thin
from pcdenoise.synthesis.shapes import random_surface

SEED, N_TRUTH, CONTRAST, LEVELS = 96, 300_000, 10.0, (0.01, 0.02)
REACH_POINTS, SHARE = 12, 0.1
METHODS = ("network", "jet")


def errors(number: int, n_points: int) -> list[dict[str, Any]]:
    """A row for each sampling, level and method on one shape."""
    sample, rng = random_surface(np.random.default_rng([SEED, number]), N_TRUTH), np.random.default_rng([SEED, 1, number])
    truth = NearestSurface(Surface(sample.points, sample.normals, 2 * (6 / N_TRUTH) ** 0.5))
    thinned = thin(sample.points, rng, CONTRAST)
    chosen = {
        "even": rng.choice(N_TRUTH, n_points, replace=False),
        "tenfold": rng.choice(thinned, min(n_points, len(thinned)), replace=False),
    }
    rows = []
    for sampling, which in chosen.items():
        clean = sample.points[which]
        reach = knn(clean, REACH_POINTS, threads=1)[0][:, -1]
        parts = {"sparse": reach >= np.quantile(reach, 1 - SHARE), "dense": reach <= np.quantile(reach, SHARE)}
        for level in LEVELS:
            noisy = clean + level * rng.standard_normal(clean.shape)
            for method in METHODS:
                model = store.load() if method == "network" else None
                moved = denoise(noisy, model, DenoiseConfig.model_validate({"threads": 1, "method": method})).points
                squared = truth.error(torch.from_numpy(moved).float()).numpy() ** 2
                named = {"all": squared, **{name: squared[part] for name, part in parts.items()}}
                means = {name: 1e4 * float(values.mean()) for name, values in named.items()}
                rows.append({"sampling": sampling, "level": level, "method": method, **means})
    return rows


def main() -> None:
    """Prints a table of means over shapes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=5)
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = [errors(number, options.points) for number in range(options.shapes)]
    names = ("all", "sparse", "dense")
    table = [
        {**rows[0], **{name: float(np.mean([row[name] for row in rows])) for name in names}} for rows in zip(*found, strict=True)
    ]
    print("| density | noise | method | all | sparse | dense |\n| --- | --- | --- | --- | --- | --- |")
    for row in table:
        figures = " | ".join(f"{row[name]:.3f}" for name in names)
        print(f"| {row['sampling']} | {100 * row['level']:g} % | {row['method']} | {figures} |")
    if options.json:
        options.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
