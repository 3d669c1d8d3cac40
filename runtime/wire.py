"""The wire protocol, version 1: bytes <-> messages, sans-I/O, both ends (docs/PROTOCOL.md is its specification).

Owns framing (COBS, CRC-32), the message layouts and their limits. Never reads a clock, opens a port or keeps click state.
`encode_*` return bytes ready to send, `FrameDecoder.feed` returns whole frames and counts what was damaged, `decode_*` turn a
frame's payload into a named tuple or raise `MalformedMessage`, which callers count: damage is a measurement, not a failure.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import msgpack
import numpy as np
import numpy.typing as npt

from .errors import PansError

PROTOCOL_VERSION = 1
MAX_PAYLOAD_BYTES = 65536
MAX_WELCOME_BYTES = 4096
MAX_ACK_TEXT_BYTES = 512
DARK_PATTERN = 0xFFFF
UNKNOWN_TRUTH = -1
NO_OBJECT = 0xFFFFFFFF

U16 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint8]


class MalformedMessage(PansError):
    """A frame whose CRC is right but whose payload cannot be meant; counted by the receiver, never fatal."""


class MessageType(IntEnum):
    """First byte of every frame; host to device below 0x80."""

    HELLO = 0x01
    PING = 0x02
    COMMAND = 0x03
    GRANT = 0x04
    WELCOME = 0x81
    PONG = 0x82
    ACK = 0x83
    STATUS = 0x84
    CLICKS = 0x90
    FRAMES = 0x91
    MARK = 0x92


class Opcode(IntEnum):
    """What a COMMAND asks for."""

    LOAD_PATTERN = 0x01
    LOAD_PLAN = 0x02
    ARM = 0x03
    STOP = 0x04
    RESET = 0x05
    GATE = 0x06


class DeviceState(IntEnum):
    """State in STATUS: IDLE takes uploads, ARMED waits for its start tick, RUNNING measures, SAFE is dark until RESET."""

    IDLE = 0
    ARMED = 1
    RUNNING = 2
    SAFE = 3


class StateReason(IntEnum):
    """Why the device is in its state."""

    NONE = 0
    COMPLETED = 1
    STOPPED = 2
    LEASE_EXPIRED = 3
    POWER_ON = 4
    FAULT = 5


class AckStatus(IntEnum):
    """Outcome of the command named by `refused_id`."""

    DONE = 0
    UNKNOWN_OPCODE = 1
    MALFORMED = 2
    OUT_OF_RANGE = 3
    WRONG_STATE = 4
    TOO_LATE = 5


# Layouts, in the order of the fields of the tuples below. The schema hash is computed from this table, so that a change to any
# layout makes the two ends refuse each other at the handshake instead of misreading each other's bytes.
_LAYOUTS: dict[str, str] = {
    "HEADER": "<BBHI",
    "HELLO": "<IHH",
    "WELCOME": "<IHH",
    "PING": "<IQ",
    "PONG": "<IQQQ",
    "COMMAND": "<IBBH",
    "ACK": "<IIHH",
    "GRANT": "<II",
    "STATUS": "<BBHIIQQ",
    "CLICKS": "<IIQQIHHI",
    "FRAMES": "<IIQQIHHI",
    "MARK": "<IIhHQQf",
    "LOAD_PATTERN": "<HHII",
    "LOAD_PLAN": "<BBHIIIIQHHI",
    "PLAN_SLOT": "<QHH",
    "ARM": "<QQII",
    "GATE": "<QIHH",
}
SCHEMA_TEXT = f"pans-wire/{PROTOCOL_VERSION};" + ";".join(f"{name}={layout}" for name, layout in _LAYOUTS.items())
SCHEMA = zlib.crc32(SCHEMA_TEXT.encode("ascii"))
_STRUCT = {name: struct.Struct(layout) for name, layout in _LAYOUTS.items()}
_HEADER = _STRUCT["HEADER"]
_UNSEEDED = (MessageType.HELLO, MessageType.WELCOME)  # readable across versions, so that a mismatch can be named
SLOT_DTYPE = np.dtype([("offset_ticks", "<u8"), ("pattern", "<u2"), ("shot", "<u2")])
BLOCK_HEADER_BYTES = _STRUCT["CLICKS"].size
MAX_FRAME_BYTES = _HEADER.size + MAX_PAYLOAD_BYTES + 4 + (MAX_PAYLOAD_BYTES + 12) // 254 + 2


class Frame(NamedTuple):
    """One whole frame whose CRC was right."""

    type: int
    flags: int
    session: int
    payload: bytes


class Welcome(NamedTuple):
    """The device's answer to HELLO: what it is and what it can hold."""

    schema: int
    protocol: int
    facts: Mapping[str, Any]


