"""A run's figures in words.toml's words, from the facts of its summary: rows for terminal, Markdown and pages, and the Markdown page.

The Markdown page is written beside the recording without any extra; `pans report` makes the full page of the recording.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pans.base.console import markdown, one_line
from pans.base.files import write_file
from pans.base.machine import fault_words, load_average
from pans.base.numbers import FIGURES, Shown, Words, group_of, group_words, shown, wilson_interval
from pans.live.timing import STAGES
from pans.report.live_view.figures import dark_state

from .summary import Summary, singular, was_busy

if TYPE_CHECKING:
    from pans.base.numbers import Figure

UNRESOLVED_US = 1000.0  # a clock that is known no better hides what a host takes
QUANTILES = {"p50": "p50", "p99": "p99", "p99.9": "p999", "max": "max"}
_SHARES = tuple(one.key for one in FIGURES.values() if one.interval)
# tables of words.toml whose rows are those of the table of figures
_SHOWN = {"figures": Shown.RESULTS, "timed": Shown.TIMED}
Facts = Mapping[str, Any]
Rows = list[tuple[str, str, str]]  # name, figure, what else there is to say


def closing_words(summary: Summary, recording: str, report: str) -> str:
    """The lines that the command ends with."""
    facts = summary.as_json()
    last = [("fault", fault, "") for fault in facts["faults"]]
    last += [("warning", words, "") for words in facts["warnings"]] + [
        ("busy", words, "") for words in _busy_words(facts)
    ]
    last += [("recording", recording, ""), ("report", report, "")]
    simulated = "SIMULATED · " * facts["simulated"]
    abstained = f", {facts['abstained']} abstained" if facts.get("abstained") else ""
    head = f"{facts['decisions']} decisions{abstained} ({objects_words(facts)})"
    head = f"{simulated}{facts['verdict']}{_but(facts)}: {head}"
    return "\n".join([head, *lines_of(rows_of(facts, "closing", "flow", "walks") + last)])


def lines_of(rows: Rows) -> list[str]:
    """Return rows as lines for a terminal."""
    return [f"  {name:<13} {one_line('; '.join(filter(None, texts)))}" for name, *texts in rows]


def rows_of(facts: Facts, *tables: str) -> Rows:
    """Return those rows of words.toml's `tables` of which a summary has the facts: `flow` of passing objects, `walks` of an automaton."""
    told, rows = {**facts, **_further(facts)}, []
    words = tomllib.loads(files(__package__).joinpath("words.toml").read_text(encoding="utf-8"))
    for table in tables:
        if table in _SHOWN:
            texts_of = {
                one.name: (_text_of(one, told), *words[table].get(one.key, (one.meaning,)))
                for one in shown(_SHOWN[table])
            }
        else:
            texts_of = words[table]
        for name, texts in texts_of.items():
            figure, *more = (_said(text, told) for text in texts)
            if figure:
                rows.append((name, figure, "; ".join(filter(None, more))))
    return rows


def _text_of(figure: Figure, facts: Facts) -> str:
    """Return a figure of the table in words, "" where a summary does not have it or other rows say it."""
    value = "" if figure.key in facts["elsewhere"] else figure.value(facts, "")
    return "" if value == "" else figure.text(value)


