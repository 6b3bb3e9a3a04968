"""Small scan files of every flavour, built byte by byte without pcdenoise's own writers. Not here: any test."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any

import lazrs
import numpy as np
from numpy.typing import NDArray

from pcdenoise.errors import ScanError

LAS_FLAVOURS = [
    *((0, form) for form in (0, 1)), *((1, form) for form in (0, 1)), *((2, form) for form in range(4)),
    *((3, form) for form in range(6)), *((4, form) for form in range(11)),
]  # fmt: skip
"""(minor version, point format) of every combination the LAS specifications allow."""

SCALE = (0.001, 0.01, 0.0005)
OFFSET = (500000.0, 4649776.0, -10.0)
_LENGTHS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
_HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}


def las_records(point_format: int, n: int, n_extra: int, seed: int = 0) -> NDArray[np.uint8]:
    """(n, length) records: random bytes, but coordinates below 1e6 steps, valid returns, one scanner channel."""
    rng = np.random.default_rng(seed)
    records = rng.integers(0, 256, (n, _LENGTHS[point_format] + n_extra), dtype=np.uint8)
    records[:, :12] = rng.integers(-1_000_000, 1_000_000, (n, 3), dtype="<i4").view(np.uint8).reshape(n, 12)
    if point_format >= 6:
        records[:, 14] = 0x11 * rng.integers(1, 6, n)
        records[:, 15] &= 0b11001111
    else:
        records[:, 14] = 0b01000000 | rng.integers(1, 6, n) << 3 | rng.integers(1, 6, n)
    if point_format in (9, 10):  # lazrs scrambles wild waveform values of these formats
        records[:, -29 - n_extra : len(records[0]) - n_extra] = 0
    return records


def refusal(call: Callable[..., Any], *arguments: Any) -> str:
    """What a call's ScanError says; nothing if it raises none."""
    try:
        call(*arguments)
    except ScanError as fault:
        return str(fault)
    return ""


def vlr(user_id: bytes, record_id: int, data: bytes, description: bytes = b"") -> bytes:
    """A variable length record."""
    return struct.pack("<H16sHH32s", 0, user_id, record_id, len(data), description) + data


def evlr(user_id: bytes, record_id: int, data: bytes) -> bytes:
    """An extended variable length record."""
    return struct.pack("<H16sHQ32s", 0, user_id, record_id, len(data), b"extended") + data


def extra_bytes_entry(name: bytes, kind: int, options: int = 0, scale: float = 0.0, offset: float = 0.0) -> bytes:
    """The 192-byte description of one extra dimension."""
    numbers = struct.pack("<3d3d", scale, 0, 0, offset, 0, 0)
    return struct.pack("<2xBB32s4x72x", kind, options, name) + numbers + b"why".ljust(32, b"\0")


