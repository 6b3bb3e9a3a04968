"""Depths that a camera rounded go back between their steps: near the truth, along their rays, and nothing else is touched."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from known_clouds import cloud
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.denoising import rounding

WIDE, HIGH, FOCAL, UNIT = 240, 180, 225.0, 3e-3
"""A camera's pixels, its focal length in pixels, and the steps of its disparity, which is one over the depth."""


def rays() -> np.ndarray:
    """(N, 3) from the camera through its pixels, as far as depth 1."""
    u, v = np.meshgrid(np.arange(WIDE) - WIDE / 2, np.arange(HIGH) - HIGH / 2)
    return np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], axis=-1).reshape(-1, 3)


def wall() -> np.ndarray:
    """(N,) depths of a slanted plane, 2.4 to 3.9: its disparity is linear in the image, and every terrace some 5 pixels wide."""
    ray = rays()
    return 1 / (0.33 + 0.11 * ray[:, 0] + 0.06 * ray[:, 1])


def ball() -> np.ndarray:
    """(N,) depths of a sphere of radius 0.6 before that wall, 2.5 away; terraces are rings of any width."""
    ray, centre = rays(), np.array([0.0, 0.0, 2.5])
    squared = (ray**2).sum(axis=1)
    along = ray @ centre / squared
    inside = along**2 - (centre @ centre - 0.6**2) / squared
    return np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), wall())


def measured(depth: np.ndarray, jitter_steps: float = 0.0) -> np.ndarray:
    """(N,) the depths as the camera tells them: disparity off by some jitter, then in whole steps."""
    jitter = jitter_steps * np.random.default_rng(3).standard_normal(len(depth))
    return 1 / (np.rint(1 / (UNIT * depth) + jitter) * UNIT)


def undone(points: np.ndarray) -> np.ndarray:
    found = rounding.find(points)
    assert found is not None
    return points + rounding.shift(points, found, threads=1)


def steps_at(depth: np.ndarray) -> np.ndarray:
    """(N,) how far one depth is from the next."""
    return UNIT * depth**2


@pytest.mark.parametrize("jitter_steps", [0.0, 0.15, 0.3])
@pytest.mark.parametrize(("scene", "left"), [(wall, 0.25), (ball, 0.5)])
def test_little_of_the_error_is_left(scene: Callable[[], np.ndarray], left: float, jitter_steps: float) -> None:
    """Of rounding and jitter together, over points whose neighbours are within a step, off the rim of the picture. A plate that
    does not bend is exact on the plane; where terraces are rings around a ball's nearest point, it is lower than the ball."""
    depth, ray = scene(), rays()
    points = ray * measured(depth, jitter_steps)[:, None]
    inner = np.zeros((HIGH, WIDE), bool)
    inner[5:-5, 5:-5] = True
    steps = np.rint(1 / (UNIT * depth)).reshape(HIGH, WIDE)
    apart = np.maximum(np.abs(np.gradient(steps, axis=0)), np.abs(np.gradient(steps, axis=1)))
    judged = (inner & (apart < 1)).ravel()
    before, after = ((p[judged, 2] - depth[judged]) / steps_at(depth[judged]) for p in (points, undone(points)))
    assert judged.mean() > 0.6
    assert np.sqrt((before**2).mean()) > 0.25
    assert np.sqrt((after**2).mean()) < left * np.sqrt((before**2).mean())


def test_a_thinned_cloud_gains_as_well() -> None:
    """A random third of the pixels: neighbours lie anywhere, and some are that of many others."""
    kept = np.random.default_rng(5).random(WIDE * HIGH) < 0.33
    depth = wall()[kept]
    points = rays()[kept] * measured(wall())[kept, None]
    before, after = (np.sqrt((((p[:, 2] - depth) / steps_at(depth)) ** 2).mean()) for p in (points, undone(points)))
    assert after < 0.6 * before


def test_points_stay_on_their_rays_and_within_a_step() -> None:
    depth = measured(ball(), 0.15)
    points = rays() * depth[:, None]
    moved = undone(points)
    assert np.abs(moved[:, :2] / moved[:, 2:] - rays()[:, :2]).max() < 1e-12
    change = np.abs(1 / moved[:, 2] - 1 / depth) / UNIT
    assert change.max() < 1.05  # depths, rather than disparities, are interpolated between two steps
    assert np.median(change) > 0.1


