"""The training loop: clouds in, a model folder out; stops on time or steps, saves as it goes, resumes.

Not here: clouds (dataset.py), signals (supervised.py), the folder's format (networks.store).
"""

from __future__ import annotations

import copy
import json
import math
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from pcdenoise.config import TrainConfig
from pcdenoise.errors import ModelError, UsageError, in_one_line
from pcdenoise.learning.dataset import CloudSource, TrainingCloud, surfaces_from
from pcdenoise.learning.supervised import supervised_loss
from pcdenoise.networks import store
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

CHECKPOINT, LOG = ".checkpoint.safetensors", "training.jsonl"
_SAVE_EVERY, _LOG_EVERY = 200, 50
_DEFAULT_BUDGET_S = 20 * 60.0
_AVERAGED_STEPS = 500  # the shipped weights are a running mean over about so many steps
_WARM_UP_STEPS = 100


@dataclass(frozen=True)
class TrainingSummary:
    """What a run did. error: mean squared distance to the surface over squared noise in the last hundred steps."""

    steps: int
    points: int
    seconds: float
    error: float

    def __str__(self) -> str:
        minutes = self.seconds / 60
        return f"{self.steps} steps, {self.points / 1e6:.1f} M points, {minutes:.1f} min, error {self.error:.3f} of the noise"


