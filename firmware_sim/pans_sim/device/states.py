"""The automaton that the host has uploaded, and the states that the host names one by one.

LOAD_STATES, SHOW, READ_COUNTS and LOAD_COUNT_STATES (docs/reference/protocol.md, sections 11, 13 and 14) are checked before anything is
stored: one that makes no sense raises `Refused` and leaves what is stored as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.protocol.wire import (
    ADAPTIVE_PATTERN,
    BLOCK_HEADER_BYTES,
    EXPOSURE_BYTES,
    MAX_LEAVES,
    MAX_PAYLOAD_BYTES,
    MAX_STATES,
    AckStatus,
    Extension,
    ReadCounts,
    Show,
    StateChunk,
)
from pans_sim.scene.program import Program, States

from .upload import Refused

MAX_SHOWS = 256  # named and not begun; the protocol asks for 64


class StatePiece(NamedTuple):
    """Some states of an automaton as either command brings them: pattern, dwell int64 (n,), successors int64 (n, outcomes)."""

    n_states: int
    first_state: int
    dwell_steps: int
    n_leaves: int
    outcomes: int
    pattern: NDArray[np.int64]
    dwell: NDArray[np.int64]
    successors: NDArray[np.int64]

    @property
    def header(self) -> tuple[int, ...]:
        """What all pieces of an automaton must say alike."""
        return self.n_states, self.dwell_steps, self.n_leaves, self.outcomes


def piece_of(chunk: StateChunk) -> StatePiece:
    """Return the states of a LOAD_STATES or LOAD_COUNT_STATES."""
    n_states, first, dwell_steps, outcomes, n_leaves, rows = chunk
    columns = (rows[name].astype(np.int64) for name in ("pattern", "dwell", "next"))
    return StatePiece(n_states, first, dwell_steps, n_leaves, outcomes, *columns)


@dataclass(slots=True)
class StateMemory:
    """What belongs to the plan in memory: the states, None until the last one has come and all can be followed, and what is read."""

    extension: Extension
    turn_ticks: int = 0  # from the end of an exposure until the projector shows what its click chose
    number_max: int = 1  # the largest photon number that the detector tells
    channels_max: int = 1  # detectors that are read at once
    states: States | None = None
    largest: int = 1  # number that the runs of this plan read; 1: clicks
    channels: int = 1  # whose clicks that number is
    _head: StatePiece | None = None
    _pieces: list[StatePiece] = field(default_factory=list)
    _filled: int = 0

    def forget(self) -> None:
        """Begin without states and with clicks: another plan comes."""
        self.largest = self.channels = 1
        self._forget_states()

    def _forget_states(self) -> None:
        self.states, self._head, self._pieces, self._filled = None, None, [], 0

    @property
    def begun(self) -> bool:
        """Whether some states have come, but not all."""
        return self._head is not None and self.states is None

    def read_counts(self, asked: ReadCounts, program: Program | None) -> None:
        """Read the numbers that are asked for in the runs of the loaded plan, or raise `Refused`; states have to come again."""
        if program is None:
            raise Refused(AckStatus.WRONG_STATE, "READ_COUNTS needs a complete plan")
        largest, channels = asked
        if channels:
            self._check_channels(asked, program)
        else:
            _require(2 <= largest <= self.number_max, lambda: f"numbers up to {largest}: allowed 2..{self.number_max}")
        exposures = max(count for _, count in program.blocks)
        longest = (MAX_PAYLOAD_BYTES - BLOCK_HEADER_BYTES) // EXPOSURE_BYTES
        _require(exposures <= longest, lambda: f"blocks of {exposures} exposures: COUNTS holds {longest}")
        self._forget_states()
        self.largest, self.channels = largest, channels or 1

    def _check_channels(self, asked: ReadCounts, program: Program) -> None:
        largest, channels = asked
        fits = 2 <= channels <= self.channels_max
        _require(fits, lambda: f"{channels} detectors at once: the device reads {self.channels_max}")
        wanted = (1 << channels) - 1
        _require(largest == wanted, lambda: f"numbers up to {largest} of {channels} detectors: allowed {wanted}")
        if not program.adaptive:
            raise Refused(AckStatus.WRONG_STATE, "several detectors at once need a plan with adaptive slots")

    def load(self, piece: StatePiece, program: Program | None) -> None:
        """Store one piece, or raise `Refused`; the last one checks the whole."""
        if program is None or not program.adaptive:
            raise Refused(AckStatus.WRONG_STATE, "no plan with adaptive slots is loaded")
        if piece.outcomes != self.largest + 1:
            text = f"states of {piece.outcomes} outcomes: the exposures of this plan have {self.largest + 1}"
            raise Refused(AckStatus.WRONG_STATE, text)
        _check_head(piece, self.extension)
        first, head = piece.first_state, self._head
        if first and (head is None or self.states is not None or piece.header != head.header):
            raise Refused(AckStatus.OUT_OF_RANGE, f"state {first} continues no states of this header")
        if first not in (0, self._filled):
            raise Refused(AckStatus.OUT_OF_RANGE, f"state {first} does not continue the states at {self._filled}")
        _check_states(piece, program.n_patterns - (self.channels - 1))
        if first == 0:
            self._forget_states()
            self._head = piece
        self._pieces.append(piece)
        self._filled += len(piece.pattern)
        if self._filled == piece.n_states:
            self._complete(piece, program)

    def _complete(self, head: StatePiece, program: Program) -> None:
        pattern, dwell, successors = (
            np.concatenate([getattr(piece, name) for piece in self._pieces])
            for name in ("pattern", "dwell", "successors")
        )
        longest = longest_walk(successors)
        slots = int(np.count_nonzero(program.patterns == ADAPTIVE_PATTERN))
        if longest > slots:
            self._forget_states()
            raise Refused(AckStatus.OUT_OF_RANGE, f"walks of {longest} exposures: a cycle has {slots} adaptive slots")
        closest = (
            int(np.diff(program.offsets, append=program.offsets[0] + program.cycle_ticks).min())
            - program.exposure_ticks
        )
        if closest < self.turn_ticks - 1:  # a tick less is forgiven for rounding
            self._forget_states()
            raise Refused(
                AckStatus.OUT_OF_RANGE,
                f"{closest} ticks between exposures: the device needs {self.turn_ticks} to choose",
            )
        self.states = States(pattern, dwell / head.dwell_steps, successors)


def longest_walk(successors: NDArray[np.int64]) -> int:
    """Exposures of the longest walk from state 0, int64 (states, outcomes): successors are above their state, from n on leaves."""
    n = len(successors)
    steps = [0] * n
    steps[0] = 1
    for state, after in enumerate(successors.tolist()):
        for target in after:
            if steps[state] and target < n:
                steps[target] = max(steps[target], steps[state] + 1)
    return max(steps)


def _check_head(head: StatePiece, extension: Extension) -> None:
    most, leaves = min(extension.states, MAX_STATES), MAX_LEAVES
    _require(1 <= head.n_states <= most, lambda: f"{head.n_states} states: the device follows {most}")
    _require(1 <= head.n_leaves <= leaves, lambda: f"{head.n_leaves} leaves: allowed 1..{leaves}")
    _check_steps(head.dwell_steps, extension)


def _check_steps(steps: int, extension: Extension) -> None:
    divides = steps > 0 and extension.dwell_steps % steps == 0
    _require(
        divides,
        lambda: f"dwell in {steps} steps: the device has {extension.dwell_steps}, of which it must be a divisor",
    )


def _check_states(piece: StatePiece, n_patterns: int) -> None:
    top = int(piece.pattern.max())
    _require(top < n_patterns, lambda: f"a state shows pattern {top}: the plan has {n_patterns}")
    low, high = int(piece.dwell.min()), int(piece.dwell.max())
    _require(low >= 1 and high <= piece.dwell_steps, lambda: f"dwell {low}..{high}: allowed 1..{piece.dwell_steps}")
    nodes = piece.n_states + piece.n_leaves
    numbers = np.arange(piece.first_state, piece.first_state + len(piece.pattern), dtype=np.int64)[:, None]
    wrong = np.argwhere((piece.successors <= numbers) | (piece.successors >= nodes))
    if len(wrong):
        row, outcome = wrong[0].tolist()
        state, found = piece.first_state + row, int(piece.successors[row, outcome])
        raise Refused(AckStatus.OUT_OF_RANGE, f"state {state} leads to {found}: allowed {state + 1}..{nodes - 1}")


class Shown(NamedTuple):
    """What the host named for one exposure: the state's number, its pattern, and the part of the exposure that the light is on."""

    state: int
    pattern: int
    light: float