class Hello(NamedTuple):
    """The host's opening: its schema hash and protocol version."""

    schema: int
    protocol: int


class Ping(NamedTuple):
    """A clock probe, stamped by the host in nanoseconds of its own clock."""

    probe_id: int
    host_ns: int


class Pong(NamedTuple):
    """The probe returned, with the device ticks of its arrival and departure."""

    probe_id: int
    host_ns: int
    rx_tick: int
    tx_tick: int


class CommandMessage(NamedTuple):
    """One numbered command; ids count from 1 within a session and are executed in order, once."""

    command_id: int
    opcode: int
    body: bytes


class Ack(NamedTuple):
    """Cumulative: every command up to `last_id` has been dealt with; `refused_id` names the latest refused one (0: none)."""

    last_id: int
    refused_id: int
    status: int
    text: str


class Grant(NamedTuple):
    """Receive window and lease: stream messages with a sequence below `stream_limit` (mod 2^32) may be sent."""

    stream_limit: int
    lease_ms: int


class Status(NamedTuple):
    """The device's state, sent on every change and at least once per second."""

    state: int
    reason: int
    lease_left_ms: int
    drops: int
    tick: int
    next_exposure: int


class ClickBlock(NamedTuple):
    """Consecutive, equally spaced exposures of one detector: one bit and one shown pattern index each.

    `patterns` is uint16 (count,); `bits` is uint8 (count,) of 0 or 1.
    """

    seq: int
    drops: int
    tick: int
    exposure_index: int
    period_ticks: int
    object_index: int
    patterns: U16
    bits: U8


class FrameBlock(NamedTuple):
    """Consecutive exposures of d_f detectors: `words` is uint8 (count, word_bytes), bit i of a word (LSB first) is channel i."""

    seq: int
    drops: int
    tick: int
    exposure_index: int
    period_ticks: int
    object_index: int
    words: U8


class Mark(NamedTuple):
    """From `exposure_index` on, object `object_index` stands before the detector.

    `truth` is its class and `photons` the expected photoelectrons of one shot on it, where the instrument knows them (a simulator
    does); else -1 and NaN.
    """

    seq: int
    object_index: int
    truth: int
    exposure_index: int
    tick: int
    photons: float


# ---------------------------------------------------------------------------------------------------------------- framing


def cobs_encode(data: bytes) -> bytes:
    """Return `data` without any zero byte (Cheshire and Baker 1999), at most 1 + len/254 bytes longer; no delimiter added."""
    out = bytearray()
    for run in data.split(b"\0"):
        while len(run) >= 254:
            out += b"\xff" + run[:254]
            run = run[254:]
        out.append(len(run) + 1)
        out += run
    return bytes(out)


def cobs_decode(data: bytes) -> bytes | None:
    """Invert `cobs_encode`; None when `data` (without its delimiter) is no COBS string."""
    out = bytearray()
    position, size = 0, len(data)
    while position < size:
        code = data[position]
        end = position + code
        if code == 0 or end > size:
            return None
        out += data[position + 1 : end]
        position = end
        if code != 0xFF and position < size:
            out.append(0)
    return bytes(out)


def _crc_seed(message_type: int) -> int:
    return 0 if message_type in _UNSEEDED else SCHEMA


