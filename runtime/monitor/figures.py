"""A `History` in, the figures of a live view out: the same rows in words for terminal and web page, and the curves of the page.

All text that comes from files or devices is made inert here (safe_text).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from pans.runtime.intervals import wilson_interval
from pans.runtime.safe_text import one_line

from .history import RECENT_S, History, quantile_us

NAME_CHARACTERS = 40
NO_LABEL = 0xFFFF  # of a decision that abstained (decide/verdict.py), which would load numpy
CLASSES_SHOWN = 20
RISE_SEEN = 3.0  # times the expected dark counts: where a larger rise is not excluded, too little was seen
DISK_LOW_S, DISK_SHORT_S = 3600.0, 86_400.0
DISK_KNOWN_S = 10.0  # before, the recording is its header
GIB, MIB = 1 << 30, 1 << 20
LEVELS = {"notice": "note", "warning": "warn", "alarm": "bad"}


class Row(NamedTuple):
    """A figure: its group, name, text, and level ("" as it should be, good, note, warn or bad)."""

    group: str
    name: str
    text: str
    level: str = ""


def rows_of(history: History) -> list[Row]:
    """Return all figures of the present moment; none before the first picture."""
    picture = history.picture
    if not picture:
        return []
    return [*_run(history), *_results(history), *_time(history), *_instrument(history), *_machine(history)]


def title_of(history: History) -> str:
    """Return what runs where."""
    title = one_line(history.begin.get("title", "pans"), 120)
    return f"SIMULATED · {title}" if history.begin.get("simulated") else title


def headline(history: History) -> str:
    """Return the most important figures as one line."""
    picture, begin = history.picture, history.begin
    decisions, expected = picture["decisions"], begin.get("expected", 0)
    accuracy = "" if not picture["known"] else f" · accuracy {picture['right'] / picture['known']:.1%}"
    clicks = picture["clicks"] / decisions if decisions else 0.0
    p99 = quantile_us(history.latency, 0.99) or 0.0
    dark, _, dark_level = _dark_state(picture)
    return (
        f"{decisions}{f' of {expected}' if expected else ''} decisions{accuracy} · {clicks:.2f} clicks each"
        f" · p99 {p99 / 1000:.2f} ms · late {picture['late']} · lost {picture['lost']}"
        + (f" · dark counts: {dark}" if dark_level not in ("", "good") else "")
    )


def _run(history: History) -> list[Row]:
    picture, begin = history.picture, history.begin
    state = picture["state"] + (f": {one_line(picture['ended'], 200)}" if picture["ended"] else "")
    level = {"running": "good", "stopped": "note", "stalled": "bad", "device lost": "bad"}.get(picture["state"], "note")
    done, expected = picture["decisions"], begin.get("expected", 0)
    rate = history.rate("decisions")
    left = (
        f", {duration((expected - done) / rate)} left" if expected > done and rate > 0 and not picture["ended"] else ""
    )
    rows = [
        Row("run", "state", state, level),
        Row("run", "running for", duration(picture["elapsed_s"])),
        Row("run", "decisions", f"{done:,}" + (f" of {expected:,}" if expected else "") + left),
        Row("run", "rate", f"{rate:,.1f} decisions and {history.rate('exposures'):,.0f} exposures per second"),
    ]
    if picture["reconnects"]:
        rows.append(Row("run", "reconnections", f"{picture['reconnects']}", "warn"))
    return rows


def _results(history: History) -> list[Row]:
    picture = history.picture
    done = picture["decisions"]
    found = history.accuracy(picture, picture["objects"])
    rows = []
    if found is not None:
        share, low, high = found
        text = f"{share:.1%}, 95 % interval {low:.1%} to {high:.1%} ({picture['objects']:,} objects)"
        rows.append(Row("results", "accuracy", text))
    if not done:
        return rows
    abstained = picture["abstained"]
    rows.append(Row("results", "abstained", f"{abstained:,} ({abstained / done:.2%})", "note" if abstained else ""))
    photons = picture["photons"] / picture["photons_known"] if picture["photons_known"] else None
    light = history.begin.get("illumination")
    light = picture["walk_light"] / done if picture.get("walk_light") is not None else light
    each = [
        f"{picture['clicks'] / done:.2f} clicks",
        "photons unknown" if photons is None else f"{photons:.2f} photons",
        *([] if light is None else [f"illumination {light:.1f}"]),
    ]
    return [*rows, Row("results", "light per decision", ", ".join(each))]


def _time(history: History) -> list[Row]:
    picture, deadline = history.picture, float(history.begin.get("deadline_us", 0.0))
    p50, p99 = (quantile_us(history.latency, q) for q in (0.5, 0.99))
    rows = []
    if p50 is not None and p99 is not None:
        text = f"p50 {p50:,.0f} us, p99 {p99:,.0f} us, longest {picture['latency_max_us']:,.0f} us"
        level = "bad" if deadline and p99 > deadline else "warn" if deadline and p99 > 0.8 * deadline else ""
        rows.append(Row("time", "latency", text, level))
        if deadline:
            rows.append(Row("time", "budget", f"{deadline:,.0f} us; p99 takes {p99 / deadline:.0%} of it", level))
    late, lost = picture["late"], picture["lost"]
    gaps = f" in {picture['gaps']:,} gaps" if lost else ""
    return [
        *rows,
        Row("time", "late", f"{late:,} decisions", "bad" if late else "good"),
        Row("time", "lost", f"{lost:,} exposures{gaps}", "bad" if lost else "good"),
    ]


def _instrument(history: History) -> list[Row]:
    picture = history.picture
    rows = [_dark(picture)]
    drift = picture.get("clock_drift_ppm")
    text = "not known yet" if drift is None else f"drift {drift:+.2f} ppm"
    rows.append(Row("instrument", "clock", f"{text}, uncertainty at most {picture['clock_uncertainty_us']:,.0f} us"))
    rows.append(_exposures(picture.get("exposed"), history.begin.get("exposure_tolerance_us", 0.0)))
    if repeated := picture.get("repeated", 0):
        differing = picture.get("repeats_differing", 0)
        text = f"{repeated:,} messages, {differing:,} with other content"
        rows.append(Row("instrument", "repeats", text, "bad" if differing else ""))
    if picture["contradictions"]:
        rows.append(Row("instrument", "contradictions", f"{picture['contradictions']:,} messages", "bad"))
    if picture["trouble"]:
        rows.append(Row("instrument", "latest trouble", one_line(picture["trouble"], 200), "warn"))
    return rows


def _exposures(told: list[float] | None, allowed_us: float) -> Row:
    """When exposures happened: how many were told of, and the farthest start and length."""
    if not told or not told[0]:
        return Row("instrument", "exposures", "not told by the device" if told is None else "not told yet", "note")
    _, start_us, length_us = told
    text = f"start {start_us:+.3g} us, length {length_us:+.3g} us at most, allowed {allowed_us:.3g} us"
    return Row("instrument", "exposures", text, "bad" if max(abs(start_us), abs(length_us)) > allowed_us else "good")


def _dark(picture: dict[str, Any]) -> Row:
    clicks, exposures = picture["dark_clicks"], picture["dark_exposures"]
    if not exposures:
        return Row("instrument", "dark counts", "no dark exposures yet", "note")
    low, high = wilson_interval(clicks, exposures)
    text = f"in the whole run {clicks / exposures:.3g} per exposure, 95 % interval {low:.2g} to {high:.2g}"
    expected = picture.get("dark_expected")
    if expected is not None:
        top = picture["dark_high"]
        text += f"; expected {expected:.2g}" + (f", at most {top:.2g}" if top > expected * 1.0001 else "")
    _, words, level = _dark_state(picture)
    return Row("instrument", "dark counts", f"{words}; {text}" if words else text, level)


def _dark_state(picture: dict[str, Any]) -> tuple[str, str, str]:
    """Return what the dark counts are, in a few words and in all, and its level; all "" where nothing is expected of them or none came.

    An alarm's words have the rate of the exposures that it was raised on. A rate whose interval excludes what is expected is not
    called so, long before there is evidence for an alarm; nor is one whose interval reaches beyond RISE_SEEN times that.
    """
    if states := picture.get("dark_states"):
        level, ratio, *_ = states[0]
        return f"{ratio:.3g} times as expected", "; ".join(one_line(one[2], 300) for one in states), LEVELS[level]
    expected = picture.get("dark_expected")
    if expected is None or not picture["dark_exposures"]:
        return "", "", ""
    low, high = wilson_interval(picture["dark_clicks"], picture["dark_exposures"])
    if low <= picture["dark_high"] and high >= picture.get("dark_low", expected):
        rise = f"no rise of the mean above {high / expected:.3g} times"
        if high <= RISE_SEEN * expected:
            return "as expected", f"as expected, {rise}", "good"
        more = f"{rise} is all that can be said (--dark-slots gives more dark exposures)"
        return "too few to judge", f"too few to judge, {more}", ""
    after = picture.get("dark_alarm_after")
    then = "no alarm at this rate" if after is None else f"alarm after about {after:,} more dark exposures at this rate"
    off = f"{'higher' if low > picture['dark_high'] else 'lower'} than expected, not yet sure"
    return off, f"{off} ({then})", "note"


def _machine(history: History) -> list[Row]:
    picture = history.picture
    free = picture.get("disk_free_bytes")
    if free is None:
        return []
    size, seconds = picture.get("recording_bytes", 0), max(float(picture["elapsed_s"]), 1.0)
    left_s = free * seconds / size if size and seconds >= DISK_KNOWN_S else float("inf")
    level = "bad" if left_s < DISK_LOW_S else "warn" if left_s < DISK_SHORT_S else ""
    lasts = f", lasts {duration(left_s)}" if left_s < 1e10 else ""
    return [
        Row(
            "machine", "recording", f"{one_line(picture.get('recording', ''), NAME_CHARACTERS)}, {size / MIB:,.1f} MiB"
        ),
        Row("machine", "disk", f"{free / GIB:,.1f} GiB free{lasts}", level),
    ]


def class_rows(history: History) -> list[tuple[str, int, int, int]]:
    """Return name, decisions for it, objects' decisions that it was the truth of, and those of them that are right, for each class."""
    picture = history.picture
    counts = zip(picture.get("class_decided", ()), picture.get("class_truth", ()), picture.get("class_right", ()))
    names = [one_line(name, NAME_CHARACTERS) for name in history.begin.get("classes", ())]
    rows = [(name, *row) for name, row in zip(names, counts)]
    return sorted(rows, key=lambda row: -row[1])[:CLASSES_SHOWN] if len(rows) > CLASSES_SHOWN else rows


