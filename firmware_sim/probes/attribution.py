"""Late decisions against the gaps of the machine: which of them would have been on time if the cores had been there.

Owns the attribution, a pure function of the recording's rows, its verdicts and what the scheduling probes saw (flow.py runs them). A
decision about an object that left at `end_ns`, made at `decided_ns`, is examined from the time on at which nothing was waiting: when the
last decision on time before it had been made (`ON_TIME_SHARE` of the deadline), or `end_ns` if that was later. A gap counts

    that overlaps this time and had not been over for longer than CATCH_UP times its own length when the object left (what came
    meanwhile is to be caught up by then);
    with the time for which its core was certainly away, clipped to this time; where gaps of both cores overlap, once.

    machine   without these gaps the decision would have been on time: they add up to no less than it was late
    link      the same with the delays of a pair of plain processes beside (link_probe.py), which were on their way between the same cores
    partly    there were gaps, and they add up to less: something else had a part in it, which may be working off what came meanwhile:
              a host that is busy for a share b of the time needs b of a gap for that (`worked_off`)
    ours      there was none
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .link_probe import Delay, LinkLog
from .scheduling_probe import Gap, ProbeLog

NS_PER_US, NS_PER_S = 1_000, 1_000_000_000
MACHINE, LINK, PARTLY, OURS = "machine", "link", "partly", "ours"
WHOSE = (MACHINE, LINK, PARTLY, OURS)
ON_TIME_SHARE = 0.5  # a decision that took less had nothing waiting before it
CATCH_UP = 3  # a host that is busy for three quarters of the time works off a gap in three times its length
STEPS_MS = (0.2, 0.3, 0.5, 1.0, 3.0)


class LateDecision(NamedTuple):
    """One late decision, host ns; nothing was waiting at `since_ns`; `away_ns` adds up the gaps that count, `cores` had them.

    `held_ns` adds up these gaps and the delays of the pair beside, once where they overlap.
    """

    number: int
    since_ns: int
    end_ns: int
    arrival_ns: int
    decided_ns: int
    late_ns: int  # beyond the deadline
    away_ns: int
    held_ns: int
    cores: tuple[int, ...]
    queued: bool  # most of these gaps: the core ran something else

    @property
    def whose(self) -> str:
        """One of WHOSE."""
        if not self.held_ns:
            return OURS
        if self.held_ns < self.late_ns:
            return PARTLY
        return MACHINE if self.away_ns >= self.late_ns else LINK


def attribute(
    timings: NDArray[np.void],
    late_numbers: Iterable[int],
    gaps: Sequence[Gap],
    deadline_ns: int,
    delays: Sequence[Delay] = (),
) -> list[LateDecision]:
    """Return what is known about each of `late_numbers`, by time.

    `timings`: TIMING_DTYPE (n,) in the order in which they were decided; `gaps` of all cores; a number without a row is left out.
    """
    latency = timings["decided_ns"] - timings["device_end_ns"]
    punctual = np.flatnonzero(latency <= ON_TIME_SHARE * deadline_ns)
    away = np.array([(gap.begin_ns, gap.end_ns, gap.length_ns) for gap in gaps], np.int64).reshape(-1, 3)
    under_way = np.array([(one.due_ns, one.came_ns, one.came_ns - one.due_ns) for one in delays], np.int64).reshape(
        -1, 3
    )
    found = []
    for place in np.flatnonzero(np.isin(timings["index"], np.array(list(late_numbers), np.uint64))).tolist():
        row = timings[place]
        end_ns, decided_ns = int(row["device_end_ns"]), int(row["decided_ns"])
        before = int(np.searchsorted(punctual, place)) - 1
        since_ns = min(end_ns, int(timings["decided_ns"][punctual[before]])) if before >= 0 else end_ns
        felt = _felt(away, since_ns, end_ns, decided_ns)
        counting = [gaps[one] for one in felt.tolist()]
        pieces = _pieces(away[felt], since_ns, decided_ns)
        delayed = _pieces(under_way[_felt(under_way, since_ns, end_ns, decided_ns)], since_ns, decided_ns)
        queued = sum(gap.length_ns for gap in counting if gap.queued)
        found.append(
            LateDecision(
                int(row["index"]),
                since_ns,
                end_ns,
                int(row["arrival_ns"]),
                decided_ns,
                decided_ns - end_ns - deadline_ns,
                united(pieces),
                united(pieces + delayed),
                tuple(sorted({gap.core for gap in counting})),
                2 * queued > sum(gap.length_ns for gap in counting),
            )
        )
    return found


def _felt(table: NDArray[np.int64], since_ns: int, end_ns: int, decided_ns: int) -> NDArray[np.intp]:
    """Return which rows (begin, end, length) a decision could feel."""
    overlapping = (table[:, 0] < decided_ns) & (table[:, 1] > since_ns)
    return np.flatnonzero(overlapping & (end_ns - table[:, 1] <= CATCH_UP * table[:, 2]))


def _pieces(table: NDArray[np.int64], since_ns: int, decided_ns: int) -> list[tuple[int, int]]:
    return [(max(begin, since_ns), min(end, decided_ns)) for begin, end, _ in table.tolist()]


def united(pieces: Iterable[tuple[int, int]]) -> int:
    """Return the length of the union of `pieces`."""
    total, reached = 0, None
    for begin, end in sorted(pieces):
        first = begin if reached is None else max(begin, reached)
        if end > first:
            total += end - first
            reached = end
    return total


def worked_off(late: LateDecision, busy_share: float) -> bool:
    """Whether the gaps, and working off what came in them, explain a decision that the gaps alone explain in part."""
    return late.whose == PARTLY and late.held_ns * (1 + min(busy_share, 1.0)) >= late.late_ns


def gap_figures(log: ProbeLog, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """Return how often and for how long the core was away between the two times."""
    seconds = (end_ns - begin_ns) / NS_PER_S
    gaps = [gap for gap in log.gaps if gap.end_ns > begin_ns and gap.begin_ns < end_ns]
    lengths_ms = [gap.length_ns / 1e6 for gap in gaps]
    return {
        "core": log.core,
        "per_s_above_ms": {str(step): sum(length > step for length in lengths_ms) / seconds for step in STEPS_MS},
        "largest_ms": max(lengths_ms, default=0.0),
        "away_ms": sum(lengths_ms),
        "queued_ms": sum(gap.length_ns for gap in gaps if gap.queued) / 1e6,
        "canary_share_of_core": log.own_share,
        "canary_wakes_per_s": log.wakes / seconds,
    }


def link_figures(log: LinkLog, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """Return what the pair of plain processes saw between the two times."""
    lengths_ms = [
        (one.came_ns - one.sent_ns) / 1e6 for one in log.delays if begin_ns < one.came_ns and one.sent_ns < end_ns
    ]
    seconds = (end_ns - begin_ns) / NS_PER_S
    return {
        "messages": log.messages,
        "usual_us": log.usual_ns / NS_PER_US,
        "per_s_above_ms": {str(step): sum(length > step for length in lengths_ms) / seconds for step in STEPS_MS},
        "largest_ms": max(lengths_ms, default=0.0),
    }


def verdict_of(number: int, verdicts: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the run's own verdict on a decision: the last one whose incident holds it; of the cause "none" if none does."""
    holding = [verdict for verdict in verdicts if verdict["first_decision"] <= number <= verdict["last_decision"]]
    return holding[-1] if holding else {"cause": "none", "sure": False, "why": "", "shares_us": {}}


