"""Depths in steps: a depth camera before meshes, cleaned as they are, with the noise told, and with rounding undone first.

    python benchmarks/rounding/run.py MESH... [--jitters 0 0.15 0.3] [--scan ORGANISED.pcd] [--json FILE]

Each mesh, 1.2 m wide, stands 2.2 m before a camera of 320 by 240 pixels, a slanted wall and a floor behind it. Disparity, one
over the depth, comes in whole steps, as large as a Kinect's, after a jitter of so many steps. Error: distance to the surface,
root mean square in mm, of all points, of those nearer than 2.8 m, and the median. `--scan`: a real one, organised in rows; its
walls are told from other windows of 48 by 48 pixels by how flat they are; error: root mean square about a plane, which is not the
truth but what is left of terraces. Not here: how rounding is undone (pcdenoise.denoising.rounding).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import pcdenoise
from pcdenoise.synthesis.meshes import Mesh, MeshQueries, load_mesh

PIXELS, FOCAL, STEP, NEAR = (240, 320), 285.0, 2.85e-3, 2.8
WINDOW, FLAT_STEPS, FEWEST_LEVELS = 48, 0.45, 3
METHODS = ("as measured", "kept rounded", "noise told", "undone", "undone, told")


def room(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh, turned at random, between a camera at the origin that looks along z, a wall and a floor. In metres."""
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    centred = mesh.vertices - (mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)) / 2
    thing = 0.6 * centred @ turn.T / np.linalg.norm(centred, axis=1).max() + [0, 0, 2.2]
    slant = np.tan(np.radians(rng.uniform(-35, 35)))
    wall = np.array([[x, y, 3.5 + slant * x + 0.13 * y] for x, y in ((-3, -3), (3, -3), (3, 3), (-3, 3))])
    floor = np.array([[x, 0.8 + 0.045 * (z - 0.5), z] for x, z in ((-3, 0.5), (3, 0.5), (3, 5), (-3, 5))])
    quad, n = np.array([[0, 1, 2], [0, 2, 3]]), len(thing)
    return Mesh(np.concatenate([thing, wall, floor]), np.concatenate([mesh.faces, quad + n, quad + n + 4]))


def seen(scene: MeshQueries, jitter: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) what the camera measures."""
    v, u = np.indices(PIXELS, dtype=np.float64)
    rays = np.stack([(u - PIXELS[1] / 2) / FOCAL, (v - PIXELS[0] / 2) / FOCAL, np.ones(PIXELS)], axis=-1).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    depth = scene.hits(np.zeros_like(rays), rays / length[:, None])[0] / length
    rays, depth = rays[depth < 5], depth[depth < 5]
    disparity = np.rint(1 / (STEP * depth) + jitter * rng.standard_normal(len(depth)))
    return rays / (STEP * np.maximum(disparity, 1))[:, None]


def cleaned(points: np.ndarray) -> Iterator[np.ndarray]:
    """(N, 3) by each of METHODS."""
    depths, step = np.unique(points[np.isfinite(points).all(axis=1), 2], return_inverse=True)
    std = float(np.median(np.gradient(depths)[step])) / 12**0.5
    yield points
    yield pcdenoise.denoise(points, threads=1, unround=False).points
    yield pcdenoise.denoise(points, threads=1, unround=False, noise=std).points
    yield pcdenoise.denoise(points, threads=1).points
    yield pcdenoise.denoise(points, threads=1, noise=std).points


def walls(points: np.ndarray, rows: int) -> list[np.ndarray]:
    """Rows of (N, 3) organised points in windows that are flat to within rounding: disparity linear there, on several levels."""
    grid = np.arange(len(points)).reshape(rows, -1)
    finite, found = np.isfinite(points).all(axis=1), []
    depths = np.unique(points[finite, 2])
    for top in range(0, rows - WINDOW, WINDOW // 2):
        for left in range(0, grid.shape[1] - WINDOW, WINDOW // 2):
            window = grid[top : top + WINDOW, left : left + WINDOW].ravel()
            if not finite[window].all():
                continue
            seen_at = points[window]
            design = np.column_stack([seen_at[:, :2] / seen_at[:, 2:], np.ones(len(window))])
            off = 1 / seen_at[:, 2] - design @ np.linalg.lstsq(design, 1 / seen_at[:, 2], rcond=None)[0]
            step = np.median(np.interp(seen_at[:, 2], depths, np.abs(np.gradient(1 / depths))))
            if off.std() < FLAT_STEPS * step and len(np.unique(seen_at[:, 2])) >= FEWEST_LEVELS:
                found.append(window)
    return found


def unevenness(points: np.ndarray, windows: list[np.ndarray]) -> float:
    """Mean over windows of the root mean square distance to a plane through them."""
    return float(np.mean([np.linalg.svd(points[w] - points[w].mean(axis=0))[1][-1] / len(w) ** 0.5 for w in windows]))


def main() -> None:
    """Prints a table of means over meshes, a line for each jitter, and one for the scan."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--jitters", nargs="*", type=float, default=[0.0, 0.15, 0.3])
    parser.add_argument("--scan", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("| | " + " | ".join(METHODS) + " |\n" + "| --- " * (1 + len(METHODS)) + "|")
    for jitter in options.jitters if options.meshes else ():
        errors = []
        for number, path in enumerate(options.meshes):
            rng = np.random.default_rng(number)
            scene = MeshQueries(room(load_mesh(path), rng))
            points = seen(scene, jitter, rng)
            off = [1000 * scene.closest(moved).distance for moved in cleaned(points)]
            near = points[:, 2] < NEAR
            errors.append([[np.sqrt((e**2).mean()), np.sqrt((e[near] ** 2).mean()), np.median(e)] for e in off])
        means = np.mean(errors, axis=0).tolist()
        rows.append({"jitter_steps": jitter, **{method: mean for method, mean in zip(METHODS, means, strict=True)}})
        cells = " | ".join(", ".join(f"{value:.2f}" for value in mean) for mean in means)
        print(f"| jitter of {jitter:g} steps | {cells} |", flush=True)
    if options.scan:
        scan = pcdenoise.read(options.scan)
        points = scan.points
        windows = walls(points, scan.source.header.height)
        found = [1000 * unevenness(moved, windows) for moved in cleaned(points)]
        rows.append({"scan": options.scan.name, "windows": len(windows), **dict(zip(METHODS, found, strict=True))})
        print(f"| {options.scan.name}, {len(windows)} windows | " + " | ".join(f"{value:.1f}" for value in found) + " |")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
