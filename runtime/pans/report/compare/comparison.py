"""What two runs have in common, in what they differ, and which of the differences are larger than chance.

Results of the same objects are compared in pairs; otherwise as two samples in which each object counts once, however often it was shown.
P-values of one comparison are corrected for their number (Holm), and 0.05 is the limit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray

from pans.base.console import one_line
from pans.base.errors import DamagedFileError, UsageError
from pans.base.files import parse_json_object, read_file
from pans.base.numbers import FIGURES, Figure, Shown, group_of, number, shown
from pans.decide import is_decided, is_judged
from pans.protocol.wire import NO_OBJECT
from pans.record.reading import TICK_HZ, checked_summary, open_recording
from pans.report.pages.page import flat, render
from pans.report.pages.run import Decisions, is_virtual, latency_curves, ledger_of

from . import statistics

ALPHA = 0.05
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
LEAST_BEYOND = 10  # decisions slower than a quantile, or nothing is said about it
SUMMARY_MAX_BYTES = 1 << 24
# Facts that differ between any two runs, or that follow from others.
_ALWAYS_DIFFERENT = ("created_utc", "command", "format_version", "toml", "decisions_sha256", "tick", "part")
_OUTPUTS = ("options.device", "options.out", "options.record", "options.force")
_DERIVED = ("config.dark.guard.", "config.backend_choice.", *_OUTPUTS)
_FIRST = ("profile.", "device_url")  # what a reader asks for first


# ---- the sides ----


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A run: where it was found, header and summary as they were written, decisions and host times (None of a summary alone)."""

    path: Path
    header: Mapping[str, Any]
    summary: Mapping[str, Any]
    decisions: NDArray[np.void] | None
    timings: NDArray[np.void] | None
    complete: bool

    @property
    def name(self) -> str:
        """The name of its folder, or of its file."""
        return self.path.resolve().parent.name if self.path.suffix == ".pansrec" else self.path.name

    @property
    def simulated(self) -> bool:
        """Whether the clicks are simulated."""
        return bool(self.header.get("simulated") or self.summary.get("simulated"))

    @property
    def scene(self) -> str:
        """The scene that a simulated instrument was given, or says that it shows; "" where none is named."""
        query = str(self.header.get("device_url", "")).partition("?")[2]
        return (parse_qs(query).get("scene") or [str(self.summary.get("device", {}).get("scene", ""))])[0]


Sides = tuple[Side, Side]


def read_side(path: str | Path) -> Side:
    """Return the run at `path`: its folder, a recording, or the JSON object that `pans run --json` printed.

    UsageError where there is none, DamagedFileError for a damaged file.
    """
    place = Path(path)
    if place.suffix == ".json" and place.is_file():
        summary = parse_json_object(read_file(place, SUMMARY_MAX_BYTES), str(place))
        if "decisions" not in summary or "verdict" not in summary:
            remedy = "save what `pans run --json` prints, or name the recording"
            raise UsageError(f"{place}: not a summary: it has no keys `decisions` and `verdict`", remedy=remedy)
        return Side(place, {}, checked_summary(summary, str(place)), None, None, True)
    found = open_recording(place, salvage=True)
    try:
        TICK_HZ.checked(found.header["config"]["tick_hz"], "tick_hz")
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedFileError(f"{place}: its header has no config.tick_hz that can be: {error}") from error
    decisions, told = found.decisions(), found.summary
    if distinct := int(told.get("device", {}).get("objects", 0)):  # then the first one is shown again
        numbers = decisions["object"].copy()
        decisions["object"] = np.where(numbers == NO_OBJECT, numbers, numbers % np.uint32(distinct))
    return Side(place, found.header, told, decisions, found.timings(), found.complete)


# ---- what is found ----


class Change(NamedTuple):
    """A fact that differs: its dotted name and what both sides say, "" where one says nothing."""

    name: str
    first: str
    second: str


