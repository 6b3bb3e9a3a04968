"""What the tests of the core share: clouds of known truth and models that need no training. Not a test itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pcdenoise.networks.store import Model
from pcdenoise.synthesis import shapes

SURFACES = {
    "plane": shapes.plane(2.0),
    "sphere": shapes.sphere(1.0),
    "cylinder": shapes.cylinder(0.6, 2.0),
    "torus": shapes.torus(1.0, 0.4),
    "cube": shapes.cube(2.0),
}
UTM = np.array([5e5, 4.9e6, 120.0])


@dataclass(frozen=True)
class Cloud:
    """A noisy sample of a known surface; spacing is the side of the square that each of its points has to itself."""

    surface: shapes.AnalyticSurface
    clean: np.ndarray
    noisy: np.ndarray
    spacing: float

    def error(self, points: np.ndarray) -> float:
        """Root mean square distance to the surface."""
        return rms(self.surface.signed_distance(points))


def cloud(name: str, n: int, std_spacings: float, seed: int = 0) -> Cloud:
    """n points uniform by area with Gaussian noise along all axes, its standard deviation a multiple of the spacing."""
    rng = np.random.default_rng([seed, n])
    surface = SURFACES[name]
    clean, spacing = surface.sample(n, rng).points, float(np.sqrt(surface.area / n))
    return Cloud(surface, clean, clean + std_spacings * spacing * rng.standard_normal((n, 3)), spacing)


def varied(sample: Cloud, quietest: float, noisiest: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) the clean points with the sample's noise times (N,) a factor that grows with x, from the one to the other."""
    x = sample.clean[:, 0]
    times = quietest * (noisiest / quietest) ** ((x - x.min()) / np.ptp(x))
    return sample.clean + times[:, None] * (sample.noisy - sample.clean), times


def ball(n: int, rng: np.random.Generator) -> np.ndarray:
    """n points strewn evenly through the unit ball: a volume, no surface."""
    points = rng.standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * rng.random((n, 1)) ** (1 / 3)


def rotation(rng: np.random.Generator) -> np.ndarray:
    """A random proper rotation (3, 3)."""
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return turn * np.linalg.det(turn)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def moves(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(N,) how far each row went."""
    return np.linalg.norm(after - before, axis=1)


@cache
def model(kind: str) -> Model:
    """'untrained': the zero head, a classical filter; 'seeded': a random head, so that every weight of the network counts;
    'wide': the same with messages of 48 channels; 'mcconv': the paper's network with random weights."""
    import torch

    from pcdenoise.networks.mcconv import PAPER, MCConvNetwork
    from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

    with torch.inference_mode(False), torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(11)
        if kind == "mcconv":
            return Model.of(MCConvNetwork(PAPER), kind)
        network = ProjectionNetwork(ProjectionConfig(landing_rounds=2, messages=48 if kind == "wide" else 0))
        for stage in [*network.among, network.landing] if kind in ("seeded", "wide") else []:
            stage.step.head.weight.normal_(std=0.1)
    return Model.of(network, kind)
