"""What a plan is, and how cycles become one: facts, times in whole ticks, slots and blocks.

Owns the arithmetic that all orders share; never decides whether hardware can do it (plan.py). The device ends a block at the end of a
cycle and where the spacing changes: the last block there may be a shorter one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import PlanError
from pans.runtime.instrument.profile import Profile
from pans.runtime.wire.messages import ADAPTIVE_PATTERN as ADAPTIVE_PATTERN
from pans.runtime.wire.messages import DARK_PATTERN as DARK_PATTERN

if TYPE_CHECKING:
    from pans.runtime.bundle.automaton import Automaton

NO_SHOT = 0xFFFF  # shot number of a dark slot
MAX_SLOTS = 1 << 20  # of one cycle; more would be 16 MB of plan on the wire
MAX_BLOCK_EXPOSURES = 1024  # keeps a click block near 2 kB
_U32 = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """One cycle of exposures; arrays are read-only, in order of time, one element per slot."""

    mode: str
    n_patterns: int
    slot_offset_ticks: NDArray[np.int64]  # start of the exposure within the cycle
    slot_pattern: NDArray[
        np.uint16
    ]  # DARK_PATTERN in a dark slot, ADAPTIVE_PATTERN where the clicks choose, 0 in parallel mode
    slot_shot: NDArray[np.uint16]  # the shot of the cycle that the exposure belongs to; NO_SHOT in a dark slot
    exposure_ticks: int
    slot_period_ticks: int  # distance of exposures inside a block
    cycle_ticks: int
    shots_per_cycle: int
    cycles_per_object: int
    block_exposures: int  # most exposures of one click block
    exposure_us: float  # of the exposure in whole ticks
    automaton: Automaton | None = (
        None  # what chooses the patterns of adaptive slots, ADAPTIVE_PATTERN in `slot_pattern`
    )
    drive: str = ""  # of an automaton: "device" if the device follows it, "host" if the host names each state
    largest: int = 1  # the largest number that an exposure can have: 1 of the clicks of one detector

    @property
    def channels_at_once(self) -> int:
        """Detectors that each exposure of a walk reads; their clicks are the bits of its number. 1 of fixed patterns."""
        return 1 if self.automaton is None else self.automaton.channels

    @property
    def n_channels(self) -> int:
        """Detectors that every exposure reads: all of a parallel plan, those of a walk, else 1."""
        return self.n_patterns if self.mode == "parallel" else self.channels_at_once

    @property
    def slots_per_cycle(self) -> int:
        """Exposures of one cycle, dark ones too."""
        return len(self.slot_pattern)

    @property
    def dark_slots_per_cycle(self) -> int:
        """Dark exposures of one cycle."""
        return int(np.count_nonzero(self.slot_pattern == DARK_PATTERN))

    @property
    def shots_per_object(self) -> int:
        """How often each pattern is exposed on one object: the K of a decision."""
        return self.shots_per_cycle * self.cycles_per_object

    @property
    def tick_us(self) -> float:
        """Length of one device tick in microseconds."""
        return self.exposure_us / self.exposure_ticks

    @property
    def cycle_us(self) -> float:
        """Length of one cycle in microseconds."""
        return self.cycle_ticks * self.tick_us

    @property
    def object_ticks(self) -> int:
        """Time for one object in ticks."""
        return self.cycle_ticks * self.cycles_per_object

    @property
    def objects_hz(self) -> float:
        """Objects, and so decisions, per second."""
        return 1e6 / (self.object_ticks * self.tick_us)

    @property
    def block_bytes(self) -> int:
        """Length of the longest click block's payload, about: clicks and pattern numbers, or words."""
        if self.mode == "parallel":
            return self.block_exposures * -(-self.n_patterns // 8)
        return self.block_exposures * 17 // 8


@dataclass(frozen=True, slots=True)
class Ticks:
    """The times that all orders share, in whole ticks."""

    exposure: int
    spacing: int  # exposure and readout: the least distance of two exposures
    refresh: float  # one refresh period of the projector, not rounded
    block: float  # longest block: a quarter of the decision deadline


def ticks_of(profile: Profile, exposure: float) -> Ticks:
    """Return the times of a plan with exposures of `exposure` us in whole ticks; PlanError beyond what the protocol counts."""
    per_us = profile.clock.tick_hz / 1e6
    exposure_ticks = max(1, round(exposure * per_us))
    spacing = exposure_ticks + up(profile.exposure.readout_us * per_us)
    refresh = profile.clock.tick_hz / profile.projector.pattern_rate_max_hz
    if max(spacing, refresh) > _U32:
        longest_s = _U32 / profile.clock.tick_hz
        raise PlanError(
            f"exposure and readout, or one refresh period, take {max(spacing, refresh):.4g} ticks of {profile.name}'s clock; "
            f"the protocol counts up to {_U32} ({longest_s:.4g} s)",
            remedy="use a slower clock.tick_hz or a shorter exposure",
        )
    return Ticks(exposure_ticks, spacing, refresh, profile.timing.decision_deadline_us * per_us / 4)


def up(ticks: float) -> int:
    """Round up to whole ticks, forgiving the last digits of a float."""
    return math.ceil(ticks * (1 - 1e-12))


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """One cycle of a plan to be made: `patterns`, `shots` and `offsets` int64 (slots,), the rest in ticks and exposures."""

    patterns: NDArray[np.int64]
    shots: NDArray[np.int64]
    offsets: NDArray[np.int64]
    cycle_ticks: int
    period: int
    shots_per_cycle: int
    cycles_per_object: int
    block: int


def lay_out(profile: Profile, n_patterns: int, cycle: Cycle, ticks: Ticks) -> Plan:
    """Return the plan of one cycle of `n_patterns` patterns."""
    arrays = (
        cycle.offsets.astype(np.int64),
        cycle.patterns.astype(np.uint16),
        np.where(cycle.patterns == DARK_PATTERN, NO_SHOT, cycle.shots).astype(np.uint16),
    )
    for array in arrays:
        array.setflags(write=False)
    return Plan(
        mode=profile.mode,
        n_patterns=n_patterns,
        slot_offset_ticks=arrays[0],
        slot_pattern=arrays[1],
        slot_shot=arrays[2],
        exposure_ticks=ticks.exposure,
        slot_period_ticks=cycle.period,
        cycle_ticks=cycle.cycle_ticks,
        shots_per_cycle=cycle.shots_per_cycle,
        cycles_per_object=cycle.cycles_per_object,
        block_exposures=cycle.block,
        exposure_us=ticks.exposure * 1e6 / profile.clock.tick_hz,
    )


def interleave(light: NDArray[np.int64], dark: int) -> NDArray[np.int64]:
    """Put `dark` dark displays before and between the `light` ones, evenly: dark display j before number floor(j n / dark)."""
    before = np.arange(dark) * len(light) // max(dark, 1)
    return np.insert(light, before, DARK_PATTERN)


def check_slots(slots: int, remedy: str) -> None:
    """Raise PlanError, with `remedy`, when a cycle would have too many slots."""
    if slots > MAX_SLOTS:
        raise PlanError(f"one cycle would have {slots} slots, allowed are {MAX_SLOTS}", remedy=remedy)


def block_exposures(slots: int, period: int, ticks: Ticks, most: int) -> int:
    """Exposures per block: blocks of about equal size that last at most a quarter of the decision deadline."""
    return even_blocks(slots, max(1, min(most, int(ticks.block // period))))


def even_blocks(exposures: int, most: int) -> int:
    """The length of as few blocks as possible of about equal length, none longer than `most`."""
    blocks = -(-exposures // most)
    return -(-exposures // blocks)
