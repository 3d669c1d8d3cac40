"""Decisions about objects in flow, cells or the bars of a tape, one for each.

`FlowCore` takes frames and marks one by one (`step`), or lets the kernel take them (`steps`): both continue the same arrays, and kernels.py
decides. What a decision was worth, matching.py says afterwards. Outputs also carry the passages and the pulses. make.py makes a core.

A cell's row of the decision log says: `object` the number of the passage, `exposure_index` the last exposure of the best window,
`clicks` those of that window. No window overlaps a gap: the row is then flagged GAP and abstains.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.base.errors import UsageError
from pans.bundle.backends import NO_LABEL, Decider, Verdict, log_evidence, softmax_winner
from pans.decide.core_state import LARGEST
from pans.decide.dark.guard import DarkGuard
from pans.decide.dark.health import Finding
from pans.decide.decision import DECISION_DTYPE, Action, CoreEvent, Decision, DecisionFlag, Output, Passage, joined
from pans.decide.follower import Follower
from pans.decide.plan.marks import mark_of
from pans.decide.plan.plan import Plan
from pans.decide.still.tables import decision_tables, undecided
from pans.decide.still.window_kernels import DARK_CLICKS, DARK_EXPOSURES, N_TALLIES
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT, ClickBlock, FrameBlock, Mark, Status

from . import kernels
from .kernels import RING_DTYPE, FlowArrays, FlowWalk
from .matching import PassageMatcher
from .settings import WATCHED_FRAMES, FlowLimits, FlowSettings, Q

MAX_CHANNELS = 64  # bits of a ring word
MAX_PASSAGES = 64  # of one call of `scan`; it is called again
ROWS_MORE = 2048  # decisions of one call, beside those of a block
MOST_BLOCKS = (
    4096  # whose empty frames have not been told yet: as many as the rings keep times of (decide/kernel/arrays.py)
)
_NEVER = 1 << 62  # more empty frames than ever come
_PART = (1 << Q) - 1
_GAP, _ABSTAINED, _NOT_FINITE, _AMBIGUOUS = (
    int(flag) for flag in (DecisionFlag.GAP, DecisionFlag.ABSTAINED, DecisionFlag.NOT_FINITE, DecisionFlag.AMBIGUOUS)
)  # plain integers: an enumeration's operators cost a microsecond each

I64 = npt.NDArray[np.int64]


class FlowCore(Follower):
    """The decisions on one flow; `walk` is what the kernel continues, and what `step` continues with the same kernels."""

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
        n = decider.n_features
        if plan.mode != "parallel" or n > MAX_CHANNELS:
            raise UsageError(
                f"a flow needs a parallel plan of up to {MAX_CHANNELS} channels, this one is {plan.mode} with {n}"
            )
        self.settings, self.limits, self.shots, self.decider = settings, limits, shots, decider
        self.frames = shots * settings.pool  # of a decision
        self._guard: DarkGuard | None = None
        self.watched_frames = 0  # empty ones that it has been told of
        self._watched_channels: I64 = np.zeros(n, np.int64)
        self._is_tape = settings.kind == "tape"
        lag = 64 + 4 * self.frames if self._is_tape else 4 * limits.longest + 4 * limits.onset_frames
        self.matcher = PassageMatcher(decider.n_classes, gated, lag, touching=self._is_tape)
        self.dark_probability = 0.0  # of a click, that the limits were worked out with
        self.gated = gated  # classes for which a pulse is asked
        self._cycles_before = 0  # in streams that have ended
        self._told = 0  # of walk.empty
        self._dark_cycle = plan.slots_per_cycle if plan.slot_pattern[-1] == DARK_PATTERN else 0
        self._period_ticks, self._max_block = plan.slot_period_ticks, plan.block_exposures
        self.block_rows = plan.block_exposures + 1 + MAX_PASSAGES
        self._facts: Any = self.state[0]  # by name
        self.walk = self._new_walk(plan, n)
        rows = np.zeros(self.block_rows, DECISION_DTYPE), np.zeros((self.block_rows, kernels.N_PASSAGE), np.int64)
        counts: I64 = np.zeros((self.block_rows, settings.pool, n), np.int64)
        self._own = self.walk._replace(
            rows=rows[0], passages=rows[1], counts=counts
        )  # for `step`: the rows of a call stay
        self._ring = self.walk.flow
        self._passing: Any = self._ring.ring[0]
        self.dark_channels, self.empty_channels = self._ring.dark_channels, self._ring.empty_channels
        if self._is_tape:
            self._prepare_tape(plan)

    def _new_walk(self, plan: Plan, n: int) -> FlowWalk:
        # two halves: one is filled while the other is accounted for
        limits, pool, n_rows = self.limits, self.settings.pool, 2 * self.block_rows + ROWS_MORE
        facts = self._facts
        facts.max_block, facts.dark_every, facts.frames = plan.block_exposures, self._dark_cycle, self.frames
        facts.watch_at = _NEVER
        # of what looks for passages; none where their times are known
        looks = np.array([] if self._is_tape else limits[:8], np.int64)
        flow = FlowArrays(
            np.zeros(limits.ring, np.uint64),
            np.zeros(limits.ring, np.int16),
            looks,
            np.zeros(1, RING_DTYPE),
            np.zeros(n, np.int64),
            np.zeros(n, np.int64),
            np.zeros((MAX_PASSAGES, kernels.N_COLUMNS), np.int64),
        )
        gated = np.zeros(max(1, self.decider.n_classes), np.uint8)
        gated[sorted(self.gated)] = 1
        tables = decision_tables(self.decider, self.shots, plan)
        if pool > 1:  # evidence is added up by the back end
            tables = undecided(tables)
        # np.full touches what it makes; np.zeros would leave that to the first use, a fault of a page each
        return FlowWalk(
            self.state,
            flow,
            plan.slot_offset_ticks.astype(np.int64),
            np.full(1, (1 << n) - 1, np.uint64),
            tables,
            np.full(1, self.settings.sure, np.float64),
            gated,
            np.full(n_rows, 0, DECISION_DTYPE),
            np.full((n_rows, kernels.N_PASSAGE), 0, np.int64),
            np.full((n_rows, pool, n), 0, np.int64),
            np.full((MOST_BLOCKS, 2 + n), 0, np.int64),
            np.zeros(kernels.N_EDGES, np.int64),
            self.tracker.heard,
        )

    @property
    def guard(self) -> DarkGuard | None:
        """The guard of the dark counts; None: they are only added up."""
        return self._guard

    @guard.setter
    def guard(self, guard: DarkGuard | None) -> None:
        self._guard = guard
        if guard is not None and guard.policy != "warn":  # each verdict depends on what it has found
            self.walk = self.walk._replace(tables=undecided(self.walk.tables))
            self._own = self._own._replace(tables=self.walk.tables)
        self._watch_on()

    @property
    def tallies(self) -> I64:
        """Dark exposures, dark clicks and wrong patterns (never seen: static patterns carry no stamp), int64 (still/windows.N_TALLIES,)."""
        tallies: I64 = np.zeros(N_TALLIES, np.int64)
        n_dark = int(self._passing.dark_frames)
        tallies[DARK_EXPOSURES], tallies[DARK_CLICKS] = n_dark * len(self.dark_channels), self.dark_channels.sum()
        return tallies

    @property
    def empty_frames(self) -> int:
        """Light frames far from every object; their clicks per channel are `empty_channels`."""
        return int(self._passing.empty_frames)

    @property
    def n_passages(self) -> int:
        """Objects so far."""
        return int(self._facts.objects)

    @property
    def bars_per_s(self) -> float | None:
        """A tape's speed: as it was said, or as it was last found; None of cells."""
        facts = self._facts
        return float(self.settings.bars_per_s * facts.nominal_pitch / facts.pitch) if self._is_tape else None

    def cycles_left(self, n_cycles: int) -> int:
        """Return how many of `n_cycles` cycles stand out: those that have not begun."""
        return n_cycles - self._cycles_before - -(-self.tracker.next_exposure // self._slots_per_cycle)

    @property
    def watches_empty(self) -> bool:
        """Whether the guard is told of the empty field: there are no dark frames."""
        return self.guard is not None and not self._dark_cycle

    def begin(self, start_tick: int, n_cycles: int) -> Output:
        """See Follower."""
        output = super().begin(start_tick, n_cycles)
        self._facts.marked = self.marks.following
        return output

    # -- the kernel ----------------------------------------------------------------------------------------------------

    def steps(self, session: int) -> FlowCore:
        """See Follower."""
        self._facts.session = session
        return self

    @property
    def takes(self) -> bool:
        """Whether the kernel may take messages."""
        return self.tracker.open

    @property
    def decides(self) -> bool:
        """Whether it gives the labels, too: with a table, and where nothing else has a say. Else `account` asks the back end."""
        return bool(self.walk.tables.labels.size)

    def rows(self, first: int, stop: int) -> npt.NDArray[np.void]:
        """Return the rows from `first` to `stop`."""
        return self.walk.rows[first:stop]

    def _watch_on(self) -> None:
        """Let the kernel tell of the empty field again once it has given enough."""
        self._facts.watch_at = self.watched_frames + WATCHED_FRAMES if self.watches_empty else _NEVER

    def told_empty(self, told: int) -> list[list[int]]:
        """Return what the empty field gave up to its `told`-th telling and has not been accounted for: rows of `FlowWalk.empty`."""
        first, self._told = self._told, told
        return self.walk.empty[np.arange(first, self._told) % MOST_BLOCKS].tolist()

    def leave_ticks(self, first: int, stop: int) -> I64:
        """Return when the objects of rows `first` to `stop` - 1 left, int64 (n,) device ticks."""
        return self.walk.passages[first:stop, kernels.W_LEAVE]

    def pulses(self, first: int, stop: int) -> list[Action]:
        """Return the pulses that rows `first` to `stop` - 1 ask for, in order."""
        rows, leaves = self.walk.rows[first:stop], self.leave_ticks(first, stop)
        places = np.flatnonzero(np.isin(rows["label"], sorted(self.gated))) if self.gated else ()
        return [self._pulse(int(rows["index"][place]), int(leaves[place])) for place in places]

    def watch(self, empty: list[int] | None) -> list[Finding]:
        """Let the guard see what the empty field gave with a block, a row of `told_empty`; return what it found with that, and before."""
        if self.guard is None:
            return []
        frames = self.watched_frames if empty is None else empty[1]
        return self._watch_empty(self.guard, frames, np.array([] if empty is None else empty[2:], np.int64))

    def account(
        self, rows: slice, behind: int, end_tick: int | None, empty: list[int] | None, block: FrameBlock | None
    ) -> Output:
        """Account for what the kernel decided on a block that ended at `end_tick`; exposure `behind` follows.

        `rows` are its decisions, `empty` what the empty field gave with it; `block` is for the guard of dark frames. Where the kernel
        does not decide, the back end does so here.
        """
        guard = self.guard
        events: list[CoreEvent] = [] if block is None or guard is None else [*guard.take(block)]
        decided = self._decided(self.walk, rows)
        if self.watches_empty:
            events = [*self.watch(empty)]
        self.matcher.settle(behind)
        return Output(decided.decisions, events, end_tick, decided.passages, decided.actions)

    def _watch_empty(self, guard: DarkGuard, empty_frames: int, empty_channels: I64) -> list[Finding]:
        """Without dark slots, the frames in which no object was found, so many with these clicks, tell the dark rates."""
        frames = empty_frames - self.watched_frames
        if frames < WATCHED_FRAMES:
            return guard.news()
        clicks = empty_channels - self._watched_channels
        self.watched_frames, self._watched_channels = empty_frames, empty_channels.copy()
        return guard.take_empty(frames, np.minimum(clicks, frames))

    # -- one decision --------------------------------------------------------------------------------------------------

    def _decided(self, walk: FlowWalk, rows: slice) -> Output:
        """Give verdicts to the rows of `walk` that wait for one, compare all with the truth, and ask for pulses."""
        guard, decides, actions = self.guard, self.decides, list[Action]()
        for at in range(rows.start, rows.stop) if guard is not None or not decides else ():
            row, counts = walk.rows[at], walk.counts[at]
            if guard is not None and not row["flags"] & _GAP:
                guard.take_object(counts.sum(axis=0), NO_OBJECT)
            if not decides:
                self._judge(row, counts)
        decisions = [Decision(*row) for row in walk.rows[rows].tolist()]
        passages = tuple(Passage(*row) for row in walk.passages[rows].tolist())
        for decision, passage in zip(decisions, passages):
            gated = decision.label in self.gated
            if gated:
                actions.append(self._pulse(decision.number, passage.leave_tick))
            self.matcher.add_decision(decision, passage, gated)
        return Output(decisions, [], None, passages, tuple(actions))

    def _judge(self, row: Any, counts: I64) -> None:
        """Complete a row that the kernel has not decided, from the clicks of its windows int64 (pool, d_f)."""
        flags, alarmed = int(row["flags"]), 0 if self.guard is None else int(self.guard.flags)
        waits = not flags
        if not flags & _GAP:
            row["clicks"], row["counts_crc"] = counts.sum(), zlib.crc32(counts.tobytes())
        if alarmed & _ABSTAINED:
            flags |= alarmed
        if not flags:
            verdict = self._verdict(counts)
            if not verdict.probability > 0:
                flags |= _NOT_FINITE
            elif verdict.probability < self.settings.sure or verdict.label == NO_LABEL:
                flags |= _AMBIGUOUS
            row["label"], row["probability"] = NO_LABEL if flags else verdict.label, verdict.probability
        flags |= _ABSTAINED if flags else 0
        self.n_abstained += bool(waits and flags)
        row["flags"] = flags | alarmed  # decided, but with another table

    def _verdict(self, counts: I64) -> Verdict:
        decider = self.decider
        if self.guard is not None:
            decider = self.guard.decider(decider)
            for one in counts:
                self.guard.count_word(one)
        if self.settings.pool == 1:
            return Verdict(*decider.decide(counts[0], self.shots))
        return softmax_winner(log_evidence(decider.scores_batch(counts, self.shots)).sum(axis=0))

    def _pulse(self, number: int, leave_tick: int) -> Action:
        """Return the pulse that decision `number` asks for, whose object left at `leave_tick`."""
        tick = leave_tick + self.limits.gate_delay_ticks
        return Action(number, leave_tick, tick, self.limits.gate_ticks, self.settings.gate_channel)

    # -- what the follower asks for ------------------------------------------------------------------------------------

    def warm_up(self) -> None:
        """Run every compiled kernel of the hot path once, before arming, on state of its own."""
        ring, block = self._ring, np.frombuffer(bytes(8 * 2), np.uint8).reshape(2, 8)
        state, words, counts = np.zeros_like(ring.ring), ring.words.copy(), ring.counts.copy()
        spare, mask = np.zeros_like(self.dark_channels), self.walk.mask[0]
        kernels.put_frames(block, 0, words, counts, self._dark_cycle, state, spare, mask)
        kernels.skip_frames(2, 3, words, counts, state)
        kernels.settle(self.walk, 0, 0, 0)
        kernels.close_passage(self.walk, 0)
        self.decider.decide(np.zeros(len(spare), np.int64), self.shots)
        if self.guard is not None:
            self.guard.warm_up()

    def _fits(self, block: ClickBlock | FrameBlock) -> bool:
        if not isinstance(block, FrameBlock):
            return False
        n, width = block.words.shape
        return (
            n <= self._max_block and 8 * width >= len(self.dark_channels) and block.period_ticks == self._period_ticks
        )

    def _take(self, block: ClickBlock | FrameBlock, n_exposures: int, end_tick: int) -> Output:
        assert isinstance(block, FrameBlock)  # _fits has seen to it
        ring, first = self._ring, block.exposure_index
        skipped = self._skip_to(first, block.tick)
        ends_dark, mask = self._dark_cycle, self.walk.mask[0]
        kernels.put_frames(block.words, first, ring.words, ring.counts, ends_dark, ring.ring, self.dark_channels, mask)
        events = [] if self.guard is None or not self._dark_cycle else self.guard.take(block)
        stop = first + n_exposures
        output = self._settle(stop, end_tick - (stop - 1) * self._period_ticks, 0)
        if self.guard is not None and self.watches_empty:
            events = self._watch_empty(self.guard, self.empty_frames, self.empty_channels)
            self._watch_on()
        self.matcher.settle(stop)
        return joined(skipped, output._replace(events=events))

    def _settle(self, stop: int, origin_tick: int, flags: int) -> Output:
        """Decide on what exposures before `stop` settle; exposure e ended at `origin_tick` + e periods. With `flags` none is decided."""
        output, done, facts = Output([], [], None), False, self._facts
        watch_at, facts.watch_at = int(facts.watch_at), _NEVER  # `_take` tells the guard itself
        while not done:
            some, done = self._stepped(kernels.settle, stop, origin_tick, flags)
            output = joined(output, some)
        facts.watch_at, facts.asks = watch_at, 0  # the pulses are in the output
        return output

    def _skip_to(self, exposure_index: int, tick: int) -> Output:
        ring, output = self._ring, Output([], [], None)
        following = int(self._passing.next_exposure)
        if exposure_index <= following:
            return output
        self.matcher.add_gap(following, exposure_index)
        if self._is_tape:
            output = self._settle(exposure_index, tick - exposure_index * self._period_ticks, _GAP)
        kernels.skip_frames(following, exposure_index, ring.words, ring.counts, ring.ring)
        return output

    def _close(self) -> Output:
        """Give up what the end of the stream leaves open."""
        return self._stepped(kernels.close_passage, min(self.last_tick, LARGEST))[0]

    def _stepped(self, kernel: Any, *arguments: int) -> tuple[Output, bool]:
        """Run a compiled step on rows of its own; return what it decides, and whether it is done."""
        facts = self._facts
        kept, facts.n_rows = int(facts.n_rows), 0
        done = kernel(self._own, *arguments)
        n, facts.n_rows = int(facts.n_rows), kept
        return self._decided(self._own, slice(0, n)), bool(done)

    def _give_up(self) -> Output:
        output, passing = self._close(), self._passing
        self._cycles_before += -(-self.tracker.next_exposure // self._slots_per_cycle)
        if self.guard is not None:
            self.guard.restart()
        self.matcher.finish()
        dark, empty = passing.dark_frames, passing.empty_frames
        self._ring.ring[:] = 0
        passing.dark_frames, passing.empty_frames = dark, empty
        if self._is_tape:
            self._begin_tape()
        return output

    def _finish(self, status: Status) -> Output:
        output = joined(super()._finish(status), self._close())
        self.matcher.finish()
        return output

    def remember_rows(self, rows: npt.NDArray[np.void]) -> None:
        """See Follower; the kernel takes no mark of an object twice."""
        super().remember_rows(rows)
        for row in rows:
            self.matcher.add_mark(mark_of(row))

    def remember(self, mark: Mark) -> None:
        """See Follower."""
        is_new = mark.object_index == NO_OBJECT or self.marks.get(mark.object_index) is None
        super().remember(mark)
        if (
            self.marks.following > self._facts.marked
        ):  # never of a mark that a kernel has taken, which may go on meanwhile
            self._facts.marked = self.marks.following
        if is_new:
            self.matcher.add_mark(mark)

    # -- parts of a recording ------------------------------------------------------------------------------------------

    def _place(self) -> dict[str, Any] | None:
        ring, facts, passing = self._ring, self._facts, self._passing
        if passing.phase == kernels.OPEN:
            return None
        if self.guard is not None and self.guard.policy != "warn":
            return None  # what it has learnt decides too
        kept, tracks = 2 * self.limits.longest, self._is_tape and self.settings.track > 0
        if self._is_tape:
            kept = max(self.frames, int(facts.pitch) >> Q) + (2 * self.frames + 2 if tracks else 0)
        slots = np.arange(int(passing.next_exposure) - kept, int(passing.next_exposure)) & (len(ring.words) - 1)
        found: dict[str, Any] = {
            "passages": self.n_passages,
            "cycles_before": self._cycles_before,
            "state": ring.ring.view(np.int64).tolist(),
            "words": ring.words[slots].astype("<u8").tobytes().hex(),
            "counts": ring.counts[slots].tolist(),
        }
        if self._is_tape:
            found["position"] = int(facts.position)
        if tracks:
            found |= {"middle": _whole(facts.middle, facts.middle_part), "pitch": int(facts.pitch)}
            found["before"] = [int(facts.before), _whole(facts.before_middle, facts.before_part)]
        return found

    def _go_on_from(self, place: dict[str, Any]) -> None:
        ring, facts = self._ring, self._facts
        facts.objects, self._cycles_before = int(place["passages"]), int(place["cycles_before"])
        ring.ring.view(np.int64)[:] = place["state"]
        stop = int(self._passing.next_exposure)
        slots = np.arange(stop - len(place["counts"]), stop) & (len(ring.words) - 1)
        ring.words[slots] = np.frombuffer(bytes.fromhex(place["words"]), "<u8")
        ring.counts[slots] = place["counts"]
        if self._is_tape:
            facts.position = int(place["position"])
            facts.middle, facts.middle_part = _parts(self._origin + int(place["position"]) * self._nominal_pitch)
        if self._is_tape and self.settings.track:
            facts.middle, facts.middle_part = _parts(int(place["middle"]))
            facts.pitch, facts.before = int(place["pitch"]), int(place["before"][0])
            facts.before_middle, facts.before_part = _parts(int(place["before"][1]))
        self.matcher.forget_marks(stop - self.frames // 2)  # they were decided in the part before

    # -- a tape --------------------------------------------------------------------------------------------------------

    def _prepare_tape(self, plan: Plan) -> None:
        """Work out when bars are aligned, in 2^-Q exposures; UsageError where a decision does not fit into a bar."""
        settings, period_us = self.settings, plan.slot_period_ticks * plan.tick_us
        pitch = self._nominal_pitch = round((1 << Q) * 1e6 / settings.bars_per_s / period_us)
        first_us = settings.first_bar * 1e6 / settings.bars_per_s - plan.exposure_us / 2
        self._origin = round((1 << Q) * first_us / period_us)
        if pitch < self.frames << Q:
            raise UsageError(
                f"a bar passes in {pitch / (1 << Q):.3g} frames, a decision takes {self.frames}",
                remedy="fewer shots, shorter exposures or a slower tape",
            )
        if settings.track and pitch < (self.frames + 2) << Q:
            raise UsageError(
                f"a bar passes in {pitch / (1 << Q):.3g} frames: following the tape needs two beside those of the decision",
                remedy="shorter exposures, or track = 0",
            )
        self._begin_tape()

    def _begin_tape(self) -> None:
        """Look for position 0, or the first one whose window does not begin before the stream."""
        pitch, facts = self._nominal_pitch, self._facts
        position = max(0, -self._origin // pitch)
        while self.window_of(self._origin + position * pitch) < 0:
            position += 1
        facts.pitch = facts.nominal_pitch = pitch
        facts.track, facts.position = self.settings.track, position
        facts.middle, facts.middle_part = _parts(self._origin + position * pitch)
        facts.before, facts.before_middle, facts.before_part = -1, 0, 0

    def window_of(self, middle: int) -> int:
        """Return the first exposure of the window that is centred at `middle`, in 2^-Q exposures."""
        return (middle - ((self.frames - 1) << (Q - 1)) + (1 << (Q - 1))) >> Q


def _whole(exposures: int, part: int) -> int:
    """Return a time of the state in 2^-Q exposures; Python's integers hold any."""
    return (int(exposures) << Q) + int(part)


def _parts(middle: int) -> tuple[int, int]:
    """Invert `_whole`."""
    return middle >> Q, middle & _PART
