"""Which files a command reads and where each result goes: folders, patterns, `-`, names. Not here: their content (io)."""

from __future__ import annotations

import glob
import heapq
import os
import re
import stat
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pcdenoise.errors import ScanError, UsageError, cannot_be_written, is_a_folder, not_a_folder

if TYPE_CHECKING:
    from pcdenoise.cloud.scan import Scan

STREAM = Path("-")
"""Standard input or output."""


@dataclass(frozen=True)
class Job:
    """One input and where its result goes."""

    source: Path
    target: Path


def expand(inputs: Sequence[str]) -> list[Path]:
    """Every scan that the arguments name, in order and once: files, `-`, the scans of a folder, patterns ('tiles/**/*.laz').

    Raises ScanError for a file that is not there, a folder without scans or a pattern without a match.
    """
    found = [path for text in inputs for path in _expand_one(text)]
    return list(dict.fromkeys(found))


def _expand_one(text: str) -> list[Path]:
    from pcdenoise import io

    path = Path(text)
    if text == "-" or path.is_file():
        return [path]
    if path.is_dir():
        visible = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
        scans = sorted(entry for entry in visible if entry.is_file() and io.is_scan(entry))
        if not scans:
            below = f"; for folders below it give '{path.as_posix()}/**'" if any(map(Path.is_dir, visible)) else ""
            raise ScanError(f"{text}: the folder holds no scan; known suffixes are {' '.join(sorted(io.SUFFIXES))}{below}")
        return scans
    if glob.has_magic(text):
        matches = sorted(path for path in _matches(text) if path.is_file())
        if not matches:
            raise ScanError(f"{text}: the pattern matches no file; quote it and check the folder")
        return matches
    if path.exists():  # a named pipe or a device
        return [path]
    raise ScanError(f"{text}: no such file or folder; check the path")


def _matches(pattern: str) -> Iterator[Path]:
    """What a pattern names; `**` is any depth of visible folders, each entered once, however many links lead to it."""
    pattern = pattern.replace(os.sep, "/") + ("/*" if pattern.endswith("**") else "")
    before, anywhere, after = pattern.partition("**/")
    if not anywhere or (before and not before.endswith("/")):
        yield from map(Path, glob.iglob(pattern))
        return
    entered: set[str] = set()
    for top in glob.iglob(before) if before else ["."]:
        for folder, below, _ in os.walk(top, followlinks=True):
            real = os.path.realpath(folder)
            below[:] = [] if real in entered else sorted(name for name in below if not name.startswith("."))
            if real not in entered:
                entered.add(real)
                yield from _matches(os.path.normpath(os.path.join(glob.escape(folder), after)))


def shard(sources: Sequence[Path], text: str) -> list[Path]:
    """The share of the sources that the I-th of N jobs has, for text "I/N", I from 1; together they have each once.

    Large files are dealt out first, each to the job that has least to do, so that jobs end at about the same time.
    """
    asked = re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", text)
    if asked is None or int(asked[1]) > int(asked[2]):
        raise UsageError(f"--shard {text}: give which of how many, such as 3/20")
    if STREAM in sources:
        raise UsageError("--shard: standard input cannot be shared out; name files")
    of_job: list[set[Path]] = [set() for _ in range(int(asked[2]))]
    bytes_of_job = [(0, job) for job in range(len(of_job))]
    for size, source in sorted(((source.stat().st_size, source) for source in sources), key=lambda pair: (-pair[0], pair[1])):
        filled, job = heapq.heappop(bytes_of_job)
        of_job[job].add(source)
        heapq.heappush(bytes_of_job, (filled + size, job))
    return [source for source in sources if source in of_job[int(asked[1]) - 1]]


