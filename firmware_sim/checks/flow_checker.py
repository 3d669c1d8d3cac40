"""What must hold of a flow whatever the link does: each object that passed is decided once, from its own clicks, or is reported as spoilt.

Owns the comparison of the decisions with what the instrument emitted; the account of the stream is checkers.py's. Passages are found anew,
by the definition (flow_truth.py), in what was delivered; a decision's clicks are those that the instrument emitted, its label the
table's, and a pulse is asked for where one is due. Windows beside a gap abstain. No object is left out and none is decided twice.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pans.runtime.core.decision import NO_LABEL, Decision, DecisionFlag, Output, Passage
from pans.runtime.live import LiveRun
from pans.runtime.wire.messages import ClickBlock, FrameBlock, Mark
from pans.runtime.wire.tracker import Gap

from .books import DELIVERED, RING, Stream
from .checkers import Checker
from .flow_truth import Bars, Passages, PassageTruth
from .flowing import SmallFlow

UNANSWERED = (
    "the link was lost before the device answered",
    "no answer before the end of the run",
)  # so far as is known
NEAR = 2  # exposures that a window may be beside the centre, rounding included
SWING = 0.3  # of a pitch, by which a tape that is followed may be early or late


@dataclass(slots=True)
class Passed:
    """What has passed in one session: what must be decided, what was."""

    passages: Passages | None
    due: deque[PassageTruth] = field(default_factory=deque)
    rows: deque[tuple[Decision, Passage]] = field(default_factory=deque)
    decided: int = 0
    before: int = -1  # the last exposure of the window before


class FlowChecker(Checker):
    """A checker of one run of a flow."""

    def __init__(self, flow: SmallFlow) -> None:
        super().__init__(flow.plan, 1)
        core = flow.core(0)
        self._core, self._settings, self._frames = core, flow.settings, core.frames
        assert flow.bundle.table is not None
        self._table = flow.bundle.table
        self._dark_cycle = flow.plan.slots_per_cycle if flow.settings.dark_every else 0
        self._bars = Bars(flow.settings, flow.plan, core.frames) if flow.settings.kind == "tape" else None
        self._passed: dict[int, Passed] = {}
        self._closing: Output | None = None  # of `begin` or `end`, whose rows have been taken already

    def attach(self, run: LiveRun) -> None:
        """Listen to the run: its rows come with each output that it accounts for."""
        super().attach(run)
        core, account = run.core, run._account
        begin, end = core.begin, core.end
        within = False

        def tapped_begin(start_tick: int, n_cycles: int) -> Output:
            nonlocal within
            session, within = self._host_session, True
            self._closing = begin(start_tick, n_cycles)
            within = False
            self._take(session, self._closing)
            self._close(session)
            return self._closing

        def tapped_end() -> Output:
            output = end()
            if not within:
                self._closing = output
                self._take(self._host_session, output)
            return output

        def tapped_account(output: Output, *times: Any, **how: Any) -> None:
            if output is not self._closing:
                self._take(self._host_session, output)
            account(output, *times, **how)

        for owner, name, tap in (
            (core, "begin", tapped_begin),
            (core, "end", tapped_end),
            (run, "_account", tapped_account),
        ):
            setattr(owner, name, tap)

    def close(self) -> None:
        """See Checker."""
        super().close()
        self._close(self._host_session)

    def on_event(self, session: int, event: dict[str, Any]) -> None:
        """See Checker; of a decision's own pulse the event names the tick."""
        if event["kind"] not in ("gate_refused", "gate_expired") or "decision" not in event:
            super().on_event(session, event)
            return
        pulse = event["tick"], self._core.limits.gate_ticks
        asked = [key for key, gate in self._gates.items() if (gate.tick, gate.duration_ticks) == pulse]
        gates = [(key[0], self._gates.pop(key)) for key in asked]
        if event["kind"] == "gate_expired":
            if gates:
                self.fail(f"the pulse of decision {event['decision']} was asked for, and reported as expired")
            return
        self.counts.gates_refused += 1
        if not gates:
            self.fail(f"a refusal of the pulse of decision {event['decision']} was reported that was never asked for")
        elif gates[0] in self._executed and event["text"] not in UNANSWERED:
            self.fail(f"the pulse of decision {event['decision']} was executed, and reported as refused")

    # -- what came -----------------------------------------------------------------------------------------------------

    def _of(self, session: int) -> Passed:
        if session not in self._passed:
            self._passed[session] = Passed(None if self._bars else Passages(self._core.limits))
        return self._passed[session]

    def _on_accept(self, message: ClickBlock | FrameBlock | Mark | None, gap: Gap | None) -> None:
        super()._on_accept(message, gap)
        if not isinstance(message, FrameBlock):
            return
        stream, first = self._stream(self._host_session), message.exposure_index
        words = stream.clicks[np.arange(first, first + len(message.words)) % RING].tolist()
        self._pass(first, [0 if self._is_dark(at) else word.bit_count() for at, word in enumerate(words, first)])

    def _on_gap(self, gap: Gap) -> None:
        super()._on_gap(gap)
        self._pass(gap.first_exposure, [None] * gap.exposures)

    def _pass(self, first: int, clicks: Sequence[int | None]) -> None:
        passed = self._of(self._host_session)
        if passed.passages is not None:
            for one in clicks:
                ended = passed.passages.put(one)
                if ended is not None:
                    passed.due.append(ended)
        self._compare(self._host_session)

    def _is_dark(self, exposure: int) -> bool:
        return bool(self._dark_cycle) and exposure % self._dark_cycle == self._dark_cycle - 1

    def _on_decision(self, stream: Stream, decision: Decision) -> None:
        """Those of a flow come with their passages, by `_take`."""

    def _take(self, session: int, output: Output) -> None:
        if output.decisions:
            self._of(session).rows.extend(zip(output.decisions, output.passages))
            self._compare(session)

    # -- comparing -----------------------------------------------------------------------------------------------------

    def _compare(self, session: int) -> None:
        """Compare the decisions whose exposures have all come; the compiled turn tells them first."""
        passed, stream = self._of(session), self._stream(session)
        while passed.rows and (passed.due or self._bars):
            decision, passage = passed.rows[0]
            if self._bars and decision.exposure_index >= stream.accounted_to:
                return
            passed.rows.popleft()
            self._count(decision)
            if self._bars:
                self._is_bar(self._bars, stream, passed, decision, passage)
            else:
                self._is_cell(stream, decision, passage, passed.due.popleft())
            passed.decided += 1

    def _count(self, decision: Decision) -> None:
        if decision.number != self.counts.decisions:
            self.fail(f"decision {decision.number} came, due was {self.counts.decisions}")
        self.counts.decisions += 1
        self.counts.decisions_flagged += bool(decision.flags)

    def _is_cell(self, stream: Stream, decision: Decision, passage: Passage, truth: PassageTruth) -> None:
        found = passage.first, passage.last, passage.clicks
        if found != (truth.first, truth.last, truth.clicks) or abs(passage.centre - truth.centre) > 1:
            self.fail(f"decision {decision.number} is of {passage}, what passed was {truth}")
        middle = decision.exposure_index - (self._frames - 1) / 2
        if abs(middle - truth.centre) > NEAR:
            self.fail(f"decision {decision.number} ends with exposure {decision.exposure_index}, centred was {truth}")
        must = DecisionFlag(0)
        if truth.broken:
            must = DecisionFlag.GAP
        elif truth.too_long or truth.last - truth.first >= self._core.limits.longest:
            must = DecisionFlag.COINCIDENCE
        self._is_sound(stream, decision, must, DecisionFlag.COINCIDENCE)

    def _is_bar(self, bars: Bars, stream: Stream, passed: Passed, decision: Decision, passage: Passage) -> None:
        last, before = decision.exposure_index, passed.before
        if self._settings.track:
            away = last - before - bars.pitch if before >= 0 else 0.0
        else:
            away = last - (self._frames - 1) - bars.start(passed.decided)
        allowed = SWING * bars.pitch if self._settings.track else 1.0
        if abs(away) > allowed:
            self.fail(f"position {passed.decided} ends with exposure {last}, {away:.1f} away from where it is aligned")
        passed.before = last
        self._is_sound(stream, decision, DecisionFlag(0), DecisionFlag(0))
        seen = np.arange(passage.first, passage.last + 1) % RING
        delivered = stream.clicks[seen][stream.state[seen] == DELIVERED]
        clicks = sum(word.bit_count() for word in delivered.tolist())
        if not decision.flags & DecisionFlag.GAP and passage.clicks != clicks:
            self.fail(f"decision {decision.number}: {passage.clicks} clicks in its bar, delivered were {clicks}")

    def _is_sound(self, stream: Stream, decision: Decision, must: DecisionFlag, may: DecisionFlag) -> None:
        """Compare flags, clicks and label of a decision with what was emitted in its window."""
        last, flags = decision.exposure_index, DecisionFlag(decision.flags)
        window = np.arange(last - self._frames + 1, last + 1)
        missing = any(self._is_dark(at) for at in window.tolist()) or bool(
            (stream.state[window % RING] != DELIVERED).any()
        )
        must |= DecisionFlag.GAP if missing else DecisionFlag(0)
        words = stream.clicks[window % RING].tolist()
        lit = [[word >> channel & 1 for channel in range(self._n_features)] for word in words]
        counts = np.array(lit, np.int64).sum(axis=0)
        if flags & DecisionFlag.GAP:
            crc, clicks = 0, 0
        else:
            crc, clicks = zlib.crc32(counts.tobytes()), int(counts.sum())
        label = int(self._table[sum(int(count) << channel for channel, count in enumerate(counts))].argmax())
        may |= must | (DecisionFlag.AMBIGUOUS if self._settings.sure else DecisionFlag(0)) | DecisionFlag.ABSTAINED
        wanted = NO_LABEL if flags else label
        if (
            must & ~flags
            or flags & ~may
            or bool(flags) != bool(flags & DecisionFlag.ABSTAINED)
            or (decision.counts_crc, decision.clicks, decision.label) != (crc, clicks, wanted)
        ):
            self.fail(
                f"decision {decision.number}: flags {flags!r}, due {must!r} and possible {may!r}; clicks {decision.clicks}, "
                f"emitted {clicks}, or others; label {decision.label}, due {wanted}"
            )

    def _close(self, session: int) -> None:
        """The stream is over: one object may be open, and nothing else may be left."""
        passed, stream = self._passed.get(session), self._stream(session)
        if passed is None:
            return
        self._compare(session)
        if passed.passages is not None and passed.passages.is_open and passed.rows:
            decision, _ = passed.rows.popleft()
            self._count(decision)
            if not decision.flags & DecisionFlag.INCOMPLETE or decision.label != NO_LABEL:
                self.fail(f"decision {decision.number} is of an object that was still in the field: {decision.flags}")
        if passed.rows or passed.due:
            self.fail(f"left are {len(passed.rows)} decisions without an object, {len(passed.due)} objects without one")
        if self._bars and passed.decided:
            following = (
                passed.before + (1 + SWING) * self._bars.pitch + 1
                if self._settings.track
                else self._bars.start(passed.decided) + self._frames
            )
            if following + 1 < stream.accounted_to:
                self.fail(f"position {passed.decided} was never decided: exposures up to {stream.accounted_to} came")
