"""The design of a CUSUM test on clicks: whole-number steps, exact average run lengths, the threshold for a stated false-alarm rate.

Owns the numerics of one Bernoulli CUSUM; never sees a click (cusum.py runs the tests). Page's test of rate p0 against p1 adds the
log likelihood ratio of each exposure and never falls below 0: `S = max(0, S + x)`, alarm at `S >= threshold`. Scaled to whole
numbers, the ratio of the steps is a fraction, so the test that runs is exact integer arithmetic, and so is the chain whose run
length is computed.

Sources: Page, Biometrika 41 (1954); Moustakides, Annals of Statistics 14 (1986): no test of the same false-alarm rate has a
shorter worst mean delay; Reynolds and Stoumbos, Journal of Quality Technology 31 (1999), for Bernoulli steps. Run lengths by
Page's cycles: from 0 a cycle ends at 0 again or at the threshold, so `ARL = mean length of a cycle / probability that it ends
in an alarm`; both are sums of positive terms, which keeps their digits whatever their size (a Brook-Evans matrix does not)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pans.runtime.wire.inner import outer

RATE_MIN, RATE_MAX = 1e-12, 0.5
FINE_RATE = 1e-3  # rarer clicks are designed at this rate and scaled: the Poisson limit, right to about the rate itself
STEP_ERROR = 2e-3  # of the steps' ratio, by rounding to whole numbers
STATES_MAX = 1 << 22
GUARD_RATIO = (
    1.5  # between the rates that are told apart where the expected one is an estimate: nearer ones would need very long
)
ENOUGH_CLICKS = 1e4  # between false alarms: beyond, log(ARL) is a straight line to about 1/ARL (Wald's identity)
_TOLERANCE = 1e-10  # relative, of the sums of a cycle: far below STEP_ERROR
_SWEEPS_MAX = 200_000  # a guard against a sum that does not settle


@dataclass(frozen=True, slots=True)
class CusumDesign:
    """One test: what a click and a silent exposure add (one is negative), the threshold, and exact figures of its run length.

    `rate` is the expected click probability p0, `ratio` is p1/p0; `arl_exposures` the mean number of exposures between false alarms.
    """

    rate: float
    ratio: float
    click_step: int
    silent_step: int
    threshold: int
    arl_exposures: float

    @property
    def rising(self) -> bool:
        """Whether the test looks for more clicks (else for fewer)."""
        return self.click_step > 0

    def delay(self, rate: float) -> float:
        """Mean exposures to an alarm from S = 0 when a click has probability `rate`: the worst case in Lorden's sense."""
        return run_length(rate, self.click_step, self.silent_step, self.threshold)


def design_cusum(rate: float, ratio: float, arl_exposures: float, guard_rate: float | None = None) -> CusumDesign:
    """Return the test of click probability `rate` against `ratio * rate` (above 1: a rise, below: a fall).

    Between false alarms lie `arl_exposures` exposures in the mean, or up to one step of the threshold more. Where `rate` is an
    estimate, `guard_rate` is the end of its interval on the side that is looked at: the promise then holds up to there, and the
    change looked for is at least GUARD_RATIO beyond it. ValueError for figures that make no test.
    """
    if not (RATE_MIN <= rate <= RATE_MAX and rate * ratio < 1 and ratio > 0 and ratio != 1 and arl_exposures >= 1):
        raise ValueError(
            f"no test for rate {rate:g}, ratio {ratio:g}, {arl_exposures:g} exposures between false alarms"
        )
    if guard_rate is not None:
        guard = max(rate, guard_rate) if ratio > 1 else min(rate, guard_rate)
        wanted = rate * ratio
        changed = max(wanted, guard * GUARD_RATIO) if ratio > 1 else min(wanted, guard / GUARD_RATIO)
        rate, ratio = guard, min(changed, 0.5 * (1 + guard)) / guard
    if rate >= FINE_RATE:
        return _design(rate, ratio, arl_exposures)
    scale = FINE_RATE / rate
    fine = _design(FINE_RATE, ratio, max(1.0, arl_exposures / scale))
    sign = 1 if ratio > 1 else -1
    click, silent = sign * round(abs(fine.click_step) * scale), -sign * abs(fine.silent_step)
    return CusumDesign(rate, ratio, click, silent, math.ceil(fine.threshold * scale), fine.arl_exposures * scale)


