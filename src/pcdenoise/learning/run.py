"""One training run: weights and their running mean, the optimiser, the curve, a checkpoint to go on from, the model it leaves.

Not here: what it learns from and in what order (trainer.py), signals (supervised.py, split.py, total.py), the model folder's
format (networks.store).
"""

from __future__ import annotations

import copy
import json
import math
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pcdenoise.config import TrainConfig
from pcdenoise.errors import ModelError, UsageError, in_one_line
from pcdenoise.learning.dataset import TrainingCloud
from pcdenoise.learning.ranks import Ranks
from pcdenoise.learning.split import held_out_error
from pcdenoise.networks import store
from pcdenoise.networks.projection import ProjectionNetwork
from pcdenoise.whole_files import replaced

CHECKPOINT, TEACHER, LOG = ".checkpoint.safetensors", ".teacher", "training.jsonl"
_SAVE_EVERY, _LOG_EVERY = 200, 50
_DEFAULT_BUDGET_S = 20 * 60.0
_AVERAGED_STEPS = 500  # the shipped weights are a running mean over about so many steps
_WARM_UP_STEPS = 100

Signal = Callable[[Any, Any, float, np.random.Generator], tuple[Tensor, Tensor]]
"""From a network, a cloud, the progress from 0 to 1 and random numbers to the loss and to the error that is reported."""

