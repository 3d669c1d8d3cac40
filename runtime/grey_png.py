"""Plain grey pictures of 8 and 16 bits as PNG (W3C PNG specification), written and read without an imaging library.

All other kinds are refused; what is written may have colours. Sizes are checked before anything is unpacked.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DamagedFileError

PNG_MARK = b"\x89PNG\r\n\x1a\n"
SIDE_MAX = 1 << 14


def levels_png(levels: NDArray[np.unsignedinteger[Any]], count: int) -> bytes:
    """Return levels (height, width), each below `count`, as PNG with the highest level white: 8 bits for up to 256 levels, else 16."""
    top, kind = (255, np.uint8) if count <= 256 else (65535, np.uint16)
    return png_bytes(np.rint(levels * (top / max(count - 1, 1))).astype(kind))


def png_bytes(grey: NDArray[np.unsignedinteger[Any]], colours: NDArray[np.uint8] | None = None) -> bytes:
    """Return a grey picture, uint8 or uint16 (height, width), as PNG.

    With `colours`, RGB (256, 3), the bytes are numbers of these; number 0 is transparent.
    """
    depth, kind = 8 * grey.itemsize, 0 if colours is None else 3
    rows = grey.astype(grey.dtype.newbyteorder(">")).view(np.uint8).reshape(len(grey), -1)
    raw = np.hstack([np.zeros((len(rows), 1), np.uint8), rows])  # filter 0 before each row
    head = struct.pack(">IIBBBBB", grey.shape[1], grey.shape[0], depth, kind, 0, 0, 0)
    palette = [] if colours is None else [(b"PLTE", colours.tobytes()), (b"tRNS", b"\0")]
    chunks = [(b"IHDR", head), *palette, (b"IDAT", zlib.compress(raw.tobytes(), 9)), (b"IEND", b"")]
    return PNG_MARK + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def read_grey_png(data: bytes, where: str) -> NDArray[np.float64]:
    """Return a plain grey PNG (8 or 16 bits, not interlaced) as float64 (height, width), white 1; DamagedFileError for any other."""
    try:
        return _decoded(data)
    except (ValueError, struct.error, zlib.error) as error:
        raise DamagedFileError(
            f"{where}: not a readable grey PNG: {error}", remedy="save it as 8-bit or 16-bit grey, without transparency"
        ) from error


def _decoded(data: bytes) -> NDArray[np.float64]:
    chunks = list(_chunks(data))
    if not chunks or chunks[0][0] != b"IHDR" or chunks[-1][0] != b"IEND":
        raise ValueError("it does not begin with its header, or does not end with its end")
    width, height, depth, colour, *ways = struct.unpack(">IIBBBBB", chunks[0][1])
    if not (1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX):
        raise ValueError(f"{width} x {height} pixels, allowed 1 to {SIDE_MAX} each")
    if colour != 0 or depth not in (8, 16) or any(ways):
        raise ValueError(
            f"colour type {colour}, {depth} bits, interlacing {ways[-1]}; allowed: grey, 8 or 16 bits, none"
        )
    row_bytes = 1 + width * depth // 8
    packed = b"".join(body for kind, body in chunks if kind == b"IDAT")
    raw = zlib.decompressobj().decompress(packed, row_bytes * height + 1)
    if len(raw) != row_bytes * height:
        raise ValueError(f"{len(raw)} bytes of pixels, its size needs {row_bytes * height}")
    rows = _unfiltered(np.frombuffer(raw, np.uint8).reshape(height, row_bytes), depth // 8)
    return rows.view(np.uint8 if depth == 8 else np.dtype(">u2")).astype(np.float64) / ((1 << depth) - 1)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    if not data.startswith(PNG_MARK):
        raise ValueError("it does not begin as a PNG does")
    at = len(PNG_MARK)
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        (sum_,) = struct.unpack_from(">I", data, at + 8 + length)
        if sum_ != zlib.crc32(kind + body):
            raise ValueError(f"the checksum of its part {kind!r} is wrong")
        yield kind, body
        at += 12 + length


def _unfiltered(rows: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Undo the five filters of PNG (PNG specification, section 9), byte by byte where a byte needs the one before it."""
    out = np.zeros((len(rows), rows.shape[1] - 1), np.uint8)
    above = np.zeros(rows.shape[1] - 1, np.int64)
    for number, row in enumerate(rows):
        kind, line = int(row[0]), row[1:].astype(np.int64)
        if kind == 2:
            line = line + above
        elif kind in (1, 3, 4):
            for at in range(len(line)):
                left = int(line[at - step]) if at >= step else 0
                corner = int(above[at - step]) if at >= step else 0
                line[at] = (int(line[at]) + _guess(kind, left, int(above[at]), corner)) & 0xFF
        elif kind != 0:
            raise ValueError(f"filter {kind}, allowed 0 to 4")
        above = line & 0xFF
        out[number] = above
    return out


def _guess(kind: int, left: int, above: int, corner: int) -> int:
    if kind == 1:
        return left
    if kind == 3:
        return (left + above) // 2
    return min((left, above, corner), key=lambda near: abs(left + above - corner - near))