def _design(rate: float, ratio: float, arl: float) -> CusumDesign:
    """Solve up to ENOUGH_CLICKS between false alarms; beyond, log(ARL) grows along its exact slope, right to about 1/ARL."""
    click, silent = whole_steps(rate, ratio)
    solved = min(arl, ENOUGH_CLICKS / rate)
    threshold = _threshold(rate, click, silent, solved)
    found = run_length(rate, click, silent, threshold)
    slope = growth(rate, click, silent)
    further = max(0, math.ceil(math.log(arl / found) / slope))
    return CusumDesign(rate, ratio, click, silent, threshold + further, found * math.exp(slope * further))


def growth(rate: float, click_step: int, silent_step: int) -> float:
    """Return the w > 0 at which `E exp(w step) = 1`: by how much log(ARL) grows per unit of the threshold (Wald's identity)."""

    def excess(w: float) -> float:
        return rate * math.expm1(w * click_step) + (1 - rate) * math.expm1(w * silent_step)

    high = 1.0 / max(abs(click_step), abs(silent_step))
    while excess(high) <= 0:
        high *= 2
    low = 0.0  # the mean step is below 0, so the excess falls before it rises
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) <= 0 else (low, middle)
    return high


def whole_steps(rate: float, ratio: float) -> tuple[int, int]:
    """Return what a click and a silent exposure add, whole numbers whose ratio is that of the log likelihood ratios to STEP_ERROR."""
    click = math.log(ratio)
    silent = math.log1p(-rate * ratio) - math.log1p(-rate)
    quotient = abs(click / silent)
    for unit in range(1, 1000):
        steps = round(quotient * unit)
        if steps >= 1 and abs(steps / unit - quotient) <= STEP_ERROR * quotient:
            break
    sign = 1 if ratio > 1 else -1
    return sign * steps, -sign * unit


def run_length(rate: float, click_step: int, silent_step: int, threshold: int) -> float:
    """Return the mean number of exposures from S = 0 to the alarm when a click has probability `rate` (inf: it never comes)."""
    up_rate, up, down = (rate, click_step, -silent_step) if click_step > 0 else (1.0 - rate, silent_step, -click_step)
    if threshold <= up:
        return 1.0 / up_rate if up_rate > 0 else math.inf
    if threshold > STATES_MAX:
        raise ValueError(f"a test of {threshold} states, allowed {STATES_MAX}")
    room = np.zeros(threshold), np.zeros(threshold)
    alarm, length = _cycle(up_rate, up, down, *room, _TOLERANCE, _SWEEPS_MAX)
    return length / alarm if alarm > 0 else math.inf


def _threshold(rate: float, click: int, silent: int, arl: float) -> int:
    """A threshold whose run length is at least `arl`, to 1/128 of a click's step: bracketed, then bisected."""
    unit = max(abs(click), abs(silent))
    tolerance = max(1, unit // 128)
    low, high = 0, unit
    while run_length(rate, click, silent, high) < arl:
        low, high = high, high + unit
        if high > STATES_MAX:
            raise ValueError(f"{arl:g} exposures between false alarms need more than {STATES_MAX} states")
    while high - low > tolerance:
        middle = (low + high) // 2
        if run_length(rate, click, silent, middle) < arl:
            low = middle
        else:
            high = middle
    return high


@outer
def _cycle(up_rate, up, down, alarm, length, tolerance, sweeps_max):  # type: ignore[no-untyped-def]
    """Return (probability of an alarm, mean length) of one cycle from 0, by Gauss-Seidel sweeps along the frequent step.

    alarm(s) = a alarm(s + up) + (1 - a) alarm(s - down), length(s) = 1 + the same; at 0 and below, and at the threshold, the
    cycle is over. alarm and length float64 (threshold,) begin as zeros."""
    threshold, down_rate = alarm.size, 1.0 - up_rate
    last_alarm, last_length = -1.0, -1.0
    for _ in range(sweeps_max):
        for index in range(1, threshold):
            s = index if down_rate > up_rate else threshold - index
            hit, more = 0.0, 0.0
            if s + up >= threshold:
                hit = 1.0
            else:
                hit, more = alarm[s + up], length[s + up]
            fall, rest = 0.0, 0.0
            if s > down:
                fall, rest = alarm[s - down], length[s - down]
            alarm[s] = up_rate * hit + down_rate * fall
            length[s] = 1.0 + up_rate * more + down_rate * rest
        change = abs(alarm[up] - last_alarm) + 1e-300
        if change <= tolerance * alarm[up] and abs(length[up] - last_length) <= tolerance * length[up]:
            break
        last_alarm, last_length = alarm[up], length[up]
    return up_rate * alarm[up], 1.0 + up_rate * length[up]
