"""Learning: clouds whose surface is known, the supervised signal, and a loop that can be stopped, resumed and repeated."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
import torch

from pcdenoise.config import TrainConfig
from pcdenoise.errors import ModelError, UsageError
from pcdenoise.learning import trainer
from pcdenoise.learning.dataset import CloudSource, draw_cloud, surfaces_from
from pcdenoise.learning.supervised import NearestSurface, supervised_loss
from pcdenoise.networks import store
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork
from pcdenoise.synthesis.shapes import sphere


@pytest.fixture(scope="module")
def surface() -> tuple[np.ndarray, np.ndarray]:
    sample = sphere().sample(200_000, np.random.default_rng(0))
    return sample.points, sample.normals


def test_the_error_of_a_prediction_is_its_distance_to_the_sphere(surface):
    cloud = draw_cloud(*surface, 24, np.random.default_rng(1))
    points = cloud.surface[:500] * np.linspace(0.9, 1.1, 500)[:, None]
    error = NearestSurface(cloud).error(torch.from_numpy(points).float()).numpy()
    # A sample's tangent disc of radius t is t²/2 off the unit sphere; samples are within 0.02 of each other.
    np.testing.assert_allclose(error, np.abs(np.linspace(-0.1, 0.1, 500)), atol=0.02**2 / 2 + 1e-5)


def test_training_clouds_depend_on_seed_and_number_alone(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    sources = [CloudSource(surfaces_from(["shapes:2"], 5, tmp_path / name), 5) for name in ("a", "b")]
    first, again = (source.cloud(3, 24) for source in sources)
    np.testing.assert_array_equal(first.seeds, again.seeds)
    np.testing.assert_array_equal(first.judged, again.judged)
    assert not np.array_equal(first.seeds[:10], sources[0].cloud(4, 24).seeds[:10])


def test_learning_from_one_cloud_lowers_its_error(surface):
    torch.manual_seed(0)
    cloud = draw_cloud(*surface, 24, np.random.default_rng(2))
    network = ProjectionNetwork(ProjectionConfig(channels=8, rounds=(1,)))
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
    losses = []
    for _ in range(12):
        loss, _ = supervised_loss(network, cloud)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.9 * losses[0]


def test_an_interrupted_run_resumes_to_the_same_weights_as_an_undisturbed_one(tmp_path):
    config = TrainConfig(steps=4, channels=4, rounds=(1,), landing_rounds=1, data=("shapes:1",), threads=1)

    def interrupt(_task: str, share: float) -> None:
        if share >= 0.5:
            raise KeyboardInterrupt

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    trainer.train(config, whole)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(config, parts, on_progress=interrupt)
    assert store.load(parts).config.training["steps_done"] == 2  # what was learned so far is a model already
    with pytest.raises(UsageError, match="--resume"):
        trainer.train(config, parts)
    summary = trainer.train(config, parts, resume=True)
    assert summary.steps == 4
    assert (whole / store.WEIGHTS).read_bytes() == (parts / store.WEIGHTS).read_bytes()
    assert not (parts / trainer.CHECKPOINT).exists()
    assert json.loads((parts / store.CONFIG).read_text())["training"]["seed"] == config.seed


def test_there_must_be_something_to_resume_and_it_must_be_a_checkpoint(tmp_path):
    resume = partial(trainer.train, TrainConfig(steps=1, channels=4, rounds=(1,), data=("shapes:1",)), resume=True)
    with pytest.raises(UsageError, match="nothing to resume"):
        resume(tmp_path)
    (tmp_path / trainer.CHECKPOINT).write_bytes(b"\x08" + bytes(30))
    with pytest.raises(ModelError, match="not a checkpoint"):
        resume(tmp_path)


def test_meshes_are_found_in_folders_and_point_clouds_are_not_taken_for_them(tmp_path):
    (tmp_path / "cloud.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    (tmp_path / "first").mkdir()
    (tmp_path / "second").mkdir()
    with pytest.raises(UsageError, match="no mesh"):
        surfaces_from([str(tmp_path)], 0, tmp_path / "first")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "shape.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    both = surfaces_from([str(tmp_path), "shapes:3"], 0, tmp_path / "second")
    assert [len(surfaces) for surfaces in both] == [1, 3]
