"""The message dictionary of protocol 1 (docs/reference/protocol.md): fields, ranges, units, WELCOME's keys, and the tables made from them.

messages.py checks with them what a device sends, kernels.py does so in compiled code, and tests/runtime/protocol/wire/test_fields.py
compares them with the document. What a field must be beside the others, the plan or the clock is not here: decide/follower.py and
protocol/clock.py judge that.

The largest numbers of the whole path:

- ticks and exposure numbers are below 2^63 on the wire. Kernels take those below 2^62 (`kernels.LARGEST`), so that the
  longest block, 65535 exposures of 2^32 - 1 ticks, stays within int64; what is above goes through Python's integers.
- rows of the decision log hold ticks and exposure numbers as uint64: no sum of the above reaches 2^64.
- counters that wrap (sequence, drops) are uint32 and compared modulo 2^32.
- times become float64 only as differences from a recent probe; 2^53 ns are 104 days.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from pans.base.errors import PansError

_BITS = {"B": 8, "H": 16, "I": 32, "Q": 64}
LARGEST_TICK = (1 << 63) - 1
MAX_LEASE_MS = 3_600_000
U16_MAX, U32_MAX = (1 << 16) - 1, (1 << 32) - 1
MAX_STATES = 0xFFFD  # of an automaton: the two numbers above mean "chosen by the clicks" and "dark"
MAX_LEAVES = 1 << 20
MAX_PHOTON_NUMBER = 15  # of one reading: beyond it the bins of a real detector overlap (instrument/click_law.py)
MAX_CHANNELS_AT_ONCE = 4  # their clicks are a number of COUNTS, up to 15


class Field(NamedTuple):
    """One field: its code in the notation of `struct`, and the range `low`..`high` whatever the plan is (None: all that fits).

    A real number may also be NaN, "not known". `title` is its name in the protocol's tables.
    """

    name: str
    code: str
    title: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None

    @property
    def span(self) -> tuple[float, float]:
        """What the layout can hold: integers of the code's bits, or every finite real number."""
        if self.code == "f":
            return -math.inf, math.inf
        half = 1 << _BITS[self.code.upper()] - 1
        return (-half, half - 1) if self.code.islower() else (0, 2 * half - 1)

    @property
    def range(self) -> tuple[float, float]:
        """The least and the largest value that can be meant."""
        low, high = self.span
        return low if self.low is None else self.low, high if self.high is None else self.high

    def allows(self, value: float) -> bool:
        """Whether `value` can be meant.

        >>> Field("photons", "f", low=0, high=3.4e38).allows(float("nan")), Field("tick", "Q", high=LARGEST_TICK).allows(1 << 63)
        (True, False)
        """
        low, high = self.range
        return low <= value <= high or value != value


def _reserved(code: str) -> Field:
    return Field("reserved", code)


def _tick(name: str, title: str) -> Field:
    return Field(name, "Q", title, "ticks", high=LARGEST_TICK)


_LARGEST_REAL = (2 - 2**-23) * 2.0**127  # of float32
_BLOCK = (
    Field("seq", "I", "sequence"),
    Field("drops", "I", "exposures dropped", "exposures"),
    _tick("tick", "tick of the first exposure"),
    Field("exposure_index", "Q", "number of the first exposure", "exposures", high=LARGEST_TICK),
    Field("period_ticks", "I", "ticks between exposures", "ticks", low=1),
    Field("count", "H", "exposures", "exposures", low=1),
)
_OBJECT = Field("object_index", "I", "object")
_PROBE = (Field("probe_id", "I", "probe id"), Field("host_ns", "Q", "host nanoseconds", "ns"))
_VERSION = (Field("schema", "I"), Field("protocol", "H"), _reserved("H"))
_FIRST_PIXEL = Field("first_pixel", "I", "first pixel", "pixels")
_ALL_PIXELS = Field("n_pixels", "I", "pixels in the whole pattern", "pixels", low=1)
_N_STATES = Field("n_states", "H", "states in all", "states", low=1, high=MAX_STATES)
_FIRST_STATE = Field("first_state", "H", "first state", high=MAX_STATES - 1)
_STEPS = Field("dwell_steps", "H", "dwell steps", "steps", low=1)
_LEAVES = Field("n_leaves", "I", "leaves", low=1, high=MAX_LEAVES)
_PATTERN = Field("pattern", "H", "pattern", high=U16_MAX - 1)
_DWELL = Field("dwell", "H", "dwell", "steps", low=1)
_LARGEST = Field("largest", "H", "largest number", "photons", low=2, high=MAX_PHOTON_NUMBER)


