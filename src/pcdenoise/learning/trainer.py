"""The training loop: clouds in, a model folder out; what is learned from, in what order, and until when.

Not here: one run's weights, curve and checkpoint (run.py), clouds (dataset.py, sources.py, scans.py), signals (supervised.py,
split.py, distill.py, total.py).
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from pcdenoise.config import TrainConfig
from pcdenoise.errors import UsageError
from pcdenoise.learning.ahead import CloudsAhead
from pcdenoise.learning.dataset import CloudSource, TrainingCloud, from_noisy, from_surface, learned_from
from pcdenoise.learning.distill import distilled
from pcdenoise.learning.ranks import joined
from pcdenoise.learning.run import CHECKPOINT, TEACHER, OnProgress, Run, Signal, TrainingSummary, discard, record_of
from pcdenoise.learning.scans import ScanSource, parts_from
from pcdenoise.learning.sources import NoisyClouds, are_scans, noisy_from, surfaces_from
from pcdenoise.learning.split import split_loss
from pcdenoise.learning.structure import shared_by
from pcdenoise.learning.supervised import supervised_loss
from pcdenoise.learning.total import total_loss
from pcdenoise.networks import store
from pcdenoise.networks.mcconv import MCConvConfig, MCConvNetwork
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

FROM_NOTHING = "none"
"""What `init` says where no model is to start from."""
_ADAPTING_RATE = 3e-4  # peak learning rate for a model that has learned already
_OWN_LAW = {True: 0.8, False: 0.1}
"""How often distillation puts back a scan's own noise and a synthetic cloud's, rather than a law of synthesis."""
_JUDGED_CLOUDS = 16
_FEW_STEPS = 4  # whose clouds are made sooner than a process that makes clouds is there
_FIRST_LAP = 0.2
"""Share of a distillation whose teacher has learned nothing yet; the laps after it are equally long."""


def train(
    config: TrainConfig,
    output: Path,
    *,
    init: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    on_progress: OnProgress | None = None,
) -> TrainingSummary:
    """Learns from the surfaces or scans in `config.data` and writes the model folder `output`.

    The folder also gets training.jsonl, one line per fifty steps. An interrupt (Ctrl-C) saves what was learned and is passed on.
    Where split or distill learn from scans alone, the shipped model is adapted to them unless `init` says otherwise ("none": a
    new network), and comes back as it was unless the change shows on a quarter of the points, which no step learns from. Where
    beams, sweeps or flight lines are off against each other, the model says so, and scans are aligned by them first.
    Under torchrun each process learns from clouds of its own, gradients are averaged, and the first process writes.
    A run that is resumed has the start of its first part, and its length if no other is given. An unfinished run in the folder is
    only replaced with `overwrite`.
    Raises UsageError when there is nothing to resume or to learn from, and when a run is resumed with other settings.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    if resume:
        config, init = _as_begun(config, init, record_of(output / CHECKPOINT), output)
    elif (output / CHECKPOINT).exists() and not overwrite:
        raise UsageError(f"{output}: holds an unfinished run; give --resume to go on with it, or another folder")
    config, init, adapts = _settled(config, init)
    with joined() as ranks:
        run = Run(config, output, _initial(config, init), ranks, init)
        return _trained(run, adapts, resume, on_progress or (lambda _words, _share: None))


def _as_begun(config: TrainConfig, init: str | None, record: dict[str, Any], output: Path) -> tuple[TrainConfig, str | None]:
    """Where the run that is resumed began, and its length where none is given. Raises UsageError for another beginning."""
    if init not in (None, record["init"]):
        raise UsageError(f"{output}: the run to resume has --init {record['init']}, not {init}; leave --init out")
    if config.steps is None and config.budget_s is None:
        config = config.model_copy(update=record["length"])
    return config, record["init"]


def _trained(run: Run, adapts: bool, resume: bool, on_progress: OnProgress) -> TrainingSummary:
    config, output, ranks = run.config, run.output, run.ranks
    before = copy.deepcopy(run.network) if adapts else None
    if resume:
        run.load()
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
                few = config.steps is not None and config.steps - run.step <= _FEW_STEPS
                first, n_makers = ranks.number(run.step), 0 if few else ranks.n_makers(config.threads)
                series = lessons.source(lap, run).clouds(first, _neighbours(run.network), stride=ranks.count, n_makers=n_makers)
                with closing(series) as clouds:  # who makes them must be gone before what they keep them in is
                    for cloud in clouds:
                        if run.progress >= until:
                            break
                        run.learn(lessons.signal, cloud)
                        on_progress(run.state, run.progress)
            if isinstance(before, ProjectionNetwork) and ranks.is_first:
                run.judge(before, _judges(lessons.noisy, config.seed, before.config.neighbours), on_progress)
                on_progress("looking for offsets", 1.0)
                run.align_by = shared_by(config.data, store.Model.of(run.average, output.name), config.seed, config.threads)
            if not run.points and not adapts:
                raise UsageError(
                    f"{output}: no cloud taught anything in {run.step} steps; learn for longer, or from larger scans"
                )
        finally:
            if ranks.is_first and run.points:
                run.save_model()
            elif ranks.is_first and not resume:
                discard(output)
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


