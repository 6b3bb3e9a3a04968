"""The training loop: clouds in, a model folder out; stops on time or steps, saves as it goes, resumes.

Not here: clouds (dataset.py, sources.py, scans.py), signals (supervised.py, split.py, distill.py, total.py), the folder's format
(networks.store).
"""

from __future__ import annotations

import copy
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pcdenoise.config import TrainConfig
from pcdenoise.errors import ModelError, UsageError, in_one_line
from pcdenoise.learning.dataset import Array, CloudsAhead, CloudSource, TrainingCloud, from_noisy, from_surface, learned_from
from pcdenoise.learning.distill import distilled
from pcdenoise.learning.ranks import Ranks, joined
from pcdenoise.learning.scans import ScanSource, parts_from
from pcdenoise.learning.sources import NoisyClouds, are_scans, noisy_from, surfaces_from
from pcdenoise.learning.split import judge, split_loss
from pcdenoise.learning.supervised import supervised_loss
from pcdenoise.learning.total import total_loss
from pcdenoise.networks import store
from pcdenoise.networks.mcconv import MCConvConfig, MCConvNetwork
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

CHECKPOINT, TEACHER, LOG = ".checkpoint.safetensors", ".teacher", "training.jsonl"
FROM_NOTHING = "none"
"""What `init` says where no model is to start from."""
_SAVE_EVERY, _LOG_EVERY = 200, 50
_DEFAULT_BUDGET_S = 20 * 60.0
_AVERAGED_STEPS = 500  # the shipped weights are a running mean over about so many steps
_WARM_UP_STEPS = 100
_ADAPTING_RATE = 3e-4  # peak learning rate for a model that has learned already
_OWN_LAW = {True: 0.8, False: 0.1}
"""How often distillation puts back a scan's own noise and a synthetic cloud's, rather than a law of synthesis."""
_JUDGED_CLOUDS = 16
_FIRST_LAP = 0.2
"""Share of a distillation whose teacher has learned nothing yet; the laps after it are equally long."""


OnProgress = Callable[[str, float], None]
"""Called with what is being done and the share of it that is done, 0 to 1."""


@dataclass(frozen=True)
class TrainingSummary:
    """What a run did. error: root mean square distance to the targets in the last hundred steps, of the noise.

    The targets are on the surface; with `total` they are the points that its prior draws.
    verdict: which weights are kept after an adaptation, and why; else empty.
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


def train(
    config: TrainConfig,
    output: Path,
    *,
    init: str | None = None,
    resume: bool = False,
    on_progress: OnProgress | None = None,
) -> TrainingSummary:
    """Learns from the surfaces or scans in `config.data` and writes the model folder `output`.

    The folder also gets training.jsonl, one line per fifty steps. An interrupt (Ctrl-C) saves what was learned and is passed on.
    Where split or distill learn from scans alone, the shipped model is adapted to them unless `init` says otherwise ("none": a
    new network), and comes back as it was unless the change shows on a quarter of the points, which no step learns from.
    Under torchrun each process learns from clouds of its own, gradients are averaged, and the first process writes.
    Raises UsageError when there is nothing to resume or to learn from, and when a run is resumed with other settings.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    if resume and init is None:
        init = _record(output / CHECKPOINT).get("init")
    config, init, adapts = _settled(config, init)
    with joined() as ranks:
        run = _Run(config, output, _initial(config, init), ranks, init)
        return _trained(run, adapts, resume, on_progress or (lambda _words, _share: None))


def discard(output: Path) -> None:
    """Forgets what an unfinished run left in its folder, so that another one can begin there; a model in it stays."""
    (output / CHECKPOINT).unlink(missing_ok=True)
    for teacher in output.glob(f"{TEACHER}-*"):
        shutil.rmtree(teacher)


