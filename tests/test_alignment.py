"""Groups of points that are off together are moved onto each other, by what the scan shows; groups that agree stay."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from known_clouds import Cloud, cloud
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.alignment import groups_of
from pcdenoise.denoising.denoiser import alignment_of, correction_of, denoise
from pcdenoise.errors import ScanError, UsageError
from pcdenoise.learning import trainer
from pcdenoise.learning.structure import shared_by
from pcdenoise.networks import store

CONFIG = DenoiseConfig(threads=2)
N, N_GROUPS, NOISE_SPACINGS = 6000, 4, 0.4


def off_by_group(name: str, stds: float, seed: int = 0) -> tuple[Cloud, np.ndarray, np.ndarray, np.ndarray]:
    """A noisy cloud, each of its groups off by a vector of so many noise stds: cloud, points, group (N,), offsets (G, 3)."""
    sample, rng = cloud(name, N, NOISE_SPACINGS, seed), np.random.default_rng(seed)
    group = rng.integers(N_GROUPS, size=N)
    offset = rng.standard_normal((N_GROUPS, 3))
    offset *= stds * NOISE_SPACINGS * sample.spacing / np.linalg.norm(offset, axis=1, keepdims=True)
    offset -= (np.bincount(group)[:, None] * offset).sum(axis=0) / N
    return sample, sample.noisy + offset[group], group, offset


@pytest.mark.parametrize("name", ["sphere", "torus", "cube"])
def test_offsets_are_found_to_within_what_noise_leaves_unknown(name: str) -> None:
    """A third of a group's points know each axis, which tells its mean to sqrt(3 / (N / G)) of the noise; five times that."""
    sample, points, group, offset = off_by_group(name, 2.0)
    found = alignment_of(points, [group], store.load(), CONFIG)[0]
    assert found.gain > 0
    tolerance = 5 * np.sqrt(3 * N_GROUPS / N) * NOISE_SPACINGS * sample.spacing
    assert np.abs(found.shift + offset).max() < tolerance
    assert tolerance < 0.5 * np.abs(offset).max()


def test_a_plane_tells_offsets_along_its_normal_alone() -> None:
    sample, points, group, offset = off_by_group("plane", 2.0)
    found = alignment_of(points, [group], store.load(), CONFIG)[0]
    noise = NOISE_SPACINGS * sample.spacing
    assert np.abs(found.shift[:, 2] + offset[:, 2]).max() < 5 * np.sqrt(N_GROUPS / N) * noise
    assert np.abs(found.shift[:, :2]).max() < 0.2 * noise


@pytest.mark.parametrize("name", ["sphere", "torus", "cube"])
def test_aligned_groups_are_cleaned_as_if_they_had_not_been_off(name: str) -> None:
    sample, points, group, _ = off_by_group(name, 2.0)
    plain, clean = (sample.error(denoise(noisy, store.load(), CONFIG).points) for noisy in (points, sample.noisy))
    correction = correction_of(points, group, store.load(), CONFIG)
    assert correction.figures["groups"] == N_GROUPS
    aligned = sample.error(denoise(points, store.load(), CONFIG, correction=correction).points)
    assert clean < 0.9 * plain
    assert aligned < clean + 0.25 * (plain - clean)


@pytest.mark.parametrize("seed", range(3))
def test_groups_that_agree_are_not_moved_at_all(seed: int) -> None:
    sample = cloud("torus", N, NOISE_SPACINGS, seed)
    rng = np.random.default_rng(seed)
    at_random = rng.integers(40, size=N)
    bands = np.floor(10 * (sample.clean[:, 2] - sample.clean[:, 2].min())).astype(np.int64)
    for found in alignment_of(sample.noisy, [at_random, bands], store.load(), CONFIG):
        assert found.gain == 0
        assert not found.shift.any()


