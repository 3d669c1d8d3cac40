"""The section on clicks over time, from recorded messages: rates of patterns, channels or steps of a walk, and dark counts."""

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
OBJECTS_KEPT = 1 << 14  # whose true class is remembered: the exposures of an object come soon after its mark
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
    """Sum clicks and exposures over at most `BINS` equal stretches of device time; a clock that went back starts no new bin.

    The messages are read twice, first for the length of the run: what is kept does not grow with it.
    """
    n = plan.n_patterns if plan.automaton is None else plan.automaton.n_slots
    edges = _edges(recording, plan, n)
    bins, first_tick = len(edges) - 1, None
    rates = Rates(
        edges,
        *np.zeros((2, bins, n)),
        *np.zeros((2, bins)),
        *np.zeros((2, 0 if plan.automaton is None else plan.automaton.n_states)),
        *np.zeros((2, n, n_classes if plan.automaton is None else 0)),
    )
    truths: dict[int, int] = {}
    for item in iter_exposures(recording, plan):
        truths |= item.truths
        if not len(item.message_tick):
            continue
        first_tick = int(item.message_tick[0]) if first_tick is None else first_tick
        seconds = np.maximum(item.message_tick - first_tick, 0) * plan.tick_us * 1e-6
        which = np.clip(np.searchsorted(edges, seconds, "right") - 1, 0, bins - 1)
        _add(rates, item, which, plan, _classes(item.object, truths, n_classes))
        while len(truths) > OBJECTS_KEPT:
            del truths[next(iter(truths))]
    return rates


def _edges(recording: Recording, plan: Plan, n: int) -> F64:
    """The ends of the stretches of time: as many as the exposures of each of `n` patterns, channels or steps are enough for."""
    first, last, lit = None, 0, 0
    for item in iter_exposures(recording, plan):
        if len(item.message_tick):
            first = int(item.message_tick[0]) if first is None else first
            last = max(last, int(item.message_tick.max()))
            lit += int((~is_dark(item.pattern)).sum())
    if first is None:
        return np.array([0.0, 1.0])
    per_pattern = lit if plan.mode == "parallel" else lit / n
    bins = int(np.clip(per_pattern / EXPOSURES_PER_BIN, 1, BINS))
    return np.linspace(0.0, (last - first) * plan.tick_us * 1e-6 + plan.cycle_us * 1e-6, bins + 1)


def _classes(objects: NDArray[np.int64], truths: Mapping[int, int], n_classes: int) -> NDArray[np.int64]:
    """The true class of each object, -1 where it is not known."""
    different, at = np.unique(objects, return_inverse=True)
    known = np.array([truths.get(number, -1) for number in different.tolist()], np.int64)
    return np.where(known < n_classes, known, -1)[at]


def _add(rates: Rates, item: Exposures, which: NDArray[np.int64], plan: Plan, truth: NDArray[np.int64]) -> None:
    """Add clicks and exposures of `item`, in the bins `which` and of the classes `truth` (-1: unknown)."""
    dark, (bins, n) = is_dark(item.pattern), rates.clicks.shape
    parallel = plan.mode == "parallel"
    clicks = item.clicks[:, :n] if parallel else np.asarray(item.clicks.any(axis=1))[:, None]  # in any of the channels
    rates.dark_clicks[:] += np.bincount(which[dark], clicks[dark].sum(axis=1), bins)
    rates.dark_exposures[:] += np.bincount(which[dark], minlength=bins) * (n if parallel else 1)
    lit, at, truth = clicks[~dark], which[~dark], truth[~dark]
    if parallel:
        for channel in range(lit.shape[1]):
            _add_lit(rates, at, np.full(len(at), channel), lit[:, channel], truth)
        return
    shown = item.pattern[~dark].astype(np.int64)
    if plan.automaton is not None:
        states = np.minimum(item.state[~dark], plan.automaton.n_states - 1)
        rates.state_clicks[:] += np.bincount(states, lit[:, 0], plan.automaton.n_states)
        rates.state_exposures[:] += np.bincount(states, minlength=plan.automaton.n_states)
        shown = plan.automaton.depth[states].astype(np.int64)
    _add_lit(rates, at, np.minimum(shown, n - 1), lit[:, 0], truth)


def _add_lit(
    rates: Rates, at: NDArray[np.int64], shown: NDArray[np.int64], clicked: NDArray[np.bool_], truth: NDArray[np.int64]
) -> None:
    """Add exposures in the bins `at`, one pattern, channel or step each."""
    bins, n = rates.clicks.shape
    places = at * n + shown
    rates.clicks[:] += np.bincount(places, clicked, bins * n).reshape(bins, n)
    rates.exposures[:] += np.bincount(places, minlength=bins * n).reshape(bins, n)
    if sums := rates.class_clicks.size:
        known = truth >= 0
        places = shown[known] * rates.class_clicks.shape[1] + truth[known]
        rates.class_clicks[:] += np.bincount(places, clicked[known], sums).reshape(rates.class_clicks.shape)
        rates.class_exposures[:] += np.bincount(places, minlength=sums).reshape(rates.class_clicks.shape)


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
