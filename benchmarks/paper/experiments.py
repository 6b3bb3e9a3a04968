"""The paper's tables and figures as data: who is judged in which cell, what the paper has there, what it claims.

Numbers are those of Hermosilla, Ritschel, Ropinski, "Total Denoising" (2019) and its supplement. Not here: training and judging
(lab.py), files, pictures of tables and pages (run.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from data import LEVELS, Law
from lab import Lab, Subject, fixed_passes

from pcdenoise.cloud.scan import Points
from pcdenoise.evaluation.chamfer import point_errors
from pcdenoise.evaluation.charts import curve, histogram
from pcdenoise.evaluation.colours import Scalar
from pcdenoise.evaluation.pictures import render, strip
from pcdenoise.evaluation.raster import Image
from pcdenoise.synthesis.meshes import Mesh

STOPS = ("fixed", "auto", "oracle")
"""Where the passes end: after a fixed number, where the rule without truth ends them, and where the error is least."""
NETWORKS = ("mcconv", "projection")
FILTERS = {"Mean": "mean", "Bilat.": "bilateral", "Jet": "jet"}
SIGNALS = {"No p.": "none", "No c.": "space", "Full": "full", "Sup.": "supervised"}
EVERYBODY = (*FILTERS, *SIGNALS)
AMOUNTS = {"0.5 M": 1 / 6, "1 M": 1 / 3, "4 M": 2 / 3, "22 M": None}
"""Rows of the paper's table of data amounts, and the share of our training shapes that stands for each; None: all of them."""
KERNELS = {
    "Gaussian": ("gaussian", (0.3, 0.5, 0.7)),
    "Wendland": ("wendland", (0.8, 1.0, 1.2)),
    "Inv. MQ": ("imq", (0.8, 1.0, 1.2)),
}
WIDTHS = ("α1", "α2", "α3")
_PANEL, _VIEW = (520, 320), (35.0, 25.0)
_EDGE = 0.04
"""What counts as near an edge, in diagonals."""
_MARKS = (1 / 12, 1 / 6, 1 / 3, 2 / 3, 1.0)


@dataclass(frozen=True)
class Cell:
    """Whose errors are averaged over which levels of noise; None: over all of them."""

    subject: Subject
    level: float | None = None


@dataclass(frozen=True)
class Table:
    """A table of the paper. cell: from row, column and network to a cell. paper: its numbers by row, None where it has none.

    quick_rows, quick_columns: those that a trial run makes do with.
    """

    name: str
    title: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    cell: Callable[[str, str, str], Cell]
    paper: dict[str, tuple[float | None, ...]]
    paper_noisy: float | None = None
    networks: tuple[str, ...] = NETWORKS
    quick_rows: tuple[str, ...] = ()
    quick_columns: tuple[str, ...] = ()

    def run(self, lab: Lab, seeds: Sequence[int], networks: Sequence[str], quick: bool) -> dict[str, Any]:
        """Every cell for every seed and network, as plain data."""
        networks = self.networks if len(self.networks) == 1 else networks
        rows = self.quick_rows if quick and self.quick_rows else self.rows
        columns = self.quick_columns if quick and self.quick_columns else self.columns
        cells = []
        for seed, network, row, column in ((s, n, r, c) for s in seeds for n in networks for r in rows for c in columns):
            cell = self.cell(row, column, network)
            label = {"row": row, "column": column, "network": network, "seed": seed}
            cells.append({**label, **_errors(lab, cell, seed)})
        paper = {row: dict(zip(self.columns, numbers, strict=True)) for row, numbers in self.paper.items()}
        return {"columns": columns, "rows": rows, "networks": list(networks), "paper": paper, "cells": cells}


def _errors(lab: Lab, cell: Cell, seed: int) -> dict[str, Any]:
    """Mean errors over the clouds of a cell, in % of the diagonal."""
    clouds = [cloud for cloud in lab.judged(cell.subject, seed) if cell.level in (None, cloud["level"])]
    passes = np.array([cloud["passes"] for cloud in clouds])
    auto = np.array([cloud["auto"] for cloud in clouds])
    return {
        "noisy": float(passes[:, 0].mean()),
        "fixed": float(passes[:, min(fixed_passes(cell.subject), passes.shape[1] - 1)].mean()),
        "auto": float(passes[np.arange(len(passes)), auto].mean()),
        "oracle": float(passes.min(axis=1).mean()),
        "auto_passes": float(auto.mean()),
        "passes": passes.mean(axis=0).tolist(),
    }


