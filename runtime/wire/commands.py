"""Bodies of the protocol's commands, and what a device announces of the extensions (docs/reference/protocol.md, sections 4, 11, 13, 14).

`pack_*` return bytes for `encode_command`; `unpack_*` return named tuples or raise `MalformedMessage`. `announced*` read WELCOME's map,
`*announcement` make its keys. Sizes are checked before anything is allocated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .messages import MAX_PAYLOAD_BYTES, SLOT_DTYPE, STRUCTS, U8, U16, MalformedMessage, fields
from .schema import AUTOMATON_SCHEMA, COUNT_SCHEMA, MAX_PHOTON_NUMBER, STATE_DTYPE, U16_MAX

SEQUENTIAL, PARALLEL = 0, 1
MODES = {"sequential": SEQUENTIAL, "parallel": PARALLEL}
MAX_PIXELS_PER_CHUNK = 4096
MAX_SLOTS_PER_CHUNK = 1024
MAX_STATES_PER_CHUNK = 4096
# What the host puts into one command: a fifth of a second at 40 kB/s, so that even a slow line acknowledges it before it is repeated.
MASK_BYTES = 8192
STATES_PER_COMMAND = 680
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
    """The automaton's header and some of its states; `states` has STATE_DTYPE (pattern, dwell, next_dark, next_click)."""

    n_states: int
    first_state: int
    dwell_steps: int
    n_leaves: int
    states: npt.NDArray[Any]


class CountStateChunk(NamedTuple):
    """The header of an automaton over photon numbers and some of its states, of `state_dtype(outcomes)`."""

    n_states: int
    first_state: int
    dwell_steps: int
    outcomes: int
    n_leaves: int
    states: npt.NDArray[Any]


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


def pack_pattern(chunk: PatternChunk) -> bytes:
    """Return the body of LOAD_PATTERN."""
    head = STRUCTS["LOAD_PATTERN"].pack(chunk.pattern, 0, chunk.first_pixel, chunk.n_pixels)
    return head + chunk.levels.astype("<u2").tobytes()


