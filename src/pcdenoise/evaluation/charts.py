"""Histograms and curves, laid out once and shown as a picture or as SVG. Not here: pixels (raster.py), pages (report.py)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcdenoise.evaluation import raster
from pcdenoise.evaluation.raster import Image

_INKS = {
    "ink": raster.INK,
    "faint": raster.FAINT_INK,
    "rule": raster.RULE,
    "series0": (0.86, 0.45, 0.27),
    "series1": (0.09, 0.36, 0.55),
    "series2": (0.36, 0.58, 0.36),
    "series3": (0.50, 0.36, 0.62),
}
Scale = Callable[[float], float]
_LEFT, _RIGHT, _TOP, _BOTTOM = 76, 22, 62, 50


@dataclass(frozen=True)
class Bar:
    """A filled rectangle."""

    x: float
    y: float
    width: float
    height: float
    role: str


@dataclass(frozen=True)
class Line:
    """A line through (N, 2) points, with a dot on each if asked."""

    points: NDArray[np.float64]
    role: str
    dotted: bool = False


@dataclass(frozen=True)
class Label:
    """Words on a baseline; anchor 0 starts at x, 0.5 centres, 1 ends there."""

    x: float
    y: float
    words: str
    anchor: float = 0
    role: str = "faint"


@dataclass
class Chart:
    """Rules, bars, lines and labels in a box of width x height; a role is an ink in the picture and a class in the SVG."""

    title: str
    width: int = 520
    height: int = 320
    bars: list[Bar] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)

    def image(self, oversampling: int = 2) -> Image:
        """The chart as a picture, (height, width, 3) uint8 times `oversampling`."""
        k = oversampling
        canvas = raster.blank(self.width * k, self.height * k)
        raster.write(canvas, 22 * k, 30 * k, self.title, 11 * k, bold=True)
        for line in (line for line in self.lines if line.role == "rule"):
            raster.stroke(canvas, raster.polyline(line.points * k), _INKS["rule"], k)
        for bar in self.bars:
            raster.fill(canvas, bar.x * k, bar.y * k, bar.width * k, bar.height * k, _INKS[bar.role], opacity=0.7)
        for line in (line for line in self.lines if line.role != "rule"):
            raster.stroke(canvas, raster.polyline(line.points * k), _INKS[line.role], 2 * k)
            if line.dotted:
                raster.dots(canvas, line.points * k, 3.2 * k, _INKS[line.role])
        for label in self.labels:
            raster.write(canvas, label.x * k, label.y * k, label.words, 8 * k, _INKS[label.role], anchor=label.anchor)
        return raster.to_image(canvas)

    def svg(self) -> str:
        """The chart without its title as an SVG element that takes its colours from the classes of the page."""
        parts = [f'<svg viewBox="0 34 {self.width} {self.height - 34}" role="img" aria-label="{escape(self.title, quote=True)}">']
        for line in self.lines:
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in line.points)
            parts.append(f'<polyline class="{line.role}" points="{path}"/>')
            if line.dotted:
                parts += [f'<circle class="{line.role}" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>' for x, y in line.points]
        parts += [
            f'<rect class="{b.role}" x="{b.x:.1f}" y="{b.y:.1f}" width="{b.width:.1f}" height="{b.height:.1f}"/>'
            for b in self.bars
        ]
        anchors = {0: "start", 0.5: "middle", 1: "end"}
        parts += [
            f'<text class="{t.role}" x="{t.x:.1f}" y="{t.y:.1f}" text-anchor="{anchors[t.anchor]}">{escape(t.words)}</text>'
            for t in self.labels
        ]
        return "".join([*parts, "</svg>"])


def histogram(values: Mapping[str, ArrayLike] | ArrayLike, *, title: str, label: str = "", n_bins: int = 48) -> Chart:
    """How often values occur, bars for each named array; the axis ends at the 99.5th percentile, what lies beyond is said."""
    named = values if isinstance(values, Mapping) else {"": values}
    series = {name: _known(numbers) for name, numbers in named.items()}
    every = np.concatenate(list(series.values()))
    chart = Chart(title)
    if not len(every):
        return _empty(chart)
    low, high = np.percentile(every, [0.5, 99.5])
    low = 0.0 if every.min() >= 0 and low < 0.3 * high else float(low)
    edges = np.linspace(low, float(high) if high > low else low + max(abs(low), 1e-9), n_bins + 1)
    counts = {name: np.histogram(numbers, edges)[0] / max(len(numbers), 1) * 100 for name, numbers in series.items()}
    most = max(float(count.max()) for count in counts.values())
    to_x, to_y = _axes(chart, (edges[0], edges[-1]), (0, most), label, "% of points")
    for place, count in enumerate(counts.values()):
        width = to_x(edges[1]) - to_x(edges[0]) - 0.8
        for edge, share in zip(edges[:-1], count, strict=True):
            if share > 0:
                chart.bars.append(Bar(to_x(edge) + 0.4, to_y(share), width, to_y(0) - to_y(share), f"series{place % 4}"))
    beyond = 1 - sum(int(((numbers >= edges[0]) & (numbers <= edges[-1])).sum()) for numbers in series.values()) / len(every)
    if beyond > 0:
        chart.labels.append(Label(chart.width - _RIGHT, 52, f"{short(100 * beyond)} % lie beyond this range", 1))
    _legend(chart, list(series))
    return chart


def curve(
    series: Mapping[str, ArrayLike], *, title: str, label: str = "", x_label: str = "Iteration", x: ArrayLike | None = None
) -> Chart:
    """Numbers over 0, 1, 2, … or over `x`, one line for each name; the axis starts at 0, gaps (NaN) are bridged."""
    named = {name: np.asarray(numbers, dtype=np.float64) for name, numbers in series.items()}
    every = _known(np.concatenate(list(named.values()))) if named else np.empty(0)
    chart = Chart(title)
    if not len(every):
        return _empty(chart)
    places = np.arange(max(map(len, named.values())), dtype=np.float64) if x is None else np.asarray(x, dtype=np.float64)
    x_range, y_range = (float(places.min()), float(places.max())), (min(0.0, float(every.min())), float(every.max()))
    to_x, to_y = _axes(chart, x_range, y_range, x_label, label, least_x_step=1 if x is None else 0)
    for place, numbers in enumerate(named.values()):
        known = np.isfinite(numbers)
        at = places[: len(numbers)][known]
        points = np.array([(to_x(x), to_y(y)) for x, y in zip(at, numbers[known], strict=True)]).reshape(-1, 2)
        chart.lines.append(Line(points, f"series{place % 4}", dotted=len(points) <= 40))
    _legend(chart, list(named))
    return chart


def short(value: float) -> str:
    """A number for people, three digits: 0.0123, 1.2e-05, 48,200, –."""
    if not np.isfinite(value):
        return "\u2013"
    value += 0.0  # no negative zero
    whole = value == round(value) or abs(value) >= 1000
    digits = f"{value:.0f}" if whole and abs(value) < 1e15 else f"{value:.3g}"
    if whole and 10_000 <= abs(value) < 1e15:
        digits = f"{value:,.0f}"
    return digits.replace("-", "\u2212")


def round_step(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `length`."""
    power = 10.0 ** np.floor(np.log10(max(length, 1e-300)))
    return float(max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)) * power)