def anybody(column: str, network: str, **learned_from: Any) -> Subject:
    """A filter that was tuned on the training set, or a network by what it learned from."""
    if column in FILTERS:
        return Subject(FILTERS[column], law=learned_from.get("law", "gaussian"))  # type: ignore[arg-type]
    return Subject(network, SIGNALS[column], **learned_from)  # type: ignore[arg-type]


def _percent(level: float) -> str:
    return f"{level:.1f} %"


def _per_method(name: str, title: str, law: Law, paper: tuple[float | None, ...]) -> Table:
    return Table(name, title, ("All",), EVERYBODY, lambda _r, c, n: Cell(anybody(c, n, law=law)), {"All": paper})


def _amount(row: str, column: str, network: str) -> Cell:
    return Cell(anybody(column, network, shapes=AMOUNTS[row]))


def _kernel(row: str, column: str, network: str) -> Cell:
    kernel, widths = KERNELS[row]
    alpha = widths[WIDTHS.index(column)]
    return Cell(Subject(network, "space", kernel, None if column == "α2" else alpha))  # type: ignore[arg-type]


TABLES = {
    table.name: table
    for table in (
        _per_method("performance", "Simple noise", "gaussian", (0.598, 0.592, None, 0.582, 0.547, 0.542, 0.545)),
        Table(
            "data-amount",
            "Amount of data",
            tuple(AMOUNTS),
            tuple(SIGNALS),
            _amount,
            {
                "0.5 M": (0.587, 0.557, 0.558, 0.574),
                "1 M": (0.584, 0.550, 0.557, 0.563),
                "4 M": (0.584, 0.553, 0.543, 0.546),
                "22 M": (0.582, 0.547, 0.542, 0.545),
            },
            quick_rows=("0.5 M", "22 M"),
            quick_columns=("Full", "Sup."),
        ),
        Table(
            "noise-level",
            "Level of noise",
            tuple(_percent(level) for level in LEVELS[::-1]),
            EVERYBODY,
            lambda row, column, network: Cell(anybody(column, network), float(row.split()[0])),
            {
                "1.5 %": (None, None, None, 0.734, 0.698, 0.691, 0.695),
                "1.0 %": (None, None, None, 0.578, 0.534, 0.525, 0.515),
                "0.5 %": (None, None, None, 0.435, 0.411, 0.408, 0.426),
            },
        ),
        _per_method("advanced", "Advanced noise (HDL-64E)", "lidar", (0.378, 0.362, None, 0.393, 0.359, 0.356, 0.329)),
        Table(
            "kernels",
            "Kernels of the prior",
            tuple(KERNELS),
            WIDTHS,
            _kernel,
            {"Gaussian": (0.567, 0.548, 0.556), "Wendland": (0.595, 0.560, 0.561), "Inv. MQ": (0.577, 0.577, 0.582)},
            quick_columns=("α2",),
        ),
        Table(
            "levels",
            "Trained at one level (rows), tested at another",
            (*map(_percent, LEVELS), "All"),
            tuple(map(_percent, LEVELS)),
            lambda row, column, network: Cell(
                Subject(network, "space", level=None if row == "All" else float(row.split()[0])),  # type: ignore[arg-type]
                float(column.split()[0]),
            ),
            {
                "0.5 %": (0.435, 0.576, 0.738),
                "1.0 %": (0.431, 0.551, 0.708),
                "1.5 %": (0.467, 0.594, 0.741),
                "All": (0.411, 0.534, 0.698),
            },
            quick_rows=("1.0 %", "All"),
        ),
        Table(
            "upgrade",
            "Upgrading a supervised denoiser",
            ("PointNet patches",),
            ("Sup.", "Ours"),
            lambda _r, column, _n: Cell(Subject("pointnet", "supervised" if column == "Sup." else "space")),
            {"PointNet patches": (1.36, 1.34)},
            paper_noisy=4.54,
            networks=("pointnet",),
        ),
    )
}


@dataclass(frozen=True)
class Claim:
    """That one cell is not above `factor` times another one of the same table. A cell: row, column, network or None for any."""

    words: str
    table: str
    left: tuple[str, str, str | None]
    right: tuple[str, str, str | None]
    factor: float = 1.0


