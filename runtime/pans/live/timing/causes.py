"""Why work was late or missing: evidence is collected while a run lasts, and one cause is named, with the reason in plain words.

Every nanosecond between the end of the exposure and the decision is given to the cause that was seen there:

    gc          a garbage collection held the interpreter
    disk        a write of the recording did not return
    inference   the decision back end computed
    host        the loop or its reader waited for a processor, slept beyond its timer, or stood still (starved, stolen by the hypervisor,
                stopped)
    link        the loop was awake and waiting for bytes, and nothing says that the device was late
    device      ... and a message that says when it left shows that the link was open, or that the device held it back
    decode      the loop's own work, none of the above (reading messages, recording)

The largest share is the cause. What separates link from device is in docs/explanation/timing.md: a click block says when it was exposed,
never when it was sent, so that only a PONG or a STATUS in the silence shows which it was; without one the verdict is `link`, not sure.
Memory is bounded. In virtual time the counters of the machine mean nothing and are not read.
"""

from __future__ import annotations

import gc
import os
import threading
import time
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from pans.decide.kernel import OVERSLEPT_NS
from pans.decide.plan import Plan
from pans.protocol.tracker import Gap

NS_PER_US, NS_PER_MS, NS_PER_S = 1_000, 1_000_000, 1_000_000_000
CAUSES = ("link", "device", "host", "gc", "disk", "inference", "decode")
GC, DISK, INFERENCE, IDLE, OVERSLEPT = "gc", "disk", "inference", "idle", "overslept"
FLOOR_NS = 100 * NS_PER_US  # a shorter span alone makes nothing late, and is not kept
LEG_NS = 500_000  # a way that takes longer than this and half the delay is no ordinary one
QUIET_NS = 50 * NS_PER_MS  # without late work: the incident is over, and the probes sent within it are back
PATIENCE_NS = 4 * QUIET_NS  # for the counters' thread to read after the incident; then the loop reads for itself
LONGEST_INCIDENT_NS = NS_PER_S  # a run that is late all the time gets a verdict per second
READ_EVERY_S, STALE_NS = 0.02, 250 * NS_PER_MS  # of the counters; when their thread counts as starved
MAX_SPANS, MAX_STAMPED, MAX_ARRIVALS, MAX_SAMPLES = 1024, 64, 512, 160
READ_BYTES, JOIN_S = 4096, 2.0


class Span(NamedTuple):
    """What the loop did from `begin_ns` to `end_ns`: one of GC, DISK, INFERENCE, IDLE (awake, waiting for bytes), OVERSLEPT.

    `cpu_ns` is how long its thread had computed since it last waited, an upper bound for the span; -1 where it is not known.
    """

    kind: str
    begin_ns: int
    end_ns: int
    cpu_ns: int = -1


class Stamped(NamedTuple):
    """A message that says when it left the device, in host time. A PONG also says when its PING was sent and came there."""

    sent_ns: int | None
    reached_ns: int | None
    left_ns: int
    arrival_ns: int


class Facts(NamedTuple):
    """What is known about late work: its exposure ended at `begin_ns`, its bytes came at `arrival_ns`, it was decided at `end_ns`."""

    begin_ns: int
    arrival_ns: int
    end_ns: int
    spans: tuple[Span, ...]
    arrivals_ns: tuple[int, ...]  # when the reader stamped bytes
    pause_ns: int  # the longest time between two blocks when everything is on time
    cpu_ns: int  # the loop's thread computed for so long, at most
    run_delay_ns: int  # it, or its reader while it did not compute, waited for a processor
    steal_ns: int
    stamped: tuple[Stamped, ...]


class Verdict(NamedTuple):
    """The cause, how much of the delay it explains, whether the evidence is conclusive, and why in plain words."""

    cause: str
    share_ns: int
    sure: bool
    why: str
    shares_ns: dict[str, int]


# ---- judging ---------------------------------------------------------------------------------------------------------


