"""The compressed point stream of LAZ files, by lazrs. Not here: everything around it (las_file.py).

A layout is the payload of the laszip VLR: compressor, chunk size, and the items of a point.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from hashlib import sha256
from io import BytesIO, RawIOBase
from mmap import mmap
from typing import Any, BinaryIO

import lazrs
import numpy as np
from numpy.typing import NDArray

from pcdenoise.errors import ScanError
from pcdenoise.io.files import Raw, check_not_cut

_ITEMS = 32  # where a layout counts its items
_LAYERED = 3
_WAVEFORM_PACKET = b"\x09\x00"  # the item of formats 4 and 5; 9 and 10 have another
_N_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # by item: point, RGB, RGB and NIR, waveform packet; extra bytes have one a byte
_LARGEST_CHUNK = 64 << 20
_LARGEST_RATIO = 5_000  # points all alike compress 3000 to 1 in chunks of 50000


def decompressed(
    raw: Raw, start: int, n_points: int, length: int, layout: bytes, origin: str, n_rows: int
) -> Iterator[NDArray[np.uint8]]:
    """(at most n_rows, length) records after records of the point stream at byte `start`, n_points in all.

    Raises ScanError if it is damaged or holds fewer.
    """
    if n_points == 0:
        return
    check_not_cut(raw, origin)
    try:
        item_length = lazrs.LazVlr(layout).item_size()
        if item_length != length:
            raise ScanError(f"{origin}: {length} bytes a point, {item_length} in the laszip VLR; the file is damaged")
        chunks = _chunk_table(raw, start, layout, origin)
        most = _LARGEST_RATIO * (len(raw) - start) // length
        held = min(most, sum(n for n, _ in chunks)) if chunks else most
        if n_points > held:
            raise ScanError(
                f"{origin}: header claims {n_points} points, the compressed data holds at most {held}; fetch it again"
            )
        source = _as_file(raw, start, origin)
        in_parallel = chunks and max(n for n, _ in chunks) * length <= _LARGEST_CHUNK  # lazrs makes room for whole chunks
        decompressor = (lazrs.ParLasZipDecompressor if in_parallel else lazrs.LasZipDecompressor)(source, layout)
        for first in range(0, n_points, n_rows):
            records = np.empty((min(n_rows, n_points - first), length), np.uint8)
            decompressor.decompress_many(records.reshape(-1))
            yield records
    except MemoryError:
        raise ScanError(f"{origin}: header claims {n_points} points, more than memory holds; split it into tiles first") from None
    except lazrs.LazrsError as fault:
        raise ScanError(f"{origin}: its compressed points cannot be read ({fault}); fetch it again or use .las") from None
    except BaseException as fault:
        if type(fault).__name__ != "PanicException":  # how a Rust panic arrives: no Exception, no importable class
            raise
        raise ScanError(f"{origin}: the compressed points are damaged; fetch the file again") from None


class _MappedFile(RawIOBase):
    """A mapped file as a stream of its own place, since several may read it at once."""

    def __init__(self, raw: mmap, origin: str) -> None:
        self.raw, self.origin, self.at = raw, origin, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        self.at = offset + (0, self.at, len(self.raw))[whence]
        return self.at

    def tell(self) -> int:
        return self.at

    def readinto(self, buffer: Any) -> int:
        check_not_cut(self.raw, self.origin)
        piece = self.raw[self.at : self.at + len(buffer)]
        buffer[: len(piece)] = piece
        self.at += len(piece)
        return len(piece)


def _as_file(raw: Raw, at: int, origin: str) -> BytesIO | _MappedFile:
    """A file of these bytes that stands at byte `at`, without a copy of them."""
    source = BytesIO(raw) if isinstance(raw, bytes) else _MappedFile(raw, origin)
    source.seek(at)
    return source


def _chunk_table(raw: Raw, start: int, layout: bytes, origin: str) -> list[tuple[int, int]]:
    """(points, bytes) of each compressed chunk; empty if the stream has no table. Raises LazrsError on sizes that cannot be true.

    Checked here because lazrs allocates what the file says, and an allocation that fails ends the process.
    """
    (compressor,) = struct.unpack_from("<H", layout)
    (table,) = struct.unpack("<q", raw[start : start + 8].ljust(8, b"\xff"))
    if table == -1:
        (table,) = struct.unpack("<q", raw[-8:])
    if not start + 8 <= table <= len(raw) - 8:
        if compressor == _LAYERED:
            raise lazrs.LazrsError("no chunk table")
        return []
    (n_chunks,) = struct.unpack_from("<I", raw, table + 4)
    if n_chunks > table - start:
        raise lazrs.LazrsError(f"a table of {n_chunks} chunks")
    chunks: list[tuple[int, int]] = lazrs.read_chunk_table(_as_file(raw, start, origin), lazrs.LazVlr(layout))
    if sum(size for _, size in chunks) > table - start - 8:
        raise lazrs.LazrsError("chunks larger than the file")
    if compressor == _LAYERED:
        if not chunks:  # lazrs would read on past the table, into layers that nothing has checked
            raise lazrs.LazrsError("an empty chunk table")
        _check_layers(raw, start + 8, chunks, layout)
    return chunks


def _check_layers(raw: Raw, at: int, chunks: list[tuple[int, int]], layout: bytes) -> None:
    """Raises LazrsError if a layered chunk (a point, a count, each layer's size, the layers) claims more bytes than it has."""
    items = [struct.unpack_from("<HH", layout, _ITEMS + 2 + 6 * i) for i in range(struct.unpack_from("<H", layout, _ITEMS)[0])]
    n_layers = sum(_N_LAYERS.get(kind, size) for kind, size in items)
    for _, size in chunks:
        first = at + sum(size for _, size in items) + 4
        layers = np.frombuffer(raw, "<u4", n_layers, first) if first + 4 * n_layers <= at + size else None
        if layers is None or first + 4 * n_layers + int(layers.sum(dtype=np.uint64)) > at + size:
            raise lazrs.LazrsError("layers larger than their chunk")
        at += size


def layout(point_format: int, n_extra: int, present: Sequence[bytes]) -> bytes:
    """How to compress points of a format with extra bytes: as one of the layouts present if lazrs can, else lazrs' default."""
    default = _for_laszip(lazrs.LazVlr.new_for_compression(point_format, n_extra).record_data())
    for own in present:
        same_kind = own[:2] == default[:2] and own[_ITEMS:] == default[_ITEMS:]
        if same_kind and 0 < struct.unpack_from("<I", own, 12)[0] * lazrs.LazVlr(own).item_size() <= _LARGEST_CHUNK:
            return own
    return default


def _for_laszip(layout: bytes) -> bytes:
    """A layout of lazrs 0.8 as LASzip reads it: lazrs calls its way to compress waveform packets the second, LASzip the first."""
    octets = bytearray(layout)
    for at in range(_ITEMS + 2, len(octets), 6):
        if octets[at : at + 2] == _WAVEFORM_PACKET:
            octets[at + 4 : at + 6] = b"\1\0"
    return bytes(octets)


def compress(parts: Iterable[NDArray[np.uint8]], layout: bytes, file: BinaryIO, *, check: bool) -> None:
    """Write (n, length) records after records as one point stream at the file's position.

    check: raise ScanError if it reads back otherwise; lazrs 0.8 scrambles waveform fields of formats 9 and 10 when scanner
    channels alternate.
    """
    start = file.tell()
    compressor = lazrs.ParLasZipCompressor(file, lazrs.LazVlr(layout))
    written: list[tuple[int, bytes]] = []
    for records in parts:
        block = max(1, _LARGEST_CHUNK // records.shape[1])
        for first in range(0, len(records), block):
            octets = np.ascontiguousarray(records[first : first + block]).reshape(-1)
            compressor.compress_many(octets)
            if check:
                written.append((len(octets), sha256(octets.tobytes()).digest()))
    compressor.done()
    if written:
        end = file.tell()
        file.seek(start)
        decompressor = lazrs.ParLasZipDecompressor(file, layout)
        same = True
        for size, digest in written:
            back = np.empty(size, np.uint8)
            decompressor.decompress_many(back)
            same &= sha256(back.tobytes()).digest() == digest
        file.seek(end)
        if not same:
            raise ScanError("LAZ cannot hold these waveform packets exactly (several scanner channels); write .las instead")
