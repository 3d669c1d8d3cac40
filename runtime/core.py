"""The deterministic core: one stream frame in, decisions and events out; no I/O, no clock, no randomness.

A live run, a replay and a simulation all drive this class with the same frames, so that a recording gives the same decisions bit
for bit. `Core.step` returns an `Output`; a window that overlaps a gap gives a decision that is flagged and abstains, never a guess.
"""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

from .decide import Decider
from .ingest import Gap, StreamTracker
from .plan import Plan
from .record_format import NO_LABEL as NO_LABEL
from .record_format import DecisionFlag
from .window import DecisionWindows, Window
from .wire import (
    NO_OBJECT,
    UNKNOWN_TRUTH,
    ClickBlock,
    DeviceState,
    Frame,
    MalformedMessage,
    Mark,
    MessageType,
    StateReason,
    Status,
    decode_status,
)

NO_FLAGS = DecisionFlag(0)
MAX_MARKS = 4096  # objects whose truth is remembered; a run may see any number


class Decision(NamedTuple):
    """One row of the decision log, in the order of record.DECISION_DTYPE; `probability` is the winning class's softmax."""

    number: int
    tick: int
    exposure_index: int
    object: int
    shot: int
    clicks: int
    label: int
    truth: int
    flags: int
    probability: float
    counts_crc: int


class Output(NamedTuple):
    """What one step produced; `block_end_tick` is the end of the last exposure seen, None if the frame held no exposures."""

    decisions: list[Decision]
    events: list[dict[str, Any]]
    block_end_tick: int | None


