"""pcdenoise cleans noisy point clouds. The Python API, each name loaded on first use so that `import pcdenoise` costs nothing."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from pcdenoise.api import denoise as denoise
    from pcdenoise.cloud.scan import Scan as Scan
    from pcdenoise.config import DenoiseConfig as DenoiseConfig
    from pcdenoise.config import TrainConfig as TrainConfig
    from pcdenoise.evaluation.chamfer import evaluate as evaluate
    from pcdenoise.io import read as read
    from pcdenoise.io import write as write
    from pcdenoise.learning.trainer import train as train
    from pcdenoise.networks.store import load as load_model

_HOMES = {
    "DenoiseConfig": ("pcdenoise.config", "DenoiseConfig"),
    "Scan": ("pcdenoise.cloud.scan", "Scan"),
    "TrainConfig": ("pcdenoise.config", "TrainConfig"),
    "denoise": ("pcdenoise.api", "denoise"),
    "evaluate": ("pcdenoise.evaluation.chamfer", "evaluate"),
    "load_model": ("pcdenoise.networks.store", "load"),
    "read": ("pcdenoise.io", "read"),
    "train": ("pcdenoise.learning.trainer", "train"),
    "write": ("pcdenoise.io", "write"),
}

__all__ = ["DenoiseConfig", "Scan", "TrainConfig", "denoise", "evaluate", "load_model", "read", "train", "write"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
