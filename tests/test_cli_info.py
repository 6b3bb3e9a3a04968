"""`pcdenoise info` as a noise meter: the map, the traps it warns of, the coordinate system, the cost."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from io_samples import SCALE, las, las_records, vlr
from known_clouds import UTM, ball, cloud
from pcdenoise.cloud import noise_level
from pcdenoise.cloud.scan import Scan
from pcdenoise.commands import main
from pcdenoise.commands.survey import survey
from pcdenoise.io import crs

UTM_WKT = (
    'COMPD_CS["UTM 17N + NAVD88 (ft)",PROJCS["WGS 84 / UTM zone 17N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",'
    '6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'UNIT["Meter",1.0],AUTHORITY["EPSG","32617"]],VERT_CS["NAVD88 height (ftUS)",VERT_DATUM["NAVD 88",2005],'
    'UNIT["US survey foot",0.304800609601219]]]'
)
WKT2 = (
    'PROJCRS["RGF93 / Lambert-93",BASEGEOGCRS["RGF93",DATUM["RGF 1993",ELLIPSOID["GRS 1980",6378137,298.257222101,'
    'LENGTHUNIT["metre",1]]]],CS[Cartesian,2],AXIS["easting (X)",east,ORDER[1],LENGTHUNIT["metre",1]],ID["EPSG",2154]]'
)


def geo_keys(*keys: tuple[int, int, int, int]) -> bytes:
    return struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(struct.pack("<4H", *key) for key in keys)


@pytest.mark.parametrize(
    ("records", "expected"),
    [
        (
            {crs.WKT: UTM_WKT.encode() + b"\0"},
            crs.Crs("WGS 84 / UTM zone 17N", "metre", "NAVD88 height (ftUS)", "US survey foot", "projected"),
        ),
        ({crs.WKT: WKT2.encode()}, crs.Crs("RGF93 / Lambert-93", "metre", kind="projected")),
        ({crs.GEO_KEYS: geo_keys((1024, 0, 1, 2), (2048, 0, 1, 4326))}, crs.Crs("EPSG:4326", "degree", kind="geographic")),
        (
            {
                crs.GEO_KEYS: geo_keys((1024, 0, 1, 1), (3072, 0, 1, 32617), (3076, 0, 1, 9001), (4097, 34737, 7, 0)),
                crs.GEO_TEXT: b"NAVD88|\0",
            },
            crs.Crs("EPSG:32617", "metre", "NAVD88", kind="projected"),
        ),
        ({crs.WKT: b"''\0"}, None),
        ({crs.WKT: b"PROJCS[" * 5000}, crs.Crs(kind="projected")),
        ({crs.GEO_KEYS: b"\1\0\1\0\0\0\xff\xff\0"}, None),
        ({}, None),
    ],
)
def test_coordinate_systems_are_read_from_text_and_geotiff(records: dict[int, bytes], expected: crs.Crs | None) -> None:
    assert crs.parse(records) == expected


@pytest.mark.parametrize("name", ["plane", "sphere", "torus"])
def test_the_map_follows_a_noise_that_grows_along_the_scan(name: str) -> None:
    """The places of 384 points are averaged, to a scatter of about 4 %, and hold noise that varies: 15 % for half of the points
    and a high correlation are what may be asked."""
    sample = cloud(name, 8000, 1.0)
    along = sample.clean[:, 0] - sample.clean[:, 0].min()
    share = 0.3 + along / along.max()
    noisy = sample.clean + (sample.noisy - sample.clean) * share[:, None]
    found = noise_level.around(noisy, noise_level.estimate(noisy))
    known = np.isfinite(found)
    ratio = found[known] / (sample.spacing * share[known])
    assert known.mean() > 0.95
    assert np.quantile(np.abs(ratio - 1), 0.5) < 0.15
    assert np.corrcoef(found[known], share[known])[0, 1] > 0.9


def test_where_no_surface_shows_the_map_says_so(rng: np.random.Generator) -> None:
    volume = ball(4000, rng)
    assert np.isnan(noise_level.around(volume, noise_level.estimate(volume))).mean() > 0.5
    assert np.isnan(noise_level.around(volume[:5], noise_level.estimate(volume[:5]))).all()


def warnings_of(scan: Scan) -> str:
    return " | ".join(survey(scan)["warnings"])


def test_traps_are_named_and_an_ordinary_scan_has_none(tmp_path: Path) -> None:
    sample = cloud("plane", 4000, 0.5)
    assert warnings_of(Scan(sample.noisy)) == ""
    far = (sample.noisy + UTM).astype(np.float32).astype(np.float64)
    assert "float32" in warnings_of(Scan(far))
    assert "degrees" in warnings_of(Scan(sample.noisy * [1e-5, 1e-5, 100.0] + [7.5, 48.0, 100.0]))
    for key, words in ((UTM_WKT, "heights in US survey foot"), ('GEOGCS["WGS 84",UNIT["degree",0.0174532925199433]]', "degrees")):
        path = tmp_path / f"{words}.las"
        path.write_bytes(las(4, 6, vlrs=[vlr(b"LASF_Projection", crs.WKT, key.encode())]))
        assert words in warnings_of(pcdenoise.read(path))


def test_a_step_that_swallows_moves_is_that_of_a_las_and_of_nothing_else(tmp_path: Path) -> None:
    """A plane whose noise is half of the coarsest step of the file; a text of the same numbers gets the decimals it needs."""
    sample = cloud("plane", 4000, 0.5)
    points = 0.01 / sample.spacing * sample.noisy
    records = las_records(6, len(points), 0)
    records[:, :12] = np.rint(points / SCALE).astype("<i4").view(np.uint8).reshape(-1, 12)
    (tmp_path / "coarse.las").write_bytes(las(4, 6, records=records))
    scan = pcdenoise.read(tmp_path / "coarse.las")
    assert "step of 0.01" in warnings_of(scan)
    pcdenoise.write(Scan(np.round(scan.points, 2)), tmp_path / "coarse.xyz")
    text = pcdenoise.read(tmp_path / "coarse.xyz")
    assert "step" not in warnings_of(text)
    moved = text.moved_to(text.points + 1e-4)
    pcdenoise.write(moved, tmp_path / "moved.xyz")
    assert np.allclose(pcdenoise.read(tmp_path / "moved.xyz").points, moved.points, rtol=0, atol=1e-5)


def test_info_writes_the_map_as_a_column_and_a_picture_and_both_only_once(
    milk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture, column = tmp_path / "noise.png", tmp_path / "noise.ply"
    command = ["info", str(milk), "--picture", str(picture), "--noise-map", str(column), "--json"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)[0]
    noise = pcdenoise.read(column).attributes["noise"]
    assert found["noise_p5"] <= np.nanmedian(noise) <= found["noise_p95"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert found["expected_cpu_s"] > 0
    assert found["expected_memory_mb"] > 0
    assert main(command) == 3


def test_the_plan_of_a_dry_run_names_cost_and_traps_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "far.ply"
    pcdenoise.write(Scan((cloud("plane", 3000, 0.5).noisy + UTM).astype(np.float32).astype(np.float64)), path)
    assert main(["denoise", str(path), "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "CPU s" in said
    assert "rounded to float32" in said
    assert list(tmp_path.iterdir()) == [path]


def test_a_system_that_the_coordinates_cannot_have_is_doubted_and_lends_no_unit(tmp_path: Path) -> None:
    """UTM coordinates under a heading of degrees, or of metres from the middle of the Earth (as real files have it)."""
    utm = ([515_396.0, 4_918_348.0, 2324.0], [515_429.0, 4_918_389.0, 2340.0])
    degrees = crs.parse({crs.GEO_KEYS: geo_keys((1024, 0, 1, 2), (2048, 0, 1, 4326))})
    geocentric = crs.parse({crs.GEO_KEYS: geo_keys((1024, 0, 1, 3), (2048, 0, 1, 4326))})
    assert degrees is not None
    assert geocentric is not None
    assert "x reaches 515,429" in degrees.misfit(*utm)
    assert "underground" in geocentric.misfit(*utm)
    assert geocentric.misfit([-1_891_000.0, -4_265_000.0, 4_330_000.0], [-1_890_000.0, -4_264_000.0, 4_440_000.0]) == ""
    assert degrees.misfit([-110.8, 44.4, 2000.0], [-110.7, 44.5, 2400.0]) == ""
    assert crs.Crs("EPSG:32612", "metre", kind=crs.PROJECTED).misfit(*utm) == ""
    path = tmp_path / "wrong.las"
    path.write_bytes(las(4, 6, vlrs=[vlr(b"LASF_Projection", crs.WKT, b'GEOGCS["WGS 84",UNIT["degree",0.0174532925199433]]')]))
    scan = pcdenoise.read(path)
    found = survey(scan.moved_to(scan.points + [515_396.0, 4_918_348.0, 2324.0]))
    assert found["unit"] == ""
    assert "cannot be right" in " | ".join(found["warnings"])
    assert "project the scan" not in " | ".join(found["warnings"])