def _claims() -> list[Claim]:
    def same(words: str, table: str, row: str, left: str, right: str, factor: float = 1.0) -> Claim:
        return Claim(words, table, (row, left, None), (row, right, None), factor)

    def down(words: str, table: str, column: str, left: str, right: str) -> Claim:
        return Claim(words, table, (left, column, None), (right, column, None))

    claims = [
        same("a prior in space beats none", "performance", "All", "No c.", "No p."),
        same("colour does not hurt", "performance", "All", "Full", "No c."),
        same("unsupervised is within 5 % of supervised", "performance", "All", "Full", "Sup.", 1.05),
        *(same(f"unsupervised beats {f}", "performance", "All", "Full", f) for f in ("Mean", "Bilat.")),
        *(same(f"supervised beats {f}", "performance", "All", "Sup.", f) for f in ("Mean", "Bilat.")),
        *(down("less noise, less error", "noise-level", "Full", *pair) for pair in (("0.5 %", "1.0 %"), ("1.0 %", "1.5 %"))),
        *(down("more data, less error", "data-amount", column, "22 M", "0.5 M") for column in ("Full", "Sup.")),
        *(down("no kernel beats the Gaussian", "kernels", "α2", "Gaussian", other) for other in ("Wendland", "Inv. MQ")),
        same("a prior in space beats none", "advanced", "All", "No c.", "No p."),
        same("colour does not hurt", "advanced", "All", "Full", "No c."),
        same("supervised is ahead", "advanced", "All", "Sup.", "Full"),
        *(down("all levels are the better school", "levels", level, "All", level) for level in map(_percent, LEVELS)),
        same("our targets teach as well as clean ones", "upgrade", "PointNet patches", "Ours", "Sup."),
    ]
    ours = "the projection network beats mcconv"
    return [
        *claims,
        *(Claim(ours, "performance", ("All", c, "projection"), ("All", c, "mcconv")) for c in ("No c.", "Full", "Sup.")),
    ]


CLAIMS = _claims()
"""The paper's orderings, and at the end one that we would like to see."""


@dataclass(frozen=True)
class Figure:
    """A figure of the paper: what it shows there, and what makes its data and its picture."""

    name: str
    title: str
    paper: str
    make: Callable[[Lab, Sequence[int], Sequence[str]], tuple[dict[str, Any], Image]]


@dataclass
class _Seen:
    """A cloud on its way: points before the first and after each pass, and where the automatic stop is."""

    mesh: Mesh
    clouds: list[Points]
    auto: int
    clean: Points = field(default_factory=lambda: np.zeros((0, 3)))

    def errors(self, number: int) -> np.ndarray:
        """(N,) distance to the surface in % of the diagonal after a pass."""
        percent: np.ndarray = 100 * point_errors(self.clouds[number], mesh=self.mesh) / self.mesh.diagonal
        return percent

    def picture(self, number: int) -> Image:
        """Coloured from no error to 2 % of the diagonal, as in the paper."""
        colour = Scalar(self.errors(number), "% of diagonal", low=0, high=2)
        return render(self.clouds[number], colour=colour, view=_VIEW, size=_PANEL)


def _seen(lab: Lab, subject: Subject, seed: int, level: float = 1.0) -> list[_Seen]:
    found = []
    for item in lab.test_items(subject.law, subject.boxes, seed):
        found.append(_Seen(item.mesh, *lab.passes(subject, seed, item.noisy[level].points), item.clean.points))
    return found


def _signals(signal: str) -> str:
    return next(column for column, name in SIGNALS.items() if name == signal)


def error_histogram(lab: Lab, seeds: Sequence[int], networks: Sequence[str]) -> tuple[dict[str, Any], Image]:
    """Distances of points to the surface where the automatic stop leaves them, at 1 % noise: unsupervised and supervised."""
    images, rows = [], []
    for network in networks:
        series = {}
        for signal in ("full", "supervised"):
            subject = Subject(network, signal)  # type: ignore[arg-type]
            seen = [cloud for seed in seeds for cloud in _seen(lab, subject, seed)]
            series[_signals(signal)] = values = np.concatenate([cloud.errors(cloud.auto) for cloud in seen])
            shares = np.histogram(values, np.append(np.arange(0, 2.01, 0.1), np.inf))[0] / len(values)
            rows.append(
                {"network": network, "signal": _signals(signal), "median": float(np.median(values)), "shares": shares.tolist()}
            )
        images.append(histogram(series, title=network, label="distance to the surface, % of diagonal").image(1))
    return {"bin_width": 0.1, "rows": rows}, strip(images)