@dataclass(frozen=True)
class _Lessons:
    """What is learned from, lap after lap, and how. source: from the lap's number and the run to its clouds.

    noisy: where they come from, with the points that nothing is learned from, if a model is adapted to them.
    """

    source: Callable[[int, Run], CloudsAhead[Any]]
    signal: Signal
    laps: int = 1
    noisy: Sequence[NoisyClouds] = ()


def _lessons(config: TrainConfig, cache: Path, adapts: bool) -> _Lessons:
    """By method: surfaces, noisy clouds with points held out, clouds that a teacher has cleaned, or targets from a prior."""
    supervised: Signal = lambda network, cloud, _progress, _rng: supervised_loss(network, cloud)  # noqa: E731
    if config.method in ("distill", "split"):
        noisy = noisy_from(config.data, config.seed, cache)
        clouds: list[NoisyClouds] = [[partial(learned_from, load) for load in some] for some in noisy] if adapts else noisy
        judges = noisy if adapts else ()
        if config.method == "distill":
            return _Lessons(partial(_cleaned_by_then, clouds, cache), supervised, config.laps, judges)
        halves = CloudSource([[partial(from_noisy, load) for load in some] for some in clouds], config.seed)
        return _Lessons(lambda _lap, _run: halves, lambda network, cloud, *_: split_loss(network, cloud), noisy=judges)
    source: CloudsAhead[Any]
    if config.method == "supervised" and config.network == "projection" and not config.pairs:
        surfaces = surfaces_from(config.data, config.seed, cache)
        source = CloudSource([[partial(from_surface, load) for load in some] for some in surfaces], config.seed)
        return _Lessons(lambda _lap, _run: source, supervised)
    source = ScanSource(parts_from(config, cache), config)
    return _Lessons(
        lambda _lap, _run: source,
        lambda network, cloud, progress, rng: total_loss(network, cloud, progress, regulariser=config.regulariser, rng=rng),
    )


def _cleaned_by_then(noisy: list[NoisyClouds], cache: Path, lap: int, run: Run) -> CloudSource:
    """Clouds as what was learned so far cleans them; that teacher stays beside the checkpoint, for a run that is resumed."""
    teacher = run.output / f"{TEACHER}-{lap}"
    if run.ranks.is_first and not (teacher / store.CONFIG).exists():
        store.save(run.average, teacher, summary=f"teacher of lap {lap}", training={}, scores={}, card="")
    run.ranks.wait()
    own_law = _OWN_LAW[are_scans(run.config.data)]
    return CloudSource(distilled(noisy, teacher, cache / f"lap-{lap}", own_law), run.config.seed)


def _judges(noisy: Sequence[NoisyClouds], seed: int, neighbours: int) -> list[TrainingCloud]:
    """Noisy clouds with the points held out that no step learned from, to compare weights by."""
    source = CloudSource([[partial(from_noisy, load, judging=True) for load in some] for some in noisy], seed + 1)
    return [source.cloud(number, neighbours) for number in range(_JUDGED_CLOUDS)]


def _neighbours(network: store.Network) -> int:
    return 0 if isinstance(network, MCConvNetwork) else network.config.neighbours


def _initial(config: TrainConfig, init: str | None) -> store.Network:
    """A new network, or one with the weights and sizes of another model; only neighbours, and wider messages, are free then."""
    if init is not None and init != FROM_NOTHING:
        learned = store.load(init).network
        if isinstance(learned, MCConvNetwork) != (config.network == "mcconv"):
            raise UsageError(f"--init {init}: not a {config.network} model; give --network to match it")
        if isinstance(learned, MCConvNetwork):
            if learned.config.unit != config.unit:
                unit = learned.config.unit or "the diagonal"
                raise UsageError(f"--init {init}: its unit of length is {unit}; give the same --unit")
            return copy.deepcopy(learned).train()
        messages = config.messages or learned.config.messages
        if messages < learned.config.messages:
            raise UsageError(f"--init {init}: its messages have {learned.config.messages} channels; give no fewer than that")
        network = ProjectionNetwork(replace(learned.config, neighbours=config.neighbours, messages=messages))
        network.take(learned)
        return network
    if config.network == "mcconv":
        return MCConvNetwork(MCConvConfig(config.width, config.sampled, unit=config.unit))
    sizes = (config.channels, config.neighbours, config.rounds, config.landing_rounds)
    return ProjectionNetwork(ProjectionConfig(*sizes, messages=config.messages or 0))