class ShowList:
    """What the host has named for exposures of a run that have not begun."""

    def __init__(self, extension: Extension, channels: int = 1) -> None:
        self._extension, self._channels = extension, channels
        self._shown: dict[int, Shown] = {}

    def put(self, show: Show, program: Program, begun: int, n_exposures: int | None) -> None:
        """Take a SHOW; `begun` exposures have begun, the run has `n_exposures` (None: no end). `Refused` leaves the list as it was."""
        last = show.pattern + self._channels - 1
        _require(last < program.n_patterns, lambda: f"pattern {last}: the plan has {program.n_patterns}")
        _check_steps(show.dwell_steps, self._extension)
        _require(1 <= show.dwell <= show.dwell_steps, lambda: f"dwell {show.dwell}: allowed 1..{show.dwell_steps}")
        _require(show.state < MAX_STATES, lambda: f"state {show.state}: allowed 0..{MAX_STATES - 1}")
        within = n_exposures is None or show.exposure_index < n_exposures
        _require(within, lambda: f"exposure {show.exposure_index}: the run has {n_exposures}")
        adaptive = program.patterns[show.exposure_index % program.n_slots] == ADAPTIVE_PATTERN
        _require(bool(adaptive), lambda: f"exposure {show.exposure_index} is dark: no adaptive slot")
        if show.exposure_index < begun:
            raise Refused(AckStatus.TOO_LATE, f"exposure {show.exposure_index} has begun: {begun} have")
        full = show.exposure_index not in self._shown and len(self._shown) >= MAX_SHOWS
        _require(not full, lambda: f"{MAX_SHOWS} exposures are named already")
        self._shown[show.exposure_index] = Shown(show.state, show.pattern, show.dwell / show.dwell_steps)

    def take(self, exposure_index: int) -> Shown | None:
        """Return what was named for an exposure and forget it; None if nothing was."""
        return self._shown.pop(exposure_index, None)


def _require(fine: bool, text: Callable[[], str]) -> None:
    if not fine:
        raise Refused(AckStatus.OUT_OF_RANGE, text())
