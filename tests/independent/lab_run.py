"""One armed run of the independent firmware: which stream message is due when, and what is in it (protocol.md, "The plan" and section 5).

Owns the schedule and the bytes of CLICKS, FRAMES and MARK but for what the stream adds: sequence and drops. Imports nothing of the package.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from lab_frames import CLICKS, FRAMES, MARK
from lab_light import Light

DARK = 0xFFFF
Maker = Callable[[int, int], bytes]  # sequence, drops -> payload


@dataclass
class Plan:
    """A complete plan and how its cycle is cut into blocks: (first slot, exposures)."""

    mode: int
    patterns: int
    exposure_ticks: int
    spacing: int
    cycle_ticks: int
    longest_block: int
    cycles_per_object: int
    slots: list[tuple[int, int, int]]

    def blocks(self) -> list[tuple[int, int]]:
        """Consecutive, equally spaced slots, as many as a block may hold."""
        cut, first = [], 0
        for slot in range(1, len(self.slots) + 1):
            ends = slot == len(self.slots) or slot - first == self.longest_block
            if ends or self.slots[slot][0] - self.slots[slot - 1][0] != self.spacing:
                cut.append((first, slot - first))
                first = slot
        return cut


class Run:
    """One armed run: which stream message is due when, and what is in it."""

    def __init__(self, plan: Plan, start: int, cycles: int, light: Light, channels: int) -> None:
        self.plan, self.start, self.cycles, self.light, self.channels = plan, start, cycles, light, channels
        self.over = False
        self._blocks = plan.blocks()
        self._cycle = self._block = 0
        self._marked = -1  # the latest object that has been announced

    def dues(self) -> list[int]:
        """Tick of the next message, or of the end of the run."""
        base = self.start + self._cycle * self.plan.cycle_ticks
        if self.over:
            return [base]
        if self._marked < self._cycle // self.plan.cycles_per_object:
            return [base + self.plan.slots[0][0]]
        first, count = self._blocks[self._block]
        return [base + self.plan.slots[first + count - 1][0] + self.plan.exposure_ticks]

    def emit(self) -> tuple[int, int, Maker]:
        """Return type, exposures and maker of the message that is due; the maker takes sequence and drops."""
        number = self._cycle // self.plan.cycles_per_object
        if self._marked < number:
            self._marked = number
            truth, photons = self.light.truth(number)
            exposure, tick = self._cycle * len(self.plan.slots), self._mark_tick()
            return MARK, 0, lambda seq, drops: struct.pack("<IIhHQQf", seq, number, truth, 0, exposure, tick, photons)
        first, count = self._blocks[self._block]
        message = self._message(first, count)
        self._block += 1
        if self._block == len(self._blocks):
            self._block, self._cycle = 0, self._cycle + 1
            self.over = bool(self.cycles) and self._cycle == self.cycles
        return message

    def _mark_tick(self) -> int:
        """Tick of the first exposure on the present object."""
        return self.start + self._cycle * self.plan.cycle_ticks + self.plan.slots[0][0]

    def cut(self, tick: int) -> tuple[int, int, Maker] | None:
        """Return the exposures of the block under way that have ended by `tick`."""
        if self.over:
            return None
        first, count = self._blocks[self._block]
        latest = tick - self.start - self._cycle * self.plan.cycle_ticks - self.plan.exposure_ticks
        ended = sum(start <= latest for start, _, _ in self.plan.slots[first : first + count])
        return self._message(first, ended) if ended else None

    def begun(self, tick: int) -> int:
        """Exposures that have begun by `tick`."""
        cycle, within = divmod(tick - self.start, self.plan.cycle_ticks)
        if cycle < 0:
            return 0
        if self.cycles and cycle >= self.cycles:
            return self.cycles * len(self.plan.slots)
        return cycle * len(self.plan.slots) + sum(start <= within for start, _, _ in self.plan.slots)

    def ended(self, tick: int) -> int:
        """Exposures that have ended by `tick`."""
        return self.begun(tick - self.plan.exposure_ticks)

    def _message(self, first: int, count: int) -> tuple[int, int, Maker]:
        plan = self.plan
        number = self._cycle // plan.cycles_per_object
        slots = plan.slots[first : first + count]
        tick = self.start + self._cycle * plan.cycle_ticks + slots[0][0]
        exposure = self._cycle * len(plan.slots) + first
        shown = [pattern for _, pattern, _ in slots]
        if plan.mode:
            width = next(size for size in (1, 2, 4, *range(8, 8193, 8)) if 8 * size >= self.channels)
            bits = np.zeros((count, 8 * width), np.uint8)
            for row, pattern in zip(bits, shown, strict=True):
                used = np.full(plan.patterns, -1) if pattern == DARK else np.arange(plan.patterns)
                row[: plan.patterns] = self.light.clicks(number, used)
            kind, patterns = FRAMES, b""
        else:
            width, kind = 0, CLICKS
            bits = self.light.clicks(number, np.array([-1 if one == DARK else one for one in shown]))
            patterns = struct.pack(f"<{count}H", *shown)
        data = patterns + np.packbits(bits.ravel(), bitorder="little").tobytes()

        def message(sequence: int, drops: int) -> bytes:
            head = (sequence, drops, tick, exposure, plan.spacing, count, width, number % 0xFFFFFFFF)
            return struct.pack("<IIQQIHHI", *head) + data

        return kind, count, message
