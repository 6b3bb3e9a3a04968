"""The Python API where it says more than the module behind it: settings by keyword, models by name. Not here: any work."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pcdenoise.cloud.scan import Scan
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising import denoiser
from pcdenoise.denoising.alignment import groups_asked_for
from pcdenoise.denoising.denoiser import Progress, Result
from pcdenoise.errors import UsageError
from pcdenoise.networks import store
from pcdenoise.networks.store import Model


def denoise(
    points: Scan | ArrayLike,
    model: Model | str | Path | None = "default",
    config: DenoiseConfig | None = None,
    on_progress: Progress | None = None,
    **settings: Any,
) -> Result:
    """What `pcdenoise denoise` does to a scan or to (N, 3) points: `.points` of the result are the cleaned ones, row by row.

    model     a Model, the name of a shipped one or a folder; not used by a classical method.
    config    all settings at once; or give them by keyword, under the command's names: iters=2, method="jet", strength=0.5.
    Raises UsageError for points of another shape, an unknown setting or a wrong value, ModelError for a model that is not there.
    """
    rows = np.ascontiguousarray(points.points if isinstance(points, Scan) else points, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise UsageError(f"points: must be an (N, 3) array, got shape {rows.shape}")
    if config is not None and settings:
        raise UsageError(f"{min(settings)}: is given beside config; put it into the config or leave the config out")
    chosen = config or _configured(settings)
    if chosen.method != "network":
        model = None
    loaded = model if isinstance(model, Model) or model is None else store.load(model)
    if not isinstance(points, Scan) and chosen.align_by:
        raise UsageError("align_by: names columns, which an array has not; give a Scan")
    groups = groups_asked_for(points, loaded, chosen) if isinstance(points, Scan) else None
    correction = denoiser.correction_of(rows, groups, loaded, chosen)
    result = denoiser.denoise(rows, loaded, chosen, on_progress, correction=correction)
    return replace(result, figures={**result.figures, **correction.figures})


def _configured(settings: dict[str, Any]) -> DenoiseConfig:
    from pydantic import ValidationError

    try:
        return DenoiseConfig(**settings)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"][:1])) or "settings"
        raise UsageError(f"{name}: {first['msg']}, got {first['input']!r}") from None
