"""Bytes in and bytes out: whole-file reads, stdin and stdout, atomic writes. Not here: what the bytes mean."""

from __future__ import annotations

import mmap
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from pcdenoise.errors import ScanError, cannot_be_written, exists_already, is_a_folder
from pcdenoise.whole_files import replaced

Raw = bytes | mmap.mmap
"""The bytes of a file, read or mapped."""
STREAM = "-"
"""The path that means stdin or stdout."""

_PIECE = 1 << 24
_LARGEST_STREAM_SHARE = 0.25  # of the machine's memory: a pipe may never end, and what it brings takes several times its size


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The whole file, or all of stdin for '-'. Raises ScanError if there is nothing to read from."""
    if os.fspath(path) == STREAM:
        if sys.stdin.isatty():
            raise ScanError("stdin: nothing is piped in; give a file or pipe one to '-'")
        return _stream_bytes(sys.stdin.buffer, "stdin")
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
            raise ScanError(f"{path}: is a device; name a scan file")
        if stat.S_ISFIFO(mode):
            with open(path, "rb") as pipe:
                return _stream_bytes(pipe, os.fspath(path))
        return Path(path).read_bytes()
    except IsADirectoryError:
        raise ScanError(f"{path}: is a folder; name a scan file") from None
    except FileNotFoundError:
        raise ScanError(f"{path}: no such file; check the path") from None
    except OSError as fault:
        raise ScanError(f"{path}: cannot be read ({fault.strerror}); check its permissions and the disk") from None
    except MemoryError:
        raise ScanError(f"{path}: larger than the free memory; split it into tiles first") from None


def _stream_bytes(stream: BinaryIO, origin: str) -> bytes:
    """All of a pipe. Raises ScanError if that is more than memory holds."""
    try:
        room = _LARGEST_STREAM_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):  # Windows
        room = float("inf")
    pieces: list[bytes] = []
    try:
        while piece := stream.read(_PIECE):
            pieces.append(piece)
            if (room := room - len(piece)) < 0:
                break
        else:
            return b"".join(pieces)
    except MemoryError:
        pass
    raise ScanError(f"{origin}: brings more than memory holds; save it as a file and split it into tiles")


@contextmanager
def mapped(path: str | os.PathLike[str]) -> Iterator[mmap.mmap]:
    """The bytes of a file that is not empty, read only where they are looked at. Raises ScanError if it cannot be read."""
    try:
        with open(path, "rb") as file:
            raw = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as fault:
        raise ScanError(f"{path}: cannot be read ({fault.strerror}); check its permissions and the disk") from None
    except ValueError:  # emptied since somebody looked at its size
        raise ScanError(f"{path}: is empty; check what wrote it") from None
    yield raw  # closed with its last view: numpy may hold some for a while


def check_not_cut(raw: Raw, origin: str) -> None:
    """Raises ScanError if a mapped file has become shorter: the system ends a process that looks at a byte that has gone."""
    if isinstance(raw, mmap.mmap) and raw.size() < len(raw):
        raise ScanError(f"{origin}: was cut to {raw.size()} bytes while it was read; run again once it is complete")


def let_go(raw: Raw) -> None:
    """Takes the pages of a mapped file that were looked at out of memory; they are read again when looked at again."""
    if isinstance(raw, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        raw.madvise(mmap.MADV_DONTNEED)


@contextmanager
def written(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[BinaryIO]:
    """A seekable binary file that becomes `path` only if the block ends well; '-' is stdout.

    Whether stdout's reader is still there is its own affair: BrokenPipeError passes.
    Raises ScanError if the target exists and `overwrite` is false, or cannot be written.
    """
    target = Path(os.path.realpath(path))
    if os.fspath(path) == STREAM or (target.exists() and not target.is_dir() and not target.is_file()):
        with _spooled(path) as file:
            yield file
        return
    _check_target(path, target, overwrite)
    try:
        with replaced(target) as file:
            yield file
            if target.exists():
                _check_target(path, target, overwrite)
    except OSError as fault:
        raise cannot_be_written(path, fault) from None


def _check_target(path: str | os.PathLike[str], target: Path, overwrite: bool) -> None:
    if target.is_dir():
        raise is_a_folder(path)
    if not target.parent.is_dir():
        raise ScanError(f"{path}: folder {target.parent} does not exist; create it first")
    if target.exists() and not overwrite:
        raise exists_already(path)


@contextmanager
def _spooled(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A temporary file copied to stdout (or to a device or pipe) once complete: LAS writers need to seek, pipes cannot."""
    with tempfile.TemporaryFile() as spool:
        yield spool
        spool.seek(0)
        try:
            if os.fspath(path) != STREAM:
                with open(path, "wb") as device:
                    shutil.copyfileobj(spool, device)
                return
            if sys.stdout.isatty() and b"\0" in spool.read(65536):
                raise ScanError("stdout: is a terminal and the scan is binary; redirect it to a file or pipe")
            spool.seek(0)
            shutil.copyfileobj(spool, sys.stdout.buffer)
            sys.stdout.buffer.flush()
        except OSError as fault:
            if isinstance(fault, BrokenPipeError) and os.fspath(path) == STREAM:
                raise
            where = "stdout" if os.fspath(path) == STREAM else path
            raise cannot_be_written(where, fault, check="where it leads") from None
