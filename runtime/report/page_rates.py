"""The report page's part on clicks over time: rates of patterns, channels or steps of a walk, and dark counts.

Owns the sums per time bin, from recorded messages; never draws (figures.py).
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

from . import figures as draw
from .page import Page

BINS = 120
EXPOSURES_PER_BIN = 25  # of each pattern: a rate from fewer is noise
F64 = NDArray[np.float64]


class Rates(NamedTuple):
    """Clicks and exposures per time bin and pattern, channel or step of a walk, and in the dark, (bins, channels) and (bins,).

    Of an automaton also clicks and exposures of each state in the whole run, (states,).
    """

    edges_s: F64
    clicks: F64
    exposures: F64
    dark_clicks: F64
    dark_exposures: F64
    state_clicks: F64
    state_exposures: F64


def count_rates(recording: Recording, plan: Plan) -> Rates:
    """Sum clicks and exposures over at most `BINS` equal stretches of device time; a clock that went back starts no new bin."""
    n = plan.n_patterns if plan.automaton is None else plan.automaton.n_slots
    of_states = np.zeros((2, 0 if plan.automaton is None else plan.automaton.n_states))
    sums: list[tuple[int, F64, F64, int, int]] = []
    for item in iter_exposures(recording, plan):
        if isinstance(item, Exposures):
            sums.append((int(item.start_tick[0]), *_sums(item, plan, n, of_states)))
    if not sums:
        empty = np.zeros((1, n))
        return Rates(np.array([0.0, 1.0]), empty, empty, np.zeros(1), np.zeros(1), *of_states)
    ticks = np.array([row[0] for row in sums], np.int64)
    seconds = np.maximum(ticks - ticks[0], 0) * plan.tick_us * 1e-6
    per_pattern = sum(float(row[2].sum()) for row in sums) / n
    bins = int(np.clip(per_pattern / EXPOSURES_PER_BIN, 1, BINS))
    edges = np.linspace(0.0, float(seconds.max()) + plan.cycle_us * 1e-6, bins + 1)
    which = np.clip(np.searchsorted(edges, seconds, "right") - 1, 0, len(edges) - 2)
    totals = [np.zeros((len(edges) - 1, n)) for _ in range(2)] + [np.zeros(len(edges) - 1) for _ in range(2)]
    for total, column in zip(totals, range(1, 5)):
        np.add.at(total, which, np.array([row[column] for row in sums], np.float64))
    return Rates(edges, totals[0], totals[1], totals[2], totals[3], *of_states)


def _sums(item: Exposures, plan: Plan, n: int, of_states: F64) -> tuple[F64, F64, int, int]:
    """Clicks and exposures of one message per pattern, channel or step; clicks and exposures in the dark. `of_states` (2, states) are
    added to.
    """
    dark = is_dark(item.pattern)
    lit = item.clicks[~dark]
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
    return clicks, np.bincount(shown, minlength=n).astype(np.float64), int(item.clicks[dark].sum()), int(dark.sum())


def add_rates(page: Page, plan: Plan, rates: Rates, summary: Mapping[str, Any]) -> None:
    """Add clicks per exposure over time, and the dark counts."""
    page.heading("Clicks over time")
    what = "channel" if plan.mode == "parallel" else "pattern" if plan.automaton is None else "step of the walk"
    page.figure(
        draw.click_rates(rates.edges_s, rates.clicks, rates.exposures, what),
        f"Clicks per exposure of each {what}, {len(rates.clicks)} bins over the run; right: the mean with its standard error.",
    )
    if not rates.dark_exposures.sum():
        _empty_fields(page, summary)
        return
    page.heading("Dark counts")
    clicks, exposures = int(rates.dark_clicks.sum()), int(rates.dark_exposures.sum())
    low, high = wilson_interval(clicks, exposures)
    expected = summary.get("dark", {}).get("expected") if isinstance(summary.get("dark"), Mapping) else None
    expected = float(np.mean(expected)) if expected is not None else None
    page.text(
        f"{clicks} clicks in {exposures} dark exposures: {clicks / exposures:.3g} per exposure, 95 % interval {low:.3g} to {high:.3g}"
        + ("." if expected is None else f"; expected {expected:.3g}.")
    )
    some = rates.dark_exposures > 0
    counted = zip(rates.dark_clicks[some].astype(int).tolist(), rates.dark_exposures[some].astype(int).tolist())
    intervals = np.array([wilson_interval(c, n) for c, n in counted])
    centres = (rates.edges_s[:-1] + rates.edges_s[1:])[some] / 2
    page.figure(
        draw.dark_rates(centres, rates.dark_clicks[some], rates.dark_exposures[some], intervals, expected),
        "Dark clicks per dark exposure in each stretch of the run.",
    )


def _empty_fields(page: Page, summary: Mapping[str, Any]) -> None:
    """Without dark slots: what a flow's frames without an object told, channel by channel."""
    channels = summary.get("dark", {}).get("channels") or []
    if not channels or not channels[0]["exposures"]:
        page.text("The run had no dark slots: nothing is known about dark counts.", "note")
        return
    page.heading("Dark counts")
    page.text("The run had no dark slots; frames in which no object was found tell, as the run summed it up.", "note")
    rows = [
        (number, row["clicks"], row["exposures"], f"{row['low']:.3g} to {row['high']:.3g}", f"{row['expected']:.3g}")
        for number, row in enumerate(channels)
    ]
    page.table(rows, ("channel", "clicks", "frames", "per frame, 95 %", "expected"))
