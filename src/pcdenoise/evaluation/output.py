"""Pictures and reports on disk, whole or not at all. Not here: scans (the package io writes those)."""

from __future__ import annotations

import os
from pathlib import Path

from pcdenoise.errors import cannot_be_written, exists_already
from pcdenoise.whole_files import replaced


def write_whole(path: str | os.PathLike[str], data: bytes, *, overwrite: bool) -> None:
    """Write the bytes to `path`. Raises ScanError if that fails or would overwrite unasked."""
    target = Path(path)
    if target.exists() and not overwrite:
        raise exists_already(path)
    try:
        with replaced(target) as file:
            file.write(data)
    except OSError as fault:
        raise cannot_be_written(path, fault) from None