def test_depths_seen_along_their_axis_move_along_it_alone() -> None:
    """A wavy field seen from far above, points in even rows; in any of the three axes."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(320.0), np.arange(200.0)))
    height = 30 * np.sin(u / 140) * np.cos(v / 120) + 20 * np.sin(v / 110)
    for axis in range(3):
        points = np.insert(np.column_stack([u, v]), axis, np.rint(height), axis=1)
        moved = undone(points)
        assert (np.delete(moved - points, axis, axis=1) == 0).all()
        before, after = (np.sqrt(((p[:, axis] - height) ** 2).mean()) for p in (points, moved))
        assert after < 0.3 * before


def test_rows_may_come_in_any_order_unit_and_number() -> None:
    points = rays() * measured(ball(), 0.15)[:, None]
    order = np.random.default_rng(0).permutation(len(points))
    moved = undone(points)
    assert np.abs(undone(points[order]) - moved[order]).max() < 1e-9
    assert np.abs(undone(1024 * points) / 1024 - moved).max() < 1e-9
    assert np.abs(undone(np.repeat(points, 3, axis=0)) - np.repeat(moved, 3, axis=0)).max() < 1e-9
    with_holes = points.copy()
    with_holes[::7] = 0.0  # the camera saw nothing there
    assert (undone(with_holes)[::7] == 0).all()


def test_points_beside_an_edge_stay_and_things_behind_one_another_do_not_meet() -> None:
    depth = measured(ball())
    points = rays() * depth[:, None]
    moved = undone(points)
    steps = np.rint(1 / (UNIT * depth)).reshape(HIGH, WIDE)
    is_edge = np.zeros((HIGH, WIDE), bool)
    for axis in (0, 1):
        for side in (1, -1):
            is_edge |= np.abs(steps - np.roll(steps, side, axis)) > 2
    is_edge[[0, -1]] = is_edge[:, [0, -1]] = False
    assert is_edge.sum() > 100
    assert (moved[is_edge.ravel()] == points[is_edge.ravel()]).all()


def test_depths_that_nothing_has_are_steps_as_well() -> None:
    """A board before a frontal wall: between the two there are a hundred steps at which no point lies."""
    ray = rays()
    depth = np.where(np.abs(ray[:, 1]) < 0.25, 1 / (0.85 + 0.25 * ray[:, 1]), 3.0)
    points = ray * measured(depth)[:, None]
    moved = undone(points)
    assert (np.abs(moved[:, 2] - points[:, 2]) < 1.05 * steps_at(points[:, 2])).all()
    found = rounding.find(points)
    assert found is not None
    assert found.left(points) == pytest.approx(0.5 / np.sqrt(12) * steps_at(points[:, 2]), rel=1e-6)
    assert np.sqrt(((moved[:, 2] - depth) ** 2).mean()) < np.sqrt(((points[:, 2] - depth) ** 2).mean())


def test_a_stray_point_changes_nothing_for_the_others() -> None:
    points = rays() * measured(wall())[:, None]
    for stray in ([2.0, 0.0, 0.5], [0.0, 0.0, -0.01], [0.1, 0.1, 0.0]):
        assert np.abs(undone(np.vstack([points, stray]))[:-1] - undone(points)).max() < 1e-12


def test_where_most_points_lie_behind_one_another_nothing_moves() -> None:
    """Leaves in slices that are whole steps apart."""
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(0, 10, (60_000, 2)), 0.8 * rng.integers(0, 50, 60_000)])
    found = rounding.find(points)
    assert found is not None
    assert not rounding.shift(points, found).any()
    assert "rounded_axis" not in pcdenoise.denoise(points, threads=1).figures


def test_no_pass_at_all_still_undoes_rounding_and_told_noise_is_what_is_told() -> None:
    points = rays() * measured(wall())[:, None]
    assert np.abs(pcdenoise.denoise(points, threads=1, iters="auto").points - undone(points)).max() < 0.5 * UNIT * 3.9**2
    assert (pcdenoise.denoise(points, threads=1, strength=0).points == points).all()
    told = [pcdenoise.denoise(points, threads=1, noise=noise).points for noise in (1e-6, 0.02)]
    assert np.abs(told[0] - undone(points)).max() < 1e-4
    assert np.abs(told[1] - told[0]).max() > 1e-4


def test_other_clouds_are_not_taken_for_rounded() -> None:
    """Noise; noise rounded along all axes; a grid of heights; rows of a line scanner; ten storeys; too few points; exact walls
    that stand anywhere."""
    rng = np.random.default_rng(2)
    walls = [np.insert(rng.uniform(0, 9, (600, 2)), 0, np.round(rng.uniform(0, 50), 2), axis=1) for _ in range(40)]
    noisy = cloud("sphere", 20_000, 0.5).noisy
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(300.0), np.arange(200.0)))
    waves = np.sin(u / 60) * np.cos(v / 50)
    storeys = np.column_stack([u, v % 20, 5 * (v // 20)])
    for points in (
        noisy, np.round(noisy, 2), np.round(noisy, 1), np.column_stack([u, v, waves]), np.column_stack([u, 12 * v, waves]),
        storeys, storeys + 1e-3 * waves[:, None], noisy[:5], noisy[:0], np.zeros((9000, 3)),
        np.concatenate(walls),
    ):  # fmt: skip
        assert rounding.find(points) is None


def test_denoise_undoes_rounding_first_and_says_so_unless_it_is_to_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth = ball()
    points = rays() * measured(depth)[:, None]
    points[::50] = np.nan
    scan, clean, kept = (tmp_path / name for name in ("scan.ply", "clean.ply", "kept.ply"))
    pcdenoise.write(Scan(points, format="ply"), scan)
    assert main(["denoise", str(scan), "-o", str(clean), "--displacement"]) == 0
    assert "z was rounded in steps of" in capsys.readouterr().err
    assert main(["denoise", str(scan), "-o", str(kept), "--keep-rounded"]) == 0
    assert "z was rounded" not in capsys.readouterr().err
    known = np.isfinite(points).all(axis=1)

    def error(path: Path) -> float:
        moved = pcdenoise.read(path).points
        assert (np.isfinite(moved).all(axis=1) == known).all()
        return float(np.median(np.abs(moved[known, 2] - depth[known]) / steps_at(depth[known])))

    assert error(clean) < 0.4 * error(kept)
    assert pcdenoise.denoise(points, threads=1).figures["rounded_axis"] == "z"
    assert main(["denoise", str(scan), "-o", str(tmp_path / "cells.ply"), "--tile", "20000"]) == 0
    assert "rounded stay so" in capsys.readouterr().err
    for option, is_said in (([], True), (["--keep-rounded"], False)):
        assert main(["denoise", str(scan), "--dry-run", *option]) == 0
        assert ("z was rounded" in capsys.readouterr().out) == is_said
    assert main(["undo", str(clean), "-o", str(tmp_path / "back.ply")]) == 0
    assert pcdenoise.read(tmp_path / "back.ply").points[known].tobytes() == points[known].tobytes()
    assert main(["info", str(scan)]) == 0
    assert "z was rounded, in steps of" in capsys.readouterr().out
