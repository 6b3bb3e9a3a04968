"""Model folders: weights (safetensors), config and card. Nothing is unpickled and no code comes from a file.

Weights are arrays until somebody asks for the network itself: compiled inference (fused.py) does without torch.

NAME/weights.safetensors   tensors, float32
NAME/config.json           {"network": …, "settings": {…}, "align_by": […], "training": {…}, "scores": {…}}
NAME/README.md             the card: data, noise, seed, command, scores
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from pcdenoise.errors import ModelError, in_one_line
from pcdenoise.whole_files import put

if TYPE_CHECKING:
    from pcdenoise.networks.mcconv import MCConvNetwork
    from pcdenoise.networks.projection import ProjectionNetwork

Network: TypeAlias = "ProjectionNetwork | MCConvNetwork"
Weights: TypeAlias = Mapping[str, NDArray[Any]]
"""Named as torch names the network's parameters and buffers."""

WEIGHTS, CONFIG, CARD = "weights.safetensors", "config.json", "README.md"
DEFAULT = "default"
_LARGEST_FILE = {WEIGHTS: 64 << 20, CONFIG: 1 << 20}  # bytes; JSON takes up to thirty times its size in memory


class _Settings(BaseModel):
    """Bounds keep a tampered file from asking for more memory than any real network needs."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ProjectionSettings(_Settings):
    """Those of `networks.projection.ProjectionConfig`."""

    channels: int = Field(ge=4, le=256)
    neighbours: int = Field(ge=6, le=256)
    rounds: tuple[Annotated[int, Field(ge=1, le=8)], ...] = Field(min_length=1, max_length=8)
    landing_rounds: int = Field(ge=1, le=8)
    messages: int = Field(0, ge=0, le=256)

    @property
    def message_channels(self) -> int:
        """Channels of a message: as many as features where a model does not say."""
        return self.messages or self.channels


class _MCConvSettings(_Settings):
    width: int = Field(ge=4, le=256)
    sampled: int | None = Field(ge=1, le=1024)
    dropout: float = Field(ge=0, lt=1)
    unit: float | None = Field(gt=0, allow_inf_nan=False)


class ModelConfig(BaseModel):
    """What config.json holds. align_by: columns by which the scans it was adapted to are aligned, see denoising.alignment."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    network: Literal["projection", "mcconv"]
    settings: ProjectionSettings | _MCConvSettings
    align_by: tuple[str, ...] = ()
    summary: str = ""
    training: dict[str, Any] = Field(default_factory=dict)
    scores: dict[str, Any] = Field(default_factory=dict)

    @field_validator("settings", mode="before")
    @classmethod
    def _of_the_network(cls, settings: Any, info: ValidationInfo) -> _Settings:
        kinds: dict[Any, type[_Settings]] = {"projection": ProjectionSettings, "mcconv": _MCConvSettings}
        return kinds[info.data["network"]].model_validate(settings) if "network" in info.data else settings


@dataclass(frozen=True)
class Model:
    """A network's weights and where they came from. sha256: of the weights file."""

    name: str
    config: ModelConfig
    sha256: str
    weights: Weights = field(compare=False, repr=False)

    @classmethod
    def of(cls, network: Network, name: str) -> Model:
        """A model of a network that is in no file."""
        return cls(name, _describe(network), "", _weights(network))

    @cached_property
    def network(self) -> Network:
        """The network itself, ready to run. Imports torch."""
        import torch

        network = _build(self.config)
        network.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in self.weights.items()})
        return network.eval()


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
    return ModelInfo(folder.name, folder, config, _n_parameters(config))


def load(name_or_folder: str | Path = DEFAULT) -> Model:
    """The model in that folder, or of that name among the shipped ones. Raises ModelError when missing, damaged or tampered."""
    folder = find(name_or_folder)
    config = _read_config(folder)
    data = _read(folder / WEIGHTS)
    return Model(folder.name, config, hashlib.sha256(data).hexdigest(), _parsed(data, config, folder / WEIGHTS))


