"""`pcdenoise synth`: noisy clouds whose true surface is known. Not here: shapes, sampling and laws of noise (synthesis)."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pcdenoise.commands import options
from pcdenoise.commands.console import Console, counted
from pcdenoise.commands.files import refuse_unwritable
from pcdenoise.commands.options import argument, option
from pcdenoise.errors import ScanError, UsageError

if TYPE_CHECKING:
    import numpy as np

    from pcdenoise.cloud.scan import Points, Scan
    from pcdenoise.synthesis.meshes import Mesh
    from pcdenoise.synthesis.shapes import SurfaceSample

NoiseName = Literal[
    "gaussian", "anisotropic", "rays", "laplace", "heavy-tailed", "beam-bias", "quantised", "misregistered", "lidar"
]
"""The laws of synthesis.noise, and the scanner of synthesis.lidar."""


def synth(
    sources: Annotated[
        list[str], argument(metavar="SOURCE...", help="Meshes, folders of meshes, or shapes:N for N random shapes.")
    ],
    output: Annotated[Path, option("--output", "-o", metavar="DIR", help="The data set's folder.")],
    points: Annotated[int, option("--points", min=16, help="Points per cloud; a lidar has its own number.")] = 10_000,
    levels: Annotated[
        str, option("--levels", metavar="PERCENT,...", help="Noise levels, in percent of the bounding box's diagonal.")
    ] = "0.5,1,1.5",
    noise: Annotated[NoiseName, option("--noise", help="The law of the noise.")] = "gaussian",
    overwrite: options.Overwrite = False,
    config: options.Config = None,
    seed: options.Seed = 0,
    quiet: options.Quiet = False,
) -> None:
    """Make a data set: of each surface a clean cloud with colours, evenly spaced, a noisy one per level, and its mesh.

    Example: pcdenoise synth meshes/ shapes:20 -o data/ --points 20000 --levels 1,2
    """
    from pcdenoise.evaluation.output import write_whole

    percents = _percents(levels)
    surfaces = [surface for source in sources for surface in _surfaces(source, noise)]
    repeated = {surface.name for surface in surfaces if [other.name for other in surfaces].count(surface.name) > 1}
    if repeated:
        raise UsageError(f"two sources are named {min(repeated)}; rename one or make two data sets")
    index = output / "dataset.json"
    refuse_unwritable([index], overwrite)
    output.mkdir(parents=True, exist_ok=True)
    console = Console(quiet)
    items = []
    with console.progress("synth") as on_progress:
        for number, surface in enumerate(surfaces):
            on_progress(surface.name, number / len(surfaces))
            items.append(_written(surface, output, points, percents, noise, [seed, number], overwrite))
    settings = {"points": points, "levels_percent_of_diagonal": percents, "noise": noise, "seed": seed}
    document = {"schema": 1, **settings, "items": items}
    write_whole(index, json.dumps(document, indent=2).encode() + b"\n", overwrite=overwrite)
    console.note(f"{output}: {counted(len(items), 'surface')}, {counted(len(percents), 'noisy cloud')} each; see {index}")


@dataclass(frozen=True)
class _Surface:
    """A source by name: how to sample it, and its mesh file if it is one."""

    name: str
    sample: Callable[[int, np.random.Generator], SurfaceSample]
    mesh_path: Path | None = None
    mesh: Mesh | None = None


def _surfaces(source: str, noise: str) -> Iterator[_Surface]:
    from pcdenoise.synthesis import meshes

    shapes = re.fullmatch(r"shapes:([1-9]\d*)", source)
    if shapes and noise == "lidar":
        raise UsageError(f"{source}: the lidar scans meshes; give a mesh file or another --noise")
    if shapes:
        yield from (_Surface(f"shape_{number:04d}", _evenly_sampled_shape) for number in range(int(shapes[1])))
        return
    path = Path(source)
    paths = [path]
    if path.is_dir():
        paths = sorted(entry for entry in path.iterdir() if entry.suffix.lower() in meshes.MESH_SUFFIXES)
        if not paths:
            raise ScanError(f"{source}: the folder holds no mesh; known suffixes are {' '.join(meshes.MESH_SUFFIXES)}")
    for entry in paths:
        mesh = meshes.load_mesh(entry)
        yield _Surface(entry.stem, partial(meshes.sample_mesh, mesh), entry, mesh)


def _evenly_sampled_shape(n: int, rng: np.random.Generator) -> SurfaceSample:
    from pcdenoise.cloud.sampling import poisson_disk_exactly
    from pcdenoise.synthesis.meshes import CANDIDATES_PER_SAMPLE
    from pcdenoise.synthesis.shapes import SurfaceSample, random_surface

    candidates = random_surface(rng, CANDIDATES_PER_SAMPLE * n)
    kept = poisson_disk_exactly(candidates.points, n, rng)
    return SurfaceSample(candidates.points[kept], candidates.normals[kept])


def _written(
    surface: _Surface, folder: Path, n_points: int, percents: list[float], noise: str, seeds: list[int], overwrite: bool
) -> dict[str, Any]:
    """Writes one surface's files and returns its entry in dataset.json; every random number comes from `seeds`."""
    import numpy as np

    from pcdenoise import io

    rng = np.random.default_rng(seeds)
    sample = surface.sample(n_points, rng)
    clean = _coloured(sample.points, sample.normals, rng)
    diagonal = surface.mesh.diagonal if surface.mesh else float(np.linalg.norm(np.ptp(sample.points, axis=0)))
    io.write(clean, folder / f"{surface.name}_clean.ply", overwrite=overwrite)
    entry: dict[str, Any] = {"name": surface.name, "clean": f"{surface.name}_clean.ply", "diagonal": diagonal, "noisy": []}
    if surface.mesh_path is not None:
        entry["mesh"] = f"{surface.name}_mesh{surface.mesh_path.suffix.lower()}"
        shutil.copyfile(surface.mesh_path, folder / entry["mesh"])
    for percent in percents:
        noisy = _noisy(surface, clean, noise, percent / 100, diagonal, rng)
        name = f"{surface.name}_{noise}_{percent:g}.ply"
        io.write(noisy, folder / name, overwrite=overwrite)
        entry["noisy"].append({"file": name, "level_percent": percent, "std": percent / 100 * diagonal, "points": len(noisy)})
    return entry


