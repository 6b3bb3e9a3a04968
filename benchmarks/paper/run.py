"""The tables and figures of "Total Denoising", one command each, with the paper's numbers beside ours.

    python benchmarks/paper/run.py performance -o paper/        # one of them; several names are fine
    python benchmarks/paper/run.py all -o paper/ [--quick]
    python benchmarks/paper/run.py page -o paper/               # docs/paper.md from what was run

Each writes NAME.json and NAME.png; networks and errors are kept in cache/, so experiments share them and a broken run goes on.
Not here: what the experiments are (experiments.py), the page (report.py).
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import report
import torch
from data import Shapes
from experiments import FIGURES, NETWORKS, TABLES
from lab import Lab, Scale

from pcdenoise import __version__
from pcdenoise.evaluation.pictures import write_png

DOCS = Path(__file__).resolve().parents[2] / "docs"
QUICK = Scale(points=400, train_shapes=2, test_shapes=1, steps=3, passes=2)


def main() -> None:
    """Runs what is asked for, or makes the page of what was run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="+", choices=[*TABLES, *FIGURES, "all", "page"], metavar="NAME", help="%(choices)s")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder")
    parser.add_argument("--seeds", type=int, default=3, help="trainings and noises that are averaged over")
    parser.add_argument(
        "--quick", action="store_true", help="whether it runs, not how well: tiny clouds, one seed, mcconv, some cells"
    )
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=NETWORKS)
    parser.add_argument("--meshes", type=Path, help="a folder of meshes instead of generated ones")
    for name, value in asdict(Scale()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, help=f"{value} by default")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.names == ["page"]:
        write_page(options.output, DOCS)
        return
    given = {name: value for name in asdict(Scale()) if (value := getattr(options, name)) is not None}
    scale = Scale(**{**asdict(QUICK if options.quick else Scale()), **given})
    seeds, networks = range(1 if options.quick else options.seeds), options.networks[:1] if options.quick else options.networks
    lab = Lab(options.output, scale, Shapes(options.meshes), options.threads)
    for name in (*TABLES, *FIGURES) if "all" in options.names else options.names:
        if name in TABLES:
            found = TABLES[name].run(lab, seeds, networks, options.quick)
            found = {**about(name, TABLES[name].title, options, scale, seeds), "paper_noisy": TABLES[name].paper_noisy, **found}
            picture = report.table_picture(found)
        else:
            shown, picture = FIGURES[name].make(lab, seeds, networks)
            found = {**about(name, FIGURES[name].title, options, scale, seeds), **shown}
        (options.output / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n")
        write_png(options.output / f"{name}.png", picture, overwrite=True)


def about(name: str, title: str, options: argparse.Namespace, scale: Scale, seeds: range) -> dict[str, Any]:
    """What was run, and the command that runs it again."""
    defaults, extra = asdict(Scale()), ""
    if options.quick:
        extra += " --quick"
    elif len(seeds) != 3:
        extra += f" --seeds {len(seeds)}"
    if options.meshes:
        extra += f" --meshes {options.meshes.name}/"
    if not options.quick and tuple(options.networks) != NETWORKS:
        extra += f" --networks {' '.join(options.networks)}"
    changed = {} if options.quick else {key: value for key, value in asdict(scale).items() if value != defaults[key]}
    extra += "".join(f" --{key.replace('_', '-')} {value}" for key, value in changed.items())
    command = f"python benchmarks/paper/run.py {name} -o paper/{extra}"
    return {
        "name": name,
        "title": title,
        "pcdenoise": __version__,
        "command": command,
        "scale": asdict(scale),
        "seeds": list(seeds),
    }


def write_page(folder: Path, docs: Path) -> None:
    """docs/paper.md and its pictures."""
    (docs / "images").mkdir(parents=True, exist_ok=True)
    for name in (*TABLES, *FIGURES):
        if (folder / f"{name}.json").exists():
            shutil.copyfile(folder / f"{name}.png", docs / "images" / f"paper-{name}.png")
    (docs / "paper.md").write_text(report.page(folder, "images"), encoding="utf-8")


if __name__ == "__main__":
    main()