def las(
    minor: int,
    point_format: int,
    *,
    compressed: bool = False,
    n: int = 40,
    n_extra: int = 0,
    vlrs: Sequence[bytes] = (),
    evlrs: Sequence[bytes] = (),
    waveforms: bytes = b"",
    gap: bytes = b"",
    records: NDArray[np.uint8] | None = None,
) -> bytes:
    """A LAS or LAZ file with odd but legal values in every header field."""
    records = las_records(point_format, n, n_extra) if records is None else records
    n, length = records.shape
    vlrs = list(vlrs)
    if compressed:
        laszip = lazrs.LazVlr.new_for_compression(point_format, length - _LENGTHS[point_format])
        layout = laszip.record_data()
        if point_format in (4, 5):  # LASzip calls the way to compress waveform packets the first, lazrs the second
            layout = layout.replace(struct.pack("<HHH", 9, 29, 2), struct.pack("<HHH", 9, 29, 1))
        vlrs.append(vlr(b"laszip encoded", 22204, layout, b"http://laszip.org"))
    size = _HEADER_SIZES[minor]
    points_start = size + sum(map(len, vlrs)) + len(gap)
    body = BytesIO()
    body.write(bytes(points_start))
    if compressed:
        compressor = lazrs.ParLasZipCompressor(body, laszip)
        compressor.compress_many(records.reshape(-1))
        compressor.done()
    else:
        body.write(records.tobytes())
    waveforms_start = body.tell() if waveforms else 0
    evlrs_start = body.tell() + len(waveforms) if evlrs else 0
    steps = np.ascontiguousarray(records[:, :12]).view("<i4").reshape(n, 3)
    low, high = (bound * SCALE + OFFSET for bound in (steps.min(axis=0), steps.max(axis=0)))
    bounds = [value for pair in zip(high, low, strict=True) for value in pair]
    returns = np.bincount(records[:, 14] & (15 if point_format >= 6 else 7), minlength=16)[1:]
    legacy = 0 if point_format >= 6 else n
    header = struct.pack(
        "<4sHH16sBB32s32sHHHIIBHI5I", b"LASF", 77, 16 if point_format >= 6 else 1, bytes(range(16)), 1, minor, b"some scanner",
        b"some software", 123, 2019, size, points_start, len(vlrs), point_format | (0x80 if compressed else 0), length, legacy,
        *(returns[:5] if legacy else [0] * 5),
    ) + struct.pack("<12d", *SCALE, *OFFSET, *bounds)  # fmt: skip
    if minor >= 3:
        header += struct.pack("<Q", waveforms_start)
    if minor >= 4:
        header += struct.pack("<QIQ15Q", evlrs_start, len(evlrs), n, *returns)
    raw = bytearray(body.getvalue() + waveforms + b"".join(evlrs))
    raw[:points_start] = header + b"".join(vlrs) + gap
    return bytes(raw)