def _noisy(surface: _Surface, clean: Scan, noise: str, share: float, diagonal: float, rng: np.random.Generator) -> Scan:
    if noise != "lidar" or surface.mesh is None:
        from pcdenoise.synthesis.noise import NOISES

        return clean.moved_to(NOISES[noise](clean.points, share * diagonal, rng))

    from pcdenoise.synthesis.lidar import scan_mesh

    scan = scan_mesh(surface.mesh, rng, ray_std=share, bias_std=share / 2)  # the paper's ratio: 1 % per ray, 0.5 % per beam
    return _coloured(scan.points, scan.normals, rng).with_attributes(beam=scan.beam.astype("u1"), pose=scan.pose.astype("u1"))


def _coloured(points: Points, normals: Points, rng: np.random.Generator) -> Scan:
    from pcdenoise.cloud.scan import Scan
    from pcdenoise.synthesis.meshes import lambert_rgb

    red, green, blue = lambert_rgb(normals, rng).T
    return Scan(points, {"red": red, "green": green, "blue": blue}, format="ply")


def _percents(text: str) -> list[float]:
    try:
        percents = [float(part) for part in text.split(",")]
    except ValueError:
        raise UsageError(f"--levels {text}: give numbers with commas between them, such as 0.5,1,1.5") from None
    if not all(0 <= percent < 100 for percent in percents):
        raise UsageError(f"--levels {text}: a level is a percentage of the bounding box's diagonal, from 0 to below 100")
    return percents
