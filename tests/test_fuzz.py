"""Random and hostile files of every kind: readers, settings. Longer, on mutated real files: benchmarks/robustness."""

from __future__ import annotations

import gzip
import os
import struct
import subprocess
import sys
import warnings
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import io_samples
from pcdenoise.commands import main
from pcdenoise.errors import ScanError
from pcdenoise.io import kitti, las, pcd, ply, xyz
from pcdenoise.io.las_dimensions import Dimension

ROOT = Path(__file__).resolve().parent.parent
QUICK = settings(max_examples=80, deadline=None, database=None)
READERS = {"las": las.read, "ply": ply.read, "pcd": pcd.read, "xyz": xyz.read, "bin": kitti.read}
SEEDS = {
    "las": [io_samples.las(4, 7, n_extra=2, evlrs=[io_samples.evlr(b"x", 1, b"data")]), io_samples.las(2, 3, compressed=True)],
    "ply": [io_samples.ply(order, lists="ragged", faces=True, camera=True) for order in "=<>"],
    "pcd": [io_samples.pcd(encoding) for encoding in ("ascii", "binary", "binary_compressed")],
    "xyz": list(io_samples.XYZ.values()),
    "bin": [bytes(160)],
}
PLY = "ply\nformat binary_little_endian 1.0\nelement vertex N\nproperty float x\nproperty float y\nproperty float z\n"
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH N\nHEIGHT 1\nPOINTS N\nDATA binary\n"
TOKENS = [
    b"4294967295", b"-1", b"0", b"1e309", b"nan", b"99999999999999999999", b"property list uchar int x\n", b"property float x\n",
    b"element vertex 9\n", b"end_header\n", b"FIELDS x y z\n", b"COUNT 1 1 99999\n", b"DATA binary\n", b"\xff\xff\xff\xff",
    b"\0" * 8, b",", b";", b'"', b"\r", b"\n", b"#", b"//X Y Z\n", b"\xef\xbb\xbf",
]  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, kind: str) -> bytes:
    """A small sound file with pieces replaced by others, or cut."""
    raw = bytearray(draw(st.sampled_from(SEEDS[kind])))
    for _ in range(draw(st.integers(1, 5))):
        at = draw(st.integers(0, min(len(raw), 500)))
        new = draw(st.one_of(st.sampled_from(TOKENS), st.binary(max_size=6)))
        raw[at : at + draw(st.integers(0, 8))] = new
    return bytes(raw[: draw(st.integers(0, len(raw)))]) if draw(st.integers(0, 4)) == 0 else bytes(raw)


@pytest.mark.parametrize("kind", READERS)
@QUICK
@given(data=st.data())
def test_a_reader_gives_a_sound_scan_or_one_line(kind: str, data: st.DataObject) -> None:
    raw = data.draw(damaged(kind))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            scan = READERS[kind](raw, "fuzzed")
    except ScanError as fault:
        assert "\n" not in str(fault)
        assert str(fault).startswith("fuzzed")
        return
    assert scan.points.dtype == np.float64
    assert all(len(values) == len(scan) for values in scan.attributes.values())


def with_scale(scale: float) -> bytes:
    raw = io_samples.las(2, 0)
    return raw[:131] + struct.pack("<d", scale) + raw[139:]


@pytest.mark.parametrize(
    ("kind", "raw"),
    [
        ("las", with_scale(1e304)),
        ("pcd", PCD.replace("DATA binary", "DATA ascii").replace("z\n", "z rgb\n").replace("4\n", "4 4\n", 1)
            .replace("F\n", "F F\n").replace("1\n", "1 1\n", 1).replace("N", "1").encode() + b"1 2 3 1e40\n"),
    ],
    ids=["a scale beyond float64", "a packed colour beyond float32"],
)  # fmt: skip
def test_files_that_once_gave_warnings_are_read_without_a_word(kind: str, raw: bytes) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(READERS[kind](raw, "found")) > 0


SIGNALLING = struct.pack("<I", 0x7F800001)
"""A NaN that processors report when they convert it; sensors do write it."""


