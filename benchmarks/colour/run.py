"""How much colour noise `denoise --colour` takes off, on procedural shapes lit from three sides, whose colours have edges.

    python benchmarks/colour/run.py [--shapes 4] [--json FILE]

Error is the root mean square over channels, of 255. `edges` are the tenth of the points whose true colours differ most from
the mean of their 16 neighbours'; `mean of 16` is what a filter without edges leaves. Not here: the filter.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from pcdenoise.cloud.neighbours import knn
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.colour import smoothed
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.networks import store
from pcdenoise.synthesis.meshes import lambert_rgb
from pcdenoise.synthesis.shapes import random_surface

SEED, LEVEL, STDS = 95, 0.01, (4, 8, 16)
N_MEAN, EDGE_SHARE = 16, 0.1


def errors(number: int, n_points: int, model: store.Model) -> list[dict[str, float]]:
    """The errors of one shape at each level of colour noise."""
    rng = np.random.default_rng([SEED, number])
    sample = random_surface(rng, n_points)
    truth = lambert_rgb(sample.normals, rng).astype(np.float64)
    points = denoise(sample.points + rng.normal(0, LEVEL, sample.points.shape), model, DenoiseConfig(threads=1)).points
    contrast = np.abs(truth[knn(sample.points, N_MEAN, threads=1)[1]].mean(axis=1) - truth).max(axis=1)
    edges = contrast >= np.quantile(contrast, 1 - EDGE_SHARE)
    rows = []
    for std in STDS:
        noisy = np.clip(np.rint(truth + rng.normal(0, std, truth.shape)), 0, 255).astype(np.uint8)
        results = {
            "noisy": noisy.astype(np.float64),
            "mean of 16": noisy[knn(points, N_MEAN, threads=1)[1]].mean(axis=1),
            "--colour": smoothed(points, noisy, 1).astype(np.float64),
        }
        row = {"std": float(std)}
        for name, result in results.items():
            squared = ((result - truth) ** 2).mean(axis=1)
            row |= {name: float(squared.mean() ** 0.5), f"{name}, edges": float(squared[edges].mean() ** 0.5)}
        rows.append(row)
    return rows


def main() -> None:
    """Prints a table of means over shapes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=4)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = [errors(number, options.points, store.load()) for number in range(options.shapes)]
    table = [{name: float(np.mean([row[i][name] for row in found])) for name in found[0][i]} for i in range(len(STDS))]
    names = [name for name in table[0] if name != "std"]
    print(f"| noise | {' | '.join(names)} |\n| --- |{' --- |' * len(names)}")
    for row in table:
        print(f"| {row['std']:g} | {' | '.join(f'{row[name]:.1f}' for name in names)} |")
    if options.json:
        options.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
