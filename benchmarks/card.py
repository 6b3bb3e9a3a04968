"""Puts a benchmark run's scores into a model's card and config.

    python score.py --run "pcdenoise denoise {input} -o {output} --overwrite" --json scores.json
    python benchmarks/card.py scores.json src/pcdenoise/models/default
    python benchmarks/card.py scores.json src/pcdenoise/models/total --iters 3      # what the benchmark was run with

score.py belongs to the benchmark (five shapes that no model is trained or tuned on, at 10K and 50K points), not to this project.
Peers are compared on the shapes that they were run on. Not here: measuring.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

HEADING = "## Scores"
PEERS = ("ScoreDenoise", "CGAL jet", "CGAL bilateral", "MeshLab APSS", "StraightPCF VM", "noisy")

EXPLANATION = """\
`cd / p2s` × 1e-4, lower is better: squared Chamfer distance to a clean Poisson sample, and squared distance to the surface, in
the unit sphere. Mean of {n_shapes} shapes that nothing was trained or tuned on; {passes}. Peers ran on the same
files on the same kind of machine; the classical ones had their parameters tuned *with* the truth. Where a peer ran on fewer
shapes, their number and our score on them stand in brackets. CPU s: the whole process per cloud, start-up included.

```text
python score.py --run "pcdenoise denoise {{input}} -o {{output}}{option} --overwrite" --json scores.json
```
"""


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: one line per cell, ours first, then each peer's `cd / p2s` with ours on its shapes where they are fewer."""
    lines = [
        f"| points, noise | ours | CPU s | {' | '.join(PEERS)} |",
        f"| --- | --- | --- | {' | '.join('---' for _ in PEERS)} |",
    ]
    for row in rows:
        cells = [
            f"{row['n'] // 1000}K, {100 * row['level']:.0f} %",
            f"**{row['cd']:.2f} / {row['p2s']:.3f}**",
            f"{row['cpu_s']:.1f}",
        ]
        for name in PEERS:
            peer = row["peers"].get(name)
            if peer is None:
                cells.append("–")
                continue
            text = f"{peer['cd']:.2f} / {peer['p2s']:.3f}"
            fewer = len(peer["on"]) < len(row["shapes"])
            cells.append(f"{text} ({len(peer['on'])}: {peer['ours']['cd']:.2f} / {peer['ours']['p2s']:.3f})" if fewer else text)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Rewrites the folder's README.md below its scores heading, and the scores in config.json."""
    rows, folder = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    card, config_path = folder / "README.md", folder / "config.json"
    text = card.read_text().split(HEADING)[0].rstrip()
    option = " ".join(["" if folder.name == "default" else f" --model {folder.name}", *sys.argv[3:]])
    passes = "settings as the command says" if sys.argv[3:] else "one pass, default settings"
    explanation = EXPLANATION.format(n_shapes=len(rows[0]["shapes"]), option=option, passes=passes)
    card.write_text(f"{text}\n\n{HEADING}\n\n{explanation}\n{table(rows)}\n")
    config = json.loads(config_path.read_text())
    config["scores"] = {f"{row['n']}_{row['level']}": {key: round(row[key], 3) for key in ("cd", "p2s", "td")} for row in rows}
    config_path.write_text(json.dumps(config, indent=1) + "\n")


if __name__ == "__main__":
    main()
