"""What came of the experiments, as pictures and as the page docs/paper.md. Every number on it is read from their JSON files.

Not here: experiments (experiments.py), why things are as they are (why.md, which the page ends with).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from experiments import CLAIMS, FIGURES, STOPS, TABLES, Claim

from pcdenoise.evaluation import charts
from pcdenoise.evaluation.charts import Bar, Chart, Label, Line
from pcdenoise.evaluation.pictures import strip
from pcdenoise.evaluation.raster import Image

HERE = Path(__file__).resolve().parent
SAID = {"fixed": "fixed number of passes", "auto": "automatic stop", "oracle": "oracle stop"}
_LEFT, _RIGHT, _TOP, _BOTTOM, _SERIES = 50, 16, 66, 30, 4
Found = Mapping[str, Any]
"""What an experiment left in its JSON file."""


def table_picture(found: Found) -> Image:
    """Bars for every cell at the automatic stop, each network's and the paper's beside each other."""
    rows, columns = found["rows"], found["columns"]
    panels = {
        network: [[_mean(found, row, c, network, "auto") for row in rows] for c in columns] for network in found["networks"]
    }
    paper = [[found["paper"].get(row, {}).get(c) for row in rows] for c in columns]
    panels["the paper"] = [[np.nan if value is None else value for value in series] for series in paper]
    turned = len(columns) > _SERIES
    images = []
    for name, series in panels.items():
        groups, inks = (columns, rows) if turned else (rows, columns)
        numbers = np.array(series, dtype=float).T if turned else np.array(series, dtype=float)
        images.append(_bars(name, groups, inks, numbers).image(1))
    return strip(images, columns=3)


def _bars(title: str, groups: Sequence[str], names: Sequence[str], numbers: np.ndarray) -> Chart:
    """(S, G) numbers as S bars in each of G groups; NaN leaves a gap."""
    chart = Chart(title)
    known = numbers[np.isfinite(numbers)]
    top = float(known.max()) if len(known) else 1.0
    step = charts.round_step(top / 3)
    top = np.ceil(top / step) * step
    height = chart.height - _TOP - _BOTTOM
    for value in np.arange(0, top + step / 2, step):
        y = chart.height - _BOTTOM - height * value / top
        chart.lines.append(Line(np.array([(_LEFT, y), (chart.width - _RIGHT, y)]), "rule"))
        chart.labels.append(Label(_LEFT - 8, y + 4, charts.short(float(value)), 1))
    room = (chart.width - _LEFT - _RIGHT) / len(groups)
    width = 0.8 * room / len(numbers)
    for place, group in enumerate(groups):
        start = _LEFT + place * room + 0.1 * room
        for ink, value in enumerate(numbers[:, place]):
            if np.isfinite(value):
                tall = height * value / top
                chart.bars.append(Bar(start + ink * width, chart.height - _BOTTOM - tall, width - 1, tall, f"series{ink % 4}"))
        chart.labels.append(Label(_LEFT + (place + 0.5) * room, chart.height - _BOTTOM + 18, group, 0.5))
    for ink, name in enumerate(names if len(names) > 1 else []):
        chart.bars.append(Bar(_LEFT + 110 * ink, 44, 9, 9, f"series{ink % 4}"))
        chart.labels.append(Label(_LEFT + 110 * ink + 14, 53, name, role="ink"))
    return chart


def page(folder: Path, images: str) -> str:
    """docs/paper.md from the JSON files in a folder; `images` is where its pictures are, seen from the page.

    What the folder's about.md says, if it is there, stands before the results.
    """
    found = {name: json.loads(path.read_text()) for name in (*TABLES, *FIGURES) if (path := folder / f"{name}.json").exists()}
    about = folder / "about.md"
    parts = [_OPENING, about.read_text() if about.exists() else "", _orderings(found), _stops(found), "## Tables\n"]
    for name, table in TABLES.items():
        parts += [f"### {table.title}\n", _run_of(name, found), _table(found[name], images) if name in found else ""]
    parts.append("## Figures\n")
    for name, figure in FIGURES.items():
        parts += [f"### {figure.title}\n", f"In the paper: {figure.paper}.\n", _run_of(name, found)]
        parts.append(_figure(found[name], images) if name in found else "")
    parts.append((HERE / "why.md").read_text())
    return "\n".join(part for part in parts if part)


_OPENING = """\
# The paper, rebuilt

