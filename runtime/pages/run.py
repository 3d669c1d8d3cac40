"""The page of a run: its recording is read once, block by block, while sums of bounded size add up; the rest is that of its summary.

Before that it was checked, and its commands were read for the plan. The messages are read for the rates; the blocks that come in between
go to who sums them up. Only objects in flow need one reading more: their passages come from a replay. Verdict,
faults and figures are those that the run recorded; a cut recording has none, and says so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.flow.matching import abort_reason
from pans.runtime.intervals import Z_95, wilson_interval
from pans.runtime.record import Recording
from pans.runtime.record.exposures import iter_exposures
from pans.runtime.record.format import Kind
from pans.runtime.record.parts import first_decision
from pans.runtime.record.recording import ROWS_AT_ONCE
from pans.runtime.record.sent_plan import recorded_plan
from pans.runtime.report.words import exposure_words, figure_rows, flow_rows, mean_words, repeat_words

from .bundle import optics
from .charts import Axis, Bars, Curve, Mark, chart, percent, seconds, whole
from .page import points, render, sentence_of, words
from .rates import BINS, Rates, Stretches
from .timing import Clock, Durations, latency_chart
from .walks import Walks

CONFUSION_MAX = 40  # classes
ACCURACY_BINS, OBJECTS_PER_BIN = 60, 20
SHOWN, OF_A_KIND = 200, 30  # events
F64 = NDArray[np.float64]


class Reading:
    """One pass over a recording: what `iter_exposures` asks of one, and rows of other kinds to those who take them, many at once."""

    def __init__(self, recording: Recording, takers: Mapping[Kind, Callable[[Any], None]]) -> None:
        self._recording, self._takers = recording, takers

    def messages(self) -> Iterator[tuple[int, bytes]]:
        """Yield the device's messages."""
        held: dict[Kind, list[Any]] = {kind: [] for kind in self._takers}
        sizes = Counter[Kind]()
        for kind, content in self._recording.read(Kind.MESSAGES, *self._takers):
            if kind == Kind.MESSAGES:
                yield from content
            elif kind == Kind.EVENTS:
                self._takers[kind](content)
            else:
                held[kind].append(content)
                sizes[kind] += len(content)
                if sizes[kind] >= ROWS_AT_ONCE:
                    self._takers[kind](np.concatenate(held[kind]))
                    held[kind], sizes[kind] = [], 0
        for kind, rows in held.items():
            if rows:
                self._takers[kind](np.concatenate(rows))