def ply(
    byte_order: str,
    *,
    dtype: str = "float",
    eol: str = "\n",
    faces: bool = False,
    lists: str = "none",
    camera: bool = False,
    n: int = 30,
) -> bytes:
    """A PLY file: `byte_order` is '=' (ASCII), '<' or '>'; `lists` in the vertices are 'none', 'even' (all of 3) or 'ragged'.

    Properties stand in an odd order (y, intensity, x, [neighbours], z, label), `camera` puts an element before the vertices.
    """
    rng = np.random.default_rng(1)
    code = {"float": "f", "double": "d", "int": "i"}[dtype]
    points = rng.integers(-50, 50, (n, 3)) if dtype == "int" else rng.normal(0, 10, (n, 3))
    form = {"=": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[byte_order]
    header = ["ply", f"format {form} 1.0", "comment made by hand: été", "obj_info range 3"]
    if camera:
        header += ["element camera 2", "property uchar kind", "property list uchar float matrix"]
    header += [f"element vertex {n}", f"property {dtype} y", "property uchar intensity", f"property {dtype} x"]
    header += ["property list uchar int neighbours"] if lists != "none" else []
    header += [f"property {dtype} z", "property short label", "comment between elements"]
    header += ["element face 2", "property list uchar int vertex_indices"] if faces else []
    rows: list[list[tuple[str, float]]] = []
    if camera:
        rows += [[("B", 7), ("B", 2), ("f", 0.5), ("f", 0.25)], [("B", 8), ("B", 1), ("f", 1.5)]]
    for i, (x, y, z) in enumerate(points.tolist()):
        n_list = {"none": -1, "even": 3, "ragged": i % 4}[lists]
        list_ = [("B", n_list), *(("i", k) for k in range(n_list))] if n_list >= 0 else []
        rows.append([(code, y), ("B", i % 256), (code, x), *list_, (code, z), ("h", -i)])
    if faces:
        rows += [[("B", 3), ("i", 0), ("i", 1), ("i", 2)], [("B", 4), ("i", 0), ("i", 1), ("i", 2), ("i", 3)]]
    head = (eol.join([*header, "end_header"]) + eol).encode()
    if byte_order == "=":
        return head + "".join(" ".join(_as_text(kind, value) for kind, value in row) + eol for row in rows).encode()
    return head + b"".join(struct.pack(byte_order + kind, value) for row in rows for kind, value in row)


def _as_text(kind: str, value: float) -> str:
    return f"{value:.4f}" if kind in "fd" else str(int(value))


def pcd(encoding: str, *, dtype: str = "F 4", organised: bool = False, version: str = "0.7", n: int = 60) -> bytes:
    """A PCD file with padding, a field of three values, a packed colour and rows of NaN.

    `encoding` is 'ascii', 'binary' or 'binary_compressed'; the last holds literal runs only.
    """
    rng = np.random.default_rng(2)
    real = {"F 4": "<f4", "F 8": "<f8"}[dtype]
    binary = encoding != "ascii"
    fields = [("x", real, 1), ("y", real, 1), *([("_", "u1", 4)] if binary else []), ("z", real, 1), ("rgb", "<f4", 1),
              ("histogram", "<u2", 3), ("label", "<i4", 1)]  # fmt: skip
    columns: dict[str, Any] = {
        "x": rng.normal(0, 5, n), "y": rng.normal(0, 5, n), "z": rng.normal(0, 5, n), "_": np.zeros((n, 4)),
        "rgb": (rng.integers(0, 1 << 24, n, dtype=np.uint32) | 0x3F000000).view(np.float32),
        "histogram": rng.integers(0, 9, (n, 3)), "label": np.arange(n) - 5,
    }  # fmt: skip
    columns["x"][::7] = columns["y"][::7] = columns["z"][::7] = np.nan
    letter = {"f": "F", "u": "U", "i": "I"}
    width, height = (n // 10, 10) if organised else (n, 1)
    header = [
        "# .PCD v.7 - Point Cloud Data file format", f"VERSION {version}", "FIELDS " + " ".join(name for name, _, _ in fields),
        "SIZE " + " ".join(str(np.dtype(code).itemsize) for _, code, _ in fields),
        "TYPE " + " ".join(letter[np.dtype(code).kind] for _, code, _ in fields),
        "COUNT " + " ".join(str(count) for _, _, count in fields), f"WIDTH {width}", f"HEIGHT {height}",
        "VIEWPOINT 0 0 1.5 1 0 0 0", f"POINTS {n}", f"DATA {encoding}",
    ]  # fmt: skip
    blocks = [np.asarray(columns[name]).astype(code).reshape(n, count) for name, code, count in fields]
    if encoding == "ascii":
        rows = ([value for block in blocks for value in block[i].tolist()] for i in range(n))
        body = "".join(" ".join(f"{value:.6g}" for value in row) + "\n" for row in rows).encode()
    elif encoding == "binary":
        body = b"".join(block[i].tobytes() for i in range(n) for block in blocks)
    else:
        plain = b"".join(block.tobytes() for block in blocks)
        runs = [plain[i : i + 32] for i in range(0, len(plain), 32)]
        packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    return ("\n".join(header) + "\n").encode() + body


XYZ = {
    "bare": b"1.5 2.25 3.125\n-4 5.0 6.0\n7.0 8.0 9.0\n",
    "columns": b"1.50 2.25 3.12 7 0.5\n-4.00 5.00 6.00 8 0.25\n7.00 8.00 9.00 9 0.125\n",
    "header in another order": b"Intensity,Z,Y,X\r\n7,3.1,2.2,1.3\r\n8,6.1,5.2,4.3\r\n9,9.1,8.2,7.3\r\n",
    "quotes": b'"X","Y","Z","name"\n1.5,2.5,3.5,"a, b"\n4.5,5.5,6.5,"c"\n7.5,8.5,9.5,d\n',
    "semicolons": b"x;y;z;r;g;b\n1.5;2.5;3.5;255;0;1\n4.5;5.5;6.5;2;3;4\n7.5;8.5;9.5;5;6;7\n",
    "decimal commas": b"x;y;z;i\n1,5;2,5;3,5;1\n4,5;5,5;6,5;2\n7,5;8,5;9,5;3\n",
    "tabs": b"1.5\t2.5\t3.5\tleaf\n4.5\t5.5\t6.5\t\n7.5\t8.5\t9.5\twood chip\n",
    "comments and blanks": b"# station 7\n\n# x y z i\n1.5 2.5 3.5 1\n\n  // moved\n4.5 5.5 6.5 2\n7.5 8.5 9.5 3\n\n",
    "cloudcompare": b"//X Y Z R G B\n3\n1.5 2.5 3.5 1 2 3\n4.5 5.5 6.5 4 5 6\n7.5 8.5 9.5 7 8 9\n",
    "pts": b"3\n1.5 2.5 3.5 -100 1 2 3\n4.5 5.5 6.5 -90 4 5 6\n7.5 8.5 9.5 -80 7 8 9\n",
    "no last line ending": b"1.5 2.5 3.5\n4.5 5.5 6.5\n7.5 8.5 9.5",
    "byte order mark": b"\xef\xbb\xbfx,y,z\n1.5,2.5,3.5\n4.5,5.5,6.5\n7.5,8.5,9.5\n",
    "exponents": b"1.500e+05 2.500e+06 3.500e-01\n1.600e+05 2.600e+06 4.500e-01\n1.700e+05 2.700e+06 5.500e-01\n",
    "nan rows": b"1.5 2.5 3.5\nnan nan nan\n7.5 8.5 9.5\n",
    "aligned": b"   1.50   2.25   3.12\n  -4.00   5.00   6.00\n 700.00   8.00   9.00\n",
    "carriage returns": b"1.5 2.5 3.5\r4.5 5.5 6.5\r7.5 8.5 9.5\r",
    "uneven": b"1.5 2.5 3.5 1\n4.5 5.5 6.5 2 3\n7.5 8.5 9.5 4\n",
    "big integers": b"1.5 2.5 3.5 9007199254740993\n4.5 5.5 6.5 1\n7.5 8.5 9.5 2\n",
}
"""Text scans of three rows in many dialects."""


_PTX_POSE = b"""600000.000000 800000.000000 400.000000
1 0 0
0 1 0
0 0 2
0.8 0.6 0 0
-0.6 0.8 0 0
0 0 2 0
600000.000000 800000.000000 400.000000 1
"""
_PTX_HOME = b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
_PTX_POINTS = b"""37.24 49.31 15.830 0.034912
36.33 49.70 23.195 0.004395
0 0 0 0.5
36.78 49.66 13.355 0.028809
36.38 48.01 12.695 0.024414
37.38 48.21 12.695 0.024414
"""
PTX = {
    "bare": b"2\n3\n" + _PTX_HOME + _PTX_POINTS,
    "colours": b"6\r\n1\r\n" + _PTX_HOME.replace(b"\n", b"\r\n")
    + b"".join(b"%d.5 %d.25 1.125 0.%d 25%d 0 %d\r\n" % (i, i * i, i + 1, i, i + 7) for i in range(6)),
    "two stations": b"2\n3\n" + _PTX_POSE + _PTX_POINTS + b"6\n1\n" + _PTX_HOME + _PTX_POINTS.replace(b"0 0 0 ", b"9 9 9 "),
    "no last line ending": (b"3\n2\n" + _PTX_POSE + _PTX_POINTS).rstrip(b"\n"),
    "one with colours": b"1\n6\n" + _PTX_HOME + _PTX_POINTS + b"1\n1\n" + _PTX_POSE + b"1.5 2.5 3.5 0.25 1 2 3\n\n",
}  # fmt: skip
"""Files of a terrestrial scanner: a grid, or several, posed or not, with a point that was not seen."""


def _crc32c(data: bytes) -> int:
    """Bit by bit, as its definition goes."""
    crc = 0xFFFFFFFF
    for octet in data:
        crc ^= octet
        for _ in range(8):
            crc = crc >> 1 ^ 0x82F63B78 * (crc & 1)
    return crc ^ 0xFFFFFFFF


def e57_pages(logical: bytes, page: int = 1024) -> bytes:
    """The pages of an E57 file with their checksums."""
    room = page - 4
    parts = [logical[at : at + room].ljust(room, b"\0") for at in range(0, len(logical), room)]
    return b"".join(part + struct.pack(">I", _crc32c(part)) for part in parts)


def e57_logical(raw: bytes, page: int = 1024) -> bytes:
    """The bytes of an E57 file without checksums."""
    return b"".join(raw[at : at + page - 4] for at in range(0, len(raw), page))


def e57(kind: str = "single", *, n: int = 300, n_stations: int = 1, image: bytes = b"", groups: bool = False) -> bytes:
    """An E57 file with intensities of odd bit lengths, a constant field, one of another namespace, text and several packets.

    `kind` is 'single', 'double', 'scaled' (19 bits, offset), 'integer', 'spherical' (and Cartesian ones), or 'invalid', where
    every seventh record says that it is no measurement. From the second station on they are posed.
    """
    page = 1024
    data = bytearray(48)

    def physical(at: int) -> int:
        return at // (page - 4) * page + at % (page - 4)

    def bits(values: Sequence[int], size: int) -> bytes:
        return sum(value << size * i for i, value in enumerate(values)).to_bytes(-(-len(values) * size // 8), "little")

    def section(streams: Sequence[bytes], n_packets: int) -> int:
        data.extend(bytes(-len(data) % 4))
        start = len(data)
        first = physical(start + 64)
        packets = bytearray(struct.pack("<BBHHB9xQQ", 0, 0, 31, 1, 0, 0, first))  # the index comes first
        for number in range(n_packets):
            cuts = [(len(some) * number // n_packets, len(some) * (number + 1) // n_packets) for some in streams]
            parts = [some[slice(*cut)] for some, cut in zip(streams, cuts, strict=True)]
            body = struct.pack(f"<{len(parts)}H", *map(len, parts)) + b"".join(parts)
            body += bytes(-(6 + len(body)) % 4)
            packets += struct.pack("<BBHH", 1, 0, 5 + len(body), len(parts)) + body
        packets += struct.pack("<BBH", 2, 0, 7) + bytes(4)
        data.extend(struct.pack("<B7xQQQ", 1, 32 + len(packets), first, physical(start + 32)) + packets)
        return physical(start)

    rng = np.random.default_rng(4)
    stations = []
    for number in range(n_stations):
        local = rng.normal(0, 4, (n, 3))
        axes = [f"cartesian{axis}" for axis in "XYZ"]
        fields: list[tuple[str, bytes]] = []
        if kind in ("scaled", "integer"):
            scale, offset = (0.0005, 100.0) if kind == "scaled" else (1.0, 0.0)
            local = 1000 * local if kind == "integer" else local
            steps = np.rint((local - offset) / scale).astype(int)
            low = int(steps.min())
            high = low + (1 << 19) - 1
            said = f'type="ScaledInteger" minimum="{low}" maximum="{high}" scale="{scale}" offset="{offset}"'
            said = said if kind == "scaled" else f'type="Integer" minimum="{low}" maximum="{high}"'
            for axis, values in zip(axes, steps.T, strict=True):
                fields.append((f"<{axis} {said}>{low}</{axis}>", bits([int(value) - low for value in values], 19)))
        else:
            precision, code = ("double", "<f8") if kind == "double" else ("single", "<f4")
            for axis, values in zip(axes, local.T, strict=True):
                low, high = float(values.min()), float(values.max())
                ends = f'minimum="{low!r}" maximum="{high!r}"' if kind == "double" else ""
                fields.append((f'<{axis} type="Float" precision="{precision}" {ends}/>', values.astype(code).tobytes()))
        if kind == "spherical":
            flat = np.hypot(local[:, 0], local[:, 1])
            angles = np.hypot(flat, local[:, 2]), np.arctan2(local[:, 1], local[:, 0]), np.arctan2(local[:, 2], flat)
            names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
            fields = [
                (f'<{name} type="Float"/>', values.astype("<f8").tobytes()) for name, values in zip(names, angles, strict=True)
            ]
        if kind == "invalid":
            state = [2 * (i % 7 == 0) for i in range(n)]
            fields.append(('<cartesianInvalidState type="Integer" minimum="0" maximum="2"/>', bits(state, 2)))
        fields += [
            ('<intensity type="Integer" minimum="-3" maximum="1000"/>', bits(rng.integers(0, 1004, n).tolist(), 10)),
            ('<returnCount type="Integer" minimum="1" maximum="1">1</returnCount>', b""),
            ('<who:wide type="Integer"/>', rng.integers(-(2**62), 2**62, n).astype("<i8").tobytes()),
            (f'<who:long type="Integer" minimum="0" maximum="{2**60 - 1}"/>', bits(rng.integers(0, 2**60, n).tolist(), 60)),
        ]  # fmt: skip
        turn = "".join(
            f"<{name} type='Float'>{value}</{name}>" for name, value in (("w", "8e-1"), ("x", ""), ("y", ""), ("z", "6e-1"))
        )
        shift = "<translation type='Structure'><x type='Float'>1e2</x><y type='Float'/></translation>"
        pose = f"<pose type='Structure'><rotation type='Structure'>{turn}</rotation>{shift}</pose>"
        at = section([stream for _, stream in fields], 3)
        grouped = ""
        if groups:
            rows = section([bits([0, n // 2], 16), bits([n // 2, n - n // 2], 16)], 1)
            grouped = (
                '<pointGroupingSchemes type="Structure"><groupingByLine type="Structure">'
                f'<groups type="CompressedVector" fileOffset="{rows}" recordCount="2"><prototype type="Structure">'
                '<startPointIndex type="Integer" minimum="0" maximum="65535"/>'
                '<pointCount type="Integer" minimum="0" maximum="65535"/>'
                "</prototype><codecs type='Vector' allowHeterogeneousChildren='1'/></groups>"
                "</groupingByLine></pointGroupingSchemes>"
            )
        stations.append(
            f'  <vectorChild type="Structure"><guid type="String"><![CDATA[{{station {number}}}]]></guid>'
            f"<temperature type='Float'>2e1</temperature> <!-- a > b -->{pose if number else ''}"
            '<cartesianBounds type="Structure"><xMinimum type="Float">-1e-1</xMinimum><xMaximum type="Float"/></cartesianBounds>'
            f'{grouped}<points type="CompressedVector" recordCount="{n}" fileOffset = "{at}">'
            f'<prototype type="Structure">{"".join(said for said, _ in fields)}</prototype>'
            '<codecs type="Vector" allowHeterogeneousChildren="1"/></points></vectorChild>\n'
        )
    pictures = ""
    if image:
        data.extend(bytes(-len(data) % 4))
        pictures = (
            '<images2D type="Vector" allowHeterogeneousChildren="1"><vectorChild type="Structure">'
            '<visualReferenceRepresentation type="Structure">'
            f'<jpegImage type="Blob" fileOffset="{physical(len(data))}" length="{len(image)}"/>'
            "</visualReferenceRepresentation></vectorChild></images2D>"
        )
        data.extend(struct.pack("<B7xQ", 0, 16 + len(image)) + image)
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0"'
        " xmlns:who='urn:who'>\n<formatName type='String'><![CDATA[ASTM E57 3D Imaging Data File]]></formatName>"
        "<guid type='String'>{file}</guid><versionMajor type='Integer'>1</versionMajor><versionMinor type='Integer'/>"
        f'<data3D type="Vector" allowHeterogeneousChildren="1">\n{"".join(stations)}</data3D>{pictures}</e57Root>'
    ).encode()
    data.extend(bytes(-len(data) % 4))
    length = -(-(len(data) + len(xml)) // (page - 4)) * page
    head = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, length, physical(len(data)), len(xml), page)
    return e57_pages(head + bytes(data[48:]) + xml, page)