@pytest.mark.parametrize("kind", ["bin", "ply", "pcd"])
def test_nans_that_signal_are_read_without_a_word_and_come_back_bit_by_bit(kind: str) -> None:
    heads = {"bin": "", "ply": PLY.replace("N", "2") + "property float q\nend_header\n"}
    heads["pcd"] = PCD.replace("z\n", "z q\n").replace("4 4\n", "4 4 4\n").replace("F F\n", "F F F\n").replace("1 1\n", "1 1 1\n")
    raw = heads[kind].replace("N\n", "2\n").encode() + 4 * SIGNALLING + struct.pack("<4f", 1, 2, 3, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scan = READERS[kind](raw, "found")
        out = BytesIO()
        {"bin": kitti, "ply": ply, "pcd": pcd}[kind].write(scan.moved_to(scan.points + 1), out)
    assert out.getvalue()[:-16] == raw[:-16]
    assert np.frombuffer(out.getvalue()[-16:], "<f4").tolist() == [2, 3, 4, 4]


def test_a_wild_scale_of_an_extra_dimension_gives_infinities_without_a_word() -> None:
    records = np.array([(7,), (-7,), (0,)], dtype=[("depth", "<i4")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        values = Dimension("depth", "depth", scale=1e308).get(records)
    assert values.tolist() == [np.inf, -np.inf, 0.0]


PLAIN_VALUES = st.one_of(st.booleans(), st.integers(), st.floats(), st.text(max_size=8))
VALUES = st.one_of(PLAIN_VALUES, st.lists(st.one_of(PLAIN_VALUES, st.lists(PLAIN_VALUES, max_size=2)), max_size=3))
KEYS = st.one_of(
    st.sampled_from(["strength", "iters", "max-move", "seed", "method", "outliers", "config", "quiet", "inputs"]),
    st.text(max_size=6),
)


def as_toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(as_toml, value))}]"
    return '"' + "".join(f"\\U{ord(c):08X}" for c in value) + '"' if isinstance(value, str) else str(value)


@settings(max_examples=40, deadline=None, database=None)
@given(st.dictionaries(KEYS, VALUES, max_size=3), st.binary(max_size=30))
def test_a_settings_file_is_followed_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: dict[str, object], junk: bytes
) -> None:
    folder = tmp_path_factory.getbasetemp()
    path, scan = folder / "settings.toml", folder / "three.xyz"
    scan.write_bytes(b"1 2 3\n4 5 6\n7 8 9\n")
    lines = [f"{as_toml(key)} = {as_toml(value)}\n" for key, value in content.items()]
    path.write_bytes("".join(lines).encode("utf-8", "replace") if content else junk)
    assert main(["denoise", str(scan), "--config", str(path), "--dry-run"]) in (0, 2, 3)