def pack_body(frame: Frame) -> bytes:
    """Return header and payload as they stood inside the frame: what a recording keeps."""
    return _HEADER.pack(frame.type, frame.flags, 0, frame.session) + frame.payload


def unpack_body(body: bytes) -> Frame:
    """Invert `pack_body`; MalformedMessage when there is no whole header."""
    if len(body) < _HEADER.size:
        raise MalformedMessage(f"a message has {len(body)} bytes, at least {_HEADER.size} expected")
    message_type, flags, _, session = _HEADER.unpack_from(body)
    return Frame(message_type, flags, session, body[_HEADER.size :])


def encode_frame(message_type: int, payload: bytes, session: int, flags: int = 0) -> bytes:
    """Return one frame ready to send, delimiter included; `MalformedMessage` above MAX_PAYLOAD_BYTES."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise MalformedMessage(f"payload has {len(payload)} bytes, allowed {MAX_PAYLOAD_BYTES}")
    body = pack_body(Frame(message_type, flags, session, payload))
    crc = zlib.crc32(body, _crc_seed(message_type))
    # A run that ends exactly at a 254-byte boundary would cost one code byte more; cobs_encode keeps the plain form.
    return cobs_encode(body + crc.to_bytes(4, "little")) + b"\0"


@dataclass(slots=True)
class DecoderCounters:
    """What the decoder has seen since it was made; every byte is in a good frame or counted as discarded."""

    frames: int = 0
    bytes_in: int = 0
    crc_errors: int = 0
    cobs_errors: int = 0
    short_frames: int = 0
    oversized_frames: int = 0
    bytes_discarded: int = 0


class FrameDecoder:
    """Incremental decoder of one direction of a link; holds at most MAX_FRAME_BYTES and resynchronises at every delimiter."""

    def __init__(self) -> None:
        self.counters = DecoderCounters()
        self._buffer = bytearray()
        self._skipping = False

    def feed(self, data: bytes | bytearray | memoryview) -> list[Frame]:
        """Return the frames that `data` completes, in order; damaged ones are counted and dropped."""
        self.counters.bytes_in += len(data)
        *ended, rest = bytes(data).split(b"\0")
        frames: list[Frame] = []
        for piece in ended:
            self._append(piece)
            if not self._skipping and self._buffer:
                frame = self._decode(bytes(self._buffer))
                if frame is not None:
                    frames.append(frame)
            self._buffer.clear()
            self._skipping = False
        self._append(rest)
        return frames

    def _append(self, piece: bytes) -> None:
        if self._skipping:
            self.counters.bytes_discarded += len(piece)
        elif len(self._buffer) + len(piece) > MAX_FRAME_BYTES:
            self.counters.oversized_frames += 1
            self.counters.bytes_discarded += len(self._buffer) + len(piece)
            self._buffer.clear()
            self._skipping = True
        else:
            self._buffer += piece

    def _decode(self, raw: bytes) -> Frame | None:
        counters = self.counters
        body = cobs_decode(raw)
        if body is None:
            counters.cobs_errors += 1
        elif len(body) < _HEADER.size + 4:
            counters.short_frames += 1
        elif zlib.crc32(body[:-4], _crc_seed(body[0])) != int.from_bytes(body[-4:], "little"):
            counters.crc_errors += 1
        else:
            counters.frames += 1
            return unpack_body(body[:-4])
        counters.bytes_discarded += len(raw) + 1
        return None


# --------------------------------------------------------------------------------------------------------------- messages


def _fields(name: str, payload: bytes, *, exact: bool = True) -> tuple[Any, ...]:
    layout = _STRUCT[name]
    if len(payload) < layout.size or (exact and len(payload) != layout.size):
        raise MalformedMessage(f"{name} has {len(payload)} bytes, expected {'' if exact else 'at least '}{layout.size}")
    return layout.unpack_from(payload)


def encode_hello(session: int) -> bytes:
    """Return the frame that opens session `session` (a nonce the host draws, not 0)."""
    return encode_frame(MessageType.HELLO, _STRUCT["HELLO"].pack(SCHEMA, PROTOCOL_VERSION, 0), session)


def decode_hello(payload: bytes) -> Hello:
    """Decode HELLO; a longer payload of a later version is accepted so that the mismatch can be named."""
    schema, protocol, _ = _fields("HELLO", payload, exact=False)
    return Hello(schema, protocol)


def encode_welcome(facts: Mapping[str, Any], session: int) -> bytes:
    """Return the device's answer to HELLO; `facts` is a flat map, at most MAX_WELCOME_BYTES of msgpack."""
    body = msgpack.packb(dict(facts))
    if len(body) > MAX_WELCOME_BYTES:
        raise MalformedMessage(f"WELCOME facts have {len(body)} bytes, allowed {MAX_WELCOME_BYTES}")
    return encode_frame(MessageType.WELCOME, _STRUCT["WELCOME"].pack(SCHEMA, PROTOCOL_VERSION, 0) + body, session)


