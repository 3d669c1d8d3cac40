"""What the checkers remember of a run: each session's stream, what the device made, how much was checked.

Owns the facts; never compares them (checkers.py does).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

RING = 1 << 17  # exposures of a stream that are remembered
EMITTED, DELIVERED, LOST = 1, 2, 3


class Entry(NamedTuple):
    """One block as it left the detector; `dropped` when the device's buffer was full."""

    first: int
    exposures: int
    clicks: bytes
    object_index: int
    dropped: bool


@dataclass(slots=True)
class Stream:
    """Books of one session's stream."""

    entries: deque[Entry] = field(default_factory=deque)
    state: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(RING, np.uint8))
    clicks: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(RING, np.uint64))  # bit c: channel c
    stamps: NDArray[np.uint16] = field(default_factory=lambda: np.zeros(RING, np.uint16))  # of an automaton's exposures
    emitted_to: int = 0
    accounted_to: int = 0
    next_window: int = 0
    open_end: bool = False  # the host has said that it does not know how this stream ended


class DeviceBooks(NamedTuple):
    """What the device has made in one session: exposures, how many of those it dropped, and whether the host knew the end."""

    exposures: int
    dropped: int
    end_known: bool


NO_BOOKS = DeviceBooks(0, 0, True)


@dataclass(slots=True)
class CheckCounts:
    """How much was checked: a check that saw nothing proves nothing."""

    frames_emitted: int = 0
    blocks_delivered: int = 0
    blocks_lost: int = 0
    blocks_lost_open_end: int = 0
    decisions: int = 0
    decisions_flagged: int = 0
    commands: int = 0
    gates_submitted: int = 0
    gates_executed: int = 0
    gates_refused: int = 0
    streams: int = 0
