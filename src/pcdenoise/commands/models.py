"""`pcdenoise models`: what models there are and what they are for."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcdenoise.commands import options
from pcdenoise.commands.console import table

if TYPE_CHECKING:
    from pcdenoise.networks.store import ModelInfo

_LISTED = {"10000_0.02": "10K, 2 %", "50000_0.02": "50K, 2 %"}
"""Cells of the benchmark whose scores the list shows: points and noise."""


def models(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Print this model's card.", show_default=False)] = None,
    as_json: options.Json = False,
    config: options.Config = None,
) -> None:
    """List the models that ship, with their scores, or print one's card: training data, noise, all scores, licence.

    Scores are squared Chamfer distance / squared distance to the surface on the benchmark, × 1e-4, lower is better.
    """
    from pcdenoise.networks import store

    if name is not None:
        chosen = store.info(store.find(name))
        card = (chosen.path / store.CARD).read_text(encoding="utf-8").strip()
        print(json.dumps({**_as_json(chosen), "card": card}, indent=2) if as_json else card)
    elif as_json:
        print(json.dumps([_as_json(model) for model in store.available()], indent=2))
    else:
        rows = [
            [model.name, f"{model.n_parameters:,}", model.config.network, *_scores(model), model.config.summary]
            for model in store.available()
        ]
        print(table(["model", "parameters", "network", *_LISTED.values(), "what"], rows, left={0, 2, 3 + len(_LISTED)}))


def _scores(model: ModelInfo) -> list[str]:
    found = (model.config.scores.get(cell) for cell in _LISTED)
    return ["–" if score is None else f"{score['cd']:.2f} / {score['p2s']:.2f}" for score in found]


def _as_json(model: ModelInfo) -> dict[str, Any]:
    return {
        "name": model.name,
        "path": str(model.path),
        "n_parameters": model.n_parameters,
        **model.config.model_dump(mode="json"),
    }
