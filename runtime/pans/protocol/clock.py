"""Device tick <-> host time, with its uncertainty, from two-way probes: the only place that converts.

A probe bounds the offset at its own tick to half its round trip, whatever the asymmetry of the two ways. The quickest probes are kept, a
straight line is fitted through their midpoints (weighted least squares with a prior on the drift), and the published uncertainty is the
tightest bound that any of the latest quick probes gives: half its round trip, plus its distance from the line, plus what the rate may have
changed since. All in integers relative to a reference, so that nothing is lost past 2^53.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pans.base.errors import LinkError
from pans.protocol.wire.contradiction import Contradiction

NS_PER_S = 1_000_000_000
HISTORY = 64  # six seconds of probes: long enough for a rate, short enough for a crystal that warms up
ANCHORS = 8  # the latest quick probes, each of which bounds the error by itself
DRIFT_PRIOR = 100e-6  # one sigma of the prior on the rate error: crystals are within +-100 ppm
WANDER = 2e-6  # the rate may differ by this from the fitted one within the history
READING_NS = 1_000  # both ends stamp to a microsecond or better
STEP_MARGIN_NS = 20_000  # a jump is larger than the published uncertainty by this: the jitter of a stamp on a busy host
# A probe is quick, and goes into the fit, up to 1.5 times the least round trip and 20 us. Its bound is half its round trip, so that a
# probe of 1.5 times the best still weighs (1 / 1.5)^2 = 0.44 of it; the 20 us let probes in on links whose best trip is shorter than
# the scheduler's own jitter. What is slower waited in a queue and says nothing that the quick ones do not.
QUICK_RATIO, QUICK_MARGIN_NS = 1.5, 20_000.0
MAX_UNRECORDED = 4096
# of a device's clock (docs/reference/protocol.md, section 9); what a fit says beyond it is no rate
MAX_RATE_ERROR = 1e-3
LARGEST_NS = 1 << 62  # 146 years: a tick that claims more is no time, and must still fit the recording's int64

I64 = npt.NDArray[np.int64]
CLOCK_DTYPE = np.dtype([("host_ns", "<i8"), ("tick", "<u8"), ("round_trip_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class ClockFit:
    """host_ns = reference_host_ns + ns_per_tick * (tick - reference_tick); `uncertainty_ns` is the one at the reference.

    `anchors` are (ticks after the reference, bound in ns) of the latest quick probes; `rate_uncertainty` is relative.
    """

    reference_tick: int
    reference_host_ns: int
    ns_per_tick: float
    uncertainty_ns: float
    rate_uncertainty: float
    drift_ppm: float
    anchors: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True, slots=True)
class ClockStep:
    """The device's counter jumped: at `tick` it was off by `off_ns`, more than the published uncertainty allowed."""

    tick: int
    off_ns: int
    allowed_ns: int


def future_tick(clock: ClockModel, tick: int, arrival_ns: int) -> Contradiction | None:
    """Return what is wrong when `tick` is later than `arrival_ns` by more than the clock's uncertainty; the device's clock has moved.

    What has arrived has happened, so that no tick may lie in the future.
    """
    fit = clock.fit
    if fit is None or fit.reference_host_ns + (tick - fit.reference_tick) * fit.ns_per_tick <= arrival_ns:
        return None
    host_ns, uncertainty_ns = clock.to_host_ns(tick)
    if host_ns - uncertainty_ns - STEP_MARGIN_NS <= arrival_ns:
        return None
    return Contradiction("future_tick", 0, tick, clock.to_tick(arrival_ns))


