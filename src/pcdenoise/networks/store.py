"""Model folders: weights (safetensors), config and card. Nothing is unpickled and no code comes from a file.

NAME/weights.safetensors   tensors, float32
NAME/config.json           {"network": …, "settings": {…}, "training": {…}, "scores": {…}}
NAME/README.md             the card: data, noise, seed, command, scores
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from pcdenoise.errors import ModelError, in_one_line
from pcdenoise.whole_files import replaced

if TYPE_CHECKING:
    from pcdenoise.networks.mcconv import MCConvNetwork
    from pcdenoise.networks.projection import ProjectionNetwork

Network: TypeAlias = "ProjectionNetwork | MCConvNetwork"

WEIGHTS, CONFIG, CARD = "weights.safetensors", "config.json", "README.md"
DEFAULT = "default"
_LARGEST_FILE = {WEIGHTS: 64 << 20, CONFIG: 1 << 20}  # bytes; JSON takes up to thirty times its size in memory


class _Settings(BaseModel):
    """Bounds keep a tampered file from asking for more memory than any real network needs."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _ProjectionSettings(_Settings):
    channels: int = Field(ge=4, le=256)
    neighbours: int = Field(ge=6, le=256)
    rounds: tuple[Annotated[int, Field(ge=1, le=8)], ...] = Field(min_length=1, max_length=8)
    landing_rounds: int = Field(ge=1, le=8)


class _MCConvSettings(_Settings):
    width: int = Field(ge=4, le=256)
    sampled: int | None = Field(ge=1, le=1024)
    dropout: float = Field(ge=0, lt=1)
    unit: float | None = Field(gt=0, allow_inf_nan=False)


class ModelConfig(BaseModel):
    """What config.json holds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    network: Literal["projection", "mcconv"]
    settings: _ProjectionSettings | _MCConvSettings
    summary: str = ""
    training: dict[str, Any] = Field(default_factory=dict)
    scores: dict[str, Any] = Field(default_factory=dict)

    @field_validator("settings", mode="before")
    @classmethod
    def _of_the_network(cls, settings: Any, info: ValidationInfo) -> _Settings:
        kinds: dict[Any, type[_Settings]] = {"projection": _ProjectionSettings, "mcconv": _MCConvSettings}
        return kinds[info.data["network"]].model_validate(settings) if "network" in info.data else settings


@dataclass(frozen=True)
class Model:
    """A network ready to run and where it came from. sha256: of the weights file."""

    name: str
    network: Network
    config: ModelConfig
    sha256: str


@dataclass(frozen=True)
class ModelInfo:
    """A model folder as `pcdenoise models` lists it."""

    name: str
    path: Path
    config: ModelConfig
    n_parameters: int


def shipped() -> Path:
    """The folder of the models that come with the program."""
    return Path(str(resources.files("pcdenoise"))) / "models"


def available() -> Iterator[ModelInfo]:
    """The shipped models, by name."""
    for folder in sorted(path.parent for path in shipped().glob(f"*/{CONFIG}")):
        yield info(folder)


def info(folder: Path) -> ModelInfo:
    """Reads a model folder's config and counts its parameters. Raises ModelError."""
    config = _read_config(folder)
    network = _build(config)
    return ModelInfo(folder.name, folder, config, sum(p.numel() for p in network.parameters()))


def load(name_or_folder: str | Path = DEFAULT) -> Model:
    """The model in that folder, or of that name among the shipped ones. Raises ModelError when missing, damaged or tampered."""
    folder = _find(name_or_folder)
    config = _read_config(folder)
    network = _build(config)
    path = folder / WEIGHTS
    data = _read(path)
    from safetensors import SafetensorError
    from safetensors.torch import load as parse

    try:
        tensors = parse(data)
    except (SafetensorError, ValueError, KeyError) as fault:
        raise ModelError(f"{path}: not a safetensors file ({in_one_line(fault)}); copy the model folder again") from None
    types = {name: tensor.dtype for name, tensor in network.state_dict().items()}
    for name, tensor in tensors.items():
        if tensor.dtype != types.get(name, tensor.dtype):  # a conversion could make infinities of numbers
            raise ModelError(f"{path}: {name} is {tensor.dtype}, not {types[name]}; copy the model folder again")
    try:
        network.load_state_dict(tensors)
    except RuntimeError as fault:
        raise ModelError(f"{path}: weights do not fit {CONFIG} ({in_one_line(fault)}); copy the model folder again") from None
    if not all(bool(t.isfinite().all()) for t in tensors.values()):
        raise ModelError(f"{path}: weights are not all numbers; copy the model folder again")
    return Model(folder.name, network.eval(), config, hashlib.sha256(data).hexdigest())


def save(
    network: Network, folder: Path, *, summary: str, training: Mapping[str, Any], scores: Mapping[str, Any], card: str
) -> None:
    """Writes a model folder; every file appears whole or not at all. Raises ModelError if one cannot be written."""
    from safetensors.torch import save as serialise

    config = _describe(network).model_copy(update={"summary": summary, "training": dict(training), "scores": dict(scores)})
    files = {
        WEIGHTS: serialise({name: tensor.detach().contiguous() for name, tensor in network.state_dict().items()}),
        CONFIG: (config.model_dump_json(indent=1) + "\n").encode(),
        CARD: card.encode(),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            with replaced(folder / name) as file:
                file.write(data)
    except OSError as fault:
        raise ModelError(f"{folder}: cannot be saved ({fault.strerror}); check permissions and free space") from None


def _find(name_or_folder: str | Path) -> Path:
    folder = Path(name_or_folder)
    if (folder / CONFIG).is_file():
        return folder
    inside = shipped() / folder
    if len(folder.parts) == 1 and (inside / CONFIG).is_file():
        return inside
    names = ", ".join(path.parent.name for path in sorted(shipped().glob(f"*/{CONFIG}"))) or "none"
    raise ModelError(f"{name_or_folder}: no such model; give a folder made by `pcdenoise train` or one of: {names}")


def _read(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():
            raise ModelError(f"{path}: is no regular file; copy the model folder again")
        if path.stat().st_size > _LARGEST_FILE[path.name]:
            raise ModelError(f"{path}: larger than any model of this program; copy the model folder again")
        return path.read_bytes()
    except OSError as fault:
        raise ModelError(f"{path}: cannot be read ({fault.strerror}); copy the model folder again") from None


def _read_config(folder: Path) -> ModelConfig:
    path = folder / CONFIG
    try:
        return ModelConfig.model_validate(json.loads(_read(path)))
    except (ValidationError, ValueError, RecursionError) as fault:
        raise ModelError(f"{path}: not a model's config ({in_one_line(fault)}); copy the model folder again") from None


def _describe(network: Network) -> ModelConfig:
    from pcdenoise.networks.mcconv import MCConvNetwork

    kind = "mcconv" if isinstance(network, MCConvNetwork) else "projection"
    return ModelConfig.model_validate({"network": kind, "settings": asdict(network.config)})


def _build(config: ModelConfig) -> Network:
    from pcdenoise.networks.mcconv import MCConvConfig, MCConvNetwork
    from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

    settings = config.settings.model_dump()
    if config.network == "mcconv":
        return MCConvNetwork(MCConvConfig(**settings))
    return ProjectionNetwork(ProjectionConfig(**settings))
