"""Learning: clouds whose surface is known, the supervised signal, and a loop that can be stopped, resumed and repeated."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
import torch

from pcdenoise.config import TrainConfig
from pcdenoise.errors import ModelError, UsageError
from pcdenoise.learning import run, sources, trainer
from pcdenoise.learning.dataset import CloudSource, Surface, draw_cloud, from_surface
from pcdenoise.learning.distill import cleaned
from pcdenoise.learning.sources import noisy_from, surfaces_from
from pcdenoise.learning.split import HeldOut
from pcdenoise.learning.supervised import NearestSurface, supervised_loss
from pcdenoise.networks import store
from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork
from pcdenoise.synthesis.shapes import sphere


@pytest.fixture(scope="module")
def surface() -> Surface:
    sample = sphere().sample(200_000, np.random.default_rng(0))
    return Surface(sample.points, sample.normals)


def test_the_error_of_a_prediction_is_its_distance_to_the_sphere(surface):
    points = surface.points[:500] * np.linspace(0.9, 1.1, 500)[:, None]
    error = NearestSurface(surface).error(torch.from_numpy(points).float()).numpy()
    # A sample's tangent disc of radius t is t²/2 off the unit sphere; samples are within 0.02 of each other.
    np.testing.assert_allclose(error, np.abs(np.linspace(-0.1, 0.1, 500)), atol=0.02**2 / 2 + 1e-5)


def test_training_clouds_depend_on_seed_and_number_alone(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    loads = [surfaces_from(["shapes:2"], 5, tmp_path / name)[0] for name in ("a", "b")]
    sources = [CloudSource([[partial(from_surface, load) for load in some]], 5) for some in loads]
    first, again = (source.cloud(3, 24) for source in sources)
    np.testing.assert_array_equal(first.seeds, again.seeds)
    np.testing.assert_array_equal(first.judged, again.judged)
    assert not np.array_equal(first.seeds[:10], sources[0].cloud(4, 24).seeds[:10])


def test_several_processes_make_the_clouds_that_one_makes(tmp_path):
    source = CloudSource([[partial(from_surface, load) for load in surfaces_from(["shapes:1"], 5, tmp_path)[0]]], 5)
    series = source.clouds(2, 24, stride=3, n_makers=2)
    for number in (2, 5, 8):
        np.testing.assert_array_equal(next(series).seeds, source.cloud(number, 24).seeds)
    series.close()


def test_learning_from_one_cloud_lowers_its_error(surface):
    torch.manual_seed(0)
    cloud = draw_cloud(surface, 24, np.random.default_rng(2))
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
    assert not (parts / run.CHECKPOINT).exists()
    assert json.loads((parts / store.CONFIG).read_text())["training"]["seed"] == config.seed


TINY = TrainConfig(steps=3, channels=4, rounds=(1,), landing_rounds=1, data=("shapes:1",), threads=1)


def test_a_run_is_resumed_with_its_own_settings_and_its_curve_is_its_own(tmp_path):
    def interrupt(_task: str, share: float) -> None:
        if share >= 0.5:
            raise KeyboardInterrupt

    (tmp_path / run.LOG).write_text('{"step": 1, "error": 99}\n')
    with pytest.raises(KeyboardInterrupt):
        trainer.train(TINY, tmp_path, on_progress=interrupt)
    with pytest.raises(UsageError, match="--seed 1"):
        trainer.train(TINY.model_copy(update={"seed": 9}), tmp_path, resume=True)
    with pytest.raises(UsageError, match="--init None"):
        trainer.train(TINY, tmp_path, resume=True, init="unsupervised")
    with (tmp_path / run.LOG).open("a") as log:
        log.write('{"step": 3, "error": 99}\n{"step": 4, "er')  # after the last checkpoint: lost with its process
    summary = trainer.train(TINY.model_copy(update={"steps": None}), tmp_path, resume=True)
    assert summary.steps == TINY.steps  # and not as many as fit in the default budget
    curve = run.curve_of(tmp_path)
    assert [line["step"] for line in curve] == [2, 3]
    assert all(line["error"] < 10 for line in curve)


def test_an_interrupt_within_a_step_does_not_count_it(tmp_path, monkeypatch):
    whole = run.Run._differentiate

    def interrupt(self: run.Run, *given: object) -> list[float]:
        if self.step == 1:
            raise KeyboardInterrupt
        return whole(self, *given)

    monkeypatch.setattr(run.Run, "_differentiate", interrupt)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(TINY, tmp_path / "parts")
    monkeypatch.undo()
    trainer.train(TINY, tmp_path / "parts", resume=True)
    trainer.train(TINY, tmp_path / "whole")
    assert (tmp_path / "parts" / store.WEIGHTS).read_bytes() == (tmp_path / "whole" / store.WEIGHTS).read_bytes()


def test_what_is_held_out_of_a_large_scan_is_held_out_of_all_its_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "_PART_POINTS", 800)
    monkeypatch.setattr(sources, "in_unit_sphere", lambda points: points)  # so that a point is the same in all parts
    np.savetxt(tmp_path / "scan.xyz", np.random.default_rng(0).random((4000, 3)))
    (parts,) = noisy_from([str(tmp_path / "scan.xyz")], 0, tmp_path)
    rows = np.concatenate([load() for load in parts])
    held_out, learned = ({tuple(row) for row in rows[rows[:, 3] == chosen, :3]} for chosen in (0, 1))
    assert len(held_out) + len(learned) < len(rows)  # parts overlap
    assert not held_out & learned
    assert len(held_out) == pytest.approx(len(learned) / 3, rel=0.2)


def test_a_run_that_ends_before_it_learned_leaves_the_model_that_was_there(tmp_path, monkeypatch):
    trainer.train(TINY.model_copy(update={"steps": 1}), tmp_path)
    before = (tmp_path / store.WEIGHTS).read_bytes()

    def interrupt(*_given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(run.Run, "learn", interrupt)
    with pytest.raises(KeyboardInterrupt):
        trainer.train(TINY.model_copy(update={"seed": 5}), tmp_path)
    assert (tmp_path / store.WEIGHTS).read_bytes() == before
    assert not (tmp_path / run.CHECKPOINT).exists()


def test_there_must_be_something_to_resume_and_it_must_be_a_checkpoint(tmp_path):
    resume = partial(trainer.train, TrainConfig(steps=1, channels=4, rounds=(1,), data=("shapes:1",)), resume=True)
    with pytest.raises(UsageError, match="nothing to resume"):
        resume(tmp_path)
    (tmp_path / run.CHECKPOINT).write_bytes(b"\x08" + bytes(30))
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


STD = 0.02


def _noisy_plane(rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-1, 1, (20_000, 2)), np.zeros(20_000)]) + STD * rng.standard_normal((20_000, 3))


def _feet(held_out: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Where the split signal would have each place be, whichever way it is reached."""
    target = HeldOut(held_out, STD)
    places = torch.from_numpy(places).double().requires_grad_()
    height, known = target.heights(places.float())
    assert known.mean() > 0.95
    height.sum().backward()
    feet = (places - height.double()[:, None] * places.grad).detach().numpy()
    return feet[known]


