"""Device tick <-> host time, with its uncertainty: the only place that converts.

Owns the probe history and the fitted line; never reads a clock. `to_host_ns` returns the host time of a tick and how far off it
may be. Method: two-way probes bound each offset to half their round trip; the quickest probes are kept and a straight line is
fitted through their midpoints (weighted least squares with a prior on the drift), in integers relative to a reference so that
nothing is lost past 2^53.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .errors import LinkError

NS_PER_S = 1_000_000_000
HISTORY = 128
DRIFT_PRIOR = 100e-6  # one sigma of the prior on the rate error: crystals are within +-100 ppm

CLOCK_DTYPE = np.dtype([("host_ns", "<i8"), ("tick", "<u8"), ("round_trip_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class ClockFit:
    """host_ns = reference_host_ns + ns_per_tick * (tick - reference_tick), good to `uncertainty_ns` at the reference."""

    reference_tick: int
    reference_host_ns: int
    ns_per_tick: float
    uncertainty_ns: float
    rate_uncertainty: float  # relative; grows the uncertainty away from the reference
    drift_ppm: float
    probes: int


class ClockModel:
    """Learns the mapping from probes; a device reset (another epoch) needs a new model, never a jump in this one."""

    def __init__(self, tick_hz: int) -> None:
        self.tick_hz = tick_hz
        self.samples: npt.NDArray[np.void] = np.zeros(HISTORY, CLOCK_DTYPE)
        self.n_probes = 0
        self.fit: ClockFit | None = None

    def add_probe(self, sent_ns: int, rx_tick: int, tx_tick: int, received_ns: int) -> None:
        """Take one two-way probe: host send, device arrival and departure in ticks, host receive; refit."""
        device_ns = (tx_tick - rx_tick) * NS_PER_S // self.tick_hz
        round_trip = max(received_ns - sent_ns - device_ns, 0)
        row = (sent_ns + (received_ns - sent_ns) // 2, rx_tick + (tx_tick - rx_tick) // 2, round_trip)
        self.samples[self.n_probes % HISTORY] = row
        self.n_probes += 1
        self.fit = _fit(self.samples[: min(self.n_probes, HISTORY)], self.tick_hz)

    def to_host_ns(self, tick: int) -> tuple[int, int]:
        """Return the host time of `tick` and its uncertainty, both in ns; LinkError before the first probe."""
        fit = self._ready()
        elapsed = tick - fit.reference_tick
        away_ns = elapsed * fit.ns_per_tick
        uncertainty = fit.uncertainty_ns + abs(away_ns) * fit.rate_uncertainty
        return fit.reference_host_ns + round(away_ns), int(uncertainty) + 1

    def to_tick(self, host_ns: int) -> int:
        """Return the device tick at a host time (for commands with absolute ticks)."""
        fit = self._ready()
        return fit.reference_tick + round((host_ns - fit.reference_host_ns) / fit.ns_per_tick)

    def _ready(self) -> ClockFit:
        if self.fit is None:
            raise LinkError("the device clock is not known: no probe has been answered")
        return self.fit


def _fit(samples: npt.NDArray[np.void], tick_hz: int) -> ClockFit:
    round_trip = samples["round_trip_ns"].astype(np.float64)
    best = float(round_trip.min())
    # Queueing only ever adds delay: slow probes carry no information that the quick ones do not.
    quick = round_trip <= 1.5 * best + 20_000.0
    host, tick, trip = samples["host_ns"][quick], samples["tick"][quick], round_trip[quick]
    reference_host, reference_tick = int(host[-1]), int(tick[-1])
    ns_per_tick = NS_PER_S / tick_hz
    ticks_ns = (tick.astype(np.int64) - np.int64(reference_tick)).astype(np.float64) * ns_per_tick
    offset = (host - reference_host).astype(np.float64) - ticks_ns  # host minus nominal device time, small numbers
    sigma = trip / 2 + 1_000.0
    weight = 1.0 / sigma**2
    mean_t = float(np.average(ticks_ns, weights=weight))
    mean_o = float(np.average(offset, weights=weight))
    spread = float(np.sum(weight * (ticks_ns - mean_t) ** 2))
    precision = spread + 1.0 / DRIFT_PRIOR**2
    rate = float(np.sum(weight * (ticks_ns - mean_t) * (offset - mean_o))) / precision
    residual = offset - (mean_o + rate * (ticks_ns - mean_t))
    scatter = float(np.sqrt(np.average(residual**2, weights=weight)))
    intercept = mean_o - rate * mean_t
    return ClockFit(
        reference_tick=reference_tick,
        reference_host_ns=reference_host + round(intercept),
        ns_per_tick=ns_per_tick * (1.0 + rate),
        uncertainty_ns=best / 2 + 3.0 * scatter + 1_000.0,
        rate_uncertainty=3.0 / precision**0.5,
        drift_ppm=rate * 1e6,
        probes=int(quick.sum()),
    )