def unwrap_tick(raw: int, latest: int, bits: int = 32) -> int:
    """Extend a counter of `bits` bits: the tick nearest to `latest` (a whole tick) whose low bits are `raw`.

    For drivers of devices whose counter wraps; right as long as less than half a wrap lies between the two.
    """
    span = 1 << bits
    if not 0 <= raw < span:
        raise ValueError(f"raw tick {raw} does not fit {bits} bits")
    ahead = (raw - latest) % span
    return max(latest + ahead - (span if ahead >= span // 2 else 0), raw)


class ClockModel:
    """Learns the mapping from probes. A device that restarts needs a new model; a counter that jumps starts a new epoch here."""

    def __init__(self, tick_hz: int) -> None:
        self.tick_hz = tick_hz
        self.samples: npt.NDArray[np.void] = np.zeros(HISTORY, CLOCK_DTYPE)
        self.n_probes = 0  # in all
        self.epoch = 0  # counts jumps within the session
        self.fit: ClockFit | None = None
        self._kept = 0  # since the last jump
        self._unrecorded: deque[tuple[int, int, int]] = deque(maxlen=MAX_UNRECORDED)

    def add_probe(self, sent_ns: int, rx_tick: int, tx_tick: int, received_ns: int) -> ClockStep | None:
        """Take one two-way probe: host send, device arrival and departure in ticks, host receive; refit.

        Returns the jump when the probe cannot be explained without one: the history before it is then left behind.
        """
        device_ns = (tx_tick - rx_tick) * NS_PER_S // self.tick_hz
        round_trip = max(received_ns - sent_ns - device_ns, 0)
        row = (sent_ns + (received_ns - sent_ns) // 2, rx_tick + (tx_tick - rx_tick) // 2, round_trip)
        self.n_probes += 1
        self._unrecorded.append(row)
        step = self._jump(row)
        if step is not None:
            self.epoch += 1
            self._kept = 0
        self.samples[self._kept % HISTORY] = row
        self._kept += 1
        self.fit = _fit(self.samples[: min(self._kept, HISTORY)], self.tick_hz, (self._kept - 1) % HISTORY)
        return step

    def can_be(self, sent_ns: int, rx_tick: int, tx_tick: int, received_ns: int) -> bool:
        """Whether the device can have held a probe for as long as it says: no longer than it was away."""
        away_ns = (received_ns - sent_ns) * (1 + MAX_RATE_ERROR) + 2 * READING_NS
        return (tx_tick - rx_tick) * NS_PER_S <= away_ns * self.tick_hz

    def to_host_ns(self, tick: int) -> tuple[int, int]:
        """Return the host time of `tick` and its uncertainty, both in ns; LinkError before the first probe."""
        fit = self._ready()
        elapsed = tick - fit.reference_tick
        rate = fit.ns_per_tick * fit.rate_uncertainty
        uncertainty = min([bound + abs(elapsed - at) * rate for at, bound in fit.anchors])
        host_ns = fit.reference_host_ns + round(elapsed * fit.ns_per_tick)
        return max(-LARGEST_NS, min(host_ns, LARGEST_NS)), min(int(uncertainty) + 1, LARGEST_NS)

    def to_host_ns_many(self, ticks: I64) -> tuple[I64, I64]:
        """Return the host times of `ticks` and their uncertainties, int64 (n,) ns, as `to_host_ns` does."""
        fit = self._ready()
        elapsed = ticks - fit.reference_tick
        away = np.minimum(np.maximum(np.rint(elapsed * fit.ns_per_tick), -LARGEST_NS), LARGEST_NS).astype(np.int64)
        at, bounds = np.array(fit.anchors).T[:, :, None]
        unsure = (bounds + np.abs(elapsed - at) * (fit.ns_per_tick * fit.rate_uncertainty)).min(axis=0)
        host_ns = np.minimum(np.maximum(fit.reference_host_ns + away, -LARGEST_NS), LARGEST_NS)
        return host_ns, np.minimum(unsure, LARGEST_NS - 1).astype(np.int64) + 1

    def to_tick(self, host_ns: int) -> int:
        """Return the device tick at a host time (for commands with absolute ticks)."""
        fit = self._ready()
        return fit.reference_tick + round((host_ns - fit.reference_host_ns) / fit.ns_per_tick)

    def history(self) -> npt.NDArray[np.void]:
        """Return the probes that the fit is made of, CLOCK_DTYPE (n,), oldest first: what a part of a recording begins with."""
        kept = self.samples[: min(self._kept, HISTORY)]
        return kept[np.argsort(kept["tick"], kind="stable")]

    def take_samples(self) -> npt.NDArray[np.void]:
        """Return the probes since the last call, CLOCK_DTYPE (n,), for the recording; of more than 4096 the oldest are gone."""
        taken = np.array(list(self._unrecorded), CLOCK_DTYPE)
        self._unrecorded.clear()
        return taken

    def _jump(self, row: tuple[int, int, int]) -> ClockStep | None:
        host_ns, tick, round_trip = row
        if self.fit is None or self._kept < ANCHORS:
            return None
        expected, uncertainty = self.to_host_ns(tick)
        allowed = uncertainty + round_trip // 2 + STEP_MARGIN_NS
        off = host_ns - expected
        return ClockStep(tick, off, allowed) if abs(off) > allowed else None

    def _ready(self) -> ClockFit:
        if self.fit is None:
            raise LinkError("the device clock is not known: no probe has been answered")
        return self.fit


def _fit(samples: npt.NDArray[np.void], tick_hz: int, newest: int) -> ClockFit:
    round_trip = samples["round_trip_ns"].astype(np.float64)
    best = float(round_trip.min())
    quick = np.flatnonzero(round_trip <= QUICK_RATIO * best + QUICK_MARGIN_NS)
    quick = quick[np.argsort((quick - newest - 1) % len(samples))]  # oldest first
    host, tick, trip = samples["host_ns"][quick], samples["tick"][quick], round_trip[quick]
    reference_host, reference_tick = int(host[-1]), int(tick[-1])
    ns_per_tick = NS_PER_S / tick_hz
    ticks = tick.astype(np.int64) - np.int64(reference_tick)
    ticks_ns = ticks.astype(np.float64) * ns_per_tick
    offset = (host - reference_host).astype(np.float64) - ticks_ns  # host minus nominal device time, small numbers
    weight = 1.0 / (trip / 2 + READING_NS) ** 2
    total = float(weight.sum())
    mean_t, mean_o = float(weight @ ticks_ns) / total, float(weight @ offset) / total
    precision = float(weight @ (ticks_ns - mean_t) ** 2) + 1.0 / DRIFT_PRIOR**2
    rate = float(weight @ ((ticks_ns - mean_t) * (offset - mean_o))) / precision
    rate = max(-MAX_RATE_ERROR, min(rate, MAX_RATE_ERROR))
    residual = offset - (mean_o + rate * (ticks_ns - mean_t))
    bounds = trip / 2 + np.abs(residual) + READING_NS + ns_per_tick  # a tick is floored, hence one tick more
    return ClockFit(
        reference_tick=reference_tick,
        reference_host_ns=reference_host + round(mean_o - rate * mean_t),
        ns_per_tick=ns_per_tick * (1.0 + rate),
        uncertainty_ns=float(bounds[-1]),
        rate_uncertainty=3.0 / precision**0.5 + WANDER,  # three sigma of the fitted rate
        drift_ppm=rate * 1e6,
        anchors=tuple(zip(ticks[-ANCHORS:].tolist(), bounds[-ANCHORS:].tolist())),
    )
