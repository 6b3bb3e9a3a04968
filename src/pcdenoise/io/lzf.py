"""LZF, the compression of binary_compressed PCD files. Not here: the layout of what is compressed (pcd.py).

The stream: a control byte below 32 is followed by that many bytes plus one to copy; else its three high bits give a length (7:
one more byte adds to it) of bytes plus two to repeat from the distance in its five low bits and the next byte, plus one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LONGEST_LITERAL = 32
_LONGEST_MATCH = 264
_FARTHEST = 8192
LARGEST_RATIO = 88
"""No LZF stream unpacks to more than this many times its size: 3 bytes make at most 264."""


def decompress(packed: bytes, size: int) -> bytes:
    """`size` bytes from an LZF stream. Raises ValueError if it is damaged or gives another number."""
    out = bytearray()
    at = 0
    try:
        while at < len(packed):
            control = packed[at]
            at += 1
            if control < _LONGEST_LITERAL:
                out += packed[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[at]
                at += 1
            length += 2
            start = len(out) - ((control & 31) << 8) - packed[at] - 1
            at += 1
            if start < 0 or len(out) > size:
                break
            piece = out[start : start + length]
            if len(piece) < length:  # the repeat overlaps what it makes
                piece = (piece * (length // len(piece) + 1))[:length]
            out += piece
    except IndexError:
        raise ValueError("the compressed data ends too early") from None
    if len(out) != size:
        raise ValueError(f"the compressed data gives {len(out)} bytes, not {size}")
    return bytes(out)


def compress(data: bytes) -> bytes:
    """An LZF stream of the bytes: greedy, each repeat from the last place the same three bytes stood."""
    candidates, sources = _repeats(np.frombuffer(data, np.uint8))
    out = bytearray()
    at = 0
    for place, source in zip(candidates.tolist(), sources.tolist(), strict=True):
        if place < at:
            continue
        longest = min(_LONGEST_MATCH, len(data) - place)
        length = 3
        while length < longest and data[source + length] == data[place + length]:
            length += 1
        _literal(out, data, at, place)
        distance = place - source - 1
        if length < 9:
            out.append((length - 2) << 5 | distance >> 8)
        else:
            out += bytes((7 << 5 | distance >> 8, length - 9))
        out.append(distance & 255)
        at = place + length
    _literal(out, data, at, len(data))
    return bytes(out)


def _literal(out: bytearray, data: bytes, start: int, end: int) -> None:
    for first in range(start, end, _LONGEST_LITERAL):
        last = min(first + _LONGEST_LITERAL, end)
        out.append(last - first - 1)
        out += data[first:last]


def _repeats(octets: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All places whose next three bytes stood within reach before, ascending, and the last such earlier place of each."""
    if len(octets) < 4:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    wide = octets.astype(np.uint32)
    keys = wide[:-2] << 16 | wide[1:-1] << 8 | wide[2:]
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    near = same[order[same + 1] - order[same] <= _FARTHEST]
    sources = np.full(len(keys), -1, np.int64)
    sources[order[near + 1]] = order[near]
    places = np.flatnonzero(sources >= 0)
    return places, sources[places]
