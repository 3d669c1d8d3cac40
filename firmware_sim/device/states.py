"""The automaton that the host has uploaded, and the states that the host names one by one.

Owns the checks of LOAD_STATES and SHOW (docs/reference/protocol.md, section 11), with every limit checked before anything is stored; never
draws a click. A command that makes no sense raises `Refused` and leaves what is stored as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.program import Program, States
from pans.runtime.wire.automata import Extension, Show, StateChunk
from pans.runtime.wire.fields import MAX_LEAVES, MAX_STATES
from pans.runtime.wire.messages import ADAPTIVE_PATTERN, AckStatus

from .upload import Refused

MAX_SHOWS = 256  # named and not begun; the protocol asks for 64


@dataclass(slots=True)
class StateMemory:
    """The states that belong to the plan in memory; `states` is None until the last one has come and all of them can be followed."""

    extension: Extension
    turn_ticks: int = 0  # from the end of an exposure until the projector shows what its click chose
    states: States | None = None
    _head: StateChunk | None = None
    _chunks: list[NDArray[Any]] = field(default_factory=list)
    _filled: int = 0

    def forget(self) -> None:
        """Begin without states: another plan comes."""
        self.states, self._head, self._chunks, self._filled = None, None, [], 0

    @property
    def begun(self) -> bool:
        """Whether some states have come, but not all."""
        return self._head is not None and self.states is None

    def load(self, chunk: StateChunk, program: Program | None) -> None:
        """Store one chunk, or raise `Refused`; the last one checks the whole."""
        if program is None or not program.adaptive:
            raise Refused(AckStatus.WRONG_STATE, "no plan with adaptive slots is loaded")
        _check_head(chunk, self.extension)
        if chunk.first_state and (self._head is None or self.states is not None or _facts(chunk) != _facts(self._head)):
            raise Refused(AckStatus.OUT_OF_RANGE, f"state {chunk.first_state} continues no states of this header")
        if chunk.first_state not in (0, self._filled):
            raise Refused(
                AckStatus.OUT_OF_RANGE, f"state {chunk.first_state} does not continue the states at {self._filled}"
            )
        _check_states(chunk, program.n_patterns)
        if chunk.first_state == 0:
            self.forget()
            self._head = chunk
        self._chunks.append(chunk.states)
        self._filled += len(chunk.states)
        if self._filled == chunk.n_states:
            self._complete(chunk, program)

    def _complete(self, head: StateChunk, program: Program) -> None:
        rows = np.concatenate(self._chunks)
        successors = np.stack([rows["next_dark"], rows["next_click"]], axis=1).astype(np.int64)
        longest = longest_walk(successors)
        slots = int(np.count_nonzero(program.patterns == ADAPTIVE_PATTERN))
        if longest > slots:
            self.forget()
            raise Refused(AckStatus.OUT_OF_RANGE, f"walks of {longest} exposures: a cycle has {slots} adaptive slots")
        closest = (
            int(np.diff(program.offsets, append=program.offsets[0] + program.cycle_ticks).min())
            - program.exposure_ticks
        )
        if closest < self.turn_ticks - 1:  # a tick less is forgiven for rounding
            self.forget()
            raise Refused(
                AckStatus.OUT_OF_RANGE,
                f"{closest} ticks between exposures: the device needs {self.turn_ticks} to choose",
            )
        self.states = States(rows["pattern"].astype(np.int64), rows["dwell"] / head.dwell_steps, successors)


def _facts(chunk: StateChunk) -> tuple[int, ...]:
    return chunk.n_states, chunk.dwell_steps, chunk.n_leaves


def longest_walk(successors: NDArray[np.int64]) -> int:
    """Exposures of the longest walk from state 0, int64 (states, 2) with successors above their state; those from n on are leaves."""
    n = len(successors)
    steps = [0] * n
    steps[0] = 1
    for state, after in enumerate(successors.tolist()):
        for target in after:
            if steps[state] and target < n:
                steps[target] = max(steps[target], steps[state] + 1)
    return max(steps)


def _check_head(head: StateChunk, extension: Extension) -> None:
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


def _check_states(chunk: StateChunk, n_patterns: int) -> None:
    rows = chunk.states
    top = int(rows["pattern"].max())
    _require(top < n_patterns, lambda: f"a state shows pattern {top}: the plan has {n_patterns}")
    low, high = int(rows["dwell"].min()), int(rows["dwell"].max())
    _require(low >= 1 and high <= chunk.dwell_steps, lambda: f"dwell {low}..{high}: allowed 1..{chunk.dwell_steps}")
    nodes = chunk.n_states + chunk.n_leaves
    numbers = np.arange(chunk.first_state, chunk.first_state + len(rows), dtype=np.int64)
    for name in ("next_dark", "next_click"):
        after = rows[name].astype(np.int64)
        wrong = np.flatnonzero((after <= numbers) | (after >= nodes))
        if len(wrong):
            state, found = int(numbers[wrong[0]]), int(after[wrong[0]])
            raise Refused(AckStatus.OUT_OF_RANGE, f"state {state} leads to {found}: allowed {state + 1}..{nodes - 1}")


class Shown(NamedTuple):
    """What the host named for one exposure: the state's number, its pattern, and the part of the exposure that the light is on."""

    state: int
    pattern: int
    light: float


class ShowList:
    """What the host has named for exposures of a run that have not begun."""

    def __init__(self, extension: Extension) -> None:
        self._extension = extension
        self._shown: dict[int, Shown] = {}
        self.late = 0

    def put(self, show: Show, program: Program, begun: int, n_exposures: int | None) -> None:
        """Take a SHOW; `begun` exposures have begun, the run has `n_exposures` (None: no end). `Refused` leaves the list as it was."""
        _require(
            show.pattern < program.n_patterns, lambda: f"pattern {show.pattern}: the plan has {program.n_patterns}"
        )
        _check_steps(show.dwell_steps, self._extension)
        _require(1 <= show.dwell <= show.dwell_steps, lambda: f"dwell {show.dwell}: allowed 1..{show.dwell_steps}")
        _require(show.state < MAX_STATES, lambda: f"state {show.state}: allowed 0..{MAX_STATES - 1}")
        within = n_exposures is None or show.exposure_index < n_exposures
        _require(within, lambda: f"exposure {show.exposure_index}: the run has {n_exposures}")
        adaptive = program.patterns[show.exposure_index % program.n_slots] == ADAPTIVE_PATTERN
        _require(bool(adaptive), lambda: f"exposure {show.exposure_index} is dark: no adaptive slot")
        if show.exposure_index < begun:
            self.late += 1
            raise Refused(AckStatus.TOO_LATE, f"exposure {show.exposure_index} has begun: {begun} have")
        full = show.exposure_index not in self._shown and len(self._shown) >= MAX_SHOWS
        _require(not full, lambda: f"{MAX_SHOWS} exposures are named already")
        self._shown[show.exposure_index] = Shown(show.state, show.pattern, show.dwell / show.dwell_steps)

    def __len__(self) -> int:
        return len(self._shown)

    def take(self, exposure_index: int) -> Shown | None:
        """Return what was named for an exposure and forget it; None if nothing was."""
        return self._shown.pop(exposure_index, None)


def _require(fine: bool, text: Callable[[], str]) -> None:
    if not fine:
        raise Refused(AckStatus.OUT_OF_RANGE, text())