def late_table(found: Iterable[LateDecision], verdicts: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Return {cause that the run named: {whose: how many}}."""
    table: dict[str, Counter[str]] = {}
    for late in found:
        table.setdefault(str(verdict_of(late.number, verdicts)["cause"]), Counter())[late.whose] += 1
    return {cause: {whose: counts[whose] for whose in WHOSE} for cause, counts in table.items()}


def late_entry(late: LateDecision, verdict: Mapping[str, Any]) -> dict[str, Any]:
    """Return one late decision for people and files, in microseconds."""
    return {
        "decision": late.number,
        "whose": late.whose,
        "cause": verdict["cause"],
        "latency_us": (late.decided_ns - late.end_ns) / NS_PER_US,
        "until_bytes_us": (late.arrival_ns - late.end_ns) / NS_PER_US,
        "until_decided_us": (late.decided_ns - late.arrival_ns) / NS_PER_US,
        "late_us": late.late_ns / NS_PER_US,
        "away_us": late.away_ns / NS_PER_US,
        "held_us": late.held_ns / NS_PER_US,
        "cores": list(late.cores),
        "queued": late.queued,
        "looked_back_us": (late.end_ns - late.since_ns) / NS_PER_US,
        "end_ns": late.end_ns,
        "sure": verdict["sure"],
        "why": verdict["why"],
        "shares_us": verdict["shares_us"],
    }
