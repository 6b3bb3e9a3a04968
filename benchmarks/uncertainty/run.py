"""Is the uncertainty right? The share of true distances within one and two of the standard deviations that cleaning writes.

    python benchmarks/uncertainty/run.py fit --shapes 10       # the constants of pcdenoise.denoising.uncertainty
    python benchmarks/uncertainty/run.py [--shapes 9] [--json FILE]

Procedural shapes, whose surface is known, under Gaussian noise of 1, 2 and 3 % of the radius, at 10K and 50K points. What is
fitted and what is tested are other shapes; the normal law says 0.683 and 0.954. Not here: the formula.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import uncertainty
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.learning.dataset import Surface
from pcdenoise.learning.supervised import NearestSurface
from pcdenoise.networks import store
from pcdenoise.synthesis.shapes import random_surface

FIT_SEED, TEST_SEED = 501, 502
LEVELS, SIZES, N_TRUTH = (0.01, 0.02, 0.03), (10_000, 50_000), 400_000
WITHIN = {1: 0.6827, 2: 0.9545}
SMALLEST = 1e-6


@dataclass(frozen=True)
class Cleaned:
    """One cloud: noise is its estimate; thickness (N,), std (N,) what is known without truth; error (N,) true distances."""

    n: int
    level: float
    noise: float
    thickness: np.ndarray
    std: np.ndarray
    error: np.ndarray

    def within(self, stds: float) -> float:
        """Share of the errors."""
        return float((self.error < stds * self.std).mean())


def clouds(seed: int, n_shapes: int, method: str) -> Iterator[Cleaned]:
    """Every shape at every level at 10K points, at one of them at 50K; clouds that show no surface are left out."""
    model = store.load() if method == "network" else None
    config = DenoiseConfig.model_validate({"threads": 1, "uncertainty": True, "method": method})
    for number in range(n_shapes):
        sample = random_surface(np.random.default_rng([seed, number]), N_TRUTH)
        truth = NearestSurface(Surface(sample.points, sample.normals, 2 * (6 / N_TRUTH) ** 0.5))
        for n in SIZES:
            clean = sample.points[:n]
            for level in LEVELS if n == SIZES[0] else LEVELS[-number % 3 - 1 :][:1]:
                noisy = clean + level * np.random.default_rng([seed, number, n]).standard_normal(clean.shape)
                result = denoise(noisy, model, config)
                if not result.figures["is_surface"]:
                    continue
                assert result.std is not None
                order = spatial_order(result.points)
                thickness = uncertainty.thickness(result.points[order], result.points, 1)
                error = truth.error(torch.from_numpy(result.points).float()).numpy()
                yield Cleaned(n, level, result.figures["noise"], thickness, result.std, error)


def fit(some: list[Cleaned]) -> tuple[float, float]:
    """Factor and exponent: the exponent by least squares of log errors within each cloud's noise, then the factor at which the
    shares within one and two standard deviations miss the normal law by as much on either side, in the mean over clouds."""
    x = np.concatenate([np.log(np.maximum(one.thickness / one.noise, SMALLEST)) for one in some])
    y = np.concatenate([np.log(np.maximum(one.error / one.noise, SMALLEST)) for one in some])
    weight = np.concatenate([np.full(len(one.error), len(one.error) ** -0.5) for one in some])
    exponent = float(np.polyfit(x, y, 1, w=weight)[0])
    ratios = [one.error / (one.noise ** (1 - exponent) * one.thickness**exponent) for one in some]
    factors = np.linspace(0.2, 1.0, 801)

    def misses(factor: float) -> float:
        return sum(abs(np.mean([(ratio < k * factor).mean() for ratio in ratios]) - share) for k, share in WITHIN.items())

    return float(min(factors, key=misses)), exponent


def main() -> None:
    """Prints the constants or the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="?", choices=("fit", "test"), default="test")
    parser.add_argument("--shapes", type=int, default=9)
    parser.add_argument("--method", choices=("network", "jet", "mean"), default="network")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    some = list(clouds(FIT_SEED if options.what == "fit" else TEST_SEED, options.shapes, options.method))
    if options.what == "fit":
        factor, exponent = fit(some)
        print(f"FACTOR, EXPONENT = {factor:.3f}, {exponent:.3f} from {len(some)} clouds")
        return
    rows: list[dict[str, Any]] = []
    print("| points, noise | clouds | within 1 std | least, most | within 2 std | least, most | std / noise |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for n in SIZES:
        for level in LEVELS:
            own = [one for one in some if (one.n, one.level) == (n, level)]
            within = {k: [cloud.within(k) for cloud in own] for k in WITHIN}
            relative = float(np.mean([np.median(cloud.std) / cloud.noise for cloud in own]))
            rows.append({"n": n, "level": level, "within_1": within[1], "within_2": within[2], "std_of_noise": relative})
            cells = " | ".join(f"{np.mean(shares):.3f} | {min(shares):.2f}, {max(shares):.2f}" for shares in within.values())
            print(f"| {n // 1000}K, {100 * level:g} % | {len(own)} | {cells} | {relative:.2f} |")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
