"""Change detection on how often the states of an automaton click, against how often the same states clicked before in the run.

An automaton makes up for lost light: it shows brighter patterns, and the clicks of a walk stay. The state with which a walk begins cannot,
and of each further state the clicks fall, given that it is shown. `StateWatch.take` gets the exposures and clicks of each state since the
run began and returns what has changed; it needs no message by itself, so that nothing is done between two looks.

The latest 1, 2, 4, 8, ... stretches are compared with all before them by the test of Mantel and Haenszel (Journal of the National
Cancer Institute 22, 719, 1959), each state a stratum: clicks expected from the states that were shown, if each clicked as often as before.
A stretch is `walks` long; the latest 2^j are looked at after every 2^(j-1). So few comparisons come in a week that the bound of Bernstein
(1924) on a sum of bounded steps, `found_at`, keeps one false alarm of all of them per `week_walks`.

It assumes that objects come in no order over the stretches compared. Objects that stay for several walks, and a mix that changes slowly,
spread the stretches more than chance does: for each length the mean square of the comparisons so far, of this length or a shorter one, is
measured before the stretches that are tested, and the test is wider by it. A change of the clicks by TOLERATED or less is none.

Until something has changed, state 0 is also compared with the `stated` share of walks in which it clicks. One walk of another object each
has the variance p (1 - p), whatever the objects; walks of objects that were seen before add nothing that can be relied on, so that as many
walks count as there are different objects. What differs by STATED_TOLERATED or less, as another mixture of objects may, is as stated.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

TOLERATED = 0.01  # of the clicks expected from the states shown: as much as 5 % of the light of the shipped automaton
STATED_TOLERATED = 0.05  # of the stated share: 14 % of the light of the shipped automaton
LOOK_S = 0.5  # of walks in a stretch: two looks per second take about 1 ms
LEAST_WALKS, LEAST_VISITS = 64, 8  # in a stretch: walks, and objects
LEARNT = 16  # comparisons of one length, from which their spread is known to about a third
STATES_WATCHED = 4096  # the first ones, which most walks come to
# Of all lengths, comparisons per look: 1 + 1 + 1/2 + 1/4 + ...; of two sides each
COMPARED = 2 * 3.0
WEEK_S = 604_800.0
Squares = dict[int, tuple[int, float]]  # by length: how many comparisons, and the sum of their squares

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]


def found_at(variance: float, looks: float) -> float:
    """Return how far a sum of 0 mean whose steps are at most 1 goes by chance once in `looks` looks, at most: Bernstein's bound.

    P(sum >= z sqrt(V) + z^2 / 3) <= exp(-z^2 / 2), of all COMPARED comparisons of a look.
    """
    square = 2.0 * math.log(COMPARED * max(looks, 1.0))
    return math.sqrt(square * variance) + square / 3.0


class StateWatch:
    """Follows `n_states` states over a run; `walks` in a stretch, `week_walks` in the time for one false alarm."""

    def __init__(self, n_states: int, walks: int, week_walks: float) -> None:
        self.walks, self.looks_per_week = max(1, walks), week_walks / max(1, walks)
        self.found: list[dict[str, Any]] = []
        self.stated: tuple[float, float] | None = None  # ends of the share of walks whose state 0 clicks
        self.walks_per_object, self.objects = 1, math.inf  # different objects, as far as is known
        n = min(n_states, STATES_WATCHED)
        self._seen: I64 = np.zeros((2, n), np.int64)  # exposures and clicks at the last look
        self._sums: F64 = np.zeros((2, n))  # those that count
        self._walks_before = 0  # that count no more
        self._looks, self._squares = 0, Squares()
        self._kept = dict[int, tuple[F64, Squares]]()  # sums and squares as they were at some of the looks

    @staticmethod
    def of_pace(n_states: int, walks_hz: float, trials: int) -> StateWatch:
        """Return the watch of an automaton that walks `walks_hz` times per second, `trials` times before each object."""
        walks = max(LEAST_WALKS, LEAST_VISITS * trials, math.ceil(LOOK_S * walks_hz))
        watch = StateWatch(n_states, walks, WEEK_S * walks_hz)
        watch.walks_per_object = trials
        return watch

    def is_due(self, begun: int) -> bool:
        """Whether there is something to look at, after so many walks have shown their first state."""
        return begun - int(self._seen[0, 0]) >= self.walks

    def take(self, shown: I64, clicked: I64, *, counts: bool = True) -> list[dict[str, Any]]:
        """Take exposures and clicks of each state since the run began, int64 (states,); return what has changed.

        With `counts` False, what came since the last look is left out.
        """
        now: I64 = np.stack([shown[: self._seen.shape[1]], clicked[: self._seen.shape[1]]])
        fresh, self._seen = now - self._seen, now
        if not counts:
            self._walks_before += int(fresh[0, 0])
            return []
        self._sums = self._sums + fresh
        self._looks += 1
        self._kept[self._looks] = self._sums, dict(self._squares)
        known = len(self.found)
        self._compare_stated()
        for level in range(self._looks.bit_length()):
            if self._looks % (1 << max(level - 1, 0)) == 0 and (1 << level) < self._looks:
                self._compare(level)
                if any(not one.get("stated") for one in self.found[known:]):
                    self._walks_before += int(self._sums[0, 0])
                    self._restart()
                    return self.found[known:]
        self._kept = {at: one for at, one in self._kept.items() if at + 2 * (at & -at) > self._looks}
        return self.found[known:]

    def report(self) -> dict[str, Any]:
        """Return what was watched, the smallest change of the clicks of the second half that is found now, and what was found."""
        exposures, clicks = self._sums
        half = float(_spread(exposures / 2, clicks / 2, exposures / 2, clicks / 2)[1])
        expected = float(clicks.sum()) / 4
        wide = _width(self._squares, self._looks.bit_length())
        enough = self._looks >= 2 * LEARNT and expected > 0
        least = TOLERATED + found_at(half * wide, self.looks_per_week) / expected if enough else None
        begun = float(exposures[0]) if len(exposures) else 0.0
        return {
            "walks": self._walks_before + int(begun),
            "first_state_clicked": float(clicks[0]) / begun if begun else None,
            "first_state_stated": None if self.stated is None else list(self.stated),
            "change_found": least,
            "false_alarm_every_walks": self.looks_per_week * self.walks,
            "found": self.found,
        }

    def _restart(self) -> None:
        self._sums = np.zeros_like(self._sums)
        self._looks, self._squares, self._kept = 0, Squares(), {}

    def _compare_stated(self) -> None:
        """Compare how often state 0 clicked since the run began with what is stated, until something is found."""
        walks, clicks = self._sums[:, 0].tolist()
        different = min(walks / self.walks_per_object, self.objects)
        if self.stated is None or self.found or different < 1:
            return
        share = clicks / walks
        wanted = float(np.clip(share, *self.stated))
        chance = found_at(different * wanted * (1 - wanted), self.looks_per_week) / different
        if abs(share - wanted) <= STATED_TOLERATED * wanted + chance:
            return
        ratio, side = share / max(wanted, 1e-300), "fall" if share < wanted else "rise"
        words = (
            f"state 0, with which every walk begins, clicked in {100 * share:.3g} % of {int(walks)} walks, {ratio:.3g} of what is stated: "
            "light source, place of the object, detector efficiency, or other objects; calibrate again"
        )
        found = {"side": side, "ratio": ratio, "decision": self._walks_before + int(walks), "since": 0, "words": words}
        self.found.append(found | {"stated": True, "objects": int(different)})

    def _compare(self, level: int) -> None:
        """Compare the latest 2^`level` stretches with all before them."""
        before, squares = self._kept[self._looks - (1 << level)]
        latest = self._sums - before
        score, variance, weight = _spread(*before, *latest)
        if variance <= 0:
            return
        allowed = TOLERATED * weight + found_at(variance * _width(squares, level), self.looks_per_week)
        if squares.get(0, (0, 0.0))[0] >= LEARNT and abs(score) > allowed:
            self._note(latest, before, score)
        if self._looks % (1 << level) == 0:
            n, total = self._squares.get(level, (0, 0.0))
            self._squares[level] = n + 1, total + score**2 / variance

    def _note(self, latest: F64, before: F64, score: float) -> None:
        with np.errstate(invalid="ignore", divide="ignore"):
            wanted = np.where(before[0] > 0, latest[0] * before[1] / before[0], 0.0)
        here = before[0] > 0
        ratio = float(latest[1][here].sum() / max(float(wanted.sum()), 1e-300))
        first = [f"{100 * one[1, 0] / max(one[0, 0], 1.0):.3g} %" for one in (before, latest)]
        side = "fall" if score < 0 else "rise"
        decision, since = (self._walks_before + int(one) for one in (self._sums[0, 0], before[0, 0]))
        causes = "less light (lamp, shutter, place of the object, detector efficiency), or other objects"
        if side == "rise":
            causes = "more light, stray light, dark counts, or other objects"
        words = (
            f"the states of the walks clicked {ratio:.3g} times as often as the same states before, in the last {decision - since} walks "
            f"(state 0 in {first[1]}, before in {first[0]}): {causes}; calibrate again"
        )
        self.found.append({"side": side, "ratio": ratio, "decision": decision, "since": since, "words": words})


def _width(squares: Squares, level: int) -> float:
    """Return how much wider than by chance stretches of 2^`level` and shorter spread, at least 1."""
    return max([1.0, *(total / n for at, (n, total) in squares.items() if at <= level and n >= LEARNT)])


def _spread(n0: F64, c0: F64, n1: F64, c1: F64) -> tuple[float, float, float]:
    """Return the clicks of the latter exposures beyond what both together expect, the variance of that, and what TOLERATED is a part of.

    n0, n1 exposures and c0, c1 clicks (states,) of each state before and since.
    """
    n, c = n0 + n1, c0 + c1
    some = n > 1
    n, c, n0, n1, c1 = n[some], c[some], n0[some], n1[some], c1[some]
    part = n0 * n1 / n
    share = c / n
    score = float((c1 - n1 * share).sum())
    variance = float((part * share * (n - c) / (n - 1)).sum())
    return score, variance, float((part * share).sum())
