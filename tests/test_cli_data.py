"""The commands around the main job: synth makes truth, eval-chamfer measures, iterate shows passes, train learns, models list."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import pcdenoise
from pcdenoise.commands import main, synth
from pcdenoise.networks import store

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two shapes of 600 points at two levels of noise."""
    folder = tmp_path / "data"
    assert main(["synth", "shapes:2", "-o", str(folder), "--points", "600", "--levels", "1,2", "-q"]) == 0
    return folder


def test_synth_writes_what_its_index_says_with_the_noise_it_says(data: Path) -> None:
    index = json.loads((data / "dataset.json").read_text())
    assert [item["name"] for item in index["items"]] == ["shape_0000", "shape_0001"]
    for item in index["items"]:
        clean = pcdenoise.read(data / item["clean"])
        assert len(clean) == 600
        assert {"red", "green", "blue"} <= set(clean.attributes)
        for noisy in item["noisy"]:
            error = pcdenoise.read(data / noisy["file"]).points - clean.points
            # The standard deviation of 1800 normal numbers scatters by 1 / sqrt(3600) of itself: 1.7 %; four of these.
            assert error.std() == pytest.approx(noisy["std"], rel=4 / 60)
            assert noisy["std"] == pytest.approx(noisy["level_percent"] / 100 * item["diagonal"])


def test_synth_with_one_seed_gives_the_same_bytes_and_with_another_seed_other_ones(data: Path, tmp_path: Path) -> None:
    again, other = tmp_path / "again", tmp_path / "other"
    for folder, seed in ((again, "0"), (other, "1")):
        main(["synth", "shapes:2", "-o", str(folder), "--points", "600", "--levels", "1,2", "--seed", seed, "-q"])
    for path in data.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()
    assert (data / "shape_0000_clean.ply").read_bytes() != (other / "shape_0000_clean.ply").read_bytes()


def test_every_law_of_noise_has_its_name_on_the_command_line() -> None:
    from pcdenoise.synthesis.noise import NOISES

    assert set(get_args(synth.NoiseName)) == {*NOISES, "lidar"}


def test_synth_samples_a_mesh_keeps_a_copy_and_scans_it_with_the_lidar(tmp_path: Path) -> None:
    pytest.importorskip("open3d", exc_type=ImportError)
    mesh, folder = tmp_path / "tetra.obj", tmp_path / "data"
    mesh.write_text(TETRAHEDRON)
    assert main(["synth", str(mesh), "-o", str(folder), "--points", "300", "--levels", "0", "-q"]) == 0
    assert (folder / "tetra_mesh.obj").read_text() == TETRAHEDRON
    points = pcdenoise.read(folder / "tetra_gaussian_0.ply").points
    on_a_face = np.minimum(np.abs(points).min(axis=1), np.abs(points.sum(axis=1) - 1))
    assert on_a_face.max() < 1e-6
    assert (
        main(["synth", str(mesh), "-o", str(tmp_path / "scans"), "--points", "300", "--noise", "lidar", "--levels", "1", "-q"])
        == 0
    )
    assert "beam" in pcdenoise.read(tmp_path / "scans" / "tetra_lidar_1.ply").attributes


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["shapes:1", "--noise", "lidar"], "lidar"),
        (["shapes:1", "shapes:1"], "shape_0000"),
        (["shapes:1", "--levels", "1,high"], "--levels"),
        (["shapes:1", "--levels", "-1"], "--levels"),
        (["no/such/mesh.obj"], "no/such/mesh.obj"),
    ],
)
def test_synth_says_what_it_cannot_do_in_one_line(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["synth", *arguments, "-o", str(tmp_path / "data"), "--points", "100"]) in (2, 3)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert words in lines[0]
    assert not (tmp_path / "data" / "dataset.json").exists()