def plan(
    sources: Sequence[Path],
    output: str,
    *,
    suffix: str = "",
    format: str | None = None,
    share: Collection[Path] | None = None,
    option: str = "-o",
) -> list[Job]:
    """One target for each source: the output itself for one source, a file of the same name in the output folder for several.

    suffix goes between name and extension; format, where given, sets the extension. share: the sources that are wanted, where
    others see to the rest; option: the one that names the output. Raises UsageError if two results, of whatever share, would
    meet in one file, or several in what is not a folder.
    """
    wanted = set(sources if share is None else share)
    folder = output.endswith(("/", "\\")) or Path(output).is_dir()
    if not folder:
        if len(sources) > 1:
            fix = f"end the name with a slash: {option} {output}/"
            raise UsageError(f"{option} {output}: {len(sources)} inputs need a folder; {fix}")
        return [Job(source, Path(output)) for source in sources if source in wanted]
    jobs = [Job(source, Path(output) / target_name(source, suffix, format)) for source in sources]
    by_target: dict[Path, Path] = {}
    for job in jobs:
        other = by_target.setdefault(job.target, job.source)
        if other != job.source:
            raise UsageError(f"{option} {output}: {other} and {job.source} would both become {job.target}; use two folders")
    return [job for job in jobs if job.source in wanted]


def beside(sources: Sequence[Path], output: str, option: str, *, format: str | None = None, suffix: str) -> dict[Path, Path]:
    """Where what an option adds to each source's result goes, as `plan` says; nowhere if the option was not given."""
    jobs = plan(sources, output, suffix=suffix, format=format, option=option) if output else []
    return {job.source: job.target for job in jobs}


def absolute(jobs: Sequence[Job]) -> list[Job]:
    """The jobs for someone who works in another folder."""
    return [Job(job.source.absolute(), job.target.absolute()) for job in jobs]


def target_name(source: Path, suffix: str = "", format: str | None = None, found: str = "") -> str:
    """A source's name with a suffix before its extension, or before that of a format; found: the format that stdin had."""
    stem, extension = ("stdin", f".{found}" if found else "") if source == STREAM else (source.stem, source.suffix)
    return f"{stem}{suffix}{'.' + format if format else extension}"


def refuse_folder(folder: Path) -> None:
    """Raises ScanError before any work is done if results need a folder where a file stands, or that takes no file."""
    if folder.exists() and not folder.is_dir():
        raise not_a_folder(str(folder))
    _try_folder(folder.absolute(), folder)


_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH


def refuse_unwritable(targets: Sequence[Path | None], overwrite: bool) -> None:
    """Raises ScanError before any work is done if a target exists and must not be replaced, or is in a folder that takes no file.

    Who made a file read-only meant it: overwriting is no leave to replace that.
    """
    files = [target for target in targets if target is not None and target != STREAM]
    for target in filter(Path.exists, files):
        if target.is_dir():
            raise is_a_folder(target)
        if not overwrite:
            raise ScanError(f"{target}: the file exists; add --overwrite to replace it")
        if target.is_file() and not target.stat().st_mode & _WRITABLE:
            raise ScanError(f"{target}: is read-only, so that --overwrite leaves it; make it writable or write elsewhere")
    folders: dict[Path, Path] = {}
    for target in files:
        place = Path(os.path.realpath(target))
        if place.is_file() or not place.exists():  # devices and pipes are written to as they are
            folders.setdefault(place.parent, target)
    for folder, target in folders.items():
        _try_folder(folder, target)


def _try_folder(folder: Path, target: Path) -> None:
    """Makes a file for a moment in a folder, or in the one it is to be made in. Raises ScanError for the target if that fails."""
    import tempfile  # a help page need not wait for it

    there = next(place for place in (folder, *folder.parents) if place.exists())
    if there.is_dir():
        try:
            tempfile.TemporaryFile(dir=there).close()
        except OSError as fault:
            raise cannot_be_written(target, fault) from None


def refuse_unknown(targets: Sequence[Path], format: str | None) -> None:
    """Raises ScanError before any work is done if nothing says what format a target is to have."""
    from pcdenoise import io

    for target in targets:
        if format is None and not io.is_scan(target):
            name = "stdout" if target == STREAM else str(target)
            raise ScanError(f"{name}: no suffix tells its format; add --format, or one of {' '.join(sorted(io.SUFFIXES))}")


def format_of(path: Path, format: str | None) -> str | None:
    """The format to read or write a path as: what --format says for `-` and where the suffix says nothing, else None."""
    from pcdenoise import io

    return format if path == STREAM or not io.is_scan(path) else None


def attachments(scan: Scan) -> list[str]:
    """What a scan's file holds beside points and columns, in words: CRS, VLRs, faces, a viewpoint."""
    return list(scan.source.attachments()) if scan.source is not None else []