def _next(name: str, title: str) -> Field:
    return Field(name, "I", title, low=1, high=MAX_STATES + MAX_LEAVES - 1)


# In the order of the schema text: it is made from this table, and the two ends compare its checksum.
MESSAGES: Mapping[str, tuple[Field, ...]] = {
    "HEADER": (Field("type", "B"), Field("flags", "B"), _reserved("H"), Field("session", "I", "session", low=1)),
    "HELLO": _VERSION,
    "WELCOME": _VERSION,
    "PING": _PROBE,
    "PONG": (*_PROBE, _tick("rx_tick", "tick of arrival"), _tick("tx_tick", "of departure")),
    "COMMAND": (Field("command_id", "I", "command id", low=1), Field("opcode", "B"), _reserved("B"), _reserved("H")),
    "ACK": (
        Field("last_id", "I", "last id"),
        Field("refused_id", "I", "refused id"),
        Field("refused_mask", "I", "refused mask"),
        Field("status", "H", "status", high=5),
        Field("text_bytes", "H", unit="bytes", high=512),
    ),
    "GRANT": (
        Field("stream_limit", "I", "stream limit"),
        Field("lease_ms", "I", "lease in ms", "ms", high=MAX_LEASE_MS),
    ),
    "STATUS": (
        Field("state", "B", "state", high=3),
        Field("reason", "B", "reason", high=5),
        _reserved("H"),
        Field("lease_left_ms", "I", "lease left in ms", "ms", high=MAX_LEASE_MS),
        Field("drops", "I", "exposures dropped", "exposures"),
        _tick("tick", "tick"),
        Field("next_exposure", "Q", "next exposure", "exposures", high=LARGEST_TICK),
    ),
    "CLICKS": (*_BLOCK, _reserved("H"), _OBJECT),
    "FRAMES": (*_BLOCK, Field("word_bytes", "H", "bytes per word", "bytes", low=1), _OBJECT),
    "MARK": (
        Field("seq", "I"),
        Field("object_index", "I", "object"),
        Field("truth", "h", "truth", low=-1),
        Field("half_exposures", "H", "half", "exposures"),
        Field("exposure_index", "Q", "exposure", "exposures", high=LARGEST_TICK),
        _tick("tick", "tick"),
        Field("photons", "f", "expected photoelectrons", "photoelectrons", low=0.0, high=_LARGEST_REAL),
    ),
    "LOAD_PATTERN": (Field("index", "H", "index"), _reserved("H"), _FIRST_PIXEL, _ALL_PIXELS),
    "LOAD_PLAN": (
        Field("mode", "B", high=1),
        _reserved("B"),
        Field("n_patterns", "H", "patterns", low=1),
        Field("n_slots", "I", "slots in all", low=1),
        Field("first_slot", "I"),
        Field("exposure_ticks", "I", "exposure ticks", "ticks", low=1),
        Field("slot_period_ticks", "I", "ticks between exposures", "ticks", low=1),
        Field("cycle_ticks", "Q", "ticks of a cycle", "ticks", low=1, high=1 << 48),
        Field("block_exposures", "H", "exposures per block", "exposures", low=1),
        _reserved("H"),
        Field("cycles_per_object", "I", "cycles per object", "cycles", low=1),
    ),
    "PLAN_SLOT": (Field("offset_ticks", "Q", "start", "ticks"), Field("pattern", "H"), Field("shot", "H", "shot")),
    "ARM": (
        _tick("start_tick", "start tick"),
        Field("n_cycles", "Q", "cycles", "cycles"),
        Field("lease_ms", "I", "lease in ms", "ms", low=1, high=MAX_LEASE_MS),
        _reserved("I"),
    ),
    "GATE": (
        _tick("tick", "tick"),
        Field("duration_ticks", "I", "duration", "ticks", low=1),
        Field("channel", "H", "channel"),
        _reserved("H"),
    ),
}
# What a device may know beside version 1, in the order of its own schema text (protocol.md, section 11). Older devices do not announce it.
AUTOMATON_MESSAGES: Mapping[str, tuple[Field, ...]] = {
    "LOAD_MASKS": (
        Field("index", "H", "index of the first"),
        Field("count", "H", "masks", "patterns", low=1),
        _FIRST_PIXEL,
        _ALL_PIXELS,
        Field("pixels", "I", "pixels here", "pixels", low=1),
    ),
    "LOAD_STATES": (_N_STATES, _FIRST_STATE, _STEPS, _reserved("H"), _LEAVES),
    "STATE": (
        *(_PATTERN, _DWELL, _next("next_dark", "successor without a click")),
        _next("next_click", "successor after a click"),
    ),
    "SHOW": (
        Field("exposure_index", "Q", "exposure", "exposures", high=LARGEST_TICK),
        Field("state", "H", "state", high=MAX_STATES - 1),
        _PATTERN,
        _DWELL,
        _STEPS,
    ),
}
# The same for photon numbers (protocol.md, section 13).
COUNT_MESSAGES: Mapping[str, tuple[Field, ...]] = {
    "COUNTS": (*_BLOCK, _LARGEST, _OBJECT),
    "READ_COUNTS": (_LARGEST, Field("channels", "H", "detectors read at once", "detectors", high=MAX_CHANNELS_AT_ONCE)),
    "LOAD_COUNT_STATES": (
        *(_N_STATES, _FIRST_STATE, _STEPS),
        Field("outcomes", "H", "outcomes", "photon numbers", low=3, high=MAX_PHOTON_NUMBER + 1),
        _LEAVES,
    ),
    "COUNT_STATE": (_PATTERN, _DWELL),
    "COUNT_SUCCESSOR": (_next("next", "successor"),),
}
# The same for when exposures happened (protocol.md, section 15).
EXPOSED_MESSAGES: Mapping[str, tuple[Field, ...]] = {
    "EXPOSED": (
        Field("exposures", "I", "exposures", "exposures", low=1),
        Field("start_error", "i", "start error", "ticks"),
        Field("length_error", "i", "length error", "ticks"),
        Field("start_exposure", "Q", "number of the one", "exposures", high=LARGEST_TICK),
        Field("length_exposure", "Q", "of the other", "exposures", high=LARGEST_TICK),
    )
}
_WHOLE = {**MESSAGES, **AUTOMATON_MESSAGES, **COUNT_MESSAGES, **EXPOSED_MESSAGES}
# without what is reserved: those are 0 when sent and not looked at when they come
ALL_MESSAGES = {name: tuple(field for field in fields if field.name != "reserved") for name, fields in _WHOLE.items()}
# the host checks these; a device refuses commands itself
FROM_DEVICE = ("PONG", "ACK", "STATUS", "CLICKS", "FRAMES", "MARK", "COUNTS", "EXPOSED")


