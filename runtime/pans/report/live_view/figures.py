"""A `History` in, the figures of a live view out: the same words for terminal and web page.

All text that comes from files or devices is made inert here (safe_text).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

from pans.base.console import one_line
from pans.base.numbers import FIGURES, Shown, decision_figures, group_words, number, shown, wilson_interval

from .history import History, quantile_us

NAME_CHARACTERS = 40
NO_LABEL, NO_OBJECT = 0xFFFF, 0xFFFFFFFF  # of a decision (bundle/backends/verdict.py would load numpy)
RATE_OVER_S, RECENT_S = 5.0, 60.0
RISE_SEEN = 3.0  # times the expected dark counts: where a larger rise is not excluded, too little was seen
DISK_LOW_S, DISK_SHORT_S = 3600.0, 86_400.0
GIB, MIB = 1 << 30, 1 << 20
LEVELS = {"notice": "note", "warning": "warn", "alarm": "bad"}
STATES = {"running": "good", "stalled": "bad", "device lost": "bad"}


class Row(NamedTuple):
    """A figure: its name, its text, and its level ("" as it should be, good, note, warn or bad)."""

    name: str
    text: str
    level: str = ""


def rows_of(history: History) -> list[Row]:
    """Return all figures of the present moment; none before the first picture."""
    return [*_results(history), *_instrument(history.picture, history.begin)] if history.picture else []


def _results(history: History) -> Iterator[Row]:
    picture, begin, latency = history.picture, history.begin, history.latency
    done, expected = picture["decisions"], begin.get("expected", 0)
    late, lost, deadline = picture["late"], picture["lost_exposures"], float(begin.get("deadline_us", 0.0))
    sums, _, seconds = history.recent(RATE_OVER_S)
    rate = sums["decisions"] / max(seconds, 1e-3)
    state = f"{picture['state']} after {duration(picture['elapsed_s'])}"
    state += f": {one_line(picture['ended'], 200)}" if picture["ended"] else ""
    state += f"; times that the device was found again: {picture['reconnects']}" if picture["reconnects"] else ""
    yield Row("state", state, STATES.get(picture["state"], "note"))
    made = f"{done:,}{f' of {expected:,}' if expected else ''}, {rate:,.1f} per second"
    goes_on = expected > done and rate > 0 and not picture["ended"]
    yield Row("decisions", made + (f", {duration((expected - done) / rate)} left" if goes_on else ""))
    yield from _light(picture, begin, history)
    yield from _latency(picture, latency, deadline)
    allowed = float(begin.get("late_allowed", 0.0)) * done
    yield Row("late", f"{late:,} decisions", "bad" if late > allowed else "note" if late else "good")
    gaps = f" in {picture['gaps']:,} gaps" if lost else ""
    yield Row("lost", f"{lost:,} exposures{gaps}", "bad" if lost else "good")


def _light(picture: dict[str, Any], begin: dict[str, Any], history: History) -> Iterator[Row]:
    """Accuracy and light per decision, of one group of decisions."""
    found, of = decision_figures(picture), group_words(picture)
    done, abstained = found.decisions, found.abstained
    if found.judged:
        accuracy, ends = FIGURES["accuracy"].brief, history.accuracy(picture, picture["objects"])
        share, low, high = map(accuracy, ends)
        between = f"95 % interval {low} to {high} ({picture['objects']:,} objects)"
        yield Row("accuracy", f"{share}{f' {of}' if of else ''}, {between}")
    if done:
        yield Row("abstained", f"{abstained:,} ({abstained / done:.2%})", "note" if abstained else "")
        walked, clicks = picture.get("walk_light"), FIGURES["clicks_mean"].brief(found.clicks_mean)
        photons = FIGURES["photons_mean"].brief(found.photons_mean)
        light = begin.get("illumination") if walked is None else walked / done
        apart = walked is not None and bool(abstained)  # which states belong to decisions that abstained is not counted
        text = f"{clicks} clicks, {photons} photons" if found.photons_known else f"{clicks} clicks, photons unknown"
        shone = FIGURES["illumination"].brief(light)
        text += "" if light is None or apart else f", illumination {shone}"
        yield Row("light per decision", f"{text}{f'; {of}' if of else ''}")
        if apart and light is not None:
            yield Row("illumination", f"{shone} per decision, of all {done:,}")
    for one in shown(Shown.LIVE):
        if one.live in picture:
            yield Row(one.name, one.brief(picture[one.live]))


def _latency(picture: dict[str, Any], counts: Counter[int], deadline: float) -> Iterator[Row]:
    """Quantiles of the latency, none of too few decisions; the upper edge of a bucket is not above the longest."""
    if picture.get("virtual_time") or not counts:
        return
    longest = float(picture["latency_max_us"])
    found = {name: quantile_us(counts, q) for name, q in (("p50", 0.5), ("p99", 0.99))}
    texts = [f"{name} {min(us, longest):,.0f} us" for name, us in found.items() if us is not None]
    p99, level, part = found["p99"], "", ""
    if p99 is not None and deadline > 0:
        share = min(p99, longest) / deadline
        level = "bad" if share > 1 else "warn" if share > 0.8 else ""
        part = f"; p99 takes {share:.0%} of {deadline:,.0f} us"
    yield Row("latency", f"{', '.join([*texts, f'longest {longest:,.0f} us'])}{part}", level)


def _instrument(picture: dict[str, Any], begin: dict[str, Any]) -> Iterator[Row]:
    clicks, exposures, expected = picture["dark_clicks"], picture["dark_exposures"], picture.get("dark_expected")
    _, words, level = dark_state(picture)
    if exposures:
        low, high = wilson_interval(clicks, exposures)
        text = f"in the whole run {clicks / exposures:.3g} per exposure, 95 % interval {low:.2g} to {high:.2g}"
        if expected is not None:
            top = picture["dark_high"]
            text += f"; expected {expected:.2g}" + (f", at most {top:.2g}" if top > expected * 1.0001 else "")
        yield Row("dark counts", f"{words}; {text}" if words else text, level)
    else:
        yield Row("dark counts", "no dark exposures yet", "note")
    if "exposure_start_us" in picture:  # the farthest of all
        start_us, length_us = picture["exposure_start_us"], picture["exposure_length_us"]
        allowed_us = begin.get("exposure_tolerance_us", 0.0)
        text = f"start {start_us:+.3g} us, length {length_us:+.3g} us at most, allowed {allowed_us:.3g} us"
        yield Row("exposures", text, "bad" if max(abs(start_us), abs(length_us)) > allowed_us else "good")
    else:
        yield Row("exposures", "not told by the device", "note")
    drift = "not known yet" if picture["clock_drift_ppm"] is None else f"{picture['clock_drift_ppm']:+.2f} ppm"
    yield Row("clock", f"drift {drift}, uncertainty at most {picture['clock_uncertainty_us']:,.0f} us")
    if picture["contradictions"]:
        yield Row("contradictions", f"{picture['contradictions']:,} messages", "bad")
    if "disk_free_bytes" in picture:
        left_s = picture.get("disk_left_s", math.inf)
        lasts = f", full in {duration(left_s)}" if left_s < math.inf else ""
        text = f"{picture['disk_free_bytes'] / GIB:,.1f} GiB free{lasts}"
        size = f"{picture.get('recording_bytes', 0) / MIB:,.1f} MiB"
        yield Row("disk", f"{text}; the recording has {size}", _disk_level(left_s))
    if trouble := picture["last_error"]:
        yield Row("latest trouble", one_line(trouble.replace("_", " ", 1), 300), "warn")


def _disk_level(left_s: float) -> str:
    return "bad" if left_s < DISK_LOW_S else "warn" if left_s < DISK_SHORT_S else ""


def title_of(history: History) -> str:
    """Return what runs where."""
    title = one_line(history.begin.get("title", "pans"), 120)
    # behind a socket only the device knows that it is simulated
    simulated = history.begin.get("simulated") or history.picture.get("simulated")
    return f"SIMULATED · {title}" if simulated else title


def headline(history: History) -> str:
    """Return the most important figures as one line."""
    picture, expected = history.picture, history.begin.get("expected", 0)
    found = decision_figures(picture)
    accuracy = f" · accuracy {FIGURES['accuracy'].brief(found.accuracy)}" if found.judged else ""
    p99 = None if picture.get("virtual_time") else quantile_us(history.latency, 0.99)
    dark, _, level = dark_state(picture)
    of = group_words(picture)
    return (
        f"{found.decisions}{f' of {expected}' if expected else ''} decisions"
        + (f", {found.abstained} abstained" if found.abstained else "")
        + f"{accuracy} · {FIGURES['clicks_mean'].brief(found.clicks_mean or 0.0)} clicks each{f' ({of})' if of else ''}"
        + ("" if p99 is None else f" · p99 {min(p99, picture['latency_max_us']) / 1000:.2f} ms")
        + f" · late {picture['late']} · lost {picture['lost_exposures']}"
        + (f" · dark counts: {dark}" if level not in ("", "good") else "")
    )


def dark_state(picture: dict[str, Any]) -> tuple[str, str, str]:
    """Return what the dark counts are, in a few words and in all, and its level; all "" where nothing is expected of them or none came.

    An alarm's words have the rate of the exposures that it was raised on. A rate whose interval excludes what is expected is not
    called so, long before there is evidence for an alarm; nor is one whose interval reaches beyond RISE_SEEN times that.
    """
    if states := picture.get("dark_states"):
        level, ratio, *_ = states[0]
        return (
            f"{number(ratio)} times the expected rate since it changed",
            "; ".join(one_line(one[2], 300) for one in states),
            LEVELS[level],
        )
    expected = picture.get("dark_expected")
    if expected is None or not picture["dark_exposures"]:
        return "", "", ""
    if picture.get("dark_changed"):  # and is over
        again = "as expected again"
        return again, f"{again}, after a change whose counts are in the rate", "good"
    low, high = wilson_interval(picture["dark_clicks"], picture["dark_exposures"])
    if low <= picture["dark_high"] and high >= picture.get("dark_low", expected):
        rise = f"a mean above {high / expected:.3g} times the expected rate is excluded"
        if high <= RISE_SEEN * expected:
            return "as expected", f"as expected, {rise}", "good"
        few = "too few to judge"
        return few, f"{few}: only {rise} (--dark-slots gives more dark exposures)", ""
    after = picture.get("dark_alarm_after")
    then = "no alarm at this rate" if after is None else f"alarm after about {after:,} more dark exposures at this rate"
    off = f"{'higher' if low > picture['dark_high'] else 'lower'} than expected, not yet sure"
    return off, f"{off} ({then})", "note"


def latest_rows(history: History) -> list[dict[str, Any]]:
    """Return the latest decisions, the newest first, as `decision_row` has them."""
    return [decision_row(history, facts) for facts in reversed(history.picture.get("latest", ()))]


def decision_row(history: History, facts: list[Any]) -> dict[str, Any]:
    """Return a decision in words: its number, object, decision, probability, clicks, truth, level."""
    number, index, label, probability, clicks, truth, _ = facts
    names = [one_line(name, NAME_CHARACTERS) for name in history.begin.get("classes", ())]
    known, decided = 0 <= truth < len(names), label != NO_LABEL
    named = names[label] if label < len(names) else "picture"
    return {
        "number": number,
        "object": index if index != NO_OBJECT else "",
        "decision": named if decided else "abstained",
        "probability": f"{probability:.0%}" if decided else "",
        "clicks": clicks,
        "truth": names[truth] if known else "unknown",
        "level": "" if not (known and decided) else "good" if truth == label else "bad",
    }


def health(history: History) -> list[tuple[str, str, str]]:
    """Return machine, link and detector, each as its name, a level, and one sentence with one number."""
    picture, deadline = history.picture, float(history.begin.get("deadline_us", 0.0))
    sums, latency, _ = history.recent(RECENT_S)
    p99, late, lost = quantile_us(latency, 0.99), int(sums["late"]), int(sums["lost_exposures"])
    full_s = picture.get("disk_left_s", math.inf)
    if level := _disk_level(full_s):
        machine = level, f"The disk of the recording is full in {duration(full_s)}."
    elif late:
        machine = "bad", f"{late:,} decisions were late in the last minute."
    elif not latency:
        machine = "note", f"No decision was made in the last {RECENT_S:.0f} s."
    elif picture.get("virtual_time"):
        machine = "good", "Time is virtual: latencies are not measured."
    elif p99 is None:
        machine = "good", f"No decision was late in the last {RECENT_S:.0f} s."
    else:
        most = f"{p99 / deadline:.0%} of the time allowed" if deadline else f"{p99:,.0f} us"
        machine = "good", f"99 % of the last minute's decisions took at most {most}."
    unsure = f"The device's clock is known to {picture['clock_uncertainty_us']:,.0f} us; nothing was lost in the last minute."
    link = ("bad", f"{lost:,} exposures were lost in the last minute.") if lost else ("good", unsure)
    if picture["state"] != "running" and not picture["ended"]:
        link = "bad", f"The run is: {picture['state']}, after {picture['elapsed_s']:,.0f} s."
    some = sums if sums["dark_exposures"] > 0 else picture
    dark, exposures = some["dark_clicks"], some["dark_exposures"]
    words, _, level = dark_state(picture)
    when = " in the last minute" if some is sums else ""
    rate = f"{dark / exposures:.2g} dark counts per exposure{when}" if exposures else "No dark exposures yet"
    if picture.get("dark_states"):  # one figure on the page: that of `dark_state`, not one of another window
        rate, words = f"Dark counts {words}", ""
    detector = level or "note", f"{rate}{f', {words}' if words else ''}."
    return [("machine", *machine), ("link", *link), ("detector", *detector)]


def duration(seconds: float) -> str:
    """Return a time span for people: 42 s, 12 min, 5 h 07 min, 3 d 04 h.

    >>> duration(18_420)
    '5 h 07 min'
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"
    return f"{int(seconds // 86_400)} d {int(seconds % 86_400 // 3600):02d} h"