@dataclass(frozen=True, slots=True)
class Finding:
    """A figure of both sides, as the runs say it.

    `difference` is first less second, or their ratio where `is_ratio`; None where no interval is known. In a difference of decisions each
    object counts once: it is that of the means in `method`.

    `p` is the p-value of the test named in `method`, `p_corrected` that after Holm; None where nothing was tested.
    """

    name: str
    unit: str
    first: float | None
    second: float | None
    difference: float | None
    low: float | None
    high: float | None
    is_ratio: bool
    p: float | None
    method: str
    p_corrected: float | None = None

    @property
    def significant(self) -> bool | None:
        """Whether it differs by more than chance; None where nothing was tested. An interval without a test tells by itself."""
        if self.p_corrected is not None:
            return self.p_corrected < ALPHA
        if self.low is None or self.high is None:
            return None
        return not self.low <= (1.0 if self.is_ratio else 0.0) <= self.high

    def as_json(self) -> dict[str, Any]:
        """Return it JSON-able; what is not finite becomes None."""
        endless = [key for key, one in asdict(self).items() if isinstance(one, float) and not math.isfinite(one)]
        facts = asdict(self) | dict.fromkeys(endless)
        return facts | {"difference_is": "a / b" if self.is_ratio else "a - b", "significant": self.significant}


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that two runs differ in; `why` says why objects were paired or not."""

    first: Side
    second: Side
    paired: bool
    why: str
    changes: tuple[Change, ...]
    findings: tuple[Finding, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it JSON-able."""
        return {
            "a": str(self.first.path),
            "b": str(self.second.path),
            "paired": self.paired,
            "why": self.why,
            "changes": [change._asdict() for change in self.changes],
            "findings": [finding.as_json() for finding in self.findings],
            "significant": [finding.name for finding in self.findings if finding.significant],
            "simulated": self.first.simulated or self.second.simulated,
        }


def compare(first: Side, second: Side, pairing: str = "auto") -> Comparison:
    """Return in what two runs differ; `pairing` says whether their objects are the same, or `auto` to find out."""
    paired, why = _pairing(first, second, pairing)
    found = list(_findings(first, second, paired))
    tested = [at for at, finding in enumerate(found) if finding.p is not None]
    for at, p in zip(tested, statistics.holm([found[at].p or 0.0 for at in tested])):
        found[at] = replace(found[at], p_corrected=p)
    return Comparison(first, second, paired, why, tuple(changes_of(first, second)), tuple(found))


def changes_of(first: Side, second: Side) -> list[Change]:
    """Return the facts of headers and devices that differ: profile and device first, hashes last, in the order of their names."""
    one, two = (_facts(side) for side in (first, second))
    names = sorted({*one, *two}, key=lambda name: ("sha256" in name, not name.startswith(_FIRST), name))
    return [Change(name, one.get(name, ""), two.get(name, "")) for name in names if one.get(name) != two.get(name)]


def _facts(side: Side) -> dict[str, str]:
    told = {"device": side.summary.get("device", {}), "deadline_us": side.summary.get("deadline_us")}
    facts = {name: text for name, text in flat({**side.header, **told}) if not name.startswith(_DERIVED)}
    if facts.get("device.name") == facts.get("device_url"):
        facts.pop("device.name", None)
    return {name: text for name, text in facts.items() if not {*name.split(".")} & {*_ALWAYS_DIFFERENT}}


def _pairing(first: Side, second: Side, pairing: str) -> tuple[bool, str]:
    if pairing == "different":
        return False, "the objects are different ones, as was said"
    if first.decisions is None or second.decisions is None:
        return False, "a summary has no decisions: objects cannot be compared one by one"
    known = [rows[rows["truth"] >= 0] for rows in (first.decisions, second.decisions)]
    one, two = (dict(zip(rows["object"].tolist(), rows["truth"].tolist())) for rows in known)
    common = one.keys() & two.keys()
    if not common:
        return False, "no object with a known truth is in both runs"
    if differ := sum(one[number] != two[number] for number in common):
        return False, f"{differ} of {len(common)} objects of the same number have another true class"
    if pairing == "same":
        return True, f"{len(common)} objects are the same, as was said"
    if first.scene and first.scene == second.scene:
        return True, f"both runs show the scene {first.scene}; {len(common)} objects are in both"
    return False, "nothing says that the objects are the same; `--objects same` does"


# ---- figures ----


def _findings(first: Side, second: Side, paired: bool) -> Iterator[Finding]:
    sides = (first, second)
    if (accuracy := _accuracy(sides, paired)) is not None:
        yield accuracy
    yield from _abstained(sides)
    yield _clicks(sides, paired)
    compared = [one for one in shown(Shown.COMPARE) if one.key != "clicks_mean"]
    yield from (_untested(one.key, one.unit, _values(sides, one)) for one in compared if not one.total)
    yield from (rate for one in compared if one.total for rate in _rates(sides, one))
    yield from _latencies(sides)


