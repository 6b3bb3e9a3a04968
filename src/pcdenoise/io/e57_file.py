"""The container of an E57 file (ASTM E2807): pages with checksums, sections of packets, fields packed bit by bit.

Not here: its XML (e57_xml.py), what fields and XML mean for a scan (e57.py).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pcdenoise.errors import ScanError
from pcdenoise.io.source import Column

SIGNATURE = b"ASTM-E57"
HEADER_BYTES = 48
PAGE = 1024
"""Bytes of a page in the files that we make, four of them a checksum; others may have other pages."""

Octets = NDArray[np.uint8]

_HEADER = struct.Struct("<8sIIQQQQ")  # signature, version, length of the file, where its XML starts and its length, page size
_BLOB, _VECTOR = 0, 1
_SECTION = struct.Struct("<B7xQ")  # what it is, its length
_RECORDS = struct.Struct("<B7xQQQ")  # of one with records also where its data starts, where its index does
_PACKET = struct.Struct("<BBHH")  # what it is, flags, its length less one, number of streams
_INDEX_PACKET, _DATA_PACKET, _EMPTY_PACKET = 0, 1, 2
_INDEX = struct.Struct("<BBHHB9xQQ")  # of one entry: from which record on, and where that is
_INDEX_HEAD = 16
_USUAL_PACKET = 1 << 15  # bytes of values; none may have twice that, and eight records of all fields are a quarter of it at most
_SMALLEST_PAGE, _LARGEST_PAGE = 64, 1 << 16
_CHECKSUM_BYTES, _PAGES_AT_ONCE = 4, 4096
_RECORDS_AT_ONCE = 1 << 16
_WHOLE_WORDS = {8: "<u1", 16: "<u2", 32: "<u4", 64: "<u8"}
_MOST_SHIFTED_BITS = 57  # seven bits into an eight-byte word there is room for so many


@dataclass(frozen=True)
class Field:
    """A value of each record. Integers lie between two bounds and mean `offset + scale * value` where they are scaled."""

    name: str
    kind: Literal["single", "double", "integer", "scaled", "text"]
    low: int = 0
    high: int = 0
    scale: float = 1.0
    offset: float = 0.0

    @property
    def bits(self) -> int:
        """Bits of one value; an integer that can have one value alone has none."""
        return {"single": 32, "double": 64, "text": 0}.get(self.kind, (self.high - self.low).bit_length())

    def unpacked(self, stream: bytes, n: int) -> Column:
        """(n,) values as stored: floats, or integers in as narrow a type as their bounds allow. The stream holds so many."""
        if self.kind in ("single", "double"):
            return np.frombuffer(stream, "<f4" if self.kind == "single" else "<f8", n)
        narrow = np.result_type(np.min_scalar_type(self.low), np.min_scalar_type(self.high))
        dtype = narrow if narrow.kind in "iu" and narrow != np.uint64 else np.dtype(np.int64)
        values = _unpacked(stream, self.bits, n) + np.uint64(self.low % (1 << 64))  # goes around, as two's complement does
        return values.view(np.int64).astype(dtype)

    def packed(self, values: Column) -> bytes:
        """The stream of (n,) values as `unpacked` gives them; integers beyond the bounds are none of them."""
        if self.kind in ("single", "double"):
            return values.astype("<f4" if self.kind == "single" else "<f8", copy=False).tobytes()
        return _packed(values.astype(np.int64).view(np.uint64) - np.uint64(self.low % (1 << 64)), self.bits)


def _unpacked(stream: bytes, bits: int, n: int) -> NDArray[np.uint64]:
    """(n,) numbers of so many bits each, the lowest bit first and without gaps."""
    if bits == 0:
        return np.zeros(n, np.uint64)
    if bits in _WHOLE_WORDS:
        return np.frombuffer(stream, _WHOLE_WORDS[bits], n).astype(np.uint64)
    values = np.empty(n, np.uint64)
    octets = np.frombuffer(stream + bytes(16), np.uint8)
    words = np.ndarray((len(octets) - 7,), "<u8", octets, strides=(1,))  # the one that starts at each byte
    mask = np.uint64((1 << bits) - 1)
    for start in range(0, n, _RECORDS_AT_ONCE):
        first = np.arange(start, min(start + _RECORDS_AT_ONCE, n), dtype=np.uint64) * np.uint64(bits)
        byte, shift = first >> np.uint64(3), first & np.uint64(7)
        some = words[byte] >> shift
        if bits > _MOST_SHIFTED_BITS:
            some |= np.where(shift > 0, words[byte + np.uint64(8)] << ((np.uint64(64) - shift) & np.uint64(63)), np.uint64(0))
        values[start : start + _RECORDS_AT_ONCE] = some & mask
    return values


def _packed(values: NDArray[np.uint64], bits: int) -> bytes:
    if bits == 0:
        return b""
    if bits in _WHOLE_WORDS:
        return values.astype(_WHOLE_WORDS[bits]).tobytes()
    parts = []
    for start in range(0, len(values), _RECORDS_AT_ONCE):
        octets = values[start : start + _RECORDS_AT_ONCE].astype("<u8").view(np.uint8).reshape(-1, 8)
        single = np.unpackbits(octets, axis=1, count=bits, bitorder="little")
        parts.append(np.packbits(single.reshape(-1), bitorder="little").tobytes())
    return b"".join(parts)


@dataclass(frozen=True)
class Container:
    """The file's bytes without checksums, where in them its XML stands, and the size of its pages."""

    data: Octets
    xml: slice
    page: int

    def at(self, physical: int) -> int:
        """Where in `data` an offset in the file leads: beyond its end where the file has no such place."""
        page, within = divmod(physical, self.page)
        return page * (self.page - _CHECKSUM_BYTES) + within if within < self.page - _CHECKSUM_BYTES else len(self.data)