def convergence(lab: Lab, seeds: Sequence[int], networks: Sequence[str]) -> tuple[dict[str, Any], Image]:
    """Error on the test clouds along the training, on the least amount of data as in the paper."""
    marks = sorted({max(1, round(share * lab.scale.steps)) for share in _MARKS})
    images, rows = [], []
    for network in networks:
        series = {}
        for signal in ("full", "supervised"):
            subject = Subject(network, signal, shapes=AMOUNTS["0.5 M"])  # type: ignore[arg-type]
            every = [lab.along_training(subject, seed, marks) for seed in seeds]
            series[_signals(signal)] = np.mean(every, axis=0)
            rows.append({"network": network, "signal": _signals(signal), "errors": np.array(every).T.tolist()})
        images.append(curve(series, title=network, label="error, % of diagonal", x_label="Step", x=marks).image(1))
    return {"steps": marks, "rows": rows}, strip(images)


def iterations(lab: Lab, seeds: Sequence[int], networks: Sequence[str]) -> tuple[dict[str, Any], Image]:
    """Error after every pass: a cloud in the colours of its error, and the mean over all test clouds."""
    rows, images, titles = [], [], []
    for network in networks:
        series = {}
        for column, signal in SIGNALS.items():
            every = [_errors(lab, Cell(Subject(network, signal)), seed) for seed in seeds]  # type: ignore[arg-type]
            series[column] = np.mean([errors["passes"] for errors in every], axis=0)
            rows.append({"network": network, "signal": column, "passes": [errors["passes"] for errors in every]})
        chart = curve(series, title="Mean of all test clouds", label="error, % of diagonal", x_label="Pass")
        seen = _seen(lab, Subject(network, "full"), seeds[0])[0]  # type: ignore[arg-type]
        shown = np.unique(np.linspace(0, len(seen.clouds) - 1, 3).round().astype(int))
        images += [*(seen.picture(number) for number in shown), chart.image(1)]
        titles += [f"{network}, pass {number}" if number else f"{network}, noisy" for number in shown] + [f"{network}, all"]
    return {"rows": rows}, strip(images, titles, columns=4)


def colour_edge(lab: Lab, seeds: Sequence[int], networks: Sequence[str]) -> tuple[dict[str, Any], Image]:
    """Boxes whose faces differ in colour, learned from and tested on: errors near the edges and elsewhere, 1 % noise."""
    rows, images, titles = [], [], []
    for network in networks:
        for signal in ("space", "full"):
            near, flat = [], []
            for seed in seeds:
                for cloud in _seen(lab, Subject(network, signal, boxes=True), seed):  # type: ignore[arg-type]
                    edge = _near_edges(cloud)
                    errors = cloud.errors(cloud.auto)
                    near.append(errors[edge].mean())
                    flat.append(errors[~edge].mean())
            label = {"network": network, "signal": _signals(signal)}
            rows.append({**label, "edge": float(np.mean(near)), "flat": float(np.mean(flat))})
            images.append(cloud.picture(cloud.auto))
            titles.append(f"{network}, {_signals(signal)}")
    return {"rows": rows}, strip(images, titles)


def _near_edges(cloud: _Seen) -> np.ndarray:
    """(N,) points that belong near an edge of an upright box: the second smallest distance to a pair of faces is small."""
    high = cloud.mesh.vertices.max(axis=0)
    second: np.ndarray = np.sort(high - np.abs(cloud.clean), axis=1)[:, 1]
    return second < _EDGE * cloud.mesh.diagonal


FIGURES = {
    figure.name: figure
    for figure in (
        Figure(
            "error-histogram",
            "Error histogram",
            "most points at 0, fewer the further, unsupervised as supervised",
            error_histogram,
        ),
        Figure("convergence", "Convergence", "both fall alike, unsupervised to the lower error", convergence),
        Figure("iterations", "Iterations", "the error falls when the network is applied several times", iterations),
        Figure("colour-edge", "Colour at an edge", "with colour the error at an edge is slightly lower", colour_edge),
    )
}