class Fact(NamedTuple):
    """One key of WELCOME's map: `kind` is int, bool or str; integers lie in `low`..`high`, text is one of `words` where there are any."""

    kind: type
    needed: bool = False
    low: int = 0
    high: int = 0
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Whether `value` can be meant; a boolean is no integer here."""
        if self.kind is int:
            return isinstance(value, int) and not isinstance(value, bool) and self.low <= value <= self.high
        return isinstance(value, self.kind) and (not self.words or value in self.words)


FACTS: Mapping[str, Fact] = {
    "tick_hz": Fact(int, True, 1000, 10**10),
    "mode": Fact(str, True, words=("sequential", "parallel")),
    "channels": Fact(int, True, 1, U16_MAX),
    "levels": Fact(int, True, 2, U16_MAX + 1),
    "pattern_memory": Fact(int, True, 0, U16_MAX),
    "pattern_pixels": Fact(int, True, 0, U32_MAX),
    "slot_memory": Fact(int, True, 1, U32_MAX),
    "epoch": Fact(int, False, 0, LARGEST_TICK),
    "tick": Fact(int, False, 0, LARGEST_TICK),
    "buffer_messages": Fact(int, False, 1, U32_MAX),
    "firmware": Fact(str),
    "serial": Fact(str),
    "simulated": Fact(bool),
    "optics_sha256": Fact(str),
    "objects": Fact(int, False, 0, U32_MAX),
    "scene_height_px": Fact(int, False, 1, U16_MAX),
    "scene_width_px": Fact(int, False, 1, U16_MAX),
    "scene_n_classes": Fact(int, False, 1, U16_MAX),
    "scene_classes": Fact(str),
    "scene_classes_sha256": Fact(str),
    "automaton_schema": Fact(int, False, 0, U32_MAX),
    "automaton_states": Fact(int, False, 0, MAX_STATES),
    "dwell_steps": Fact(int, False, 1, U16_MAX),
    "count_schema": Fact(int, False, 0, U32_MAX),
    "photon_number_max": Fact(int, False, 1, MAX_PHOTON_NUMBER),
    "channels_at_once": Fact(int, False, 1, MAX_CHANNELS_AT_ONCE),
    "exposed_schema": Fact(int, False, 0, U32_MAX),
}


def narrow_fields(name: str) -> tuple[tuple[int, Field], ...]:
    """Return place and field of those whose range is less than what their layout holds."""
    return tuple((place, field) for place, field in enumerate(ALL_MESSAGES[name]) if field.range != field.span)


def wrong_facts(facts: Mapping[str, Any]) -> list[str]:
    """Return one sentence for each of WELCOME's keys that is missing or holds what it cannot mean.

    >>> wrong_facts({"tick_hz": "1000000"})[0]
    "tick_hz is '1000000', allowed 1000 to 10000000000"
    """
    wrong = []
    for key, fact in FACTS.items():
        if key not in facts:
            wrong += [f"{key} is missing"] if fact.needed else []
        elif not fact.allows(facts[key]):
            wrong.append(f"{key} is {_shown(facts[key])}, allowed {_allowed(fact)}")
    return wrong


def _allowed(fact: Fact) -> str:
    if fact.kind is int:
        return f"{fact.low} to {fact.high}"
    return " or ".join(fact.words) or {str: "text", bool: "true or false"}[fact.kind]


def _shown(value: Any) -> str:
    text = ascii(value)
    return text if len(text) <= 40 else text[:40] + "..."


PROTOCOL_VERSION = 1
MAX_PAYLOAD_BYTES = 65536
MAX_WELCOME_BYTES = 4096
MAX_ACK_TEXT_BYTES = 512
DARK_PATTERN = 0xFFFF
ADAPTIVE_PATTERN = 0xFFFE  # in a slot of a plan: what is shown there, the clicks before decide
UNKNOWN_TRUTH = -1
NO_OBJECT = 0xFFFFFFFF
# a number further ahead is nonsense: believing it would mean seconds of empty windows at once
MAX_GAP_EXPOSURES = 1 << 18
# no device sends beyond the host's window, which begins at the next sequence number
RECEIVE_WINDOW = 4096


class MalformedMessage(PansError):
    """A frame whose CRC is right but whose payload makes no sense; counted by the receiver, never fatal."""


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
    EXPOSED = 0x85  # of the extension for when exposures happened
    CLICKS = 0x90
    FRAMES = 0x91
    MARK = 0x92
    COUNTS = 0x93  # of the extension for photon numbers


class Opcode(IntEnum):
    """What a COMMAND asks for."""

    LOAD_PATTERN = 0x01
    LOAD_PLAN = 0x02
    ARM = 0x03
    STOP = 0x04
    RESET = 0x05
    GATE = 0x06
    LOAD_MASKS = 0x07  # this and those below: of the extension for automata
    LOAD_STATES = 0x08
    SHOW = 0x09
    READ_COUNTS = 0x0A  # this and the one below: of the extension for photon numbers
    LOAD_COUNT_STATES = 0x0B


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


def _schema_text(head: str, messages: Mapping[str, tuple[Field, ...]]) -> str:
    return head + "".join(f";{name}=<{''.join(field.code for field in fields)}" for name, fields in messages.items())


def _struct(fields: tuple[Field, ...]) -> struct.Struct:
    """Return the layout of a message, in which what is reserved is padding."""
    codes = (f"{struct.calcsize(one.code)}x" if one.name == "reserved" else one.code for one in fields)
    return struct.Struct("<" + "".join(codes))


# The hash of a schema is that of its layouts in their order, so that a change to any of them makes the two ends refuse each
# other at the handshake instead of misreading each other's bytes.
SCHEMA_TEXT = _schema_text(f"pans-wire/{PROTOCOL_VERSION}", MESSAGES)
AUTOMATON_SCHEMA_TEXT = _schema_text("pans-automaton/1", AUTOMATON_MESSAGES)
COUNT_SCHEMA_TEXT = _schema_text("pans-counts/1", COUNT_MESSAGES)
EXPOSED_SCHEMA_TEXT = _schema_text("pans-exposed/1", EXPOSED_MESSAGES)
SCHEMA, AUTOMATON_SCHEMA, COUNT_SCHEMA, EXPOSED_SCHEMA = (
    zlib.crc32(text.encode("ascii"))
    for text in (SCHEMA_TEXT, AUTOMATON_SCHEMA_TEXT, COUNT_SCHEMA_TEXT, EXPOSED_SCHEMA_TEXT)
)
STRUCTS = {name: _struct(fields) for name, fields in _WHOLE.items()}
HEADER = STRUCTS["HEADER"]
UNSEEDED = (MessageType.HELLO, MessageType.WELCOME)  # readable across versions, so that a mismatch can be named
SLOT_DTYPE = np.dtype([("offset_ticks", "<u8"), ("pattern", "<u2"), ("shot", "<u2")])
# The fixed part of CLICKS, FRAMES and COUNTS, of MARK and of ACK, with the header; `width` is word_bytes, largest or nothing.
BLOCK_DTYPE, MARK_DTYPE, ACK_DTYPE = (
    np.dtype([(one.name.replace("word_bytes", "width"), f"<{one.code}") for one in (*_WHOLE["HEADER"], *_WHOLE[name])])
    for name in ("FRAMES", "MARK", "ACK")
)
BLOCK_HEADER_BYTES = STRUCTS["CLICKS"].size


def payload_offsets(dtype: np.dtype[np.void], *names: str, begin: int = HEADER.size) -> tuple[np.uint64, ...]:
    """Return the offsets of fields of BLOCK_DTYPE, MARK_DTYPE or ACK_DTYPE in the payload, uint64 as kernels add them.

    With `begin` 0 they are those in the body.

    >>> [int(offset) for offset in payload_offsets(BLOCK_DTYPE, "seq", "count")]
    [0, 28]
    """
    assert dtype.fields is not None
    return tuple(np.uint64(dtype.fields[name][1] - begin) for name in names)


MAX_FRAME_BYTES = HEADER.size + MAX_PAYLOAD_BYTES + 4 + (MAX_PAYLOAD_BYTES + 12) // 254 + 2
