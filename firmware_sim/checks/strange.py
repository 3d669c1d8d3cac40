"""Commands that no host sends: the opcodes of the protocol and others, with bodies that nearly fit.

Owns the choice of commands for an instrument that is fuzzed (trials/fuzz.py); never judges what comes of them. Most are good enough to be
carried out now and then, as a fuzzer whose input is always refused at once proves little.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from pans.firmware_sim.device.instrument import Instrument
from pans.runtime.wire import messages as wire
from pans.runtime.wire.commands import (
    Arm,
    CountStateChunk,
    Gate,
    MaskChunk,
    PatternChunk,
    PlanChunk,
    Show,
    StateChunk,
    pack_arm,
    pack_count_states,
    pack_gate,
    pack_masks,
    pack_pattern,
    pack_plan,
    pack_read_counts,
    pack_show,
    pack_states,
    state_dtype,
)
from pans.runtime.wire.messages import ADAPTIVE_PATTERN, Opcode
from pans.runtime.wire.schema import STATE_DTYPE

EDGES = (
    0, 1, 2, 3, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1,
)  # fmt: skip


class StrangeCommands:
    """Commands drawn from `dice`."""

    def __init__(self, dice: random.Random) -> None:
        self._dice = dice

    def number(self, bits: int) -> int:
        """A number of up to `bits` bits, at an edge half of the time."""
        dice = self._dice
        if dice.random() < 0.5:
            return dice.choice(EDGES) & ((1 << bits) - 1)
        return dice.getrandbits(dice.randint(1, bits))

    def command(self, device: Instrument, session: int) -> bytes:
        """A command for `device`: most have a right id and a body that fits the opcode, and a strange number somewhere."""
        dice = self._dice
        expected = device._ack.last_id + 1
        number = expected if dice.random() < 0.9 else self.number(32)
        opcode = dice.choice((*Opcode, *Opcode, dice.randrange(256)))
        body = (
            dice.randbytes(dice.choice((0, 1, 12, 24, 36, 100)))
            if dice.random() < 0.2
            else self._body(opcode, device.tick)
        )
        return wire.encode_command(number, opcode, body, session)

    def _body(self, opcode: int, tick: int) -> bytes:
        dice = self._dice
        if opcode == Opcode.LOAD_PATTERN:
            levels = np.array([self.number(16) for _ in range(dice.choice((1, 4)))], np.uint16)
            small = dice.random() < 0.8
            whole = len(levels) if small else self.number(32)
            return pack_pattern(PatternChunk(dice.randrange(3) if small else self.number(16), 0, whole, levels))
        if opcode == Opcode.LOAD_PLAN:
            return self._plan()
        if opcode == Opcode.ARM:
            start = tick + dice.randrange(1, 100) if dice.random() < 0.8 else self.number(64)
            cycles = dice.randrange(4) if dice.random() < 0.8 else self.number(64)
            return pack_arm(Arm(start, cycles, dice.randrange(1, 2000) if dice.random() < 0.8 else self.number(32)))
        if opcode == Opcode.GATE:
            near = tick + dice.randrange(1000)
            return pack_gate(Gate(near if dice.random() < 0.8 else self.number(64), self.number(32), dice.randrange(9)))
        if opcode == Opcode.LOAD_MASKS:
            return self._masks()
        if opcode == Opcode.LOAD_STATES:
            return self._states()
        if opcode == Opcode.READ_COUNTS:
            largest, detectors = dice.choice(((2, 0), (2, 0), (3, 2)))
            asked = (largest, detectors) if dice.random() < 0.8 else (self.number(16), self.number(16))
            return pack_read_counts(*asked)
        if opcode == Opcode.LOAD_COUNT_STATES:
            return self._count_states()
        if opcode == Opcode.SHOW:
            near = dice.randrange(12) if dice.random() < 0.8 else self.number(64)
            state, pattern = (self.number(16) if dice.random() < 0.1 else dice.randrange(3) for _ in range(2))
            dwell, steps = dice.choice((1, 1, 4, self.number(16))), dice.choice((1, 4, 4, self.number(16)))
            return pack_show(Show(near, state, pattern, dwell, steps))
        return b""

    def _masks(self) -> bytes:
        dice = self._dice
        pixels = dice.choice((1, 4, 9))
        rows = np.frombuffer(dice.randbytes(dice.choice((1, 2, 3)) * -(-pixels // 8)), np.uint8).reshape(
            -1, -(-pixels // 8)
        )
        chunk = MaskChunk(dice.randrange(2), 0, pixels, pixels, rows)
        if dice.random() < 0.3:
            name, bits = dice.choice((("first_pattern", 16), ("first_pixel", 32), ("n_pixels", 32), ("pixels", 32)))
            changes: dict[str, Any] = {name: self.number(bits)}
            chunk = chunk._replace(**changes)
        return pack_masks(chunk)

    def _states(self) -> bytes:
        """Now and then a chain of states that can be followed, mostly one with a strange number."""
        dice = self._dice
        n = dice.choice((1, 2, 3))
        rows = np.array([(dice.randrange(2), dice.choice((1, 4)), s + 1, s + 2) for s in range(n)], STATE_DTYPE)
        chunk = StateChunk(n, 0, 4, 2, rows)
        if dice.random() < 0.3:
            name, bits = dice.choice((("n_states", 16), ("first_state", 16), ("dwell_steps", 16), ("n_leaves", 32)))
            changes: dict[str, Any] = {name: self.number(bits)}
            chunk = chunk._replace(**changes)
        if dice.random() < 0.3:
            name, bits = dice.choice((("pattern", 16), ("dwell", 16), ("next_dark", 32), ("next_click", 32)))
            rows[name][dice.randrange(n)] = self.number(bits)
        return pack_states(chunk)

    def _count_states(self) -> bytes:
        """As `_states`, of photon numbers."""
        dice = self._dice
        n, outcomes = dice.choice((1, 2, 3)), dice.choice((3, 3, 3, 4, 16))
        rows = np.zeros(n, state_dtype(outcomes))
        rows["dwell"], rows["next"] = 4, np.arange(n)[:, None] + 1 + np.arange(outcomes) % 2
        chunk = CountStateChunk(n, 0, 4, outcomes, 2, rows)
        if dice.random() < 0.3:
            name, bits = dice.choice((("n_states", 16), ("first_state", 16), ("dwell_steps", 16), ("n_leaves", 32)))
            changes: dict[str, Any] = {name: self.number(bits)}
            chunk = chunk._replace(**changes)
        if dice.random() < 0.3:
            rows["next"][dice.randrange(n), dice.randrange(outcomes)] = self.number(32)
        return pack_count_states(chunk)

    def _plan(self) -> bytes:
        dice = self._dice
        n_slots = dice.choice((1, 2, 5))
        slots = np.zeros(n_slots, wire.SLOT_DTYPE)
        slots["offset_ticks"] = np.arange(n_slots) * 100
        shown = (0, 1, 0xFFFF) if dice.random() < 0.5 else (ADAPTIVE_PATTERN, ADAPTIVE_PATTERN, 0xFFFF)
        slots["pattern"] = [dice.choice(shown) for _ in range(n_slots)]
        chunk = PlanChunk(0, 2, n_slots, 0, 80, 100, 100 * n_slots, dice.choice((1, 16)), 1, slots)
        for _ in range(dice.choice((0, 0, 0, 1, 2))):
            name, bits = dice.choice(
                (("mode", 8), ("n_patterns", 16), ("n_slots", 32), ("first_slot", 32), ("exposure_ticks", 32),
                 ("slot_period_ticks", 32), ("cycle_ticks", 64), ("block_exposures", 16), ("cycles_per_object", 32))
            )  # fmt: skip
            changes: dict[str, Any] = {name: self.number(bits)}
            chunk = chunk._replace(**changes)
        if dice.random() < 0.1:
            slots["offset_ticks"][dice.randrange(n_slots)] = self.number(64)
        return pack_plan(chunk)
