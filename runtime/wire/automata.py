"""Bodies of the extension for automata: pack on the host, unpack on the device (docs/reference/protocol.md, section 11).

Owns the layouts of LOAD_MASKS, LOAD_STATES and SHOW, and what a device announces of itself; never builds an automaton. `pack_*` return
bytes for `wire.encode_command`, `unpack_*` return named tuples or raise `MalformedMessage`. Sizes are checked before anything is allocated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .fields import U16_MAX
from .messages import MAX_PAYLOAD_BYTES, STRUCTS, MalformedMessage, fields
from .schema import AUTOMATON_SCHEMA, STATE_DTYPE

MAX_STATES_PER_CHUNK = 4096
# What the host puts into one command: a fifth of a second at 40 kB/s, so that even a slow line acknowledges it before it is repeated.
MASK_BYTES = 8192
STATES_PER_COMMAND = 680
U8 = npt.NDArray[np.uint8]


class Extension(NamedTuple):
    """What a device says of automata: most states (0: it follows none, the host names every state), and steps of a dwell time."""

    states: int
    dwell_steps: int


class MaskChunk(NamedTuple):
    """Patterns of two levels from number `first_pattern` on: rows uint8 (n, bytes), bit i (LSB first) is pixel `first_pixel` + i.

    `pixels` of the `n_pixels` of each pattern stand here; those of more than one pattern are whole.
    """

    first_pattern: int
    first_pixel: int
    n_pixels: int
    pixels: int
    rows: U8


class StateChunk(NamedTuple):
    """The automaton's header and some of its states; `states` has STATE_DTYPE (pattern, dwell, next_dark, next_click)."""

    n_states: int
    first_state: int
    dwell_steps: int
    n_leaves: int
    states: npt.NDArray[Any]


class Show(NamedTuple):
    """In exposure `exposure_index`, show `pattern` for dwell / dwell_steps of it and stamp it `state`."""

    exposure_index: int
    state: int
    pattern: int
    dwell: int
    dwell_steps: int


def announced(facts: Mapping[str, Any]) -> Extension | None:
    """Return what WELCOME's map says of automata; None of a device that knows none, or another version of them.

    >>> announced({"tick_hz": 1000}) is None
    True
    """
    if facts.get("automaton_schema") != AUTOMATON_SCHEMA:
        return None
    return Extension(int(facts.get("automaton_states", 0)), int(facts.get("dwell_steps", 1)))


def announcement(extension: Extension) -> dict[str, int]:
    """Return the keys of WELCOME's map that `announced` reads."""
    schema = {"automaton_schema": AUTOMATON_SCHEMA}
    return schema | {"automaton_states": extension.states, "dwell_steps": extension.dwell_steps}


def pack_masks(chunk: MaskChunk) -> bytes:
    """Return the body of LOAD_MASKS."""
    head = (chunk.first_pattern, len(chunk.rows), chunk.first_pixel, chunk.n_pixels, chunk.pixels)
    return STRUCTS["LOAD_MASKS"].pack(*head) + chunk.rows.tobytes()


def unpack_masks(body: bytes) -> MaskChunk:
    """Invert `pack_masks`; `rows` is a read-only view of the body."""
    first, count, first_pixel, n_pixels, pixels = fields("LOAD_MASKS", body, exact=False)
    size, rest = STRUCTS["LOAD_MASKS"].size, len(body) - STRUCTS["LOAD_MASKS"].size
    row_bytes = (pixels + 7) // 8
    whole = first_pixel == 0 and pixels == n_pixels
    if not count or not pixels or rest != count * row_bytes or first_pixel + pixels > n_pixels:
        text = f"LOAD_MASKS holds {rest} bytes of {count} masks with {pixels} pixels from pixel {first_pixel} of {n_pixels}"
        raise MalformedMessage(text)
    if count > 1 and not whole:
        raise MalformedMessage(f"LOAD_MASKS holds pieces of {count} patterns, allowed: one piece, or whole patterns")
    rows = np.frombuffer(body, np.uint8, rest, size).reshape(count, row_bytes)
    return MaskChunk(first, first_pixel, n_pixels, pixels, rows)


def mask_chunks(levels: npt.NDArray[Any]) -> Iterator[MaskChunk]:
    """Cut patterns of the levels 0 and 1, (n, pixels), into LOAD_MASKS of about MASK_BYTES."""
    n_patterns, n_pixels = levels.shape
    per_command = min(MASK_BYTES // ((n_pixels + 7) // 8), U16_MAX)
    if per_command:
        for first in range(0, n_patterns, per_command):
            rows = np.packbits(levels[first : first + per_command] != 0, axis=1, bitorder="little")
            yield MaskChunk(first, 0, n_pixels, n_pixels, rows)
        return
    for number in range(n_patterns):
        for first in range(0, n_pixels, 8 * MASK_BYTES):
            piece = levels[number : number + 1, first : first + 8 * MASK_BYTES] != 0
            rows = np.packbits(piece, axis=1, bitorder="little")
            yield MaskChunk(number, first, n_pixels, piece.shape[1], rows)


def pack_states(chunk: StateChunk) -> bytes:
    """Return the body of LOAD_STATES."""
    head = STRUCTS["LOAD_STATES"].pack(chunk.n_states, chunk.first_state, chunk.dwell_steps, 0, chunk.n_leaves)
    return head + chunk.states.astype(STATE_DTYPE).tobytes()


def unpack_states(body: bytes) -> StateChunk:
    """Invert `pack_states`."""
    n_states, first, dwell_steps, _, n_leaves = fields("LOAD_STATES", body, exact=False)
    size = STRUCTS["LOAD_STATES"].size
    count, odd = divmod(len(body) - size, STATE_DTYPE.itemsize)
    if odd or not 0 < count <= MAX_STATES_PER_CHUNK or first + count > n_states or len(body) > MAX_PAYLOAD_BYTES:
        raise MalformedMessage(f"LOAD_STATES holds {len(body) - size} bytes of states from state {first} of {n_states}")
    return StateChunk(n_states, first, dwell_steps, n_leaves, np.frombuffer(body, STATE_DTYPE, count, size).copy())


def pack_show(show: Show) -> bytes:
    """Return the body of SHOW."""
    return STRUCTS["SHOW"].pack(*show)


def unpack_show(body: bytes) -> Show:
    """Invert `pack_show`."""
    return Show(*fields("SHOW", body))