def opened(raw: bytes, origin: str) -> Container:
    """A file's container. Raises ScanError for one that is cut off, damaged, or of another version than 1."""
    if len(raw) < HEADER_BYTES:
        raise ScanError(f"{origin}: ends before its header; it is cut off, fetch it again")
    _, major, minor, length, xml_at, xml_length, page = _HEADER.unpack_from(raw)
    if major != 1:
        raise ScanError(f"{origin}: is E57 of version {major}.{minor}, known is 1; save it as 1.0")
    if not _SMALLEST_PAGE <= page <= _LARGEST_PAGE or page % 4 or length % page or not length:
        raise ScanError(f"{origin}: header claims {length} bytes in pages of {page}; it is damaged, fetch it again")
    if length > len(raw):
        raise ScanError(f"{origin}: header claims {length} bytes, the file holds {len(raw)}; it is cut off, fetch it again")
    pages = np.frombuffer(raw, np.uint8, length).reshape(-1, page)
    stored = np.ascontiguousarray(pages[:, -_CHECKSUM_BYTES:]).view(">u4")[:, 0]
    wrong = np.flatnonzero(_checksums(pages[:, :-_CHECKSUM_BYTES]) != stored)
    if len(wrong):
        raise ScanError(
            f"{origin}: {len(wrong)} of {len(pages)} pages fail their checksum, the first at byte {wrong[0] * page};"
            " it is damaged, fetch it again"
        )
    container = Container(pages[:, :-_CHECKSUM_BYTES].reshape(-1), slice(0), page)
    start = container.at(xml_at)
    if not HEADER_BYTES <= start <= start + xml_length <= len(container.data):
        raise ScanError(f"{origin}: header claims XML where the file has none; it is damaged, fetch it again")
    return Container(container.data, slice(start, start + xml_length), page)