class _Words(Words):
    """Texts in which the name of a figure alone stands for its form in the table, with `:short` for the brief one."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Facts) -> Any:
        value, first = super().get_field(field_name, args, kwargs)
        return (FIGURES.get(field_name), value), first

    def format_field(self, value: tuple[Figure | None, Any], spec: str) -> str:
        figure, found = value
        if figure is None or spec not in ("", "short"):
            return super().format_field(found, spec)
        return figure.brief(found) if spec else figure.text(found)


def _said(text: str, facts: Facts) -> str:
    """A text with its facts, "" where one of them is not there."""
    try:
        return _Words().vformat(text, (), facts)
    except (KeyError, TypeError):
        return ""


def _further(facts: Facts) -> dict[str, Any]:
    """What the words need besides the facts of a summary; a list of one is None where its fact is. `elsewhere`: figures in other rows."""
    dark, stream = (facts.get(name) or {} for name in ("dark", "stream"))
    known = {"spread": facts.get("accuracy_std_trials"), "off": facts.get("expected_off_stderr")}
    known |= {"asked": facts.get("confidence") or None}
    found: dict[str, Any] = {name: None if one is None else [one] for name, one in known.items()}
    light, of = facts.get("illumination_mean", facts.get("illumination")), facts.get("figures_of", {})
    # of an automaton's states it is not known which belonged to decisions that abstained
    is_apart = facts.get("abstained") and of.get("illumination") != of.get("clicks_mean")
    lit, allowed = FIGURES["illumination"], facts.get("late_allowed")
    found |= {"ends": accuracy_interval(facts), "apart": [lit.brief(light)] if is_apart else None}
    found |= {} if light is None else {"illumination": light}
    found["together"] = None if is_apart or light is None else [lit.text(light)]
    found["allowed"] = [FIGURES["late_allowed"].text(allowed)] if allowed else None
    other = {"illumination": not is_apart, "dark.per_exposure": not dark.get("exposures")}
    found["elsewhere"] = {key for key, is_other in other.items() if is_other}
    found["share"] = {name: _share(facts, name) for name in _SHARES if f"{name}_ci" in facts}
    found["text"] = {}
    found["turn"] = [quantile_words(facts["turn_us"])] if facts.get("turn_us") else None
    if "passages" in facts:
        found["text"]["aborted"] = ", ".join(f"{name} {n}" for name, n in facts["aborted"].items()) or "none"
    if "verdict" in facts:
        granted = ", ".join(f"{what}: {answer}" for what, answer in facts.get("realtime", {}).items())
        found["text"] |= {
            "objects": objects_words(facts),
            "lit": "" if is_apart or light is None else f", illumination {lit.brief(light)}",
            "every": f"of all {facts['decisions']:,} decisions" if facts.get("abstained") else "",
            "latency": "not measured in virtual time" if _is_virtual(facts) else latency_words(facts),
            "exposures": exposure_words(facts.get("exposure_timing", {})),
            "realtime": granted or "virtual time: nothing asked for",
            "page_faults": fault_words(facts.get("page_faults", {})),
            "dark": dark_words(dark, calibrated=bool(facts.get("calibration"))),
        }
        found["text"]["counted"] = counted_words(facts)
    if stream.get("repeated"):
        counts = ((stream.get(f"repeats_{what}"), what) for what in ("differing", "unchecked"))
        unlike = ", ".join(f"{n} {what}" for n, what in counts if n)
        found |= {"repeats": stream["repeated"], "differing": f" ({unlike})" if unlike else ""}
    return found


def dark_words(dark: Facts, *, calibrated: bool) -> str:
    """Return how the dark counts of a whole run stand to what is expected, as the live view says it; "" after an alarm.

    A calibrated rate is an interval, which the summary does not have: then only a rate that may be the expected one is judged.
    """
    if not dark.get("exposures") or not dark.get("expected") or dark.get("alarm") or dark.get("findings"):
        return ""
    watched = dark.get("channels") or (dark,)  # which leaves out afterpulses
    counts = {f"dark_{name}": sum(row[name] for row in watched) for name in ("exposures", "clicks")}
    off, words, level = dark_state(counts | dict.fromkeys(("dark_expected", "dark_high"), dark["expected"]))
    return words if level != "note" else "" if calibrated else off


def _but(facts: Facts) -> str:
    return f", but {facts['busy']}" if facts.get("busy") else ""


def _is_virtual(facts: Facts) -> bool:
    return bool(facts["device"].get("virtual_time"))


def _busy_words(facts: Facts) -> Iterator[str]:
    """Yield how busy the computer was, if that made most decisions late, and what to do about it."""
    waited_ms, causes = facts["page_faults"].get("waited_ms", 0), facts["late_cause"]
    if not was_busy(facts["simulated"], facts["late"], causes, waited_ms, facts["seconds"]):
        return
    loop = f"; the loop waited {waited_ms} ms of {facts['seconds']:.1f} s for a processor" if waited_ms else ""
    yield f"other programs kept the computer busy: load {load_average():.1f} on {os.cpu_count()} cores{loop}"
    accuracy = "late decisions are as accurate as others" if facts["lost"] else "accuracy is not affected"
    yield f"{accuracy}; end other programs and run again, or see what `pans doctor` recommends"


def objects_words(facts: Facts) -> str:
    """Return on how many objects how often was decided; objects that come again and again are no trials.

    >>> objects_words({"objects": 200, "trials": 1, "decisions": 700, "judged": 500, "abstained": 200})
    '200 objects, 2.5 decisions on each on average'
    """
    if "passages" in facts:
        alone = facts["passages"]["alone"]
        return f"{alone:,} objects passed alone" if alone else "true classes unknown"
    objects, trials, judged = facts["objects"], facts["trials"], facts.get("judged", facts["decisions"])
    if not objects:
        return "true classes unknown" if facts["decisions"] > facts["abstained"] else "all abstained"
    if objects * trials == judged:
        return f"{objects} objects × {trials} trials"
    return f"{objects} objects, {judged / objects:.1f} decisions on each on average"


def counted_words(facts: Facts) -> str:
    """Return of which decisions accuracy, clicks and photons are; "" where they are of all."""
    if "passages" in facts:
        found = facts["passages"]["alone"] - facts["passages"]["missed"]
        aborted = found - facts.get("judged", found)  # recordings of earlier versions have no `judged`
        said = f"of {found:,} decisions about objects that passed alone" if found else ""
        return said + (f", {aborted:,} of them aborted: not right" if aborted else "")
    if "judged" not in facts:
        return "abstained decisions with a known truth count as not right" if facts.get("abstained") else ""
    known, n = facts["photons_known"], facts[group_of(facts)]
    partly = f"photons: of {known:,} of them, known from their marks" if 0 < known < n else ""
    return "; ".join(filter(None, (group_words(facts), partly)))


def latency_words(facts: Facts) -> str:
    """Return the quantiles of the time from exposure to decision; what the clock cannot resolve is said, not shown as 0."""
    values = {key: us for key in QUANTILES.values() if (us := facts["latency_us"][key]) is not None}
    if not values:
        return "not measured: no decision"
    uncertainty_us = facts["clock"]["worst_uncertainty_us"]
    seen = list(
        filter(None, [quantile_words({k: us for k, us in values.items() if not is_unresolved(us, uncertainty_us)})])
    )
    if not is_unresolved(min(values.values()), uncertainty_us):
        return ", ".join(seen)
    return f"{', '.join([*seen, 'else'] if seen else [])} not resolved (clock uncertainty {uncertainty_us / 1000:.1f} ms)".strip()


def quantile_words(values: Facts) -> str:
    """Return quantiles and the largest of durations in us; one of too few durations is None and left out.

    >>> quantile_words({"p50": 12.3, "p99": None, "p999": None, "max": 40.0})
    'p50 12 us, max 40 us'
    """
    return ", ".join(f"{name} {values[key]:.0f} us" for name, key in QUANTILES.items() if values.get(key) is not None)


def is_unresolved(latency_us: float, uncertainty_us: float) -> bool:
    """Whether a latency of (nearly) 0 says nothing, because the device's clock was not known to a millisecond."""
    return latency_us < 0.5 and uncertainty_us >= UNRESOLVED_US