def _rates(sides: Sides, figure: Figure) -> Iterator[Finding]:
    """A count as a rate of its total: two Poisson counts, each of so many."""
    counts, totals = ([int(one or 0) for one in _values(sides, FIGURES[key])] for key in (figure.key, figure.total))
    is_dark = figure.key == "dark.clicks"  # rare and independent: also where both are 0
    if all(totals) and (any(counts) or is_dark):
        four = counts[0], totals[0], counts[1], totals[1]
        rates, of = (four[0] / four[1], four[2] / four[3]), FIGURES[figure.total].word
        method = "as two Poisson counts, exact" if is_dark else "as two Poisson counts; bursts look surer than they are"
        ratio, p = statistics.rate_ratio(*four), statistics.poisson_rates(*four)
        how = "{} of {} and {} of {} ".format(*four) + f"{of} {method}"
        yield Finding(figure.compared or figure.key, figure.rate_unit, *rates, *ratio, True, p, how)


def _values(sides: Sides, figure: Figure) -> list[Any]:
    """What the summaries say of a figure of the table; None where one says nothing."""
    found = [figure.value(side.summary) for side in sides]
    if figure.key != "illumination":
        return found
    # of an automaton that of the states shown, as recordings of earlier versions tell them apart
    return [FIGURES["illumination_mean"].value(side.summary, light) for side, light in zip(sides, found)]


def _untested(name: str, unit: str, values: list[Any], why: str = "not tested", *, is_ratio: bool = False) -> Finding:
    one, two = (None if value is None else float(value) for value in values)
    apart = None
    if one is not None and two is not None and (two or not is_ratio):
        apart = one / two if is_ratio else one - two
    return Finding(name, unit, one, two, apart, None, None, is_ratio, None, why)


Column = Callable[[NDArray[np.void]], NDArray[Any]]


def _of_objects(rows: NDArray[np.void], value: Column) -> dict[int, float]:
    """The mean `value` of the decisions about each object."""
    objects, at = np.unique(rows["object"], return_inverse=True)
    return dict(zip(objects.tolist(), (np.bincount(at, value(rows)) / np.bincount(at)).tolist()))


def _both(sides: Sides, chosen: Column) -> list[NDArray[np.void]]:
    """The `chosen` decisions of both sides; empty where a side has no decisions."""
    found = [side.decisions for side in sides if side.decisions is not None]
    return [rows[chosen(rows)] for rows in found] if len(found) == len(sides) else []


