"""Real and awkward files from elsewhere: each is read right or refused in one line, and written back as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import io_samples
from pcdenoise import io

UNREADABLE = {
    "1.2-with-color-clipped.las": "claims 1065 points, the file holds 1064",
    "garbage_nVariableLength.las": "claims 719 points, the file holds 718",
    "1.2-no-points.las": "holds 0",
    "pdrf10-1.5.laz": "version: 4 is not supported",
    "pdrf9-1.5.laz": "version: 4 is not supported",
    "missingheader.pcd": "content is text",
    "no_vertex.ply": "no vertex element",
    "emptyIO_ply_empty_header.ply": "no vertex element",
    "unsized_dims.ply": "no x, y and z",
    "issue623.ply": "line 13: has 6 columns",
    "japanese-pr2135.txt": "three numbers",
}
"""Files that are broken or beyond the libraries, and why."""

RECOMPRESSED = {"pdrf4-1.3.laz", "liblas-generated.laz", "ellipsoid.copc.laz"}
"""LAZ files compressed in a way lazrs does not write: the points come back the same, the packed bytes do not."""


def scans(extra_data: Path) -> list[Path]:
    """Every file with a scan's suffix that is small enough for a quick test."""
    found = [path for name in ("awkward", "scans") for path in sorted((extra_data / name).rglob("*")) if io.is_scan(path)]
    return [path for path in found if path.stat().st_size < 2_000_000]


def test_every_file_is_read_and_written_back_or_refused_in_one_line(extra_data: Path, tmp_path: Path) -> None:
    n_read = 0
    for path in scans(extra_data):
        target = tmp_path / path.name.replace(".copc", "")
        if message := io_samples.refusal(io.read, path):
            assert UNREADABLE.get(path.name, "unexpected") in message
            assert "\n" not in message
            continue
        assert path.name not in UNREADABLE, f"{path} is readable now"
        scan = io.read(path)
        io.write(scan, target, overwrite=True)
        back = io.read(target)
        if path.name not in RECOMPRESSED:
            assert target.read_bytes() == path.read_bytes(), path
        assert np.array_equal(back.points, scan.points, equal_nan=True), path
        assert list(back.attributes) == list(scan.attributes), path
        n_read += 1
    assert n_read > 100


def test_moved_points_of_every_file_arrive_within_a_step_and_attributes_stay(extra_data: Path, tmp_path: Path) -> None:
    for path in scans(extra_data):
        if path.name in UNREADABLE:
            continue
        scan = io.read(path)
        if not scan.finite.any():
            continue
        centre = scan.points[scan.finite].mean(axis=0)
        points = centre + 0.999 * (scan.points - centre)
        target = tmp_path / path.name.replace(".copc", "")
        io.write(scan.moved_to(points), target, overwrite=True)
        back = io.read(target)
        scale = scan.source.file.field("scale").max() if scan.format in ("las", "laz") else 0.0
        text_step = 1e-6 * np.ptp(scan.points[scan.finite], axis=0).max()
        step = max(scale, text_step, 1.2e-7 * np.abs(points[scan.finite]).max())
        assert np.nanmax(np.abs(back.points - points), initial=0.0) <= step, path
        for name, values in scan.attributes.items():
            assert np.array_equal(back.attributes[name], values, equal_nan=values.dtype.kind == "f"), (path, name)


@pytest.mark.parametrize("name", ["points.ply", "bunny_8.pts", "simple.las", "simple-ascii.pcd"])
def test_a_small_file_of_each_format_has_the_points_it_shows(extra_data: Path, name: str) -> None:
    expected = {"points.ply": 4, "bunny_8.pts": 9, "simple.las": 1065, "simple-ascii.pcd": 213}
    path = next((extra_data / "awkward").rglob(name))
    assert len(io.read(path)) == expected[name]