def train(
    config: TrainConfig,
    output: Path,
    *,
    init: str | None = None,
    resume: bool = False,
    on_progress: Callable[[str, float], None] | None = None,
) -> TrainingSummary:
    """Learns from the surfaces in `config.data` and writes the model folder `output`.

    The folder also gets training.jsonl, one line per fifty steps. An interrupt (Ctrl-C) saves what was learned and is passed on.
    Raises UsageError when there is nothing to resume or to learn from.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    output.mkdir(parents=True, exist_ok=True)
    run = _Run(config, output, _initial(config, init))
    if resume:
        run.load()
    elif (output / CHECKPOINT).exists():
        raise UsageError(f"{output}: holds an unfinished run; give --resume to go on with it, or another folder")
    with tempfile.TemporaryDirectory(prefix="pcdenoise-surfaces-") as cache:
        source = CloudSource(surfaces_from(config.data, config.seed, Path(cache)), config.seed)
        try:
            for cloud in source.clouds(run.step, run.network.config.neighbours):
                if run.progress >= 1:
                    break
                run.learn(supervised_loss, cloud)
                if on_progress is not None:
                    on_progress(f"step {run.step}, error {run.recent_error:.3f}", run.progress)
        finally:
            run.save_model()
    (output / CHECKPOINT).unlink(missing_ok=True)
    return run.summary


def _initial(config: TrainConfig, init: str | None) -> ProjectionNetwork:
    """A new network, or one with the weights and sizes of another model; only the number of neighbours is free then."""
    if init is not None:
        learned = store.load(init).network
        network = ProjectionNetwork(replace(learned.config, neighbours=config.neighbours))
        network.load_state_dict(learned.state_dict())
        return network
    return ProjectionNetwork(ProjectionConfig(config.channels, config.neighbours, config.rounds, config.landing_rounds))


class _Run:
    """Weights, their running mean, the optimiser and the record of one training run."""

    def __init__(self, config: TrainConfig, output: Path, network: ProjectionNetwork) -> None:
        self.config, self.output, self.network = config, output, network
        self.average = copy.deepcopy(network)
        self.optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, betas=(0.9, 0.98), weight_decay=1e-4)
        self.step, self.points, self._before_s, self._began = 0, 0, 0.0, time.monotonic()
        self._errors: list[float] = []

    @property
    def seconds(self) -> float:
        """Time spent learning, over all resumed runs."""
        return self._before_s + time.monotonic() - self._began

    @property
    def progress(self) -> float:
        """Share of the budget or the steps that is spent."""
        by_steps = self.step / self.config.steps if self.config.steps else 0.0
        budget_s = self.config.budget_s or (None if self.config.steps else _DEFAULT_BUDGET_S)
        return max(by_steps, self.seconds / budget_s if budget_s else 0.0)

    @property
    def recent_error(self) -> float:
        """Mean error of the last hundred clouds, infinite before the first."""
        return sum(self._errors) / len(self._errors) if self._errors else math.inf

    @property
    def summary(self) -> TrainingSummary:
        """The record so far."""
        return TrainingSummary(self.step, self.points, self.seconds, self.recent_error)

    def learn(self, signal: Callable[[ProjectionNetwork, TrainingCloud], tuple[Tensor, Tensor]], cloud: TrainingCloud) -> None:
        """One step on one cloud; a cloud without judged points or with a loss that is no number teaches nothing."""
        self.step += 1
        if not cloud.on_surface.any():
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.learning_rate * min(1, self.step / _WARM_UP_STEPS) * _cosine(self.progress)
        loss, error = signal(self.network, cloud)
        if not torch.isfinite(loss):
            return
        self.optimiser.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        keep = min(1 - 1 / _AVERAGED_STEPS, self.step / (self.step + 10))
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)
        self._errors = [*self._errors[-99:], float(error.detach())]
        self.points += len(cloud.seeds) + len(cloud.judged)
        if self.step % _LOG_EVERY == 0:
            self._log()
        if self.step % _SAVE_EVERY == 0:
            self.save()

    def _log(self) -> None:
        line = {"step": self.step, "error": self.recent_error, "points": self.points, "seconds": round(self.seconds, 1)}
        with (self.output / LOG).open("a") as log:
            log.write(json.dumps(line) + "\n")

    def save(self) -> None:
        """Everything that `load` needs, as safetensors: weights, running mean, the optimiser's moments, the record."""
        from safetensors.torch import save_file

        tensors = {f"network.{n}": t for n, t in self.network.state_dict().items()}
        tensors |= {f"average.{n}": t for n, t in self.average.state_dict().items()}
        for name, parameter in self.network.named_parameters():
            for key, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"{key}.{name}"] = value
        record = {"step": self.step, "points": self.points, "seconds": self.seconds, "errors": self._errors}
        part = self.output / f"{CHECKPOINT}.part"
        save_file({n: t.detach().contiguous().clone() for n, t in tensors.items()}, part, metadata={"record": json.dumps(record)})
        os.replace(part, self.output / CHECKPOINT)

    def load(self) -> None:
        """Continues where `save` left off. Raises UsageError without a checkpoint, ModelError with one that does not fit."""
        from safetensors import SafetensorError, safe_open

        path = self.output / CHECKPOINT
        if not path.exists():
            raise UsageError(f"{self.output}: nothing to resume; leave --resume out to start a run")
        try:
            with safe_open(path, framework="pt") as file:
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
                record = json.loads(file.metadata()["record"])
            self.network.load_state_dict(_part(tensors, "network."))
            self.average.load_state_dict(_part(tensors, "average."))
        except (SafetensorError, RuntimeError, KeyError, ValueError) as fault:
            said = in_one_line(fault)
            raise ModelError(f"{path}: not a checkpoint of this run ({said}); leave --resume out to start again") from None
        for name, parameter in self.network.named_parameters():
            state = {key: tensors[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq") if f"{key}.{name}" in tensors}
            if state:
                self.optimiser.state[parameter] = state
        self.step, self.points, self._before_s = record["step"], record["points"], record["seconds"]
        self._errors, self._began = record["errors"], time.monotonic()

    def save_model(self) -> None:
        """Checkpoint and model folder, the latter with the running mean of the weights."""
        self.save()
        settings = self.config.model_dump(mode="json", exclude={"threads"})
        training = {**settings, "steps_done": self.step, "points": self.points, "minutes": round(self.seconds / 60, 1)}
        store.save(
            self.average,
            self.output,
            summary=f"{self.config.method}: {self.summary}",
            training=training,
            scores={},
            card=self._card(),
        )

    def _card(self) -> str:
        rows = "\n".join(f"| {name} | {value} |" for name, value in self.config.model_dump(mode="json").items())
        return (
            f"# {self.output.resolve().name}\n\nA projection network trained with pcdenoise: {self.summary}.\n\n"
            f"| setting | value |\n| --- | --- |\n{rows}\n\nThe curve is in {LOG}.\n"
        )


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _cosine(progress: float) -> float:
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1)))
