"""Rules of section 4: how commands are numbered, acknowledged and refused."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from pans.protocol.wire import (
    DARK_PATTERN,
    MAX_PIXELS_PER_CHUNK,
    AckStatus,
    Arm,
    DeviceState,
    Gate,
    MessageType,
    Opcode,
    PatternChunk,
    encode_command,
    pack_command,
)
from pans_sim.conform.bench import Bench
from pans_sim.conform.plans import Layout
from pans_sim.conform.registry import NotTried, need, rule

UNKNOWN_OPCODE = 0xEE
MOST_GATES = 300  # that a check asks for until the list is full
COMMANDS = 260  # past the first byte of their number
MANY_COMMANDS, AT_ONCE = 65_800, 8  # past 16 bits of their number; as many unacknowledged as a host may have
MALFORMED, RANGE, STATE, LATE = AckStatus.MALFORMED, AckStatus.OUT_OF_RANGE, AckStatus.WRONG_STATE, AckStatus.TOO_LATE


@rule("4.1", "The command after the last one is carried out and acknowledged.")
def next_command(bench: Bench) -> None:
    for _ in range(COMMANDS):
        bench.done(Opcode.STOP)


@rule("4.2", "A repeated command is not carried out again, and acknowledged.")
def repeated(bench: Bench) -> None:
    bench.done(Opcode.STOP)
    ack = bench.command(UNKNOWN_OPCODE, number=bench.last_id)  # would be refused if it were carried out
    need(ack.last_id == bench.last_id, f"last id {ack.last_id}, expected {bench.last_id}")
    need(not ack.refuses(bench.last_id), "a command with an id that had been used was carried out")


@rule("4.3", "A command behind a gap is not carried out; ACK says the last id before the gap.")
def gap(bench: Bench) -> None:
    bench.done(Opcode.STOP)
    ack = bench.command(UNKNOWN_OPCODE, number=bench.last_id + 2)
    need(ack.last_id == bench.last_id, f"last id {ack.last_id}, expected {bench.last_id}: a command was left out")
    need(ack.refused_id <= bench.last_id, "a command behind a gap was carried out")
    bench.done(Opcode.STOP)


@rule("4.4", "ACK names the latest refused command, and the mask each one of the last 32.")
def refused_mask(bench: Bench) -> None:
    bench.refused(AckStatus.UNKNOWN_OPCODE, UNKNOWN_OPCODE, b"", "an unknown opcode")
    first = bench.last_id
    bench.done(Opcode.STOP)
    bench.refused(AckStatus.UNKNOWN_OPCODE, UNKNOWN_OPCODE, b"", "an unknown opcode")
    bench.last_id += 1
    ack = bench.command(Opcode.STOP, number=bench.last_id)
    need(ack.refused_id == first + 2, f"refused id {ack.refused_id}, expected {first + 2}")
    need(ack.refused_mask & 0xF == 0b1010, f"refused mask {ack.refused_mask:#b}, expected it to end in 1010")
    for _ in range(32):
        bench.last_id += 1
        ack = bench.command(Opcode.STOP, number=bench.last_id)
        wanted = sum(1 << bench.last_id - number for number in (first, first + 2) if bench.last_id - number < 32)
        need(
            ack.refused_mask == wanted,
            f"refused mask {ack.refused_mask:#b} at command {bench.last_id}, expected {wanted:#b}",
        )


@rule("4.5", "An unknown opcode is refused with 1.")
def unknown_opcode(bench: Bench) -> None:
    for opcode in (0, 0x3F, 0x80, 0xFF):
        bench.refused(AckStatus.UNKNOWN_OPCODE, opcode, b"", f"opcode {opcode:#04x}")


@rule("4.6", "A body that cannot be meant is refused with 2.")
def malformed(bench: Bench) -> None:
    layout = bench.layout()
    plan = pack_command(layout.chunk())
    head, long_head = (struct.pack("<HHII", 0, 0, 0, pixels) for pixels in (4, 2 * MAX_PIXELS_PER_CHUNK))
    for opcode, body, what in (
        (Opcode.STOP, b"x", "STOP with a body"),
        (Opcode.RESET, b"xy", "RESET with a body"),
        (Opcode.ARM, bytes(23), "ARM of 23 bytes"),
        (Opcode.ARM, bytes(25), "ARM of 25 bytes"),
        (Opcode.LOAD_PATTERN, head, "LOAD_PATTERN without levels"),
        (Opcode.LOAD_PATTERN, head + b"\0", "LOAD_PATTERN with half a level"),
        (Opcode.LOAD_PATTERN, head + bytes(10), "LOAD_PATTERN with five levels of four"),
        (Opcode.LOAD_PATTERN, long_head + bytes(2 * MAX_PIXELS_PER_CHUNK + 2), "LOAD_PATTERN with 4097 levels"),
        (Opcode.LOAD_PLAN, plan[:20], "a part of LOAD_PLAN's header"),
        (Opcode.LOAD_PLAN, plan[:36], "LOAD_PLAN without slots"),
        (Opcode.LOAD_PLAN, plan[:-5], "LOAD_PLAN with a part of a slot"),
        (Opcode.LOAD_PLAN, plan + bytes(12), "LOAD_PLAN with more slots than it says"),
    ):
        bench.refused(MALFORMED, opcode, body, what)


@rule("4.7", "LOAD_PATTERN outside its ranges, or out of order, is refused with 3.")
def pattern_ranges(bench: Bench) -> None:
    facts = bench.facts

    def refuse(index: int, first: int, whole: int, level: int, what: str) -> None:
        body = struct.pack("<HHIIH", index, 0, first, whole, level)
        bench.refused(RANGE, Opcode.LOAD_PATTERN, body, what)

    if facts["pattern_memory"] <= 0xFFFF:
        refuse(facts["pattern_memory"], 0, 4, 0, "a pattern beyond the memory")
    if facts["levels"] <= 0xFFFF:
        refuse(0, 0, 4, facts["levels"], "a level that the projector does not have")
        wrong = next(bench.layout().patterns())
        wrong.levels[-1] = facts["levels"]
        what = "a last level that the projector does not have"
        bench.refused(RANGE, Opcode.LOAD_PATTERN, pack_command(wrong), what)
    if facts["pattern_pixels"] < 0xFFFFFFFF:
        refuse(0, 0, facts["pattern_pixels"] + 1, 0, "a pattern of too many pixels")
    refuse(1 if facts["pattern_memory"] > 1 else 0, 2, 4, 0, "a piece that continues nothing")


@rule("4.8", "LOAD_PLAN outside its ranges is refused with 3.")
def plan_ranges(bench: Bench) -> None:
    layout = bench.layout()
    good = layout.chunk()
    most = bench.facts["channels"] if layout.mode else bench.facts["pattern_memory"]
    wrong: list[dict[str, Any]] = [
        {"mode": 1 - layout.mode},
        {"n_patterns": 0},
        {"exposure_ticks": 0},
        {"slot_period_ticks": 0},
        {"cycle_ticks": 0},
        {"cycle_ticks": (1 << 48) + 1},
        {"block_exposures": 0},
        {"cycles_per_object": 0},
    ]
    if most < 0xFFFF:
        wrong.append({"n_patterns": most + 1})
    if bench.facts["slot_memory"] < 0xFFFFFFFF:
        wrong.append({"n_slots": bench.facts["slot_memory"] + 1})
    for fields in wrong:
        bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(good._replace(**fields)), f"LOAD_PLAN with {fields}")
    # All slots moved until the last one begins at the end of the cycle: their spacing is still right.
    moved = good.slots.copy()
    moved["offset_ticks"] += np.uint64(good.cycle_ticks) - moved["offset_ticks"][-1]
    bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(good._replace(slots=moved)), "a slot at the end of the cycle")
    # The gap from the last slot to the first of the next cycle is one tick shorter than an exposure.
    short = int(good.slots["offset_ticks"][-1]) + good.exposure_ticks - 1
    what = "the last exposure of a cycle over the first of the next"
    bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(good._replace(cycle_ticks=short)), what)
    turned = good.slots.copy()
    turned["offset_ticks"][:2] = good.slots["offset_ticks"][1::-1]
    bench.refused(
        RANGE, Opcode.LOAD_PLAN, pack_command(good._replace(slots=turned)), "slots that are not in order of time"
    )
    for field, value in (("offset_ticks", good.cycle_ticks), ("pattern", good.n_patterns)):
        slots = good.slots.copy()
        slots[field][-1] = value
        bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(good._replace(slots=slots)), f"a slot with {field} {value}")


@rule("4.22", "Pieces of a plan come in order and repeat its header, else 3; first slot 0 starts over.")
def plan_pieces(bench: Bench) -> None:
    whole = bench.layout(shown=(DARK_PATTERN,) * 4).chunk()

    def piece(first: int, stop: int, **header: Any) -> bytes:
        return pack_command(whole._replace(first_slot=first, slots=whole.slots[first:stop], **header))

    bench.upload(bench.layout())
    bench.done(Opcode.LOAD_PLAN, piece(0, 2))
    bench.refused(RANGE, Opcode.LOAD_PLAN, piece(3, 4), "a piece of a plan behind a gap")
    bench.refused(RANGE, Opcode.LOAD_PLAN, piece(1, 2), "a piece of a plan over an earlier one")
    for header in (
        {"n_slots": whole.n_slots + 1},
        {"exposure_ticks": whole.exposure_ticks + 1},
        {"slot_period_ticks": whole.slot_period_ticks + 1},
        {"cycle_ticks": whole.cycle_ticks + 1},
        {"block_exposures": whole.block_exposures + 1},
        {"cycles_per_object": whole.cycles_per_object + 1},
        *([{"n_patterns": whole.n_patterns - 1}] if whole.n_patterns > 1 else []),
    ):
        bench.refused(
            RANGE, Opcode.LOAD_PLAN, piece(2, 4, **header), f"a piece of a plan with another header, {header}"
        )
    bench.arm_refused("ARM with two of four slots")
    bench.done(Opcode.LOAD_PLAN, piece(2, 4))
    bench.arm(1, ahead_s=20.0, lease_ms=20_000)
    bench.done(Opcode.STOP)
    bench.done(Opcode.LOAD_PLAN, piece(0, 1))
    bench.done(Opcode.LOAD_PLAN, piece(0, 2))
    bench.done(Opcode.LOAD_PLAN, piece(2, 4))


@rule(
    "4.9",
    "ARM without a complete plan, or with a pattern of it missing or incomplete, is refused with 4; with patterns of several sizes, or "
    "when they are loaded, with 3.",
)
def arm_without_plan(bench: Bench) -> None:
    bench.open()
    body = pack_command(Arm(bench.ping().tx_tick + bench.facts["tick_hz"], 1, 1000))
    bench.refused(STATE, Opcode.ARM, body, "ARM in a new session")
    layout = bench.layout()
    bench.upload(layout)
    slots = layout.chunk()
    bench.done(Opcode.LOAD_PLAN, pack_command(slots._replace(slots=slots.slots[:1])))
    body = pack_command(Arm(bench.ping().tx_tick + bench.facts["tick_hz"], 1, 1000))
    bench.refused(STATE, Opcode.ARM, body, "ARM after the first of several pieces of a plan")
    for number in range(layout.n_patterns):
        for kept in sorted({0, min(layout.pixels // 2, MAX_PIXELS_PER_CHUNK)}):
            bench.open()
            for opcode, part in layout.commands():
                if opcode != Opcode.LOAD_PATTERN or int.from_bytes(part[:2], "little") != number:
                    bench.done(opcode, part)
            if kept:
                levels = np.zeros(kept, np.uint16)
                bench.done(Opcode.LOAD_PATTERN, pack_command(PatternChunk(number, 0, layout.pixels, levels)))
            body = pack_command(Arm(bench.ping().tx_tick + bench.facts["tick_hz"], 1, 1000))
            bench.refused(STATE, Opcode.ARM, body, f"ARM with {kept} of {layout.pixels} pixels of pattern {number}")
    _refused_plan(bench, layout)
    if layout.n_patterns > 1 and layout.pixels > 1:
        _two_sizes(bench, layout)


def _refused_plan(bench: Bench, layout: Layout) -> None:
    """A plan that was refused because of its last slot is no plan."""
    bench.open()
    bench.upload(layout)
    good = layout.chunk()
    overlapping = good._replace(cycle_ticks=int(good.slots["offset_ticks"][-1]) + 1)
    bench.refused(RANGE, Opcode.LOAD_PLAN, pack_command(overlapping), "a plan whose cycles overlap")
    bench.arm_refused("ARM with a plan that was refused")


def _two_sizes(bench: Bench, layout: Layout) -> None:
    bench.open()
    bench.upload(layout)
    half = PatternChunk(1, 0, layout.pixels // 2, np.zeros(min(layout.pixels // 2, MAX_PIXELS_PER_CHUNK), np.uint16))
    opcode, body = Opcode.LOAD_PATTERN, pack_command(half)
    ack = bench.command(opcode, body)
    if ack.refuses(bench.last_id):
        need(ack.status == RANGE, f"a second pattern of another size was refused with {ack.status}, expected {RANGE}")
    else:
        for first in range(MAX_PIXELS_PER_CHUNK, half.n_pixels, MAX_PIXELS_PER_CHUNK):
            rest = np.zeros(min(half.n_pixels - first, MAX_PIXELS_PER_CHUNK), np.uint16)
            bench.done(opcode, pack_command(half._replace(first_pixel=first, levels=rest)))
        body = pack_command(Arm(bench.ping().tx_tick + bench.facts["tick_hz"], 1, 1000))
        bench.refused(RANGE, Opcode.ARM, body, "ARM with patterns of two sizes")


@rule(
    "4.10",
    "ARM outside its ranges is refused: 5 for a start that has passed, 3 for a lease of 0 or more than an hour, or a start too far ahead.",
)
def arm_ranges(bench: Bench) -> None:
    bench.upload(bench.layout())
    now, hz = bench.ping().tx_tick, bench.facts["tick_hz"]
    for status, arm, what in (
        (LATE, Arm(now, 1, 1000), "ARM for a tick that has passed"),
        (LATE, Arm(0, 1, 1000), "ARM for tick 0"),
        (RANGE, Arm(now + hz, 1, 0), "ARM with a lease of 0"),
        (RANGE, Arm(now + hz, 1, 3_600_001), "ARM with a lease of more than an hour"),
        (RANGE, Arm(now + 3601 * hz, 1, 1000), "ARM for more than an hour ahead"),
        (RANGE, Arm(now + hz, 1 << 62, 1000), "ARM for 2^62 cycles"),
    ):
        bench.refused(status, Opcode.ARM, pack_command(arm), what)
    bench.inbox.clear()
    status = bench.until_state(DeviceState.IDLE)
    need(status.state == DeviceState.IDLE, "a refused ARM changed the state")


@rule("4.11", "LOAD_PATTERN, LOAD_PLAN and ARM are refused with 4 outside IDLE.")
def uploads_need_idle(bench: Bench) -> None:
    layout = bench.layout()
    bench.upload(layout)
    start = bench.arm(0, ahead_s=20.0, lease_ms=20_000)
    for opcode, body in (*layout.commands(), (Opcode.ARM, pack_command(Arm(start + 1, 1, 1000)))):
        bench.refused(STATE, opcode, body, f"{Opcode(opcode).name} while ARMED")
    bench.done(Opcode.STOP)


@rule(
    "4.12",
    "GATE is refused with 4 in IDLE, with 5 when its tick has passed, with 3 outside its ranges or when the list is full, with 2 of "
    "another length, and carried out ahead of time.",
)
def gates(bench: Bench) -> None:
    now, hz = bench.ping().tx_tick, bench.facts["tick_hz"]
    bench.refused(STATE, Opcode.GATE, pack_command(Gate(now + hz, 1, 0)), "GATE in IDLE")
    bench.upload(bench.layout())
    bench.arm(0, ahead_s=20.0, lease_ms=20_000)
    now = bench.ping().tx_tick
    for status, gate, what in (
        (LATE, Gate(now, 100, 0), "GATE for a tick that has passed"),
        (RANGE, Gate(now + hz, 0, 0), "GATE for 0 ticks"),
        (RANGE, Gate(now + hz, 1, 0xFFFF), "GATE of output 65535"),
        (RANGE, Gate(1 << 63, 1, 0), "GATE at tick 2^63"),
    ):
        bench.refused(status, Opcode.GATE, pack_command(gate), what)
    body = pack_command(Gate(now + 15 * hz, hz // 1000, 0))
    for wrong in (body[:-1], body + b"\0"):
        bench.refused(MALFORMED, Opcode.GATE, wrong, f"GATE of {len(wrong)} bytes")
    if bench.facts.get("gate_channels", 1):
        bench.done(Opcode.GATE, pack_command(Gate(bench.ping().tx_tick + hz // 2, hz // 1000, 0)))
        for count in range(1, MOST_GATES):
            ack = bench.command(Opcode.GATE, body)
            if ack.refuses(bench.last_id):
                need(
                    ack.status == RANGE,
                    f"GATE {count} more was refused with {ack.status} ({ack.text}), expected {RANGE}",
                )
                break
    bench.done(Opcode.STOP)


@rule("4.13", "Pieces of a pattern come in order, and first pixel 0 starts over.")
def pattern_pieces(bench: Bench) -> None:
    whole = bench.layout().pixels
    if whole < 6:
        raise NotTried("patterns of less than six pixels")

    def piece(first: int, count: int) -> bytes:
        return pack_command(PatternChunk(0, first, whole, np.zeros(count, np.uint16)))

    bench.done(Opcode.LOAD_PATTERN, piece(0, 2))
    bench.refused(RANGE, Opcode.LOAD_PATTERN, piece(3, 1), "a piece behind a gap")
    other = pack_command(PatternChunk(0, 2, whole - 1, np.zeros(1, np.uint16)))
    bench.refused(RANGE, Opcode.LOAD_PATTERN, other, "a piece of a pattern with another number of pixels")
    bench.done(Opcode.LOAD_PATTERN, piece(2, 2))
    bench.done(Opcode.LOAD_PATTERN, piece(0, 2))
    bench.refused(RANGE, Opcode.LOAD_PATTERN, piece(4, 1), "a piece behind a gap, after first pixel 0")
    bench.done(Opcode.LOAD_PATTERN, piece(2, min(whole - 2, MAX_PIXELS_PER_CHUNK)))


@rule("4.21", "Command ids go on past 65 536.", long=True)
def many_commands(bench: Bench) -> None:
    while bench.last_id < MANY_COMMANDS:
        ids = range(bench.last_id + 1, bench.last_id + 1 + AT_ONCE)
        bench.last_id = ids[-1]
        bench.inbox.clear()
        bench.send(b"".join(encode_command(number, Opcode.STOP, b"", bench.session) for number in ids))
        bench.wait(MessageType.ACK, lambda ack: ack.last_id == bench.last_id, what=f"of command {bench.last_id}")
    bench.done(Opcode.STOP)
