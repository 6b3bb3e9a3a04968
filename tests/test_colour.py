"""Colours along a cleaned surface: noise falls as derived; edges, dtypes, ranges and rows stay, and undo brings all back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from known_clouds import cloud
from pcdenoise.cloud.neighbours import spatial_order
from pcdenoise.commands import main
from pcdenoise.denoising.colour import NEIGHBOURS, RANGE_STDS, noise_std, smoothed

SPHERE = cloud("sphere", 6000, 0.0).clean
SPHERE = SPHERE[spatial_order(SPHERE)]
EDGE = np.where(SPHERE[:, :1] > 0, [200.0, 60.0, 120.0], [60.0, 160.0, 120.0])
STD = 6.0


def test_noise_falls_by_the_derived_share_and_the_edge_stays(rng: np.random.Generator) -> None:
    """The kernel (1 - d²)² over a disc weighs n neighbours as 5/9 n equal ones, and the range kernel as few as (1 + 2 / RANGE²)
    less in each of three channels. What is left: of the own error 1 / (1 + RANGE²), of the others' the mean."""
    noisy = EDGE + rng.normal(0, STD, EDGE.shape)
    n_equal = 5 / 9 * NEIGHBOURS / (1 + 2 / RANGE_STDS**2) ** 3
    expected = STD * np.hypot(1 / (1 + RANGE_STDS**2), n_equal**-0.5)
    left = smoothed(SPHERE, noisy) - EDGE
    far = np.abs(SPHERE[:, 0]) > 0.25
    assert left[far].std() == pytest.approx(expected, rel=0.15)
    # 140 between the sides is 23 stds, so that no neighbour across the edge has a say: it is as clean as any other place.
    near = np.abs(SPHERE[:, 0]) < 0.03
    assert left[near].std() < 1.6 * expected
    assert abs(left[near & (SPHERE[:, 0] > 0), 0].mean()) < 4 * expected / near.sum() ** 0.5 + 0.2 * STD


def test_the_noise_is_found_in_each_channel(rng: np.random.Generator) -> None:
    """5 % for the edge, which adds to the differences of those beside it."""
    noisy = EDGE + rng.normal(0, [2, 6, 12], EDGE.shape)
    np.testing.assert_allclose(noise_std(SPHERE, noisy), [2, 6, 12], rtol=0.05)


@pytest.mark.parametrize(("dtype", "full"), [("u1", 255), ("u2", 65535), ("f4", 1)])
def test_dtype_and_range_stay(dtype: str, full: float, rng: np.random.Generator) -> None:
    noisy = np.clip((EDGE + rng.normal(0, 60, EDGE.shape)) / 255, 0, 1) * full
    colours = noisy.astype(dtype)
    result = smoothed(SPHERE, colours)
    assert result.dtype == colours.dtype
    assert (result.min(axis=0) >= colours.min(axis=0)).all()
    assert (result.max(axis=0) <= colours.max(axis=0)).all()
    assert not np.array_equal(result, colours)


def test_colours_without_noise_stay_and_so_do_rows_without_coordinates(rng: np.random.Generator) -> None:
    assert np.array_equal(smoothed(SPHERE, EDGE), EDGE)
    assert np.array_equal(smoothed(SPHERE, EDGE.astype("u1")), EDGE.astype("u1"))
    points, colours = SPHERE.copy(), rng.integers(0, 255, SPHERE.shape).astype("u1")
    points[:3] = np.nan
    assert np.array_equal(smoothed(points, colours)[:3], colours[:3])


def test_rows_in_another_order_get_the_same_colours(rng: np.random.Generator) -> None:
    colours, order = (EDGE + rng.normal(0, STD, EDGE.shape)).astype("u1"), rng.permutation(len(SPHERE))
    difference = smoothed(SPHERE[order], colours[order]).astype(int) - smoothed(SPHERE, colours)[order]
    assert np.abs(difference).max() <= 1  # sums in another order may round to the other side


@pytest.fixture
def noisy(tmp_path: Path, rng: np.random.Generator) -> pcdenoise.Scan:
    points = SPHERE + rng.normal(0, 0.02, SPHERE.shape)
    colours = np.clip(EDGE + rng.normal(0, STD, EDGE.shape), 0, 255)
    return pcdenoise.Scan(points, {name: colours[:, i].astype("u1") for i, name in enumerate(("red", "green", "blue"))})


@pytest.mark.parametrize("format", ["ply", "las"])
def test_the_command_smooths_colours_and_undo_brings_them_back(format: str, noisy: pcdenoise.Scan, tmp_path: Path) -> None:
    first, clean, back = (tmp_path / f"{name}.{format}" for name in ("first", "clean", "back"))
    wide = {name: values.astype("u2") * 257 for name, values in noisy.attributes.items()}
    pcdenoise.write(pcdenoise.Scan(noisy.points, wide if format == "las" else noisy.attributes), first)
    arguments = ["denoise", str(first), "-o", str(clean), "--method", "mean", "-q", "--colour"]
    assert main([*arguments, "--displacement"]) == 0
    before, after = pcdenoise.read(first), pcdenoise.read(clean)
    assert after.attributes["red"].dtype == before.attributes["red"].dtype
    truth = EDGE[:, 0] * (257 if format == "las" else 1)
    spread = [float(np.std(scan.attributes["red"] - truth)) for scan in (after, before)]
    assert spread[0] < 0.5 * spread[1]
    assert main(["undo", str(clean), "-o", str(back)]) == 0
    assert back.read_bytes() == first.read_bytes()


def test_scans_without_colours_and_scans_in_cells_are_refused(
    noisy: pcdenoise.Scan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, coloured, out = tmp_path / "plain.ply", tmp_path / "coloured.ply", tmp_path / "out.ply"
    pcdenoise.write(pcdenoise.Scan(noisy.points), plain)
    pcdenoise.write(noisy, coloured)
    assert main(["denoise", str(plain), "-o", str(out), "--method", "mean", "--colour"]) == 3
    assert "leave out --colour" in capsys.readouterr().err
    assert main(["denoise", str(coloured), "-o", str(out), "--method", "mean", "--colour", "--tile", "2000"]) == 2
    assert "--colour" in capsys.readouterr().err
    assert not out.exists()
