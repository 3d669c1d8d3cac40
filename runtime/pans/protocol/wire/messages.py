"""The wire protocol's messages, version 1: named tuples to bytes and back, for both ends (docs/reference/protocol.md specifies them).

`encode_*` return bytes ready to send; `decode_*` turn a frame's payload into a named tuple or raise `MalformedMessage`, which callers
count. The names of schema.py and framing.py are offered from here too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgpack
import numpy as np
import numpy.typing as npt

from .framing import Frame as Frame
from .framing import FrameDecoder as FrameDecoder
from .framing import encode_frame as encode_frame
from .framing import pack_body as pack_body
from .framing import unpack_body as unpack_body
from .schema import ADAPTIVE_PATTERN as ADAPTIVE_PATTERN
from .schema import BLOCK_HEADER_BYTES as BLOCK_HEADER_BYTES
from .schema import DARK_PATTERN as DARK_PATTERN
from .schema import FACTS, FROM_DEVICE, MAX_ACK_TEXT_BYTES, MAX_WELCOME_BYTES, narrow_fields
from .schema import MAX_PAYLOAD_BYTES as MAX_PAYLOAD_BYTES
from .schema import NO_OBJECT as NO_OBJECT
from .schema import PROTOCOL_VERSION as PROTOCOL_VERSION
from .schema import SCHEMA as SCHEMA
from .schema import SLOT_DTYPE as SLOT_DTYPE
from .schema import STRUCTS as STRUCTS
from .schema import UNKNOWN_TRUTH as UNKNOWN_TRUTH
from .schema import AckStatus as AckStatus
from .schema import DeviceState as DeviceState
from .schema import MalformedMessage as MalformedMessage
from .schema import MessageType as MessageType
from .schema import Opcode as Opcode
from .schema import StateReason as StateReason

EXPOSURE_BYTES = 3  # of COUNTS: the pattern shown, and the number
_CHECKED = {name: narrow_fields(name) for name in FROM_DEVICE}
U16 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint8]


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
    """Cumulative: every command up to `last_id` has been dealt with; `refused_id` names the latest refused one (0: none).

    Bit i of `refused_mask` says that command `last_id - i` was refused, so that no refusal is lost with an acknowledgement.
    """

    last_id: int
    refused_id: int
    status: int
    text: str
    refused_mask: int = 0

    def refuses(self, command_id: int) -> bool:
        """Whether this acknowledgement says that `command_id` was refused."""
        behind = self.last_id - command_id
        return command_id == self.refused_id or (0 <= behind < 32 and bool(self.refused_mask >> behind & 1))


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


class Exposed(NamedTuple):
    """What the latest `exposures` were off the plan at most, in ticks, and the numbers since ARM of those that were."""

    exposures: int
    start_error: int  # above 0: it began late
    length_error: int  # above 0: it was too long
    start_exposure: int
    length_exposure: int

    def joined(self, later: Exposed) -> Exposed:
        """Return what this and a later one tell together; the first of equal errors stays.

        >>> Exposed(3, 0, -2, 0, 1).joined(Exposed(2, 5, 2, 4, 3))
        Exposed(exposures=5, start_error=5, length_error=-2, start_exposure=4, length_exposure=1)
        """
        start = max(self[1::2], later[1::2], key=lambda one: abs(one[0]))
        length = max(self[2::2], later[2::2], key=lambda one: abs(one[0]))
        return Exposed(self.exposures + later.exposures, start[0], length[0], start[1], length[1])


class ClickBlock(NamedTuple):
    """Consecutive, equally spaced exposures of one detector: one bit and one shown pattern index each.

    `patterns` is uint16 (count,); `bits` is uint8 (count,) of 0 or 1. With `largest` above 1 it came as COUNTS, and `bits` are
    photon numbers from 0 to `largest`, which stands for that many or more.
    """

    seq: int
    drops: int
    tick: int
    exposure_index: int
    period_ticks: int
    object_index: int
    patterns: U16
    bits: U8
    largest: int = 1


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
    does); else -1 and NaN. `half_exposures` is 0 for an object that stands still; for one that passes by, `exposure_index` and `tick` are
    those at which it is centred, `photons` is what that exposure expects, and it has left the field this many exposures later.
    """

    seq: int
    object_index: int
    truth: int
    exposure_index: int
    tick: int
    photons: float
    half_exposures: int = 0


