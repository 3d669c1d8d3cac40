"""Rules of section 11: automata that the device follows, or that the host names state by state.

On a device that announces no automata only its refusals are tried.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pans.protocol.wire import (
    ADAPTIVE_PATTERN,
    DARK_PATTERN,
    MAX_STATES,
    AckStatus,
    ClickBlock,
    DeviceState,
    Extension,
    MaskChunk,
    MessageType,
    Opcode,
    Show,
    StateChunk,
    announced,
    pack_command,
    state_dtype,
)
from pans_sim.conform.bench import LEASE_MS, PATIENCE_S, Bench
from pans_sim.conform.plans import Layout
from pans_sim.conform.registry import NotTried, need, rule

CYCLES = 15
SLOTS = 3
LONG_WALK, LONG_WALKS = 511, 3  # exposures of a walk, past the first byte of slots and states; walks
LONG_BLOCK = 200  # exposures; the stamps of states from 257 on are hundreds of bytes without a zero
LONG_LEASE_MS = 60_000
AHEAD_S = 2.0  # of a run: 64 names come before it begins
TURNS = 14  # exposures that are waited for one by one
MOST_NAMES, NAMES = 300, 64  # names that a check asks a device to hold; that it must hold
NAMING_S = 0.05  # between exposures that the host names one after another: any link is quicker
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


def no_divisor(steps: int) -> int:
    """Return the least number that does not divide `steps`."""
    return next(k for k in range(2, 1 << 16) if steps % k)


def long_walk(length: int, steps: int) -> StateChunk:
    """Each state leads to the next one, or after a click to the one behind that: walks of half to all of `length` exposures."""
    rows = np.zeros(length, state_dtype(2))
    rows["pattern"], rows["dwell"] = np.arange(length) % 2, steps
    rows["next"] = np.arange(length)[:, None] + (1, 2)
    return StateChunk(length, 0, steps, 2, 2, rows)


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
    "LOAD_STATES needs a plan with adaptive slots (4), and LOAD_PLAN forgets the states; a plan that mixes adaptive slots with fixed "
    "patterns is refused with 3.",
)
def states_need_a_plan(bench: Bench) -> None:
    steps = following(bench).dwell_steps
    bench.upload(bench.layout())
    bench.refused(STATE, Opcode.LOAD_STATES, pack_command(four_states(steps)), "LOAD_STATES with fixed patterns")
    bench.upload(bench.layout(adaptive=SLOTS))
    bench.done(Opcode.LOAD_STATES, pack_command(four_states(steps)))
    bench.done(Opcode.LOAD_PLAN, pack_command(bench.layout(adaptive=SLOTS).chunk()))
    bench.arm(1, ahead_s=20.0, lease_ms=20_000)
    bench.done(Opcode.SHOW, pack_command(Show(0, 0, 0, 1, steps)))  # the host drives: the states are forgotten
    bench.done(Opcode.STOP)
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
    if found.states < MAX_STATES:
        refuse("more states than are announced", n_states=found.states + 1)
    odd = no_divisor(found.dwell_steps)
    rows = good.states.copy()
    rows["dwell"] = 1
    wrong = pack_command(good._replace(dwell_steps=odd, states=rows))
    bench.refused(RANGE, Opcode.LOAD_STATES, wrong, f"{odd} dwell steps on a device of {found.dwell_steps}")
    bench.refused(MALFORMED, Opcode.LOAD_STATES, pack_command(good)[:-3], "a part of a state")
    bench.upload(bench.layout(adaptive=2))
    bench.refused(RANGE, Opcode.LOAD_STATES, pack_command(good), "walks of three exposures in two adaptive slots")
    meeting = good.states.copy()
    meeting["next"] = (1, 2), (2, 4), (5, 6), (6, 7)  # the way to state 2 by state 1 is the longer one
    chunk = good._replace(states=meeting)
    bench.refused(
        RANGE, Opcode.LOAD_STATES, pack_command(chunk), "walks that meet, of three exposures in two adaptive slots"
    )
    bench.arm(1, ahead_s=20.0, lease_ms=20_000)  # they are forgotten: the host names each state
    bench.done(Opcode.STOP)


@rule("11.11", "Pieces of states come in order and repeat their header, else 3; first state 0 starts over.")
def state_pieces(bench: Bench) -> None:
    steps = following(bench).dwell_steps
    bench.upload(bench.layout(adaptive=SLOTS))
    good = four_states(steps)

    def piece(first: int, stop: int, **header: int) -> bytes:
        return pack_command(good._replace(first_state=first, states=good.states[first:stop], **header))

    bench.done(Opcode.LOAD_STATES, piece(0, 2))
    bench.refused(RANGE, Opcode.LOAD_STATES, piece(3, 4), "states behind a gap")
    bench.refused(RANGE, Opcode.LOAD_STATES, piece(1, 3), "states over earlier ones")
    for header in ({"n_states": 5}, {"n_leaves": 5}, *([{"dwell_steps": 1}] if steps > 1 else [])):
        rows = good.states.copy()
        rows["dwell"] = 1
        body = pack_command(good._replace(first_state=2, states=rows[2:], **header))
        bench.refused(RANGE, Opcode.LOAD_STATES, body, f"states with another header, {header}")
    bench.done(Opcode.LOAD_STATES, piece(2, 4))
    bench.arm(1, ahead_s=20.0, lease_ms=20_000)
    bench.done(Opcode.STOP)
    bench.done(Opcode.LOAD_STATES, piece(0, 1))
    bench.done(Opcode.LOAD_STATES, piece(0, 2))
    bench.done(Opcode.LOAD_STATES, piece(2, 4))
    bench.done(Opcode.LOAD_PLAN, pack_command(bench.layout(adaptive=SLOTS).chunk()))
    bench.refused(RANGE, Opcode.LOAD_STATES, piece(2, 4), "states that continue those of another plan")


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
    length = min(LONG_WALK, following(bench).states, bench.facts["slot_memory"] - 1)
    layout, automaton = bench.layout(adaptive=length, block_exposures=LONG_BLOCK), long_walk(length, steps)
    bench.upload(layout)
    bench.done(Opcode.LOAD_STATES, pack_command(automaton))
    follow(bench, layout, automaton, LONG_WALKS)


def follow(bench: Bench, layout: Layout, automaton: StateChunk, cycles: int = CYCLES) -> None:
    """Run what is loaded for so many cycles; hold the stamps against the readings and the states."""
    node, seen, largest = 0, 0, automaton.outcomes - 1
    for block in (one for one in bench.expose(layout, cycles) if isinstance(one, ClickBlock)):
        need(block.largest == largest, f"a block has the largest number {block.largest}, asked for was {largest}")
        for exposure, (stamp, reading) in enumerate(zip(block.patterns, block.bits), block.exposure_index):
            slot = exposure % layout.n_slots
            node = node if slot else 0
            lit = layout.shown[slot] == ADAPTIVE_PATTERN and node < automaton.n_states
            wanted = node if lit else DARK_PATTERN
            need(stamp == wanted, f"exposure {exposure} is stamped {stamp}, the walk stands in {wanted}")
            node = int(automaton.states["next"][node, reading]) if lit else node
            seen += 1
    need(seen == cycles * layout.n_slots, f"{seen} exposures, the run has {cycles * layout.n_slots}")


@rule(
    "11.7",
    "An adaptive slot without SHOW is dark and stamped 0xFFFF, one with SHOW is stamped its state; SHOW may come until the exposure "
    "begins.",
)
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
    far = Show((1 << 16) + layout.n_slots + 2, 11, 1, 1, steps)
    bench.refused(RANGE, Opcode.SHOW, pack_command(far), "SHOW of an exposure beyond the run")
    bench.closing(layout, CYCLES)
    for block in (one for one in bench.stream() if isinstance(one, ClickBlock)):
        stamp = wanted.get(block.exposure_index, DARK_PATTERN)
        need(
            block.patterns.tolist() == [stamp],
            f"exposure {block.exposure_index} is stamped {block.patterns.tolist()}, expected {stamp}",
        )
    named_in_turn(bench)


def named_in_turn(bench: Bench) -> None:
    """Name each exposure when the one before has come, and one of 65 536 later."""
    steps = extension(bench).dwell_steps
    layout = bench.layout(adaptive=SLOTS, block_exposures=1)
    layout = replace(layout, period_ticks=max(layout.period_ticks, round(NAMING_S * layout.tick_hz)))
    bench.upload(layout)
    bench.grant()
    bench.arm(0)
    far = (1 << 16) + layout.n_slots  # of 16 bits: the first exposure of the second cycle
    bench.done(Opcode.SHOW, pack_command(Show(far, 7, 0, 1, steps)))
    wanted: dict[int, int] = {}
    for exposure in range(TURNS):
        slot = exposure % layout.n_slots
        if slot == 1:
            show = Show(exposure, 100 + exposure, 0, 1, steps)
            ack = bench.command(Opcode.SHOW, pack_command(show))
            need(
                ack.status == LATE or not ack.refuses(bench.last_id),
                f"SHOW of the next exposure was refused with {ack.status}",
            )
            wanted[exposure] = DARK_PATTERN if ack.refuses(bench.last_id) else show.state
        block = bench.wait(MessageType.CLICKS, what=f"of exposure {exposure}")
        stamp = wanted.get(exposure, DARK_PATTERN)
        need(
            block.exposure_index == exposure and block.patterns.tolist() == [stamp],
            f"exposure {block.exposure_index} is stamped {block.patterns.tolist()}, expected {stamp} of {exposure}",
        )
    bench.done(Opcode.STOP)


@rule(
    "11.8",
    "SHOW of an exposure that has begun is refused with 5, outside its ranges with 3, of another length with 2, and with 4 where the "
    "host names nothing.",
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
        (RANGE, Show(far, 0, 0, 1, no_divisor(steps)), "SHOW with dwell steps that are no divisor"),
    ):
        bench.refused(status, Opcode.SHOW, pack_command(show), what)
    body = pack_command(Show(far, 0, 0, 1, steps))
    for wrong in (body[:-1], body + b"\0"):
        bench.refused(MALFORMED, Opcode.SHOW, wrong, f"SHOW of {len(wrong)} bytes")
    bench.until_state(DeviceState.RUNNING)
    bench.listen(2 * layout.cycle_ticks / layout.tick_hz)
    bench.refused(LATE, Opcode.SHOW, pack_command(Show(0, 0, 0, 1, steps)), "SHOW of an exposure that has begun")
    bench.done(Opcode.STOP)
    if extension(bench).states >= 4:
        bench.done(Opcode.LOAD_STATES, pack_command(four_states(steps)))
        bench.arm(1, ahead_s=20.0, lease_ms=20_000)
        bench.refused(STATE, Opcode.SHOW, pack_command(Show(0, 0, 0, 1, steps)), "SHOW in a run that the device drives")
        bench.done(Opcode.STOP)


@rule(
    "11.9",
    "A device holds the names of at least 64 exposures, refuses one too many with 3, and makes room when they have begun.",
)
def many_names(bench: Bench) -> None:
    steps = extension(bench).dwell_steps
    layout = bench.layout(adaptive=SLOTS)
    bench.upload(layout)

    def show(number: int) -> Any:
        """Name adaptive exposure `number` of the run."""
        cycle, slot = divmod(number, SLOTS)
        return bench.command(Opcode.SHOW, pack_command(Show(cycle * layout.n_slots + slot, 0, 0, 1, steps)))

    bench.arm(0, ahead_s=60.0, lease_ms=60_000)
    held = 0
    while held < MOST_NAMES and not (ack := show(held)).refuses(bench.last_id):
        held += 1
    need(held >= NAMES, f"the name of exposure {held + 1} was refused with {ack.status} ({ack.text})")
    need(
        held == MOST_NAMES or ack.status == RANGE, f"one name too many was refused with {ack.status}, expected {RANGE}"
    )
    bench.done(Opcode.STOP)
    bench.grant()
    bench.arm(0, ahead_s=AHEAD_S)
    taken = [not show(number).refuses(bench.last_id) for number in range(NAMES)]
    need(all(taken), f"{taken.count(False)} of {NAMES} names were refused: STOP forgets all")
    bench.grant(lease_ms=LEASE_MS)
    last = -(-NAMES // SLOTS) * layout.n_slots
    within_s = AHEAD_S + PATIENCE_S + layout.seconds(last // layout.n_slots + 1)
    bench.wait(MessageType.CLICKS, lambda block: block.exposure_index >= last, within_s, f"of exposure {last}")
    bench.grant(lease_ms=LONG_LEASE_MS)
    far = 1 << 30  # none of them begins
    for number in range(far, far + held):
        ack = show(number)
        need(
            not ack.refuses(bench.last_id),
            f"a name was refused with {ack.status} ({ack.text}), {NAMES} names have begun",
        )
    bench.done(Opcode.STOP)


@rule("11.10", "LOAD_MASKS and LOAD_STATES are refused with 4 outside IDLE.")
def uploads_need_idle(bench: Bench) -> None:
    found = extension(bench)
    layout = bench.layout(adaptive=SLOTS)
    bench.upload(layout)
    masks = pack_command(MaskChunk(0, 0, layout.pixels, min(8, layout.pixels), np.zeros((1, 1), np.uint8)))
    bench.arm(0, ahead_s=20.0, lease_ms=20_000)
    bench.refused(STATE, Opcode.LOAD_MASKS, masks, "LOAD_MASKS while ARMED")
    if found.states >= 4:
        bench.refused(
            STATE, Opcode.LOAD_STATES, pack_command(four_states(found.dwell_steps)), "LOAD_STATES while ARMED"
        )
    bench.done(Opcode.STOP)
