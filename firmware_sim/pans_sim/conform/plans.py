"""Small plans for a device that only its profile and its WELCOME describe: bodies of LOAD_PATTERN and LOAD_PLAN.

Exposures are the shortest that the profile allows, at most a thousand a second, so that any host and any link can keep up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pans.instrument.profile import Profile
from pans.protocol.wire import (
    ADAPTIVE_PATTERN,
    DARK_PATTERN,
    MAX_PIXELS_PER_CHUNK,
    MODES,
    PARALLEL,
    SLOT_DTYPE,
    Opcode,
    PatternChunk,
    PlanChunk,
    pack_command,
)

MOST_EXPOSURES_HZ = 1000
NO_SHOT = 0xFFFF


@dataclass(frozen=True, slots=True)
class Layout:
    """A plan: what each slot of a cycle shows, and how the exposures follow each other."""

    mode: int
    shown: tuple[int, ...]
    exposure_ticks: int
    period_ticks: int
    tick_hz: int
    pixels: int
    levels: int
    n_patterns: int = 2
    block_exposures: int = 2
    cycles_per_object: int = 2
    pause_ticks: int = 0  # before the last slot of a cycle, so that the spacing breaks there
    seamless: bool = False  # the next cycle follows without a pause
    lead_ticks: int = (
        0  # from the start of a cycle to its first exposure; at most the half spacing that a cycle has to spare
    )

    @property
    def n_slots(self) -> int:
        """Slots of a cycle."""
        return len(self.shown)

    @property
    def cycle_ticks(self) -> int:
        """Ticks of a cycle: half a spacing more than its slots need, so that a cycle's end breaks the spacing too."""
        rest = 0 if self.seamless else self.period_ticks // 2
        return self.period_ticks * self.n_slots + self.pause_ticks + rest

    @property
    def offsets(self) -> list[int]:
        """Ticks from the start of a cycle to that of each of its exposures."""
        begins = [self.lead_ticks + slot * self.period_ticks for slot in range(self.n_slots)]
        return [*begins[:-1], begins[-1] + self.pause_ticks]

    def seconds(self, cycles: int) -> float:
        """How long a run lasts."""
        return cycles * self.cycle_ticks / self.tick_hz

    def begins(self, exposure: int) -> int:
        """Ticks from the start of the run to that of an exposure."""
        cycle, slot = divmod(exposure, self.n_slots)
        return cycle * self.cycle_ticks + self.offsets[slot]

    def chunk(self) -> PlanChunk:
        """LOAD_PLAN in one piece."""
        slots = np.zeros(self.n_slots, SLOT_DTYPE)
        slots["offset_ticks"] = self.offsets
        slots["pattern"] = self.shown
        slots["shot"] = [NO_SHOT if one == DARK_PATTERN else 0 for one in self.shown]
        return PlanChunk(
            self.mode, self.n_patterns, self.n_slots, 0, self.exposure_ticks, self.period_ticks, self.cycle_ticks,
            self.block_exposures, self.cycles_per_object, slots,
        )  # fmt: skip

    def patterns(self) -> Iterator[PatternChunk]:
        """LOAD_PATTERN: the first pattern is bright, every other one a chequer of levels 0 and 1."""
        for number in range(self.n_patterns):
            levels = np.arange(self.pixels, dtype=np.uint16) % 2 if number else np.full(self.pixels, self.levels - 1)
            for first in range(0, self.pixels, MAX_PIXELS_PER_CHUNK):
                part = levels[first : first + MAX_PIXELS_PER_CHUNK].astype(np.uint16)
                yield PatternChunk(number, first, self.pixels, part)

    def commands(self) -> Iterator[tuple[Opcode, bytes]]:
        """Opcode and body of everything that the device needs."""
        yield from ((Opcode.LOAD_PATTERN, pack_command(chunk)) for chunk in self.patterns())
        yield Opcode.LOAD_PLAN, pack_command(self.chunk())


def layout_for(profile: Profile, facts: Mapping[str, Any], pixels: int, **changes: Any) -> Layout:
    """Return a plan of one dark and two lit slots; `changes` replace fields of it, `adaptive=n` makes n adaptive slots and a dark one.

    `longer=x` makes exposures longer by x of the spacing, as far as the profile allows, and the spacing by as much. `rate_hz=x` makes
    cycles of one lit slot, at most so many a second: its pattern never changes, so that the projector does not limit them.
    """
    hz = int(facts["tick_hz"])
    mode = MODES[facts["mode"]]
    exposure = math.ceil(profile.exposure.min_us * hz / 1e6)
    turns = max(profile.exposure.readout_us, profile.timing.device_turn_us, 0.0)
    single = changes.pop("rate_hz", 0)
    changing = mode != PARALLEL and not single
    rate = min(single or MOST_EXPOSURES_HZ, profile.projector.pattern_rate_max_hz if changing else math.inf)
    period = max(exposure + math.ceil(turns * hz / 1e6) + 1, math.ceil(hz / rate) + 1)
    adaptive = changes.pop("adaptive", 0)
    lit = (0, 0) if mode == PARALLEL else (0, 1)
    shown = (ADAPTIVE_PATTERN,) * adaptive + (DARK_PATTERN,) if adaptive else (DARK_PATTERN, *lit)
    if single:
        shown, changes = (0,), {"block_exposures": 1, "cycles_per_object": 1, **changes}
    more = min(
        round(changes.pop("longer", 0) * period), max(0, math.floor(profile.exposure.max_us * hz / 1e6) - exposure)
    )
    exposure, period = exposure + more, period + more
    most = facts["channels"] if mode == PARALLEL else facts["pattern_memory"]
    levels, n_pixels = int(facts["levels"]), max(1, min(pixels, int(facts["pattern_pixels"])))
    made = Layout(mode, shown, exposure, period, hz, n_pixels, levels, n_patterns=min(2, int(most)))
    return replace(made, **changes)
