"""The dark-count watch against a simulated detector: false alarms, delay to a doubled rate, and what an estimated rate costs.

Owns the measurement; the clicks are drawn by the simulator's own generator (SIMULATED), the watch is the runtime's, exposure by
exposure. The optimum beside the delay is exact: the mean delay, from the worst state, of the CUSUM that knows both rates and
has the same false-alarm rate (no test has a shorter one: Moustakides 1986). It fails when a bar is missed: false alarms
within a factor 1.5 of the stated rate, delay at most 1.25 times the optimum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.options import option
from pans.firmware_sim.scene.detector_kernels import click_thresholds, plain_words
from pans.firmware_sim.scene.detector_model import CLICK_STREAM, stream_key
from pans.runtime.instrument.cusum import ChannelWatch, WatchSettings, design_cusum
from pans.runtime.intervals import wilson_interval

from . import Report, Trial, rows_report

BATCH = 1 << 20
FACTOR, DELAY_FACTOR = 1.5, 1.25  # the bars: of the stated false-alarm rate, and of the optimal delay
DOUBLED = 2.0


class DarkCase(NamedTuple):
    """One detector: expected clicks per dark exposure, channels, and the stated mean exposures between false alarms."""

    rate: float
    channels: int
    arl_exposures: float


CASES = (DarkCase(1e-4, 1, 1e6), DarkCase(1e-2, 1, 5e5), DarkCase(1e-4, 8, 1e6), DarkCase(1e-2, 8, 5e5))
ESTIMATES = (100, 400)  # dark clicks that the rate was estimated from


class Detector:
    """Dark exposures of one simulated detector, drawn one after another with a rate that may change."""

    def __init__(self, channels: int, seed: int) -> None:
        self._channels, self._key, self._next = channels, np.uint64(stream_key(seed, CLICK_STREAM)), 0

    def expose(self, n: int, rate: float) -> NDArray[np.uint8]:
        """Return the next `n` exposures at `rate`, words uint8 (n, bytes)."""
        words = np.zeros((n, -(-self._channels // 8)), np.uint8)
        thresholds = click_thresholds(np.full((1, self._channels), rate))
        plain_words(thresholds, np.zeros(n, np.int64), self._key, self._next, words)
        self._next += n
        return words


def count_false_alarms(watch: ChannelWatch, rate: float, exposures: int, seed: int) -> int:
    """Return how many alarms `exposures` dark exposures at `rate` give."""
    detector = Detector(watch.n_channels, seed)
    alarms = 0
    for first in range(0, exposures, BATCH):
        alarms += len(watch.update_words(detector.expose(min(BATCH, exposures - first), rate)))
    return alarms


def delay_to_change(watch: ChannelWatch, before: int, rates: tuple[float, float], seed: int) -> int:
    """Return the exposures from a change of the rate after `before` exposures to the first alarm behind it."""
    detector = Detector(watch.n_channels, seed)
    if before:
        watch.update_words(detector.expose(before, rates[0]))
    step = max(64, int(20 / rates[1]))
    while True:
        alarms = watch.update_words(detector.expose(step, rates[1]))
        if alarms:
            return alarms[0].exposure - before


def false_alarm_row(case: DarkCase, exposures: int, seed: int) -> dict[str, Any]:
    """Measure the false alarms of a watch that knows its rate."""
    watch = ChannelWatch(case.channels, np.full(case.channels, case.rate), WatchSettings(case.arl_exposures))
    alarms = count_false_alarms(watch, case.rate, exposures, seed)
    stated = exposures / case.arl_exposures
    return {
        "name": "false alarms",
        **case._asdict(),
        "exposures": exposures,
        "alarms": alarms,
        "stated": stated,
        "factor": alarms / stated,
        "fine": 1 / FACTOR <= alarms / stated <= FACTOR,
    }


def delay_rows(case: DarkCase, changes: int, seed: int) -> list[dict[str, Any]]:
    """Measure the delay to a doubled rate (in all channels), from S = 0 and after a long quiet time, beside the optimum for one
    channel."""
    rows = []
    settings = WatchSettings(case.arl_exposures)
    optimum = design_cusum(case.rate, DOUBLED, case.arl_exposures).delay(DOUBLED * case.rate)
    for name, before in (("delay, worst case", 0), ("delay, after quiet", int(50 / case.rate))):
        delays = np.array(
            [
                delay_to_change(
                    ChannelWatch(case.channels, np.full(case.channels, case.rate), settings),
                    before,
                    (case.rate, DOUBLED * case.rate),
                    (seed << 32) + number,
                )
                for number in range(changes)
            ]
        )
        rows.append(
            {
                "name": name,
                **case._asdict(),
                "changes": changes,
                "delay": float(delays.mean()),
                "stderr": float(delays.std(ddof=1) / np.sqrt(changes)),
                "optimum": optimum,
                "factor": float(delays.mean()) / optimum,
                "fine": float(delays.mean()) <= DELAY_FACTOR * optimum,
            }
        )
    return rows


def estimate_rows(case: DarkCase, clicks: int, exposures: int, changes: int, seed: int) -> list[dict[str, Any]]:
    """What it costs that the rate is an estimate from about `clicks` dark clicks: plugged in as it is, and guarded by its
    interval.
    """
    rng = np.random.default_rng(seed)
    sample = round(clicks / case.rate)
    optimum = design_cusum(case.rate, DOUBLED, case.arl_exposures).delay(DOUBLED * case.rate)
    tries = 20
    rows = []
    for guarded in (False, True):
        alarms, delays = [], []
        for number, found in enumerate(rng.binomial(sample, case.rate, tries).tolist()):
            low, high = wilson_interval(found, sample)
            guards = (np.array([low]), np.array([high])) if guarded else (None, None)
            settings, expected = WatchSettings(case.arl_exposures), np.array([found / sample])
            watch = ChannelWatch(1, expected, settings, *guards)
            alarms.append(count_false_alarms(watch, case.rate, exposures // tries, seed + 1000 + number))
            for change in range(changes // tries):
                watch = ChannelWatch(1, expected, settings, *guards)
                key = (seed << 32) + (number << 16) + change
                delays.append(delay_to_change(watch, 0, (case.rate, DOUBLED * case.rate), key))
        stated = exposures / case.arl_exposures
        rows.append(
            {
                "name": f"rate from {clicks} clicks, {'guarded' if guarded else 'plugged in'}",
                **case._asdict(),
                "exposures": exposures,
                "alarms": sum(alarms),
                "stated": stated,
                "alarm_factor": sum(alarms) / stated,
                "worst_estimate_factor": max(alarms) * tries / stated,
                "delay": float(np.mean(delays)),
                "optimum": optimum,
                "factor": float(np.mean(delays)) / optimum,
            }
        )
    return rows


@dataclass(frozen=True, slots=True)
class Settings:
    """How much to draw."""

    exposures: int = option(100_000_000, "dark exposures per row of false alarms")
    changes: int = option(2000, "changes per row of delays (default 2000)")
    seed: int = option(1, "of the simulated detector (default 1)")


def run(settings: Settings) -> Report:
    """Run all cases."""
    rows: list[dict[str, Any]] = []
    exposures, changes, seed = settings.exposures, settings.changes, settings.seed
    for case in CASES:
        rows.append(false_alarm_row(case, exposures, seed))
        rows += delay_rows(case, changes if case.channels == 1 else changes // 10, seed)
        if case.channels == 1:
            for clicks in ESTIMATES:
                rows += estimate_rows(case, clicks, exposures, changes // 4, seed)
    return rows_report(rows, all(row.get("fine", True) for row in rows), seed=seed, simulated=True)


TRIAL = Trial(Settings, run)
