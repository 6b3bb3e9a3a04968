"""What each network does in a pass: from points in spatial order to where it moves them.

Torch is imported only where it is needed: by mcconv, and by the projection network where there is no compiled code for it.
Not here: what is done about a pass (denoiser.py), the networks (networks).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from pcdenoise.cloud.neighbours import Identity
from pcdenoise.cloud.noise_level import NoiseLevel, by_place
from pcdenoise.cloud.scan import Points
from pcdenoise.denoising.seeds import Seeds, coarsen, share_of_seeds, times_noisier
from pcdenoise.networks import fused
from pcdenoise.networks.store import Model, ProjectionSettings

OnShare = Callable[[float], None]
"""Called with the share of a pass that is done, 0 to 1."""

_DECODED_AT_ONCE = 65_536


def projection(
    points: Points,
    identity: Identity,
    level: NoiseLevel,
    model: Model,
    seeds: Sequence[int],
    threads: int,
    on_share: OnShare,
) -> tuple[Points, NDArray[np.float64]]:
    """Coarse to fine in O(N·K): seeds find the surface, all points land on it, as far as there is one.

    identity (N,): what seeds are drawn by, once for each of the numbers `seeds`. Gives the mean of where they lead and the noise
    (N,) that was found around each point.
    """
    sizes = model.config.settings
    assert isinstance(sizes, ProjectionSettings)
    share = share_of_seeds(level, sizes.neighbours)
    noise = by_place(points, identity, level, threads)
    noisier = None if level.is_known else times_noisier(noise, level, sizes.neighbours)

    def moved(seed: int, on_share: OnShare) -> Points:
        coarse = coarsen(points, share, seed, threads, identity, noisier) if share < 1 else None
        return _descended(points, coarse, noise, level, model, threads, on_share)

    return _mean(moved, seeds if share < 1 else seeds[:1], on_share), noise  # where every point is its own seed none are drawn


def _mean(moved: Callable[[int, OnShare], Points], seeds: Sequence[int], on_share: OnShare) -> Points:
    """(N, 3) mean of where each of these seeds leads, two results in memory at a time."""
    mean: Points = np.zeros((1, 3))
    for number, seed in enumerate(seeds):

        def on_share_of_all(done: float, number: int = number) -> None:
            on_share((number + done) / len(seeds))

        mean = mean + (moved(seed, on_share_of_all) - mean) / (number + 1)
    return mean


def _descended(
    points: Points,
    coarse: Seeds | None,
    noise: NDArray[np.float64],
    level: NoiseLevel,
    model: Model,
    threads: int,
    on_share: OnShare,
) -> Points:
    """(N, 3) where points land on these seeds, or where they lead each other if there are none."""
    sizes = model.config.settings
    assert isinstance(sizes, ProjectionSettings)
    seeds, count, cell, raw, seed_noise = points, None, np.arange(len(points)), None, noise
    if coarse is not None:
        seeds, count, cell, raw, seed_noise = coarse.points, coarse.count, coarse.cell, points, coarse.means(noise)
    total = len(seeds) * sum(sizes.rounds) + (0 if raw is None else len(raw) * sizes.landing_rounds)
    done, counting = 0, Lock()

    def on_block(n: int) -> None:
        nonlocal done
        with counting:
            done += n
            on_share(done / total)

    if fused.fits(sizes):
        given = (model.weights, sizes, seeds, count, raw, seed_noise, noise)
        moved, shape = fused.descend(*given, threads=threads, on_block=on_block)
    else:
        moved, shape = _in_torch(model, seeds, count, raw, (seed_noise, noise), threads, on_block)
    explained = np.sqrt(seed_noise * level.std)  # half-way to the cloud's own: where foliage grows, places read much noise too
    landed: Points = points + trust(shape, explained)[cell, None] * (moved - points)
    return landed


def trust(shape: NDArray[np.float32], noise: fused.Noise) -> NDArray[np.float64]:
    """(M,) from 0, no surface here (foliage, wires, clutter), to 1: the noise explains how thick it is, or it is flat anyway.

    shape (M, 3): ascending standard deviations of neighbourhoods along their axes. On noisy surfaces 19 of 20 are thinner than
    1.5 std; a wire or a filled volume has a planarity, (middle - thin) / wide, of about 0.2, a plane 0.7, the edge of a box 0.35.
    """
    thin, middle, wide = shape.astype(np.float64).T
    unexplained = np.clip((thin / np.maximum(noise, 1e-30) - 1.5) / 0.7, 0, 1)
    flat = np.clip(((middle - thin) / np.maximum(wide, 1e-30) - 0.15) / 0.2, 0, 1)
    trusted: NDArray[np.float64] = 1 - unexplained * (1 - flat)
    return trusted


def _in_torch(
    model: Model,
    seeds: Points,
    count: NDArray[np.float64] | None,
    raw: Points | None,
    noise: tuple[NDArray[np.float64], NDArray[np.float64]],
    threads: int,
    on_block: Callable[[int], None],
) -> tuple[Points, NDArray[np.float32]]:
    import torch

    from pcdenoise.denoising.pyramid import descend
    from pcdenoise.networks.projection import ProjectionNetwork

    assert isinstance(model.network, ProjectionNetwork)
    with _torch_threads(1), torch.no_grad():  # of blocks, which are spread over threads already
        descent = descend(model.network, seeds, count, raw, *noise, threads=threads, on_block=on_block)
    return descent.last.numpy(), descent.shape.numpy()


def mcconv(points: Points, unit: float, model: Model, seeds: Sequence[int], threads: int, on_share: OnShare) -> Points:
    """In the network's frame, the mean over the seeds that its samples are drawn by.

    unit: what the network takes for one, in the points' unit.
    """
    return _mean(lambda seed, on_share: _sampled(points, unit, model, seed, threads, on_share), seeds, on_share)


def _sampled(points: Points, unit: float, model: Model, seed: int, threads: int, on_share: OnShare) -> Points:
    """Only the first level, which is small, is looked at as a whole; the points follow in blocks."""
    import torch

    from pcdenoise.networks.mcconv import MCConvNetwork

    network, rng = model.network, np.random.default_rng(seed)
    assert isinstance(network, MCConvNetwork)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    local = torch.from_numpy((points - centre) / unit)
    moves = []
    with _torch_threads(threads), torch.no_grad():
        code = network.encode(local, rng)
        for start in range(0, len(points), _DECODED_AT_ONCE):
            moves.append(network.decode(code, local[start : start + _DECODED_AT_ONCE], rng).double().numpy())
            on_share(min((start + _DECODED_AT_ONCE) / len(points), 1.0))
    return fused.checked_finite(points + unit * np.concatenate(moves))


@contextmanager
def _torch_threads(number: int) -> Iterator[None]:
    """Torch with so many threads of its own."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)
