"""The clock model against crystals and links that are known exactly: how often does the true error exceed the published uncertainty?

Owns the simulated crystals (drift, random wander, a sinusoid as of a room that warms and cools) and links (delay, asymmetry, exponential
jitter, rare long queues); never reads a clock. It fails when fewer than 99.9 % of the
conversions were within their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pans.firmware_sim.options import option
from pans.runtime.timing.clock import ClockModel

from . import Report, Trial, rows_report

TICK_HZ = 10_000_000
PROBE_EVERY_NS = 97_000_000
REQUIRED = 0.999


@dataclass(frozen=True, slots=True)
class Settings:
    """How long to run."""

    seconds: float = option(600.0, "of each case (default 600)")


class ClockCase(NamedTuple):
    """A crystal and a link; delays in us, rates in ppm, `wander_ppm_per_s` is the scale of a random walk of the rate."""

    name: str
    drift_ppm: float
    wander_ppm_per_s: float
    swing_ppm: float
    swing_period_s: float
    out_us: float
    back_us: float
    jitter_us: float


CASES = tuple(
    ClockCase(f"{name} {drift:+.0f} ppm", drift, *rest)
    for drift in (-100.0, 0.0, 100.0)
    for name, *rest in (
        ("quiet, tcp", 0.0, 0.0, 60.0, 40.0, 40.0, 10.0),
        ("wander, jitter", 0.05, 2.0, 60.0, 40.0, 40.0, 60.0),
        ("wander, asymmetric usb", 0.05, 2.0, 60.0, 20.0, 250.0, 60.0),
        ("wander, 1 ms serial", 0.05, 2.0, 60.0, 1000.0, 300.0, 500.0),
        ("warming up fast", 0.2, 5.0, 30.0, 40.0, 120.0, 60.0),
    )
)


def run_clock_case(case: ClockCase, seconds: float, seed: int) -> dict[str, Any]:
    """Probe and convert for `seconds`; return coverage and errors over ticks up to 100 ms before and after each probe."""
    rng = np.random.default_rng(seed)
    model = ClockModel(TICK_HZ)
    rate_ppm, phase = case.drift_ppm, 0.0
    at_ns, tick = 0.0, float(rng.integers(0, 1 << 33))
    errors, bounds = [], []

    def pass_time(ns: float) -> None:
        nonlocal at_ns, tick, rate_ppm, phase
        swing = case.swing_ppm * np.sin(2 * np.pi * (at_ns / 1e9) / case.swing_period_s)
        tick += ns * (1 + (rate_ppm + swing) * 1e-6) * TICK_HZ / 1e9
        rate_ppm += case.wander_ppm_per_s * np.sqrt(ns / 1e9) * rng.normal()
        at_ns += ns

    def delay(us: float) -> float:
        queue = rng.exponential(20_000_000.0) if rng.random() < 0.02 else 0.0
        return us * 1000 + rng.exponential(case.jitter_us * 1000) + queue

    n_probes = 16 + int(seconds * 1e9 / PROBE_EVERY_NS)
    for number in range(n_probes):
        sent = at_ns
        pass_time(delay(case.out_us))
        rx_tick = int(tick)
        pass_time(20_000.0)
        tx_tick = int(tick)
        pass_time(delay(case.back_us))
        model.add_probe(round(sent), rx_tick, tx_tick, round(at_ns))
        until = sent + (PROBE_EVERY_NS if number >= 16 else 1_000_000)
        for _ in range(4):  # a block may end at any moment until the next probe
            pass_time(max(until - at_ns, 1e6) / 4 * rng.random())
            host_ns, bound = model.to_host_ns(int(tick))
            errors.append(abs(host_ns - at_ns))
            bounds.append(bound)
        pass_time(max(until - at_ns, 0.0))
    within = np.array(errors) <= np.array(bounds)
    return {
        "name": case.name,
        "conversions": len(errors),
        "within": float(within.mean()),
        "error_us_median": float(np.median(errors)) / 1000,
        "error_us_max": float(np.max(errors)) / 1000,
        "uncertainty_us_median": float(np.median(bounds)) / 1000,
        "steps": model.epoch,
    }


def run(settings: Settings) -> Report:
    """Run all cases."""
    rows = [run_clock_case(case, settings.seconds, seed) for seed, case in enumerate(CASES)]
    return rows_report(rows, all(row["within"] >= REQUIRED and row["steps"] == 0 for row in rows))


TRIAL = Trial(Settings, run)
