"""The page of a run: decisions, times, events and messages are read block by block, while sums of bounded size add up.

Messages are read for the rates; passages of objects in flow come from a replay. Verdict, faults and figures are those that the run
recorded; a cut recording has none, and says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import wilson_interval
from pans.bundle.automaton import Automaton
from pans.bundle.backends import NO_LABEL
from pans.bundle.sensor import Bundle
from pans.decide import DecisionFlag, is_judged
from pans.decide.flow import abort_reason
from pans.live.timing import LatencyHistogram, TimingLedger, upper_edge
from pans.record.reading import Recording, earlier_parts, first_decision, iter_exposures, recorded_plan, together
from pans.report.summary.words import dark_words, rows_of, stage_rows

from .bundle import first_states, optics
from .charts import Bars, Curve, seconds
from .page import render, sentence_of, words
from .rates import BINS, TOLD_APART, Rates, Stretches

CONFUSION_MAX = 40  # classes
ACCURACY_BINS, OBJECTS_PER_BIN = 60, 20
CLICKS_PER_BIN = 50  # decisions
SHOWN, OF_A_KIND = 200, 30  # events
LEAST_US = 1.0  # of the axis of latencies
NO_TIME_US = 0.05  # p99 of the host's own time
CONFIDENCE_BINS = 10
_NOT_WALKED = int(DecisionFlag.GAP | DecisionFlag.WRONG_PATTERN | DecisionFlag.INCOMPLETE)
NEVER_NS = 1 << 62
_OF_A_STATE = ("since_dark_exposure", "channels", "after_clicks")  # what tells which state is over
PHASES = ("before it began", "until it was noticed", "from then on", "after it was over")
_MARKS = ("device_end_ns", "arrival_ns", "arrival_ns", "decided_ns", "recorded_ns")  # of the ledger's stages
_CURVES = {"link": "on the link", "decide": "in the host, to the decision", "record": "to the recorder"}
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Rows = NDArray[np.void]


class Decisions:
    """Sums over decisions: truth against decision, accuracy over time, outcomes and pulses of passing objects."""

    def __init__(self, config: Mapping[str, Any], n: int, classes: Sequence[str] = (), first: int = 0) -> None:
        self.n, self._first = n, first  # decisions, and the number of the first one
        self._first_tick: int | None = None
        self._tick_hz = float(config["tick_hz"])
        self.judged = self.right = 0
        self._n_classes = len(classes) or NO_LABEL
        shown = len(classes) if len(classes) <= CONFUSION_MAX else 0
        self.confusion = np.zeros((shown, shown), np.int64)  # truth in rows, of those that have a label
        self.over = Stretches(objects=(TOLD_APART,))
        gated = config["flow"]["settings"].get("gate_classes", ()) if "flow" in config else ()
        self._passing = "flow" in config
        self._gated = [list(classes).index(name) for name in gated if name in classes]

    def add(self, name: str, numbers: NDArray[Any] | list[int], weights: Any = None) -> None:
        """Add decisions by number to the sum `name`; those that the recording does not have are left out."""
        found = np.asarray(numbers, np.int64) - self._first
        if ((found >= 0) & (found < self.n)).all():
            self.over.add(name, found, weights)

    def take(self, rows: Rows) -> None:
        """Take the next rows, DECISION_DTYPE (n,)."""
        if self._first_tick is None:
            self._first_tick = int(rows["tick"][0])
        numbers, judged = rows["index"], is_judged(rows, self._n_classes)
        right = judged & (rows["label"] == rows["truth"])
        self.judged, self.right = self.judged + int(judged.sum()), self.right + int(right.sum())
        self.add("decisions", numbers)
        ticks = np.maximum(rows["tick"].astype(np.float64) - self._first_tick, 0.0)
        self.add("seconds", numbers, ticks / self._tick_hz)
        whole, clicks = (rows["flags"] & _NOT_WALKED) == 0, rows["clicks"].astype(np.float64)
        for name, weights in (("measured", None), ("clicks", clicks[whole]), ("squares", clicks[whole] ** 2)):
            self.add(name, numbers[whole], weights)
        for name, which in (("judged", judged), ("right", right)):
            self.add(name, numbers[which])
        self.over.tell_apart("objects", numbers[judged].astype(np.int64) - self._first, rows["object"][judged])
        n = len(self.confusion)
        fits = judged & (rows["truth"] < n) & (rows["label"] < n)
        np.add.at(self.confusion, (rows["truth"][fits], rows["label"][fits]), 1)
        if self._passing:
            for flag in np.unique(rows["flags"]).tolist():
                self.add(f"outcome {abort_reason(flag) or 'with a label'}", numbers[rows["flags"] == flag])
            self.add("asked", numbers[np.isin(rows["label"], self._gated)])

    def accuracy(self) -> dict[str, Any] | None:
        """Return accuracy over time with its interval, and how many objects a stretch has; None where it is not known, or too short."""
        objects = np.count_nonzero(self.over.sums["objects"])
        over = self.over.merged(int(np.clip(objects // OBJECTS_PER_BIN, 1, ACCURACY_BINS)))
        some = over.sums.get("judged", np.zeros(1)) > 0
        if some.sum() < 2:
            return None
        share = over.sums["right"][some] / over.sums["judged"][some]
        counts = np.count_nonzero(over.sums["objects"][some], axis=1).tolist()
        low, high = np.array([wilson_interval(round(p * n), n) for p, n in zip(share.tolist(), counts)]).T
        band = {"low": np.minimum(low, share), "high": np.maximum(high, share)}
        sums = {"mean": self.right / self.judged, "objects": (min(counts), max(counts))}
        return {"seconds": self._seconds(over)[some], "share": share, **band, **sums}

    def clicks(self) -> dict[str, Any] | None:
        """Return clicks per measured decision over time, with a 95 % interval by their spread; None where the run is too short."""
        measured = self.over.sums.get("measured", np.zeros(1))
        over = self.over.merged(int(np.clip(measured.sum() // CLICKS_PER_BIN, 1, ACCURACY_BINS)))
        some = over.sums.get("measured", np.zeros(1)) > 1
        if some.sum() < 2:
            return None
        n, total, squares = (over.sums[name][some] for name in ("measured", "clicks", "squares"))
        mean = total / n
        error = 1.96 * np.sqrt(np.maximum(squares - n * mean**2, 0.0) / (n - 1) / n)
        when = self._seconds(over)[some]
        return {
            "seconds": when,
            "mean": mean,
            "low": mean - error,
            "high": mean + error,
            "whole": total.sum() / n.sum(),
        }

    def stacked(self, prefix: str) -> dict[str, Any] | None:
        """Return the sums whose names begin with `prefix` over time, one upon the other, the largest first; None without any."""
        over = self.over.merged(ACCURACY_BINS)
        rows = [(key.removeprefix(prefix), n) for key, n in over.sums.items() if key.startswith(prefix) and n.any()]
        if not rows:
            return None
        edges = np.append(np.minimum.accumulate(self._seconds(over)[::-1])[::-1], 0.0)
        edges[-1] = 2 * edges[-2] - edges[-3] if len(edges) > 2 else edges[-2] + 1.0
        rows.sort(key=lambda row: -float(row[1].sum()))
        bars = [Bars(edges, n, f"{name} ({int(n.sum())})", kind) for (name, n), kind in zip(rows, "abcd")]
        return {
            "bars": bars,
            "edges": edges,
            "top": float(np.sum([n for _, n in rows], axis=0).max()),
            "width": over.width,
        }

    def when(self, number: int) -> float | None:
        """Return when a decision was made, seconds since the first one, about; None where the recording does not have it."""
        some, at = np.flatnonzero(self.over.sums["decisions"]), number - self._first
        if not 0 <= at < self.n or not len(some):
            return None
        return float(np.interp(at, (some + 0.5) * self.over.width - 0.5, self._seconds(self.over)[some]))

    def _seconds(self, over: Stretches) -> F64:
        """The mean time of each stretch."""
        return over.sums["seconds"] / np.maximum(over.sums["decisions"], 1)

    def pulses(self) -> dict[str, int]:
        """Return how many pulses were asked for, made, refused and expired; one without a refusal counts as made."""
        sums, none = self.over.sums, np.zeros(BINS)
        asked, refused, expired = (sums.get(name, none) for name in ("asked", "pulses refused", "pulses expired"))
        sums["pulses done"] = np.maximum(asked - refused - expired, 0.0)
        found = {"asked": asked, "done": sums["pulses done"], "refused": refused, "expired": expired}
        return {name: int(one.sum()) for name, one in found.items()}


class Events:
    """What was noted: how many events of each kind, the first of them, and who is to blame for what was late or lost."""

    def __init__(self, decisions: Decisions) -> None:
        self._decisions = decisions
        self.kinds: Counter[str] = Counter()
        self.shown: list[Mapping[str, Any]] = []
        # states of the detector that began; `over`: the dark exposure at which one ended
        self.dark: list[dict[str, Any]] = []
        self.late, self.lost = Counter[str](), Counter[str]()
        self.first_case: dict[str, str] = {}

    def take(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Take the next events."""
        for event in events:
            kind = str(event["kind"])
            self.kinds[kind] += 1
            if len(self.shown) < SHOWN and self.kinds[kind] <= OF_A_KIND and kind != "session":
                self.shown.append(event)
                if kind == "dark_state" and "since_dark_exposure" in event:
                    self._dark_state(event)
            if kind == "blame":
                cause = str(event.get("cause", "?"))
                self.first_case.setdefault(cause, sentence_of(event))
                if event.get("what") == "late":
                    n = int(event.get("decisions", 1))
                    self.late[cause] += n
                    self._decisions.add(f"late {cause}", [int(event.get("first_decision", -1))], [n])
                else:
                    self.lost[cause] += int(event.get("exposures", 1))
            elif kind in ("gate_refused", "gate_expired") and "decision" in event:
                self._decisions.add(kind.replace("gate_", "pulses "), [int(event["decision"])])

    def _dark_state(self, event: Mapping[str, Any]) -> None:
        if event.get("state") != "over":
            self.dark.append({**event, "over": None})
        for one in self.dark:
            if event.get("state") == "over" and all(one.get(key) == event.get(key) for key in _OF_A_STATE):
                one["over"] = event["dark_exposure"] - 1

    def causes(self) -> list[tuple[str, int, int, str]]:
        """Return cause, late decisions, lost exposures and the first case of each, the most frequent first."""
        both = (self.late + self.lost).most_common()
        return [(cause, self.late[cause], self.lost[cause], self.first_case[cause]) for cause, _ in both]