@pytest.mark.parametrize("text", ["a = " + "[" * 5000 + "]" * 5000, "strength = 1\n" * 2, "x" * (2 << 20), "\ufeffstrength = 1"])
def test_settings_that_are_deep_large_or_doubled_are_one_line(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["models", "--config", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    for special in ("/dev/zero", str(tmp_path)):
        assert main(["denoise", "x.las", "-o", "y.las", "--config", special]) == 2
        assert "no regular file" in capsys.readouterr().err


def zipped(depth: int) -> bytes:
    raw = bytes(1 << 20)
    for _ in range(depth):
        file = BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("scan.las", raw)
        raw = file.getvalue()
    return raw


def claims(header: str, n: int) -> bytes:
    return header.replace("N", str(n)).encode()


PROPERTIES = b"".join(b"property float p%d\n" % i for i in range(200_000))
HOSTILE = {
    "zip.las": zipped(3), "zip.xyz": zipped(1), "points.ply": claims(PLY + "end_header\n", 4_000_000_000) + bytes(100),
    "text.ply": claims(PLY.replace("binary_little_endian", "ascii") + "end_header\n1 2 3\n", 4_000_000_000),
    "lists.ply": claims(PLY + "property list uint float w\nend_header\n", 2) + bytes(12) + b"\xff" * 40,
    "empty.ply": b"ply\nformat ascii 1.0\nelement face 4000000000\nelement vertex 1\nproperty float x\nproperty float y\n"
                 b"property float z\nend_header\n1 2 3\n",
    "properties.ply": PLY.replace("N", "1").encode() + PROPERTIES + b"end_header\n",
    "elements.ply": b"ply\nformat ascii 1.0\n" + b"element a 0\n" * 200_000 + b"end_header\n",
    "points.pcd": claims(PCD, 4_000_000_000) + bytes(100),
    "packed.pcd": claims(PCD[:-1] + "_compressed\n", 300_000_000) + b"\x10\0\0\0\0\xa4\x93\xd6" + bytes(16),
    "counts.pcd": claims(PCD.replace("COUNT 1 1 1", "COUNT 1 1 999999999"), 1) + bytes(100),
    "fields.pcd": b"FIELDS" + b" x" * 500_000 + b"\nDATA ascii\n",
    "line.xyz": b"1 2 3 " * 5_000_000, "nine.xyz": b"9" * 30_000_000, "quote.xyz": b'1,2,3,"' + b"," * 20_000_000,
    "columns.csv": b"x,y,z" + b",c" * 400_000 + b"\n" + b"1," * 400_000 + b"1\n", "count.pts": b"4000000000\n1 2 3\n",
    "grid.pcd": claims(PCD, 1 << 48).replace(b"WIDTH 281474976710656\nHEIGHT 1", b"WIDTH 16777216\nHEIGHT 16777216") + bytes(100),
    "overflow.pcd": claims(PCD, 4).replace(b"WIDTH 4\nHEIGHT 1", b"WIDTH 4294967296\nHEIGHT 4294967297") + bytes(48),
    "list.ply": claims(PLY + "property list int float w\nend_header\n", 2) + bytes(12) + b"\xff\xff\xff\x7f" + bytes(40),
    "zipped.las": gzip.compress(io_samples.las(2, 0)), "zipped.xyz": gzip.compress(b"1 2 3\n" * 100),
    "unbroken.xyz": b"1 2 3" + b" " * 40_000_000,
    "vlrs.las": io_samples.las(2, 0)[:100] + b"\xff\xff\xff\xff" + io_samples.las(2, 0)[104:],
    "count.las": io_samples.las(2, 0)[:107] + b"\xff\xff\xff\xff" + io_samples.las(2, 0)[111:],
    "count.laz": io_samples.las(2, 0, compressed=True)[:107] + b"\xff\xff\xff\x7f" + io_samples.las(2, 0, compressed=True)[111:],
    "evlrs.las": io_samples.las(4, 6)[:235] + b"\0" * 8 + b"\xff\xff\xff\xff" + io_samples.las(4, 6)[247:],
}  # fmt: skip
"""Files that claim, nest or repeat without bound."""
READABLE = {"vlrs.las"}

_READ_WITH_A_LIMIT = """
import resource, sys, time
from pathlib import Path
from pcdenoise.commands import main
from pcdenoise import io
from pcdenoise.cloud import noise_level
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
for path in map(Path, sys.argv[1:]):
    room = (300 << 20) + 20 * path.stat().st_size
    resource.setrlimit(resource.RLIMIT_AS, (size + room, resource.getrlimit(resource.RLIMIT_AS)[1]))
    began = time.process_time()
    code = main(["info", str(path), "--json", "--threads", "1"])
    print("RESULT", path.name, code, round(time.process_time() - began, 2), flush=True)
"""


def test_files_that_claim_billions_are_refused_in_bounded_time_and_memory(tmp_path: Path) -> None:
    """300 MB and twenty times the file's size of memory, 10 CPU seconds."""
    for name, raw in HOSTILE.items():
        (tmp_path / name).write_bytes(raw)
    done = subprocess.run(
        [sys.executable, "-c", _READ_WITH_A_LIMIT, *(tmp_path / name for name in HOSTILE)],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    results = {line.split()[1]: line.split()[2:] for line in done.stdout.splitlines() if line.startswith("RESULT")}
    assert results.keys() == HOSTILE.keys()
    assert {name for name, (code, _) in results.items() if code == "0"} == READABLE, done.stderr
    assert all(code in ("0", "3") for code, _ in results.values()), results
    assert all(float(seconds) < 10 for _, seconds in results.values()), results
    assert len(done.stderr.splitlines()) == len(HOSTILE) - len(READABLE), done.stderr
    assert "out of memory" not in done.stderr, done.stderr
