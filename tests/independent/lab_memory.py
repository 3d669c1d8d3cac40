"""What has been uploaded to the independent firmware (protocol.md, section 4): patterns and plan, in order and within limits.

Owns the checks of LOAD_PATTERN and LOAD_PLAN and the statuses of refusals. Imports nothing of the package.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from lab_run import DARK, Plan
from numpy.typing import NDArray

UNKNOWN, MALFORMED, RANGE, STATE, LATE = range(1, 6)
MAX_PIXELS = 1 << 22
PATTERN_MEMORY = 1024
SLOT_MEMORY = 1 << 16


class Refused(Exception):
    """A command that is not carried out: status and text."""


@dataclass
class Memory:
    """Patterns and plan of one session; `channels` is 0 for one detector, `pixels` is the width times the height that it is set to."""

    channels: int
    levels: int
    pixels: int
    patterns: dict[int, tuple[int, list[int]]] = field(default_factory=dict)  # pixels in all, levels so far
    plan_head: tuple[int, ...] = ()
    plan_slots: list[tuple[int, int, int]] = field(default_factory=list)

    def load_pattern(self, body: bytes) -> None:
        """LOAD_PATTERN."""
        index, _, first, pixels = struct.unpack_from("<HHII", body)
        count, odd = divmod(len(body) - 12, 2)
        if odd or not 0 < count <= 4096 or first + count > pixels:
            raise Refused(MALFORMED, "levels of a pattern")
        levels = list(struct.unpack_from(f"<{count}H", body, 12))
        if first == 0:
            self.patterns[index] = (pixels, [])
        wanted, held = self.patterns.get(index, (0, []))
        good = index < PATTERN_MEMORY and pixels <= MAX_PIXELS and max(levels) < self.levels
        if not good or first != len(held) or pixels != wanted or pixels != self.pixels:
            raise Refused(RANGE, f"pattern {index}, pixel {first} of {pixels}")
        held += levels

    def load_plan(self, body: bytes) -> None:
        """LOAD_PLAN."""
        head = struct.unpack_from("<BBHIIIIQHHI", body)
        mode, _, patterns, n_slots, first, exposure, _, cycle, longest, _, per_object = head
        count, odd = divmod(len(body) - 36, 12)
        if odd or not 0 < count <= 1024 or first + count > n_slots:
            raise Refused(MALFORMED, "slots of a plan")
        slots = list(struct.iter_unpack("<QHH", body[36:]))
        if first == 0:
            self.plan_head, self.plan_slots = head, []
        follows = first == len(self.plan_slots) and (*head[:4], *head[5:]) == (*self.plan_head[:4], *self.plan_head[5:])
        most = self.channels if self.channels else PATTERN_MEMORY
        good = bool(mode) == bool(self.channels) and 0 < patterns <= most and n_slots <= SLOT_MEMORY
        if not (follows and good and exposure and longest and per_object and cycle <= 1 << 48):
            raise Refused(RANGE, f"plan from slot {first}")
        shown = [pattern for _, pattern, _ in slots if pattern != DARK]
        starts = [start for start, _, _ in self.plan_slots[-1:] + slots]
        apart = all(after - before >= exposure for before, after in pairwise(starts))
        if not apart or starts[-1] + exposure > cycle or max(shown, default=0) >= patterns:
            raise Refused(RANGE, f"slots from {first} on")
        self.plan_slots += slots

    def complete(self) -> tuple[Plan, NDArray[np.uint16]]:
        """Return plan and patterns, (patterns, pixels), if all of them are here."""
        if not self.plan_head or len(self.plan_slots) < self.plan_head[3]:
            raise Refused(STATE, "no complete plan")
        mode, _, n_patterns, _, _, exposure, spacing, cycle, longest, _, per_object = self.plan_head
        chosen = [self.patterns.get(index, (1, [])) for index in range(n_patterns)]
        if any(len(levels) < pixels for pixels, levels in chosen):
            raise Refused(STATE, "a pattern is missing")
        plan = Plan(mode, n_patterns, exposure, spacing, cycle, longest, per_object, list(self.plan_slots))
        return plan, np.array([levels for _, levels in chosen], np.uint16)