def exposure_words(timing: Facts) -> str:
    """Return when exposures happened, as the device told.

    >>> exposure_words({"announced": False, "exposures": 0})
    'not told by the device'
    """
    if not timing.get("exposures"):
        return f"{'none ' if timing.get('announced') else 'not '}told by the device"
    start, length = (f"{timing[key]:+.3g} us" for key in ("worst_start_us", "worst_length_us"))
    allowed = f"largest of {timing['exposures']:,} exposures, allowed {timing['tolerance_us']:.3g} us"
    return f"start {start}, length {length} off the plan ({allowed})"


def accuracy_interval(facts: Facts) -> tuple[float, float] | None:
    """Return the 95 % interval of the accuracy, None where it is not known: as a flow states it, else Wilson's by independent objects.

    Several decisions about an object count as many objects as the spread over objects amounts to.
    """
    accuracy, objects, error = (facts.get(name) for name in ("accuracy", "objects", "accuracy_stderr_objects"))
    if facts.get("accuracy_ci"):
        low, high = facts["accuracy_ci"]
        return low, high
    if accuracy is None or not objects:
        return None
    n = max(objects, round(accuracy * (1 - accuracy) / error**2)) if error else objects
    return wilson_interval(accuracy * n, n)


def _share(facts: Facts, name: str) -> str:
    value, ends = facts[name], facts[f"{name}_ci"]
    return "unknown" if value is None or ends is None else f"{value:.3%} ({ends[0]:.3%} to {ends[1]:.3%})"


