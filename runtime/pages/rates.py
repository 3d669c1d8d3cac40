"""The report page's part on clicks over time: rates of patterns, channels or steps of a walk, and dark counts.

Owns the sums per time bin and per class, from recorded messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.core.plan import Plan
from pans.runtime.intervals import wilson_interval
from pans.runtime.record import Recording
from pans.runtime.record.exposures import Exposures, is_dark, iter_exposures

from .charts import Axis, Chart, Curve, Mark, number, seconds
from .page import Page
from .pixels import heat_png

BINS = 120
DARK_BINS, DARK_PER_BIN = 40, 200  # stretches of the dark counts' strip, and exposures in one
EXPOSURES_PER_BIN = 25  # of each pattern: a rate from fewer is noise
F64 = NDArray[np.float64]


class Rates(NamedTuple):
    """Clicks and exposures per time bin and pattern, channel or step of a walk, and in the dark, (bins, channels) and (bins,).

    Of an automaton also clicks and exposures of each state in the whole run, (states,); of fixed patterns those of each pattern and true
    class, (channels, classes).
    """

    edges_s: F64
    clicks: F64
    exposures: F64
    dark_clicks: F64
    dark_exposures: F64
    state_clicks: F64
    state_exposures: F64
    class_clicks: F64
    class_exposures: F64


def count_rates(recording: Recording, plan: Plan, n_classes: int = 0) -> Rates:
    """Sum clicks and exposures over at most `BINS` equal stretches of device time; a clock that went back starts no new bin."""
    n = plan.n_patterns if plan.automaton is None else plan.automaton.n_slots
    of_states = np.zeros((2, 0 if plan.automaton is None else plan.automaton.n_states))
    of_classes = np.zeros((2, n, n_classes if plan.automaton is None else 0))
    truth = _truths(recording, n_classes)
    sums: list[tuple[int, F64, F64, int, int]] = []
    for item in iter_exposures(recording, plan):
        if isinstance(item, Exposures):
            row = _sums(item, plan, n, of_states)
            sums.append((int(item.start_tick[0]), *row))
            known = truth.get(item.object, -1)
            if known >= 0 and of_classes.size:
                of_classes[0, :, known] += row[0]
                of_classes[1, :, known] += row[1]
    if not sums:
        empty = np.zeros((1, n))
        return Rates(np.array([0.0, 1.0]), empty, empty, np.zeros(1), np.zeros(1), *of_states, *of_classes)
    ticks = np.array([row[0] for row in sums], np.int64)
    seconds = np.maximum(ticks - ticks[0], 0) * plan.tick_us * 1e-6
    per_pattern = sum(float(row[2].sum()) for row in sums) / n
    bins = int(np.clip(per_pattern / EXPOSURES_PER_BIN, 1, BINS))
    edges = np.linspace(0.0, float(seconds.max()) + plan.cycle_us * 1e-6, bins + 1)
    which = np.clip(np.searchsorted(edges, seconds, "right") - 1, 0, len(edges) - 2)
    totals = [np.zeros((len(edges) - 1, n)) for _ in range(2)] + [np.zeros(len(edges) - 1) for _ in range(2)]
    for total, column in zip(totals, range(1, 5)):
        np.add.at(total, which, np.array([row[column] for row in sums], np.float64))
    return Rates(edges, totals[0], totals[1], totals[2], totals[3], *of_states, *of_classes)


def _truths(recording: Recording, n_classes: int) -> dict[int, int]:
    """The true class of each object, as the decision log has it."""
    rows = recording.decisions()
    known = rows[(rows["truth"] >= 0) & (rows["truth"] < n_classes)]
    return dict(zip(known["object"].tolist(), known["truth"].tolist()))


def _sums(item: Exposures, plan: Plan, n: int, of_states: F64) -> tuple[F64, F64, int, int]:
    """Clicks and exposures of one message per pattern, channel or step; clicks and exposures in the dark. `of_states` (2, states) are
    added to.
    """
    dark = is_dark(item.pattern)
    lit = item.clicks[~dark]
    if plan.channels_at_once > 1:  # exposures in which any of the channels clicked
        lit = np.asarray(lit.any(axis=1))[:, None]
    if plan.mode == "parallel":
        clicks, exposures = lit.sum(axis=0).astype(np.float64), np.full(n, float(len(lit)))
        return clicks, exposures, int(item.clicks[dark].sum()), int(dark.sum()) * n
    shown = item.pattern[~dark]
    if plan.automaton is not None:
        states = np.minimum(item.state[~dark], plan.automaton.n_states - 1)
        np.add.at(of_states[0], states, lit[:, 0])
        np.add.at(of_states[1], states, 1)
        shown = plan.automaton.depth[states]
    shown = np.minimum(shown, n - 1)
    clicks = np.bincount(shown, weights=lit[:, 0], minlength=n).astype(np.float64)
    return (
        clicks,
        np.bincount(shown, minlength=n).astype(np.float64),
        int(item.clicks[dark].any(axis=1).sum()),
        int(dark.sum()),
    )


def add_rates(page: Page, plan: Plan, rates: Rates) -> None:
    """Add clicks per exposure over time."""
    page.heading("Clicks over time")
    what = "channel" if plan.mode == "parallel" else "pattern" if plan.automaton is None else "step of the walk"
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.where(rates.exposures > 0, rates.clicks / rates.exposures, np.nan)
    high = float(np.nanmax(rate)) if np.isfinite(rate).any() else 1.0
    n = rates.clicks.shape[1]
    chart = Chart(
        label=f"Clicks per exposure of each {what} over the run",
        x=Axis("time since the first exposure", 0.0, float(rates.edges_s[-1]), text=seconds),
        y=Axis(what, -0.5, n - 0.5, text=lambda value: f"{value:.0f}"),
        heat=heat_png(rate.T[::-1], 0.0, high or 1.0),
        height=min(420, 110 + 9 * n),
    )
    page.figure(
        chart,
        f"Clicks per exposure of each {what} in {len(rates.clicks)} stretches of the run, from 0 (light) to {high:.3g} (dark). Stripes "
        "from top to bottom are moments in which the light changed; a stripe from left to right that differs from its neighbours is that "
        f"{what} alone.",
    )


def add_dark(page: Page, rates: Rates, summary: Mapping[str, Any]) -> None:
    """Add the dark counts over time as one strip."""
    page.heading("Dark counts")
    if not rates.dark_exposures.sum():
        _empty_fields(page, summary)
        return
    clicks, exposures = int(rates.dark_clicks.sum()), int(rates.dark_exposures.sum())
    low, high = wilson_interval(clicks, exposures)
    told = summary.get("dark", {}).get("expected") if isinstance(summary.get("dark"), Mapping) else None
    expected = float(np.mean(told)) if told is not None else None
    page.text(
        f"{clicks} clicks in {exposures} dark exposures: {clicks / exposures:.3g} per exposure, 95 % interval {low:.3g} to {high:.3g}"
        + ("." if expected is None else f"; expected {expected:.3g}.")
    )
    page.figure(
        dark_chart(rates, expected),
        "Dark clicks per dark exposure in each stretch of the run, with 95 % intervals (Wilson).",
    )
    for words in summary.get("dark", {}).get("present", ()) if isinstance(summary.get("dark"), Mapping) else ():
        page.text(str(words), "warn")


def dark_chart(rates: Rates, expected: float | None) -> Chart:
    """Return the dark rate over time with its interval and what is expected."""
    total = float(rates.dark_exposures.sum())
    group = -(-len(rates.dark_exposures) // int(np.clip(total // DARK_PER_BIN, 1, DARK_BINS)))  # bins to one stretch
    firsts = np.arange(0, len(rates.dark_exposures), group)
    exposures, clicks = (np.add.reduceat(sums, firsts) for sums in (rates.dark_exposures, rates.dark_clicks))
    ends = rates.edges_s[np.minimum(firsts + group, len(rates.edges_s) - 1)]
    some = exposures > 0
    counted = zip(clicks[some].astype(int).tolist(), exposures[some].astype(int).tolist())
    intervals = np.array([wilson_interval(c, n) for c, n in counted])
    centres = ((rates.edges_s[firsts] + ends) / 2)[some]
    rate = clicks[some] / exposures[some]
    top = max(float(intervals[:, 1].max()), 1.2 * (expected or 0.0), 1e-12)
    return Chart(
        label=f"Dark clicks per exposure over the run, {rates.dark_clicks.sum() / rates.dark_exposures.sum():.3g} on average",
        x=Axis("time since the first exposure", 0.0, float(rates.edges_s[-1]), text=seconds),
        y=Axis("dark clicks per exposure", 0.0, min(top, 1.0), text=number),
        curves=[Curve(centres, rate, low=intervals[:, 0], high=intervals[:, 1])],
        marks=[] if expected is None else [Mark(expected, f"expected {expected:.3g}")],
        height=150,
    )


def _empty_fields(page: Page, summary: Mapping[str, Any]) -> None:
    """Without dark slots: what a flow's frames without an object told, channel by channel."""
    dark = summary.get("dark")
    channels = dark.get("channels") or [] if isinstance(dark, Mapping) else []
    if not channels or not channels[0]["exposures"]:
        page.text("The run had no dark slots: nothing is known about dark counts.", "note")
        return
    page.text(
        "The run had no dark slots. Frames in which no object was found tell instead, as the run counted them.", "note"
    )
    rows = [
        (channel, row["clicks"], row["exposures"], f"{row['low']:.3g} to {row['high']:.3g}", f"{row['expected']:.3g}")
        for channel, row in enumerate(channels)
    ]
    page.table(rows, ("channel", "clicks", "frames", "per frame, 95 %", "expected"))
