"""The facts of scenes that move, and their limits: cells that cross the field of the patterns, an endless tape of bars, and changes.

Moving scenes stand before parallel instruments: static patterns, one frame of all channels per exposure.

Cells: the centres of the cells pass the middle of the field as a Poisson process. A cell's picture is as large as the patterns and moves
from left to right, from one field before the middle to one behind it, at its own constant speed. Tape: bars run through a window of
`bars` bars at a steady speed with a stationary position error.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .still import Scene

# Of cells, fields or bars per second: below, times in ticks pass what 53 bits hold, and a run would wait for the first one without end.
MIN_HZ = 1e-3
MAX_RATE_HZ = 1e6
MAX_SPEED_HZ = 1e7  # fields or bars per second
MAX_SPREAD = 0.5
MAX_OFFSET_PX = 64
MAX_BARS = 63  # a window is named by its bits
MAX_PIXELS_PER_BAR = 1024
MAX_JITTER_BARS = 0.1  # beyond, a tape could run backwards between two bars
MAX_CHANGES = 4096
ALL_CHANNELS = -1
CHANGE_KINDS = ("dark", "burst", "hot", "dead", "drift")


class Change(NamedTuple):
    """Something that is different from `at_s` (seconds after the run's start) for `for_s` seconds, on one channel or on all.

    dark: dark rate times `amount`; burst and hot: `amount` more photoelectrons per second; dead: no clicks; drift: the efficiency
    changes by `amount` percent of its first value per second, and stays where it is when the time is over.

    Of a profile alone: threshold rises by `amount` electrons per second; telegraph: the reading is `amount` electrons higher now and then,
    at random (`at_s` is the seed), `for_s` seconds at a time in the mean.
    """

    kind: str
    at_s: float
    for_s: float
    channel: int
    amount: float


@dataclass(frozen=True, slots=True)
class Cells:
    """Cells in flow: who passes (`objects`), how many a second, how fast, how far off the middle line, and when none come.

    velocity_fields_per_s is the mean and velocity_spread the relative standard deviation of a log-normal law cut at 4 sigma; offsets are
    whole pixels, each of -offset_px..offset_px equally likely. In every gap_every_s seconds the last gap_s are empty (0: none).
    """

    objects: Scene
    rate_hz: float
    velocity_fields_per_s: float
    velocity_spread: float = 0.0
    offset_px: int = 0
    background_transmission: float = 0.0
    gap_every_s: float = 0.0
    gap_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Tape:
    """Bars of transmission 1 or 0; `file_bits` uint8 (n,) repeats without end, empty: fair random bits.

    jitter_bars is the standard deviation of the position error, an Ornstein-Uhlenbeck process of correlation time jitter_time_s. A
    window of `bars` bars that contains `target` is of class 1, any other of class 0.
    """

    bars: int
    pixels_per_bar: int
    speed_bars_per_s: float
    jitter_bars: float = 0.0
    jitter_time_s: float = 0.0
    target: str = "1010"
    file_bits: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))


@dataclass(frozen=True, slots=True)
class SceneFile:
    """A scene as a file describes it: what stands or moves before the detector, and what changes meanwhile."""

    name: str
    what: Scene | Cells | Tape
    changes: tuple[Change, ...] = ()

    @property
    def moves(self) -> bool:
        """Whether objects flow past on their own, instead of waiting for the plan."""
        return not isinstance(self.what, Scene)

    @property
    def n_objects(self) -> int:
        """Different objects that can pass; 0: without end."""
        if isinstance(self.what, Tape):
            return len(self.what.file_bits)
        return (self.what if isinstance(self.what, Scene) else self.what.objects).n_objects
