"""A plan as the LOAD_PLAN bodies that a device is sent, and back.

Owns the conversion; never sends anything. The bodies themselves are laid out in wire/commands.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pans.runtime.wire.commands import MAX_SLOTS_PER_CHUNK, MODES, PlanChunk
from pans.runtime.wire.messages import DARK_PATTERN, SLOT_DTYPE, MalformedMessage

from .plan import Plan

SLOTS_MAX = 1 << 24  # of a plan that is rebuilt: 256 MiB


def plan_chunks(plan: Plan) -> list[PlanChunk]:
    """Return the plan as LOAD_PLAN bodies."""
    slots = np.zeros(plan.slots_per_cycle, SLOT_DTYPE)
    slots["offset_ticks"] = plan.slot_offset_ticks
    slots["pattern"] = plan.slot_pattern
    slots["shot"] = plan.slot_shot
    return [
        PlanChunk(
            MODES[plan.mode],
            plan.n_patterns,
            len(slots),
            first,
            plan.exposure_ticks,
            plan.slot_period_ticks,
            plan.cycle_ticks,
            plan.block_exposures,
            plan.cycles_per_object,
            slots[first : first + MAX_SLOTS_PER_CHUNK],
        )
        for first in range(0, len(slots), MAX_SLOTS_PER_CHUNK)
    ]


def plan_from_chunks(chunks: Sequence[PlanChunk], tick_hz: int) -> Plan:
    """Invert `plan_chunks`: the plan that a device was sent; MalformedMessage when slots are missing."""
    if not chunks:
        raise MalformedMessage("no plan was sent to the device")
    if not 1 <= chunks[-1].n_slots <= SLOTS_MAX:
        raise MalformedMessage(f"a plan of {chunks[-1].n_slots} slots, allowed: 1 to {SLOTS_MAX}")
    slots = np.zeros(chunks[-1].n_slots, SLOT_DTYPE)
    covered = 0
    for chunk in chunks:
        if chunk.first_slot + len(chunk.slots) > len(slots):
            raise MalformedMessage(f"slots {chunk.first_slot} to {chunk.first_slot + len(chunk.slots)} of {len(slots)}")
        slots[chunk.first_slot : chunk.first_slot + len(chunk.slots)] = chunk.slots
        covered += len(chunk.slots)
    head = chunks[-1]
    if covered < len(slots):
        raise MalformedMessage(f"{covered} of {len(slots)} slots of the plan were sent")
    lit = slots["pattern"] != DARK_PATTERN
    if not lit.any() or not head.n_patterns or int(slots["pattern"][lit].max()) >= head.n_patterns:
        raise MalformedMessage("a plan that shows no pattern, or one that it does not have")
    if (
        min(head.exposure_ticks, head.slot_period_ticks, head.cycle_ticks, head.cycles_per_object, head.block_exposures)
        < 1
    ):
        raise MalformedMessage("a plan with exposures, slots, cycles or blocks of length 0")
    return Plan(
        mode={number: mode for mode, number in MODES.items()}[head.mode],
        n_patterns=head.n_patterns,
        slot_offset_ticks=slots["offset_ticks"].astype(np.int64),
        slot_pattern=slots["pattern"].copy(),
        slot_shot=slots["shot"].copy(),
        exposure_ticks=head.exposure_ticks,
        slot_period_ticks=head.slot_period_ticks,
        cycle_ticks=head.cycle_ticks,
        shots_per_cycle=int(slots["shot"][lit].max()) + 1,
        cycles_per_object=head.cycles_per_object,
        block_exposures=head.block_exposures,
        exposure_us=head.exposure_ticks * 1e6 / tick_hz,
    )