def _trained(run: _Run, adapts: bool, resume: bool, on_progress: OnProgress) -> TrainingSummary:
    config, output, ranks = run.config, run.output, run.ranks
    before = copy.deepcopy(run.network) if adapts else None
    if resume:
        run.load()
    elif (output / CHECKPOINT).exists():
        raise UsageError(f"{output}: holds an unfinished run; give --resume to go on with it, or another folder")
    with tempfile.TemporaryDirectory(prefix="pcdenoise-clouds-") as cache:
        lessons = _lessons(config, Path(cache), adapts)
        output.mkdir(parents=True, exist_ok=True)
        if ranks.is_first and not resume:
            discard(output)
        try:
            for lap in range(lessons.laps):
                until = 1.0 if lap + 1 == lessons.laps else _FIRST_LAP + (1 - _FIRST_LAP) * lap / (lessons.laps - 1)
                if run.progress >= until:
                    continue
                for cloud in lessons.source(lap, run).clouds(
                    ranks.number(run.step), _neighbours(run.network), stride=ranks.count
                ):
                    if run.progress >= until:
                        break
                    run.learn(lessons.signal, cloud)
                    on_progress(f"step {run.step}, {run.recent_error:.3f} of the noise off", run.progress)
            if isinstance(before, ProjectionNetwork) and ranks.is_first:
                run.judge(before, _judges(config, Path(cache), before.config.neighbours), on_progress)
            if not run.points and not adapts:
                raise UsageError(
                    f"{output}: no cloud taught anything in {run.step} steps; learn for longer, or from larger scans"
                )
        finally:
            if ranks.is_first and run.points:
                run.save_model()
    if ranks.is_first:
        if not run.points:
            run.save_model()
        discard(output)
    return run.summary


def _settled(config: TrainConfig, init: str | None) -> tuple[TrainConfig, str | None, bool]:
    """The method, the starting model and the rate where they were left open, and whether a model is adapted to scans."""
    scans = are_scans(config.data)
    method = config.method or ("distill" if scans and not config.pairs and config.network == "projection" else "supervised")
    if method in ("split", "distill") and config.network != "projection":
        raise UsageError(f"--method {method}: trains the projection network alone; leave out --network {config.network}")
    adapts = scans and method in ("split", "distill") and init != FROM_NOTHING
    changes: dict[str, Any] = {"method": method}
    if adapts:
        init = init or store.DEFAULT
        learned = store.load(init).network
        if isinstance(learned, ProjectionNetwork):
            changes["neighbours"] = learned.config.neighbours
        changes["learning_rate"] = config.learning_rate or _ADAPTING_RATE
    return config.model_copy(update=changes), init, adapts


Signal = Callable[[Any, Any, float, np.random.Generator], tuple[Tensor, Tensor]]
"""From a network, a cloud, the progress from 0 to 1 and random numbers to the loss and to the error that is reported."""


@dataclass(frozen=True)
class _Lessons:
    """What is learned from, lap after lap, and how. source: from the lap's number and the run to its clouds."""

    source: Callable[[int, _Run], CloudsAhead[Any]]
    signal: Signal
    laps: int = 1


def _lessons(config: TrainConfig, cache: Path, adapts: bool) -> _Lessons:
    """By method: surfaces, noisy clouds with points held out, clouds that a teacher has cleaned, or targets from a prior."""
    supervised: Signal = lambda network, cloud, _progress, _rng: supervised_loss(network, cloud)  # noqa: E731
    if config.method == "distill":
        return _Lessons(partial(_cleaned, _noisy(config, cache, adapts), cache), supervised, config.laps)
    source: CloudsAhead[Any]
    if config.method == "split":
        draws = [[partial(from_noisy, load) for load in some] for some in _noisy(config, cache, adapts)]
        source = CloudSource(draws, config.seed)
        return _Lessons(lambda _lap, _run: source, lambda network, cloud, _progress, _rng: split_loss(network, cloud))
    if config.method == "supervised" and config.network == "projection" and not config.pairs:
        surfaces = surfaces_from(config.data, config.seed, cache)
        source = CloudSource([[partial(from_surface, load) for load in some] for some in surfaces], config.seed)
        return _Lessons(lambda _lap, _run: source, supervised)
    source = ScanSource(parts_from(config, cache), config)
    return _Lessons(
        lambda _lap, _run: source,
        lambda network, cloud, progress, rng: total_loss(network, cloud, progress, regulariser=config.regulariser, rng=rng),
    )