def decode_welcome(payload: bytes) -> Welcome:
    """Decode WELCOME; msgpack limits are set before anything is allocated."""
    schema, protocol, _ = _fields("WELCOME", payload, exact=False)
    body = payload[_STRUCT["WELCOME"].size :]
    if len(body) > MAX_WELCOME_BYTES:
        raise MalformedMessage(f"WELCOME facts have {len(body)} bytes, allowed {MAX_WELCOME_BYTES}")
    if schema != SCHEMA:
        return Welcome(schema, protocol, {})
    try:
        facts = msgpack.unpackb(
            body, max_str_len=256, max_bin_len=256, max_array_len=64, max_map_len=64, max_ext_len=0, strict_map_key=True
        )
    except Exception as error:  # msgpack raises many kinds, a plain ValueError among them
        raise MalformedMessage(f"WELCOME facts are no msgpack map: {error}") from None
    if not isinstance(facts, dict):
        raise MalformedMessage(f"WELCOME facts are a {type(facts).__name__}, expected a map")
    return Welcome(schema, protocol, facts)


def encode_ping(probe_id: int, host_ns: int, session: int) -> bytes:
    """Return a clock probe stamped with the host's nanoseconds."""
    return encode_frame(MessageType.PING, _STRUCT["PING"].pack(probe_id, host_ns), session)


def decode_ping(payload: bytes) -> Ping:
    """Decode PING."""
    return Ping(*_fields("PING", payload))


def encode_pong(pong: Pong, session: int) -> bytes:
    """Return the device's answer to a probe."""
    return encode_frame(MessageType.PONG, _STRUCT["PONG"].pack(*pong), session)


def decode_pong(payload: bytes) -> Pong:
    """Decode PONG."""
    return Pong(*_fields("PONG", payload))


def encode_command(command_id: int, opcode: int, body: bytes, session: int) -> bytes:
    """Return a numbered command; `body` comes from one of the `pack_*` functions."""
    return encode_frame(MessageType.COMMAND, _STRUCT["COMMAND"].pack(command_id, opcode, 0, 0) + body, session)


def decode_command(payload: bytes) -> CommandMessage:
    """Decode COMMAND; the body stays packed."""
    command_id, opcode, _, _ = _fields("COMMAND", payload, exact=False)
    return CommandMessage(command_id, opcode, payload[_STRUCT["COMMAND"].size :])


def encode_ack(ack: Ack, session: int) -> bytes:
    """Return a cumulative acknowledgement; the text is cut at MAX_ACK_TEXT_BYTES."""
    text = ack.text.encode("utf-8")[:MAX_ACK_TEXT_BYTES]
    return encode_frame(
        MessageType.ACK, _STRUCT["ACK"].pack(ack.last_id, ack.refused_id, ack.status, len(text)) + text, session
    )


