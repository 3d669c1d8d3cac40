"""One field of a message that says something else: which one, from when on, and the payload with it.

Owns where each field of the message dictionary stands in a payload; never chooses a mutation and never judges one (trials/fields.py does).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import msgpack

from pans.runtime.wire.fields import ALL_MESSAGES, AUTOMATON_MESSAGES, Field
from pans.runtime.wire.frame import Frame
from pans.runtime.wire.messages import BLOCK_HEADER_BYTES, STRUCTS, MessageType, Opcode

COMMANDS = ("LOAD_PATTERN", "LOAD_PLAN", "ARM", "GATE", "READ_COUNTS", "LOAD_COUNT_STATES")
BODIES = {  # of commands: which of them holds the layout, and where in the payload it begins; of rows, the first
    **{name: (name, STRUCTS["COMMAND"].size) for name in (*COMMANDS, *AUTOMATON_MESSAGES)},
    "PLAN_SLOT": ("LOAD_PLAN", STRUCTS["COMMAND"].size + STRUCTS["LOAD_PLAN"].size),
    "STATE": ("LOAD_STATES", STRUCTS["COMMAND"].size + STRUCTS["LOAD_STATES"].size),
    "COUNT_STATE": ("LOAD_COUNT_STATES", STRUCTS["COMMAND"].size + STRUCTS["LOAD_COUNT_STATES"].size),
}
STAMP = "STAMP"  # not a message: the first pattern or state that is stamped in a block of clicks or of photon numbers
LAYOUTS = {**ALL_MESSAGES, STAMP: (Field("pattern", "H"),)}


class Mutation(NamedTuple):
    """In `message`s, from number `first` on and at most `most` of them, `name` becomes `change` of what it was.

    `name` is a field, or a key of WELCOME's map behind "map.". `words` say what the change is.
    """

    message: str
    name: str
    change: Callable[[Any], Any]
    words: str
    first: int = 0
    most: int = 1 << 30

    def __str__(self) -> str:
        return f"{self.message}.{self.name} {self.words}, from message {self.first} on, {self.most} of them"


def to(value: Any) -> tuple[Callable[[Any], Any], str]:
    """Return the change to `value`, and its words."""
    return lambda _: value, f"becomes {value!r}"


def by(step: int) -> tuple[Callable[[Any], Any], str]:
    """Return the change by `step`."""
    return lambda value: value + step, f"moves by {step}"


def is_of(frame: Frame, message: str) -> bool:
    """Whether a frame is of the kind whose fields stand under `message` in LAYOUTS."""
    if message in BODIES:
        return frame.type == MessageType.COMMAND and frame.payload[4] == Opcode[BODIES[message][0]]
    return frame.type in ((MessageType.CLICKS, MessageType.COUNTS) if message == STAMP else (MessageType[message],))


def _layout(mutation: Mutation) -> tuple[struct.Struct, int, int]:
    """The layout of the fields that `mutation` changes, where it begins in the payload, and the place of the field in it."""
    place = [one.name for one in LAYOUTS[mutation.message]].index(mutation.name)
    if mutation.message == STAMP:
        return struct.Struct("<H"), BLOCK_HEADER_BYTES, place
    return STRUCTS[mutation.message], BODIES.get(mutation.message, ("", 0))[1], place


def field_of(payload: bytes, mutation: Mutation) -> Any:
    """Return what stands in the field that `mutation` changes."""
    layout, start, place = _layout(mutation)
    return layout.unpack_from(payload, start)[place]


def mutate(payload: bytes, mutation: Mutation) -> bytes:
    """Return `payload` with one field changed; whatever does not fit the field's bits is cut to them."""
    if mutation.name.startswith("map."):
        head, facts = payload[: STRUCTS["WELCOME"].size], msgpack.unpackb(payload[STRUCTS["WELCOME"].size :])
        key = mutation.name[4:]
        value = mutation.change(facts.get(key))
        if value is MISSING:
            facts.pop(key, None)
        else:
            facts[key] = value
        return head + msgpack.packb(facts)
    layout, start, place = _layout(mutation)
    values = list(layout.unpack_from(payload, start))
    values[place] = fitted(LAYOUTS[mutation.message][place], mutation.change(values[place]))
    return payload[:start] + layout.pack(*values) + payload[start + layout.size :]


MISSING = object()


def fitted(field: Field, value: Any) -> Any:
    """Return `value` as the field's bits hold it."""
    if field.code == "f":
        return struct.unpack("<f", struct.pack("<f", value))[0]
    size = struct.calcsize(field.code)
    return int.from_bytes((int(value) % (1 << 8 * size)).to_bytes(size, "little"), "little", signed=field.code == "h")
