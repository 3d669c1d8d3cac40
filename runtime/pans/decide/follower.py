"""What every core does with a stream: order, gaps, marks, contradictions with the plan, the end.

`step` takes one message and returns an `Output`; `begin` and `end` settle what a stream leaves open. `core.Core` decides on objects that
stand still, `flow.FlowCore` on those that pass by.
"""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.decide.plan.marks import Marks
from pans.decide.plan.plan import Plan
from pans.protocol.tracker import MEMORY_BYTES, StateField, StreamTracker
from pans.protocol.wire import (
    DARK_PATTERN,
    MAX_GAP_EXPOSURES,
    NO_OBJECT,
    UNKNOWN_TRUTH,
    ClickBlock,
    Contradiction,
    DeviceState,
    Exposed,
    Frame,
    FrameBlock,
    MalformedMessage,
    Mark,
    MessageType,
    StateReason,
    Status,
    decode_exposed,
    decode_status,
)

from .core_state import CORE_DTYPE, LARGEST
from .decision import BeyondPlan, CoreEvent, Output, StreamEndUnknown, joined

if TYPE_CHECKING:
    from .dark.guard import DarkGuard


class PlanRules:
    """The rules of one plan; `moving` where objects flow past, and blocks therefore name none."""

    def __init__(self, plan: Plan, n_classes: int, *, moving: bool) -> None:
        self._offsets = plan.slot_offset_ticks.tolist()
        self._period, self._cycle_ticks, self._slots = plan.slot_period_ticks, plan.cycle_ticks, plan.slots_per_cycle
        self._visit = plan.slots_per_cycle * plan.cycles_per_object
        self._n_classes, self._moving = n_classes, moving
        self._n_states = 0 if plan.automaton is None else plan.automaton.n_states

    def planned(self, exposure_index: int) -> int:
        """Ticks from the start of the run to the start of an exposure."""
        cycle, slot = divmod(exposure_index, self._slots)
        return int(cycle * self._cycle_ticks + self._offsets[slot])

    def begun_by(self, ticks: int) -> int:
        """How many exposures have begun `ticks` after the start of the run."""
        if ticks < 0:
            return 0
        cycle, rest = divmod(ticks, self._cycle_ticks)
        return cycle * self._slots + int(np.searchsorted(self._offsets, rest, "right"))

    def of_block(self, block: ClickBlock | FrameBlock, start_tick: int) -> Contradiction | None:
        """Spacing, object, time and stamps of a block: an exposure may be late, but never a whole period early.

        With an automaton an exposure is dark or shows one of its states; whether it is the right one, the walk says (still/windows.py).
        """
        first = block.exposure_index
        if block.period_ticks != self._period:
            return Contradiction("period", first, block.period_ticks, self._period)
        expected = NO_OBJECT if self._moving else first // self._visit % NO_OBJECT
        if block.object_index not in (expected, NO_OBJECT):
            return Contradiction("object", first, block.object_index, expected)
        earliest = start_tick + self.planned(first) - self._period
        if block.tick < earliest:
            return Contradiction("early", first, block.tick, earliest)
        if self._n_states and isinstance(block, ClickBlock):
            strange = (block.patterns >= self._n_states) & (block.patterns != DARK_PATTERN)
            if strange.any():
                return Contradiction("stamp", first, int(block.patterns[strange.argmax()]), self._n_states - 1)
        return None

    def of_mark(self, mark: Mark, next_exposure: int, end_exposure: int) -> Contradiction | None:
        """Class, object and place of a mark."""
        first = mark.exposure_index
        if not UNKNOWN_TRUTH <= mark.truth < self._n_classes:
            return Contradiction("truth", first, mark.truth, self._n_classes - 1)
        if first >= end_exposure + MAX_GAP_EXPOSURES or abs(first - next_exposure) > MAX_GAP_EXPOSURES:
            return Contradiction("mark_exposure", first, first, next_exposure)
        if not self._moving and mark.half_exposures:
            return Contradiction("mark_half", first, mark.half_exposures, 0)
        if not self._moving:
            visit, within = divmod(first, self._visit)
            if within or mark.object_index not in (visit % NO_OBJECT, NO_OBJECT):
                return Contradiction("mark_object", first, mark.object_index, visit % NO_OBJECT)
        return None

    def of_status(self, status: Status, start_tick: int, end_exposure: int) -> Contradiction | None:
        """The exposures that a STATUS of this run claims: no more than the plan has, and than time has allowed; drops among them."""
        claimed = status.next_exposure
        most = min(end_exposure, self.begun_by(status.tick - start_tick) + 1)  # one for the rounding of ticks
        if claimed > most:
            return Contradiction("claimed_exposures", claimed, claimed, most)
        if status.drops > claimed and claimed < 1 << 32:
            return Contradiction("claimed_drops", claimed, status.drops, claimed)
        return None

    def of_exposed(self, told: Exposed, n_told: int, end_exposure: int) -> Contradiction | None:
        """Exposures that lie beyond the plan, were told of before (`n_told`), or are farther apart than as many as it tells of."""
        named = sorted((told.start_exposure, told.length_exposure))
        last = max(n_told + told.exposures - 1, named[1])
        if last >= end_exposure:
            return Contradiction("exposed", told.start_exposure, last, end_exposure - 1)
        if named[0] < n_told or named[1] - named[0] >= told.exposures:
            return Contradiction("exposed", told.start_exposure, named[0], max(n_told, named[1] - told.exposures + 1))
        return None


