"""Rules of sections 13 and 14: exposures that are photon numbers, or the clicks of several detectors, and automata that follow them.

On a device that announces neither only its refusals are tried.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pans.protocol.wire import (
    COUNT_SCHEMA,
    AckStatus,
    ClickBlock,
    Opcode,
    ReadCounts,
    StateChunk,
    announced,
    announced_channels,
    announced_counts,
    pack_command,
    state_dtype,
)
from pans_sim.conform.bench import Bench
from pans_sim.conform.registry import NotTried, need, rule

from .automata import CYCLES, SLOTS, follow, following, four_states

LEAVES = 5
MALFORMED, RANGE, STATE = AckStatus.MALFORMED, AckStatus.OUT_OF_RANGE, AckStatus.WRONG_STATE


def counting(bench: Bench) -> int:
    """The largest number that the device tells; NotTried where it only clicks."""
    largest = announced_counts(bench.facts)
    if largest < 2:
        raise NotTried("the device announces no photon numbers")
    return largest


def four_counted(steps: int, largest: int) -> StateChunk:
    """State 0 leads to 1, 2 or 3, all of them to leaves: walks of two exposures."""
    rows = np.zeros(4, state_dtype(largest + 1))
    rows["pattern"], rows["dwell"] = (0, 1, 0, 1), steps
    numbers = np.arange(largest + 1)
    rows["next"][0] = 1 + np.minimum(numbers, 2)
    rows["next"][1:] = 4 + (np.arange(3)[:, None] + numbers) % LEAVES
    return StateChunk(4, 0, steps, largest + 1, LEAVES, rows)


@rule("13.1", "A device without photon numbers refuses their opcodes with 1 and sends no COUNTS.")
def clicks_only(bench: Bench) -> None:
    if announced_counts(bench.facts) > 1 or announced_channels(bench.facts) > 1:
        raise NotTried("the device announces photon numbers, or several detectors at once")
    for opcode in (Opcode.READ_COUNTS, Opcode.LOAD_COUNT_STATES):
        bench.refused(AckStatus.UNKNOWN_OPCODE, opcode, bytes(4), opcode.name)
    _, stream, _ = bench.run(bench.layout(), CYCLES)
    counted = [one for one in stream if isinstance(one, ClickBlock) and one.largest > 1]
    need(not counted, f"{len(counted)} blocks are COUNTS")


@rule(
    "13.2",
    "A device that announces photon numbers does so with the number of the extension, a largest number of 2 or more, and automata.",
)
def says_what_it_knows(bench: Bench) -> None:
    schema, largest = (bench.facts.get(key) for key in ("count_schema", "photon_number_max"))
    if largest in (None, 1) and (schema is None or announced_channels(bench.facts) > 1):
        raise NotTried("the device announces no photon numbers")
    need(schema == COUNT_SCHEMA, f"count_schema is {schema}, expected {COUNT_SCHEMA:#010x}")
    need(isinstance(largest, int) and largest >= 2, f"photon_number_max is {largest}, expected 2 to 15")
    need(bench.facts["mode"] == "sequential", f"mode is {bench.facts['mode']}, expected sequential")
    need(announced(bench.facts) is not None, "no automata are announced")


@rule(
    "13.3",
    "READ_COUNTS needs a plan (4) and IDLE (4); outside its range it is refused with 3, with another length with 2.",
)
def reading(bench: Bench) -> None:
    largest = counting(bench)
    bench.refused(STATE, Opcode.READ_COUNTS, pack_command(ReadCounts(2)), "READ_COUNTS without a plan")
    bench.upload(bench.layout())
    for wrong in (0, 1, largest + 1, 0xFFFF):
        bench.refused(RANGE, Opcode.READ_COUNTS, pack_command(ReadCounts(wrong)), f"READ_COUNTS of {wrong}")
    for body, what in ((b"", "no body"), (bytes(3), "three bytes"), (bytes(5), "five bytes")):
        bench.refused(MALFORMED, Opcode.READ_COUNTS, body, f"READ_COUNTS with {what}")
    bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(largest)))
    bench.arm(0, ahead_s=5.0)
    bench.refused(STATE, Opcode.READ_COUNTS, pack_command(ReadCounts(2)), "READ_COUNTS in ARMED")
    bench.done(Opcode.STOP)


@rule(
    "13.4", "After READ_COUNTS every block is COUNTS with its largest number; after LOAD_PLAN blocks are CLICKS again."
)
def blocks_of_numbers(bench: Bench) -> None:
    most = counting(bench)
    layout = bench.layout()
    for largest in sorted({2, most}):
        bench.upload(layout)
        bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(largest)))
        blocks = [one for one in bench.expose(layout, CYCLES) if isinstance(one, ClickBlock)]
        found = {block.largest for block in blocks}
        need(found == {largest}, f"blocks have the largest numbers {sorted(found)}, asked for was {largest}")
        seen = sum(len(block.bits) for block in blocks)
        need(seen == CYCLES * layout.n_slots, f"{seen} exposures, the run has {CYCLES * layout.n_slots}")
    _, stream, _ = bench.run(layout, CYCLES)
    again = {block.largest for block in stream if isinstance(block, ClickBlock)}
    need(again == {1}, f"after LOAD_PLAN blocks have the largest numbers {sorted(again)}, expected CLICKS")


@rule(
    "13.5",
    "LOAD_COUNT_STATES before READ_COUNTS or of other outcomes is refused with 4, as LOAD_STATES after it; outside its ranges with 3, "
    "a part of a state with 2.",
)
def count_state_ranges(bench: Bench) -> None:
    largest, found = min(counting(bench), 3), following(bench)
    bench.upload(bench.layout(adaptive=SLOTS))
    good = four_counted(found.dwell_steps, largest)
    body = pack_command(good)
    bench.refused(STATE, Opcode.LOAD_COUNT_STATES, body, "LOAD_COUNT_STATES before READ_COUNTS")
    bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(largest)))
    bench.refused(
        STATE, Opcode.LOAD_STATES, pack_command(four_states(found.dwell_steps)), "LOAD_STATES after READ_COUNTS"
    )
    other = four_counted(found.dwell_steps, largest + 1)
    bench.refused(STATE, Opcode.LOAD_COUNT_STATES, pack_command(other), "LOAD_COUNT_STATES of other outcomes")
    bench.refused(MALFORMED, Opcode.LOAD_COUNT_STATES, body[:-3], "a part of a state")

    def refuse(what: str, successor: int | None = None, **fields: Any) -> None:
        rows = good.states.copy()
        for name in ("pattern", "dwell"):
            if name in fields:
                rows[name][1] = fields.pop(name)
        if successor is not None:
            rows["next"][1, largest] = successor
        bench.refused(RANGE, Opcode.LOAD_COUNT_STATES, pack_command(good._replace(states=rows, **fields)), what)

    refuse("a pattern that the plan does not have", pattern=2)
    refuse("a dwell of 0", dwell=0)
    refuse("a successor that is its own state", successor=1)
    refuse("a successor that is no node", successor=4 + LEAVES)
    refuse("no leaves", n_leaves=0)
    refuse("states that continue nothing", n_states=8, first_state=4)
    bench.done(Opcode.LOAD_COUNT_STATES, pack_command(good._replace(states=good.states[:2])))
    bench.arm_refused("ARM with two of four states")
    bench.done(Opcode.LOAD_PLAN, pack_command(bench.layout(adaptive=SLOTS).chunk()))
    bench.refused(STATE, Opcode.LOAD_COUNT_STATES, body, "LOAD_COUNT_STATES after another LOAD_PLAN")


@rule(
    "13.6",
    "The device follows states of photon numbers: each number leads to the stamped successor, a leaf ends the walk in the dark.",
)
def follows_numbers(bench: Bench) -> None:
    largest, found = min(counting(bench), 3), following(bench)
    layout, automaton = bench.layout(adaptive=SLOTS), four_counted(found.dwell_steps, largest)
    bench.upload(layout)
    bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(largest)))
    bench.done(Opcode.LOAD_COUNT_STATES, pack_command(automaton))
    follow(bench, layout, automaton)


# ---- several detectors at once ----


def at_once(bench: Bench) -> int:
    """How many detectors the device reads at once; NotTried of one."""
    channels = announced_channels(bench.facts)
    if channels < 2:
        raise NotTried("the device announces one detector at a time")
    return channels


@rule(
    "14.1",
    "A device that reads one detector at a time refuses READ_COUNTS for several with 3, or with 1 without numbers.",
)
def one_at_a_time(bench: Bench) -> None:
    if announced_channels(bench.facts) > 1:
        raise NotTried("the device announces several detectors at once")
    bench.upload(bench.layout())
    status = RANGE if announced_counts(bench.facts) > 1 else AckStatus.UNKNOWN_OPCODE
    bench.refused(status, Opcode.READ_COUNTS, pack_command(ReadCounts(3, 2)), "READ_COUNTS of two detectors")


@rule(
    "14.2",
    "A device that announces several detectors at once does so with the number of section 13, up to 4 of its channels, and automata.",
)
def says_how_many(bench: Bench) -> None:
    channels = bench.facts.get("channels_at_once")
    if channels in (None, 1):
        raise NotTried("the device announces one detector at a time")
    schema, most = bench.facts.get("count_schema"), min(4, bench.facts["channels"])
    need(schema == COUNT_SCHEMA, f"count_schema is {schema}, expected {COUNT_SCHEMA:#010x}")
    need(isinstance(channels, int) and 2 <= channels <= most, f"channels_at_once is {channels}, expected 2 to {most}")
    need(bench.facts["mode"] == "sequential", f"mode is {bench.facts['mode']}, expected sequential")
    need(announced(bench.facts) is not None, "no automata are announced")


@rule(
    "14.3",
    "READ_COUNTS for several detectors needs a plan with adaptive slots (4); more of them than announced, or another largest number "
    "than 2^c - 1, is refused with 3.",
)
def reading_several(bench: Bench) -> None:
    channels = at_once(bench)
    bench.upload(bench.layout())
    bench.refused(STATE, Opcode.READ_COUNTS, pack_command(ReadCounts(3, 2)), "two detectors and fixed patterns")
    bench.upload(bench.layout(adaptive=SLOTS))
    for largest, several in ((2, 2), (7, 2), (1, 1), (3, channels + 1), ((2 << channels) - 1, channels + 1)):
        what = f"READ_COUNTS of {several} detectors up to {largest}"
        bench.refused(RANGE, Opcode.READ_COUNTS, pack_command(ReadCounts(largest, several)), what)
    bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(3, 2)))


@rule(
    "14.4",
    "A state of several detectors names the first of as many patterns, all in the plan (3); each word of clicks leads to the stamped "
    "successor.",
)
def follows_words(bench: Bench) -> None:
    at_once(bench)
    found, layout = following(bench), bench.layout(adaptive=SLOTS)
    automaton = four_counted(found.dwell_steps, 3)
    bench.upload(layout)
    bench.done(Opcode.READ_COUNTS, pack_command(ReadCounts(3, 2)))
    bench.refused(RANGE, Opcode.LOAD_COUNT_STATES, pack_command(automaton), "a second pattern that is not there")
    automaton.states["pattern"] = 0
    bench.done(Opcode.LOAD_COUNT_STATES, pack_command(automaton))
    follow(bench, layout, automaton)