def fields(name: str, payload: bytes, *, exact: bool = True) -> tuple[Any, ...]:
    """Unpack the struct of layout `name` from the start of `payload`.

    MalformedMessage when it is too short (or, `exact`, too long), or when a device sent what the message dictionary does not allow.
    """
    layout = STRUCTS[name]
    if len(payload) < layout.size or (exact and len(payload) != layout.size):
        raise MalformedMessage(f"{name} has {len(payload)} bytes, expected {'' if exact else 'at least '}{layout.size}")
    values = layout.unpack_from(payload)
    for place, field in _CHECKED.get(name, ()):
        if not field.allows(values[place]):
            low, high = field.range
            raise MalformedMessage(f"{name}: {field.name} is {values[place]}, allowed {low} to {high}")
    return values


def encode_hello(session: int) -> bytes:
    """Return the frame that opens session `session` (a nonce the host draws, not 0)."""
    return encode_frame(MessageType.HELLO, STRUCTS["HELLO"].pack(SCHEMA, PROTOCOL_VERSION), session)


def encode_welcome(facts: Mapping[str, Any], session: int) -> bytes:
    """Return the device's answer to HELLO; `facts` is a flat map, at most MAX_WELCOME_BYTES of msgpack."""
    body = msgpack.packb(dict(facts))
    if len(body) > MAX_WELCOME_BYTES:
        raise MalformedMessage(f"WELCOME facts have {len(body)} bytes, allowed {MAX_WELCOME_BYTES}")
    return encode_frame(MessageType.WELCOME, STRUCTS["WELCOME"].pack(SCHEMA, PROTOCOL_VERSION) + body, session)


def decode_welcome(payload: bytes) -> Welcome:
    """Decode WELCOME; msgpack limits are set before anything is allocated."""
    schema, protocol = fields("WELCOME", payload, exact=False)
    body = payload[STRUCTS["WELCOME"].size :]
    if len(body) > MAX_WELCOME_BYTES:
        raise MalformedMessage(f"WELCOME facts have {len(body)} bytes, allowed {MAX_WELCOME_BYTES}")
    if schema != SCHEMA:
        return Welcome(schema, protocol, {})
    try:
        facts = msgpack.unpackb(
            body, max_str_len=256, max_bin_len=256, max_array_len=64, max_map_len=64, max_ext_len=0, strict_map_key=True,
            object_pairs_hook=_flat_map,
        )  # fmt: skip
    except Exception as error:  # msgpack raises many kinds, a plain ValueError among them
        raise MalformedMessage(f"WELCOME facts are no msgpack map: {error}") from None
    if not isinstance(facts, dict):
        raise MalformedMessage(f"WELCOME facts are a {type(facts).__name__}, expected a map")
    return Welcome(schema, protocol, facts)


