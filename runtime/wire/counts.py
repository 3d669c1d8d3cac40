"""The extension for photon numbers: blocks of COUNTS, the command that asks for them, automata with a successor for each number.

A number may also be the clicks of several detectors that are read at once: bit k is that of detector k (section 14).
Owns the layouts of COUNTS, READ_COUNTS and LOAD_COUNT_STATES (docs/reference/protocol.md, section 13), and what a device announces of
itself. A block of COUNTS is a `ClickBlock` whose `largest` is above 1. `pack_*` and `encode_*` return bytes, `unpack_*` and `decode_*`
raise `MalformedMessage`; sizes are checked before anything is allocated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .fields import MAX_PHOTON_NUMBER
from .messages import BLOCK_HEADER_BYTES, MAX_PAYLOAD_BYTES, STRUCTS, ClickBlock, MalformedMessage, encode_frame, fields
from .schema import COUNT_SCHEMA, MessageType

STATE_BYTES_PER_COMMAND = 8160  # as automata.STATES_PER_COMMAND: a slow line acknowledges it before it is repeated
EXPOSURE_BYTES = 3  # of COUNTS: the pattern shown, and the number


class ReadCounts(NamedTuple):
    """What READ_COUNTS asks for: numbers up to `largest`, of one detector that counts (`channels` 0) or the clicks of so many detectors."""

    largest: int
    channels: int = 0


class CountStateChunk(NamedTuple):
    """The header of an automaton over photon numbers and some of its states, of `state_dtype(outcomes)`."""

    n_states: int
    first_state: int
    dwell_steps: int
    outcomes: int
    n_leaves: int
    states: npt.NDArray[Any]


def state_dtype(outcomes: int) -> np.dtype[Any]:
    """The layout of one state: pattern, dwell, and `next`, the successors after 0, 1, ... `outcomes` - 1 photons."""
    return np.dtype([("pattern", "<u2"), ("dwell", "<u2"), ("next", "<u4", (outcomes,))])


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


def encode_counts(block: ClickBlock, session: int) -> bytes:
    """Return a block of photon numbers, at most `block.largest` each."""
    head = STRUCTS["COUNTS"].pack(*block[:5], len(block.patterns), block.largest, block.object_index)
    body = block.patterns.astype("<u2").tobytes() + block.bits.astype(np.uint8).tobytes()
    return encode_frame(MessageType.COUNTS, head + body, session)


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


def pack_read_counts(largest: int, channels: int = 0) -> bytes:
    """Return the body of READ_COUNTS: runs of the loaded plan send COUNTS of numbers up to `largest`; see `ReadCounts`."""
    return STRUCTS["READ_COUNTS"].pack(largest, channels)


def unpack_read_counts(body: bytes) -> ReadCounts:
    """Invert `pack_read_counts`; the range is the device's to judge."""
    return ReadCounts(*fields("READ_COUNTS", body))


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
