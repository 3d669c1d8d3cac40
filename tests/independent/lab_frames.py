"""Frames of the instrument protocol, as a lab would write them from docs/reference/protocol.md alone (sections 1 and 2)."""

from __future__ import annotations

import struct
import zlib

SCHEMA_TEXT = (
    "pans-wire/1;HEADER=<BBHI;HELLO=<IHH;WELCOME=<IHH;PING=<IQ;PONG=<IQQQ;COMMAND=<IBBH;ACK=<IIIHH;GRANT=<II;STATUS=<BBHIIQQ;"
    "CLICKS=<IIQQIHHI;FRAMES=<IIQQIHHI;MARK=<IIhHQQf;LOAD_PATTERN=<HHII;LOAD_PLAN=<BBHIIIIQHHI;PLAN_SLOT=<QHH;ARM=<QQII;GATE=<QIHH"
)
SCHEMA = zlib.crc32(SCHEMA_TEXT.encode())
PROTOCOL = 1
HELLO, PING, COMMAND, GRANT = 0x01, 0x02, 0x03, 0x04
WELCOME, PONG, ACK, STATUS, CLICKS, FRAMES, MARK, COUNTS = 0x81, 0x82, 0x83, 0x84, 0x90, 0x91, 0x92, 0x93
LONGEST_PAYLOAD = 65536
LONGEST_FRAME = LONGEST_PAYLOAD + 12 + LONGEST_PAYLOAD // 254 + 2

Message = tuple[int, int, bytes]  # type, session, payload


def cobs(data: bytes) -> bytes:
    """Return `data` without zero bytes."""
    out = bytearray()
    for run in data.split(b"\0"):
        rest = run
        while len(rest) >= 254:  # a full group ends without a zero; what follows it may be empty
            out += b"\xff" + rest[:254]
            rest = rest[254:]
        out += bytes([len(rest) + 1]) + rest
    return bytes(out)


def uncobs(data: bytes) -> bytes | None:
    """Invert `cobs`; None for what is no COBS string."""
    out, at = bytearray(), 0
    while at < len(data):
        code = data[at]
        group = data[at + 1 : at + code]
        if code == 0 or len(group) != code - 1 or 0 in group:
            return None
        out += group
        at += code
        if code < 255 and at < len(data):
            out.append(0)
    return bytes(out)


def frame(kind: int, payload: bytes, session: int) -> bytes:
    """Return one frame with its delimiter."""
    body = struct.pack("<BBHI", kind, 0, 0, session) + payload
    crc = zlib.crc32(body, 0 if kind in (HELLO, WELCOME) else SCHEMA)
    return cobs(body + struct.pack("<I", crc)) + b"\0"


def open_body(body: bytes) -> Message:
    """Return type, session and payload of a header with its payload."""
    kind, _, _, session = struct.unpack_from("<BBHI", body)
    return kind, session, body[8:]


class FrameCutter:
    """Bytes in any pieces -> whole messages; what is damaged is counted and dropped."""

    def __init__(self) -> None:
        self.damaged = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that end in `data`."""
        *pieces, rest = (self._rest + data).split(b"\0")
        self._rest = rest[: LONGEST_FRAME + 1]
        messages = [self._open(piece) for piece in pieces if piece]
        return [message for message in messages if message is not None]

    def _open(self, piece: bytes) -> Message | None:
        body = uncobs(piece) if len(piece) <= LONGEST_FRAME else None
        if body is None or len(body) < 12:
            self.damaged += 1
            return None
        seed = 0 if body[0] in (HELLO, WELCOME) else SCHEMA
        if zlib.crc32(body[:-4], seed) != int.from_bytes(body[-4:], "little"):
            self.damaged += 1
            return None
        return open_body(body[:-4])