NOTHING_EXPOSED = Exposed(0, 0, 0, 0, 0)
ANY_CLASS = 1 << 15  # where nothing is classified, every truth that fits its field is one
PART_MARKS = 16  # of them that a part of a recording begins with
TAIL_US = 2e6  # STATUS comes every second: so much of a stream that broke off may lie behind the last EXPOSED
I32_MAX = (1 << 31) - 1


def exposure_timing(
    told: Exposed, tick_us: float, tolerance_us: float, *, announced: bool, untold: int = 0
) -> dict[str, Any]:
    """Return when exposures happened, under the summary's keys, judged; what the device has not told is None.

    `untold` exposures have ended of which EXPOSED did not tell, though it should have.
    """
    start_us, length_us = told.start_error * tick_us, told.length_error * tick_us
    keys = ("within", "worst_start_us", "worst_length_us", "worst_start_exposure", "worst_length_exposure")
    within = max(abs(start_us), abs(length_us)) <= tolerance_us
    values = (within, start_us, length_us, told.start_exposure, told.length_exposure)
    facts = dict(zip(keys, values if told.exposures else [None] * len(keys)))
    counts = {"exposures": told.exposures, "untold": untold if announced else 0}
    return {"announced": announced, **counts, "tolerance_us": tolerance_us, **facts}


class Standing(NamedTuple):
    """Where a stream stood when a message came: the exposure that came next, the drop counter, the last end, the largest jitter."""

    next_exposure: int
    drops: int
    last_tick: int
    jitter_ticks: int


@dataclass(frozen=True, slots=True)
class Place:
    """Where a core stands in a stream, for another one to go on from; `core` is what one kind of core adds, JSON-able."""

    tracker: tuple[int, int, int]
    marks: tuple[Mark, ...]
    decisions: int
    abstained: int
    last_tick: int
    core: dict[str, Any]
    heard: bytes = b""  # StreamTracker.memory; b"" in recordings that were made without
    # exposures that EXPOSED has told of, their largest start error, how far blocks were from the plan, and how far that was judged;
    # () in recordings that were made without
    told: tuple[int, ...] = ()

    def facts(self) -> dict[str, Any]:
        """Return it as it stands at the beginning of a part of a recording; JSON has no NaN."""
        marks = [[*mark[:5], None if math.isnan(mark.photons) else mark.photons, *mark[6:]] for mark in self.marks]
        numbers = {"decisions": self.decisions, "abstained": self.abstained, "last_tick": self.last_tick}
        heard = b64encode(self.heard).decode()
        device = {"heard": heard, "told": list(self.told)}
        return {"tracker": list(self.tracker), "marks": marks, **numbers, "core": self.core, **device}

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Place:
        """Invert `facts`; LookupError, TypeError or ValueError if they are damaged."""
        marks = tuple(
            Mark._make([*map(int, mark[:5]), math.nan if mark[5] is None else float(mark[5]), *map(int, mark[6:])])
            for mark in facts["marks"]
        )
        decisions, abstained, last_tick = (int(facts[name]) for name in ("decisions", "abstained", "last_tick"))
        seq, exposure, drops = map(int, facts["tracker"])
        heard = b64decode(facts.get("heard", ""), validate=True)
        if len(heard) not in (0, MEMORY_BYTES):
            raise ValueError(f"heard has {len(heard)} bytes, expected {MEMORY_BYTES}")
        told = tuple(map(int, facts.get("told", ())))
        if len(told) not in (0, 4):
            raise ValueError(f"told has {len(told)} numbers, expected 4")
        return cls((seq, exposure, drops), marks, decisions, abstained, last_tick, facts["core"], heard, told)