def decode_ack(payload: bytes) -> Ack:
    """Decode ACK."""
    last_id, refused_id, status, size = _fields("ACK", payload, exact=False)
    text = payload[_STRUCT["ACK"].size :]
    if len(text) != size or size > MAX_ACK_TEXT_BYTES:
        raise MalformedMessage(f"ACK text has {len(text)} bytes, announced {size}, allowed {MAX_ACK_TEXT_BYTES}")
    return Ack(last_id, refused_id, status, text.decode("utf-8", "replace"))


def encode_grant(grant: Grant, session: int) -> bytes:
    """Return a receive-window and lease message; idempotent, never acknowledged."""
    return encode_frame(MessageType.GRANT, _STRUCT["GRANT"].pack(*grant), session)


def decode_grant(payload: bytes) -> Grant:
    """Decode GRANT."""
    return Grant(*_fields("GRANT", payload))


def encode_status(status: Status, session: int) -> bytes:
    """Return the device's state."""
    packed = _STRUCT["STATUS"].pack(status.state, status.reason, 0, *status[2:])
    return encode_frame(MessageType.STATUS, packed, session)


def decode_status(payload: bytes) -> Status:
    """Decode STATUS."""
    state, reason, _, *rest = _fields("STATUS", payload)
    return Status(state, reason, *rest)


def encode_clicks(block: ClickBlock, session: int) -> bytes:
    """Return a sequential click block."""
    count = len(block.patterns)
    head = _STRUCT["CLICKS"].pack(*block[:5], count, 0, block.object_index)
    bits = np.packbits(block.bits, bitorder="little").tobytes()
    return encode_frame(MessageType.CLICKS, head + block.patterns.astype("<u2").tobytes() + bits, session)


def decode_clicks(payload: bytes) -> ClickBlock:
    """Decode CLICKS; the arrays are fresh copies."""
    seq, drops, tick, first, period, count, _, object_index = _fields("CLICKS", payload, exact=False)
    expected = BLOCK_HEADER_BYTES + 2 * count + (count + 7) // 8
    if count == 0 or len(payload) != expected:
        raise MalformedMessage(f"CLICKS of {count} exposures has {len(payload)} bytes, expected {expected}")
    patterns = np.frombuffer(payload, "<u2", count, BLOCK_HEADER_BYTES).astype(np.uint16)
    packed = np.frombuffer(payload, np.uint8, -1, BLOCK_HEADER_BYTES + 2 * count)
    bits = np.unpackbits(packed, count=count, bitorder="little")
    return ClickBlock(seq, drops, tick, first, period, object_index, patterns, bits)


def encode_frames(block: FrameBlock, session: int) -> bytes:
    """Return a parallel frame block."""
    count, word_bytes = block.words.shape
    head = _STRUCT["FRAMES"].pack(*block[:5], count, word_bytes, block.object_index)
    return encode_frame(MessageType.FRAMES, head + block.words.tobytes(), session)


def decode_frames(payload: bytes) -> FrameBlock:
    """Decode FRAMES; `words` is a read-only view of the payload."""
    seq, drops, tick, first, period, count, word_bytes, object_index = _fields("FRAMES", payload, exact=False)
    expected = BLOCK_HEADER_BYTES + count * word_bytes
    if count == 0 or word_bytes == 0 or len(payload) != expected:
        raise MalformedMessage(
            f"FRAMES of {count} words of {word_bytes} bytes has {len(payload)} bytes, expected {expected}"
        )
    words = np.frombuffer(payload, np.uint8, count * word_bytes, BLOCK_HEADER_BYTES)
    return FrameBlock(seq, drops, tick, first, period, object_index, words.reshape(count, word_bytes))


def encode_mark(mark: Mark, session: int) -> bytes:
    """Return an object mark."""
    packed = _STRUCT["MARK"].pack(*mark[:3], 0, *mark[3:])
    return encode_frame(MessageType.MARK, packed, session)


def decode_mark(payload: bytes) -> Mark:
    """Decode MARK."""
    seq, object_index, truth, _, *rest = _fields("MARK", payload)
    return Mark(seq, object_index, truth, *rest)
