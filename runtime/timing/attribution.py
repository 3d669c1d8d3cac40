"""Attribution of late and missing work: evidence in, one named cause out, with the reason in plain words.

Owns the judgement; evidence.py collects, ledger.py counts, nobody acts on it. `judge` returns a `Verdict` and is a pure function.
Every nanosecond between the end of the exposure and the decision is given to the cause that was seen there:

    gc          a garbage collection held the interpreter
    disk        a write of the recording did not return
    inference   the decision back end computed
    host        the loop or its reader waited for a processor, slept beyond its timer, or stood still (starved, stolen by the hypervisor,
                stopped)
    link        the loop was awake and waiting for bytes, and nothing says that the device was late
    device      ... and a message that says when it left shows that the link was open, or that the device held it back
    decode      the loop's own work, none of the above (reading messages, recording)

The largest share is the cause. What separates link from device is in docs/explanation/timing.md: a click block
says when it was exposed, never when it was sent, so that only a PONG or a STATUS that falls into the silence can tell; without one the
verdict is `link`, not sure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pans.runtime.wire.tracker import Gap

from .evidence import DISK, GC, IDLE, INFERENCE, OVERSLEPT, Evidence, Facts, Span, Stamped

NS_PER_MS = 1_000_000
CAUSES = ("link", "device", "host", "gc", "disk", "inference", "decode")
QUIET_NS = 50 * NS_PER_MS  # without late work: the incident is over, and the probes sent within it are back
PATIENCE_NS = 4 * QUIET_NS  # with the counters' thread, for a reading after the incident; then the loop reads them
LONGEST_INCIDENT_NS = 1_000 * NS_PER_MS  # a run that is late all the time gets a verdict per second
LEG_NS = 500_000  # a way that takes longer than this and half the delay is no ordinary one


class Verdict(NamedTuple):
    """The cause, how much of the delay it explains, whether the evidence settles it, and why in plain words."""

    cause: str
    share_ns: int
    sure: bool
    why: str
    shares_ns: dict[str, int]

    def facts(self) -> dict[str, Any]:
        """Return what an event says of it; shares in whole microseconds, those below one left out."""
        shares = {name: share // 1000 for name, share in self.shares_ns.items() if share >= 1000}
        return {"cause": self.cause, "sure": self.sure, "why": self.why, "shares_us": shares}


def judge(facts: Facts) -> Verdict:
    """Return the cause of the time from `facts.begin_ns` to `facts.end_ns`."""
    shares = _shares(facts)
    outside = shares.pop("outside")
    source, sure, why = attribute_silence(facts)
    shares[source] = shares.get(source, 0) + outside
    cause = max(CAUSES, key=lambda name: shares.get(name, 0))
    share = shares.get(cause, 0)
    if cause == source and outside == share:
        return Verdict(cause, share, sure, why, shares)
    total = max(facts.end_ns - facts.begin_ns, 1)
    return Verdict(cause, share, 2 * share >= total, _words(cause, share, facts), shares)


def _shares(facts: Facts) -> dict[str, int]:
    """Return how many ns each cause on this side explains, and `outside`: awake, and no bytes."""
    begin, end = facts.begin_ns, facts.end_ns
    total = end - begin
    collecting = _clipped(facts.spans, GC, begin, end)
    shares = {"gc": _length(collecting)}
    for cause, kind in (("disk", DISK), ("inference", INFERENCE), ("outside", IDLE)):
        spans = _clipped(facts.spans, kind, begin, end)
        shares[cause] = _length(spans) - _shared(spans, collecting)
    overslept = _clipped(facts.spans, OVERSLEPT, begin, end)
    asleep = _length(overslept) - _shared(overslept, collecting)
    own = max(total - _covered(facts.spans, begin, end), 0)
    # What the hypervisor took explains work that took long; a loop that woke up on time lost nothing by it.
    stolen = min(facts.steal_ns, own + shares["inference"] + shares["disk"])
    starved = min(max(facts.run_delay_ns, asleep, stolen), total)
    # A thread that waits for a processor does so in the middle of something: that time is the machine's, not the activity's.
    hidden = max(starved - asleep, 0)
    shares["decode"] = own
    for cause in sorted(("disk", "inference", "decode", "outside"), key=lambda name: -shares[name]):
        taken = min(shares[cause], hidden)
        shares[cause] -= taken
        hidden -= taken
    stopped = _stopped(facts, shares)
    return shares | {"host": min(starved + stopped, total)}


def _stopped(facts: Facts, shares: dict[str, int]) -> int:
    """Take from `shares`, and return, the time in which the loop should have computed and nothing of this process did: it stood still.

    The loop's own work costs it processor time. A back end may sleep, as one that waits for other hardware does; but then the reader
    still stamps what comes.
    """
    computed = min(shares["decode"], facts.cpu_ns)
    still = shares["decode"] - computed
    shares["decode"] = computed
    for span in facts.spans:
        length = min(span.end_ns, facts.end_ns) - max(span.begin_ns, facts.begin_ns)
        expected = facts.pause_ns > 0 and span.end_ns - span.begin_ns > 4 * facts.pause_ns
        computed = facts.cpu_ns if span.cpu_ns < 0 else span.cpu_ns
        if span.kind != INFERENCE or not expected or 2 * computed > length or length > shares["inference"]:
            continue
        margin = facts.pause_ns
        if not any(span.begin_ns + margin < arrival < span.end_ns - margin for arrival in facts.arrivals_ns):
            shares["inference"] -= length
            still += length
    return still


def attribute_silence(facts: Facts) -> tuple[str, bool, str]:
    """Tell link from device for a silence that began when the exposure ended and lasted until the block came."""
    begin, end = facts.begin_ns, facts.arrival_ns
    delay = max(end - begin, 1)
    long_ns = max(LEG_NS, delay // 2)
    for message in facts.stamped:
        held = message.left_ns - (message.left_ns if message.reached_ns is None else message.reached_ns)
        if held > long_ns and message.left_ns > begin:
            return "device", True, f"the device kept a clock probe for {_ms(held)} before it answered"
    open_again = _latest_round_trip(facts.stamped, begin, end)
    for message in facts.stamped:
        way = message.arrival_ns - message.left_ns
        if begin <= message.left_ns <= end and way > long_ns:
            what = "a clock probe's answer" if message.sent_ns is not None else "a STATUS"
            why = f"{what} left the device on time and was {_ms(way)} on the way, while the host waited for bytes"
            return "link", True, why
        if message.sent_ns is None or message.reached_ns is None:
            continue
        way = message.reached_ns - message.sent_ns
        if (
            open_again is None
            and begin - delay <= message.sent_ns <= end
            and way > max(LEG_NS, (end - message.sent_ns) // 2)
        ):
            why = f"a clock probe needed {_ms(way)} to reach the device, while the host was awake and waited for bytes"
            return "link", True, why
    if open_again is not None:
        trip, overdue = open_again.arrival_ns - (open_again.sent_ns or 0), open_again.arrival_ns - begin
        why = (
            f"a clock probe went to the device and back in {_ms(trip)} while the block was already {_ms(overdue)} late, "
            "so the link was open and the block had not been sent"
        )
        return "device", True, why
    why = f"the host was awake and waited for bytes for {_ms(delay)}; no message that says when it left fell into this time"
    return "link", False, why


def _latest_round_trip(stamped: Iterable[Stamped], begin: int, end: int) -> Stamped | None:
    """A probe that was sent after the block should have come, and was back well before it came."""
    margin = max(LEG_NS, (end - begin) // 8)
    inside = [
        message
        for message in stamped
        if message.sent_ns is not None and message.sent_ns >= begin and message.arrival_ns <= end - margin
    ]
    return max(inside, key=lambda message: message.arrival_ns, default=None)


def _words(cause: str, share: int, facts: Facts) -> str:
    length_ns = facts.end_ns - facts.begin_ns
    total = _ms(length_ns)
    if cause == "host":
        # the system's counters are read around the delay, not at its ends: they hold time beyond it
        waited, stolen, computed = (
            _ms(min(one, length_ns)) for one in (facts.run_delay_ns, facts.steal_ns, facts.cpu_ns)
        )
        return (
            f"the host did not run for {_ms(share)} of {total}: waiting for a processor {waited}, "
            f"stolen from the machine {stolen}, computing at most {computed}, "
            f"{facts.switches} involuntary switches"
        )
    sentence = {
        "gc": "a garbage collection held the interpreter",
        "disk": "writing the recording did not return",
        "inference": "the decision back end computed",
        "decode": "the loop was busy with its own work, reading messages,",
        "link": "the host was awake and waited for bytes",
        "device": "the device had not sent the block",
    }[cause]
    return f"{sentence} for {_ms(share)} of {total}"


def _ms(nanoseconds: int) -> str:
    return f"{nanoseconds / NS_PER_MS:.2f} ms"


# ---- spans ----


def _clipped(spans: Iterable[Span], kind: str, begin: int, end: int) -> list[tuple[int, int]]:
    cut = [(max(span.begin_ns, begin), min(span.end_ns, end)) for span in spans if span.kind == kind]
    return [(first, last) for first, last in cut if last > first]


def _length(pieces: Iterable[tuple[int, int]]) -> int:
    return sum(last - first for first, last in pieces)


def _shared(some: list[tuple[int, int]], others: list[tuple[int, int]]) -> int:
    return sum(max(0, min(a[1], b[1]) - max(a[0], b[0])) for a in some for b in others)


def _covered(spans: Iterable[Span], begin: int, end: int) -> int:
    """How much of the time from `begin` to `end` any of `spans` covers; what overlaps counts once."""
    covered, reached = 0, begin
    for span in sorted(spans, key=lambda span: span.begin_ns):
        first, last = max(span.begin_ns, reached), min(span.end_ns, end)
        if last > first:
            covered += last - first
            reached = last
    return covered


# ---- incidents ----


class LateWork(NamedTuple):
    """One late decision, in host ns: exposure ended, bytes came, decided."""

    number: int
    begin_ns: int
    arrival_ns: int
    end_ns: int
    uncertainty_ns: int


@dataclass(frozen=True, slots=True)
class LateAttribution:
    """The verdict on late decisions in a row, from `first_decision` to `last_decision`; `worst` is the latest of them."""

    first_decision: int
    last_decision: int
    decisions: int
    worst: LateWork
    verdict: Verdict

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        return {
            "kind": "blame",
            "what": "late",
            "first_decision": self.first_decision,
            "last_decision": self.last_decision,
            "decisions": self.decisions,
            "worst_us": (self.worst.end_ns - self.worst.begin_ns) / 1000,
            "begin_ns": self.worst.begin_ns,
            "end_ns": self.worst.end_ns,
            **self.verdict.facts(),
        }


@dataclass(frozen=True, slots=True)
class MissingAttribution:
    """The verdict on exposures that never came."""

    first_exposure: int
    exposures: int
    verdict: Verdict

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        place = {"first_exposure": self.first_exposure, "exposures": self.exposures}
        return {"kind": "blame", "what": "missing", **place, **self.verdict.facts()}


@dataclass(slots=True)
class _Incident:
    first: LateWork
    worst: LateWork
    last: LateWork
    decisions: int = 1


@dataclass(slots=True)
class Incidents:
    """Late decisions in a row are one incident with one cause, judged from its worst decision once it is quiet again."""

    evidence: Evidence
    causes: dict[str, int] = field(default_factory=dict)  # late decisions by cause
    missing: dict[str, int] = field(default_factory=dict)  # lost exposures by cause
    _waiting: deque[_Incident] = field(default_factory=deque)  # for their verdicts, the oldest first
    _known: tuple[_Incident, Facts] | None = None  # to be judged next

    def late(self, work: LateWork) -> None:
        """Take one late decision.

        It belongs to the incident before it if that was not over when its own exposure ended.
        """
        latest = self._waiting[-1] if self._waiting else None
        if (
            latest is None
            or work.begin_ns > latest.last.end_ns
            or work.end_ns - latest.first.end_ns > LONGEST_INCIDENT_NS
        ):
            self._waiting.append(_Incident(work, work, work))
            return
        if work.end_ns - work.begin_ns > latest.worst.end_ns - latest.worst.begin_ns:
            latest.worst = work
        latest.last = work
        latest.decisions += 1

    def verdict(self, now_ns: int, *, final: bool = False) -> LateAttribution | None:
        """Return the verdict on the incident under way, None while there is none or it is not over.

        What is known is gathered in one call and judged in the next: a decision may be due between the two.
        """
        if self._known is not None:
            return self._judged(*self._known)
        if not self._waiting:
            return None
        oldest = self._waiting[0]
        quiet_ns, end_ns = now_ns - oldest.last.end_ns, oldest.worst.end_ns
        if not final and quiet_ns < QUIET_NS and now_ns - oldest.first.end_ns < LONGEST_INCIDENT_NS:
            return None
        if not final and quiet_ns < PATIENCE_NS and not self.evidence.heard_since(end_ns):
            return None
        self._waiting.popleft()
        self._known = oldest, self.evidence.facts(*oldest.worst[1:])
        return self._judged(*self._known) if final else None

    def _judged(self, incident: _Incident, facts: Facts) -> LateAttribution:
        self._known = None
        verdict = judge(facts)
        self.causes[verdict.cause] = self.causes.get(verdict.cause, 0) + incident.decisions
        return LateAttribution(incident.first.number, incident.last.number, incident.decisions, incident.worst, verdict)

    def lost(self, gap: Gap, since_ns: int, now_ns: int, damaged_frames: int) -> MissingAttribution:
        """Return the cause of exposures that never came; `since_ns` is when the latest block before came."""
        verdict = judge_gap(gap, self.evidence.facts(since_ns, now_ns, now_ns, 0), damaged_frames)
        self.missing[verdict.cause] = self.missing.get(verdict.cause, 0) + gap.exposures
        return MissingAttribution(gap.first_exposure, gap.exposures, verdict)


def judge_gap(gap: Gap, facts: Facts, damaged_frames: int) -> Verdict:
    """Return the cause of a gap: what the device dropped was held up by whoever did not take it, the rest got lost on the link."""
    dropped = gap.dropped_by_device
    if 2 * dropped < gap.exposures:
        why = (
            f"{gap.messages} stream messages left the device (their numbers are missing) and never came; "
            f"{damaged_frames} damaged frames were thrown away meanwhile"
        )
        return Verdict("link", 0, True, why, {})
    held_up = judge(facts)
    full = f"the device dropped {dropped} exposures because its buffer was full"
    if held_up.share_ns < NS_PER_MS:
        return Verdict("device", 0, False, f"{full}; nothing on this side held the stream up", held_up.shares_ns)
    return held_up._replace(why=f"{full}; before that, {held_up.why}")