def _known(numbers: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(numbers, dtype=np.float64).ravel()
    return array[np.isfinite(array)]


def _empty(chart: Chart) -> Chart:
    chart.labels.append(Label(chart.width / 2, chart.height / 2, "no values", 0.5))
    return chart


def _axes(
    chart: Chart, x_range: tuple[float, float], y_range: tuple[float, float], x_label: str, y_label: str, least_x_step: float = 0
) -> tuple[Scale, Scale]:
    """Draw rules, numbers and names of both axes; return value -> coordinate for each."""
    to_x = _scale(x_range, (_LEFT, chart.width - _RIGHT))
    y_step = round_step(max(y_range[1] - y_range[0], 1e-12) / 3)
    y_range = (np.floor(y_range[0] / y_step) * y_step, np.ceil(y_range[1] / y_step - 1e-9) * y_step)
    to_y = _scale(y_range, (chart.height - _BOTTOM, _TOP))
    for value in np.arange(y_range[0], y_range[1] + y_step / 2, y_step):
        chart.lines.append(Line(np.array([(_LEFT, to_y(value)), (chart.width - _RIGHT, to_y(value))]), "rule"))
        chart.labels.append(Label(_LEFT - 10, to_y(value) + 4, short(float(np.round(value / y_step) * y_step)), 1))
    x_step = max(round_step(max(x_range[1] - x_range[0], 1e-12) / 4), least_x_step)
    for value in np.arange(np.ceil(x_range[0] / x_step - 1e-9) * x_step, x_range[1] + x_step * 1e-6, x_step):
        chart.labels.append(Label(to_x(value), chart.height - _BOTTOM + 18, short(float(np.round(value / x_step) * x_step)), 0.5))
    chart.labels.append(Label((_LEFT + chart.width - _RIGHT) / 2, chart.height - 12, x_label, 0.5, "ink"))
    if y_label:
        chart.labels.append(Label(chart.width - _RIGHT, chart.height - 12, y_label + " \u2191", 1))
    return to_x, to_y


def _scale(values: tuple[float, float], coordinates: tuple[float, float]) -> Scale:
    """The straight line that takes one range to the other."""
    factor = (coordinates[1] - coordinates[0]) / ((values[1] - values[0]) or 1.0)
    return lambda value: coordinates[0] + (value - values[0]) * factor


def _legend(chart: Chart, names: Sequence[str]) -> None:
    """The names of the series over the plot, each after a patch of its ink."""
    x = float(_LEFT)
    for place, name in enumerate(names if any(names) else []):
        chart.bars.append(Bar(x, 45, 9, 9, f"series{place % 4}"))
        chart.labels.append(Label(x + 14, 53, name, role="ink"))
        x += 14 + raster.text_width(name, 8) + 22
