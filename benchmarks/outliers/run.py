"""Precision and recall of the outlier search: injected ones on procedural shapes, labelled ones in LAS files.

    python benchmarks/outliers/run.py [--scans SCAN...] [--json FILE]

Injected: rows replaced by points strewn around the shape or flown off their own place (synthesis.noise.outliers). Those that
happen to land within 5 noise stds or a fifth of the reach of the surface are indistinguishable from noise; the column
`recall, far` leaves them out. Labelled: LAS classes 7 (low noise) and 18 (high noise), whose points were judged by people for
whatever reason. Nothing is tuned on either. Not here: the detector (pcdenoise.denoising.outliers).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pcdenoise import io
from pcdenoise.cloud.neighbours import knn
from pcdenoise.denoising import outliers
from pcdenoise.synthesis import noise
from pcdenoise.synthesis.shapes import random_surface

SEED, N_TRUTH = 81, 200_000
SHARES, REACHES, LEVEL = (0.001, 0.01, 0.05), (0.02, 0.1), 0.01
NOISE_CLASSES = (7, 18)
STDS_OF_NOISE, REACH_SHARE, REACH_POINTS = 5.0, 0.2, 12
"""What is nearer to the surface is noise to any observer; see the limits in pcdenoise.denoising.outliers."""


def counts(found: np.ndarray, wrong: np.ndarray) -> dict[str, int]:
    """True positives, all found, all wrong."""
    return {"hits": int((found & wrong).sum()), "found": int(found.sum()), "wrong": int(wrong.sum())}


def shares(row: dict[str, Any]) -> dict[str, Any]:
    """The row with precision and recall, empty where nothing was found or nothing is wrong."""
    precision = row["hits"] / row["found"] if row["found"] else None
    return {**row, "precision": precision, "recall": row["hits"] / row["wrong"] if row["wrong"] else None}


def injected(n_shapes: int, n_points: int) -> list[dict[str, Any]]:
    """One row for each share and reach, over all shapes together."""
    rows = []
    samples = [random_surface(np.random.default_rng([SEED, number]), N_TRUTH).points for number in range(n_shapes)]
    for reach in REACHES:
        for share in SHARES:
            total = {"hits": 0, "found": 0, "wrong": 0, "far": 0, "hits_far": 0}
            for number, truth in enumerate(samples):
                rng = np.random.default_rng([SEED, 1, number])
                noisy = noise.gaussian(truth[:n_points], LEVEL, rng)
                limit = max(STDS_OF_NOISE * LEVEL, REACH_SHARE * float(np.median(knn(noisy, REACH_POINTS + 1)[0][:, -1])))
                points, wrong = noise.outliers(noisy, share, rng, reach=reach)
                found = outliers.find(points, threads=1)
                far = wrong & (cKDTree(truth).query(points)[0] > limit)
                total = {name: total[name] + n for name, n in counts(found, wrong).items()} | {
                    "far": total["far"] + int(far.sum()),
                    "hits_far": total["hits_far"] + int((found & far).sum()),
                }
            row = shares({"what": f"{100 * share:g} % within {reach:g} diagonals", **total})
            rows.append({**row, "recall_far": total["hits_far"] / total["far"] if total["far"] else None})
    return rows


def labelled(path: Path) -> dict[str, Any]:
    """The row of one LAS file; one without points of the noise classes tells of false alarms only."""
    scan = io.read(path)
    wrong = np.isin(scan.attributes["classification"], NOISE_CLASSES)
    return shares({"what": f"{path.name}, {len(scan):,} points", **counts(outliers.find(scan.points, threads=1), wrong)})


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=6)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--scans", type=Path, nargs="*", default=[], help="LAS or LAZ with classes 7 or 18")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = [*injected(options.shapes, options.points), *map(labelled, options.scans)]
    print("| outliers | wrong | found | precision | recall | recall, far |\n| --- | --- | --- | --- | --- | --- |")
    for row in rows:
        figures = ("–" if row.get(name) is None else f"{row[name]:.3f}" for name in ("precision", "recall", "recall_far"))
        print(f"| {row['what']} | {row['wrong']:,} | {row['found']:,} | {' | '.join(figures)} |")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