class Core:
    """Stream tracker, windows and back end joined up, for one run of `n_cycles` cycles (0: until stopped) from `start_tick` on.

    A run that lost its device and found it again goes on in another stream: `begin` ends the old one and starts the next.
    """

    def __init__(self, plan: Plan, decider: Decider, shots: int, n_cycles: int) -> None:
        self.start_tick = 0
        self.completed = False
        self.tracker = StreamTracker()
        self.windows = DecisionWindows(plan, decider.n_features, shots)
        self.shots = shots
        self.marks: dict[int, Mark] = {}
        self.n_decisions = 0
        self.n_abstained = 0
        self._decider = decider
        self._exposure_ticks = plan.exposure_ticks
        self._slots_per_cycle, self._cycles_per_object = plan.slots_per_cycle, plan.cycles_per_object
        self.end_exposure = self._exposures_of(n_cycles)
        self._begun = False
        self._visits_before = 0  # in streams that have ended
        self.last_tick = 0
        self._status: Status | None = None  # the latest of this stream
        self._told_end: int | None = None  # tick of the first STATUS that told of the end

    def begin(self, start_tick: int, n_cycles: int) -> Output:
        """Follow the stream that an ARM starts; the output settles what the one before left open (INCOMPLETE, never guessed)."""
        output = self.end()
        if self._begun:
            output.decisions.extend(self._give_up())
            self.tracker.restart()
            self.marks.clear()
        self._begun, self.completed, self._told_end, self._status = True, False, None, None
        self.start_tick, self.end_exposure = start_tick, self._exposures_of(n_cycles)
        return output

    def end(self) -> Output:
        """End the stream: report what the device says that it exposed and never came, or that this is not known."""
        if not self._begun or self.completed:
            return Output([], [], None)
        status = self._status
        if status is not None and status.state in (DeviceState.IDLE, DeviceState.SAFE):
            return self._finish(status)
        self.completed = True
        unknown = {"kind": "stream_end_unknown", "first_exposure": self.tracker.next_exposure}
        decisions: list[Decision] = []
        if self.windows.visits_begun * self.windows.visit_exposures >= self.end_exposure:
            decisions = self._give_up()  # nothing is left for another stream: the last object's windows stay open
        return Output(decisions, [unknown], None)

    def _give_up(self) -> list[Decision]:
        self._visits_before += self.windows.visits_begun
        windows = self.windows.restart()
        return [self._decide(window, self.last_tick, DecisionFlag.INCOMPLETE) for window in windows]

    def cycles_left(self, n_cycles: int) -> int:
        """Return how many of a whole run's `n_cycles` cycles stand out when the visit under way is given up."""
        return n_cycles - (self._visits_before + self.windows.visits_begun) * self._cycles_per_object

    def _exposures_of(self, n_cycles: int) -> int:
        return n_cycles * self._slots_per_cycle if n_cycles else 1 << 63

    def step(self, frame: Frame) -> Output:
        """Take one frame (CLICKS, FRAMES, MARK or STATUS) in the order of arrival."""
        if frame.type == MessageType.STATUS:
            return self._on_status(frame)
        message, gap = self.tracker.accept(frame)
        if message is None:
            return Output([], [], None)
        if isinstance(message, Mark):
            self._remember(message)
            return Output([], [], None)
        events = [] if gap is None else [_gap_event(gap)]
        n_exposures = len(message.patterns) if isinstance(message, ClickBlock) else len(message.words)
        if message.exposure_index + n_exposures > self.end_exposure or not self.windows.fits(message):
            self.tracker.counters.malformed += 1
            return Output([], [*events, {"kind": "beyond_plan", "exposure_index": message.exposure_index}], None)
        end_tick = message.tick + (n_exposures - 1) * message.period_ticks + self._exposure_ticks
        self.last_tick = end_tick
        decisions = self._missed(message.exposure_index, message.tick)
        for window in self.windows.push(message):
            before_end = (message.exposure_index + n_exposures - 1 - window.last_exposure) * message.period_ticks
            decisions.append(self._decide(window, end_tick - before_end))
        return Output(decisions, events, end_tick)

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming."""
        self.windows.warm_up()

    def _on_status(self, frame: Frame) -> Output:
        """When the device says that the plan is done, settle what will never be complete.

        STATUS may overtake stream messages, so that with exposures missing only a second one settles them.
        """
        try:
            status = decode_status(frame.payload)
        except MalformedMessage:
            return Output([], [], None)
        if self.completed or status.tick < self.start_tick:  # an earlier run's news
            return Output([], [], None)
        self._status = status
        if (status.state, status.reason) != (DeviceState.IDLE, StateReason.COMPLETED):
            return Output([], [], None)
        missing = min(status.next_exposure, self.end_exposure) > self.tracker.next_exposure
        if missing and (self._told_end is None or status.tick <= self._told_end):  # the same one may come twice
            self._told_end = status.tick
            return Output([], [], None)
        return self._finish(status)

    def _finish(self, status: Status) -> Output:
        self.completed = True
        end = min(status.next_exposure, self.end_exposure)
        gap = self.tracker.finish(end, status.drops)
        return Output(self._missed(end, status.tick), [] if gap is None else [_gap_event(gap)], None)

    def _remember(self, mark: Mark) -> None:
        self.marks.pop(mark.object_index, None)
        self.marks[mark.object_index] = mark
        if len(self.marks) > MAX_MARKS:
            del self.marks[next(iter(self.marks))]  # the one that was set longest ago

    def _missed(self, exposure_index: int, tick: int) -> list[Decision]:
        return [self._decide(window, tick) for window in self.windows.skip_to(exposure_index)]

    def _decide(self, window: Window, tick: int, flags: DecisionFlag = NO_FLAGS) -> Decision:
        label, probability = NO_LABEL, 0.0
        if window.missing:
            flags |= DecisionFlag.GAP
        if window.wrong:
            flags |= DecisionFlag.WRONG_PATTERN
        if flags:
            flags |= DecisionFlag.ABSTAINED
            self.n_abstained += 1
        else:
            label, probability = self._decider.decide(window.counts, self.shots)
            if not probability > 0:  # the scores were not finite: their label means nothing
                flags |= DecisionFlag.NOT_FINITE | DecisionFlag.ABSTAINED
                label, probability = NO_LABEL, 0.0
                self.n_abstained += 1
        mark = self.marks.get(window.object_index)
        decision = Decision(
            number=self.n_decisions,
            tick=tick,
            exposure_index=window.last_exposure,
            object=window.object_index,
            shot=window.first_shot,
            clicks=int(window.counts.sum()),
            label=label,
            truth=UNKNOWN_TRUTH if mark is None or window.object_index == NO_OBJECT else mark.truth,
            flags=int(flags),
            probability=probability,
            counts_crc=zlib.crc32(window.counts.tobytes()),
        )
        self.n_decisions += 1
        return decision


def _gap_event(gap: Gap) -> dict[str, Any]:
    return {"kind": "gap", **gap._asdict()}
