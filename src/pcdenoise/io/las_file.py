"""The bytes of a LAS or LAZ file: header, VLRs, raw point records, all that follows. Not here: what the values mean (las.py).

The parts are kept as bytes and only changed fields are patched, because laspy's own copy drops EVLRs, gaps and unknown header
bytes. Layouts follow the ASPRS LAS 1.4 R15 specification.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pcdenoise.errors import ScanError
from pcdenoise.io import laz
from pcdenoise.io.files import Raw, check_not_cut, let_go

HEADER = np.dtype(
    [
        ("signature", "S4"), ("source_id", "<u2"), ("global_encoding", "<u2"), ("guid", "V16"), ("major", "u1"), ("minor", "u1"),
        ("system", "S32"), ("software", "S32"), ("day", "<u2"), ("year", "<u2"), ("header_size", "<u2"), ("points_start", "<u4"),
        ("n_vlrs", "<u4"), ("point_format", "u1"), ("record_length", "<u2"), ("legacy_n_points", "<u4"),
        ("legacy_n_by_return", "<u4", 5), ("scale", "<f8", 3), ("offset", "<f8", 3), ("bounds", "<f8", (3, 2)),
        ("waveforms_start", "<u8"), ("evlrs_start", "<u8"), ("n_evlrs", "<u4"), ("n_points", "<u8"), ("n_by_return", "<u8", 15),
    ]
)  # fmt: skip
"""The public header block of LAS 1.4; older versions are prefixes of it. `bounds` is ((max, min) of x, of y, of z)."""

_WAVEFORM_14 = (9, 10)
_SIZE_BY_MINOR = {0: 227, 1: 227, 2: 227, 3: 235}
_COMPRESSED = 0x80
_VLR = struct.Struct("<H16sHH32s")
_EVLR = struct.Struct("<H16sHQ32s")
LASZIP = (b"laszip encoded", 22204)
"""Identity of the VLR that says how points are compressed."""


@dataclass(frozen=True)
class LasFile:
    """A LAS file taken apart; `write` puts it together again, byte for byte unless a part was replaced.

    header      the whole header block, `header_size` bytes.
    vlrs        each VLR with its own 54-byte header, in file order; a LAZ file's laszip VLR among them.
    gap         bytes between the last VLR and the first point.
    records     (N, record_length) uint8, uncompressed.
    tail        bytes after the points: EVLRs and waveform packets.
    tail_start  where the tail began; header pointers into it are relative to this.
    """

    header: bytes
    vlrs: tuple[bytes, ...]
    gap: bytes
    records: NDArray[np.uint8]
    tail: bytes
    tail_start: int

    def field(self, name: str) -> Any:
        """The value of a header field named in HEADER; zero where this LAS version has no such field."""
        return np.frombuffer(self.header.ljust(HEADER.itemsize, b"\0"), HEADER, 1)[0][name]

    @property
    def point_format(self) -> int:
        """Point data record format 0 to 10, without the compression bits."""
        return int(self.field("point_format")) & 0x3F

    def with_header(self, **values: Any) -> LasFile:
        """The file with header fields replaced; fields beyond this version's header size are ignored."""
        block = np.frombuffer(self.header.ljust(HEADER.itemsize, b"\0"), HEADER, 1).copy()
        for name, value in values.items():
            block[0][name] = value
        size = min(len(self.header), HEADER.itemsize)
        return replace(self, header=block.tobytes()[:size] + self.header[size:])

    def vlr(self, user_id: bytes, record_id: int) -> list[bytes]:
        """The payloads of all VLRs with this identity."""
        return [record[_VLR.size :] for record in self.vlrs if vlr_identity(record) == (user_id, record_id)]

    def with_vlr(self, user_id: bytes, record_id: int, description: bytes, data: bytes) -> LasFile:
        """The file with this VLR, in place of the first one of the same identity (further ones go) or after the others."""
        if len(data) > 0xFFFF:
            raise ScanError(f"VLR {user_id.decode()}/{record_id} would have {len(data)} bytes, LAS allows 65535; shorten it")
        identities = [vlr_identity(record) for record in self.vlrs]
        place = identities.index((user_id, record_id)) if (user_id, record_id) in identities else len(self.vlrs)
        vlrs = [record for i, record in enumerate(self.vlrs) if i < place or identities[i] != (user_id, record_id)]
        reserved = 0
        if place < len(self.vlrs):
            reserved, _, _, _, description = _VLR.unpack_from(self.vlrs[place])
        vlrs.insert(place, _VLR.pack(reserved, user_id, record_id, len(data), description) + data)
        return replace(self, vlrs=tuple(vlrs)).with_header(n_vlrs=len(vlrs))

    def without_vlr(self, user_id: bytes, record_id: int) -> LasFile:
        """The file without the VLRs of this identity."""
        vlrs = tuple(record for record in self.vlrs if vlr_identity(record) != (user_id, record_id))
        return replace(self, vlrs=vlrs).with_header(n_vlrs=int(self.field("n_vlrs")) + len(vlrs) - len(self.vlrs))

    def without_copc(self) -> LasFile:
        """The file as plain LAZ: the COPC octree indexes the old coordinates, so its VLR and EVLRs go."""
        if not any(vlr_identity(record)[0] == b"copc" for record in self.vlrs):
            return self
        vlrs = tuple(record for record in self.vlrs if vlr_identity(record)[0] != b"copc")
        evlrs = self.evlrs()
        kept = [record for record in evlrs if _EVLR.unpack_from(record)[1].split(b"\0")[0] != b"copc"]
        first = int(self.field("evlrs_start")) - self.tail_start
        tail = self.tail[:first] + b"".join(kept) + self.tail[first + sum(map(len, evlrs)) :]
        start = self.field("evlrs_start") if kept else 0
        return replace(self, vlrs=vlrs, tail=tail).with_header(n_vlrs=len(vlrs), n_evlrs=len(kept), evlrs_start=start)

    def evlrs(self) -> list[bytes]:
        """The EVLRs, each with its own 60-byte header; those that run past the end of the file are left out."""
        records: list[bytes] = []
        at = int(self.field("evlrs_start")) - self.tail_start
        for _ in range(int(self.field("n_evlrs"))):
            if at < 0 or at + _EVLR.size > len(self.tail):
                break
            end = at + _EVLR.size + _EVLR.unpack_from(self.tail, at)[3]
            if end > len(self.tail):
                break
            records.append(self.tail[at:end])
            at = end
        return records

    def write(
        self,
        file: BinaryIO,
        *,
        compressed: bool,
        parts: Iterable[NDArray[np.uint8]] | None = None,
        at_the_end: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        """Write as LAS or LAZ at the start of a seekable file. Raises ScanError if lazrs cannot hold the records exactly.

        parts: the records in several pieces, in place of `records`; at_the_end: header fields that are known after the last.
        """
        parts = (self.records,) if parts is None else parts
        vlrs = [record for record in self.vlrs if compressed or vlr_identity(record) != LASZIP]
        n_extra = self.records.shape[1] - standard_length(self.point_format)
        layout = laz.layout(self.point_format, n_extra, self.vlr(*LASZIP))
        if compressed:
            place = next((i for i, record in enumerate(vlrs) if vlr_identity(record) == LASZIP), len(vlrs))
            if layout not in self.vlr(*LASZIP)[:1]:
                vlrs[place : place + 1] = [_VLR.pack(0, *LASZIP, len(layout), b"written by lazrs") + layout]
        points_start = len(self.header) + sum(map(len, vlrs)) + len(self.gap)
        start = self.with_header(
            points_start=points_start,
            n_vlrs=int(self.field("n_vlrs")) + len(vlrs) - len(self.vlrs),
            point_format=self.point_format | (_COMPRESSED if compressed else 0),
            record_length=self.records.shape[1],
        )
        file.write(start.header + b"".join(vlrs) + self.gap)
        if compressed:
            laz.compress(parts, layout, file, check=self.point_format in _WAVEFORM_14)
        else:
            for records in parts:
                file.write(records.data)
        start = start.with_header(**at_the_end())
        shift = file.tell() - self.tail_start
        file.write(self.tail)
        file.seek(0)
        pointers = {name: int(self.field(name)) for name in ("waveforms_start", "evlrs_start")}
        file.write(start.with_header(**{name: at + shift for name, at in pointers.items() if at >= self.tail_start > 0}).header)
        file.seek(0, 2)


@dataclass(frozen=True)
class Body:
    """Where the point records of a file are: n_points of `length` bytes from byte `start`; layout: how they are compressed."""

    raw: Raw
    origin: str
    start: int
    n_points: int
    length: int
    layout: bytes | None

    def parts(self, n_rows: int) -> Iterator[NDArray[np.uint8]]:
        """(at most n_rows, length) records after records. Raises ScanError if compressed ones are damaged."""
        if self.layout is not None:
            yield from laz.decompressed(self.raw, self.start, self.n_points, self.length, self.layout, self.origin, n_rows)
            return
        for first in range(0, self.n_points, n_rows):
            n = min(n_rows, self.n_points - first)
            check_not_cut(self.raw, self.origin)
            octets = np.frombuffer(self.raw, np.uint8, n * self.length, self.start + first * self.length)
            yield (octets if isinstance(self.raw, bytes) else octets.copy()).reshape(n, self.length)
            let_go(self.raw)


def parse(raw: bytes, origin: str) -> LasFile:
    """Take a LAS or LAZ file apart. Raises ScanError if it is not LAS, is damaged or holds fewer points than it claims."""
    file, body = outline(raw, origin)
    return replace(file, records=next(body.parts(max(1, body.n_points)), file.records))


def outline(raw: Raw, origin: str) -> tuple[LasFile, Body]:
    """The file without its records, and where they are. Raises ScanError as `parse` does, for what shows without reading them."""
    if len(raw) < 227 or raw[:4] != b"LASF":
        raise ScanError(f"{origin}: is not a LAS file (no LASF header); check the file or name its real format")
    fields = np.frombuffer(raw[: HEADER.itemsize].ljust(HEADER.itemsize, b"\0"), HEADER, 1)[0]
    size = int(fields["header_size"])
    major, minor = int(fields["major"]), int(fields["minor"])
    needed = _SIZE_BY_MINOR.get(minor, HEADER.itemsize)
    if major != 1 or minor > 5:
        raise ScanError(f"{origin}: is LAS {major}.{minor}; this reads 1.0 to 1.5, convert it first")
    if size < needed or size > len(raw):
        raise ScanError(f"{origin}: LAS 1.{minor} header of {size} bytes, not {needed}; the file is damaged, fetch it again")
    points_start, length = int(fields["points_start"]), int(fields["record_length"])
    form = int(fields["point_format"])
    if form & 0x3F > 10:
        raise ScanError(f"{origin}: point format {form & 0x3F} is unknown; LAS knows 0 to 10, convert the file first")
    if length < standard_length(form & 0x3F):
        raise ScanError(f"{origin}: {length} bytes a point are too few for point format {form & 0x3F}; the file is damaged")
    if not size <= points_start <= len(raw):
        raise ScanError(f"{origin}: points start at byte {points_start} of {len(raw)}; the file is damaged, fetch it again")
    if not (np.isfinite(fields["scale"]).all() and np.isfinite(fields["offset"]).all() and (fields["scale"] != 0).all()):
        raise ScanError(f"{origin}: scale or offset is zero or no number, so there are no coordinates; repair the header first")
    waveforms_start = int(fields["waveforms_start"]) if size >= 235 else 0
    n_evlrs = int(fields["n_evlrs"]) if size >= HEADER.itemsize else 0
    evlrs_start = int(fields["evlrs_start"]) if n_evlrs else 0
    n_points = (int(fields["n_points"]) if size >= HEADER.itemsize and minor >= 4 else 0) or int(fields["legacy_n_points"])
    vlrs = _split_vlrs(raw[size:points_start], int(fields["n_vlrs"]))
    gap = raw[size + sum(map(len, vlrs)) : points_start]
    if n_evlrs and not points_start <= evlrs_start <= len(raw):
        raise ScanError(f"{origin}: EVLRs start at byte {evlrs_start} of {len(raw)}; the file is damaged, fetch it again")
    if form & 0xC0:
        tail_start = min((at for at in (waveforms_start, evlrs_start) if points_start < at <= len(raw)), default=len(raw))
        layouts = [record[_VLR.size :] for record in vlrs if vlr_identity(record) == LASZIP]
        if not layouts:
            raise ScanError(f"{origin}: is compressed but has no laszip VLR; the file is damaged, fetch it again")
        layout = layouts[0]
    else:
        held = (len(raw) - points_start) // length
        if n_points > held:
            raise ScanError(f"{origin}: header claims {n_points} points, the file holds {held}; it is cut off, fetch it again")
        tail_start = points_start + n_points * length
        layout = None
    file = LasFile(raw[:size], vlrs, gap, np.empty((0, length), np.uint8), raw[tail_start:], tail_start)
    return file, Body(raw, origin, points_start, n_points, length, layout)


def vlr_identity(record: bytes) -> tuple[bytes, int]:
    """(user id, record id) of a VLR."""
    _, user_id, record_id, _, _ = _VLR.unpack_from(record)
    return user_id.split(b"\0")[0], record_id


def standard_length(point_format: int) -> int:
    """Bytes of a point record of format 0 to 10 without extra bytes."""
    return (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)[point_format]


def _split_vlrs(block: bytes, n_claimed: int) -> tuple[bytes, ...]:
    """The VLRs that lie whole within the block; a chain that breaks leaves its rest to the gap."""
    records: list[bytes] = []
    at = 0
    while len(records) < n_claimed and at + _VLR.size <= len(block):
        end = at + _VLR.size + _VLR.unpack_from(block, at)[3]
        if end > len(block):
            break
        records.append(block[at:end])
        at = end
    return tuple(records)
