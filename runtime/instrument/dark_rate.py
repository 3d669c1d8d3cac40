"""Dark-count monitoring: what the dark slots say about the detector, with intervals.

Owns integer counts of dark exposures and the comparison with the profile's click law; never acts on it. `DarkMonitor.report`
returns facts for the summary, `alarm` a sentence when the dark slots contradict the profile.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pans.runtime.intervals import binomial_tail, wilson_interval

ALARM_PROBABILITY = 1e-6  # of seeing this many dark clicks or more, if the profile's dark rate were right


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
    findings: tuple[
        dict[str, Any], ...
    ] = ()  # states of the detector that began or ended (channel_health.py), in order
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