def unpack_pattern(body: bytes) -> PatternChunk:
    """Invert `pack_pattern`."""
    pattern, _, first_pixel, n_pixels = fields("LOAD_PATTERN", body, exact=False)
    rest = len(body) - STRUCTS["LOAD_PATTERN"].size
    if rest == 0 or rest % 2 or rest // 2 > MAX_PIXELS_PER_CHUNK or first_pixel + rest // 2 > n_pixels:
        raise MalformedMessage(f"LOAD_PATTERN holds {rest} bytes of levels from pixel {first_pixel} of {n_pixels}")
    levels = np.frombuffer(body, "<u2", rest // 2, STRUCTS["LOAD_PATTERN"].size).astype(np.uint16)
    return PatternChunk(pattern, first_pixel, n_pixels, levels)


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


def pack_plan(chunk: PlanChunk) -> bytes:
    """Return the body of LOAD_PLAN."""
    head = STRUCTS["LOAD_PLAN"].pack(
        chunk.mode, 0, chunk.n_patterns, chunk.n_slots, chunk.first_slot, chunk.exposure_ticks, chunk.slot_period_ticks,
        chunk.cycle_ticks, chunk.block_exposures, 0, chunk.cycles_per_object,
    )  # fmt: skip
    return head + chunk.slots.astype(SLOT_DTYPE).tobytes()


def unpack_plan(body: bytes) -> PlanChunk:
    """Invert `pack_plan`."""
    mode, _, n_patterns, n_slots, first_slot, exposure, period, cycle, block, _, per_object = fields(
        "LOAD_PLAN", body, exact=False
    )
    size = STRUCTS["LOAD_PLAN"].size
    count, odd = divmod(len(body) - size, SLOT_DTYPE.itemsize)
    if odd or not 0 < count <= MAX_SLOTS_PER_CHUNK or first_slot + count > n_slots or len(body) > MAX_PAYLOAD_BYTES:
        raise MalformedMessage(f"LOAD_PLAN holds {len(body) - size} bytes of slots from slot {first_slot} of {n_slots}")
    slots = np.frombuffer(body, SLOT_DTYPE, count, size).copy()
    return PlanChunk(mode, n_patterns, n_slots, first_slot, exposure, period, cycle, block, per_object, slots)


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


def state_dtype(outcomes: int) -> np.dtype[Any]:
    """The layout of one state: pattern, dwell, and `next`, the successors after 0, 1, ... `outcomes` - 1 photons."""
    return np.dtype([("pattern", "<u2"), ("dwell", "<u2"), ("next", "<u4", (outcomes,))])


def pack_count_states(chunk: CountStateChunk) -> bytes:
    """Return the body of LOAD_COUNT_STATES."""
    return STRUCTS["LOAD_COUNT_STATES"].pack(*chunk[:5]) + chunk.states.astype(state_dtype(chunk.outcomes)).tobytes()


def unpack_count_states(body: bytes) -> CountStateChunk:
    """Invert `pack_count_states`."""
    n_states, first, dwell_steps, outcomes, n_leaves = fields("LOAD_COUNT_STATES", body, exact=False)
    if not 3 <= outcomes <= MAX_PHOTON_NUMBER + 1:
        raise MalformedMessage(f"LOAD_COUNT_STATES of {outcomes} outcomes, allowed 3 to {MAX_PHOTON_NUMBER + 1}")
    size, dtype = STRUCTS["LOAD_COUNT_STATES"].size, state_dtype(outcomes)
    count, odd = divmod(len(body) - size, dtype.itemsize)
    if odd or not count or first + count > n_states or len(body) > MAX_PAYLOAD_BYTES:
        raise MalformedMessage(
            f"LOAD_COUNT_STATES holds {len(body) - size} bytes of states from state {first} of {n_states}"
        )
    states = np.frombuffer(body, dtype, count, size).copy()
    return CountStateChunk(n_states, first, dwell_steps, outcomes, n_leaves, states)


def count_state_chunks(header: tuple[int, int, int, int], states: npt.NDArray[Any]) -> list[CountStateChunk]:
    """Cut the states of an automaton into commands; `header` holds its states, dwell steps, outcomes and leaves."""
    n_states, dwell_steps, outcomes, n_leaves = header
    step = STATE_BYTES_PER_COMMAND // state_dtype(outcomes).itemsize
    return [
        CountStateChunk(n_states, first, dwell_steps, outcomes, n_leaves, states[first : first + step])
        for first in range(0, n_states, step)
    ]


def pack_arm(arm: Arm) -> bytes:
    """Return the body of ARM."""
    return STRUCTS["ARM"].pack(*arm, 0)


def unpack_arm(body: bytes) -> Arm:
    """Invert `pack_arm`."""
    return Arm(*fields("ARM", body)[:3])


def pack_gate(gate: Gate) -> bytes:
    """Return the body of GATE."""
    return STRUCTS["GATE"].pack(*gate, 0)


def unpack_gate(body: bytes) -> Gate:
    """Invert `pack_gate`."""
    return Gate(*fields("GATE", body)[:3])


def pack_show(show: Show) -> bytes:
    """Return the body of SHOW."""
    return STRUCTS["SHOW"].pack(*show)


def unpack_show(body: bytes) -> Show:
    """Invert `pack_show`."""
    return Show(*fields("SHOW", body))


def pack_read_counts(largest: int, channels: int = 0) -> bytes:
    """Return the body of READ_COUNTS: runs of the loaded plan send COUNTS of numbers up to `largest`; see `ReadCounts`."""
    return STRUCTS["READ_COUNTS"].pack(largest, channels)


def unpack_read_counts(body: bytes) -> ReadCounts:
    """Invert `pack_read_counts`; the range is the device's to judge."""
    return ReadCounts(*fields("READ_COUNTS", body))


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


def count_announcement(largest: int, channels: int = 1) -> dict[str, int]:
    """Return the keys of WELCOME's map that `announced_counts` and `announced_channels` read; none of a device with neither."""
    told = {"photon_number_max": largest, "channels_at_once": channels}
    found = {key: value for key, value in told.items() if value > 1}
    return {"count_schema": COUNT_SCHEMA, **found} if found else {}