def _parsed(data: bytes, config: ModelConfig, path: Path) -> Weights:
    """The arrays in a weights file, all of which are numbers of the kind and shape that the network has."""
    from safetensors import SafetensorError, deserialize

    again = "copy the model folder again"
    try:
        found = dict(deserialize(data))  # type: ignore[no-untyped-call]
    except (SafetensorError, ValueError, KeyError) as fault:
        raise ModelError(f"{path}: not a safetensors file ({in_one_line(fault)}); {again}") from None
    expected = _expected(config)
    if odd := sorted(found.keys() ^ expected.keys()):
        raise ModelError(
            f"{path}: weights do not fit {CONFIG} ({odd[0]} is {'too much' if odd[0] in found else 'missing'}); {again}"
        )
    weights = {}
    for name, (shape, kind) in expected.items():
        tensor = found[name]
        if tensor["dtype"] != kind:  # a conversion could make infinities of numbers
            raise ModelError(f"{path}: {name} is {tensor['dtype']}, not {kind}; {again}")
        if tuple(tensor["shape"]) != shape:
            raise ModelError(f"{path}: weights do not fit {CONFIG} ({name} is {tensor['shape']}, not {list(shape)}); {again}")
        weights[name] = np.frombuffer(tensor["data"], _KINDS[kind]).reshape(shape)
    if not all(np.isfinite(array).all() for array in weights.values()):
        raise ModelError(f"{path}: weights are not all numbers; {again}")
    return weights


def save(
    network: Network,
    folder: Path,
    *,
    summary: str,
    training: Mapping[str, Any],
    scores: Mapping[str, Any],
    card: str,
    align_by: tuple[str, ...] = (),
) -> None:
    """Writes a model folder; every file appears whole or not at all. Raises ModelError if one cannot be written."""
    from safetensors.numpy import save as serialise

    about = {"align_by": align_by, "summary": summary, "training": dict(training), "scores": dict(scores)}
    config = _describe(network).model_copy(update=about)
    files = {
        WEIGHTS: serialise(_weights(network)),
        CONFIG: (config.model_dump_json(indent=1) + "\n").encode(),
        CARD: card.encode(),
    }
    try:
        for name, data in files.items():
            put(folder / name, data)
    except OSError as fault:
        raise ModelError(f"{folder}: cannot be saved ({fault.strerror}); check permissions and free space") from None


def find(name_or_folder: str | Path) -> Path:
    """The folder of a model, or of a shipped one by its name. Raises ModelError if there is none."""
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


def _weights(network: Network) -> dict[str, NDArray[Any]]:
    return {name: tensor.detach().cpu().contiguous().numpy().copy() for name, tensor in network.state_dict().items()}


_KINDS = {"F32": np.float32, "I64": np.int64}
_Expected: TypeAlias = dict[str, tuple[tuple[int, ...], str]]


def _expected(config: ModelConfig) -> _Expected:
    """Shape and kind of number of every array that such a network has."""
    if isinstance(config.settings, ProjectionSettings):
        return {name: (shape, "F32") for name, shape in _projection_shapes(config.settings)}
    kinds = {np.dtype(number): kind for kind, number in _KINDS.items()}
    return {name: (array.shape, kinds[array.dtype]) for name, array in _weights(_build(config)).items()}


def _projection_shapes(sizes: ProjectionSettings) -> Iterator[tuple[str, tuple[int, ...]]]:
    """What `ProjectionNetwork.state_dict` would say, without torch."""
    c, m = sizes.channels, sizes.message_channels
    a_round = {
        "edge.weight": (m, 8), "edge.bias": (m,), "own.weight": (m, c), "their.weight": (m, c), "message.weight": (m, m),
        "message.bias": (m,), "update.weight": (c, 2 * m), "update.bias": (c,), "norm.weight": (c,), "norm.bias": (c,),
    }  # fmt: skip
    stages = {f"stages.{number}": rounds for number, rounds in enumerate(sizes.rounds)}
    for stage, rounds in {**stages, "landing": sizes.landing_rounds}.items():
        yield f"{stage}.embed.weight", (c, 4)
        yield f"{stage}.embed.bias", (c,)
        for number in range(rounds):
            for name, shape in a_round.items():
                yield f"{stage}.rounds.{number}.{name}", shape
        yield f"{stage}.step.head.weight", (3, m)
        yield f"{stage}.step.head.bias", (3,)


def _n_parameters(config: ModelConfig) -> int:
    if isinstance(config.settings, ProjectionSettings):
        return sum(math.prod(shape) for _, shape in _projection_shapes(config.settings))
    return sum(parameter.numel() for parameter in _build(config).parameters())