def _figures_are_of(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Which decisions the figures of a run are of."""
    of = {"judged": is_judged(rows), "decided": is_decided(rows), "decisions": np.ones(len(rows), np.bool_)}
    return of[group_of({name: np.count_nonzero(some) for name, some in of.items()})]


def _accuracy(sides: Sides, paired: bool) -> Finding | None:
    values, sizes = (_values(sides, FIGURES[key]) for key in ("accuracy", "objects"))
    sizes = [int(one or 0) for one in sizes]
    if both := _both(sides, is_judged):
        right = [rows["label"] == rows["truth"] for rows in both]
        values = [float(one.mean()) if len(one) else None for one in right]
        shares = [_of_objects(rows, lambda rows: rows["label"] == rows["truth"]) for rows in both]
        if paired and None not in values and shares[0].keys() & shares[1].keys():
            return _paired_accuracy((shares[0], shares[1]), (values[0], values[1]))
        sizes = [len(one) for one in shares]
    if None in values or not all(sizes):
        return None
    return _two_shares("accuracy", values, sizes, f"two shares of {sizes[0]} and {sizes[1]} distinct objects")


def _two_shares(name: str, shares: list[float], sizes: list[int], method: str) -> Finding:
    right = [share * n for share, n in zip(shares, sizes)]
    between = statistics.newcombe_difference(right[0], sizes[0], right[1], sizes[1])  # of the shares that are shown
    p = statistics.fisher_exact(round(right[0]), sizes[0], round(right[1]), sizes[1])
    how = f"{method}, Fisher exact; interval by Newcombe"
    return Finding(name, "share", shares[0], shares[1], *between, False, p, how)


def _pairs(first: dict[int, float], second: dict[int, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What both say of the objects that are in both."""
    common = sorted(first.keys() & second.keys())
    return np.array([first[number] for number in common]), np.array([second[number] for number in common])


def _paired_accuracy(
    shares: tuple[dict[int, float], dict[int, float]], values: tuple[float | None, float | None]
) -> Finding:
    """The accuracies of the runs, `values`; their difference is that of the objects in both, each of which counts once."""
    one, two = _pairs(*shares)
    better, worse = int((one > two).sum()), int((one < two).sum())
    method = f"pairs of {len(one)} objects, each counts once (A {one.mean():.2%}, B {two.mean():.2%})"
    method += f": {better} better in A, {worse} better in B, McNemar exact"
    between, p = statistics.paired_difference(one, two, 1.0), statistics.mcnemar_exact(better, worse)
    return Finding("accuracy", "share", values[0], values[1], *between, False, p, method)


def _abstained(sides: Sides) -> Iterator[Finding]:
    figures = [FIGURES[key] for key in ("abstained", "decisions", "trials")]
    abstained, decisions, trials = ([int(n or 0) for n in _values(sides, one)] for one in figures)
    if all(decisions) and any(abstained):
        sizes = [max(1, n // max(1, times)) for n, times in zip(decisions, trials)]
        shares = [some / n for some, n in zip(abstained, decisions)]
        yield _two_shares("abstained", shares, sizes, "two shares, the trials of an object count once")


def _clicks(sides: Sides, paired: bool) -> Finding:
    figure, both = FIGURES["clicks_mean"], _both(sides, _figures_are_of)
    shares = [_of_objects(rows, lambda rows: rows["clicks"]) for rows in both]
    paired = paired and len(shares) == 2
    means = _pairs(*shares) if paired else [np.array([*one.values()]) for one in shares]
    if min(map(len, means), default=0) < 2:
        return _untested(figure.key, figure.unit, _values(sides, figure))
    one, two = means
    values = [float(rows["clicks"].mean()) for rows in both]
    if paired:
        between = statistics.paired_difference(one, two)
        method = f"pairs of {len(one)} objects, each counts once (A {one.mean():.4g}, B {two.mean():.4g})"
    else:
        between = statistics.mean_difference(one, two)
        method = f"{len(one)} and {len(two)} objects, each counts once (A {one.mean():.4g}, B {two.mean():.4g})"
    method += "; interval by the spread of their differences" if paired else "; interval by their spread"
    return Finding(figure.key, figure.unit, values[0], values[1], *between, False, None, method)


def _latencies(sides: Sides) -> Iterator[Finding]:
    rows = [side.timings for side in sides]
    one, two = (None if t is None else (t["decided_ns"] - t["device_end_ns"]) / 1000.0 for t in rows)
    for key, q in QUANTILES.items():
        figure = FIGURES[f"latency_us.{key}"]
        if one is None or two is None:
            values = _values(sides, figure)
            if None not in values and min(map(float, values)) >= statistics.LEAST_US:
                yield _untested(figure.compared, figure.unit, values, "not tested: no single latencies", is_ratio=True)
        elif min(len(one), len(two)) * (1 - q) >= LEAST_BEYOND:
            found = statistics.quantile_ratio(one, two, q)
            method = "interval by a bootstrap of stretches of consecutive decisions"
            if min(found.first, found.second) >= statistics.LEAST_US:  # not in virtual time
                yield Finding(figure.compared, figure.unit, found.first, found.second, *found.ratio, True, None, method)


# ---- in words ----

SAME = "Bundle, profile, options and device are the same."
CUT = "cut, no summary"
LONG, SHOWN = 40, 160  # characters of a value in the terminal


def value_of(finding: Finding, value: float | None) -> str:
    """Return one side's figure with its unit."""
    if value is None:
        return "unknown"
    if finding.unit == "share":
        return f"{100 * value:.2f} %"
    return f"{value:.1f} us" if finding.unit == "us" else f"{value:.4g}"


def difference_of(finding: Finding) -> str:
    """Return how far the sides are apart, with the 95 % interval where it is known."""
    apart, low, high = finding.difference, finding.low, finding.high
    if apart is None:
        return ""
    if not finding.is_ratio:
        scale, form, unit = (100, "+.2f", " points") if finding.unit == "share" else (1, "+.3g", "")
        head = f"A − B = {scale * apart:{form}}{unit}"
        return head if low is None or high is None else f"{head} ({scale * low:{form}} to {scale * high:{form}})"
    if math.isnan(apart):
        return "none in either run"
    head = "B has none" if math.isinf(apart) else f"A is {number(apart)} times B"
    if low is None or high is None:
        return head
    return f"{head} ({f'at least {number(low)} times' if math.isinf(high) else f'{number(low)} to {number(high)}'})"


def verdict_of(finding: Finding) -> str:
    """Return whether it is significant, with the corrected p-value."""
    if finding.significant is None:
        return "not tested"
    word = "significant" if finding.significant else "within chance"
    return word if finding.p_corrected is None else f"{word}, p = {finding.p_corrected:.2g}"


def conclusion(comparison: Comparison) -> str:
    """Return in a sentence or two whether the verdicts differ, and what differs by more than chance."""
    verdicts = [str(side.summary.get("verdict", CUT)) for side in (comparison.first, comparison.second)]
    unlike = "" if verdicts[0] == verdicts[1] else "The verdicts differ: A {}, B {}. ".format(*verdicts)
    if not any(one.significant is not None for one in comparison.findings):
        return f"{unlike}Nothing could be tested."
    differing = ", ".join(_title(one) for one in comparison.findings if one.significant)
    head = "Larger than chance" if differing else "No figure differs by more than chance"
    how = f"(p-values below {ALPHA:g} after a correction for their number, or 95 % intervals)"
    return f"{unlike}{head} {how}{': ' if differing else ''}{differing}."


def _title(finding: Finding) -> str:
    found = (one.name for one in FIGURES.values() if finding.name in (one.compared, one.key))
    return next(filter(None, found), finding.name)


def _row(one: Finding) -> tuple[str, str, str, str, str]:
    """Name, both sides, their difference and whether it is beyond chance."""
    return _title(one), value_of(one, one.first), value_of(one, one.second), difference_of(one), verdict_of(one)


def apart(first: str, second: str) -> tuple[str, str]:
    """Return two texts, of long ones the parts that the other does not have.

    >>> apart("sim:oled-qcmos?scene=fashion200&pace=fast&seed=1", "sim:oled-qcmos?scene=fashion200&pace=fast&seed=2&optics=gain=-15%")
    ('… seed=1', '… seed=2 optics=gain=-15%')
    """
    if max(len(first), len(second)) <= LONG:
        return first or "-", second or "-"
    one, two = (re.split(r"[?&]|, ", text) for text in (first, second))
    kept = [[part for part in parts if part not in other] for parts, other in ((one, two), (two, one))]
    return " ".join(["…"] * (kept[0] != one) + kept[0]), " ".join(["…"] * (kept[1] != two) + kept[1])


def comparison_words(comparison: Comparison) -> str:
    """Return all of it as lines for a terminal: results first, then what was different about the runs."""
    lines = ["SIMULATED"] if comparison.first.simulated or comparison.second.simulated else []
    for name, side in zip("AB", (comparison.first, comparison.second)):
        lines.append(f"{name}  {one_line(side.path)}: {one_line(side.summary.get('verdict', CUT))}")
        lines += [f"     {one_line(fault)}" for fault in side.summary.get("faults", ())]
    lines += ["", conclusion(comparison)]
    how = "paired, each counts once in a difference" if comparison.paired else "two samples"
    lines += [f"Objects: {how}; {one_line(comparison.why)}", ""]
    lines += ["  {:<26}A {}, B {}; {}; {}".format(*_row(one)) for one in comparison.findings]
    lines += ["", "What changed:" if comparison.changes else SAME]
    for change in comparison.changes:
        texts = (one_line(text, SHOWN) for text in apart(change.first, change.second))
        lines.append(f"  {one_line(change.name)}: {' -> '.join(texts)}")
    return "\n".join(lines)


def comparison_page(comparison: Comparison) -> bytes:
    """Return the page: results and their differences, curves of both sides, what was different about the runs, hashes at the end."""
    sides = {"A": comparison.first, "B": comparison.second}
    rows, methods = zip(*((_row(one), f"{_title(one)}: {one.method}.") for one in comparison.findings))
    facts = {"conclusion": conclusion(comparison), "rows": rows, "methods": methods, "same": SAME, "cut": CUT}
    return render("compare.html", comparison=comparison, sides=sides, curves_of=_curves, **facts)


def _curves(side: Side) -> dict[str, Any]:
    """What is drawn of one side: accuracy over time, latency unless time was virtual."""
    if side.decisions is None or side.timings is None or not len(side.decisions):
        return {}
    ledger = ledger_of([side.timings])
    numbers = Decisions(side.header["config"], len(side.decisions), first=int(side.decisions["index"][0]))
    numbers.take(side.decisions)
    latency = {} if is_virtual(ledger) else {"ledger": ledger, "curves": latency_curves(ledger)}
    return {"accuracy": numbers.accuracy(), "budget_us": side.summary.get("deadline_us"), **latency}
