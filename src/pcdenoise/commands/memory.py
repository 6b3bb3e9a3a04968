"""How much memory a run may take: the --max-memory option, and what is free. Not here: what is done with it."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from pcdenoise.errors import UsageError

LEAST = 500 << 20
"""The program itself and one small cell."""


def n_bytes(size: str | None) -> int:
    """Bytes that a size such as 800M or 2G stands for; half of what is free if there is none. Raises UsageError."""
    if size is None:
        return max(LEAST, _free() // 2)
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,3})?)\s*([KMG])i?B?", size.strip(), re.IGNORECASE)
    if match is None:
        raise UsageError(f"--max-memory: must be a number with K, M or G, such as 800M, got {size!r}")
    found = int(float(match[1]) * 1024 ** ("KMG".index(match[2].upper()) + 1))
    if found < LEAST:
        raise UsageError(f"--max-memory: must be {LEAST >> 20}M or more, which the program itself needs, got {size!r}")
    return found


def _free() -> int:
    """Bytes of memory that are free now, in the container if there is one."""
    limits = []
    with suppress(OSError, ValueError):
        limits.append(int(Path("/sys/fs/cgroup/memory.max").read_text()) - int(Path("/sys/fs/cgroup/memory.current").read_text()))
    try:
        found = re.search(r"MemAvailable:\s*(\d+) kB", Path("/proc/meminfo").read_text())
        limits += [int(found[1]) << 10] if found else []
    except OSError:
        if hasattr(os, "sysconf"):
            limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2)
    return min(limits, default=4 << 30)
