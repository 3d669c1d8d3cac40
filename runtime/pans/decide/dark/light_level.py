"""Change detection on the mean number of clicks per decision, against the level at the beginning of the run, and of that beginning
against what the bundle states.

`LightWatch.take` receives the clicks of decisions and returns what has changed. A different mixture of objects looks like a change of
light, and the words say so. How much of a change of efficiency reaches the clicks depends on the patterns: nearly all of it where an
exposure clicks seldom, almost none where exposures are either dark or saturated (docs/how-to/calibrate.md has figures).

Clicks are summed over batches of decisions, so that the spread between objects is measured and not assumed. The first batches give
mean m and standard deviation s, until m is known to BASELINE_ERROR; then a two-sided CUSUM (Page 1954) sums the deviation beyond half
the change looked for. Its threshold follows from the stated batches between false alarms by Siegmund's approximation (Sequential
Analysis, 1985), with the drift reduced by twice the error of m, because the mean is an estimate.

Until then m is compared with the `stated` mean after 32, 64, 128, ... batches, and at the end. What differs by more than CHANGE, as
another mixture of objects may, and about six standard errors has changed: by Student's t, less than one run in a million says so
whose mean is within CHANGE of the stated one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pans.base.numbers import bisect

CHANGE = 0.06  # of the clicks, relative, looked for
BATCH = 50  # decisions
BASELINE_ERROR = 0.0075  # of the mean
STATED_CHANGE = 0.085  # of the clicks: what a tenth of efficiency does where exposures click seldom
BASELINE_LEAST, BASELINE_MOST = 20, 20_000  # batches
ARL_BATCHES = 1e5
# so many, and this over the number of batches more, as few know their own spread badly
STATED_ERRORS, STATED_FEW = 5.5, 40.0
STATED_FALSE_ALARM = 1e-6  # per run
_OVERSHOOT = 1.166  # Siegmund: how far a sum of normal steps jumps over its boundary, twice


@dataclass(frozen=True, slots=True)
class Baseline:
    """Mean and standard deviation of a batch's clicks, the slack per batch and the threshold of the sums."""

    mean: float
    deviation: float
    slack: float
    threshold: float

    def stated_batches(self, change: float) -> float:
        """Batches after which a lasting relative change is found, in the mean (inf if it is no more than the slack)."""
        gain = abs(change) * self.mean - self.slack
        return math.inf if gain <= 0 else (self.threshold + _OVERSHOOT * self.deviation) / gain