OnProgress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is done, 0 to 1."""


@dataclass(frozen=True)
class TrainingSummary:
    """What a run did. error: root mean square distance to the targets in the last hundred steps, of the noise.

    The targets are on the surface; with `total` they are the points that its prior draws.
    verdict: which weights are kept after an adaptation, and why, and how scans are aligned; else empty.
    """

    steps: int
    points: int
    seconds: float
    error: float
    verdict: str = ""

    def __str__(self) -> str:
        minutes = self.seconds / 60
        done = f"{self.steps:,} steps, {self.points:,} points, {minutes:.1f} min, {self.error:.3f} of the noise off its targets"
        return f"{done}; {self.verdict}" if self.verdict else done


class Run:
    """Weights, their running mean, the optimiser and the record of one training run."""

    def __init__(self, config: TrainConfig, output: Path, network: store.Network, ranks: Ranks, init: str | None) -> None:
        self.config, self.output, self.network, self.ranks, self.init = config, output, network, ranks, init
        self.average = copy.deepcopy(network)
        self._plan = _PLANS[config.network]
        self._peak = config.learning_rate or self._plan.learning_rate
        self.optimiser = self._plan.optimiser(network.parameters(), lr=self._peak)
        self.step, self.points, self._before_s, self._began = 0, 0, 0.0, time.monotonic()
        self._errors: list[float] = []
        self._verdict = ""
        self.align_by: tuple[str, ...] = ()
        self._logged = 0

    @property
    def seconds(self) -> float:
        """Time spent learning, over all resumed runs."""
        return self._before_s + time.monotonic() - self._began

    @property
    def progress(self) -> float:
        """Share of the budget or the steps that is spent, by the first process's clock; all processes must ask together."""
        return self._progress_at(self.step)

    def _progress_at(self, step: int) -> float:
        by_steps = step / self.config.steps if self.config.steps else 0.0
        budget_s = self.config.budget_s or (None if self.config.steps else _DEFAULT_BUDGET_S)
        return max(by_steps, self.ranks.agreed(self.seconds) / budget_s if budget_s else 0.0)

    @property
    def recent_error(self) -> float:
        """Root mean square error of the last hundred clouds, infinite before the first."""
        return math.sqrt(sum(self._errors) / len(self._errors)) if self._errors else math.inf

    @property
    def state(self) -> str:
        """How far it is, in words."""
        off = f", {self.recent_error:.3f} of the noise off" if self._errors else ""
        return f"step {self.step:,}{off}"

    @property
    def summary(self) -> TrainingSummary:
        """The record so far."""
        aligned = f"; scans are aligned by {' and '.join(self.align_by)} first" if self.align_by else ""
        return TrainingSummary(self.step, self.points, self.seconds, self.recent_error, self._verdict + aligned)

    def learn(self, signal: Signal, cloud: Any) -> None:
        """One step on one cloud a process; one without judged points or with a loss that is no number teaches nothing."""
        number = self.step + 1
        progress = self._progress_at(number)
        self.optimiser.zero_grad()
        errors = self._differentiate(signal, cloud, progress)
        shared = [_gradient(parameter) for parameter in self.network.parameters()] if self.ranks.count > 1 else []
        shared += [buffer for buffer in self.network.buffers() if buffer.is_floating_point()]
        figures = [sum(errors), cloud.n_points if errors else 0]
        error, n_points, n_taught = self.ranks.averaged(shared, figures, len(errors))
        if not n_taught:
            self.step = number
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self._peak * self._plan.rate(number, progress)
        nn.utils.clip_grad_norm_(self.network.parameters(), self._plan.clip)
        self.optimiser.step()
        keep = min(1 - 1 / _AVERAGED_STEPS, number / (number + 10)) if self._plan.is_averaged else 0.0
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)
            for kept, current in zip(self.average.buffers(), self.network.buffers(), strict=True):
                kept.copy_(current)
        self._errors = [*self._errors[-99:], error / n_taught]
        self.points, self.step = self.points + int(n_points), number
        if self.step % _LOG_EVERY == 0 and self.ranks.is_first:
            self._log()
        if self.step % _SAVE_EVERY == 0 and self.ranks.is_first:
            self.save()

    def _differentiate(self, signal: Signal, cloud: Any, progress: float) -> list[float]:
        """Leaves the gradient of this process's cloud in the network; gives its error, or nothing if it teaches nothing."""
        if not cloud.n_points:
            return []
        rng = np.random.default_rng([self.config.seed, 17, self.ranks.number(self.step + 1)])
        loss, error = signal(self.network, cloud, min(progress, 1.0), rng)
        if not torch.isfinite(loss):
            return []
        torch.autograd.backward(loss)
        return [float(error.detach())]

    def judge(self, before: ProjectionNetwork, clouds: list[TrainingCloud], on_progress: OnProgress) -> None:
        """Goes back to the weights of `before` unless what was learned is better on held-out points, by two standard errors."""
        assert isinstance(self.average, ProjectionNetwork)
        errors = np.full((2, len(clouds)), math.nan)
        for i, cloud in enumerate(clouds):
            errors[:, i] = [held_out_error(weights, cloud, self.config.threads or -1) for weights in (before, self.average)]
            on_progress("judging", (i + 1) / len(clouds))
        old, new = errors
        known = np.isfinite(old) & np.isfinite(new)
        gain = old[known] - new[known]
        better = len(gain) > 1 and gain.mean() > 2 * gain.std(ddof=1) / math.sqrt(len(gain))
        if not better:
            self.average.load_state_dict(before.state_dict())
        if not known.any():
            self._verdict = "too few points were held out to judge by: the starting weights are kept"
            return
        kept = "the adapted" if better else "the starting"
        heights = [math.sqrt(float(squared[known].mean())) for squared in (old, new)]
        self._verdict = f"over held-out points {heights[0]:.4f} before, {heights[1]:.4f} after: {kept} weights are kept"

    def _log(self) -> None:
        line = {"step": self.step, "error": self.recent_error, "points": self.points, "seconds": round(self.seconds, 1)}
        with (self.output / LOG).open("a" if self._logged else "w") as log:
            log.write(json.dumps(line) + "\n")
        self._logged = self.step

    def save(self) -> None:
        """Everything that `load` needs, as safetensors: weights, running mean, the optimiser's moments, the record."""
        from safetensors.torch import save

        tensors = {f"network.{n}": t for n, t in self.network.state_dict().items()}
        tensors |= {f"average.{n}": t for n, t in self.average.state_dict().items()}
        for name, parameter in self.network.named_parameters():
            for key, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"{key}.{name}"] = value
        record = {"step": self.step, "points": self.points, "seconds": self.seconds, "errors": self._errors}
        length = {"steps": self.config.steps, "budget_s": self.config.budget_s}
        record |= {"settings": self._settings, "init": self.init, "length": length}
        whole = {name: tensor.detach().contiguous().clone() for name, tensor in tensors.items()}
        with replaced(self.output / CHECKPOINT) as file:
            file.write(save(whole, {"record": json.dumps(record)}))

    def load(self) -> None:
        """Continues where `save` left off. Raises UsageError without a checkpoint and with other settings, ModelError with one
        that does not fit."""
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        path = self.output / CHECKPOINT
        record = record_of(path)
        if others := [name for name, value in self._settings.items() if record["settings"].get(name) != value]:
            named = ", ".join(f"--{name.replace('_', '-')} {record['settings'].get(name)}" for name in others)
            raise UsageError(f"{self.output}: the run to resume has {named}; give the same, or start again with --overwrite")
        try:
            tensors = load_file(path)
            self.network.load_state_dict(_part(tensors, "network."))
            self.average.load_state_dict(_part(tensors, "average."))
        except (SafetensorError, RuntimeError, KeyError, ValueError) as fault:
            raise _no_checkpoint(path, fault) from None
        for name, parameter in self.network.named_parameters():
            state = {key: tensors[f"{key}.{name}"] for key in ("step", "exp_avg", "exp_avg_sq") if f"{key}.{name}" in tensors}
            if state:
                self.optimiser.state[parameter] = state
        self.step, self.points, self._before_s = record["step"], record["points"], record["seconds"]
        self._errors, self._began = record["errors"], time.monotonic()
        if self.ranks.is_first:
            self._forget_steps_after()

    def _forget_steps_after(self) -> None:
        """Cuts from the log what was learned after the checkpoint, since it is learned again."""
        kept = [line for line in curve_of(self.output) if line["step"] <= self.step]
        if kept:
            with replaced(self.output / LOG) as log:
                log.write("".join(json.dumps(line) + "\n" for line in kept).encode())
            self._logged = kept[-1]["step"]

    @property
    def _settings(self) -> dict[str, Any]:
        """What a run that is resumed must have in common with its beginning."""
        return self.config.model_dump(mode="json", exclude={"threads", "steps", "budget_s"})

    def save_model(self) -> None:
        """Checkpoint, curve and model folder, the latter with the running mean of the weights."""
        self.save()
        if self._errors and self._logged != self.step:
            self._log()
        settings = self.config.model_dump(mode="json", exclude={"threads"}) | {"init": self.init}
        training = {**settings, "steps_done": self.step, "points": self.points, "minutes": round(self.seconds / 60, 1)}
        store.save(
            self.average,
            self.output,
            summary=f"{self.config.method}: {self.summary}",
            training=training,
            scores={},
            card=self._card(),
            align_by=self.align_by,
        )

    def _card(self) -> str:
        settings = {**self.config.model_dump(mode="json"), "init": self.init}
        rows = "\n".join(f"| {name} | {value} |" for name, value in settings.items() if value is not None)
        return (
            f"# {self.output.resolve().name}\n\nA {self.config.network} network trained with pcdenoise: {self.summary}.\n\n"
            f"| setting | value |\n| --- | --- |\n{rows}\n\nThe curve is in {LOG}.\n"
        )


