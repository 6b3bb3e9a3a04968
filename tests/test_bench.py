"""Judging a cleaned half by the half that was held back, and the command that compares methods so."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from known_clouds import ball, cloud
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.denoising import classical
from pcdenoise.evaluation.unseen import Unseen, halves


@pytest.mark.parametrize("name", ["plane", "sphere", "torus"])
def test_the_error_judged_without_truth_is_the_true_one(name: str) -> None:
    """1000 places of 16 points: the mean square of independent errors is known to 1 %; smooth errors repeat within a place."""
    sample = cloud(name, 8000, 0.5)
    given, held = halves(sample.noisy, len(sample.noisy))
    judge = Unseen(held)
    for points, tolerance in ((given, 0.05), (classical.jet(given), 0.15), (classical.mean(given), 0.2)):
        assert judge.error(points) == pytest.approx(sample.error(points), rel=tolerance)
    assert judge.error(sample.clean[:4000]) < 0.1 * sample.spacing


def test_known_noise_on_top_is_found_again(rng: np.random.Generator) -> None:
    sample = cloud("sphere", 8000, 0.3)
    given, held = halves(sample.noisy, len(sample.noisy))
    own, more = 0.3 * sample.spacing, 0.6 * sample.spacing
    noisier = given + more * rng.standard_normal(given.shape)
    assert Unseen(held).error(noisier) == pytest.approx(np.hypot(own, more), rel=0.06)


def test_halves_share_no_point_and_a_large_cloud_gives_a_compact_part(rng: np.random.Generator) -> None:
    points = rng.random((5000, 3))
    given, held = halves(points, 1000)
    both = np.concatenate([given, held])
    assert len(given) == len(held) == 500
    assert len(np.unique(both, axis=0)) == 1000
    assert np.ptp(both, axis=0).max() < 0.9


def test_bench_writes_a_row_for_each_method_and_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan, report = tmp_path / "scan.ply", tmp_path / "bench.csv"
    pcdenoise.write(Scan(cloud("sphere", 2000, 0.5).noisy), scan)
    assert main(["bench", str(scan), "--added", "0,1", "--report", str(report), "-q", "--threads", "1"]) == 0
    rows = list(csv.DictReader(report.open()))
    errors = {(row["figures.method"], row["figures.added"]): float(row["figures.error"]) for row in rows}
    assert {method for method, _ in errors} >= {"as it is", "network default", "mean", "bilateral", "jet"}
    for added in ("0.0", "1.0"):
        assert errors["network default", added] < 0.8 * errors["as it is", added]
    assert "network default" in capsys.readouterr().out


def test_the_page_of_bench_says_what_the_terminal_says_and_names_its_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, broken, page, report = (tmp_path / name for name in ("scan.ply", "broken.ply", "bench.html", "bench.json"))
    pcdenoise.write(Scan(cloud("sphere", 2000, 0.5).noisy), scan)
    broken.write_bytes(b"ply\nformat nonsense\n")
    command = ["bench", str(broken), str(scan), "--added", "0,1", "--model", "default", "-q", "--threads", "1"]
    for path in (page, report):
        assert main([*command, "--report", str(path)]) == 1
    text = page.read_text()
    headings = [text.index(f">{name}<") for name in ("Error +0x", "Error +1x", "CPU (s)", "Spacing variation")]
    assert headings == sorted(headings)
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("as it is"))
    written = json.loads(report.read_text())
    evenness = [
        record["figures"]["spacing_variation"]
        for record in written["files"]
        if record["status"] == "done" and record["figures"]["method"] == "as it is"
    ]
    assert row.split()[-1] == f"{np.mean(evenness):.4g}"
    assert written["settings"]["models"] == ["default"]
    assert len(written["settings"]["models_sha256"][0]) == 64
    assert written["figures"]["failed"] == 1


def test_bench_refuses_what_it_cannot_judge(tmp_path: Path, rng: np.random.Generator) -> None:
    for name, points in (("few", rng.random((50, 3))), ("volume", ball(3000, rng))):
        pcdenoise.write(Scan(points), tmp_path / f"{name}.ply")
        assert main(["bench", str(tmp_path / f"{name}.ply"), "-q"]) == 3
    assert main(["bench", str(tmp_path / "few.ply"), "--added", "1,x"]) == 2
