"""Bodies of the protocol's commands, and what a device announces of the extensions (docs/reference/protocol.md, sections 4, 11, 13, 14).

Named tuples become bytes for `encode_command` by `pack_command`, and bytes named tuples again by `unpack_command`, which raises
`MalformedMessage`. `announced*` read WELCOME's map, `*announcement` make its keys.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from .messages import U8, U16, fields
from .schema import (
    AUTOMATON_SCHEMA,
    COUNT_SCHEMA,
    EXPOSED_SCHEMA,
    MAX_PHOTON_NUMBER,
    SLOT_DTYPE,
    STRUCTS,
    U16_MAX,
    MalformedMessage,
    Opcode,
)

SEQUENTIAL, PARALLEL = 0, 1
MODES = {"sequential": SEQUENTIAL, "parallel": PARALLEL}
MAX_PIXELS_PER_CHUNK = 4096
MAX_SLOTS_PER_CHUNK = 1024
MAX_STATES_PER_CHUNK = 4096
# What the host puts into one command: a fifth of a second at 40 kB/s, so that even a slow line acknowledges it before it is repeated.
MASK_BYTES = 8192
STATE_BYTES_PER_COMMAND = 8160


class PatternChunk(NamedTuple):
    """Part of one pattern: levels uint16 (n,) of the pixels from `first_pixel` on, of `n_pixels` in the whole pattern."""

    pattern: int
    first_pixel: int
    n_pixels: int
    levels: U16


class PlanChunk(NamedTuple):
    """The schedule's header and some of its slots; `slots` has SLOT_DTYPE (offset_ticks, pattern, shot)."""

    mode: int
    n_patterns: int
    n_slots: int
    first_slot: int
    exposure_ticks: int
    slot_period_ticks: int
    cycle_ticks: int
    block_exposures: int
    cycles_per_object: int
    slots: npt.NDArray[Any]


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
    """The automaton's header and some of its states, of `state_dtype(outcomes)`; two outcomes are no click and a click."""

    n_states: int
    first_state: int
    dwell_steps: int
    outcomes: int
    n_leaves: int
    states: npt.NDArray[Any]

    @property
    def opcode(self) -> Opcode:
        """The command that loads them."""
        return Opcode.LOAD_COUNT_STATES if self.outcomes > 2 else Opcode.LOAD_STATES


class Arm(NamedTuple):
    """Start at `start_tick`, run `n_cycles` cycles (0: until STOP), stay armed for `lease_ms` after each renewal."""

    start_tick: int
    n_cycles: int
    lease_ms: int


class Gate(NamedTuple):
    """Open output `channel` at `tick` for `duration_ticks`; refused when the tick has passed."""

    tick: int
    duration_ticks: int
    channel: int


class Show(NamedTuple):
    """In exposure `exposure_index`, show `pattern` for dwell / dwell_steps of it and stamp it `state`."""

    exposure_index: int
    state: int
    pattern: int
    dwell: int
    dwell_steps: int


class ReadCounts(NamedTuple):
    """What READ_COUNTS asks for: numbers up to `largest`, of one detector that counts (`channels` 0) or the clicks of so many detectors."""

    largest: int
    channels: int = 0


class Extension(NamedTuple):
    """What a device says of automata: most states (0: it follows none, the host names every state), and steps of a dwell time."""

    states: int
    dwell_steps: int


Command = PatternChunk | MaskChunk | PlanChunk | StateChunk | Arm | Gate | Show | ReadCounts
T = TypeVar("T")
_LAYOUTS: Mapping[Any, str] = {
    **{PatternChunk: "LOAD_PATTERN", PlanChunk: "LOAD_PLAN", MaskChunk: "LOAD_MASKS"},
    **{Arm: "ARM", Gate: "GATE", Show: "SHOW", ReadCounts: "READ_COUNTS"},
}
# the rows behind a command's header: their layout, the most of them, and where the header has the first one and how many there are
_ROWS: Mapping[Any, tuple[np.dtype[Any], int, int, int]] = {
    PatternChunk: (np.dtype("<u2"), MAX_PIXELS_PER_CHUNK, 1, 2),
    PlanChunk: (SLOT_DTYPE, MAX_SLOTS_PER_CHUNK, 3, 2),
}


