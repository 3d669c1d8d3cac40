"""What the device runs: a plan as it stands in the device's memory after the upload.

Owns the facts only. The device checks and compiles a program (device/upload.py); scenes read from it when light is shown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.wire.commands import PARALLEL
from pans.runtime.wire.messages import ADAPTIVE_PATTERN


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