# ---- Markdown ----


def write_markdown(
    path: Path,
    summary: Summary,
    run: Facts,
    confusion: NDArray[np.int64],
    classes: Sequence[str],
    *,
    force: bool = False,
) -> None:
    """Write the summary as Markdown; UsageError if it exists, unless `force`. `run`: name -> text about what was run."""
    facts = summary.as_json()
    simulated = "\n> **SIMULATED**: the clicks come from a simulated instrument, not from light.\n" * facts["simulated"]
    blame, totals, cut = facts["blame"], (facts["late"], facts["lost"]), ""
    what = (singular(rows_of(one, "causes")[0][1]) for one in blame)
    causes = [(text, one["cause"], "yes" if one["sure"] else "no", one["why"]) for text, one in zip(what, blame)]
    shown = tuple(sum(one.get(what, 0) for one in blame) for what in ("decisions", "exposures"))
    if causes and shown != totals:
        of = f"{shown[0]:,} of {totals[0]:,} late decisions and {shown[1]:,} of {totals[1]:,} lost exposures"
        cut = f"The first {len(causes)} causes, of {of}; the recording has them all (`pans report`)."
    lines = [
        f"# Run of {markdown(run.get('bundle', 'a bundle'))}{' (SIMULATED)' if simulated else ''}",
        simulated,
        f"**{facts['verdict']}**{markdown(_but(facts))}",
        *(f"- {markdown(fault)}" for fault in facts["faults"]),
        *(f"- warning: {markdown(words)}" for words in facts["warnings"]),
        *_table("Results", ("figure", "value", ""), rows_of(facts, "figures", "flow", "walks")),
        *_table("Timing", ("microseconds", *QUANTILES), [] if _is_virtual(facts) else stage_rows(facts)),
        *(f"- {name}: {markdown('; '.join(filter(None, texts)))}" for name, *texts in rows_of(facts, "timing")),
        *(_table("Late and missing work", ("what", "cause", "sure", "why"), causes) if causes else ()),
        cut,
    ]
    if confusion.any():
        cells = [(name, *(str(n) if n else "·" for n in row)) for name, row in zip(classes, confusion.tolist())]
        lines += _table("Decisions by class (truth in rows)", ("", *classes), cells)
    lines += ["", "## What was run", "", *(f"- {name}: {markdown(text)}" for name, text in run.items())]
    write_file(path, ("\n".join(lines) + "\n").encode(), force=force)


def _table(heading: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(map(markdown, row))} |" for row in (head, *rows)]
    table = [lines[0], "|" + " --- |" * len(head), *lines[1:], ""] if lines[1:] else []
    return ["", f"## {heading}", "", *table]


def stage_rows(facts: Facts) -> list[tuple[str, ...]]:
    """Return the quantiles of the whole latency and by stage, microseconds; the host's own stages are of its clock alone."""
    uncertainty_us, rows = facts["clock"]["worst_uncertainty_us"], []
    stages = {name: facts["stage_latency_us"][name] for name in STAGES if name in facts["stage_latency_us"]}
    for name, row in {"exposure end to decision": facts["latency_us"], **stages}.items():
        doubt_us = uncertainty_us if name in ("exposure end to decision", "link") else 0.0
        cells = (row[key] for key in QUANTILES.values())
        texts = ("–" if us is None else "not resolved" if is_unresolved(us, doubt_us) else f"{us:.0f}" for us in cells)
        rows.append((name, *texts))
    return rows
