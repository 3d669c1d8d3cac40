"""Decisions about objects in flow, one for each: what cells (cells.py) and a tape (tape.py) have in common.

Owns the ring of the last frames, the verdict on a window, the pulse it asks for and why a passage is given up; frames run through
kernels.py. Never reads a clock and never learns the truth before it has decided: matching.py compares afterwards. A core of a flow has
the shape of core.Core; its outputs also carry the passages and the pulses. make.py makes one.

A cell's row of the decision log says: `object` the number of the passage, `exposure_index` the last exposure of the best window,
`clicks` those of that window. No window overlaps a gap: the row is then flagged GAP and abstains.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.runtime.core.dark_guard import DarkGuard
from pans.runtime.core.decision import NO_LABEL, Action, Decision, DecisionFlag, Output, Passage, Rows, joined
from pans.runtime.core.follower import Follower
from pans.runtime.core.plan import Plan
from pans.runtime.core.window import DARK_CLICKS, DARK_EXPOSURES, N_TALLIES
from pans.runtime.decide.backends import Decider
from pans.runtime.decide.verdict import Verdict, log_evidence, softmax_winner
from pans.runtime.errors import UsageError
from pans.runtime.instrument.channel_health import Finding
from pans.runtime.wire import walk as stream
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import DARK_PATTERN, NO_OBJECT, UNKNOWN_TRUTH, ClickBlock, FrameBlock, Mark, Status

from . import columns, kernels
from . import walk as walking
from .arrays import FlowArrays, NewMarks
from .matching import PassageMatcher
from .settings import WATCHED_FRAMES, FlowLimits, FlowSettings

MAX_CHANNELS = 64  # bits of a ring word
MAX_PASSAGES = 64  # of one call of the kernel; it is called again
MAX_MARKS_AT_ONCE = 64
NO_FLAGS = DecisionFlag(0)
_GAP, _ABSTAINED, _NOT_FINITE, _AMBIGUOUS = (
    int(flag) for flag in (DecisionFlag.GAP, DecisionFlag.ABSTAINED, DecisionFlag.NOT_FINITE, DecisionFlag.AMBIGUOUS)
)  # plain integers: an enumeration's operators cost a microsecond each

I64 = npt.NDArray[np.int64]


class FlowCore(Follower):
    """What cells and tape share: the ring of frames, the verdict on a window, the pulse it asks for."""

    moving = True

    def __init__(
        self,
        plan: Plan,
        decider: Decider,
        settings: FlowSettings,
        limits: FlowLimits,
        gated: frozenset[int],
        shots: int,
        n_cycles: int,
    ) -> None:
        super().__init__(plan, n_cycles, decider.n_classes)
        if plan.mode != "parallel" or decider.n_features > MAX_CHANNELS:
            raise UsageError(
                f"a flow needs a parallel plan of up to {MAX_CHANNELS} channels, this one is {plan.mode} with {decider.n_features}"
            )
        self.settings, self.limits, self.shots = settings, limits, shots
        self.frames = shots * settings.pool  # of a decision
        self.guard: DarkGuard | None = None  # of the dark counts; None: they are only added up
        self.watched_frames = 0  # empty ones that it has been told of
        self._watched_channels: I64 = np.zeros(decider.n_features, np.int64)
        self.matcher = PassageMatcher(decider.n_classes, gated, self._lag(), touching=settings.kind == "tape")
        self.n_passages = 0
        self.dark_probability = 0.0  # of a click, that the limits were worked out with
        self.dark_channels: I64 = np.zeros(decider.n_features, np.int64)  # clicks in dark frames
        self.empty_channels: I64 = np.zeros(decider.n_features, np.int64)  # clicks in frames without an object
        self.decider = decider
        self.gated = gated  # classes for which a pulse is asked
        self._cycles_before = 0  # in streams that have ended
        self._state: I64 = np.zeros(kernels.N_STATE, np.int64)
        self._words = np.zeros(limits.ring, np.uint64)
        self._counts = np.zeros(limits.ring, np.int16)
        self._clicks: I64 = np.zeros((settings.pool, decider.n_features), np.int64)
        self._channel_mask = np.uint64((1 << decider.n_features) - 1)
        self._dark_cycle = plan.slots_per_cycle if plan.slot_pattern[-1] == DARK_PATTERN else 0
        self._period_ticks = plan.slot_period_ticks
        self._max_block = plan.block_exposures
        self._facts = self.new_facts()
        self._slot_offsets = plan.slot_offset_ticks.astype(np.int64)
        self._new = NewMarks(
            np.zeros((MAX_MARKS_AT_ONCE, walking.N_MARK), np.int64), np.zeros(MAX_MARKS_AT_ONCE, np.float32)
        )
        self._limits: I64 = np.zeros(0, np.int64)  # of what looks for passages; none where their times are known
        self._passages: I64 = np.zeros((MAX_PASSAGES, kernels.N_COLUMNS), np.int64)
        self._prepare(plan)
        self.arrays = FlowArrays(
            self._words,
            self._counts,
            self._limits,
            self._state,
            self.dark_channels,
            self.empty_channels,
            self._passages,
        )

    def _prepare(self, plan: Plan) -> None:
        """Make what this kind of flow needs besides, once, before arming."""
        raise NotImplementedError

    def _lag(self) -> int:
        """Exposures after which a passage can no longer be decided."""
        return 4 * self.limits.longest + 4 * self.limits.onset_frames

    @property
    def tallies(self) -> I64:
        """Dark exposures, dark clicks and wrong patterns (never seen: static patterns carry no stamp), int64 (window.N_TALLIES,)."""
        tallies: I64 = np.zeros(N_TALLIES, np.int64)
        n_dark = int(self._state[kernels.DARK_FRAMES])
        tallies[DARK_EXPOSURES], tallies[DARK_CLICKS] = n_dark * len(self.dark_channels), self.dark_channels.sum()
        return tallies

    @property
    def empty_frames(self) -> int:
        """Light frames far from every object; their clicks per channel are `empty_channels`."""
        return int(self._state[kernels.EMPTY_FRAMES])

    @property
    def dark_frames(self) -> int:
        """Dark frames; their clicks per channel are `dark_channels`."""
        return int(self._state[kernels.DARK_FRAMES])

    def cycles_left(self, n_cycles: int) -> int:
        """Return how many of `n_cycles` cycles stand out: those that have not begun."""
        return n_cycles - self._cycles_before - -(-self.tracker.next_exposure // self._slots_per_cycle)

    def new_facts(self) -> I64:
        """Return the facts of a stream that has not begun, int64 (columns.N_FACTS,)."""
        return walking.facts_of(self._plan, self.n_classes, self._dark_cycle)

    @property
    def watches_empty(self) -> bool:
        """Whether the guard is told of the empty field: there are no dark frames."""
        return self.guard is not None and not self._dark_cycle

    # -- the compiled turn ---------------------------------------------------------------------------------------------

    @property
    def excluded(self) -> str:
        """Why no compiled turn can be taken, for people; "" where it can."""
        if self.guard is not None and self.guard.policy != "warn":
            return "--on-dark changes decisions while they are made"
        if self.settings.pool > 1:
            return "the evidence of windows side by side is added in Python"
        return (
            "" if getattr(self.decider, "radix", None) is not None else "the back end is no table: it decides in Python"
        )

    def lend(self, state: I64) -> None:
        """Put what this kind of flow knows besides into `state`, int64 (columns.N_FACTS,)."""

    def take_back(self, state: Sequence[int]) -> None:
        """Go on from `state`."""

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming, on state of its own."""
        block = np.frombuffer(bytes(8 * 2), np.uint8).reshape(2, 8)
        state, words, counts = np.zeros_like(self._state), self._words.copy(), self._counts.copy()
        spare = np.zeros_like(self.dark_channels)
        kernels.put_frames(block, 0, words, counts, self._dark_cycle, state, spare, self._channel_mask)
        kernels.skip_frames(2, 3, words, counts, state)
        kernels.window_clicks(words, counts, 0, 1, spare)
        self.decider.decide(np.zeros(len(spare), np.int64), self.shots)
        self._walk(Messages(np.zeros(8, np.uint8), np.zeros((0, 2), np.int64)), 0)
        if self.guard is not None:
            self.guard.warm_up()

    # -- what the follower asks for ------------------------------------------------------------------------------------

    def _fits(self, block: ClickBlock | FrameBlock) -> bool:
        if not isinstance(block, FrameBlock):
            return False
        n, width = block.words.shape
        return (
            n <= self._max_block and 8 * width >= len(self.dark_channels) and block.period_ticks == self._period_ticks
        )

    def _take(self, block: ClickBlock | FrameBlock, n_exposures: int, end_tick: int) -> Output:
        assert isinstance(block, FrameBlock)  # _fits has seen to it
        kernels.put_frames(
            block.words, block.exposure_index, self._words, self._counts, self._dark_cycle, self._state, self.dark_channels,
            self._channel_mask,
        )  # fmt: skip
        events = [] if self.guard is None or not self._dark_cycle else self.guard.take(block)
        came = self._came(block.exposure_index + n_exposures, end_tick, 0)
        return joined(Output([], events, None), came) if events else came

    def _came(self, stop: int, end_tick: int, found: int) -> Output:
        """Decide on what exposures up to `stop` - 1, now in the ring, settle; `found` passages stand in `_passages` already."""
        output = self._settle(stop, end_tick, found)
        if self.guard is not None and self.watches_empty:
            news = self.watch_empty(self.guard, self.empty_frames, self.empty_channels)
            output = joined(output, Output([], news, None)) if news else output
        self.matcher.settle(stop)
        return output

    def step_messages(self, messages: Messages, place: int) -> tuple[int, Output]:
        """See Follower: ordinary messages are taken in one call of a kernel, up to the first block of which something comes."""
        by_block = self.guard is not None and self._dark_cycle  # it wants to see every block
        taken = 0 if by_block or not self.tracker.open else self._walk(messages, place)
        if not taken:
            return super().step_messages(messages, place)
        facts = self._facts.tolist()
        n_marks, n_messages = facts[columns.MARKS], facts[stream.MESSAGES]
        position = facts[stream.NEXT_SEQ], facts[stream.NEXT_EXPOSURE]
        self.tracker.advance(position, n_messages, facts[stream.EXPOSURES])
        if n_marks:
            for mark, photons in zip(self._new.rows[:n_marks].tolist(), self._new.photons[:n_marks].tolist()):
                self.remember(Mark._make([*mark[: walking.M_HALF], photons, mark[walking.M_HALF]]))
        if n_messages == n_marks:
            return taken, Output([], [], None)
        self.last_tick, self.jitter_ticks = facts[columns.END_TICK], facts[columns.JITTER_TICKS]
        came = self._came(position[1], self.last_tick, facts[columns.PASSAGES])
        return taken, Output(came.decisions, came.events, self.last_tick, came.passages, came.actions)

    def _walk(self, messages: Messages, place: int) -> int:
        """Bring the kernel's facts up to date and let it take messages; return how many it took."""
        facts = self._facts
        watch_at = 1 << 62 if self.guard is None else self.watched_frames + WATCHED_FRAMES
        facts[: stream.MESSAGES] = (*self.tracker.position, min(self.end_exposure, 1 << 62))
        facts[columns.START_TICK], facts[columns.WATCH_AT] = self.start_tick, watch_at
        facts[columns.JITTER_TICKS] = self.jitter_ticks
        shape = self._slot_offsets, self.arrays, self._channel_mask
        taken = walking.walk(messages, place, facts, *shape, self._new, self.tracker.heard)
        return int(taken)

    def watch_empty(self, guard: DarkGuard, empty_frames: int, empty_channels: I64) -> list[Finding]:
        """Without dark slots, the frames in which no object was found, so many with these clicks, tell the dark rates."""
        frames = empty_frames - self.watched_frames
        if frames < WATCHED_FRAMES:
            return guard.news()
        clicks = empty_channels - self._watched_channels
        self.watched_frames, self._watched_channels = empty_frames, empty_channels.copy()
        return guard.take_empty(frames, np.minimum(clicks, frames))

    def _skip_to(self, exposure_index: int, tick: int) -> Output:
        following = int(self._state[kernels.NEXT])
        if exposure_index <= following:
            return Output([], [], None)
        self.matcher.add_gap(following, exposure_index)
        output = self._lose(exposure_index, tick)
        kernels.skip_frames(following, exposure_index, self._words, self._counts, self._state)
        return output

    def _give_up(self) -> Output:
        output = self._close()
        self._cycles_before += -(-self.tracker.next_exposure // self._slots_per_cycle)
        if self.guard is not None:
            self.guard.restart()
        self.matcher.finish()
        dark, empty = self._state[kernels.DARK_FRAMES], self._state[kernels.EMPTY_FRAMES]
        self._state[:] = 0
        self._state[kernels.DARK_FRAMES], self._state[kernels.EMPTY_FRAMES] = dark, empty
        return output

    def _finish(self, status: Status) -> Output:
        output = joined(super()._finish(status), self._close())
        self.matcher.finish()
        return output

    def _nothing_left(self) -> bool:
        return self.tracker.next_exposure >= self.end_exposure

    def remember(self, mark: Mark) -> None:
        super().remember(mark)
        self.matcher.add_mark(mark)

    def _place(self) -> dict[str, Any] | None:
        if self._state[kernels.STATE] == kernels.OPEN:
            return None
        if self.guard is not None and self.guard.policy != "warn":
            return None  # what it has learnt decides too
        frames = np.arange(int(self._state[kernels.NEXT]) - self._kept_frames(), int(self._state[kernels.NEXT]))
        slots = frames & (len(self._words) - 1)
        return {
            "passages": self.n_passages,
            "cycles_before": self._cycles_before,
            "state": self._state.tolist(),
            "words": self._words[slots].astype("<u8").tobytes().hex(),
            "counts": self._counts[slots].tolist(),
        }

    def _go_on_from(self, place: dict[str, Any]) -> None:
        self.n_passages, self._cycles_before = int(place["passages"]), int(place["cycles_before"])
        self._state[:] = place["state"]
        stop = int(self._state[kernels.NEXT])
        slots = np.arange(stop - len(place["counts"]), stop) & (len(self._words) - 1)
        self._words[slots] = np.frombuffer(bytes.fromhex(place["words"]), "<u8")
        self._counts[slots] = place["counts"]
        self.matcher.forget_marks(stop - self.frames // 2)  # they were decided in the part before

    # -- what cells and tape do each in their way ----------------------------------------------------------------------

    def _settle(self, stop: int, end_tick: int, found: int) -> Output:
        """Decide on what is settled by exposures up to `stop` - 1, the last of which ended at `end_tick`.

        `found` rows of `_passages` are there already.
        """
        raise NotImplementedError

    def _kept_frames(self) -> int:
        """How many of the last frames a decision to come may need, while no object is being followed."""
        raise NotImplementedError

    def _lose(self, stop: int, tick: int) -> Output:
        """Give up what needs an exposure before `stop` that never came."""
        return Output([], [], None)

    def _close(self) -> Output:
        """Give up what the end of the stream leaves open."""
        return Output([], [], None)

    # -- one decision --------------------------------------------------------------------------------------------------

    def _row(self, passage: Passage, first: int, end_tick: int, why: DecisionFlag, out: Rows) -> None:
        """Decide on the window from exposure `first` on, which ended at `end_tick`; `why` it must not be decided."""
        label, probability, clicks, crc, flags = NO_LABEL, 0.0, 0, 0, int(why)
        if not flags & _GAP:
            unlit = self._sum_clicks(first)
            if unlit:
                flags |= _GAP
            else:
                clicks, crc = int(self._clicks.sum()), zlib.crc32(self._clicks.tobytes())
                if self.guard is not None:
                    self.guard.take_object(self._clicks.sum(axis=0), NO_OBJECT)
        alarmed = 0 if self.guard is None else int(self.guard.flags)
        if alarmed & _ABSTAINED:
            flags |= alarmed
        if not flags:
            label, probability = self._verdict()
            if not probability > 0:
                flags |= _NOT_FINITE
            elif probability < self.settings.sure:
                flags |= _AMBIGUOUS
        if flags:
            label, flags = NO_LABEL, flags | _ABSTAINED
            self.n_abstained += 1
        flags |= alarmed  # decided, but with another table
        last = first + self.frames - 1
        decision = Decision(
            self.n_decisions, end_tick, max(0, last), self.n_passages, 0, clicks, label, UNKNOWN_TRUTH, flags, probability, crc
        )  # fmt: skip
        self.n_decisions += 1
        self.n_passages = (self.n_passages + 1) & 0xFFFFFFFF
        self.put_row(decision, passage, out)

    def pulse(self, number: int, leave_tick: int) -> Action:
        """Return the pulse that decision `number` asks for, whose object left at `leave_tick`."""
        tick = leave_tick + self.limits.gate_delay_ticks
        return Action(number, tick, self.limits.gate_ticks, self.settings.gate_channel)

    def put_row(self, decision: Decision, passage: Passage, out: Rows) -> None:
        """Say a decision, ask for its pulse, and compare it with the truth."""
        out.decisions.append(decision)
        out.passages.append(passage)
        gated = decision.label in self.gated
        if gated:
            out.actions.append(self.pulse(decision.number, passage.leave_tick))
        self.matcher.add_decision(decision, passage, gated)

    def _sum_clicks(self, first: int) -> int:
        """Fill the clicks of the windows from `first` on; return how many of their frames had no light or never came."""
        unlit = 0
        for window in range(self.settings.pool):
            start = first + window * self.shots
            unlit += kernels.window_clicks(self._words, self._counts, start, self.shots, self._clicks[window])
        return unlit

    def _verdict(self) -> Verdict:
        decider = self.decider
        if self.guard is not None:
            decider = self.guard.decider(decider)
            for counts in self._clicks:
                self.guard.count_word(counts)
        if self.settings.pool == 1:
            return decider.decide(self._clicks[0], self.shots)
        scores = decider.scores_batch(self._clicks, self.shots)
        return softmax_winner(log_evidence(scores).sum(axis=0))