def pack_command(command: Command) -> bytes:
    """Return the body of a COMMAND."""
    if isinstance(command, StateChunk):
        head = command[: 4 if command.outcomes > 2 else 3] + command[4:5]
        return STRUCTS[command.opcode.name].pack(*head) + command.states.astype(state_dtype(command.outcomes)).tobytes()
    pack = STRUCTS[_LAYOUTS[type(command)]].pack
    if isinstance(command, MaskChunk):
        first_pattern, *pixels, rows = command
        return pack(first_pattern, len(rows), *pixels) + rows.tobytes()
    if isinstance(command, (PatternChunk, PlanChunk)):
        return pack(*command[:-1]) + command[-1].astype(_ROWS[type(command)][0]).tobytes()
    return pack(*command)


def unpack_command(kind: Callable[..., T], body: bytes) -> T:
    """Return the body of a COMMAND as a `kind`: any named tuple of this module but StateChunk, see `unpack_states`."""
    name = _LAYOUTS[kind]
    if kind is MaskChunk:
        return kind(*_unpacked_masks(body))
    if kind not in _ROWS:
        return kind(*fields(name, body))
    head = fields(name, body, exact=False)
    return kind(*head, _rows(name, body, head, *_ROWS[kind]))


def unpack_states(opcode: int, body: bytes) -> StateChunk:
    """Return the body of LOAD_STATES or LOAD_COUNT_STATES."""
    name = Opcode(opcode).name
    n_states, first, dwell_steps, *counted, n_leaves = fields(name, body, exact=False)
    outcomes = counted[0] if counted else 2
    if counted and not 3 <= outcomes <= MAX_PHOTON_NUMBER + 1:
        raise MalformedMessage(f"{name} of {outcomes} outcomes, allowed 3 to {MAX_PHOTON_NUMBER + 1}")
    rows = _rows(name, body, (n_states, first), state_dtype(outcomes), MAX_STATES_PER_CHUNK, 1, 0)
    return StateChunk(n_states, first, dwell_steps, outcomes, n_leaves, rows)


def _rows(
    name: str, body: bytes, head: tuple[int, ...], dtype: np.dtype[Any], most: int, first: int, total: int
) -> npt.NDArray[Any]:
    """Return a copy of the rows behind the header of `body`; their number is checked before anything is allocated."""
    size = STRUCTS[name].size
    count, odd = divmod(len(body) - size, dtype.itemsize)
    if odd or not 0 < count <= most or head[first] + count > head[total]:
        raise MalformedMessage(f"{name} holds {len(body) - size} bytes of rows from {head[first]} of {head[total]}")
    return np.frombuffer(body, dtype, count, size).copy()


def _unpacked_masks(body: bytes) -> MaskChunk:
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


def state_dtype(outcomes: int) -> np.dtype[Any]:
    """The layout of one state: pattern, dwell, and `next`, the successors after 0, 1, ... `outcomes` - 1 photons."""
    return np.dtype([("pattern", "<u2"), ("dwell", "<u2"), ("next", "<u4", (outcomes,))])


def cut_states(header: tuple[int, int, int, int], states: npt.NDArray[Any]) -> list[StateChunk]:
    """Cut the states of an automaton into commands; `header` holds its states, dwell steps, outcomes and leaves."""
    n_states, dwell_steps, outcomes, n_leaves = header
    step = STATE_BYTES_PER_COMMAND // states.itemsize
    return [
        StateChunk(n_states, first, dwell_steps, outcomes, n_leaves, states[first : first + step])
        for first in range(0, n_states, step)
    ]


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


def announced_counts(facts: Mapping[str, Any]) -> int:
    """Return the largest photon number that a device tells by WELCOME's map; 1 of one that only clicks, or that speaks another version.

    >>> announced_counts({"photon_number_max": 15}), announced_counts({"count_schema": COUNT_SCHEMA, "photon_number_max": 15})
    (1, 15)
    """
    return int(facts.get("photon_number_max", 1)) if facts.get("count_schema") == COUNT_SCHEMA else 1


def announced_channels(facts: Mapping[str, Any]) -> int:
    """Return how many detectors a device reads at once by WELCOME's map; 1 of one that does not, or that speaks another version."""
    return int(facts.get("channels_at_once", 1)) if facts.get("count_schema") == COUNT_SCHEMA else 1


def announces_exposed(facts: Mapping[str, Any]) -> bool:
    """Whether a device tells when exposures happened, by WELCOME's map; the EXPOSED of another one mean nothing."""
    return bool(facts.get("exposed_schema") == EXPOSED_SCHEMA)


def count_announcement(largest: int, channels: int = 1) -> dict[str, int]:
    """Return the keys of WELCOME's map that `announced_counts` and `announced_channels` read; none of a device with neither."""
    numbers = {"photon_number_max": largest, "channels_at_once": channels}
    found = {key: value for key, value in numbers.items() if value > 1}
    return {"count_schema": COUNT_SCHEMA, **found} if found else {}