class Decisions:
    """Sums over decisions: truth against decision, accuracy over time, outcomes and pulses of passing objects."""

    def __init__(self, config: Mapping[str, Any], n: int, classes: Sequence[str] = (), first: int = 0) -> None:
        self.n, self._first = n, first  # decisions, and the number of the first one
        self._first_tick: int | None = None
        self._tick_hz = float(config["tick_hz"])
        self.known = self.right = 0
        shown = len(classes) if len(classes) <= CONFUSION_MAX else 0
        self.confusion = np.zeros((shown, shown), np.int64)  # truth in rows, of those that have a label
        self.over = Stretches()
        gated = config["flow"]["settings"].get("gate_classes", ()) if "flow" in config else ()
        self._passing = "flow" in config
        self._gated = [list(classes).index(name) for name in gated if name in classes]

    def add(self, name: str, numbers: NDArray[Any] | list[int], weights: Any = None) -> None:
        """Add decisions by number to the sum `name`; those that the recording does not have are left out."""
        found = np.asarray(numbers, np.int64) - self._first
        if ((found >= 0) & (found < self.n)).all():
            self.over.add(name, found, weights)

    def take(self, rows: NDArray[np.void]) -> None:
        """Take the next rows, DECISION_DTYPE (n,)."""
        if self._first_tick is None:
            self._first_tick = int(rows["tick"][0])
        numbers, told = rows["index"], rows["truth"] >= 0
        right, abstained = told & (rows["label"] == rows["truth"]), (rows["flags"] & int(DecisionFlag.ABSTAINED)) != 0
        self.known, self.right = self.known + int(told.sum()), self.right + int(right.sum())
        self.add("decisions", numbers)
        ticks = np.maximum(rows["tick"].astype(np.float64) - self._first_tick, 0.0)
        self.add("seconds", numbers, ticks / self._tick_hz)
        for name, which in (("known", told), ("right", right)):
            self.add(name, numbers[which])
        self.over.tell_apart(numbers[told].astype(np.int64) - self._first, rows["object"][told])
        n = len(self.confusion)
        fits = told & ~abstained & (rows["truth"] < n) & (rows["label"] < n)
        np.add.at(self.confusion, (rows["truth"][fits], rows["label"][fits]), 1)
        if self._passing:
            for flag in np.unique(rows["flags"]).tolist():
                self.add(f"outcome {abort_reason(flag) or 'with a label'}", numbers[rows["flags"] == flag])
            self.add("asked", numbers[np.isin(rows["label"], self._gated)])

    def accuracy(self, n_classes: int, label: str = "Accuracy over the run") -> tuple[Any, list[int]]:
        """Return accuracy over time with its interval, and the least and largest number of objects of a stretch; None of a short run."""
        objects = sum(map(len, self.over.sets.values()))
        over = self.over.merged(int(np.clip(objects // OBJECTS_PER_BIN, 1, ACCURACY_BINS)))
        some = over.sums.get("known", np.zeros(1)) > 0
        if some.sum() < 2:
            return None, []
        share = over.sums["right"][some] / over.sums["known"][some]
        counts = [len(over.sets[place]) for place in np.flatnonzero(some).tolist()]
        ends = np.array([wilson_interval(round(p * n), n) for p, n in zip(share.tolist(), counts)]).T
        when, mean = self._seconds(over)[some], self.right / self.known
        marks = [Mark(mean, f"whole run {100 * mean:.1f} %")]
        if abs(mean - 1 / n_classes) > 0.12:
            marks.append(Mark(1 / n_classes, "a guess"))
        curve = Curve(when, share, low=np.minimum(ends[0], share), high=np.maximum(ends[1], share))
        x = Axis("time since the first decision", 0.0, max(float(when[-1]), 1e-9), text=seconds)
        y = Axis("share of right decisions", 0.0, 1.0, text=percent)
        return chart(f"{label}, {100 * mean:.1f} % on average", x, y, curves=[curve], marks=marks), [
            min(counts),
            max(counts),
        ]

    def stacked(self, what: str, names: Mapping[str, str]) -> Any:
        """Return sums over time, one upon the other, the largest first; `names`: sum -> its name. None where there is nothing."""
        over = self.over.merged(ACCURACY_BINS)
        rows = {name: over.sums[key] for key, name in names.items() if over.sums.get(key, np.zeros(1)).any()}
        if not rows:
            return None
        edges = np.append(np.minimum.accumulate(self._seconds(over)[::-1])[::-1], 0.0)
        edges[-1] = 2 * edges[-2] - edges[-3] if len(edges) > 2 else edges[-2] + 1.0
        base, bars = np.zeros(over.used), []
        for (name, counts), kind in zip(sorted(rows.items(), key=lambda row: -float(row[1].sum())), "abcd"):
            bars.append(Bars(edges, counts, base.copy(), f"{name} ({int(counts.sum())})", kind))
            base += counts
        label = f"{what} over the run: " + ", ".join(f"{name} {int(counts.sum())}" for name, counts in rows.items())
        x = Axis("time since the first decision", float(edges[0]), float(edges[-1]), text=seconds)
        y = Axis(f"{what} per {over.width} decisions", 0.0, 1.05 * max(float(base.max()), 1.0), text=whole)
        return chart(label, x, y, bars=bars)

    def _seconds(self, over: Stretches) -> F64:
        """The mean time of each stretch."""
        return over.sums["seconds"] / np.maximum(over.sums["decisions"], 1)

    def pulses(self) -> dict[str, int]:
        """Return how many pulses were asked for, made, refused and expired; one without a refusal counts as made."""
        asked, refused, expired = (
            self.over.sums.get(name, np.zeros(BINS)) for name in ("asked", "gate_refused", "gate_expired")
        )
        self.over.sums["made"] = np.maximum(asked - refused - expired, 0.0)
        found = {"asked": asked, "done": self.over.sums["made"], "refused": refused, "expired": expired}
        return {name: int(one.sum()) for name, one in found.items()}


class Events:
    """What was noted: how many events of each kind, the first of them, and who is to blame for what was late or lost."""

    def __init__(self, decisions: Decisions) -> None:
        self._decisions = decisions
        self.kinds: Counter[str] = Counter()
        self.shown: list[Mapping[str, Any]] = []
        self.late, self.lost = Counter[str](), Counter[str]()
        self.first_case: dict[str, str] = {}

    def take(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Take the next events."""
        for event in events:
            kind = str(event["kind"])
            self.kinds[kind] += 1
            if len(self.shown) < SHOWN and self.kinds[kind] <= OF_A_KIND and kind != "session":
                self.shown.append(event)
            if kind == "blame":
                cause = str(event.get("cause", "?"))
                self.first_case.setdefault(cause, str(event.get("why", "")))
                if event.get("what") == "late":
                    n = int(event.get("decisions", 1))
                    self.late[cause] += n
                    self._decisions.add(f"late {cause}", [int(event.get("first_decision", -1))], [n])
                else:
                    self.lost[cause] += int(event.get("exposures", 1))
            elif kind in ("gate_refused", "gate_expired") and "decision" in event:
                self._decisions.add(kind, [int(event["decision"])])

    def causes(self) -> list[tuple[str, int, int, str]]:
        """Return cause, late decisions, lost exposures and the first case of each, the most frequent first."""
        both = (self.late + self.lost).most_common()
        return [(cause, self.late[cause], self.lost[cause], self.first_case.get(cause, "")) for cause, _ in both]


def run_page(recording: Recording) -> bytes:
    """Return the page of `recording`; a cut one is shown as far as it goes."""
    bundle = recording.bundle() if recording.bundle_place else None
    plan, summary, config = recorded_plan(recording), recording.summary, recording.header["config"]
    classes = () if bundle is None else bundle.classes
    decisions = Decisions(config, recording.n_decisions, classes, first_decision(recording))
    events, durations, clock = Events(decisions), Durations(), Clock(int(config["tick_hz"]))
    walks = Walks(plan.automaton) if plan.automaton is not None else None

    def decided(rows: NDArray[np.void]) -> None:
        decisions.take(rows)
        if walks is not None:
            walks.take(rows)

    takers = {Kind.DECISIONS: decided, Kind.TIMINGS: durations.take, Kind.CLOCK: clock.take, Kind.EVENTS: events.take}
    rates = Rates(plan, len(classes))
    for item in iter_exposures(cast(Recording, Reading(recording, takers)), plan):
        rates.take(item)
    budget_us = summary.get("deadline_us") or config.get("deadline_us")
    timed = not durations.is_virtual()
    accuracy, sizes = decisions.accuracy(len(classes)) if len(classes) > 1 and decisions.known else (None, [])
    passing = _passing(recording, bundle, decisions)
    shown = figure_rows(summary) if "verdict" in summary else []
    confusion = passing["confusion"] if passing else decisions.confusion
    return render(
        "run.html",
        recording=recording,
        summary=summary,
        bundle=bundle,
        header={key: value for key, value in recording.header.items() if key not in ("profile", "command")},
        what=_what_was_run(recording, bundle),
        reasons=[(fault, advice_on(str(fault))) for fault in summary.get("faults", ())],
        agrees=_dark_agrees(summary.get("dark")),
        tiles=list(_tiles(summary, timed)) if "verdict" in summary else [],
        decisions=decisions,
        accuracy=accuracy,
        sizes=sizes,
        confusion=confusion if confusion.any() else None,
        mistakes=mistakes(confusion, bundle),
        passing=passing,
        optics=optics(bundle, rates) if bundle is not None and plan.automaton is None else None,
        walks=walks.facts(bundle, rates) if walks is not None and bundle is not None else None,
        rates=rates,
        latency=durations.rows(summary) if timed else [],
        curve=latency_chart(durations, float(budget_us) if budget_us else None) if timed else None,
        causes=events.causes(),
        late=decisions.stacked("late decisions", {f"late {cause}": cause for cause in events.late}),
        clock=clock.facts(summary),
        noted=events.kinds,
        sentences=[sentence_of(event) for event in events.shown],
        records=[(e["kind"], ", ".join(f"{k} {v}" for k, v in e.items() if k != "kind")) for e in events.shown],
        figures=[row for row in shown if not passing or row not in passing["rows"]],
    )


def advice_on(fault: str) -> str:
    """Return what to do about a fault, "" where nothing is known."""
    return next((one["text"] for one in words()["advice"] if one["words"] in fault), "")


def mistakes(counts: NDArray[np.int64], bundle: Bundle | None) -> list[str]:
    """Return the three most frequent confusions in words."""
    wrong = counts.copy()
    np.fill_diagonal(wrong, 0)
    found = []
    for truth, label in (divmod(int(pair), len(counts)) for pair in np.argsort(wrong, axis=None)[::-1][:3]):
        if bundle is not None and wrong[truth, label]:
            name, share = bundle.classes[truth], wrong[truth, label] / max(counts[truth].sum(), 1)
            found.append(f"{name} taken for {bundle.classes[label]} ({share:.0%} of {name})")
    return found


def _passing(recording: Recording, bundle: Bundle | None, decisions: Decisions) -> dict[str, Any] | None:
    """Of objects that passed by: what their decisions were worth, by a replay, as a cut recording or a part has no such figures."""
    if "flow" not in recording.header["config"] or bundle is None:
        return None
    from pans.runtime.record.replaying import replayed_flow

    figures, confusion = replayed_flow(recording, bundle)
    pulses, names = decisions.pulses(), [name for name in decisions.over.sums if name.startswith("outcome ")]
    return {
        "rows": flow_rows(figures.as_json() | {"gates": pulses}),
        "confusion": confusion,
        "outcomes": decisions.stacked("decisions", {name: name.removeprefix("outcome ") for name in names}),
        "pulses": decisions.stacked("pulses", {"made": "done", "gate_refused": "refused", "gate_expired": "expired"}),
    }


def _dark_agrees(dark: Any) -> bool:
    counted = dark if isinstance(dark, Mapping) and dark.get("exposures") else {}
    return bool(counted.get("low", 1) <= counted.get("expected", 0) <= counted.get("high", 0))


def _what_was_run(recording: Recording, bundle: Bundle | None) -> list[tuple[str, str]]:
    header, summary = recording.header, recording.summary
    device, profile = summary.get("device", {}), header.get("profile") or {}
    firmware = f", firmware {device['firmware']}" if "firmware" in device else ""
    lasted = f", {float(summary['seconds']):,.1f} s" if "seconds" in summary else ""
    rows = [
        ("date", f"{str(header.get('created_utc', 'unknown'))[:19].replace('T', ' ')} UTC{lasted}"),
        ("device", f"{header.get('device_url', 'unknown')}{firmware}"),
        ("bundle", "not in the recording" if bundle is None else bundle.name),
        ("profile", str(profile.get("name", "unknown"))),
        ("recording", str(recording.path)),
        ("ended", str(summary.get("ended", ""))),
    ]
    return [row for row in rows if row[1]]


def accuracy_interval(summary: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the 95 % interval of the accuracy by its spread over objects, or as a flow states it; None where it is not known."""
    accuracy, error = summary.get("accuracy"), summary.get("accuracy_stderr_objects")
    if summary.get("accuracy_ci"):
        low, high = summary["accuracy_ci"]
        return low, high
    if accuracy is None or error is None:
        return None
    return max(0.0, accuracy - Z_95 * error), min(1.0, accuracy + Z_95 * error)


def _tiles(summary: Mapping[str, Any], timed: bool) -> Iterator[tuple[str, str, str]]:
    """Yield name, figure and a line about each of the main figures."""
    if summary.get("accuracy") is not None:
        between = accuracy_interval(summary)
        more = "" if between is None else f"95 % interval {100 * between[0]:.2f} to {100 * between[1]:.2f} %, "
        objects = f"of {summary['objects']:,} objects" if summary.get("objects") else "of objects that passed alone"
        yield "accuracy", points(summary["accuracy"]), more + objects
    yield "decisions", f"{summary.get('decisions', 0):,}", f"{summary.get('abstained', 0):,} of them abstained"
    photons, clicks = (mean_words(summary.get(name)) for name in ("photons_mean", "clicks_mean"))
    light = mean_words(summary.get("illumination_mean", summary.get("illumination")))
    more = f"{photons} photons (expected photoelectrons), illumination {light} (sum of pattern intensities)"
    yield "clicks per decision", clicks, more
    if timed and (latency := summary.get("latency_us")):
        budget = float(summary.get("deadline_us", 0.0)) / 1000
        yield "latency p99", f"{latency['p99'] / 1000:.3g} ms", f"99 % of decisions were faster; budget {budget:g} ms"
    more = f"decisions; {summary.get('lost', 0):,} exposures lost{repeat_words(summary.get('stream', {}))}"
    yield "late", f"{summary.get('late', 0):,}", more
    if timing := summary.get("exposure_timing"):
        start = f"{timing['worst_start_us']:+.3g} us" if timing["exposures"] else "unknown"
        yield "exposures off the plan", start, exposure_words(timing)
    dark = summary.get("dark")
    if isinstance(dark, Mapping) and dark.get("exposures"):
        more = f"95 % interval {dark['low']:.3g} to {dark['high']:.3g}, expected {dark['expected']:.3g}"
        yield "dark clicks per exposure", f"{dark['clicks'] / dark['exposures']:.3g}", more