def latest_rows(history: History) -> list[dict[str, Any]]:
    """Return the latest decisions, the newest first, as `decision_row` has them."""
    return [decision_row(history, facts) for facts in reversed(history.picture.get("latest", ()))]


def decision_row(history: History, facts: list[Any]) -> dict[str, Any]:
    """Return a decision in words: its number, object, decision, probability, clicks, truth, level."""
    names = history.begin.get("classes", ())
    number, index, label, probability, clicks, truth, _ = facts
    known = 0 <= truth < len(names)
    return {
        "number": number,
        "object": index if index != 0xFFFFFFFF else "",
        "decision": name_of(label, names),
        "probability": f"{probability:.0%}" if label != NO_LABEL else "",
        "clicks": clicks,
        "truth": one_line(names[truth], NAME_CHARACTERS) if known else "unknown",
        "level": "" if not known or label == NO_LABEL else "good" if truth == label else "bad",
    }


def name_of(label: int, classes: Any) -> str:
    """Return the class name of a label, "abstained" for none."""
    if label == NO_LABEL:
        return "abstained"
    return one_line(classes[label], NAME_CHARACTERS) if label < len(classes) else "picture"


def health(history: History) -> list[tuple[str, str, str]]:
    """Return machine, link and detector, each as its name, a level, and one sentence with one number."""
    picture, deadline = history.picture, float(history.begin.get("deadline_us", 0.0))
    sums, latency = history.recent()
    p99, late, lost = quantile_us(latency, 0.99), int(sums["late"]), int(sums["lost"])
    disk = next((row for row in _machine(history) if row.level), None)
    if disk is not None:
        machine = disk.level, f"The disk of the recording has {disk.text}."
    elif late:
        machine = "bad", f"{late:,} decisions were late in the last minute."
    elif p99 is None:
        machine = "note", f"No decision was made in the last {RECENT_S:.0f} s."
    elif not deadline:
        machine = "good", f"99 % of the last minute's decisions took at most {p99:,.0f} us."
    else:
        machine = "good", f"99 % of the last minute's decisions took at most {p99 / deadline:.0%} of the time allowed."
    unsure = f"The device's clock is known to {picture['clock_uncertainty_us']:,.0f} us, and nothing was lost of late."
    link = ("bad", f"{lost:,} exposures were lost in the last minute.") if lost else ("good", unsure)
    if picture["state"] != "running" and not picture["ended"]:
        link = "bad", f"The run is: {picture['state']}, after {picture['elapsed_s']:,.0f} s."
    dark, exposures = history.dark(sums)
    words, _, level = _dark_state(picture)
    rate = f"{dark / exposures:.2g} dark counts per exposure" if exposures else "No dark exposures yet"
    detector = level or "note", f"{rate}{f', {words}' if words else ''}."
    return [(name, *one) for name, one in zip(("machine", "link", "detector"), (machine, link, detector))]


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