@pytest.mark.parametrize("offset", [-STD, 0.0, STD])
def test_held_out_points_put_predictions_on_the_plane_from_either_side(offset):
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-0.7, 0.7, (2000, 2)), np.full(2000, offset)])
    height = _feet(_noisy_plane(rng), places)[:, 2]
    # 20,000 points / (4 · area of a cylinder, some 60 points): 2,000 fits share points, so that about 200 are independent;
    # each errs by 0.25 std.
    assert abs(height.mean()) < 4 * 0.3 * STD / np.sqrt(200)


@pytest.mark.parametrize("offset", [-STD, 0.0, STD])
def test_held_out_points_put_predictions_on_the_sphere_but_for_the_curvature_term(offset):
    rng = np.random.default_rng(1)
    held_out, places = (rng.standard_normal((n, 3)) for n in (30_000, 2000))
    held_out /= np.linalg.norm(held_out, axis=1, keepdims=True)
    places *= (1 + offset) / np.linalg.norm(places, axis=1, keepdims=True)
    radius = np.linalg.norm(_feet(held_out + STD * rng.standard_normal(held_out.shape), places), axis=1)
    # A fit to points that err along the surface lies Hσ² too deep (H = 1 / radius), a cylinder of finite height as much again.
    assert -2.5 * STD**2 < radius.mean() - 1 < 0.5 * STD**2


def test_no_prediction_gets_below_the_noise_floor_of_held_out_points():
    rng = np.random.default_rng(2)
    seen, held_out = _noisy_plane(rng), _noisy_plane(rng)
    inner = np.abs(seen[:, :2]).max(axis=1) < 0.7
    truth = seen[inner] * [1, 1, 0]
    height, known = HeldOut(held_out, STD).heights(torch.from_numpy(truth).float())
    floor = float(height[known].square().mean())
    raw, known = HeldOut(held_out, STD).heights(torch.from_numpy(seen[inner]).float())
    assert 0 < floor < 0.25 * STD**2
    # The seen noise is independent of the held-out points': both variances add up.
    assert float(raw[known].square().mean()) == pytest.approx(STD**2 + floor, rel=0.1)


def test_who_learns_without_truth_gets_the_noisy_files_of_a_synth_folder_alone(tmp_path):
    rng = np.random.default_rng(3)
    for name, level in (("a_clean.xyz", 0.0), ("a_noisy.xyz", STD)):
        np.savetxt(tmp_path / name, rng.uniform(-1, 1, (600, 3)) * [1, 1, level])
    (tmp_path / "dataset.json").write_text(json.dumps({"items": [{"clean": "a_clean.xyz", "noisy": [{"file": "a_noisy.xyz"}]}]}))
    (clouds,) = noisy_from([str(tmp_path)], 0, tmp_path / "cache")
    assert len(clouds) == 1
    assert np.ptp(clouds[0]()[:, 2]) > 0


def test_a_teacher_leaves_a_surface_closer_to_the_truth_and_the_noise_that_it_took_off(surface):
    rng = np.random.default_rng(4)
    noisy = surface.points[:20_000] + STD * rng.standard_normal((20_000, 3))
    model = store.Model.of(ProjectionNetwork(ProjectionConfig(channels=4, rounds=(1, 1))), "untrained")
    made = cleaned(noisy, model, own_law=1.0)
    np.testing.assert_allclose(made.points + made.residual, noisy, atol=1e-12)
    assert np.std(np.linalg.norm(made.points, axis=1)) < 0.5 * STD
    again = draw_cloud(made, 24, rng)
    assert again.noise == pytest.approx(STD, rel=0.35)


def test_an_adapted_model_is_kept_only_if_points_it_never_learned_from_say_so(tmp_path):
    rng = np.random.default_rng(5)
    np.savetxt(tmp_path / "scan.xyz", _noisy_plane(rng)[:6000])
    config = TrainConfig(data=(str(tmp_path / "scan.xyz"),), steps=1, threads=1, laps=1)
    summary = trainer.train(config, tmp_path / "model")
    assert "weights are kept" in summary.verdict
    if "starting" in summary.verdict:
        kept, shipped = (store.load(name).network.state_dict() for name in (tmp_path / "model", store.DEFAULT))
        assert all(torch.equal(kept[name], shipped[name]) for name in shipped)
