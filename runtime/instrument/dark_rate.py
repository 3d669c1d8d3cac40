"""Dark-count monitoring: what the dark slots say about the detector, with intervals.

Owns integer counts of dark exposures and the comparison with the profile's click law; never acts on it. `DarkMonitor.report`
returns facts for the summary, `alarm` a sentence when the dark slots contradict the profile.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

ALARM_PROBABILITY = 1e-6  # of seeing this many dark clicks or more, if the profile's dark rate were right
Z_95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class DarkReport:
    """Clicks in dark exposures: the estimate per exposure with its 95 % Wilson interval, beside what the profile says."""

    exposures: int
    clicks: int
    per_exposure: float
    low: float
    high: float
    expected: float
    alarm: str
    policy: str = "warn"
    findings: tuple[dict[str, Any], ...] = ()  # states of the detector that began or ended (channels.py), in order
    present: tuple[str, ...] = ()  # those that last, in words
    channels: tuple[
        dict[str, float], ...
    ] = ()  # exposures, clicks, rate and its interval by channel, where a guard watched


class DarkMonitor:
    """Compares tallied dark clicks with the click probability `expected` of a dark exposure."""

    def __init__(self, expected: float) -> None:
        self.expected = expected

    def report(self, exposures: int, clicks: int) -> DarkReport:
        """Return the estimate, its interval and, where the counts contradict the profile, the alarm's sentence ("" if none)."""
        low, high = wilson_interval(clicks, exposures)
        rate = clicks / exposures if exposures else 0.0
        alarm = ""
        if exposures and binomial_tail(clicks, exposures, self.expected) < ALARM_PROBABILITY:
            alarm = (
                f"{clicks} clicks in {exposures} dark exposures, expected are {self.expected * exposures:.3g}: "
                "look for stray light, a warm detector or a wrong threshold"
            )
        return DarkReport(exposures, clicks, rate, low, high, self.expected, alarm)


def wilson_interval(clicks: int, exposures: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a click probability (Wilson 1927); (0, 1) without data."""
    if exposures == 0:
        return 0.0, 1.0
    z2 = Z_95 * Z_95
    rate = clicks / exposures
    centre = (rate + z2 / (2 * exposures)) / (1 + z2 / exposures)
    half = Z_95 / (1 + z2 / exposures) * math.sqrt(rate * (1 - rate) / exposures + z2 / (4 * exposures**2))
    return (0.0 if clicks == 0 else centre - half), (1.0 if clicks == exposures else centre + half)


def binomial_tail(clicks: int, exposures: int, probability: float) -> float:
    """Return P(X >= clicks) for X ~ Binomial(exposures, probability).

    Terms are summed from the first down their geometric decay in log space, so that tails down to 1e-300 keep their digits; below, 0.
    """
    if clicks <= 0:
        return 1.0
    if probability <= 0.0:
        return 0.0
    if probability >= 1.0 or clicks <= exposures * probability:
        return 1.0  # at or below the mean nothing is alarming: the exact value, at least about a half, is not needed
    log_term = (
        math.lgamma(exposures + 1)
        - math.lgamma(clicks + 1)
        - math.lgamma(exposures - clicks + 1)
        + clicks * math.log(probability)
        + (exposures - clicks) * math.log1p(-probability)
    )
    odds = probability / (1.0 - probability)
    total, term, k = 1.0, 1.0, clicks
    while k < exposures and term > 1e-17 * total:
        term *= odds * (exposures - k) / (k + 1)
        total += term
        k += 1
    return min(1.0, math.exp(log_term) * total) if log_term > -700 else 0.0
