"""Files that appear whole or not at all, whatever happens to the process. Not here: their content, and whether to replace one."""

from __future__ import annotations

import os
import secrets
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

_LONGEST_STEM = 100  # bytes; file systems allow 255 for a name
_YOUNG_S = 60.0


@contextmanager
def replaced(target: Path) -> Iterator[BinaryIO]:
    """A seekable binary file that takes the target's place, with its permissions, if the block ends well.

    The bytes go to a hidden file beside the target, which is on the disk before it is renamed and is removed on any failure. One
    that a killed run left behind is removed by the next run for the same target. Raises OSError if the file cannot be written.
    """
    part = _part_of(target)
    try:
        with part.open("xb+") as file:
            _mark_in_use(file)
            yield file
            file.flush()
            os.fsync(file.fileno())  # a full network disk is often only noticed here
        if target.exists():
            part.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(part, target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def tidy(target: Path) -> None:
    """Removes what a writer of this target left that is known to have been killed; nothing if another one is at work."""
    _removed_if_abandoned(target.with_name(f".{_stem(target)}.part"), 0)


def put(path: Path, data: bytes) -> None:
    """Writes a file that is there whole or not at all, and the folder it is in. Raises OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as file:
        file.write(data)


def _part_of(target: Path) -> Path:
    """The hidden file to write to: one name, which a killed run's leftover makes room for, or a random one while it is in use."""
    part = target.with_name(f".{_stem(target)}.part")
    if os.path.lexists(part) and not _removed_if_abandoned(part, _YOUNG_S):
        return target.with_name(f".{_stem(target)}.{secrets.token_hex(4)}.part")
    return part


def _stem(target: Path) -> str:
    return target.name.encode("utf-8", "surrogateescape")[:_LONGEST_STEM].decode("utf-8", "ignore")


def _removed_if_abandoned(part: Path, young_s: float) -> bool:
    """Removes a file that nobody has open and nobody has written to for so long; whether it did."""
    try:
        if time.time() - part.stat().st_mtime < young_s:
            return False
        with part.open("rb+") as file:
            _mark_in_use(file)
            part.unlink()
    except OSError:
        return False
    return True


if sys.platform == "win32":  # where a file that is open cannot be removed anyway

    def _mark_in_use(file: BinaryIO) -> None:
        del file

else:

    def _mark_in_use(file: BinaryIO) -> None:
        """Locks the file until it is closed, where there are locks. Raises BlockingIOError if another process has."""
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            return
