"""Coverage-guided fuzzing of all that reads foreign bytes: scans of every format, settings files, model folders.

    python benchmarks/robustness/fuzz.py FOLDER... --minutes 15 [--only las laz] [--keep FOLDER]

Needs atheris (Linux). Each kind has a process and an equal share of the minutes; seeds are the small files of that kind below the
folders and small ones made here. What is neither a sound result nor an expected error in one line is kept as a file, each kind of
fault once. Exit code 0 if nothing was found, else 5. Not here: mutation without coverage, commands, signals (run.py).
"""

from __future__ import annotations

import argparse
import hashlib
import io as streams
import re
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

SCANS = {
    "las": (".las",),
    "laz": (".laz",),
    "ply": (".ply",),
    "pcd": (".pcd",),
    "xyz": (".xyz", ".txt", ".csv"),
    "bin": (".bin",),
}
KINDS = (*SCANS, "settings", "config", "weights")
LARGEST_SEED = 16_384
TIME_LIMIT_S, MEMORY_LIMIT_MB = 10, 2500
TOKENS = {
    "ply": "format ascii 1.0|format binary_big_endian 1.0|element vertex 2|property list uchar int a|property double x|"
    "end_header|comment|4294967295|1e309|nan",
    "pcd": "FIELDS x y z|COUNT 1 1 1|DATA ascii|DATA binary_compressed|WIDTH|HEIGHT|POINTS|VIEWPOINT|SIZE 8 8 8|TYPE F F F|rgb|"
    "99999999999",
    "xyz": r"//X Y Z|nan|-inf|1e309|;|,|\x09|\x0d|\x22|#|\xef\xbb\xbf",
    "las": r"LASF|laszip encoded|LASF_Spec|LASF_Projection|copc|pcdenoise|\xff\xff\xff\xff",
    "settings": r"iters = |[denoise]|strength = nan|1979-05-27|inf|\x5cuD800|[[denoise]]|max-move = |'''",
    "config": r"\x22settings\x22|\x22channels\x22|NaN|Infinity|1e999|null|[[[[|\x5cud800",
    "weights": r"\x22dtype\x22|\x22F32\x22|\x22F64\x22|\x22BF16\x22|\x22F8_E4M3\x22|\x22BOOL\x22|\x22C64\x22|data_offsets|"
    r"__metadata__|shape",
}
"""Words for libFuzzer to put in, by kind, with a bar between them."""
TOKENS["laz"] = TOKENS["las"]


def one_scan(kind: str, folder: Path) -> Callable[[bytes], None]:
    """A file refused in one line, or a round trip as in run.py, which is imported late: first comes atheris."""
    from run import round_trip

    from pcdenoise.errors import ScanError

    path, back = folder / f"in.{kind}", folder / f"out.{kind}"

    def try_one(raw: bytes) -> None:
        path.write_bytes(raw)
        try:
            round_trip(path, back)
        except ScanError as fault:
            assert "\n" not in str(fault), "a message of several lines"

    return try_one


def one_settings(folder: Path) -> Callable[[bytes], None]:
    """A settings file for `denoise` with an input that is not there: refused in one line for the one or the other."""
    from pcdenoise.commands import main

    path = folder / "settings.toml"

    def try_one(raw: bytes) -> None:
        path.write_bytes(raw)
        with redirect_stdout(streams.StringIO()), redirect_stderr(streams.StringIO()) as said:
            code = main(["denoise", str(folder / "gone.xyz"), "--config", str(path), "--dry-run"])
        assert code in (2, 3), f"exit code {code}"
        assert said.getvalue().count("\n") == 1, f"{said.getvalue().count(chr(10))} lines on stderr"

    return try_one


def small_model(folder: Path) -> None:
    """Saves the smallest network there is."""
    import torch

    from pcdenoise.networks import store
    from pcdenoise.networks.projection import ProjectionConfig, ProjectionNetwork

    torch.manual_seed(0)
    store.save(ProjectionNetwork(ProjectionConfig(4, 6, (1,), 1)), folder, summary="", training={}, scores={}, card="")


def one_model(file: str, folder: Path) -> Callable[[bytes], None]:
    """A model folder with that one file changed: refused in one line, or all weights are finite float32."""
    import torch

    from pcdenoise.errors import ModelError
    from pcdenoise.networks import store

    small_model(folder)

    def try_one(raw: bytes) -> None:
        (folder / file).write_bytes(raw)
        try:
            network = store.load(folder).network
        except ModelError as fault:
            assert "\n" not in str(fault), "a message of several lines"
            return
        assert all(t.dtype == torch.float32 and bool(t.isfinite().all()) for t in network.parameters()), (
            "weights that are no numbers"
        )

    return try_one