def discard(output: Path) -> None:
    """Forgets what an unfinished run left in its folder, so that another one can begin there; a model in it stays."""
    (output / CHECKPOINT).unlink(missing_ok=True)
    for teacher in output.glob(f"{TEACHER}-*"):
        shutil.rmtree(teacher)


def curve_of(output: Path) -> list[dict[str, Any]]:
    """The lines of a run's log, without one that was cut off as it was written."""
    lines = []
    for line in (output / LOG).read_text().splitlines() if (output / LOG).exists() else []:
        with suppress(ValueError):
            lines.append(json.loads(line))
    return lines


def record_of(path: Path) -> dict[str, Any]:
    """What a checkpoint says of its run. Raises UsageError without a checkpoint, ModelError with one that is none."""
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise UsageError(f"{path.parent}: nothing to resume; leave --resume out to start a run")
    try:
        with safe_open(path, framework="pt") as file:
            record: dict[str, Any] = json.loads(file.metadata()["record"])
            record["settings"], record["step"], record["init"], record["length"]
    except (SafetensorError, KeyError, ValueError, TypeError) as fault:
        raise _no_checkpoint(path, fault) from None
    return record


def _no_checkpoint(path: Path, fault: Exception) -> ModelError:
    return ModelError(f"{path}: not a checkpoint of this run ({in_one_line(fault)}); leave --resume out to start again")


def _gradient(parameter: nn.Parameter) -> Tensor:
    """The gradient to be averaged with others', zero where this process has none."""
    if parameter.grad is None:
        parameter.grad = torch.zeros_like(parameter)
    return parameter.grad


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _cosine(step: int, progress: float) -> float:
    return min(1, step / _WARM_UP_STEPS) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1))))


def _stairs(_step: int, progress: float) -> float:
    """As released: times 0.7 after each twenty-fifth of the training, down to a five-hundredth."""
    return max(0.7 ** math.floor(25 * min(progress, 1)), 0.002)


@dataclass(frozen=True)
class _Plan:
    """How a kind of network is trained. rate: share of the peak learning rate at a step and a progress from 0 to 1."""

    learning_rate: float
    optimiser: Callable[..., torch.optim.Optimizer]
    rate: Callable[[int, float], float]
    clip: float
    is_averaged: bool


_PLANS = {
    "projection": _Plan(3e-3, partial(torch.optim.AdamW, betas=(0.9, 0.98), weight_decay=1e-4), _cosine, 1.0, True),
    "mcconv": _Plan(5e-3, torch.optim.Adam, _stairs, math.inf, False),
}