class Follower:
    """Follows the streams of one run of `n_cycles` cycles (0: until stopped); subclasses decide on blocks, gaps and open ends.

    A run that lost its device and found it again goes on in another stream: `begin` ends the old one and starts the next.
    """

    moving = False  # whether objects flow past
    guard: DarkGuard | None = None  # of the dark counts; None: they are only added up

    n_decisions = StateField(CORE_DTYPE)
    n_abstained = StateField(CORE_DTYPE)
    last_tick = StateField(CORE_DTYPE, LARGEST)
    jitter_ticks = StateField(CORE_DTYPE, LARGEST)  # most that a block's end differed from the plan
    start_tick = StateField(CORE_DTYPE, LARGEST)
    end_exposure = StateField(CORE_DTYPE, LARGEST + 1)

    def __init__(self, plan: Plan, n_cycles: int, n_classes: int = ANY_CLASS) -> None:
        self.contradictions: Counter[str] = Counter()  # messages that the plan or others exclude, by what is wrong
        self.n_classes = n_classes
        self.state: npt.NDArray[np.void] = np.zeros(1, CORE_DTYPE)
        self.cells = self.state.view(np.int64)
        self.beyond: dict[str, int] = {}
        facts = self.state[0]
        facts.exposure_ticks, facts.period_ticks = plan.exposure_ticks, plan.slot_period_ticks
        facts.cycle_ticks, facts.n_classes = plan.cycle_ticks, n_classes
        self.completed = False
        self.tracker = StreamTracker(self.state)
        self.marks = Marks()
        self.exposed = NOTHING_EXPOSED  # what the device told of all streams
        self.untold = 0  # exposures of all streams that ended, of which EXPOSED should have told
        self.plan = plan
        self._rules = PlanRules(plan, n_classes, moving=self.moving)
        self._exposure_ticks = plan.exposure_ticks
        self._slots_per_cycle, self._cycles_per_object = plan.slots_per_cycle, plan.cycles_per_object
        self.end_exposure = self._exposures_of(n_cycles)
        self._begun = False
        self._idle_steps: Any = None
        self._exposed = NOTHING_EXPOSED  # the latest of this stream
        # exposures that all of this stream have told of; None in a part of an old recording
        self._n_told: int | None = 0
        self._worst_told = self._jitter_known = 0  # their largest start error; what has been judged of `jitter_ticks`
        self._status: Status | None = None  # the latest of this stream
        self._told_end: int | None = None  # tick of the first STATUS that told of the end
        self._told_wrong = False  # whether that one has been found to contradict the plan

    # -- what subclasses do --------------------------------------------------------------------------------------------

    @property
    def tallies(self) -> npt.NDArray[np.int64]:
        """Dark exposures, dark clicks and wrong patterns, int64 (still/windows.N_TALLIES,)."""
        raise NotImplementedError

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming."""

    def cycles_left(self, n_cycles: int) -> int:
        """Return how many of a whole run's `n_cycles` cycles stand out when what is under way is given up."""
        raise NotImplementedError

    def _fits(self, block: ClickBlock | FrameBlock) -> bool:
        raise NotImplementedError

    def _take(self, block: ClickBlock | FrameBlock, n_exposures: int, end_tick: int) -> Output:
        """Settle what lies before a block that fits, and decide on the block."""
        raise NotImplementedError

    def _skip_to(self, exposure_index: int, tick: int) -> Output:
        """Settle what lies before `exposure_index`, which comes next."""
        raise NotImplementedError

    def _give_up(self) -> Output:
        """Settle what is open, and be ready for another stream."""
        raise NotImplementedError

    def _nothing_left(self) -> bool:
        """Whether another stream would have nothing to show."""
        return self.tracker.next_exposure >= self.end_exposure

    def _place(self) -> dict[str, Any] | None:
        """What this core must be given to go on from here; None while something is open that the clicks so far are part of."""
        return None

    def _go_on_from(self, place: dict[str, Any]) -> None:
        raise NotImplementedError

    def steps(self, session: int) -> Any:
        """Return what the kernel continues of this core (decide/kernel/calls.py), ready for messages of `session`."""
        if self._idle_steps is None:
            from pans.decide.still.kernel_state import IdleSteps  # numba is loaded only by who receives

            self._idle_steps = IdleSteps(self)
        return self._idle_steps.begin(session)

    # -- parts of a recording ------------------------------------------------------------------------------------------

    def part(self) -> Place | None:
        """Begin a part of the recording here and return the place in the stream; None while that cannot be.

        What the place does not hold is forgotten here too, so that `resume` in a replay goes on exactly as this core does.
        """
        stopped = self._status is not None and self._status.state in (DeviceState.IDLE, DeviceState.SAFE)
        own = None if self.completed or stopped or not self._begun else self._place()
        if own is None:
            return None
        self.marks.keep(PART_MARKS)
        marks = tuple(self.marks.latest())
        numbers = self.n_decisions, self.n_abstained, self.last_tick
        told = () if self._n_told is None else (self._n_told, self._worst_told, self.jitter_ticks, self._jitter_known)
        return Place(self.tracker.position, marks, *numbers, own, self.tracker.memory, told)

    def resume(self, place: Place) -> None:
        """Go on from the place that `part` returned, right after `begin`."""
        self.tracker.resume(place.tracker, place.heard)
        for mark in place.marks:
            self.remember(mark)
        self.n_decisions, self.n_abstained, self.last_tick = place.decisions, place.abstained, place.last_tick
        self._n_told, self._worst_told, self.jitter_ticks, self._jitter_known = place.told or (None, 0, 0, 0)
        self._go_on_from(place.core)

    # -- one stream ----------------------------------------------------------------------------------------------------

    def begin(self, start_tick: int, n_cycles: int) -> Output:
        """Follow the stream that an ARM starts; the output settles what the one before left open (INCOMPLETE, never guessed)."""
        output = self.end()
        if self._begun:
            output = joined(output, self._give_up())
            self.tracker.restart()
            self.marks.keep(0)
        self._begun, self.completed, self._told_end, self._told_wrong, self._status = True, False, None, False, None
        self.start_tick, self.end_exposure = start_tick, self._exposures_of(n_cycles)
        self._exposed, self._n_told, self._worst_told, self._jitter_known = NOTHING_EXPOSED, 0, 0, self.jitter_ticks
        return output

    def begin_later(self, start_tick: int) -> None:
        """The ARM of the stream that was begun was refused, so that nothing of it came, and another one starts it."""
        self.start_tick, self._status, self._told_end = start_tick, None, None

    def end(self) -> Output:
        """End the stream: report what the device says that it exposed and never came, or that this is not known."""
        if not self._begun or self.completed:
            return Output([], [], None)
        status = self._status
        if status is not None and status.state in (DeviceState.IDLE, DeviceState.SAFE):
            return self._finish(status)
        self.completed = True
        due = self._rules.begun_by(self.last_tick - self.start_tick - round(TAIL_US / self.plan.tick_us))
        self._count_untold(due if status is None else max(due, status.next_exposure - 1))  # one may be under way
        unknown = StreamEndUnknown(self.tracker.next_exposure)
        output = Output([], [unknown], None)
        if self._nothing_left():
            output = joined(output, self._give_up())  # nothing is left for another stream: what is open stays open
        return output

    def _exposures_of(self, n_cycles: int) -> int:
        return n_cycles * self._slots_per_cycle if n_cycles else 1 << 63

    def step(self, frame: Frame, standing: Standing | None = None) -> Output:
        """Take one frame (CLICKS, FRAMES, MARK, STATUS or EXPOSED) in the order of arrival.

        `standing` is where the stream stood when a STATUS or EXPOSED came that a kernel has passed; None: as it stands now.
        """
        if frame.type == MessageType.STATUS:
            return self._on_status(frame, standing or self._standing())
        if frame.type == MessageType.EXPOSED:
            return self._on_exposed(frame, standing or self._standing())
        unexplained = self.tracker.counters.unexplained_drops
        message, gap = self.tracker.accept(frame)
        if message is None:
            differs = self.tracker.differs
            return Output([], [] if differs is None else [self._contradicts(Contradiction("repeat", *differs))], None)
        if isinstance(message, Mark):
            return self._take_mark(message)
        events: list[CoreEvent] = [] if gap is None else [gap]
        if self.tracker.counters.unexplained_drops != unexplained:
            events.append(self._contradicts(Contradiction("drops", message.exposure_index, message.drops, 0)))
        n_exposures = len(message.patterns) if isinstance(message, ClickBlock) else len(message.words)
        if message.exposure_index + n_exposures > self.end_exposure or not self._fits(message):
            self.contradictions["beyond_plan"] += 1
            return Output([], [*events, BeyondPlan(message.exposure_index)], None)
        wrong = self._rules.of_block(message, self.start_tick)
        if wrong is not None:
            return Output([], [*events, self._contradicts(wrong)], None)
        end_tick = message.tick + (n_exposures - 1) * message.period_ticks + self._exposure_ticks
        self.last_tick = end_tick
        planned = self.start_tick + self._rules.planned(message.exposure_index + n_exposures - 1)
        self.jitter_ticks = max(self.jitter_ticks, abs(end_tick - planned - self._exposure_ticks))
        return joined(Output([], events, None), self._take(message, n_exposures, end_tick), end_tick)

    def _take_mark(self, mark: Mark) -> Output:
        wrong = self._rules.of_mark(mark, self.tracker.next_exposure, self.end_exposure)
        if wrong is None:
            wrong = self._other_class(mark)
            self.remember(mark)  # also then: recordings made before this rule must replay to the same decisions
        return Output([], [] if wrong is None else [self._contradicts(wrong)], None)

    def _other_class(self, mark: Mark) -> Contradiction | None:
        """Whether an earlier mark of the same object named another class: a device would choose its accuracy."""
        known = None if mark.object_index == NO_OBJECT else self.marks.get(mark.object_index)
        if known is None or known.truth == mark.truth:
            return None
        return Contradiction("truth", mark.exposure_index, mark.truth, known.truth)

    def _contradicts(self, wrong: Contradiction) -> Contradiction:
        self.contradictions[wrong.what] += 1
        return wrong

    def _standing(self) -> Standing:
        _, came, drops = self.tracker.position
        return Standing(came, drops, self.last_tick, self.jitter_ticks)

    def _on_exposed(self, frame: Frame, standing: Standing) -> Output:
        """Note when exposures happened. No two are equal, as each is of other exposures: an equal one is a repetition."""
        with suppress(MalformedMessage):
            told = decode_exposed(frame.payload)
            if told == self._exposed:
                return Output([], [], None)
            self._exposed = told
            wrong = self._rules.of_exposed(told, self._n_told or 0, self.end_exposure)
            if wrong is not None:
                return Output([], [self._contradicts(wrong)], None)
            if self._n_told is not None:
                self._n_told += told.exposures
            self._worst_told = max(self._worst_told, abs(told.start_error))
            self.exposed = self.exposed.joined(told)
            if (wrong := self._late_blocks(standing)) is not None:
                return Output([], [self._contradicts(wrong)], None)
        return Output([], [], None)

    def _late_blocks(self, standing: Standing) -> Contradiction | None:
        """Compare the ticks of blocks with EXPOSED, once it has told of all that came: none may be farther from the plan than that."""
        if not self._n_told or self._n_told < standing.next_exposure:
            return None
        told = max(self._worst_told + 1, self._jitter_known)  # a device may round the tick of a block by itself
        if min(standing.jitter_ticks, I32_MAX) <= told:
            return None
        self._jitter_known = standing.jitter_ticks
        return Contradiction("exposed", standing.next_exposure - 1, standing.jitter_ticks, self._worst_told)

    def _count_untold(self, due: int) -> None:
        """Account for what EXPOSED has not told of: of the stream's first `due` exposures, those that came or were lost."""
        if self._n_told is not None:
            self.untold += max(0, min(due, self.tracker.next_exposure) - self._n_told)

    def _on_status(self, frame: Frame, standing: Standing) -> Output:
        """When the device says that the plan is done, settle what will never be complete.

        STATUS may overtake stream messages, so that with exposures missing only a second one settles them.
        """
        try:
            status = decode_status(frame.payload)
        except MalformedMessage:
            return Output([], [], None)
        if status.tick < self.start_tick:  # an earlier run's news
            return Output([], [], None)
        if self.completed:
            wrong = self._rules.of_status(status, self.start_tick, self.end_exposure)
            return Output([], [] if wrong is None else [self._contradicts(wrong)], None)
        wrong, self._status = self._takes_back(status, standing), status
        events: list[CoreEvent] = [] if wrong is None else [self._contradicts(wrong)]
        return joined(Output([], events, None), self._settle_status(status))

    def _settle_status(self, status: Status) -> Output:
        if (status.state, status.reason) != (DeviceState.IDLE, StateReason.COMPLETED):
            wrong = self._rules.of_status(status, self.start_tick, self.end_exposure)
            # one that ends a stream otherwise is judged when the stream is closed
            running = status.state in (DeviceState.ARMED, DeviceState.RUNNING)
            return Output([], [] if wrong is None or not running else [self._contradicts(wrong)], None)
        missing = min(status.next_exposure, self.end_exposure) > self.tracker.next_exposure
        if missing and (self._told_end is None or status.tick <= self._told_end):  # the same one may come twice
            self._told_end = status.tick
            wrong = None if self._told_wrong else self._rules.of_status(status, self.start_tick, self.end_exposure)
            self._told_wrong |= wrong is not None  # judged now: what it overtook may complete the plan
            return Output([], [] if wrong is None else [self._contradicts(wrong)], None)
        return self._finish(status)

    def _takes_back(self, status: Status, standing: Standing) -> Contradiction | None:
        """What `status` takes back of an earlier STATUS, of EXPOSED, or of blocks that had ended by its tick.

        A run that is stopped has one exposure less than had begun, as the one under way is not counted.
        """
        known, claimed = self._status, status.next_exposure
        if known is not None and status.tick <= known.tick:
            return None  # it came twice
        least, dropped, most = self._n_told or 0, 0, claimed
        if known is not None:
            least, dropped = max(least, known.next_exposure - 1), known.drops
            most = claimed if known.state in (DeviceState.ARMED, DeviceState.RUNNING) else known.next_exposure
        if status.tick >= standing.last_tick:
            least, dropped = max(least, standing.next_exposure), max(dropped, standing.drops)
        if not min(least, self.end_exposure) <= claimed <= most:
            return Contradiction("claimed_exposures", claimed, claimed, most if claimed > most else least)
        if status.drops < dropped and claimed < 1 << 32:
            return Contradiction("claimed_drops", claimed, status.drops, dropped)
        return None

    def _finish(self, status: Status) -> Output:
        """Close the stream; what `status` claims beyond the plan or beyond what is believed is no gap but a contradiction."""
        self.completed = True
        wrong = None if self._told_wrong else self._rules.of_status(status, self.start_tick, self.end_exposure)
        end = min(status.next_exposure, self.end_exposure)
        late = self._late_blocks(self._standing())
        unexplained = self.tracker.counters.unexplained_drops
        gap = self.tracker.finish(end, status.drops)
        self._count_untold(end)
        if wrong is None and self.tracker.counters.unexplained_drops != unexplained:
            wrong = Contradiction("closing_status", status.next_exposure, status.drops, self.tracker.next_exposure)
        events: list[CoreEvent] = [] if gap is None else [gap]
        events += [self._contradicts(one) for one in (wrong, late) if one is not None]
        return joined(Output([], events, None), self._skip_to(min(end, self.tracker.next_exposure), status.tick))

    def remember_rows(self, rows: npt.NDArray[np.void]) -> None:
        """Know marks that the kernel has taken, MARK_DTYPE (n,), from here on."""
        self.marks.add_rows(rows)

    def remember(self, mark: Mark) -> None:
        """Know a mark from here on."""
        self.marks.add(mark)