def closed(data: bytes, xml: bytes, page: int = PAGE) -> bytes:
    """The file of these bytes, the first of them room for its header, and XML behind them."""
    room = page - _CHECKSUM_BYTES
    xml_at = len(data)
    n_pages = -(-(len(data) + len(xml)) // room)
    header = _HEADER.pack(SIGNATURE, 1, 0, n_pages * page, _physical(xml_at, page), len(xml), page)
    whole = header + data[HEADER_BYTES:] + xml
    pages = np.zeros((n_pages, page), np.uint8)
    pages[:, :room] = np.frombuffer(whole.ljust(n_pages * room, b"\0"), np.uint8).reshape(n_pages, room)
    pages[:, room:] = _checksums(pages[:, :room]).astype(">u4")[:, None].view(np.uint8)
    return pages.tobytes()


def _physical(at: int, page: int) -> int:
    return at // (page - _CHECKSUM_BYTES) * page + at % (page - _CHECKSUM_BYTES)


def _checksum_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = (table >> np.uint32(1)) ^ (np.uint32(0x82F63B78) * (table & np.uint32(1)))
    return table


_TABLE = _checksum_table()


def _checksums(pages: Octets) -> NDArray[np.uint32]:
    """(P,) CRC-32C (Castagnoli) of each page (P, L): byte after byte, many pages at a time."""
    found = np.empty(len(pages), np.uint32)
    for start in range(0, len(pages), _PAGES_AT_ONCE):
        some = np.ascontiguousarray(pages[start : start + _PAGES_AT_ONCE].T)
        checksum = np.full(some.shape[1], 0xFFFFFFFF, np.uint32)
        for octets in some:
            checksum = _TABLE[(checksum ^ octets) & np.uint32(255)] ^ (checksum >> np.uint32(8))
        found[start : start + _PAGES_AT_ONCE] = ~checksum
    return found


@dataclass(frozen=True)
class Vector:
    """A section of records: where the pieces of each field's stream stand in the container's data, and its length."""

    pieces: Sequence[Sequence[slice]]
    length: int

    def stream(self, container: Container, number: int) -> bytes:
        """All bytes of a field's stream."""
        return b"".join(container.data[piece].tobytes() for piece in self.pieces[number])


def vector_at(container: Container, physical: int, n_fields: int, is_empty: bool, origin: str) -> Vector:
    """The section of records at an offset of the file, which may be empty: without packets. Raises ScanError on damage."""
    data, start = container.data, container.at(physical)
    if start + _RECORDS.size > len(data):
        raise _no_section(origin, physical)
    kind, section_length, data_at, _ = _RECORDS.unpack_from(data.data, start)
    at, stop = container.at(data_at), start + section_length
    pieces: list[list[slice]] = [[] for _ in range(n_fields)]
    if kind != _VECTOR or stop > len(data) or not (is_empty or start < at <= stop):
        raise _no_section(origin, physical)
    while at < stop and not is_empty:
        kind, _, length, n_streams = _PACKET.unpack_from(data.data, at) if at + _PACKET.size <= stop else (-1, 0, 0, 0)
        end = at + length + 1
        if kind not in (_INDEX_PACKET, _DATA_PACKET, _EMPTY_PACKET) or end > stop or end % 4 != at % 4:
            raise ScanError(f"{origin}: has a broken packet in its points at byte {at}; it is damaged, fetch it again")
        if kind == _DATA_PACKET:
            first = at + _PACKET.size + 2 * n_streams
            lengths = np.frombuffer(data[at + _PACKET.size : first].tobytes(), "<u2").tolist() if first <= end else []
            if n_streams != n_fields or first + sum(lengths) > end:
                raise ScanError(f"{origin}: has {n_streams} streams for {n_fields} fields; it is damaged, fetch it again")
            for piece, size in zip(pieces, lengths, strict=True):
                piece.append(slice(first, first + size))
                first += size
        at = end
    return Vector(pieces, section_length)


def _no_section(origin: str, physical: int) -> ScanError:
    return ScanError(f"{origin}: its XML names a section at byte {physical}, where none is; it is damaged, fetch it again")


def section_at(container: Container, physical: int, origin: str) -> bytes:
    """The bytes of a section, its head among them: of records, or of an image or the like. Raises ScanError on damage."""
    data, start = container.data, container.at(physical)
    kind, length = _SECTION.unpack_from(data.data, start) if start + _SECTION.size <= len(data) else (-1, 0)
    if kind not in (_BLOB, _VECTOR) or length < (_SECTION if kind == _BLOB else _RECORDS).size or start + length > len(data):
        raise _no_section(origin, physical)
    return data[start : start + length].tobytes()


class Layout:
    """A file in the making, section after section; the XML follows by `closed`."""

    def __init__(self) -> None:
        self._data = bytearray(HEADER_BYTES)

    @property
    def data(self) -> bytes:
        """What there is by now."""
        return bytes(self._data)

    def add_section(self, container: Container, physical: int, origin: str) -> int:
        """Puts a section of another file down as it is, and says where it lies; what in it names places is told the new ones."""
        section, at = bytearray(section_at(container, physical, origin)), self._next()
        start, where = container.at(physical), _physical(at, PAGE)

        def moved(place: int) -> int:
            return _physical(container.at(place) - start + at, PAGE) if place else 0

        if section[0] == _VECTOR:
            kind, length, data_at, index_at = _RECORDS.unpack_from(section)
            _RECORDS.pack_into(section, 0, kind, length, moved(data_at), moved(index_at))
            inside = _RECORDS.size
            while inside + _PACKET.size <= len(section):
                kind, _, length, n_entries = _PACKET.unpack_from(section, inside)
                stop = min(inside + length + 1, len(section))
                for entry in range(inside + _INDEX_HEAD, stop - 15, 16) if kind == _INDEX_PACKET else ():
                    if (entry - inside - _INDEX_HEAD) // 16 < n_entries:
                        struct.pack_into("<Q", section, entry + 8, moved(struct.unpack_from("<Q", section, entry + 8)[0]))
                inside = stop
        self._data += section
        return where

    def add_vector(self, fields: Sequence[Field], streams: Sequence[bytes], n: int) -> int:
        """Puts n records down, and says where in the file their section lies."""
        at = self._next()
        first = at + _RECORDS.size
        packets = b"".join(_data_packets(fields, streams, n))
        where = _physical(first, PAGE)
        index_at = first + len(packets)
        index = _INDEX.pack(_INDEX_PACKET, 0, _INDEX.size - 1, 1, 0, 0, where)
        length = _RECORDS.size + len(packets) + len(index)
        self._data += _RECORDS.pack(_VECTOR, length, where, _physical(index_at, PAGE)) + packets + index
        return _physical(at, PAGE)

    def _next(self) -> int:
        self._data += bytes(-len(self._data) % 4)
        return len(self._data)


def _data_packets(fields: Sequence[Field], streams: Sequence[bytes], n: int) -> Iterator[bytes]:
    """Packets of about as many records each, a multiple of eight, so that no byte of a stream is shared by two; one at least."""
    n_packets = max(1, -(-sum(map(len, streams)) // _USUAL_PACKET))
    records = [min(n, -(-n * number // n_packets // 8) * 8) for number in range(n_packets + 1)]
    for number, (first, last) in enumerate(pairwise(records)):
        parts = []
        for field, some in zip(fields, streams, strict=True):
            by_record = bytes_of(field, first), bytes_of(field, last)
            by_length = len(some) * number // n_packets, len(some) * (number + 1) // n_packets
            parts.append(some[slice(*(by_length if field.kind == "text" else by_record))])
        body = np.array([len(part) for part in parts], "<u2").tobytes() + b"".join(parts)
        body += bytes(-(_PACKET.size + len(body)) % 4)
        yield _PACKET.pack(_DATA_PACKET, 0, _PACKET.size + len(body) - 1, len(parts)) + body


def bytes_of(field: Field, n: int) -> int:
    """How many bytes n values of a field take at least."""
    return -(-n * field.bits // 8)


def number_type(dtype: np.dtype[Any]) -> Field | None:
    """A field, as yet without a name, that holds every value of a number type; None if there is none."""
    if dtype.kind == "b":
        return Field("", "integer", 0, 1)
    if dtype.kind == "f":
        return Field("", "single" if dtype.itemsize <= 4 else "double") if dtype.itemsize <= 8 else None
    if dtype.kind in "iu" and not (dtype.kind == "u" and dtype.itemsize == 8):
        return Field("", "integer", int(np.iinfo(dtype).min), int(np.iinfo(dtype).max))
    return None