class LightWatch:
    """Follows the clicks of decisions and reports each lasting change of their mean once; `stated` clicks are those to begin with."""

    def __init__(self, batch: int = BATCH, arl_batches: float = ARL_BATCHES, stated: float | None = None) -> None:
        self.batch, self.arl_batches, self.stated = batch, arl_batches, stated
        self.baseline: Baseline | None = None
        self.found: list[dict[str, Any]] = []
        self.decisions = 0
        self._unfinished = np.zeros(0, np.int64)  # clicks of the decisions since the last whole batch
        self._learnt = 0, 0, 0  # batches of the baseline, their clicks and the sum of squares
        self._sums = {"fall": 0.0, "rise": 0.0}
        self._since = {"fall": (0, 0, 0), "rise": (0, 0, 0)}  # decisions, batches and clicks when the sum last was 0
        self._batches = self._total = 0

    def take(self, clicks: npt.ArrayLike) -> list[dict[str, Any]]:
        """Take the clicks of decisions, whole numbers (n,), in the order of time; return the changes found with them."""
        known = len(self.found)
        waiting = np.append(self._unfinished, np.asarray(clicks, np.int64))
        whole = len(waiting) // self.batch * self.batch
        self.decisions -= len(self._unfinished)
        totals = waiting[:whole].reshape(-1, self.batch).sum(axis=1).tolist()
        done = 0
        while done < len(totals):
            if self.baseline is None:
                self.decisions += self.batch
                self._learn(totals[done])
                done += 1
            else:
                done += self._compare(totals[done:], self.baseline)
        self._unfinished = waiting[whole:].copy()
        self.decisions += len(self._unfinished)
        return self.found[known:]

    def report(self) -> dict[str, Any]:
        """What is known: the baseline, how long a change of the clicks by STATED_CHANGE takes to be found, and what was found."""
        base = self.baseline
        return {
            "decisions": self.decisions,
            "clicks_per_decision": None if base is None else base.mean / self.batch,
            "clicks_stated": self.stated,
            "false_alarm_per_run": None if self.stated is None else STATED_FALSE_ALARM,
            "change_of_clicks": STATED_CHANGE,
            "found_after_decisions": None if base is None else base.stated_batches(STATED_CHANGE) * self.batch,
            "false_alarm_every_decisions": self.arl_batches * self.batch,
            "found": self.found,
        }

    def _learn(self, total: int) -> None:
        """Add a batch to the baseline, which is made when its mean is known well enough."""
        n, clicks, squares = self._learnt
        self._learnt = n, clicks, squares = n + 1, clicks + total, squares + total * total
        if n < BASELINE_LEAST:
            return
        mean = clicks / n
        variance = (squares - clicks * mean) / (n - 1)
        deviation = math.sqrt(max(variance, mean, 1.0))
        error = deviation / math.sqrt(n)
        ends = mean > 0 and (error <= BASELINE_ERROR * mean or n >= BASELINE_MOST)
        if self.stated and not self.found and (ends or n.bit_count() == 1):
            wanted = self.stated * self.batch
            if abs(mean - wanted) > CHANGE * wanted + (STATED_ERRORS + STATED_FEW / n) * error:
                self._note(mean / wanted, 0, stated=True)
        if ends:
            self.baseline = make_baseline(mean, deviation, error, self.arl_batches)
            self._since = dict.fromkeys(self._since, (self.decisions, self._batches, self._total))

    def _compare(self, totals: list[int], base: Baseline) -> int:
        """Compare batches with the baseline until a change is found; return how many were compared."""
        (fall, rise), threshold, done, fell, rose = self._sums.values(), base.threshold, 0, -1, -1
        moved = np.array(totals) - base.mean
        for done, (less, more) in enumerate(zip((moved + base.slack).tolist(), (moved - base.slack).tolist())):
            fall -= less
            rise += more
            if fall <= 0.0:
                fall, fell = 0.0, done
            elif fall >= threshold:
                break
            if rise <= 0.0:
                rise, rose = 0.0, done
            elif rise >= threshold:
                break
        for side, at in (("fall", fell), ("rise", rose)):  # the batch with which a sum was 0 last
            if at >= 0:
                self._since[side] = self._after(totals[: at + 1])
        self.decisions, self._batches, self._total = self._after(totals[: done + 1])
        self._sums = {"fall": fall, "rise": rise}
        if max(fall, rise) >= threshold:
            self._report_change("fall" if fall >= threshold else "rise", base)
        return done + 1

    def _after(self, totals: list[int]) -> tuple[int, int, int]:
        """Return decisions, batches and clicks with these batches."""
        return self.decisions + self.batch * len(totals), self._batches + len(totals), self._total + sum(totals)

    def _report_change(self, side: str, base: Baseline) -> None:
        """Note the change, and begin a new baseline: from here on clicks are compared with the new mean."""
        decisions, batches, clicks = self._since[side]
        ratio = (self._total - clicks) / ((self._batches - batches) * base.mean)
        self._note(ratio, decisions, stated=False)
        self.baseline, self._learnt = None, (0, 0, 0)
        self._sums = dict.fromkeys(self._sums, 0.0)

    def _note(self, ratio: float, since: int, *, stated: bool) -> None:
        what = "the bundle states" if stated else "they were at the beginning"
        side = "fall" if ratio < 1 else "rise"
        words = (
            f"clicks per decision {'fell' if side == 'fall' else 'rose'} to {ratio:.3g} of what {what}, since about "
            f"{self.decisions - since} decisions: light source, place of the object, detector efficiency, or other objects; calibrate again"
        )
        found = {"side": side, "ratio": ratio, "decision": self.decisions, "since": since, "words": words}
        self.found.append(found | {"stated": True} if stated else found)


def make_baseline(mean: float, deviation: float, error: float, arl_batches: float) -> Baseline:
    """Return the test for a mean known to `error`: slack of half the change, threshold for `arl_batches` between false alarms
    of both sides.
    """
    slack = 0.5 * CHANGE * mean
    drift = max(slack - 2.0 * error, 0.2 * slack) / deviation

    def excess(boundary: float) -> float:  # Siegmund: ARL of one side = (exp(x) - x - 1) / (2 d^2), x = 2 d (b + 1.166)
        x = 2.0 * drift * (boundary + _OVERSHOOT)
        return (math.inf if x > 600 else (math.exp(x) - x - 1.0) / (2.0 * drift**2)) - 2.0 * arl_batches

    return Baseline(mean, deviation, slack, bisect(excess, 0.0, 1e4) * deviation)