def test_eval_chamfer_ranks_more_noise_higher_and_leaves_clouds_histograms_and_a_report(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noisy = [str(data / f"shape_0000_gaussian_{level}.ply") for level in (1, 2)]
    out = data / "errors"
    extras = ["--error-ply", f"{out}/", "--picture", f"{out}/", "--report", str(data / "report.json")]
    assert main(["eval-chamfer", *noisy, "--clean", str(data / "shape_0000_clean.ply"), *extras]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("mean")
    files = json.loads((data / "report.json").read_text())["files"]
    assert 0 < files[0]["figures"]["cd"] < files[1]["figures"]["cd"]
    coloured = pcdenoise.read(out / "shape_0000_gaussian_1_error.ply")
    truth = pcdenoise.read(data / "shape_0000_clean.ply").points
    nearest = np.linalg.norm(coloured.points[:, None] - truth[None], axis=2).min(axis=1)
    assert np.allclose(coloured.attributes["error"], nearest, rtol=1e-6)
    assert (out / "shape_0000_gaussian_2_error.png").read_bytes().startswith(b"\x89PNG")


def test_eval_chamfer_is_zero_for_the_truth_itself_and_needs_one(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = str(data / "shape_0000_clean.ply")
    report = data / "report.json"
    assert main(["eval-chamfer", clean, "--clean", clean, "--report", str(report)]) == 0
    assert json.loads(report.read_text())["figures"]["cd"] == 0
    assert main(["eval-chamfer", clean]) == 2
    assert "--clean" in capsys.readouterr().err


def test_eval_chamfer_names_the_file_that_is_empty(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean, empty = str(data / "shape_0000_clean.ply"), data / "empty.ply"
    pcdenoise.write(pcdenoise.Scan(np.zeros((0, 3))), empty)
    for result, truth in ((str(empty), clean), (clean, str(empty))):
        assert main(["eval-chamfer", result, "--clean", truth]) == 3
        captured = capsys.readouterr()
        assert captured.err.startswith(f"pcdenoise: {empty}: has 0 points with coordinates")
        assert captured.out == ""


def test_iterate_writes_every_pass_a_table_a_strip_and_a_page(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = data / "steps"
    noisy, clean = data / "shape_0000_gaussian_1.ply", data / "shape_0000_clean.ply"
    assert main(["iterate", str(noisy), "-o", str(out), "--method", "mean", "--iters", "2", "--clean", str(clean)]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "passes.png", "report.html", "shape_0000_gaussian_1_1.ply", "shape_0000_gaussian_1_2.ply",
    ]  # fmt: skip
    table = capsys.readouterr().out.splitlines()
    assert len(table) == 2 + 3  # header, rule, before, two passes
    assert "cd" in table[0]


def test_iterate_says_in_its_page_and_in_every_pass_what_made_them_and_refuses_passes_that_are_there(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = data / "steps"
    command = ["iterate", str(data / "shape_0000_gaussian_1.ply"), "-o", str(out), "--iters", "1", "-q"]
    assert main(command) == 0
    sha = hashlib.sha256((store.shipped() / "default" / store.WEIGHTS).read_bytes()).hexdigest()
    written = out / "shape_0000_gaussian_1_1.ply"
    assert sha in (out / "report.html").read_text()
    assert sha.encode() in written.read_bytes()[:4096]
    for name in ("report.html", "passes.png"):
        (out / name).unlink()
    capsys.readouterr()
    assert main(command) == 3
    assert f"{written}: the file exists" in capsys.readouterr().err
    assert list(out.iterdir()) == [written]


def test_iterate_ends_where_denoise_ends(data: Path) -> None:
    noisy = data / "shape_0000_gaussian_1.ply"
    main(["iterate", str(noisy), "-o", str(data / "steps"), "--method", "mean", "--iters", "2", "-q"])
    main(["denoise", str(noisy), "-o", str(data / "twice.ply"), "--method", "mean", "--iters", "2", "-q"])
    last = pcdenoise.read(data / "steps" / "shape_0000_gaussian_1_2.ply").points
    assert np.allclose(last, pcdenoise.read(data / "twice.ply").points, rtol=0, atol=1e-12)


def test_models_lists_the_default_model_and_prints_its_card(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models"]) == 0
    listed = capsys.readouterr().out
    assert main(["models", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)[0]
    assert first["name"] == "default"
    assert first["n_parameters"] > 1000
    assert f"{first['scores']['10000_0.02']['cd']:.2f} / " in next(line for line in listed.splitlines() if "default" in line)
    assert main(["models", "default"]) == 0
    assert len(capsys.readouterr().out) > 500
    assert main(["models", "default", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "default"
    assert main(["models", "no-such-model"]) == 4
    assert "no such model; give" in capsys.readouterr().err


def test_a_model_trained_for_two_steps_can_be_used_and_listed(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model, noisy = data / "model", data / "shape_0000_gaussian_1.ply"
    assert main(["train", "-o", str(model), "--steps", "2", "-q"]) == 0
    assert main(["denoise", str(noisy), "-o", str(data / "clean.ply"), "--model", str(model), "-q"]) == 0
    assert len(pcdenoise.read(data / "clean.ply")) == 600
    capsys.readouterr()
    assert main(["models", str(model)]) == 0
    assert capsys.readouterr().out.strip()
