"""What the device runs: a plan as it stands in memory after the upload, and when the exposures of a run begin.

The device makes a `Program` from the upload (device/upload.py); scenes read from it what is shown, and from `Exposures` when.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, LARGEST_TICK, PARALLEL

I64 = NDArray[np.int64]
LONG_CYCLE = 4096  # exposures: so many are computed in one piece, without a division for each


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """An automaton that the device follows: pattern int64 and light float64 (states,), successors int64 (states, outcomes).

    `light` is the part of the exposure that the light is on. The successors are those after no click and after one, or after each photon
    number; from `len(pattern)` on they are leaves.
    """

    pattern: NDArray[np.int64]
    light: NDArray[np.float64]
    successors: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Program:
    """A complete plan: exposures of one cycle, int64 (slots,), and how they are cut into blocks (first slot, count)."""

    mode: int
    n_patterns: int
    exposure_ticks: int
    slot_period_ticks: int
    cycle_ticks: int
    cycles_per_object: int
    offsets: NDArray[np.int64]
    patterns: NDArray[np.uint16]
    blocks: tuple[tuple[int, int], ...]

    @property
    def adaptive(self) -> bool:
        """Whether the clicks choose what is shown."""
        return bool((self.patterns == ADAPTIVE_PATTERN).any())

    @property
    def n_slots(self) -> int:
        return len(self.offsets)

    @property
    def channels(self) -> int:
        return self.n_patterns if self.mode == PARALLEL else 1


class Exposures:
    """The exposures of `program` in `n_cycles` cycles (None: without end), on a clock of `tick_hz`."""

    def __init__(self, program: Program, n_cycles: int | None, tick_hz: int) -> None:
        self.n_exposures = None if n_cycles is None else n_cycles * program.n_slots
        self.exposure_ticks = program.exposure_ticks
        self.tick_hz = tick_hz
        self._cycle_ticks, self._n_slots, self._offsets = program.cycle_ticks, program.n_slots, program.offsets
        repeats = -(-LONG_CYCLE // program.n_slots)
        self._long_ticks = repeats * program.cycle_ticks
        cycles = np.arange(repeats, dtype=np.int64)[:, None] * program.cycle_ticks
        self._long_offsets: I64 = (cycles + program.offsets).reshape(-1)
        self._long_lit = np.tile(program.patterns != DARK_PATTERN, repeats)
        self.longest_period_ticks = int(np.diff(program.offsets, append=program.offsets[0] + program.cycle_ticks).max())

    def begins(self, first: int, count: int) -> I64:
        """Ticks at which exposures first..first+count-1 begin, int64 (count,); LARGEST_TICK for those that the counter does not reach."""
        parts = self._parts(first, count)
        if parts and (parts[-1][0] + 1) * self._long_ticks > LARGEST_TICK:
            return np.array([min(self.begin(first + k), LARGEST_TICK) for k in range(count)], np.int64)
        ticks = [self._long_offsets[part] + cycle * self._long_ticks for cycle, part in parts]
        return ticks[0] if len(ticks) == 1 else np.concatenate(ticks)

    def begin(self, exposure: int) -> int:
        """Tick at which one exposure begins; of any size, since the next mark may lie beyond the end of the counter."""
        cycle, slot = divmod(exposure, self._n_slots)
        return cycle * self._cycle_ticks + int(self._offsets[slot])

    def begins_of(self, exposures: I64) -> I64:
        """Ticks at which `exposures` begin, int64 of the same shape."""
        cycle, slot = np.divmod(exposures, self._n_slots)
        return np.asarray(cycle * self._cycle_ticks + self._offsets[slot])

    def lit(self, first: int, count: int) -> NDArray[np.bool_]:
        """Which of these exposures see light, bool (count,)."""
        lit = [self._long_lit[part] for _, part in self._parts(first, count)]
        return lit[0] if len(lit) == 1 else np.concatenate(lit)

    def _parts(self, first: int, count: int) -> list[tuple[int, slice]]:
        """The parts of long cycles that exposures first..first+count-1 are: number of the cycle, places in it."""
        parts, n_long, stop = [], len(self._long_offsets), first + count
        while first < stop:
            cycle, slot = divmod(first, n_long)
            n = min(n_long - slot, stop - first)
            parts.append((cycle, slice(slot, slot + n)))
            first += n
        return parts

    def begun_by(self, ticks: I64) -> I64:
        """How many exposures have begun before or at each of `ticks`, int64 of the same shape, as if the run had no end."""
        cycle, within = np.divmod(ticks, self._cycle_ticks)
        return np.asarray(cycle * self._n_slots + np.searchsorted(self._offsets, within, "right"))

    def seconds(self, ticks: NDArray[np.int64]) -> NDArray[np.float64]:
        """The same times in seconds."""
        return np.asarray(ticks / self.tick_hz)