def judge(facts: Facts) -> Verdict:
    """Return the cause of the time from `facts.begin_ns` to `facts.end_ns`."""
    shares = _shares(facts)
    source, sure, why = attribute_silence(facts)
    shares[source] = shares.pop("outside")
    cause = max((name for name in CAUSES if name in shares), key=lambda name: shares[name])
    share = shares[cause]
    if cause == source:
        return Verdict(cause, share, sure, why, shares)
    return Verdict(cause, share, 2 * share >= facts.end_ns - facts.begin_ns, _words(cause, share, facts), shares)


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


def _shares(facts: Facts) -> dict[str, int]:
    """Return how many ns each cause on this side explains, and `outside`: awake, and no bytes."""
    begin, end = facts.begin_ns, facts.end_ns
    pieces = [(one.kind, max(one.begin_ns, begin), min(one.end_ns, end)) for one in facts.spans]
    pieces = [piece for piece in pieces if piece[1] < piece[2]]
    collecting = [piece[1:] for piece in pieces if piece[0] == GC]

    def without_gc(kind: str) -> int:
        spans = [piece[1:] for piece in pieces if piece[0] == kind]
        shared = (max(0, min(a[1], b[1]) - max(a[0], b[0])) for a in spans for b in collecting)
        return sum(last - first for first, last in spans) - sum(shared)

    covered, reached = 0, begin  # what overlaps counts once
    for _, first, last in sorted(pieces, key=lambda piece: piece[1]):
        covered += max(last - max(first, reached), 0)
        reached = max(reached, last)
    shares = {"disk": without_gc(DISK), "inference": without_gc(INFERENCE), "decode": end - begin - covered}
    shares["outside"], asleep = without_gc(IDLE), without_gc(OVERSLEPT)
    # What the hypervisor took explains work that took long; a loop that woke up on time lost nothing by it.
    stolen = min(facts.steal_ns, shares["decode"] + shares["inference"] + shares["disk"])
    starved = min(max(facts.run_delay_ns, asleep, stolen), end - begin)
    # A thread that waits for a processor does so in the middle of something: that time is the machine's, not the activity's.
    hidden = max(starved - asleep, 0)
    for cause in sorted(shares, key=lambda name: -shares[name]):
        taken = min(shares[cause], hidden)
        shares[cause] -= taken
        hidden -= taken
    host = min(starved + _stopped(facts, shares), end - begin)
    return shares | {"gc": sum(last - first for first, last in collecting), "host": host}


def _stopped(facts: Facts, shares: dict[str, int]) -> int:
    """Take from `shares`, and return, the time in which the loop should have computed and nothing of this process did.

    The loop's own work costs it processor time. A back end may sleep, as one that waits for other hardware does; but then the reader
    still stamps what comes.
    """
    still = max(shares["decode"] - facts.cpu_ns, 0)
    shares["decode"] -= still
    margin = facts.pause_ns
    for span in facts.spans:
        length = min(span.end_ns, facts.end_ns) - max(span.begin_ns, facts.begin_ns)
        expected = 0 < 4 * margin < span.end_ns - span.begin_ns
        computed = facts.cpu_ns if span.cpu_ns < 0 else span.cpu_ns
        if span.kind != INFERENCE or not expected or 2 * computed > length or length > shares["inference"]:
            continue
        if not any(span.begin_ns + margin < arrival < span.end_ns - margin for arrival in facts.arrivals_ns):
            shares["inference"] -= length
            still += length
    return still


