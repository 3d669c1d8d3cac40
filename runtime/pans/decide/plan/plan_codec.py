"""A plan as the commands that a device is sent, and back: LOAD_PLAN, READ_COUNTS, and LOAD_STATES or LOAD_COUNT_STATES."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pans.protocol.wire import (
    ADAPTIVE_PATTERN,
    DARK_PATTERN,
    MAX_SLOTS_PER_CHUNK,
    MODES,
    SLOT_DTYPE,
    MalformedMessage,
    Opcode,
    PlanChunk,
    ReadCounts,
    StateChunk,
    cut_states,
    pack_command,
    state_dtype,
)

from .plan import Plan

if TYPE_CHECKING:
    from pans.bundle.automaton import Automaton
    from pans.bundle.sensor import Bundle
    from pans.instrument.profile import Profile

SERIAL_BYTES_PER_S = 400_000  # ten bits a byte
SLOTS_MAX = 1 << 24  # of a plan that is rebuilt: 256 MiB
# what a plan and its chunks have in common, by name
SHARED = ("n_patterns", "exposure_ticks", "slot_period_ticks", "cycle_ticks", "block_exposures", "cycles_per_object")


def plan_chunks(plan: Plan) -> list[PlanChunk]:
    """Return the plan as LOAD_PLAN bodies."""
    slots = np.zeros(plan.slots_per_cycle, SLOT_DTYPE)
    slots["offset_ticks"] = plan.slot_offset_ticks
    slots["pattern"] = plan.slot_pattern
    slots["shot"] = plan.slot_shot
    head: dict[str, Any] = {"mode": MODES[plan.mode], "n_slots": len(slots)}
    head |= {name: getattr(plan, name) for name in SHARED}
    starts = range(0, len(slots), MAX_SLOTS_PER_CHUNK)
    return [PlanChunk(**head, first_slot=first, slots=slots[first : first + MAX_SLOTS_PER_CHUNK]) for first in starts]


def plan_commands(plan: Plan) -> list[tuple[Opcode, bytes]]:
    """Return the commands that bring `plan` to a device: its slots, what is read in an exposure, and the states that the device follows."""
    commands = [(Opcode.LOAD_PLAN, pack_command(chunk)) for chunk in plan_chunks(plan)]
    if plan.largest > 1:
        commands.append((Opcode.READ_COUNTS, pack_command(reading_of(plan))))
    return [*commands, *((chunk.opcode, pack_command(chunk)) for chunk in state_chunks(plan))]


def reading_of(plan: Plan) -> ReadCounts:
    """Return what READ_COUNTS asks a device for, of a plan that reads numbers."""
    return ReadCounts(plan.largest, plan.channels_at_once if plan.channels_at_once > 1 else 0)


def state_chunks(plan: Plan) -> Sequence[StateChunk]:
    """Return the automaton that the device is to follow as bodies of commands; none of a plan that it does not drive."""
    return [] if plan.automaton is None or plan.drive != "device" else _chunks_of(plan.automaton)


def _chunks_of(automaton: Automaton) -> Sequence[StateChunk]:
    states = np.zeros(automaton.n_states, state_dtype(automaton.n_outcomes))
    states["pattern"], states["dwell"], states["next"] = automaton.pattern, automaton.dwell, automaton.successors
    return cut_states((automaton.n_states, automaton.dwell_steps, automaton.n_outcomes, automaton.n_leaves), states)


def upload_bytes(plan: Plan, bundle: Bundle) -> int:
    """How many bytes the device is sent before it can measure: patterns, slots and states, without the frames around them."""
    n_patterns, n_pixels = bundle.pattern_levels.shape
    pattern = (n_pixels + 7) // 8 if bundle.levels == 2 else 2 * n_pixels
    states = 0
    if plan.automaton is not None and plan.drive == "device":
        states = plan.automaton.n_states * state_dtype(plan.automaton.n_outcomes).itemsize
    return n_patterns * pattern + plan.slots_per_cycle * SLOT_DTYPE.itemsize + states


def drive_words(profile: Profile, bundle: Bundle, plan: Plan) -> str:
    """Who drives a plan's automaton and what it takes, against what `profile` allows, in one sentence."""
    automaton = plan.automaton
    if automaton is None:
        raise ValueError("a plan without an automaton")
    projector, size = profile.projector, upload_bytes(plan, bundle)
    follows = f"of {automaton.n_states} states (the device follows {projector.automaton_states})"
    names = f"each next pattern, within {profile.timing.host_turn_us:g} us"
    who = (
        f"the device drives an automaton {follows}" if plan.drive == "device" else f"the host names {names}, {follows}"
    )
    return (
        f"{who} and {bundle.n_shown} patterns (it holds {projector.pattern_memory}): {plan.slots_per_cycle} slots of "
        f"{plan.slot_period_ticks * plan.tick_us:.4g} us, {1e6 / plan.cycle_us:.4g} walks per second; upload {size / 1e6:.3g} MB, "
        f"{size / SERIAL_BYTES_PER_S:.2g} s on a serial line of 4 Mbaud"
    )


def plan_from_chunks(
    chunks: Sequence[PlanChunk],
    tick_hz: int,
    automaton: Automaton | None = None,
    states: Sequence[StateChunk] = (),
    largest: int = 1,
) -> Plan:
    """Invert `plan_chunks` and `state_chunks`: the plan that a device was sent, with the `automaton` that it was made for.

    `largest` is the largest number of an exposure of fixed patterns.

    MalformedMessage when slots or states are missing, or the states are not those of `automaton`.
    """
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
    adaptive = slots["pattern"] == ADAPTIVE_PATTERN
    _check_automaton(slots[adaptive], automaton, states)
    fixed = slots["pattern"][lit & ~adaptive]
    if not lit.any() or not head.n_patterns or (fixed.size and int(fixed.max()) >= head.n_patterns):
        raise MalformedMessage("a plan that shows no pattern, or one that it does not have")
    shared: dict[str, Any] = {name: getattr(head, name) for name in SHARED}
    if min(shared.values()) < 1:
        raise MalformedMessage("a plan with exposures, slots, cycles or blocks of length 0")
    return Plan(
        mode={number: mode for mode, number in MODES.items()}[head.mode],
        **shared,
        slot_offset_ticks=slots["offset_ticks"].astype(np.int64),
        slot_pattern=slots["pattern"].copy(),
        slot_shot=slots["shot"].copy(),
        shots_per_cycle=int(slots["shot"][lit].max()) + 1,
        exposure_us=head.exposure_ticks * 1e6 / tick_hz,
        automaton=automaton,
        drive="" if automaton is None else "device" if states else "host",
        largest=largest if automaton is None else automaton.n_outcomes - 1,
    )


def _check_automaton(adaptive: NDArray[Any], automaton: Automaton | None, states: Sequence[StateChunk]) -> None:
    """Raise MalformedMessage unless the adaptive slots and the states that were sent are those of `automaton`."""
    walk = 0 if automaton is None else automaton.n_slots
    if len(adaptive) != walk:
        raise MalformedMessage(f"a plan of {len(adaptive)} adaptive slots for walks of {walk} exposures")
    if automaton is None or not states:
        if states:
            raise MalformedMessage("states were sent, but no automaton is known")
        return
    sent = {chunk.first_state: chunk for chunk in states}
    for chunk in _chunks_of(automaton):
        found = sent.get(chunk.first_state)
        if found is None or found[:-1] != chunk[:-1] or found.states.tobytes() != chunk.states.tobytes():
            raise MalformedMessage(f"the states from {chunk.first_state} on were not sent as the automaton has them")