def _flat_map(pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
    """Return the map of `pairs`; what is no text, boolean or finite number is left out, unless the protocol names its key."""
    facts = dict(pairs)
    if len(facts) < len(pairs):
        raise MalformedMessage("a key stands twice")
    if not all(isinstance(key, str) for key in facts):
        raise MalformedMessage("a key is no text")
    plain = (str, bool, int)
    return {
        key: value
        for key, value in facts.items()
        if key in FACTS or isinstance(value, plain) or (isinstance(value, float) and math.isfinite(value))
    }


def encode_ping(probe_id: int, host_ns: int, session: int) -> bytes:
    """Return a clock probe stamped with the host's nanoseconds."""
    return encode_frame(MessageType.PING, STRUCTS["PING"].pack(probe_id, host_ns), session)


def encode_pong(pong: Pong, session: int) -> bytes:
    """Return the device's answer to a probe."""
    return encode_frame(MessageType.PONG, STRUCTS["PONG"].pack(*pong), session)


def decode_pong(payload: bytes) -> Pong:
    """Decode PONG."""
    pong = Pong(*fields("PONG", payload))
    if pong.tx_tick < pong.rx_tick:
        raise MalformedMessage(f"PONG left at tick {pong.tx_tick}, before PING came at {pong.rx_tick}")
    return pong


def encode_command(command_id: int, opcode: int, body: bytes, session: int) -> bytes:
    """Return a numbered command; `body` comes from one of the `pack_*` functions."""
    return encode_frame(MessageType.COMMAND, STRUCTS["COMMAND"].pack(command_id, opcode) + body, session)


def decode_command(payload: bytes) -> CommandMessage:
    """Decode COMMAND; the body stays packed."""
    command_id, opcode = fields("COMMAND", payload, exact=False)
    return CommandMessage(command_id, opcode, payload[STRUCTS["COMMAND"].size :])


def encode_ack(ack: Ack, session: int) -> bytes:
    """Return a cumulative acknowledgement; the text is cut at MAX_ACK_TEXT_BYTES."""
    text = ack.text.encode("utf-8")[:MAX_ACK_TEXT_BYTES]
    head = STRUCTS["ACK"].pack(ack.last_id, ack.refused_id, ack.refused_mask, ack.status, len(text))
    return encode_frame(MessageType.ACK, head + text, session)


def decode_ack(payload: bytes) -> Ack:
    """Decode ACK."""
    last_id, refused_id, mask, status, size = fields("ACK", payload, exact=False)
    text = payload[STRUCTS["ACK"].size :]
    if len(text) != size or size > MAX_ACK_TEXT_BYTES:
        raise MalformedMessage(f"ACK text has {len(text)} bytes, announced {size}, allowed {MAX_ACK_TEXT_BYTES}")
    if refused_id > last_id or (status and not refused_id):
        raise MalformedMessage(f"ACK of command {last_id} names {refused_id} as refused, with status {status}")
    return Ack(last_id, refused_id, status, text.decode("utf-8", "replace"), mask)


def encode_grant(grant: Grant, session: int) -> bytes:
    """Return a receive-window and lease message; idempotent, never acknowledged."""
    return encode_frame(MessageType.GRANT, STRUCTS["GRANT"].pack(*grant), session)


def encode_status(status: Status, session: int) -> bytes:
    """Return the device's state."""
    return encode_frame(MessageType.STATUS, STRUCTS["STATUS"].pack(*status), session)


def decode_status(payload: bytes) -> Status:
    """Decode STATUS."""
    return Status(*fields("STATUS", payload))


def encode_exposed(exposed: Exposed, session: int) -> bytes:
    """Return when exposures happened; sent directly before a STATUS."""
    return encode_frame(MessageType.EXPOSED, STRUCTS["EXPOSED"].pack(*exposed), session)


def decode_exposed(payload: bytes) -> Exposed:
    """Decode EXPOSED."""
    return Exposed(*fields("EXPOSED", payload))


def encode_clicks(block: ClickBlock, session: int) -> bytes:
    """Return a sequential block: CLICKS, or COUNTS where `block.largest` is above 1."""
    head, patterns = (*block[:5], len(block.patterns)), block.patterns.astype("<u2").tobytes()
    if block.largest > 1:
        payload = STRUCTS["COUNTS"].pack(*head, block.largest, block.object_index) + patterns
        return encode_frame(MessageType.COUNTS, payload + block.bits.astype(np.uint8).tobytes(), session)
    payload = STRUCTS["CLICKS"].pack(*head, block.object_index) + patterns
    return encode_frame(MessageType.CLICKS, payload + np.packbits(block.bits, bitorder="little").tobytes(), session)


def decode_clicks(payload: bytes) -> ClickBlock:
    """Decode CLICKS; the arrays are fresh copies."""
    seq, drops, tick, first, period, count, object_index = fields("CLICKS", payload, exact=False)
    expected = BLOCK_HEADER_BYTES + 2 * count + (count + 7) // 8
    if len(payload) != expected:
        raise MalformedMessage(f"CLICKS of {count} exposures has {len(payload)} bytes, expected {expected}")
    patterns = np.frombuffer(payload, "<u2", count, BLOCK_HEADER_BYTES).astype(np.uint16)
    packed = np.frombuffer(payload, np.uint8, -1, BLOCK_HEADER_BYTES + 2 * count)
    bits = np.unpackbits(packed, count=count, bitorder="little")
    return ClickBlock(seq, drops, tick, first, period, object_index, patterns, bits)


def encode_frames(block: FrameBlock, session: int) -> bytes:
    """Return a parallel frame block."""
    count, word_bytes = block.words.shape
    head = STRUCTS["FRAMES"].pack(*block[:5], count, word_bytes, block.object_index)
    return encode_frame(MessageType.FRAMES, head + block.words.tobytes(), session)


def decode_frames(payload: bytes) -> FrameBlock:
    """Decode FRAMES; `words` is a read-only view of the payload."""
    seq, drops, tick, first, period, count, word_bytes, object_index = fields("FRAMES", payload, exact=False)
    expected = BLOCK_HEADER_BYTES + count * word_bytes
    if len(payload) != expected:
        raise MalformedMessage(
            f"FRAMES of {count} words of {word_bytes} bytes has {len(payload)} bytes, expected {expected}"
        )
    words = np.frombuffer(payload, np.uint8, count * word_bytes, BLOCK_HEADER_BYTES)
    return FrameBlock(seq, drops, tick, first, period, object_index, words.reshape(count, word_bytes))


def decode_counts(payload: bytes) -> ClickBlock:
    """Decode COUNTS; the arrays are fresh copies. A number above the block's largest is malformed."""
    seq, drops, tick, first, period, count, largest, object_index = fields("COUNTS", payload, exact=False)
    expected = BLOCK_HEADER_BYTES + EXPOSURE_BYTES * count
    if len(payload) != expected:
        raise MalformedMessage(f"COUNTS of {count} exposures has {len(payload)} bytes, expected {expected}")
    patterns = np.frombuffer(payload, "<u2", count, BLOCK_HEADER_BYTES).astype(np.uint16)
    numbers = np.frombuffer(payload, np.uint8, count, BLOCK_HEADER_BYTES + 2 * count).copy()
    most = int(numbers.max())
    if most > largest:
        raise MalformedMessage(f"COUNTS holds the photon number {most}, its largest is {largest}")
    return ClickBlock(seq, drops, tick, first, period, object_index, patterns, numbers, largest)


def encode_mark(mark: Mark, session: int) -> bytes:
    """Return an object mark."""
    return encode_frame(MessageType.MARK, STRUCTS["MARK"].pack(*mark[:3], mark.half_exposures, *mark[3:6]), session)


def decode_mark(payload: bytes) -> Mark:
    """Decode MARK."""
    seq, object_index, truth, half_exposures, exposure_index, tick, photons = fields("MARK", payload)
    return Mark(seq, object_index, truth, exposure_index, tick, photons, half_exposures)


STREAM_DECODERS: Mapping[int, Callable[[bytes], ClickBlock | FrameBlock | Mark]] = {
    MessageType.CLICKS: decode_clicks,
    MessageType.FRAMES: decode_frames,
    MessageType.MARK: decode_mark,
    MessageType.COUNTS: decode_counts,
}
DECODERS: Mapping[int, Callable[[bytes], Any]] = {  # of all that a device sends
    MessageType.WELCOME: decode_welcome,
    MessageType.PONG: decode_pong,
    MessageType.ACK: decode_ack,
    MessageType.STATUS: decode_status,
    MessageType.EXPOSED: decode_exposed,
    **STREAM_DECODERS,
}