def test_groups_without_neighbours_of_other_groups_stay() -> None:
    left, right = cloud("sphere", N // 2, NOISE_SPACINGS, 1), cloud("sphere", N // 2, NOISE_SPACINGS, 2)
    points = np.concatenate([left.noisy, right.noisy + [5, 0, 0.05]])
    assert not alignment_of(points, [np.repeat([0, 1], N // 2)], store.load(), CONFIG)[0].shift.any()


def test_the_order_of_rows_and_the_numbers_of_groups_do_not_matter() -> None:
    sample, points, group, _ = off_by_group("sphere", 2.0)
    order = np.random.default_rng(5).permutation(N)
    there = correction_of(points, group, store.load(), CONFIG).shift
    back = correction_of(points[order], (N_GROUPS - 1 - group)[order], store.load(), CONFIG).shift
    assert np.abs(there[order] - back).max() < 1e-6 * sample.spacing


def test_a_group_may_be_of_rows_that_coincide_with_others_or_are_not_finite() -> None:
    sample, points, group, _ = off_by_group("sphere", 2.0)
    more = np.concatenate([points, points[:5], np.full((2, 3), np.nan)])
    groups = np.concatenate([group, np.repeat([N_GROUPS, N_GROUPS + 1], [5, 2])])
    correction = correction_of(more, groups, store.load(), CONFIG)
    assert correction.figures["groups"] == N_GROUPS + 2
    assert np.abs(correction.shift[:N] - correction_of(points, group, store.load(), CONFIG).shift).max() < 1e-9 * sample.spacing
    cleaned = denoise(more, store.load(), CONFIG, correction=correction).points
    assert np.array_equal(cleaned[N : N + 5], cleaned[:5])


def test_limits_count_from_where_points_were_measured() -> None:
    sample, points, group, _ = off_by_group("sphere", 2.0)
    correction = correction_of(points, group, store.load(), CONFIG)
    limit = 0.3 * NOISE_SPACINGS * sample.spacing
    near = denoise(points, store.load(), CONFIG.model_copy(update={"max_move": limit}), correction=correction)
    assert 0.99 * limit < np.linalg.norm(near.points - points, axis=1).max() < limit * (1 + 1e-9)
    still = denoise(points, store.load(), CONFIG.model_copy(update={"strength": 0.0}), correction=correction)
    assert np.array_equal(still.points, points)


def test_columns_make_groups_and_odd_ones_are_refused() -> None:
    values = {"beam": np.array([7, 7, 3, 3] * 10, "u1"), "pose": np.array([0.5, np.nan, 0.5, 0.5] * 10)}
    scan = Scan(np.zeros((40, 3)), {**values, "gps_time": np.arange(40.0)}, origin="a.las")
    assert groups_of(scan, ["beam"]).tolist() == [1, 1, 0, 0] * 10
    assert groups_of(scan, ["beam", "pose"]).tolist() == [1, 2, 0, 0] * 10
    with pytest.raises(ScanError, match=r"a.las: has no column ring to align by; its columns: beam, pose, gps_time"):
        groups_of(scan, ["ring"])
    with pytest.raises(ScanError, match="40 points make 40 groups by gps_time"):
        groups_of(scan, ["gps_time"])


def write_off_by_beam(path: Path) -> tuple[Cloud, Scan]:
    sample, points, group, _ = off_by_group("sphere", 2.0)
    scan = Scan(points, {"beam": group.astype("u1"), "intensity": np.arange(N, dtype="u2")}, format="ply")
    pcdenoise.write(scan, path)
    return sample, pcdenoise.read(path)


def test_the_command_aligns_by_columns_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample, scan = write_off_by_beam(tmp_path / "scan.ply")
    out, report = tmp_path / "out.ply", tmp_path / "report.json"
    wanted = ["denoise", str(tmp_path / "scan.ply"), "-o", str(out), "--align-by", "beam", "--report", str(report), "-v"]
    assert main(wanted) == 0
    said = capsys.readouterr().err
    assert "4 groups by beam off by" in said
    assert "beam 0: " in said
    figures = json.loads(report.read_text())["files"][0]["figures"]
    assert figures["aligned_by"] == "beam"
    cleaned = pcdenoise.read(out)
    assert all(cleaned.attributes[name].tobytes() == values.tobytes() for name, values in scan.attributes.items())
    by_keyword = pcdenoise.denoise(scan, align_by=("beam",)).points
    assert np.abs(cleaned.points - by_keyword).max() < 1e-6
    plain, clean = (sample.error(pcdenoise.denoise(noisy).points) for noisy in (scan, sample.noisy))
    assert sample.error(cleaned.points) < clean + 0.25 * (plain - clean)


def test_iterate_aligns_as_denoise_does(tmp_path: Path) -> None:
    write_off_by_beam(tmp_path / "scan.ply")
    options = ["--align-by", "beam", "--iters", "2", "-q"]
    assert main(["denoise", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "out.ply"), *options]) == 0
    assert main(["iterate", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "steps"), *options]) == 0
    last = pcdenoise.read(tmp_path / "steps" / "scan_2.ply").points
    assert np.array_equal(last, pcdenoise.read(tmp_path / "out.ply").points)


def test_the_command_refuses_columns_that_are_not_there_and_cells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_off_by_beam(tmp_path / "scan.ply")
    wanted = ["denoise", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "out.ply"), "-q"]
    for more, code, fault in (
        (["--align-by", "ring"], 3, "has no column ring"),
        (["--align-by", "beam,"], 2, "give names of columns"),
        (["--align-by", "beam", "--tile", "2000"], 2, "--align-by: leave it out"),
    ):
        assert main([*wanted, *more]) == code
        assert fault in capsys.readouterr().err
    assert not (tmp_path / "out.ply").exists()
    with pytest.raises(UsageError, match="give a Scan"):
        pcdenoise.denoise(np.zeros((20, 3)), align_by=("beam",))


def test_a_model_that_was_adapted_says_by_which_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer, "_JUDGED_CLOUDS", 2)
    path, adapted, out = tmp_path / "scan.ply", tmp_path / "adapted", tmp_path / "out.ply"
    _, scan = write_off_by_beam(path)
    assert main(["train", "--data", str(path), "--steps", "1", "-o", str(adapted), "-q"]) == 0
    assert store.load(adapted).config.align_by == ("beam",)
    assert main(["denoise", str(path), "-o", str(out), "--model", str(adapted)]) == 0
    assert "4 groups by beam" in capsys.readouterr().err
    assert main(["denoise", str(path), "-o", str(out), "--model", str(adapted), "--align-by", "none", "--overwrite"]) == 0
    assert "groups" not in capsys.readouterr().err
    pcdenoise.write(Scan(scan.points, format="ply"), path, overwrite=True)
    assert main(["denoise", str(path), "-o", str(out), "--model", str(adapted), "--overwrite"]) == 0
    assert "has no column beam to align by; its columns: none; cleaned as it is" in capsys.readouterr().err


