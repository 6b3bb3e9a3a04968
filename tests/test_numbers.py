"""Numbers that could go wrong, by file and by the command line: for each what must hold, for the network and the filters."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import io_samples
import pcdenoise
from pcdenoise import Scan
from pcdenoise.commands import main
from pcdenoise.config import DenoiseConfig
from pcdenoise.denoising.denoiser import denoise
from pcdenoise.networks import store

METHODS = ["network", "mean", "bilateral", "jet"]
UTM = np.array([5e5, 5.8e6, 300.0])


def plane(n: int, rng: np.random.Generator, noise: float = 0.02) -> np.ndarray:
    """n points of the unit square with noise across it."""
    return np.column_stack([rng.random((n, 2)), noise * rng.standard_normal(n)])


CLOUDS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "no point": lambda rng: np.empty((0, 3)),
    "one point": lambda rng: rng.normal(size=(1, 3)),
    "two points": lambda rng: rng.normal(size=(2, 3)),
    "one fewer than neighbours": lambda rng: rng.normal(size=(23, 3)),
    "as many as neighbours": lambda rng: rng.normal(size=(24, 3)),
    "one more than neighbours": lambda rng: rng.normal(size=(25, 3)),
    "only NaN": lambda rng: np.full((40, 3), np.nan),
    "one coordinate NaN or infinite": lambda rng: np.where(rng.random((400, 3)) < 0.1, np.inf * -1, plane(400, rng)),
    "all at one place": lambda rng: np.tile(UTM, (400, 1)),
    "all twice": lambda rng: np.repeat(plane(200, rng), 2, axis=0),
    "collinear": lambda rng: np.outer(rng.random(400), [1.0, 2, 3]) + UTM,
    "coplanar": lambda rng: plane(400, rng, 0) + UTM,
    "a raster": lambda rng: np.stack(np.meshgrid(*[np.arange(20.0)] * 2, [0.0]), axis=-1).reshape(-1, 3),
    "one point far away": lambda rng: np.concatenate([plane(400, rng), [[1e9, 1e9, 1e9]]]),
    "extent of a micrometre": lambda rng: 1e-6 * plane(400, rng) + [3.0, 4, 5],
    "extent of ten thousand kilometres": lambda rng: 1e7 * plane(400, rng),
    "UTM": lambda rng: plane(400, rng) + UTM,
    "degrees": lambda rng: plane(400, rng) * [1e-5, 1e-5, 1] + [13.4, 52.5, 34],
}


@pytest.mark.parametrize("scale", [1e-310, 1e-100, 1e100, 1e200, 1e307])
def test_coordinates_whose_squares_are_lost_are_refused_in_one_line(
    scale: float, tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "scan.ply", tmp_path / "out.ply"
    pcdenoise.write(Scan(scale * plane(100, rng)), path)
    for arguments in (["info", str(path)], ["denoise", str(path), "-o", str(out), "--method", "mean"]):
        assert main(arguments) == 3
        assert "beyond any scan" in (said := capsys.readouterr().err)
        assert said.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", CLOUDS)
def test_rows_stay_finite_stays_finite_and_nothing_leaves_its_surroundings(
    name: str, method: str, rng: np.random.Generator
) -> None:
    points = CLOUDS[name](rng)
    before = points.copy()
    config = DenoiseConfig.model_validate({"method": method, "threads": 1, "outliers": "flag"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = denoise(points, store.load() if method == "network" else None, config)
    finite = np.isfinite(points).all(axis=1)
    assert np.array_equal(points, before, equal_nan=True)
    assert result.points.shape == points.shape
    assert np.array_equal(result.points[~finite], points[~finite], equal_nan=True)
    assert np.isfinite(result.points[finite]).all()
    assert result.figures["points_not_finite"] == (~finite).sum()
    if finite.any():
        low, high = points[finite].min(axis=0), points[finite].max(axis=0)
        slack = (high - low).max()
        assert (result.points[finite] >= low - slack).all()
        assert (result.points[finite] <= high + slack).all()
    if name in ("all at one place", "one point", "two points"):
        assert np.array_equal(result.points, points)
    if name == "all twice":
        assert np.array_equal(result.points[0::2], result.points[1::2])
    if name == "one point far away":
        assert np.abs(result.points[:-1]).max() < 2


IN_FILES = [
    "no point", "one point", "only NaN", "one coordinate NaN or infinite", "all at one place", "UTM", "degrees",
    "one point far away", "extent of ten thousand kilometres",
]  # fmt: skip


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".pcd", ".xyz", ".bin"])
@pytest.mark.parametrize("name", IN_FILES)
def test_every_format_takes_odd_numbers_through_the_commands_or_refuses_in_one_line(
    name: str, suffix: str, tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / f"scan{suffix}", tmp_path / f"out{suffix}"
    points = CLOUDS[name](rng)
    if io_samples.refusal(lambda: pcdenoise.write(Scan(points), path, drop_attributes=True)):
        assert suffix in (".las", ".laz")
        assert not np.isfinite(points).all(), "LAS holds no NaN, and all else"
        assert not path.exists()
        return
    if not path.stat().st_size or io_samples.refusal(pcdenoise.read, path):  # a text or KITTI file without points is no scan
        assert len(points) == 0
        assert main(["denoise", str(path), "-o", str(out)]) == 3
        assert capsys.readouterr().err.count("\n") == 1
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["info", str(path), "--json"]) == 0
        for method in ("network", "jet"):
            assert main(["denoise", str(path), "-o", str(out), "-q", "--overwrite", "--method", method]) == 0
            assert main(["verify", str(path), str(out)]) == 0
    assert capsys.readouterr().err == ""
    assert len(pcdenoise.read(out)) == len(points)


def test_nan_rows_of_an_organised_pcd_stay_bit_by_bit_and_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "grid.pcd", tmp_path / "out.pcd"
    path.write_bytes(io_samples.pcd("binary", organised=True, n=400))
    assert main(["info", str(path)]) == 0
    assert "58 without coordinates" in capsys.readouterr().out
    assert main(["denoise", str(path), "-o", str(out), "-q", "--method", "mean"]) == 0
    before, after = pcdenoise.read(path), pcdenoise.read(out)
    assert np.array_equal(before.finite, after.finite)
    assert b"WIDTH 40\nHEIGHT 10\n" in out.read_bytes()


@pytest.mark.parametrize("top", [0, 255, 65535])
def test_colours_come_back_as_they_were_whatever_their_range(top: int, tmp_path: Path, rng: np.random.Generator) -> None:
    """All zero, 8 bits in 16-bit fields, full range: none is guessed at or rescaled."""
    path, out = tmp_path / "scan.las", tmp_path / "out.las"
    colours = {name: rng.integers(0, top + 1, 400).astype("u2") for name in ("red", "green", "blue")}
    pcdenoise.write(Scan(plane(400, rng), colours), path)
    stored = pcdenoise.read(path)
    picture = ["--picture", str(tmp_path / "p.png")] if top == 0 else []
    assert main(["denoise", str(path), "-o", str(out), "-q", *picture]) == 0
    for name, values in colours.items():
        assert np.array_equal(stored.attributes[name], values)
        assert np.array_equal(pcdenoise.read(out).attributes[name], values)


def test_noise_below_the_step_of_the_file_leaves_points_on_its_raster(tmp_path: Path, rng: np.random.Generator) -> None:
    """A slope stored in steps of 0.01 with noise of 0.001: coordinates stay whole steps within one of where they were."""
    records = io_samples.las_records(6, 900, 0)
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(30), np.arange(30)))
    height = np.rint(0.37 * i + 0.21 * j + rng.normal(0, 0.1, 900))
    steps = np.stack([10 * i, height, 20 * j], axis=1).astype("<i4")
    records[:, :12] = steps.view(np.uint8).reshape(900, 12)
    path, out = tmp_path / "scan.las", tmp_path / "out.las"
    path.write_bytes(io_samples.las(4, 6, records=records))
    assert main(["denoise", str(path), "-o", str(out), "--method", "jet", "-q"]) == 0
    assert main(["verify", str(path), str(out), "--max-move", "0.02"]) == 0
    raster = (pcdenoise.read(out).points - io_samples.OFFSET) / io_samples.SCALE
    assert np.abs(raster - np.rint(raster)).max() < 1e-4


def test_a_move_beyond_int32_is_one_line_and_leaves_the_old_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two sheets of points around the largest integer: the mean of an upper point lies within, a column beyond it cannot be."""
    raw = io_samples.las(2, 0, n=400)
    path, out = tmp_path / "edge.las", tmp_path / "out.las"
    path.write_bytes(raw)
    out.write_bytes(b"old")
    scan = pcdenoise.read(path)
    far = scan.points.copy()
    far[7, 2] = 1e9
    message = io_samples.refusal(lambda: pcdenoise.write(scan.moved_to(far), out, overwrite=True))
    assert "row 7 has z" in message
    assert "limit the move" in message
    assert out.read_bytes() == b"old"