def _cleaned(noisy: list[NoisyClouds], cache: Path, lap: int, run: _Run) -> CloudSource:
    """Clouds as what was learned so far cleans them; that teacher stays beside the checkpoint, for a run that is resumed."""
    teacher = run.output / f"{TEACHER}-{lap}"
    if run.ranks.is_first and not (teacher / store.CONFIG).exists():
        store.save(run.average, teacher, summary=f"teacher of lap {lap}", training={}, scores={}, card="")
    run.ranks.wait()
    own_law = _OWN_LAW[are_scans(run.config.data)]
    return CloudSource(distilled(noisy, teacher, cache / f"lap-{lap}", own_law), run.config.seed)


def _noisy(config: TrainConfig, cache: Path, adapts: bool) -> list[list[Callable[[], Array]]]:
    """Noisy clouds to learn from, without the points that an adapted model is judged by."""
    noisy = noisy_from(config.data, config.seed, cache)
    return [[partial(learned_from, load) for load in some] for some in noisy] if adapts else noisy


def _judges(config: TrainConfig, cache: Path, neighbours: int) -> list[TrainingCloud]:
    """Noisy clouds with the points held out that no step learned from, to compare weights by."""
    noisy = noisy_from(config.data, config.seed, cache)
    source = CloudSource([[partial(from_noisy, load, judging=True) for load in some] for some in noisy], config.seed + 1)
    return [source.cloud(number, neighbours) for number in range(_JUDGED_CLOUDS)]


def _neighbours(network: store.Network) -> int:
    return 0 if isinstance(network, MCConvNetwork) else network.config.neighbours


def _initial(config: TrainConfig, init: str | None) -> store.Network:
    """A new network, or one with the weights and sizes of another model; only the number of neighbours is free then."""
    if init is not None and init != FROM_NOTHING:
        learned = store.load(init).network
        if isinstance(learned, MCConvNetwork) != (config.network == "mcconv"):
            raise UsageError(f"--init {init}: not a {config.network} model; give --network to match it")
        if isinstance(learned, MCConvNetwork):
            if learned.config.unit != config.unit:
                unit = learned.config.unit or "the diagonal"
                raise UsageError(f"--init {init}: its unit of length is {unit}; give the same --unit")
            return copy.deepcopy(learned).train()
        network = ProjectionNetwork(replace(learned.config, neighbours=config.neighbours))
        network.load_state_dict(learned.state_dict())
        return network
    if config.network == "mcconv":
        return MCConvNetwork(MCConvConfig(config.width, config.sampled, unit=config.unit))
    return ProjectionNetwork(ProjectionConfig(config.channels, config.neighbours, config.rounds, config.landing_rounds))


