"""Clicks over time, from recorded exposures as they come: rates of patterns, channels or steps of a walk, and dark counts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import wilson_interval
from pans.decide.plan import Plan
from pans.record.reading import Exposures, is_dark

HEAT_BINS, EXPOSURES_PER_BIN = 120, 25  # of each pattern: a rate from fewer is noise
DARK_BINS, DARK_PER_BIN = 40, 200
LIGHT_BINS, WALKS_PER_BIN = 60, 100
OBJECTS_KEPT = 1 << 14  # whose true class is remembered: the exposures of an object come soon after its mark
BINS = 128
TOLD_APART = 4096  # objects of a stretch that follow one another in number: an interval counts no more of them
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Stretches:
    """Named sums, float64 (BINS, *shape), over equal stretches of something numbered from 0; the stretches double as the numbers grow."""

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        self.width, self.used = 1, 0
        self.sums: dict[str, F64] = {name: np.zeros((BINS, *shape)) for name, shape in shapes.items()}

    def at(self, numbers: I64) -> I64:
        """Return the stretch of each number, after making them wide enough."""
        if not len(numbers):
            return numbers
        while (top := int(numbers.max()) // self.width) >= BINS:
            self.width, self.used = 2 * self.width, -(-self.used // 2)
            for name, one in self.sums.items():
                self.sums[name] = np.concatenate([one[::2] + one[1::2], np.zeros_like(one[::2])])
        self.used = max(self.used, top + 1)
        return np.maximum(numbers, 0) // self.width

    def add(self, name: str, numbers: I64, weights: Any = None) -> None:
        """Add to the sum `name`, of no shape, which begins with the first that is added."""
        self.sums.setdefault(name, np.zeros(BINS))
        places = self.at(numbers)
        self.sums[name] += np.bincount(places, weights, BINS)

    def tell_apart(self, name: str, numbers: I64, things: I64) -> None:
        """Count each of the `things` in the sum `name`, of shape (TOLD_APART,): what is not 0 there are the different ones."""
        places = self.at(numbers)
        np.add.at(self.sums[name], (places, things % TOLD_APART), 1.0)

    def merged(self, most: int) -> Stretches:
        """Return the same in at most `most` stretches."""
        found, times = Stretches(), -(-max(self.used, 1) // max(most, 1))
        firsts = np.arange(0, max(self.used, 1), times)
        found.width, found.used = self.width * times, len(firsts)
        found.sums = {name: np.add.reduceat(one[: max(self.used, 1)], firsts) for name, one in self.sums.items()}
        return found


class Rates:
    """Clicks and exposures over time per pattern, channel or step of a walk ("clicks", "exposures") and in the dark ("dark clicks", ...).

    Of an automaton also those of each state in the whole run, `state_clicks` and `state_exposures` (states,), and the light shown over time
    where `state_light` (states,) says what each state shows, photoelectrons per unit transmission; of fixed patterns the clicks of
    each pattern and true class, `class_clicks` and `class_exposures` (channels, classes). A clock that went back adds to the first stretch.
    """

    def __init__(
        self,
        plan: Plan,
        n_classes: int = 0,
        wanted: Iterable[int] = (),
        left_out: int = 0,
        state_light: F64 | None = None,
    ) -> None:
        self._plan, self._dark, self._wanted, self._left_out = plan, 0, sorted({*wanted}), left_out
        # begin of each `wanted` dark exposure by its number, `left_out` exposures behind a click not counted (as by decide/dark/guard.py)
        self.dark_ticks: dict[int, int] = {}
        self._next, self._clicked = 0, -1  # number of the next exposure, and of the last one with a click
        self._first: int | None = None
        walks, self.parallel = plan.automaton is not None, plan.mode == "parallel"
        self.n = plan.n_patterns if plan.automaton is None else plan.automaton.n_slots
        self.what = "channel" if self.parallel else "step of the walk" if walks else "pattern"
        self.over = Stretches(
            **{"clicks": (self.n,), "exposures": (self.n,), "dark clicks": (), "dark exposures": (), "light": ()}
        )
        n_states = 0 if plan.automaton is None else plan.automaton.n_states
        self.state_clicks, self.state_exposures = np.zeros((2, n_states))
        self._state_light = state_light
        self.class_clicks, self.class_exposures = np.zeros((2, self.n, 0 if walks else n_classes))
        self._truths: dict[int, int] = {}

    def take(self, item: Exposures) -> None:
        """Add the next exposures."""
        self._truths |= item.truths
        if not len(item.message_tick):
            return
        plan = self._plan
        if self._first is None:
            self._first = int(item.message_tick[0])
        cycles = np.maximum(item.message_tick - self._first, 0) * (plan.tick_us / plan.cycle_us)
        where, dark = self.over.at(cycles.astype(np.int64)), is_dark(item.pattern)
        # in any of the channels, where one pattern after the other is shown
        clicks = item.clicks[:, : self.n] if self.parallel else np.asarray(item.clicks.any(axis=1))[:, None]
        sums = self.over.sums
        sums["dark clicks"] += np.bincount(where[dark], clicks[dark].sum(axis=1), BINS)
        sums["dark exposures"] += np.bincount(where[dark], minlength=BINS) * (self.n if self.parallel else 1)
        begins = item.start_tick[dark & (self._silent_before(item) >= self._left_out)]
        for number in self._wanted:
            if 0 <= number - self._dark < len(begins):
                self.dark_ticks[number] = int(begins[number - self._dark])
        self._dark += len(begins)
        lit, at, truth = clicks[~dark], where[~dark], self._classes(item.object[~dark])
        if self.parallel:
            for channel in range(lit.shape[1]):
                self._add(at, np.full(len(at), channel), lit[:, channel], truth)
        else:
            shown = item.pattern[~dark].astype(np.int64)
            if plan.automaton is not None:
                states = np.minimum(item.state[~dark], plan.automaton.n_states - 1)
                np.add.at(self.state_clicks, states, lit[:, 0])
                np.add.at(self.state_exposures, states, 1)
                if self._state_light is not None:
                    self.over.sums["light"] += np.bincount(at, self._state_light[states], BINS)
                shown = plan.automaton.depth[states].astype(np.int64)
            self._add(at, np.minimum(shown, self.n - 1), lit[:, 0], truth)
        while len(self._truths) > OBJECTS_KEPT:
            del self._truths[next(iter(self._truths))]

    def _silent_before(self, item: Exposures) -> I64:
        """How many exposures without a click are known directly before each; 0 where some are missing."""
        number, clicked = item.number, np.where(item.clicks.any(axis=1), item.number, -1)
        gap = np.diff(number, prepend=self._next - 1) != 1
        self._clicked = self._clicked if number[0] >= self._next else -1  # another stream
        last = np.maximum.accumulate(np.maximum(np.where(gap, number - 1, -1), np.append(self._clicked, clicked[:-1])))
        self._next, self._clicked = int(number[-1]) + 1, int(max(last[-1], clicked[-1]))
        return np.asarray(number - 1 - last, np.int64)

    def _classes(self, objects: I64) -> I64:
        """The true class of each object, -1 where it is not known."""
        different, at = np.unique(objects, return_inverse=True)
        known = np.array([self._truths.get(number, -1) for number in different.tolist()], np.int64)
        return np.where(known < self.class_clicks.shape[1], known, -1)[at]

    def _add(self, at: I64, shown: I64, clicked: NDArray[np.bool_], truth: I64) -> None:
        """Add exposures in the stretches `at`, one pattern, channel or step each."""
        np.add.at(self.over.sums["clicks"], (at, shown), clicked)
        np.add.at(self.over.sums["exposures"], (at, shown), 1)
        known = truth >= 0
        np.add.at(self.class_clicks, (shown[known], truth[known]), clicked[known])
        np.add.at(self.class_exposures, (shown[known], truth[known]), 1)

    def _edges(self, over: Stretches) -> F64:
        return np.arange(over.used + 1, dtype=np.float64) * (over.width * self._plan.cycle_us * 1e-6)

    def heat(self) -> dict[str, Any]:
        """Return clicks per exposure over time (`rate`, stretches last), the largest, when the run ended, and how many stretches it has."""
        exposures = float(self.over.sums["exposures"].sum()) / self.n
        over = self.over.merged(int(np.clip(exposures / EXPOSURES_PER_BIN, 1, HEAT_BINS)))
        with np.errstate(invalid="ignore", divide="ignore"):
            rate = over.sums["clicks"] / over.sums["exposures"]
        high = float(np.nanmax(rate)) if np.isfinite(rate).any() else 0.0
        return {"rate": rate.T, "high": high, "end_s": float(self._edges(over)[-1]), "stretches": over.used}

    def dark(self) -> tuple[int, int, float, float] | None:
        """Return clicks and dark exposures, and the 95 % interval of their ratio; None without dark exposures."""
        clicks, exposures = (int(self.over.sums[f"dark {what}"].sum()) for what in ("clicks", "exposures"))
        return (clicks, exposures, *wilson_interval(clicks, exposures)) if exposures else None

    def dark_over(self) -> dict[str, Any]:
        """Return the dark rate over time with its interval, NaN without a click, its least and largest figure, and when the run ended.

        The last stretch is one with the one before where it has not half as many dark exposures.
        """
        total = float(self.over.sums["dark exposures"].sum())
        over = self.over.merged(int(np.clip(total / DARK_PER_BIN, 1, DARK_BINS)))
        exposures = over.sums["dark exposures"]
        firsts = np.flatnonzero(exposures)
        firsts = firsts[:-1] if len(firsts) > 1 and 2 * exposures[firsts[-1]] < exposures[firsts[-2]] else firsts
        edges = np.append(self._edges(over)[firsts], self._edges(over)[-1])
        clicks, exposures = (np.add.reduceat(over.sums[f"dark {what}"], firsts) for what in ("clicks", "exposures"))
        low, high = np.array([wilson_interval(int(c), int(n)) for c, n in zip(clicks, exposures)]).T
        rate = np.where(clicks > 0, clicks / exposures, np.nan)
        found = {"seconds": (edges[1:] + edges[:-1]) / 2, "rate": rate, "low": low, "high": high, "end_s": edges[-1]}
        return found | {"least": low[low > 0].min(initial=high.max()), "most": high.max()}

    def walks_over(self) -> dict[str, Any] | None:
        """Return how often state 0 clicked over time, with its interval, and the illumination per walk (`light`, None where not known).

        None of fixed patterns, and of a run too short for two stretches.
        """
        if self._plan.automaton is None:
            return None
        walks = float(self.over.sums["exposures"][:, 0].sum())
        over = self.over.merged(int(np.clip(walks // WALKS_PER_BIN, 1, LIGHT_BINS)))
        some = over.sums["exposures"][:, 0] > 0
        if some.sum() < 2:
            return None
        clicks, begun = (over.sums[name][some, 0] for name in ("clicks", "exposures"))
        low, high = np.array([wilson_interval(int(c), int(n)) for c, n in zip(clicks, begun)]).T
        edges = self._edges(over)
        middles = ((edges[1:] + edges[:-1]) / 2)[some]
        light = None if self._state_light is None else over.sums["light"][some] / begun
        rate = {"rate": clicks / begun, "low": low, "high": high, "mean": float(clicks.sum()) / walks}
        return {"seconds": middles, **rate, "light": light, "end_s": float(edges[-1])}

    def seconds_at(self, number: int | None) -> float | None:
        """Return when a `wanted` dark exposure began, seconds since the first exposure; None where the recording does not have it."""
        return self.since_begin(self.dark_ticks[number]) if number in self.dark_ticks else None

    def since_begin(self, tick: int) -> float | None:
        """Return the seconds from the first exposure to `tick`; None before it, as of a clock that has begun anew."""
        return None if self._first is None or tick < self._first else (tick - self._first) * self._plan.tick_us * 1e-6

    def of_state(self, state: int) -> str:
        """Return which share of the walks came to a state of the automaton, and how often it clicked."""
        exposures, clicks = float(self.state_exposures[state]), float(self.state_clicks[state])
        share = f"{100 * exposures / max(float(self.state_exposures[0]), 1.0):.0f} % of the walks"
        return f"{share}, clicked in {100 * clicks / exposures:.0f} %" if exposures else "never shown"
