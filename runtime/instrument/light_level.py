"""Is the light still what was calibrated? Change detection on the mean number of clicks per decision.

Owns sums of clicks and their comparison with the run's own beginning, whose level the calibration states; never knows the
objects, so that a change of their mixture looks like a change of light, and the words say so. Nothing is decided by it.

How much of a change of efficiency is seen in the clicks depends on the patterns: nearly all of it where an exposure clicks
seldom, next to nothing where objects make it either dark or saturated (docs/how-to/calibrate.md has figures).

Clicks are added up over batches of decisions, so that the spread between objects is measured and not assumed. The first batches
give mean m and standard deviation s, until m is known to BASELINE_ERROR; then a two-sided CUSUM (Page 1954) sums the deviation
beyond half the change looked for. Its threshold follows from the stated batches between false alarms by Siegmund's
approximation (Sequential Analysis, 1985), with the drift made smaller by twice the error of m: the price of a mean that is an
estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

CHANGE = 0.06  # of the clicks, relative, looked for
BATCH = 50  # decisions
BASELINE_ERROR = 0.0075  # of the mean
STATED_CHANGE = 0.085  # of the clicks: what a tenth of efficiency does where exposures click seldom
BASELINE_LEAST, BASELINE_MOST = 20, 20_000  # batches
ARL_BATCHES = 1e5
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
    """Follows the clicks of decisions; `take` returns words when the mean has changed, once for each direction."""

    def __init__(self, batch: int = BATCH, arl_batches: float = ARL_BATCHES) -> None:
        self.batch, self.arl_batches = batch, arl_batches
        self.baseline: Baseline | None = None
        self.found: list[dict[str, Any]] = []
        self.decisions = 0
        self._clicks = self._in_batch = 0
        self._n, self._sum, self._squares = 0, 0, 0
        self._low = self._high = 0.0  # sums of the falls and of the rises
        self._since = {"fall": (0, 0, 0), "rise": (0, 0, 0)}  # decisions, batches and clicks when the sum last was 0
        self._batches = self._total = 0
        self._order = np.arange(1, dtype=np.uint32)

    def take(self, clicks: int) -> str:
        """Take one decision's clicks; return a sentence when a change has been found, else ""."""
        self.decisions += 1
        self._clicks += clicks
        self._in_batch += 1
        if self._in_batch < self.batch:
            return ""
        total, self._clicks, self._in_batch = self._clicks, 0, 0
        if self.baseline is None:
            self._learn(total)
            return ""
        return self._compare(total, self.baseline)

    def take_many(
        self, rows: npt.NDArray[np.void], left_out: int, numbers: npt.NDArray[np.uint32] | None = None
    ) -> list[dict[str, Any]]:
        """Take many decisions, rows (n,) with fields `clicks` and `flags`, but those with one of the flags `left_out`: as `take` of each.

        With `numbers` uint32 (m,), the decisions are rows[numbers]. Returns what was found.
        """
        from . import light_kernels as kernels  # numba is loaded only by who takes many at once

        numbers = self._in_order(len(rows)) if numbers is None else numbers
        known, at, levels = len(self.found), 0, np.empty(kernels.N_LEVELS)
        levels[kernels.ERROR :] = BASELINE_ERROR, BASELINE_LEAST, BASELINE_MOST
        while True:
            base, sums = self.baseline, (self._n, self._sum, self._squares)
            since = (*self._since["fall"], *self._since["rise"])
            batch = (self.decisions, self._clicks, self._in_batch)
            counts = np.array([*batch, *sums, self._batches, self._total, *since, self.batch], np.int64)
            levels[: kernels.ERROR] = (
                self._low,
                self._high,
                *((math.nan, 0.0, 0.0) if base is None else (base.mean, base.slack, base.threshold)),
            )
            at, why = kernels.take_clicks(rows, numbers, np.uint32(left_out), at, counts, levels)
            self._go_on(counts.tolist(), levels.tolist())
            if why == kernels.LEARNT:
                self._learnt()
            elif why != kernels.ALL_TAKEN:
                assert base is not None
                self._tell("fall" if why == kernels.FELL else "rise", base)
            else:
                return self.found[known:]

    def _in_order(self, n: int) -> npt.NDArray[np.uint32]:
        """Return 0 to n - 1."""
        if n > len(self._order):
            self._order = np.arange(max(n, 2 * len(self._order)), dtype=np.uint32)
        return self._order[:n]

    def _go_on(self, counts: list[int], levels: list[float]) -> None:
        self.decisions, self._clicks, self._in_batch, self._n, self._sum, self._squares, self._batches, self._total = (
            counts[:8]
        )
        self._since = {"fall": (counts[8], counts[9], counts[10]), "rise": (counts[11], counts[12], counts[13])}
        self._low, self._high = levels[:2]

    def report(self) -> dict[str, Any]:
        """What is known: the baseline, how long a change of the clicks by STATED_CHANGE takes to be found, and what was found."""
        base = self.baseline
        return {
            "decisions": self.decisions,
            "clicks_per_decision": None if base is None else base.mean / self.batch,
            "change_of_clicks": STATED_CHANGE,
            "found_after_decisions": None if base is None else base.stated_batches(STATED_CHANGE) * self.batch,
            "false_alarm_every_decisions": self.arl_batches * self.batch,
            "found": self.found,
        }

    def _learn(self, total: int) -> None:
        self._n, self._sum, self._squares = self._n + 1, self._sum + total, self._squares + total * total
        if self._n >= BASELINE_LEAST:
            self._learnt()

    def _learnt(self) -> None:
        """Make the baseline, if its mean is known well enough."""
        mean = self._sum / self._n
        variance = (self._squares - self._sum * mean) / (self._n - 1)
        deviation = math.sqrt(max(variance, mean, 1.0))
        error = deviation / math.sqrt(self._n)
        if mean > 0 and (error <= BASELINE_ERROR * mean or self._n >= BASELINE_MOST):
            self.baseline = make_baseline(mean, deviation, error, self.arl_batches)
            self._since = {side: (self.decisions, 0, 0) for side in self._since}

    def _compare(self, total: int, base: Baseline) -> str:
        self._batches, self._total = self._batches + 1, self._total + total
        self._low = max(0.0, self._low + base.mean - total - base.slack)
        self._high = max(0.0, self._high + total - base.mean - base.slack)
        for side, value in (("fall", self._low), ("rise", self._high)):
            if value == 0.0:
                self._since[side] = (self.decisions, self._batches, self._total)
            elif value >= base.threshold:
                return self._tell(side, base)
        return ""

    def _tell(self, side: str, base: Baseline) -> str:
        decisions, batches, clicks = self._since[side]
        ratio = (self._total - clicks) / ((self._batches - batches) * base.mean)
        words = (
            f"clicks per decision {'fell' if side == 'fall' else 'rose'} to {ratio:.3g} of what they were at the beginning, since about "
            f"{self.decisions - decisions} decisions: light source, alignment or detector efficiency, or other objects; calibrate again"
        )
        self.found.append(
            {"side": side, "ratio": ratio, "decision": self.decisions, "since": decisions, "words": words}
        )
        self.baseline, self._n, self._sum, self._squares = None, 0, 0, 0  # from here on against the new mean
        self._low = self._high = 0.0
        return words


def make_baseline(mean: float, deviation: float, error: float, arl_batches: float) -> Baseline:
    """Return the test for a mean known to `error`: slack of half the change, threshold for `arl_batches` between false alarms
    of both sides.
    """
    slack = 0.5 * CHANGE * mean
    drift = max(slack - 2.0 * error, 0.2 * slack) / deviation
    low, high = 0.0, 1e4
    for _ in range(200):  # Siegmund: ARL of one side = (exp(2 d b) - 2 d b - 1) / (2 d^2), b = threshold + 1.166
        middle = 0.5 * (low + high)
        exponent = 2.0 * drift * (middle + _OVERSHOOT)
        arl = math.inf if exponent > 600 else (math.exp(exponent) - exponent - 1.0) / (2.0 * drift**2)
        low, high = (middle, high) if arl < 2.0 * arl_batches else (low, middle)
    return Baseline(mean, deviation, slack, high * deviation)