class _Run:
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
        self._logged = 0

    @property
    def seconds(self) -> float:
        """Time spent learning, over all resumed runs."""
        return self._before_s + time.monotonic() - self._began

    @property
    def progress(self) -> float:
        """Share of the budget or the steps that is spent, by the first process's clock; all processes must ask together."""
        by_steps = self.step / self.config.steps if self.config.steps else 0.0
        budget_s = self.config.budget_s or (None if self.config.steps else _DEFAULT_BUDGET_S)
        return max(by_steps, self.ranks.agreed(self.seconds) / budget_s if budget_s else 0.0)

    @property
    def recent_error(self) -> float:
        """Root mean square error of the last hundred clouds, infinite before the first."""
        return math.sqrt(sum(self._errors) / len(self._errors)) if self._errors else math.inf

    @property
    def summary(self) -> TrainingSummary:
        """The record so far."""
        return TrainingSummary(self.step, self.points, self.seconds, self.recent_error, self._verdict)

    def learn(self, signal: Signal, cloud: Any) -> None:
        """One step on one cloud a process; one without judged points or with a loss that is no number teaches nothing."""
        self.step += 1
        progress = self.progress
        self.optimiser.zero_grad()
        errors = self._differentiate(signal, cloud, progress)
        shared = [_gradient(parameter) for parameter in self.network.parameters()] if self.ranks.count > 1 else []
        shared += [buffer for buffer in self.network.buffers() if buffer.is_floating_point()]
        figures = [sum(errors), cloud.n_points if errors else 0]
        error, n_points, n_taught = self.ranks.averaged(shared, figures, len(errors))
        if not n_taught:
            return
        for group in self.optimiser.param_groups:
            group["lr"] = self._peak * self._plan.rate(self.step, progress)
        nn.utils.clip_grad_norm_(self.network.parameters(), self._plan.clip)
        self.optimiser.step()
        keep = min(1 - 1 / _AVERAGED_STEPS, self.step / (self.step + 10)) if self._plan.is_averaged else 0.0
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)
            for kept, current in zip(self.average.buffers(), self.network.buffers(), strict=True):
                kept.copy_(current)
        self._errors = [*self._errors[-99:], error / n_taught]
        self.points += int(n_points)
        if self.step % _LOG_EVERY == 0 and self.ranks.is_first:
            self._log()
        if self.step % _SAVE_EVERY == 0 and self.ranks.is_first:
            self.save()

    def _differentiate(self, signal: Signal, cloud: Any, progress: float) -> list[float]:
        """Leaves the gradient of this process's cloud in the network; gives its error, or nothing if it teaches nothing."""
        if not cloud.n_points:
            return []
        rng = np.random.default_rng([self.config.seed, 17, self.ranks.number(self.step)])
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
            errors[:, i] = judge(before, cloud), judge(self.average, cloud)
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
        from safetensors.torch import save_file

        tensors = {f"network.{n}": t for n, t in self.network.state_dict().items()}
        tensors |= {f"average.{n}": t for n, t in self.average.state_dict().items()}
        for name, parameter in self.network.named_parameters():
            for key, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"{key}.{name}"] = value
        record = {"step": self.step, "points": self.points, "seconds": self.seconds, "errors": self._errors}
        record |= {"settings": self._settings, "init": self.init}
        part = self.output / f"{CHECKPOINT}.part"
        save_file({n: t.detach().contiguous().clone() for n, t in tensors.items()}, part, metadata={"record": json.dumps(record)})
        os.replace(part, self.output / CHECKPOINT)

    def load(self) -> None:
        """Continues where `save` left off. Raises UsageError without a checkpoint and with other settings, ModelError with one
        that does not fit."""
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        path = self.output / CHECKPOINT
        record = _record(path)
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
        self._forget_steps_after()

    def _forget_steps_after(self) -> None:
        """Cuts from the log what was learned after the checkpoint, since it is learned again."""
        log = self.output / LOG
        lines = log.read_text().splitlines(keepends=True) if log.exists() else []
        kept = [line for line in lines if json.loads(line)["step"] <= self.step]
        if kept:
            log.write_text("".join(kept))
            self._logged = json.loads(kept[-1])["step"]

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
        )

    def _card(self) -> str:
        settings = {**self.config.model_dump(mode="json"), "init": self.init}
        rows = "\n".join(f"| {name} | {value} |" for name, value in settings.items() if value is not None)
        return (
            f"# {self.output.resolve().name}\n\nA {self.config.network} network trained with pcdenoise: {self.summary}.\n\n"
            f"| setting | value |\n| --- | --- |\n{rows}\n\nThe curve is in {LOG}.\n"
        )


def _record(path: Path) -> dict[str, Any]:
    """What a checkpoint says of its run. Raises UsageError without a checkpoint, ModelError with one that is none."""
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise UsageError(f"{path.parent}: nothing to resume; leave --resume out to start a run")
    try:
        with safe_open(path, framework="pt") as file:
            record: dict[str, Any] = json.loads(file.metadata()["record"])
            record["settings"], record["step"]
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
