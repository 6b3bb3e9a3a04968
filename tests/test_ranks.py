"""Training on two processes that torchrun starts: one gradient, the same weights, and a run that can be interrupted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from pcdenoise.config import TrainConfig
from pcdenoise.learning import trainer
from pcdenoise.learning.ranks import Ranks
from pcdenoise.learning.run import CHECKPOINT
from pcdenoise.networks import store

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = {"steps": 2, "channels": 4, "rounds": (1,), "landing_rounds": 1, "data": ("shapes:1",), "threads": 1}
PROGRAM = f"""
import itertools, sys
from pathlib import Path
from safetensors.torch import save_file
from pcdenoise.config import TrainConfig
from pcdenoise.learning import ahead, ranks, trainer
from pcdenoise.learning.run import Run

folder, config = Path(sys.argv[1]), TrainConfig(**{SETTINGS!r})
learn = Run.learn

def noted(self, signal, cloud):
    learn(self, signal, cloud)
    tensors = {{f"weights.{{name}}": p.detach() for name, p in self.network.named_parameters()}}
    tensors |= {{f"gradient.{{name}}": p.grad for name, p in self.network.named_parameters()}}
    save_file(tensors, folder / f"{{self.output.name}}_{{self.step}}_{{self.ranks.rank}}.safetensors")

def interrupt(_task, share):
    if share >= 0.5:
        raise KeyboardInterrupt

def run():
    Run.learn = noted
    with ranks.joined() as both:
        trainer.train(config, folder / "whole")
        ahead.CloudsAhead.clouds = lambda self, first, neighbours, stride=1, n_makers=1: (
            self.cloud(number, neighbours) for number in itertools.count(first, stride)
        )
        try:
            trainer.train(config, folder / "parts", on_progress=interrupt)
        except KeyboardInterrupt:
            both.wait()
            trainer.train(config, folder / "parts", resume=True)

if __name__ == "__main__":
    run()
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of two processes, and the same run interrupted half way and resumed."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "program.py").write_text(PROGRAM)
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--local-addr",
        "127.0.0.1",
        "--nproc-per-node",
        "2",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"}
    done = subprocess.run(
        [*command, str(folder / "program.py"), str(folder)], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_after_every_step_both_processes_have_the_same_weights(trained: Path) -> None:
    for step in range(1, SETTINGS["steps"] + 1):
        assert (trained / f"whole_{step}_0.safetensors").read_bytes() == (trained / f"whole_{step}_1.safetensors").read_bytes()
    assert (trained / "whole_1_0.safetensors").read_bytes() != (trained / "whole_2_0.safetensors").read_bytes()


def test_their_gradient_is_that_of_one_process_that_sees_both_clouds(trained: Path, tmp_path: Path) -> None:
    config = TrainConfig(**SETTINGS)
    torch.manual_seed(config.seed)
    network = trainer._initial(config, None)
    lessons = trainer._lessons(config.model_copy(update={"method": "supervised"}), tmp_path, adapts=False)
    source = lessons.source(0, None)
    clouds = [source.cloud(number, config.neighbours) for number in (0, 1)]
    losses = [lessons.signal(network, cloud, 0.0, np.random.default_rng(0))[0] for cloud in clouds]
    (sum(losses) / 2).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    shared = load_file(trained / "whole_1_0.safetensors")
    largest = max(float(parameter.grad.abs().max()) for parameter in network.parameters() if parameter.grad is not None)
    assert largest > 0
    for name, parameter in network.named_parameters():
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        # Sums of float32 in another order: a thousandth of a thousandth for each of some ten layers.
        torch.testing.assert_close(shared[f"gradient.{name}"], gradient, rtol=0, atol=1e-5 * largest)


def test_two_processes_go_on_where_they_were_interrupted_and_leave_one_model(trained: Path) -> None:
    assert (trained / "parts" / store.WEIGHTS).read_bytes() == (trained / "whole" / store.WEIGHTS).read_bytes()
    assert not (trained / "parts" / CHECKPOINT).exists()
    assert store.load(trained / "whole").config.training["steps_done"] == SETTINGS["steps"]


def test_clouds_are_dealt_out_once_each() -> None:
    dealt = [Ranks(rank, 3).number(step) for step in range(4) for rank in range(3)]
    assert dealt == list(range(12))


def test_a_process_alone_shares_with_nobody() -> None:
    tensor = torch.ones(3)
    assert Ranks().averaged([tensor], [2.0], 1.0) == [2.0, 1.0]
    assert Ranks().agreed(0.3) == 0.3
    assert torch.equal(tensor, torch.ones(3))