# ---- what the detector was like ----


def dark_states(recording: Recording, rates: Rates, found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return states of the detector with `times` of begin, notice and end, seconds since the first exposure, None where not known.

    `phases` are the decisions before, between and after these moments; none where the device's clock has begun anew.
    """
    states = []
    for one in found:
        numbers = one["since_dark_exposure"], one["dark_exposure"] - 1, one["over"]
        if one.get("after_clicks"):  # numbered among exposures that `rates` leaves out
            numbers = None, None, None
        edges = [rates.dark_ticks[number] for number in numbers if number in rates.dark_ticks]
        phases = decisions_between(recording, edges) if len(edges) >= 2 and edges == sorted(edges) else []
        states.append({**one, "times": [rates.seconds_at(number) for number in numbers], "phases": phases})
    return states


def light_changes(events: Sequence[Mapping[str, Any]], decisions: Decisions) -> list[tuple[float | None, float]]:
    """Return of each change of the light about when it began, None where the recording does not have that, and when it was found."""
    found = [one for one in events if one["kind"] == "light_changed" and "decision" in one and "since" in one]
    times = [(decisions.when(int(one["since"])), decisions.when(int(one["decision"]) - 1)) for one in found]
    return [(since, at) for since, at in times if at is not None]


def decisions_between(recording: Recording, edges: Sequence[int]) -> list[tuple[Any, ...]]:
    """Return the decisions before, between and after device ticks: name, how many, labelled, of known truth, right, clicks of all, objects.

    `right` are labelled; `objects` those that differ among the labelled ones of known truth, TOLD_APART at most.
    """
    sums = np.zeros((len(edges) + 1, 5), np.int64)
    objects = np.zeros((len(sums), TOLD_APART), np.bool_)
    again = (recording.summary.get("device") or {}).get("objects") or TOLD_APART  # after these the first is shown again
    for rows in together(recording.iter_decisions()):
        phase = np.searchsorted(edges, rows["tick"], side="right")
        labelled = (rows["flags"] & int(DecisionFlag.ABSTAINED)) == 0
        known = labelled & (rows["truth"] >= 0)
        columns = np.ones(len(rows)), labelled, known, known & (rows["label"] == rows["truth"]), rows["clicks"]
        np.add.at(sums, phase, np.array(columns, np.int64).T)
        objects[phase[known], rows["object"][known] % again % TOLD_APART] = True
    return [(name, *row, seen) for name, row, seen in zip(PHASES, sums.tolist(), objects.sum(axis=1).tolist())]


# ---- latencies ----


def ledger_of(blocks: Iterable[Rows]) -> TimingLedger:
    """Return the latencies of recorded decisions, TIMING_DTYPE (n,) in each block; decoding is not recorded, and within `decide`."""
    ledger = TimingLedger(NEVER_NS)
    for rows in together(blocks):
        marks = np.stack([rows[name].astype(np.int64) for name in _MARKS], axis=1)
        ledger.judge(marks, np.zeros(len(rows), np.int64), np.ones(len(rows), np.int64))
    return ledger


def is_virtual(ledger: TimingLedger) -> bool:
    """Return whether the host took no time at all, as in virtual time: then latencies say nothing."""
    return ledger.stages["decide"].quantile_ns(0.99) < 1000 * NO_TIME_US


def latency_curves(ledger: TimingLedger) -> list[Curve]:
    """Return the shares of decisions above each time, in microseconds, of the whole latency and of its stages."""
    shown = [
        (ledger.total, "end of exposure to decision"),
        *((ledger.stages[key], text) for key, text in _CURVES.items()),
    ]
    return [Curve(*survival(one), name, kind) for (one, name), kind in zip(shown, "abcd")]


def survival(histogram: LatencyHistogram) -> tuple[F64, F64]:
    """Return times in microseconds and the share of durations that are at least about as long."""
    counts, n = histogram.counts, max(histogram.total, 1)
    buckets = np.flatnonzero(counts)
    beyond = np.cumsum(counts[::-1])[::-1][buckets] / n
    edges = np.minimum([upper_edge(bucket) for bucket in buckets.tolist()], histogram.max_ns)
    return np.maximum(edges / 1000, LEAST_US), np.asarray(beyond, np.float64)


class Walks:
    """How many whole walks had each number of exposures and of clicks, and what they said of themselves."""

    def __init__(self, automaton: Automaton) -> None:
        self.automaton = automaton
        self.exposures, self.clicks = Counter[int](), Counter[int]()
        self.probability = 0.0  # their sum
        self.bins = np.zeros((3, CONFIDENCE_BINS))  # of those with label and truth: how many, probabilities, right ones

    def take(self, rows: Rows) -> None:
        """Take the next rows, DECISION_DTYPE (n,)."""
        some = rows[(rows["flags"] & _NOT_WALKED) == 0]
        known = some[(some["truth"] >= 0) & ((some["flags"] & int(DecisionFlag.ABSTAINED)) == 0)]
        place = np.minimum((known["probability"] * CONFIDENCE_BINS).astype(np.int64), CONFIDENCE_BINS - 1)
        for row, weights in enumerate((None, known["probability"], known["label"] == known["truth"])):
            self.bins[row] += np.bincount(place, weights, CONFIDENCE_BINS)
        self.exposures.update(some["exposures"].tolist())
        self.clicks.update(some["clicks"].tolist())
        self.probability += float(some["probability"].sum(dtype=np.float64))

    def reliability(self) -> list[tuple[float, float, float]]:
        """Return mean probability, share of right ones and share of all, of each bin that has any."""
        n = self.bins[0].sum()
        return [(said / count, right / count, count / n) for count, said, right in self.bins.T.tolist() if count]

    def miscalibration(self) -> tuple[float, float]:
        """Return by how much stated probabilities and shares of right ones differ, weighted by decisions, and how much by chance."""
        bins, known = self.reliability(), float(self.bins[0].sum())
        # if every stated probability were right: of a share of m decisions sqrt(2 p (1 - p) / (pi m))
        chance = sum(share * float(np.sqrt(2 * p * (1 - p) / (np.pi * share * known))) for p, _, share in bins)
        return sum(share * abs(right - said) for said, right, share in bins), chance


# ---- the page ----


def run_page(recording: Recording) -> bytes:
    """Return the page of `recording`; a cut one is shown as far as it goes."""
    bundle = recording.bundle() if recording.bundle_place else None
    plan, summary, config = recorded_plan(recording), recording.summary, recording.header["config"]
    classes, first = () if bundle is None else bundle.classes, first_decision(recording)
    decisions = Decisions(config, recording.n_decisions, classes, first)
    events, ledger = Events(decisions), ledger_of(recording.iter_timings())
    events.take(recording.events())
    states = events.dark if first == 0 else []  # dark exposures are numbered in the run, not in its parts
    moments = [(one["since_dark_exposure"], one["dark_exposure"] - 1, one["over"] or 0) for one in states]
    left_out = int(((config.get("dark") or {}).get("guard") or {}).get("afterpulses", 0))
    numbers = [int(number) for three in moments for number in three]
    state_light = None if bundle is None or plan.automaton is None else bundle.light_of(plan.automaton)
    rates = Rates(plan, len(classes), numbers, left_out, state_light)
    walks = Walks(plan.automaton) if plan.automaton is not None else None
    for rows in together(recording.iter_decisions()):
        decisions.take(rows)
        if walks is not None:
            walks.take(rows)
    for item in iter_exposures(recording, plan):
        rates.take(item)
    stages = {name: ledger.stages[name].summary() for name in _CURVES}
    told = {"latency_us": ledger.total.summary(), "stage_latency_us": stages, "clock": {"worst_uncertainty_us": 0.0}}
    timed, passing = not is_virtual(ledger), _passing(recording, bundle, decisions)
    is_told = (summary.get("latency_us") or {}).get("p99") is not None
    confusion = passing[1] if passing else decisions.confusion
    return render(
        "run.html",
        earlier=earlier_parts(recording),
        told_dark=dark_words(summary.get("dark") or {}, calibrated=bool(summary.get("calibration"))),
        recording=recording,
        summary=summary,
        bundle=bundle,
        reasons=[(fault, advice_on(str(fault), simulated=recording.simulated)) for fault in summary.get("faults", ())],
        tiles=rows_of(summary, "figures", *["timed"] * bool(timed and is_told)) if "verdict" in summary else [],
        decisions=decisions,
        accuracy=decisions.accuracy() if len(classes) > 1 else None,
        confusion=confusion if confusion.any() else None,
        passing=passing,
        optics=optics(bundle, rates) if bundle is not None and plan.automaton is None else None,
        walks=walks if bundle is not None else None,
        states_shown=first_states(bundle, walks.automaton, rates) if walks is not None and bundle is not None else [],
        walked=rows_of(summary, "walks"),
        rates=rates,
        light_changes=light_changes(events.shown, decisions),
        states=dark_states(recording, rates, events.dark),
        timed=timed,
        latency=stage_rows({**told, **summary}) if timed else [],
        ledger=ledger,
        curves_of=latency_curves,
        budget_us=summary.get("deadline_us") or config.get("deadline_us"),
        events=events,
        sentences=[moment_of(event, decisions, rates) + sentence_of(event) for event in events.shown],
    )


def moment_of(event: Mapping[str, Any], decisions: Decisions, rates: Rates) -> str:
    """Return the seconds of the run at which an event was, by its tick, its decision or its dark exposure; "" where it has none."""
    if event.get("after_clicks"):  # numbered among exposures that `rates` leaves out
        return ""
    found = {"tick": rates.since_begin, "decision": decisions.when, "first_decision": decisions.when}
    found["dark_exposure"] = lambda number: rates.seconds_at(number - 1)
    at = next((find(int(event[key])) for key, find in found.items() if key in event), None)
    return "" if at is None else f"{seconds(at)}: "


def advice_on(fault: str, *, simulated: bool = False) -> str:
    """Return what to do about a fault, of a `simulated` instrument or of another; "" where nothing is known."""
    found = next((one for one in words()["advice"] if one["words"] in fault), {"text": ""})
    return str(found.get("simulated", found["text"]) if simulated else found["text"])


def _passing(recording: Recording, bundle: Bundle | None, decisions: Decisions) -> tuple[Any, NDArray[np.int64]] | None:
    """Of objects that passed by: rows and confusion of their decisions, by a replay, as a cut recording or a part has no such figures."""
    if "flow" not in recording.header["config"] or bundle is None:
        return None
    from pans.record.replay import replayed_flow

    figures, confusion = replayed_flow(recording, bundle)
    return rows_of(figures.as_json() | {"gates": decisions.pulses()}, "flow"), confusion
