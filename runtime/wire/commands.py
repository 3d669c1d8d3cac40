"""Bodies of the protocol's commands: pack on the host, unpack on the device (docs/reference/protocol.md, "Commands").

Owns the layouts of LOAD_PATTERN, LOAD_PLAN, ARM and GATE. `pack_*` return bytes for `wire.encode_command`, `unpack_*` return named
tuples or raise `MalformedMessage`. Sizes are checked before anything is allocated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .messages import MAX_PAYLOAD_BYTES, SLOT_DTYPE, STRUCTS, U16, MalformedMessage, fields

SEQUENTIAL, PARALLEL = 0, 1
MODES = {"sequential": SEQUENTIAL, "parallel": PARALLEL}
MAX_PIXELS_PER_CHUNK = 4096
MAX_SLOTS_PER_CHUNK = 1024


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
