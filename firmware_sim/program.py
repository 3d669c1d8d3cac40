"""What the device runs: a plan as it stands in the device's memory after the upload.

Owns the facts only. The device checks and compiles a program (device/upload.py); scenes read from it when light is shown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.wire.commands import PARALLEL


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
    def n_slots(self) -> int:
        return len(self.offsets)

    @property
    def channels(self) -> int:
        return self.n_patterns if self.mode == PARALLEL else 1
