"""Protocol 1 in tables: message types, states, limits and byte layouts (docs/reference/protocol.md is its specification).

Owns the numbers that both ends must agree on, and the schema hash made from the fields (fields.py); never encodes a message (messages.py
does) and never frames one (framing.py does).
"""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum

import numpy as np

from pans.runtime.errors import PansError

from .fields import AUTOMATON_MESSAGES, COUNT_MESSAGES, MESSAGES, layout

PROTOCOL_VERSION = 1
MAX_PAYLOAD_BYTES = 65536
MAX_WELCOME_BYTES = 4096
MAX_ACK_TEXT_BYTES = 512
DARK_PATTERN = 0xFFFF
ADAPTIVE_PATTERN = 0xFFFE  # in a slot of a plan: what is shown there, the clicks before decide
UNKNOWN_TRUTH = -1
NO_OBJECT = 0xFFFFFFFF


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


# The schema hash is computed from the layouts of fields.py, in its order, so that a change to any of them makes the two ends refuse each
# other at the handshake instead of misreading each other's bytes.
LAYOUTS: dict[str, str] = {name: layout(name) for name in MESSAGES}
SCHEMA_TEXT = f"pans-wire/{PROTOCOL_VERSION};" + ";".join(f"{name}={layout}" for name, layout in LAYOUTS.items())
SCHEMA = zlib.crc32(SCHEMA_TEXT.encode("ascii"))
AUTOMATON_LAYOUTS: dict[str, str] = {name: layout(name) for name in AUTOMATON_MESSAGES}
AUTOMATON_SCHEMA_TEXT = "pans-automaton/1;" + ";".join(f"{name}={layout}" for name, layout in AUTOMATON_LAYOUTS.items())
AUTOMATON_SCHEMA = zlib.crc32(AUTOMATON_SCHEMA_TEXT.encode("ascii"))
COUNT_LAYOUTS: dict[str, str] = {name: layout(name) for name in COUNT_MESSAGES}
COUNT_SCHEMA_TEXT = "pans-counts/1;" + ";".join(f"{name}={layout}" for name, layout in COUNT_LAYOUTS.items())
COUNT_SCHEMA = zlib.crc32(COUNT_SCHEMA_TEXT.encode("ascii"))
STRUCTS = {name: struct.Struct(layout) for name, layout in {**LAYOUTS, **AUTOMATON_LAYOUTS, **COUNT_LAYOUTS}.items()}
HEADER = STRUCTS["HEADER"]
UNSEEDED = (MessageType.HELLO, MessageType.WELCOME)  # readable across versions, so that a mismatch can be named
SLOT_DTYPE = np.dtype([("offset_ticks", "<u8"), ("pattern", "<u2"), ("shot", "<u2")])
STATE_DTYPE = np.dtype([("pattern", "<u2"), ("dwell", "<u2"), ("next_dark", "<u4"), ("next_click", "<u4")])
# What CLICKS, FRAMES and COUNTS begin with, and MARK, behind the header of their frame; `width` is word_bytes, largest or nothing.
BLOCK_DTYPE = np.dtype(
    [
        *(("type", "u1"), ("flags", "u1"), ("reserved", "<u2"), ("session", "<u4")),
        *(("seq", "<u4"), ("drops", "<u4"), ("tick", "<u8"), ("exposure_index", "<u8")),
        *(("period_ticks", "<u4"), ("count", "<u2"), ("width", "<u2"), ("object_index", "<u4")),
    ]
)
MARK_DTYPE = np.dtype(
    [
        *BLOCK_DTYPE.descr[:4],
        *(("seq", "<u4"), ("object_index", "<u4"), ("truth", "<i2"), ("half_exposures", "<u2")),
        *(("exposure_index", "<u8"), ("tick", "<u8"), ("photons", "<f4")),
    ]
)
BLOCK_HEADER_BYTES = STRUCTS["CLICKS"].size
MAX_FRAME_BYTES = HEADER.size + MAX_PAYLOAD_BYTES + 4 + (MAX_PAYLOAD_BYTES + 12) // 254 + 2
