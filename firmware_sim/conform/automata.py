"""Rules of section 11: automata that the device follows, or that the host names state by state.

On a device that announces no automata only its refusals are tried.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pans.runtime.wire.commands import (
    Extension,
    MaskChunk,
    Show,
    StateChunk,
    announced,
    pack_command,
    state_dtype,
)
from pans.runtime.wire.messages import DARK_PATTERN, AckStatus, ClickBlock, DeviceState, Opcode

from .bench import Bench
from .plans import Layout
from .rules import NotTried, need, rule

CYCLES = 15
SLOTS = 3
MALFORMED, RANGE, STATE, LATE = AckStatus.MALFORMED, AckStatus.OUT_OF_RANGE, AckStatus.WRONG_STATE, AckStatus.TOO_LATE


def extension(bench: Bench) -> Extension:
    """What the device announces; NotTried without it."""
    found = announced(bench.facts)
    if found is None:
        raise NotTried("the device announces no automata")
    return found


def following(bench: Bench) -> Extension:
    """As `extension`, of a device that follows states."""
    found = extension(bench)
    if found.states < 4:
        raise NotTried(f"the device follows {found.states} states")
    return found


def four_states(steps: int) -> StateChunk:
    """State 0 leads to 1 or 2, 1 to 3 or a leaf, 2 and 3 to leaves: walks of two or three exposures."""
    rows = np.zeros(4, state_dtype(2))
    rows["pattern"], rows["dwell"] = (0, 1, 1, 0), steps
    rows["next"] = (1, 2), (3, 4), (5, 6), (6, 7)
    return StateChunk(4, 0, steps, 2, 4, rows)


@rule("11.1", "A device without automata refuses their opcodes with 1 and an adaptive slot with 3.")
def older_device(bench: Bench) -> None:
    if announced(bench.facts) is not None:
        raise NotTried("the device announces automata")
    for opcode in (Opcode.LOAD_MASKS, Opcode.LOAD_STATES, Opcode.SHOW):
        bench.refused(AckStatus.UNKNOWN_OPCODE, opcode, bytes(16), opcode.name)
    chunk = bench.layout().chunk()
    chunk.slots["pattern"][-1] = 0xFFFE
    bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(chunk), "a slot with the pattern 0xFFFE")


@rule(
    "11.2",
    "LOAD_MASKS: another number of bytes, no masks, no pixels, pieces of several patterns: 2; outside the memory: 3.",
)
def masks(bench: Bench) -> None:
    extension(bench)
    pixels = min(9, bench.facts["pattern_pixels"])
    rows = np.zeros((2, -(-pixels // 8)), np.uint8)
    good = MaskChunk(0, 0, pixels, pixels, rows)
    body = pack_command(good)
    bench.done(Opcode.LOAD_MASKS, body)
    for wrong, what in (
        (body + b"\0", "a byte too many"),
        (body[:-1], "a byte too few"),
        (body[:16], "no masks' bytes"),
    ):
        bench.refused(MALFORMED, Opcode.LOAD_MASKS, wrong, f"LOAD_MASKS with {what}")
    none = pack_command(good._replace(rows=rows[:0]))
    bench.refused(MALFORMED, Opcode.LOAD_MASKS, none, "LOAD_MASKS of no masks")
    if pixels > 8:
        piece = pack_command(good._replace(n_pixels=pixels + 8))
        bench.refused(MALFORMED, Opcode.LOAD_MASKS, piece, "LOAD_MASKS with pieces of two patterns")
    beyond = pack_command(good._replace(first_pattern=bench.facts["pattern_memory"] - 1))
    bench.refused(RANGE, Opcode.LOAD_MASKS, beyond, "LOAD_MASKS beyond the memory")


@rule(
    "11.3",
    "LOAD_STATES needs a plan with adaptive slots (4); a plan that mixes them with fixed patterns is refused with 3.",
)
def states_need_a_plan(bench: Bench) -> None:
    steps = following(bench).dwell_steps
    bench.upload(bench.layout())
    bench.refused(STATE, Opcode.LOAD_STATES, pack_command(four_states(steps)), "LOAD_STATES with fixed patterns")
    mixed = bench.layout(adaptive=SLOTS).chunk()
    mixed.slots["pattern"][-1] = mixed.slots["shot"][-1] = 0
    bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(mixed), "adaptive slots beside a fixed pattern")


@rule(
    "11.4",
    "LOAD_STATES outside its ranges, out of order, or with a walk longer than a cycle's adaptive slots: 3; a part of a state: 2.",
)
def state_ranges(bench: Bench) -> None:
    found = following(bench)
    bench.upload(bench.layout(adaptive=SLOTS))
    good = four_states(found.dwell_steps)

    def refuse(what: str, status: int = RANGE, **fields: Any) -> None:
        rows = good.states.copy()
        for name in ("pattern", "dwell", "next"):
            if name in fields:
                rows[name][1] = fields.pop(name)
        bench.refused(status, Opcode.LOAD_STATES, pack_command(good._replace(states=rows, **fields)), what)

    refuse("a pattern that the plan does not have", pattern=2)
    refuse("a dwell of 0", dwell=0)
    if found.dwell_steps < 0xFFFF:
        refuse("a dwell above the steps", dwell=found.dwell_steps + 1)
    refuse("a successor that is its own state", next=(1, 4))
    refuse("a successor below its state", next=(3, 0))
    refuse("a successor that is no node", next=(3, 8))
    refuse("no leaves", n_leaves=0)
    refuse("states that continue nothing", n_states=8, first_state=4)
    bench.refused(MALFORMED, Opcode.LOAD_STATES, pack_command(good)[:-3], "a part of a state")
    bench.upload(bench.layout(adaptive=2))
    bench.refused(RANGE, Opcode.LOAD_STATES, pack_command(good), "walks of three exposures in two adaptive slots")


@rule("11.5", "ARM while some but not all states have come is refused with 4.")
def half_an_automaton(bench: Bench) -> None:
    steps = following(bench).dwell_steps
    bench.upload(bench.layout(adaptive=SLOTS))
    good = four_states(steps)
    bench.done(Opcode.LOAD_STATES, pack_command(good._replace(states=good.states[:2])))
    bench.arm_refused("ARM with two of four states")


@rule(
    "11.6",
    "The device follows its states: a walk begins in state 0, each click leads to the stamped successor, a leaf ends it in the dark.",
)
def follows(bench: Bench) -> None:
    steps = following(bench).dwell_steps
    layout, automaton = bench.layout(adaptive=SLOTS), four_states(steps)
    bench.upload(layout)
    bench.done(Opcode.LOAD_STATES, pack_command(automaton))
    follow(bench, layout, automaton)


def follow(bench: Bench, layout: Layout, automaton: StateChunk) -> None:
    """Run what is loaded for `CYCLES`; hold the stamps against the readings and the states."""
    node, seen, largest = 0, 0, automaton.outcomes - 1
    for block in (one for one in bench.expose(layout, CYCLES) if isinstance(one, ClickBlock)):
        need(block.largest == largest, f"a block has the largest number {block.largest}, asked for was {largest}")
        for exposure, (stamp, reading) in enumerate(zip(block.patterns, block.bits), block.exposure_index):
            slot = exposure % layout.n_slots
            node = node if slot else 0
            lit = slot < SLOTS and node < automaton.n_states
            wanted = node if lit else DARK_PATTERN
            need(stamp == wanted, f"exposure {exposure} is stamped {stamp}, the walk stands in {wanted}")
            node = int(automaton.states["next"][node, reading]) if lit else node
            seen += 1
    need(seen == CYCLES * layout.n_slots, f"{seen} exposures, the run has {CYCLES * layout.n_slots}")


@rule("11.7", "An adaptive slot without SHOW is dark and stamped 0xFFFF, one with SHOW is stamped its state.")
def named(bench: Bench) -> None:
    steps = extension(bench).dwell_steps
    layout = bench.layout(adaptive=SLOTS, block_exposures=1)
    bench.upload(layout)
    bench.grant()
    bench.arm(CYCLES, ahead_s=0.5)
    wanted = {0: 5, 2: 9, layout.n_slots: 65532, layout.n_slots + 1: 3}
    for exposure, state in wanted.items():
        bench.done(Opcode.SHOW, pack_command(Show(exposure, 1, 0, steps, steps)))
        bench.done(Opcode.SHOW, pack_command(Show(exposure, state, 1, 1, steps)))  # takes the place of the first
    bench.closing(layout, CYCLES)
    for block in (one for one in bench.stream() if isinstance(one, ClickBlock)):
        stamp = wanted.get(block.exposure_index, DARK_PATTERN)
        need(
            block.patterns.tolist() == [stamp],
            f"exposure {block.exposure_index} is stamped {block.patterns.tolist()}, expected {stamp}",
        )


@rule(
    "11.8",
    "SHOW of an exposure that has begun is refused with 5, outside its ranges with 3, and with 4 where the host names nothing.",
)
def show_refusals(bench: Bench) -> None:
    steps = extension(bench).dwell_steps
    layout = bench.layout(adaptive=SLOTS, block_exposures=1)
    bench.upload(layout)
    bench.refused(STATE, Opcode.SHOW, pack_command(Show(0, 0, 0, 1, steps)), "SHOW in IDLE")
    bench.grant()
    bench.arm(0)
    far = 1000 * layout.n_slots
    for status, show, what in (
        (RANGE, Show(far + SLOTS, 0, 0, 1, steps), "SHOW of a dark slot"),
        (RANGE, Show(far, 0, 2, 1, steps), "SHOW of a pattern that the plan does not have"),
        (RANGE, Show(far, 0, 0, 0, steps), "SHOW with a dwell of 0"),
        (RANGE, Show(far, 65533, 0, 1, steps), "SHOW of state 65533"),
    ):
        bench.refused(status, Opcode.SHOW, pack_command(show), what)
    bench.until_state(DeviceState.RUNNING)
    bench.listen(2 * layout.cycle_ticks / layout.tick_hz)
    bench.refused(LATE, Opcode.SHOW, pack_command(Show(0, 0, 0, 1, steps)), "SHOW of an exposure that has begun")
    bench.done(Opcode.STOP)


@rule("11.9", "A device holds the names of at least 64 exposures.")
def many_names(bench: Bench) -> None:
    steps = extension(bench).dwell_steps
    layout = bench.layout(adaptive=SLOTS)
    bench.upload(layout)
    bench.arm(0, ahead_s=20.0, lease_ms=20_000)
    ahead = [cycle * layout.n_slots + slot for cycle in range(22) for slot in range(SLOTS)][:64]
    for exposure in ahead:
        bench.done(Opcode.SHOW, pack_command(Show(exposure, 0, 0, 1, steps)))
    bench.done(Opcode.STOP)
