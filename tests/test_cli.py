"""The command line as a person meets it: exit codes, one-line errors, names, refusal, pipes, settings, quiet."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import pcdenoise
from pcdenoise.commands import main
from pcdenoise.networks import fused

ROOT = Path(__file__).resolve().parent.parent
FAST = ["--method", "mean"]
Run = Callable[..., subprocess.CompletedProcess[bytes]]


@pytest.fixture
def sphere(tmp_path: Path, rng: np.random.Generator) -> Path:
    """3 000 points of a unit sphere with radial noise of 2 %, as text with an intensity column."""
    direction = rng.normal(size=(3000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * (1 + rng.normal(scale=0.02, size=(3000, 1)))
    path = tmp_path / "sphere.xyz"
    np.savetxt(path, np.column_stack([points, np.arange(3000)]), fmt="%.6f %.6f %.6f %d")
    return path


def columns(path: Path) -> np.ndarray:
    return np.loadtxt(path)


def the_one_line(captured: str) -> str:
    """The single line of stderr that an expected error is."""
    lines = captured.splitlines()
    assert len(lines) == 1, captured
    assert lines[0].startswith("pcdenoise: ")
    return lines[0]


def test_denoise_moves_points_and_keeps_rows_and_attributes(sphere: Path) -> None:
    out = sphere.with_name("clean.xyz")
    assert main(["denoise", str(sphere), "-o", str(out), *FAST]) == 0
    before, after = columns(sphere), columns(out)
    assert np.array_equal(before[:, 3], after[:, 3])
    assert not np.array_equal(before[:, :3], after[:, :3])
    assert np.linalg.norm(after[:, :3] - before[:, :3], axis=1).max() < 0.3


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["denoise", "absent.las", "-o", "x.las"], 3, "absent.las"),
        (["denoise", "no/such/*.las", "-o", "out/"], 3, "matches no file"),
        (["info", "broken.las"], 3, "broken.las"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--method", "magic"], 2, "method"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--strength", "1.5"], 2, "--strength"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--noise", "0"], 2, "--noise"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--noise", "inf"], 2, "--noise"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--iters", "0"], 2, "--iters"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--iters", "many"], 2, "--iters"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--max-move", "-1"], 2, "--max-move"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--model", "no-such-model"], 4, "no-such-model"),
        (["denoise", "sphere.xyz"], 2, "-o"),
        (["denoise", "sphere.xyz", "-o", "x.xyz", "--no-such-option"], 2, "--no-such-option"),
        (["denose", "sphere.xyz"], 2, "denose"),
        (["train", "-o", "m", "--budget", "soon"], 2, "--budget"),
        (["train", "-o", "m", "--budget", "0s"], 2, "--budget:"),
        (["verify", "sphere.xyz", "sphere.xyz", "--max-move", "-1"], 2, "'--max-move'"),
        (["tune", "nowhere", "--method", "mean"], 3, "nowhere: no such file or folder; check the path"),
        (["info", "sphere.xyz", "broken.las", "--picture", "pics"], 2, "--picture pics: 2 inputs need a folder"),
        (["undo", "sphere.xyz", "-o", "x.xyz"], 3, "--displacement"),
    ],
)
def test_an_expected_error_is_one_line_with_its_exit_code(
    arguments: list[str], code: int, words: str, sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("broken.las").write_bytes(b"LASF" + bytes(50))
    assert main(arguments) == code
    captured = capsys.readouterr()
    assert words in the_one_line(captured.err)
    assert captured.out == ""
    assert not Path("x.xyz").exists()


def test_an_existing_output_is_refused_before_any_work_and_replaced_when_asked(
    sphere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = sphere.with_name("clean.xyz")
    out.write_text("precious")
    assert main(["denoise", str(sphere), "-o", str(out), *FAST]) == 3
    assert "--overwrite" in the_one_line(capsys.readouterr().err)
    assert out.read_text() == "precious"
    assert main(["denoise", str(sphere), "-o", str(out), *FAST, "--overwrite"]) == 0
    assert len(columns(out)) == 3000


def test_a_folder_a_pattern_and_a_suffix_name_the_outputs(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("tiles").mkdir()
    for name in ("a", "b"):
        Path(f"tiles/{name}.xyz").write_bytes(sphere.read_bytes())
    Path("tiles/notes.md").write_text("not a scan")
    assert main(["denoise", "tiles", "-o", "out", "-q", *FAST]) == 2  # two inputs, and out is no folder
    assert main(["denoise", "tiles", "-o", "out/", "-q", *FAST]) == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["a.xyz", "b.xyz"]
    assert main(["denoise", "tiles/[ab].xyz", "-o", "out", "--suffix", "_clean", "--format", "ply", "-q", *FAST]) == 0
    assert sorted(path.name for path in Path("out").glob("*_clean*")) == ["a_clean.ply", "b_clean.ply"]


def test_two_inputs_of_one_name_are_not_written_over_each_other(
    sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    for folder in ("left", "right"):
        Path(folder).mkdir()
        Path(folder, "tile.xyz").write_bytes(sphere.read_bytes())
    assert main(["denoise", "left", "right", "-o", "out/", *FAST]) == 2
    assert "tile.xyz" in the_one_line(capsys.readouterr().err)


def test_a_batch_goes_on_past_a_broken_input_and_the_report_lists_it(
    sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("broken.ply").write_bytes(b"ply\nformat nonsense\n")
    assert main(["denoise", "broken.ply", "sphere.xyz", "-o", "out/", "--report", "report.json", "-q", *FAST]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("pcdenoise: broken.ply")
    assert lines[-1] == "pcdenoise: 1 of 2 inputs failed; the others are done"
    assert len(columns(Path("out/sphere.xyz"))) == 3000
    assert not Path("out/broken.ply").exists()
    assert "broken.ply" in Path("report.json").read_text()


def test_a_pipe_gives_the_bytes_that_a_file_gives(sphere: Path, run: Run) -> None:
    out = sphere.with_name("clean.xyz")
    assert main(["denoise", str(sphere), "-o", str(out), "-q", *FAST]) == 0
    piped = run("denoise", "-", "-o", "-", "--format", "xyz", *FAST, input=sphere.read_bytes())
    assert piped.returncode == 0, piped.stderr
    assert piped.stdout == out.read_bytes()
    assert b"points" in piped.stderr


def test_a_reader_that_goes_away_ends_the_command_without_a_traceback(sphere: Path) -> None:
    shell = f"{sys.executable} -m pcdenoise denoise {sphere} -o - --format xyz --method mean | head -c 10"
    done = subprocess.run(
        ["bash", "-c", shell], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")}, timeout=120
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_quiet_says_nothing_and_normal_says_where_the_result_is(sphere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = sphere.with_name("clean.xyz")
    main(["denoise", str(sphere), "-o", str(out), "-q", *FAST])
    assert capsys.readouterr() == ("", "")
    main(["denoise", str(sphere), "-o", str(out), "--overwrite", *FAST])
    captured = capsys.readouterr()
    assert captured.out == ""
    assert str(out) in captured.err


def test_the_same_seed_gives_the_same_bytes(sphere: Path) -> None:
    for name in ("one.ply", "two.ply"):
        assert main(["denoise", str(sphere), "-o", str(sphere.with_name(name)), "--seed", "7", "-q"]) == 0
    assert sphere.with_name("one.ply").read_bytes() == sphere.with_name("two.ply").read_bytes()


def test_a_dry_run_prints_the_plan_and_writes_nothing(sphere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = sphere.with_name("clean.xyz")
    assert main(["denoise", str(sphere), "-o", str(out), "--dry-run"]) == 0
    captured = capsys.readouterr()
    assert "3,000" in captured.out
    assert str(out) in captured.out
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["-o", "there.xyz"], 3, "there.xyz: the file exists"),
        (["-o", "c.xyz", "--model", "nope"], 4, "nope: no such model"),
        (["-o", "c.xyz", "--only-class", "2"], 3, "has no classes"),
        (["-o", "c.abc"], 3, "c.abc: no suffix tells its format"),
        (["-o", "c.bin", "--method", "mean"], 3, "would drop"),
        (["-o", "c.bin", "--outliers", "flag", "--drop-attributes"], 3, "bin cannot hold column outlier, which is asked for"),
        (["-o", "locked.xyz", "--overwrite"], 3, "locked.xyz: is read-only"),
        (["-o", "c.xyz", "--max-move", "inf"], 2, "--max-move: must be a finite number"),
        (["-o", "c.xyz", "--noise", "1e300"], 2, "--noise: must be less than"),
        (["-o", "c.xyz", "--tile", "1000", "--outliers", "remove"], 2, "use --outliers flag, or leave out --tile"),
    ],
)
def test_a_dry_run_refuses_what_the_run_refuses(
    options: list[str], code: int, words: str, sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("there.xyz").touch()
    Path("locked.xyz").touch(mode=0o444)
    for command in (["denoise", "sphere.xyz", *options, "--dry-run"], ["denoise", "sphere.xyz", *options]):
        assert main(command) == code
        assert words in the_one_line(capsys.readouterr().err)
    assert sorted(path.name for path in Path().iterdir()) == ["locked.xyz", "sphere.xyz", "there.xyz"]


def test_a_plan_goes_on_past_a_broken_input(
    sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("broken.ply").write_bytes(b"ply\nformat nonsense\n")
    assert main(["denoise", "broken.ply", "sphere.xyz", "-o", "out/", "--dry-run", *FAST]) == 1
    rows = capsys.readouterr().out.splitlines()
    assert rows[2].startswith("broken.ply")
    assert "no end_header" in rows[2]
    assert rows[3].startswith("sphere.xyz")
    assert rows[3].endswith("ready")
    assert not Path("out").exists()


def strength_used(sphere: Path, *arguments: str) -> float:
    report = sphere.with_name("report.json")
    code = main(
        [
            "denoise",
            str(sphere),
            "-o",
            str(sphere.with_name("c.xyz")),
            "--overwrite",
            "--report",
            str(report),
            "-q",
            *FAST,
            *arguments,
        ]
    )
    assert code == 0
    return float(json.loads(report.read_text())["settings"]["strength"])


def test_a_flag_beats_the_environment_beats_the_file_beats_the_default(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = sphere.with_name("settings.toml")
    settings.write_text("seed = 3\n[denoise]\nstrength = 0.25\n")
    assert strength_used(sphere) == 1.0
    assert strength_used(sphere, "--config", str(settings)) == 0.25
    monkeypatch.setenv("PCDENOISE_STRENGTH", "0.5")
    assert strength_used(sphere, "--config", str(settings)) == 0.5
    assert strength_used(sphere, "--config", str(settings), "--strength", "0.75") == 0.75


def test_a_config_file_speaks_of_json_as_the_command_line_does(sphere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = sphere.with_name("settings.toml")
    settings.write_text("[info]\njson = true\n")
    assert main(["info", str(sphere), "--config", str(settings)]) == 0
    assert json.loads(capsys.readouterr().out)[0]["points"] == 3000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[denoise]\nstrenght = 0.5\n", "--strenght"),
        ("[denose]\nstrength = 0.5\n", "denose"),
        ("hue = 1\n", "--hue"),
        ("strength = \n", "TOML"),
        ("[denoise]\nstrength = 'half'\n", "settings.toml: invalid value for '--strength'"),
        ("[denoise]\nstrength = 1.5\n", "settings.toml: --strength: must be"),
        ("[denoise]\nonly-class = [2, -6]\n", "settings.toml: --only-class 2,-6: give"),
    ],
)
def test_a_wrong_key_or_value_in_the_config_file_is_refused(
    text: str, words: str, sphere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = sphere.with_name("settings.toml")
    settings.write_text(text)
    assert main(["denoise", str(sphere), "-o", str(sphere.with_name("c.xyz")), "--config", str(settings), *FAST]) == 2
    assert words in the_one_line(capsys.readouterr().err)


def test_a_list_in_the_config_file_is_joined_or_given_item_by_item(
    sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("s.toml").write_text(
        '[denoise]\nroi = [-2, -2, 2, 2.5]\ninputs = "sphere.xyz"\n[synth]\nlevels = [0.5, 1]\n[bench]\nadded = [0, 1.5]\n'
        'model = "default"\n'
    )
    assert main(["denoise", "-o", "c.ply", "--config", "s.toml", "--report", "r.json", "-q", *FAST]) == 0
    assert json.loads(Path("r.json").read_text())["settings"]["roi"][:4] == [-2, -2, None, 2]
    assert main(["synth", "shapes:1", "-o", "data", "--points", "50", "--config", "s.toml", "-q"]) == 0
    assert json.loads(Path("data/dataset.json").read_text())["levels_percent_of_diagonal"] == [0.5, 1]
    assert main(["bench", "sphere.xyz", "--config", "s.toml", "--points", "1000", "-q"]) == 0
    assert "error +1.5x" in capsys.readouterr().out


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_command_with_its_code_and_leaves_nothing(number: signal.Signals, code: int, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "pcdenoise", "denoise", "-", "-o", "out.xyz", "--format", "xyz", "-v", *FAST],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # jobs in a shell's background inherit it ignored
    )  # fmt: skip
    assert process.stderr is not None
    assert b"reading" in process.stderr.readline()  # from here on it waits for stdin
    process.send_signal(number)
    _, rest = process.communicate(timeout=60)
    assert process.returncode == code
    assert b"Traceback" not in rest
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("added", [[], ["--uncertainty"], ["--outliers=flag"], ["--uncertainty", "--outliers=flag"]])
@pytest.mark.parametrize("format", ["xyz", "ply", "pcd", "las", "laz"])
def test_undo_gives_back_the_very_coordinates_and_attributes(format: str, added: list[str], sphere: Path) -> None:
    original, clean = (sphere.with_name(f"{name}.{format}") for name in ("original", "clean"))
    back = sphere.parent / "not" / "there" / f"back.{format}"
    pcdenoise.write(pcdenoise.read(sphere), original)
    assert main(["denoise", str(original), "-o", str(clean), "--displacement", *added, "-q", *FAST]) == 0
    before, moved = pcdenoise.read(original), pcdenoise.read(clean)
    assert len(moved.attributes) == len(before.attributes) + 4 + len(added)
    assert not np.array_equal(moved.points, before.points)
    assert main(["undo", str(clean), "-o", str(back)]) == 0
    after = pcdenoise.read(back)
    assert np.array_equal(after.points, before.points)
    for name, values in before.attributes.items():
        assert np.array_equal(after.attributes[name], values)
    assert set(after.attributes) == set(before.attributes)


@pytest.mark.parametrize("option", ["--displacement", "--uncertainty", "--outliers flag"])
@pytest.mark.parametrize("in_cells", [[], ["--tile", "1000"], ["--dry-run"]])
def test_a_column_that_is_there_already_is_not_written_over(
    option: str, in_cells: list[str], sphere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = sphere.with_name("first.ply"), sphere.with_name("second.ply")
    assert main(["denoise", str(sphere), "-o", str(first), *option.split(), "-q", *FAST]) == 0
    assert main(["denoise", str(first), "-o", str(second), *option.split(), *in_cells, "-q", *FAST]) == 3
    assert f"leave out {option}" in the_one_line(capsys.readouterr().err)
    assert {path.name for path in sphere.parent.iterdir()} == {"sphere.xyz", "first.ply"}


@pytest.mark.parametrize("format", ["xyz", "ply", "pcd", "las"])
def test_a_limit_that_binds_is_kept_but_for_the_rounding_of_the_file(format: str, sphere: Path) -> None:
    original, clean = (sphere.with_name(f"{name}.{format}") for name in ("original", "clean"))
    pcdenoise.write(pcdenoise.read(sphere), original)
    assert main(["denoise", str(original), "-o", str(clean), "--max-move", "0.005", "-q", *FAST]) == 0
    assert main(["verify", str(original), str(clean), "--max-move", "0.005"]) == 0
    assert main(["verify", str(original), str(clean), "--max-move", "0.0048"]) == 5


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
@pytest.mark.parametrize(
    ("target", "options", "words"),
    [
        ("c.ply", ["--colour"], "leave out --colour"),
        ("c.bin", ["--displacement", "--format", "bin"], "column original_x"),
        ("c.xyz", ["--report", "report"], "choose such a suffix"),
    ],
)
def test_what_must_fail_in_the_end_fails_before_any_work(
    target: str, options: list[str], words: str, dry: list[str], sphere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["denoise", str(sphere), "-o", str(sphere.with_name(target)), *options, *dry, *FAST]) in (2, 3)
    assert words in the_one_line(capsys.readouterr().err)
    assert list(sphere.parent.iterdir()) == [sphere]


def test_pictures_of_several_scans_go_to_a_folder(sphere: Path) -> None:
    other = sphere.with_name("other.xyz")
    other.write_bytes(sphere.read_bytes())
    folders = [f"{sphere.with_name(name)}/" for name in ("out", "pics")]
    assert main(["denoise", str(sphere), str(other), "-o", folders[0], "--picture", folders[1], "-q", *FAST]) == 0
    assert sorted(path.name for path in sphere.with_name("pics").iterdir()) == ["other.png", "sphere.png"]


def test_undo_takes_away_only_what_came_with_the_places(sphere: Path) -> None:
    once, twice, back = (sphere.with_name(f"{name}.ply") for name in ("once", "twice", "back"))
    assert main(["denoise", str(sphere), "-o", str(once), "--uncertainty", "-q", *FAST]) == 0
    assert main(["denoise", str(once), "-o", str(twice), "--displacement", "--outliers", "flag", "-q", *FAST]) == 0
    assert main(["undo", str(twice), "-o", str(back)]) == 0
    assert main(["verify", str(once), str(back)]) == 0
    np.testing.assert_array_equal(pcdenoise.read(back).points, pcdenoise.read(once).points)
    assert list(pcdenoise.read(back).attributes) == list(pcdenoise.read(once).attributes)


def test_undo_is_exact_for_float32_coordinates_that_cross_zero(tmp_path: Path, rng: np.random.Generator) -> None:
    """Near zero the coordinates have far finer steps than the move, so that a stored difference would not bring them back."""
    points = (rng.normal(size=(2000, 3)) * [1, 1, 1e-3]).astype(np.float32).astype(np.float64)
    points[:20, 2] = 1e-30
    original, clean, back = (tmp_path / f"{name}.ply" for name in ("original", "clean", "back"))
    pcdenoise.write(pcdenoise.Scan(points), original)
    assert main(["denoise", str(original), "-o", str(clean), "--displacement", "-q", *FAST]) == 0
    assert main(["undo", str(clean), "-o", str(back)]) == 0
    assert np.array_equal(pcdenoise.read(back).points, points)


def test_verify_passes_a_clean_scan_and_fails_a_changed_attribute_and_a_far_move(
    sphere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clean, bad = sphere.with_name("clean.xyz"), sphere.with_name("bad.xyz")
    assert main(["denoise", str(sphere), "-o", str(clean), "-q", *FAST]) == 0
    assert main(["verify", str(sphere), str(clean)]) == 0
    assert main(["verify", str(sphere), str(clean), "--max-move", "1e-9"]) == 5
    lines = clean.read_text().splitlines(keepends=True)
    bad.write_text("".join(lines[:10] + [lines[10].replace(" 10\n", " 11\n")] + lines[11:]))
    capsys.readouterr()
    assert main(["verify", str(sphere), str(bad)]) == 5
    assert "1 rows changed" in the_one_line(capsys.readouterr().err)
    bad.write_text("".join(lines[:-1]))
    assert main(["verify", str(sphere), str(bad)]) == 5


def test_split_cuts_a_scan_to_parts_that_hold_every_row_once(sphere: Path) -> None:
    out = sphere.with_name("parts")
    assert main(["split", str(sphere), "-o", str(out), "--points", "800", "-q"]) == 0
    rows = [columns(path) for path in sorted(out.iterdir())]
    assert [len(part) for part in rows] == [750] * 4
    assert all((np.diff(part[:, 3]) > 0).all() for part in rows)  # in the file's order
    joined = np.concatenate(rows)
    np.testing.assert_array_equal(joined[np.argsort(joined[:, 3])], columns(sphere))
    assert main(["split", str(sphere), "-o", str(out), "--points", "800", "-q"]) == 3


def test_pairs_give_a_foreign_trainer_noisy_and_pseudo_clean_rows(sphere: Path) -> None:
    out, text = sphere.with_name("pairs"), sphere.with_name("text")
    assert main(["pairs", str(sphere), "-o", str(out), "--draws", "2", "-q"]) == 0
    first, second = (np.load(out / f"sphere_000{draw}.npz") for draw in (1, 2))
    np.testing.assert_allclose(first["noisy"], columns(sphere)[:, :3])
    assert first["clean"].shape == first["noisy"].shape
    assert 0 < np.linalg.norm(first["clean"] - first["noisy"], axis=1).max() <= 0.05 * np.sqrt(12) * 1.1
    assert not np.array_equal(first["clean"], second["clean"])
    assert main(["pairs", str(sphere), "-o", str(text), "--draws", "1", "--to", "xyz", "--radius", "0.1", "-q"]) == 0
    assert sorted(path.name for path in text.iterdir()) == ["sphere_0001_clean.xyz", "sphere_noisy.xyz"]
    moved = columns(text / "sphere_0001_clean.xyz")[:, :3] - columns(text / "sphere_noisy.xyz")[:, :3]
    assert 0 < np.linalg.norm(moved, axis=1).max() < 0.1001
    assert main(["pairs", str(sphere), "-o", str(out), "--prior", "full", "--overwrite", "-q"]) == 2


@pytest.mark.parametrize(
    ("command", "names"),
    [
        (["iterate", "--iters", "1", *FAST], ["passes.png", "report.html", "stdin_1.xyz"]),
        (["iterate", "--iters", "1", "--format", "xyz", *FAST], ["passes.png", "report.html", "stdin_1.xyz"]),
        (["split", "--points", "1500"], ["stdin_0001.xyz", "stdin_0002.xyz"]),
        (["pairs", "--draws", "1"], ["stdin_0001.npz"]),
    ],
)
def test_what_comes_from_stdin_is_named_so_with_a_suffix(command: list[str], names: list[str], sphere: Path, run: Run) -> None:
    out = sphere.with_name("out")
    done = run(command[0], "-", "-o", out, *command[1:], input=sphere.read_bytes())
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in out.iterdir()) == names
    assert b" 1 pairs" not in done.stderr
    assert b" 1 passes" not in done.stderr


@pytest.mark.parametrize("command", [["split", "--points", "1500"], ["pairs", "--draws", "1"]])
def test_split_and_pairs_go_on_past_a_broken_input(
    command: list[str], sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("broken.ply").write_bytes(b"ply\nformat nonsense\n")
    assert main([command[0], "broken.ply", "-o", "none", *command[1:]]) == 3
    assert not Path("none").exists()
    capsys.readouterr()
    assert main([command[0], "broken.ply", "sphere.xyz", "-o", "out", *command[1:], "-q"]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "pcdenoise: 1 of 2 inputs failed; the others are done"
    assert any(path.name.startswith("sphere_0001") for path in Path("out").iterdir())


@pytest.mark.parametrize("command", [["iterate"], ["split"], ["pairs"], ["synth"], ["train", "--steps", "1"]])
def test_a_file_in_the_place_of_a_folder_is_told(
    command: list[str], sphere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(sphere.parent)
    Path("afile").touch()
    source = {"synth": ["shapes:1"], "train": []}.get(command[0], ["sphere.xyz"])
    assert main([command[0], *source, "-o", "afile", *command[1:]]) in (3, 4)
    assert "afile: is a file where a folder is needed" in the_one_line(capsys.readouterr().err)


def test_what_tune_writes_denoise_reads(tmp_path: Path, rng: np.random.Generator) -> None:
    from pcdenoise import io
    from pcdenoise.cloud.scan import Scan

    directions = rng.normal(size=(600, 3))
    clean = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    io.write(Scan(clean, format="ply"), tmp_path / "clean.ply")
    io.write(Scan(clean + 0.05 * rng.normal(size=(600, 3)), format="ply"), tmp_path / "noisy.ply")
    (tmp_path / "dataset.json").write_text(json.dumps({"items": [{"clean": "clean.ply", "noisy": [{"file": "noisy.ply"}]}]}))
    for method, option in (("mean", "neighbours"), ("bilateral", "sigma_n")):
        tuned = tmp_path / f"{method}.toml"
        assert main(["tune", str(tmp_path), "--method", method, "-o", str(tuned), "-q"]) == 0
        assert f'method = "{method}"' in tuned.read_text()
        assert option in tuned.read_text() or tuned.read_text().count("=") == 1
        scan = str(tmp_path / "noisy.ply")
        assert main(["denoise", scan, "-o", str(tmp_path / f"{method}.ply"), "--config", str(tuned), "-q"]) == 0
        assert not np.array_equal(io.read(tmp_path / f"{method}.ply").points, io.read(scan).points)
    assert main(["tune", str(tmp_path / "clean.ply"), "--method", "mean", "-q"]) == 2


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["-o", "o.pcd", "--report", "r.docx"], 2, "--report r.docx: a report is written as .json, .csv"),
        (["-o", "o.pcd", "--picture", "p.jpg"], 2, "--picture p.jpg: a picture is written as .png"),
        (["-o", "o.foo"], 3, "o.foo: no suffix tells its format; add --format"),
        (["-o", "-"], 3, "stdout: no suffix tells its format; add --format"),
        (["-o", "o.pcd", "--iters", "many"], 2, "--iters: must be a number of passes from 1 to 100, or auto, got 'many'"),
        (["-o", "o.pcd", "--config", "no.toml"], 2, "check the path"),
    ],
)
def test_what_cannot_end_well_is_refused_before_any_work(
    milk: Path,
    options: list[str],
    code: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["denoise", str(milk), *options]) == code
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_cleaning_does_without_torch_and_a_wrong_model_writes_nothing(run: Run, milk: Path, tmp_path: Path) -> None:
    missing = run("denoise", tmp_path / "no.pcd", "-o", tmp_path / "out" / "o.pcd", "--model", "defualt")
    assert missing.returncode == 3
    wrong = run("denoise", milk, "-o", tmp_path / "out" / "o.pcd", "--model", "defualt")
    assert wrong.returncode == 4
    assert b"defualt: no such model" in wrong.stderr
    several = run("denoise", milk, ROOT / "examples" / "ground.laz", "-o", f"{tmp_path}/out/", "--model", "defualt")
    assert several.returncode == 4
    assert list(tmp_path.iterdir()) == []
    if not fused.IS_BUILT:
        return
    order = "import sys; from pcdenoise.commands import main; main(sys.argv[1:]); print({'torch', 'scipy'} & sys.modules.keys())"
    command = [sys.executable, "-c", order, "denoise", str(milk), "-o", str(tmp_path / "o.pcd"), "-q", "--uncertainty"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")})
    assert done.stdout.strip() == "set()", done.stderr


@pytest.mark.parametrize(
    ("line", "found"), [("pcdenoise ", {"denoise", "eval-chamfer"}), ("pcdenoise denoise --max-", {"--max-move", "--max-memory"})]
)
def test_a_shell_completes_commands_and_their_options(line: str, found: set[str]) -> None:
    typed = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_PCDENOISE_COMPLETE": "complete_bash"}
    environment = {**os.environ, **typed, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run([sys.executable, "-m", "pcdenoise"], capture_output=True, text=True, env=environment)
    assert found <= set(done.stdout.split()), done.stderr
