"""Lines and fields of text as offsets into its bytes, and the splice that changes them. Not here: rows of a scan (text.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Octets = NDArray[np.uint8]
"""Bytes of a file."""
Offsets = NDArray[np.int64]
"""Places in Octets."""

LF, CR, BLANK, QUOTE = 10, 13, 32, 34
"""Bytes with a meaning; all up to BLANK count as blank."""

LONGEST_PADDING = 4096
"""More blanks than this around a field are not looked past."""

_BLANKS = bytes(BLANK if byte <= BLANK and byte != 9 else byte for byte in range(256))


def find_lines(raw: Octets) -> tuple[Offsets, Offsets]:
    """(L,) start and end, before the line ending, of every line; LF, CR LF, or CR alone."""
    breaks = np.flatnonzero(raw == LF)
    if not len(breaks):
        breaks = np.flatnonzero(raw == CR)
    if len(raw) and (not len(breaks) or breaks[-1] != len(raw) - 1):
        breaks = np.append(breaks, len(raw))
    starts = np.concatenate([np.zeros(min(1, len(breaks)), np.int64), breaks[:-1] + 1])
    ends = breaks - ((breaks > starts) & (raw[np.maximum(breaks - 1, 0)] == CR) if len(raw) else 0)
    return starts, ends


def first_visible(raw: Octets, starts: Offsets, ends: Offsets) -> Offsets:
    """(L,) offset of the first byte of each line that is no blank; the line's end for a blank line."""
    at = starts.copy()
    blank = np.flatnonzero(at < ends)
    for _ in range(LONGEST_PADDING):
        blank = blank[raw[at[blank]] <= BLANK]
        if not len(blank):
            break
        at[blank] += 1
        blank = blank[at[blank] < ends[blank]]
    return at


def split_fields(line: bytes, delimiter: int | None) -> list[bytes]:
    """The fields of one line without the blanks and quotes around them; quoted delimiters do not split."""
    line = line.translate(_BLANKS)
    if delimiter is None:
        return [field.strip(b'"') for field in line.split()]
    parts = line.split(b'"')
    cut = b'"'.join(part.replace(bytes([delimiter]), b"\n") if i % 2 == 0 else part for i, part in enumerate(parts))
    return [field.strip(b' \t"') for field in cut.split(b"\n")]


def is_number(field: bytes) -> bool:
    """Whether a field reads as a number, nan and inf included."""
    try:
        float(field)
    except ValueError:
        return False
    return b"_" not in field


def spliced(raw: Octets, starts: Offsets, lengths: Offsets, new: Octets, new_starts: Offsets, new_lengths: Offsets) -> Octets:
    """`raw` with each span (ascending, disjoint) replaced by a piece of `new`."""
    kept_starts = np.concatenate([np.zeros(1, np.int64), starts + lengths])
    kept_ends = np.append(starts, len(raw))
    firsts = np.empty(2 * len(starts) + 1, np.int64)
    sizes = np.empty_like(firsts)
    firsts[0::2], sizes[0::2] = kept_starts, kept_ends - kept_starts
    firsts[1::2], sizes[1::2] = new_starts + len(raw), new_lengths
    places = np.repeat(firsts - (np.cumsum(sizes) - sizes), sizes) + np.arange(int(sizes.sum()))
    result: Octets = np.concatenate([raw, new])[places]
    return result


def without(raw: Octets, starts: Offsets, lengths: Offsets) -> Octets:
    """`raw` without spans that do not overlap."""
    steps = np.zeros(len(raw) + 1, np.int8)
    steps[starts] += 1
    steps[starts + lengths] -= 1
    kept: Octets = raw[np.cumsum(steps[:-1], dtype=np.int8) == 0]
    return kept