def attribute_silence(facts: Facts) -> tuple[str, bool, str]:
    """Tell link from device for a silence that began when the exposure ended and lasted until the block came."""
    begin, end = facts.begin_ns, facts.arrival_ns
    delay = max(end - begin, 1)
    long_ns = max(LEG_NS, delay // 2)
    probes = [(one.sent_ns, one.reached_ns, one) for one in facts.stamped]
    for _, reached_ns, one in probes:
        held = 0 if reached_ns is None else one.left_ns - reached_ns
        if held > long_ns and one.left_ns > begin:
            return "device", True, f"the device kept a clock probe for {_ms(held)} before it answered"
    # a probe that was sent after the block should have come, and was back well before it came
    back_ns = end - max(LEG_NS, (end - begin) // 8)
    trips = [(one.arrival_ns, sent) for sent, _, one in probes if sent and sent >= begin and one.arrival_ns <= back_ns]
    for sent_ns, reached_ns, one in probes:
        way = one.arrival_ns - one.left_ns
        if begin <= one.left_ns <= end and way > long_ns:
            what = "a clock probe's answer" if sent_ns is not None else "a STATUS"
            why = f"{what} left the device on time and was {_ms(way)} on the way, while the host waited for bytes"
            return "link", True, why
        if sent_ns is None or reached_ns is None or trips:
            continue
        way = reached_ns - sent_ns
        if begin - delay <= sent_ns <= end and way > max(LEG_NS, (end - sent_ns) // 2):
            why = f"a clock probe needed {_ms(way)} to reach the device, while the host was awake and waited for bytes"
            return "link", True, why
    if trips:
        arrival_ns, sent_ns = max(trips)
        why = (
            f"a clock probe went to the device and back in {_ms(arrival_ns - sent_ns)} while the block was already "
            f"{_ms(arrival_ns - begin)} late, so the link was open and the block had not been sent"
        )
        return "device", True, why
    why = f"the host was awake and waited for bytes for {_ms(delay)}; no message that says when it left fell into this time"
    return "link", False, why


SENTENCES = {
    "gc": "a garbage collection held the interpreter",
    "disk": "writing the recording did not return",
    "inference": "the decision back end computed",
    "decode": "the loop was busy with its own work, reading messages,",
    "host": "the host did not run",
}


def _words(cause: str, share: int, facts: Facts) -> str:
    total_ns = facts.end_ns - facts.begin_ns
    why = f"{SENTENCES[cause]} for {_ms(share)} of {_ms(total_ns)}"
    if cause != "host":
        return why
    # the system's counters are read around the delay, not at its ends: they hold time beyond it
    waited, stolen, computed = (_ms(min(one, total_ns)) for one in (facts.run_delay_ns, facts.steal_ns, facts.cpu_ns))
    return f"{why}: waiting for a processor {waited}, stolen from the machine {stolen}, computing at most {computed}"


def _ms(nanoseconds: int) -> str:
    return f"{nanoseconds / NS_PER_MS:.2f} ms"


# ---- collecting ------------------------------------------------------------------------------------------------------


class Evidence:
    """Collects while a run lasts, from `watch` to `close`. `now_ns` is the link's clock."""

    def __init__(
        self, now_ns: Callable[[], int], deadline_ns: int, *, pause_ns: int = 0, virtual: bool = False
    ) -> None:
        self.floor_ns = max(FLOOR_NS, deadline_ns // 16)
        self._now, self._virtual, self._pause_ns = now_ns, virtual, pause_ns
        self._arrivals: deque[int] = deque(maxlen=MAX_ARRIVALS)
        self._spans: deque[Span] = deque(maxlen=MAX_SPANS)
        self._stamped: deque[Stamped] = deque(maxlen=MAX_STAMPED)
        self._collecting_ns = self._cpu_mark_ns = 0
        self._apart = False  # whether decisions are made in another thread than the accounting
        self._accounting: deque[Span] = deque(
            maxlen=MAX_STAMPED
        )  # then: what the accounting did, which delays no decision
        self._counters = Counters(now_ns, [])

    def watch(self, reader: int | None = None, deciding: int | None = None) -> None:
        """From here on watch collections and the thread that decides, by native ids: the calling one, with the link's reader, or another.

        A new link has a new reader.
        """
        if self._virtual:
            return
        if self._on_gc not in gc.callbacks:
            gc.callbacks.append(self._on_gc)
        self._counters.close()
        self._apart = deciding is not None
        own = [threading.get_native_id(), *([reader] if reader else [])] if deciding is None else [deciding]
        self._counters = Counters(self._now, own)

    def close(self) -> None:
        """End: leave the collector as it was found; idempotent."""
        with suppress(ValueError):
            gc.callbacks.remove(self._on_gc)
        self._counters.close()

    def parked(self, begin_ns: int, end_ns: int) -> None:
        """Note that the thread that decides waited for the accounting: what that did counts."""
        for one in self._accounting:
            if one.end_ns > begin_ns and one.begin_ns < end_ns:
                self._spans.append(Span(one.kind, max(one.begin_ns, begin_ns), min(one.end_ns, end_ns)))

    def worked(self, kind: str, begin_ns: int, end_ns: int) -> None:
        """Note that the loop was busy with `kind`."""
        if end_ns - begin_ns >= self.floor_ns and self._apart:
            kept = self._spans if kind == INFERENCE else self._accounting
            kept.append(Span(kind, begin_ns, end_ns))
        elif end_ns - begin_ns >= self.floor_ns:
            cpu_ns = -1 if self._virtual else time.thread_time_ns() - self._cpu_mark_ns
            self._spans.append(Span(kind, begin_ns, end_ns, cpu_ns))

    def waited(self, begin_ns: int, asked_ns: int, end_ns: int) -> None:
        """Note a wait for bytes until `asked_ns` at most; one that lasts longer by OVERSLEPT_NS or more is the machine's delay."""
        if not self._virtual:
            self._cpu_mark_ns = time.thread_time_ns()
        last = self._spans[-1] if self._spans else None
        if last is not None and last.kind == IDLE and begin_ns - last.end_ns < self.floor_ns:
            self._spans.pop()  # nothing of note was done in between
            begin_ns = last.begin_ns
        self._spans.append(Span(IDLE, begin_ns, min(end_ns, asked_ns)))
        if end_ns - asked_ns >= OVERSLEPT_NS:
            self._spans.append(Span(OVERSLEPT, asked_ns, end_ns))

    def arrived(self, *arrivals_ns: int) -> None:
        """Note when bytes were stamped by whoever read them."""
        self._arrivals.extend(arrivals_ns)

    def stamped(self, message: Stamped) -> None:
        """Note a message that says when it left the device."""
        self._stamped.append(message)

    def read_since(self, end_ns: int) -> bool:
        """Return whether the system's counters were read after `end_ns`; in virtual time they do not count."""
        return self._virtual or self._counters.read_ns >= end_ns

    def read_if_stale(self, now_ns: int) -> None:
        """Read the counters here and now if nobody has done so for STALE_NS, as a loop that is never away makes it happen."""
        if not self.read_since(now_ns - STALE_NS + 1):
            self._counters.read()

    def facts(self, begin_ns: int, arrival_ns: int, end_ns: int) -> Facts:
        """Return what is known about the time from `begin_ns` to `end_ns`, both host times."""
        if not self.read_since(end_ns):
            self._counters.read()
        steal_ns, cpu_ns, own, *readers = self._counters.grown(begin_ns, end_ns)
        spans, arrivals_ns = list(self._spans), list(self._arrivals)  # both in the order of their ends
        first_span = bisect_right(spans, begin_ns, key=attrgetter("end_ns"))
        return Facts(
            begin_ns,
            arrival_ns,
            end_ns,
            tuple(span for span in spans[first_span:] if span.begin_ns < end_ns),
            tuple(arrivals_ns[bisect_right(arrivals_ns, begin_ns) : bisect_left(arrivals_ns, end_ns)]),
            self._pause_ns,
            cpu_ns,
            max([own, *(delay - cpu_ns for delay in readers)]),  # a reader waits for the loop while that computes
            steal_ns,
            tuple(
                one
                for one in self._stamped
                if one.arrival_ns >= begin_ns and (one.left_ns if one.sent_ns is None else one.sent_ns) <= end_ns
            ),
        )

    def _on_gc(self, phase: str, info: dict[str, Any]) -> None:
        if phase == "start":
            self._collecting_ns = self._now()
        elif self._collecting_ns:
            self.worked(GC, self._collecting_ns, self._now())
            self._collecting_ns = 0


class Counters:
    """Samples of the counters of some threads, the loop's first; made by a thread of their own, or by `read` in the caller's.

    The thread runs one step below the loop's priority, where that is a real-time one: the loop never waits for it. Not
    further down: whoever holds the interpreter must not wait for the rest of the machine, since the loop may be waiting for it.
    Where the system has no such files, there is no thread, and a sample holds the caller's own computing time and zeros.
    """

    def __init__(self, now_ns: Callable[[], int], threads: Sequence[int]) -> None:
        self.read_ns = 0  # when the latest reading began
        self._now = now_ns
        # when a reading began and ended; steal of the whole machine, computing time of the loop, how long each thread waited to run, ns
        self._samples: deque[tuple[int, int, list[int]]] = deque(maxlen=MAX_SAMPLES)
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._files: list[int] = []
        tasks = [f"/proc/self/task/{thread}/schedstat" for thread in threads]
        with suppress(OSError):
            for path in ["/proc/stat", *tasks] if tasks else []:
                self._files.append(os.open(path, os.O_RDONLY))
        self.read()
        self._thread = threading.Thread(target=self._watch, name="pans-counters", daemon=True)
        if len(self._files) > 1:
            self._thread.start()

    def read(self) -> None:
        """Read in the calling thread: some ten to a hundred microseconds; nothing if the other thread is at it."""
        if self._stop.is_set() or not self._lock.acquire(blocking=False):
            return
        try:
            began_ns = self._now()
            stat, *tasks = [_numbers(file) for file in self._files] or [[]]
            found = [0, time.thread_time_ns(), 0]
            if tasks:
                steal_ns = stat[7] * (NS_PER_S // os.sysconf("SC_CLK_TCK"))
                found = [steal_ns, tasks[0][0], *(task[1] for task in tasks)]
            self._samples.append((began_ns, self._now(), found))
            self.read_ns = began_ns
        finally:
            self._lock.release()

    def grown(self, begin_ns: int, end_ns: int) -> list[int]:
        """Return by how much the counters grew from the latest reading whole at `begin_ns` to the first begun at `end_ns`.

        [steal, computing time, waiting time of each thread], ns; of the nearest readings where there are none such.
        """
        samples = list(self._samples)
        first = next((one for one in reversed(samples) if one[1] <= begin_ns), samples[0])
        last = next((one for one in samples if one[0] >= end_ns), samples[-1])
        return [after - before for before, after in zip(first[2], last[2])]

    def close(self) -> None:
        """End the thread and close the files; idempotent."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(JOIN_S)
        with self._lock:
            while self._files:
                os.close(self._files.pop())

    def _watch(self) -> None:
        if hasattr(os, "sched_getparam") and (priority := os.sched_getparam(0).sched_priority) > 1:
            with suppress(OSError):  # a reading in time is worth little against a run
                os.sched_setscheduler(0, os.sched_getscheduler(0), os.sched_param(priority - 1))
        while not self._stop.wait(READ_EVERY_S):
            self.read()


def _numbers(file: int) -> list[int]:
    """The first eight numbers of a file's first line, which the kernel makes afresh for each read from its start; else zeros."""
    try:
        line = os.pread(file, READ_BYTES, 0).partition(b"\n")[0]
    except OSError:  # the thread has ended
        line = b""
    return [*(int(word) for word in line.split() if word.isdigit()), *[0] * 8][:8]


# ---- incidents -------------------------------------------------------------------------------------------------------


class LateWork(NamedTuple):
    """One late decision, in host ns: exposure ended, bytes came, decided."""

    number: int
    begin_ns: int
    arrival_ns: int
    end_ns: int


class Attribution(NamedTuple):
    """What was late or missing, as the fields of an event, and the verdict on it."""

    what: dict[str, Any]
    verdict: Verdict

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording; shares in whole microseconds, those below one left out."""
        cause, _, sure, why, shares_ns = self.verdict
        shares = {name: share // 1000 for name, share in shares_ns.items() if share >= 1000}
        return {"kind": "blame", **self.what, "cause": cause, "sure": sure, "why": why, "shares_us": shares}


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
    causes: Counter[str] = field(default_factory=Counter)  # late decisions by cause
    missing: Counter[str] = field(default_factory=Counter)  # lost exposures by cause
    _waiting: deque[_Incident] = field(default_factory=deque)  # for their verdicts, the oldest first
    _known: tuple[_Incident, Facts] | None = None  # to be judged next

    def late(self, work: LateWork) -> None:
        """Add one late decision; it belongs to the incident before it if that was not over when its own exposure ended."""
        latest = self._waiting[-1] if self._waiting else None
        longest = latest is not None and work.end_ns - latest.first.end_ns > LONGEST_INCIDENT_NS
        if latest is None or longest or work.begin_ns > latest.last.end_ns:
            self._waiting.append(_Incident(work, work, work))
            return
        if work.end_ns - work.begin_ns > latest.worst.end_ns - latest.worst.begin_ns:
            latest.worst = work
        latest.last = work
        latest.decisions += 1

    def verdict(self, now_ns: int, *, final: bool = False) -> Attribution | None:
        """Return the verdict on the incident under way, None while there is none or it is not over.

        What is known is gathered in one call and judged in the next: a decision may be due between the two.
        """
        if self._known is not None:
            return self._judged(*self._known)
        if not self._waiting:
            return None
        oldest = self._waiting[0]
        quiet_ns = now_ns - oldest.last.end_ns
        if not final:
            if quiet_ns < QUIET_NS and now_ns - oldest.first.end_ns < LONGEST_INCIDENT_NS:
                return None
            if quiet_ns < PATIENCE_NS and not self.evidence.read_since(oldest.worst.end_ns):
                return None
        self._waiting.popleft()
        self._known = oldest, self.evidence.facts(*oldest.worst[1:])
        return self._judged(*self._known) if final else None

    def _judged(self, incident: _Incident, facts: Facts) -> Attribution:
        self._known = None
        verdict = judge(facts)
        self.causes[verdict.cause] += incident.decisions
        what = {
            "what": "late",
            "first_decision": incident.first.number,
            "last_decision": incident.last.number,
            "decisions": incident.decisions,
            "worst_us": (facts.end_ns - facts.begin_ns) / 1000,
            "begin_ns": facts.begin_ns,
            "end_ns": facts.end_ns,
        }
        return Attribution(what, verdict)

    def lost(self, gap: Gap, since_ns: int, now_ns: int, damaged_frames: int) -> Attribution:
        """Return the cause of exposures that never came; `since_ns` is when the latest block before came."""
        verdict = judge_gap(gap, self.evidence.facts(since_ns, now_ns, now_ns), damaged_frames)
        self.missing[verdict.cause] += gap.exposures
        what = {"what": "missing", "first_exposure": gap.first_exposure, "exposures": gap.exposures}
        return Attribution(what, verdict)


def longest_pause_ns(plan: Plan) -> int:
    """Return the longest time between the ends of two blocks that follow each other, when everything is on time."""
    offsets = plan.slot_offset_ticks.astype(np.int64)
    breaks = np.append(np.diff(offsets) != plan.slot_period_ticks, True)  # a block ends there at the latest
    ends, length = [], 0
    for offset, is_end in zip(offsets.tolist(), breaks.tolist()):
        length += 1
        if is_end or length == plan.block_exposures:
            ends.append(offset)
            length = 0
    pauses = np.diff([*ends, ends[0] + plan.cycle_ticks])
    return round(int(pauses.max()) * plan.tick_us * NS_PER_US)