Every table and figure of "Total Denoising" (Hermosilla, Ritschel, Ropinski 2019) by one command each, on two processor cores,
with the paper's numbers beside ours. This page is made by the last of these commands, and none of its numbers by hand:

```text
python benchmarks/paper/run.py all -o paper/              # everything, three seeds
python benchmarks/paper/run.py performance -o paper/      # one table
python benchmarks/paper/run.py all -o paper/ --quick      # does it run? tiny clouds, one seed
python benchmarks/paper/run.py page -o paper/             # this page
```

**Numbers are comparable within ours and within the paper's, not across.** The paper has 22 million points of ModelNet-40; here
are generated shapes (or a folder of meshes, `--meshes`), as many points as are said below, and minutes of training. The error is
the paper's: mean distance from prediction to surface plus mean distance from clean samples to prediction, in % of the box's
diagonal. With fewer points both are larger: the second never falls below about half a spacing.

*fixed*: three passes for mcconv and the patch network, one for everybody else. *automatic*: where
`--iters auto` stops, which sees no truth.
*oracle*: where the error of the cloud is least; nobody could choose that. Mean, bilateral and jets have parameters that were best
on the training set. mcconv is the paper's network at 25 000 parameters, projection is ours.
"""


def _run_of(name: str, found: Mapping[str, Found]) -> str:
    if name not in found:
        return "**Not run yet.**\n"
    done = found[name]
    scale = done["scale"]
    seeds = len(done["seeds"])
    return (
        f"```text\n{done['command']}\n```\n\n{scale['points']:,} points a cloud, {scale['train_shapes']} shapes to learn from at"
        f" three levels, {scale['steps']} steps, {scale['test_shapes']} test shapes, at most {scale['passes']} passes,"
        f" {seeds} seed{'s' if seeds > 1 else ''}.\n"
    )


def _table(found: Found, images: str) -> str:
    columns, many_rows = found["columns"], len(found["rows"]) > 1
    head = [*(["row"] if many_rows else []), "who, stop", "noisy", *columns]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for row in found["rows"]:
        first = [row] if many_rows else []
        paper = found["paper"].get(row, {})
        numbers = [_short(found["paper_noisy"]), *(_short(paper.get(column)) for column in columns)]
        lines.append(f"| {' | '.join([*first, 'the paper', *numbers])} |")
        for network in found["networks"]:
            for stop in STOPS:
                noisy = _spread(found, row, columns[-1], network, "noisy")
                cells = [_spread(found, row, column, network, stop) for column in columns]
                lines.append(f"| {' | '.join([*first, f'{network}, {stop}', noisy, *cells])} |")
    return "\n".join(lines) + f"\n\n![{found['title']}]({images}/paper-{found['name']}.png)\n"


def _figure(found: Found, images: str) -> str:
    shown = f"![{found['title']}]({images}/paper-{found['name']}.png)\n"
    rows = found["rows"]
    if found["name"] == "colour-edge":
        lines = ["| network, prior | near edges | elsewhere |", "| --- | --- | --- |"]
        return "\n".join([*lines, *(f"| {_who(row)} | {row['edge']:.3f} | {row['flat']:.3f} |" for row in rows)]) + f"\n\n{shown}"
    if found["name"] == "error-histogram":
        lines = ["| network, signal | median | within 0.5 % | beyond 2 % |", "| --- | --- | --- | --- |"]
        for row in rows:
            near, far = sum(row["shares"][: round(0.5 / found["bin_width"])]), row["shares"][-1]
            lines.append(f"| {_who(row)} | {row['median']:.3f} | {100 * near:.0f} % | {100 * far:.1f} % |")
        return "\n".join(lines) + f"\n\n{shown}"
    if found["name"] == "convergence":
        heads, series = [f"step {step}" for step in found["steps"]], [(row, np.mean(row["errors"], axis=1)) for row in rows]
    else:
        series = [(row, np.mean(row["passes"], axis=0)) for row in rows]
        heads = ["noisy", *(f"pass {number}" for number in range(1, len(series[0][1])))]
    lines = [f"| network, signal | {' | '.join(heads)} |", f"| --- |{' --- |' * len(heads)}"]
    lines += [f"| {_who(row)} | {' | '.join(f'{value:.3f}' for value in values)} |" for row, values in series]
    return "\n".join(lines) + f"\n\n{shown}"


def _who(row: Mapping[str, Any]) -> str:
    return f"{row['network']}, {row['signal']}"


def _orderings(found: Mapping[str, Found]) -> str:
    lines = [
        "## Which orderings hold\n",
        "Left error over right error, the mean over seeds, and in how many seeds it is at most the limit. The verdict is that",
        "of the automatic stop, and plain only over three seeds: one or two are a direction, no proof.\n",
        "| ordering | table | left over right | network | limit | the paper | fixed | automatic | oracle | verdict |",
        "|" + " --- |" * 10,
    ]
    for claim in CLAIMS:
        if claim.table not in found:
            lines.append(f"| {claim.words} | {claim.table} | {_sides(claim)} | | {claim.factor:g} | | | | | not run yet |")
            continue
        table = found[claim.table]
        lines += [_ordering(claim, table, network) for network in (table["networks"] if claim.left[2] is None else [""])]
    return "\n".join(lines) + "\n"


def _ordering(claim: Claim, found: Found, network: str) -> str:
    (row, column, own), (other_row, other_column, other) = claim.left, claim.right
    cells, verdict = [], "not run yet"
    for stop in STOPS:
        left = _values(found, row, column, own or network, stop)
        right = _values(found, other_row, other_column, other or network, stop)
        if not left or not right:
            cells.append("")
            continue
        holds = sum(a <= claim.factor * b for a, b in zip(left, right, strict=True))
        cells.append(f"{np.mean(left) / np.mean(right):.3f} ({holds} of {len(left)})")
        if stop == "auto":
            verdict = _verdict(holds, len(left))
    numbers = [found["paper"].get(r, {}).get(c) for r, c in ((row, column), (other_row, other_column))]
    paper = f"{numbers[0] / numbers[1]:.3f}" if own is None and None not in numbers else ""
    start = f"| {claim.words} | {claim.table} | {_sides(claim)} | {network} | {claim.factor:g} | {paper}"
    return f"{start} | {' | '.join(cells)} | {verdict} |"


def _verdict(holds: int, seeds: int) -> str:
    if seeds < 3:
        return f"so far it {'holds' if holds == seeds else 'fails' if holds == 0 else 'does both'}"
    return "**holds**" if holds == seeds else "**fails**" if holds == 0 else "now and then"


def _sides(claim: Claim) -> str:
    (row, column, own), (other_row, other_column, other) = claim.left, claim.right
    if own is not None:
        return f"{column}: {own} over {other}"
    return (
        f"{column} over {other_column}" + (f" at {row}" if row != "All" else "")
        if row == other_row
        else f"{column}: {row} over {other_row}"
    )


def _stops(found: Mapping[str, Found]) -> str:
    """How far the two stops that could be used are from the one that could not."""
    ratios: dict[str, list[tuple[float, float]]] = {}
    for name in TABLES:
        for cell in found.get(name, {}).get("cells", []):
            who = cell["column"] if cell["column"] in ("Mean", "Bilat.", "Jet") else cell["network"]
            ratios.setdefault(who, []).append((cell["fixed"] / cell["oracle"], cell["auto"] / cell["oracle"]))
    lines = [
        "## Where to stop\n",
        "Error at the stop over that at the oracle's, over all cells of the tables below: mean, worst, and share within 5 %.\n",
        "| who | cells | fixed: mean, worst, within 5 % | automatic: mean, worst, within 5 % |",
        "| --- | --- | --- | --- |",
    ]
    for who, pairs in ratios.items():
        table = np.array(sorted(set(pairs)))
        cells = [f"{c.mean():.3f}, {c.max():.3f}, {100 * (c <= 1.05).mean():.0f} %" for c in table.T]
        lines.append(f"| {who} | {len(table)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n" if ratios else ""


def _values(found: Found, row: str, column: str, network: str, stop: str) -> list[float]:
    """One for each seed."""
    wanted = {"row": row, "column": column, "network": network}
    return [cell[stop] for cell in found["cells"] if wanted.items() <= cell.items()]


def _mean(found: Found, row: str, column: str, network: str, stop: str) -> float:
    values = _values(found, row, column, network, stop)
    return float(np.mean(values)) if values else np.nan


def _spread(found: Found, row: str, column: str, network: str, stop: str) -> str:
    """Mean and, of several seeds, standard deviation."""
    values = _values(found, row, column, network, stop)
    if not values:
        return "–"
    return f"{np.mean(values):.3f}" + (f" ± {np.std(values, ddof=1):.3f}" if len(values) > 1 else "")


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