def test_a_column_is_learned_only_where_its_groups_are_off(tmp_path: Path) -> None:
    sample, scan = write_off_by_beam(tmp_path / "scan.ply")
    data, rng = (str(tmp_path / "scan.ply"),), np.random.default_rng(1)
    assert shared_by(data, store.load(), 0, 2) == ("beam",)
    with_more = {**scan.attributes, "classification": scan.attributes["beam"], "point_source_id": rng.integers(3, size=N)}
    pcdenoise.write(Scan(scan.points, with_more, format="ply"), tmp_path / "scan.ply", overwrite=True)
    assert shared_by(data, store.load(), 0, 2) == ("beam",)
    pcdenoise.write(Scan(sample.noisy, with_more, format="ply"), tmp_path / "scan.ply", overwrite=True)
    assert shared_by(data, store.load(), 0, 2) == ()


def test_a_class_is_aligned_and_every_other_row_stays(tmp_path: Path) -> None:
    sample, points, group, _ = off_by_group("sphere", 2.0)
    chosen = np.arange(N) < N // 2
    columns = {"classification": np.where(chosen, 2, 3).astype("u1"), "point_source_id": group.astype("u2")}
    source, out = tmp_path / "a.ply", tmp_path / "b.ply"
    pcdenoise.write(Scan(points, columns, format="ply"), source)
    assert main(["denoise", str(source), "-o", str(out), "--only-class", "2", "--align-by", "point_source_id", "-q"]) == 0
    before, after = pcdenoise.read(source), pcdenoise.read(out)
    assert np.array_equal(after.points[~chosen], before.points[~chosen])
    plain, clean = (sample.error(pcdenoise.denoise(noisy[chosen]).points) for noisy in (before.points, sample.noisy))
    assert sample.error(after.points[chosen]) < clean + 0.4 * (plain - clean)
