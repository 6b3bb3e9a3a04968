"""Pictures and reports on disk, whole or not at all. Not here: scans (the package io writes those)."""

from __future__ import annotations

import os
import secrets
from contextlib import suppress
from pathlib import Path

from pcdenoise.errors import ScanError


def write_whole(path: str | os.PathLike[str], data: bytes, *, overwrite: bool) -> None:
    """Write a hidden file beside `path`, then rename it to that. Raises ScanError if that fails or would overwrite unasked."""
    target = Path(path)
    if target.exists() and not overwrite:
        raise ScanError(f"{path}: exists already; choose another name or allow overwriting")
    part = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    try:
        part.write_bytes(data)
        os.replace(part, target)
    except OSError as fault:
        raise ScanError(f"{path}: cannot be written ({fault.strerror}); check the folder, its permissions and space") from None
    finally:
        with suppress(OSError):
            part.unlink()