def seeds_of(kind: str, folders: list[Path], folder: Path) -> None:
    """Fills a folder with small files of a kind: those found, and some made here."""
    import numpy as np

    from pcdenoise import io
    from pcdenoise.cloud.scan import Scan
    from pcdenoise.networks import store

    suffixes = SCANS.get(kind, {"settings": (".toml",)}.get(kind, ()))
    found = (path for one in folders for path in sorted(one.rglob("*")) if path.suffix.lower() in suffixes and path.is_file())
    contents = [path.read_bytes() for path in found if path.stat().st_size <= LARGEST_SEED]
    if kind in SCANS:
        rng = np.random.default_rng(0)
        columns = {"intensity": rng.integers(0, 99, 20).astype("u2"), "label": rng.integers(0, 9, 20).astype("i4")}
        made = folder / f"made.{kind}"
        io.write(Scan(rng.normal(size=(20, 3)).round(3), columns), made, drop_attributes=True)
        contents.append(made.read_bytes())
    elif kind == "settings":
        contents += [b"seed = 3\n[denoise]\niters = 2\nstrength = 0.5\noutliers = 'flag'\n", b"iters = 'auto'\nmax-move = 0.1\n"]
    else:
        small_model(folder / "model")
        contents.append((folder / "model" / (store.CONFIG if kind == "config" else store.WEIGHTS)).read_bytes())
    for raw in contents:
        (folder / hashlib.sha256(raw).hexdigest()[:12]).write_bytes(raw)


def fuzz(kind: str, folders: list[Path], seconds: int, keep: Path) -> None:
    """Fuzzes one kind in this process, which atheris ends; findings are kept and named on stderr."""
    import atheris

    with atheris.instrument_imports(include=["pcdenoise"]):
        import pcdenoise.commands
        import pcdenoise.io
        import pcdenoise.networks.projection
        import pcdenoise.networks.store  # noqa: F401
    work = Path(tempfile.mkdtemp(prefix="pcdenoise-fuzz-"))
    (work / "seeds").mkdir()
    seeds_of(kind, folders, work / "seeds")
    try_one = {
        "settings": lambda: one_settings(work),
        "config": lambda: one_model("config.json", work),
        "weights": lambda: one_model("weights.safetensors", work),
    }.get(kind, lambda: one_scan(kind, work))()
    known: set[str] = set()

    def judged(raw: bytes) -> None:
        try:
            try_one(raw)
        except KeyboardInterrupt:
            raise
        except BaseException as fault:  # a Rust panic is no Exception
            frame = traceback.extract_tb(fault.__traceback__)[-1]
            name = f"{type(fault).__name__} at {Path(frame.filename).name}:{frame.lineno}"
            if name not in known:
                known.add(name)
                path = keep / f"{kind}-{hashlib.sha256(raw).hexdigest()[:12]}"
                path.write_bytes(raw)
                print(f"FOUND {kind}: {name}: {' '.join(str(fault).split())[:200]}; kept as {path}", file=sys.stderr, flush=True)

    words = work / "words.txt"
    words.write_text("".join(f'"{token}"\n' for token in TOKENS.get(kind, "nan").split("|") if token))
    limits = [
        f"-timeout={TIME_LIMIT_S}",
        f"-rss_limit_mb={MEMORY_LIMIT_MB}",
        f"-max_total_time={seconds}",
        f"-max_len={LARGEST_SEED}",
    ]
    atheris.Setup(
        ["fuzz", *limits, f"-dict={words}", f"-artifact_prefix={keep}/{kind}-", "-print_final_stats=1", str(work / "seeds")],
        judged,
    )
    atheris.Fuzz()


def main() -> int:
    """Fuzzes each kind in a process of its own and prints how many files were tried and what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="*", help="folders of files to start from")
    parser.add_argument("--minutes", type=float, default=15, help="for all kinds together")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"), help="folder for what was found")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.keep.mkdir(parents=True, exist_ok=True)
    seconds = max(1, round(60 * options.minutes / len(options.only)))
    if options.here:
        fuzz(options.only[0], options.folder, seconds, options.keep)
    n_tried, found = 0, []
    for kind in options.only:
        command = [sys.executable, __file__, *map(str, options.folder), "--here", "--only", kind, "--keep", str(options.keep)]
        done = subprocess.run([*command, "--minutes", str(seconds / 60)], capture_output=True, check=False)
        said = done.stderr.decode(errors="replace")
        n = re.search(r"number_of_executed_units: *(\d+)", said)
        lines = [line for line in said.splitlines() if line.startswith("FOUND")]
        if done.returncode or n is None:
            lines.append(f"FOUND {kind}: the process ended with {done.returncode}: {said[-600:]}")
        n_tried, found = n_tried + int(n[1] if n else 0), found + lines
        print(f"{kind:9} {seconds} s, {n[1] if n else '?'} inputs, {len(lines)} findings", flush=True)
    print("\n".join(found) or "nothing lost, hung or crashed")
    print(f"{n_tried} inputs in {seconds * len(options.only) / 60:g} minutes")
    return 5 if found else 0


if __name__ == "__main__":
    sys.exit(main())
