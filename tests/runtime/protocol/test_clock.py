"""The clock model against simulated crystals and links; a fake clock throughout."""

from typing import Any, NamedTuple

import numpy as np
import pytest

from pans.base.errors import LinkError
from pans.protocol.clock import CLOCK_DTYPE, READING_NS, STEP_MARGIN_NS, WANDER, ClockModel, future_tick, unwrap_tick

TICK_HZ = 10_000_000
NS_PER_TICK = 100
PROBE_EVERY_NS = 97_000_000


def probed(
    model: ClockModel, step: int, jump_ticks: int = 0, late_ns: int = 0, rate: float = 1.0, host_ns: int = 0
) -> Any:
    """Give the model the probe of a `step`: 100 us there and back, and `late_ns` on the way back."""
    sent = host_ns + step * PROBE_EVERY_NS
    tick = int((step * PROBE_EVERY_NS + 50_000) * rate) // NS_PER_TICK + jump_ticks
    return model.add_probe(sent, tick, tick, sent + 100_000 + late_ns)


def test_the_drift_is_found() -> None:
    model = ClockModel(TICK_HZ)
    for step in range(100):
        probed(model, step, rate=1 + 37e-6)
    assert model.fit.drift_ppm == pytest.approx(-37.0, abs=0.5)  # host time per device time runs slow by as much


def test_ticks_and_times_convert_both_ways_without_losing_digits() -> None:
    model = ClockModel(TICK_HZ)
    for step in range(50):
        probed(model, step, 2**61, host_ns=2**60)
    host_ns = 2**60 + 5_000_000_000
    assert abs(model.to_host_ns(model.to_tick(host_ns))[0] - host_ns) <= NS_PER_TICK


def test_slow_probes_do_not_pull_the_line() -> None:
    model = ClockModel(TICK_HZ)
    for step in range(60):
        probed(model, step, late_ns=20_000_000 if step % 2 else 0)
    host_ns, bound = model.to_host_ns(5_000_000_000 // NS_PER_TICK)
    assert abs(host_ns - 5_000_000_000) < 60_000
    assert bound < 200_000


@pytest.mark.parametrize("n", [1, 2, 5, 40])
def test_the_uncertainty_grows_away_from_the_probes_by_three_sigma_of_the_rate(n: int) -> None:
    """And by what the crystal may wander, as docs/reference/links.md says; of one probe, sigma is that of crystals, 100 ppm."""
    model = ClockModel(TICK_HZ)
    for step in range(n):
        probed(model, step)
    at_s = np.arange(n) * PROBE_EVERY_NS / 1e9
    error_s = (50_000 + READING_NS) / 1e9  # of a probe: half its round trip, and the readings
    sigma = 1 / np.sqrt(np.sum((at_s - at_s.mean()) ** 2) / error_s**2 + 1 / 100e-6**2)
    (near, far), ticks = (model.to_host_ns(tick)[1] for tick in (10**9, 2 * 10**9)), 10**9
    assert far - near == pytest.approx((3 * sigma + WANDER) * ticks * NS_PER_TICK, rel=1e-3)


@pytest.mark.parametrize(("held_ns", "possible"), [(0, True), (1_002_990, True), (1_003_010, False)])
def test_a_device_holds_a_probe_no_longer_than_it_was_away(held_ns: int, possible: bool) -> None:
    """Away for 1 ms, but for a rate error of 0.1 % and two readings of 1 us."""
    assert ClockModel(1_000_000_000).can_be(0, 77, 77 + held_ns, 1_000_000) is possible


def test_the_middle_of_both_ways_is_one_instant_and_no_round_trip_is_negative() -> None:
    model = ClockModel(TICK_HZ)
    model.add_probe(0, 1000, 5000, 600_000)  # the device held it from 100 to 500 us
    assert model.history()[0].tolist() == (300_000, 3000, 200_000)
    assert model.to_host_ns(3000)[0] == 300_000
    model.add_probe(600_000, 6000, 6011, 601_000)  # a tick is coarser than a short trip
    assert model.history()[1]["round_trip_ns"] == 0


def test_the_bound_is_that_of_the_probe_that_gives_the_tightest() -> None:
    model = ClockModel(TICK_HZ)
    for step in range(40):
        probed(model, step, late_ns=0 if step < 39 else 60_000)
    assert model.to_host_ns(39 * PROBE_EVERY_NS // NS_PER_TICK)[1] < 60_000  # half the trip of the latest is 80 us


def test_before_the_first_probe_nothing_is_converted() -> None:
    with pytest.raises(LinkError, match="no probe"):
        ClockModel(TICK_HZ).to_host_ns(0)


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


def run_clock_case(case: ClockCase, seconds: float, seed: int) -> tuple[ClockModel, np.ndarray, np.ndarray]:
    """Probe and convert for `seconds`; return errors and uncertainties, ns, of ticks up to 100 ms before and after each probe."""
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
    return model, np.array(errors), np.array(bounds)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_coverage_under_drift_wander_jitter_and_asymmetry(case: ClockCase) -> None:
    model, errors, bounds = run_clock_case(case, 40.0, 7)
    assert (errors <= bounds).mean() >= 0.999
    assert np.median(errors) < np.median(bounds)
    assert model.epoch == 0


def test_a_counter_that_jumps_starts_a_new_epoch_and_is_told() -> None:
    model = ClockModel(TICK_HZ)
    assert all(probed(model, step) is None for step in range(30))
    step = probed(model, 30, 50_000)  # 5 ms ahead
    assert step.off_ns == pytest.approx(-5_000_000, abs=200_000)
    assert model.epoch == 1
    for later in range(31, 40):
        assert probed(model, later, 50_000) is None
    host_ns, bound = model.to_host_ns(39 * 970_000 + 50_000)
    assert abs(host_ns - 39 * 97_000_000) < bound < 500_000


def test_a_tick_that_lies_in_the_future_beyond_the_uncertainty_is_a_contradiction() -> None:
    model = ClockModel(TICK_HZ)
    assert future_tick(model, 10**18, 0) is None  # nothing is known yet
    for step in range(30):
        probed(model, step)
    tick = 10**8
    host_ns, bound = model.to_host_ns(tick)
    earliest_ns = host_ns - bound - STEP_MARGIN_NS
    assert [future_tick(model, tick, earliest_ns + off) is None for off in (-1, 0, bound)] == [False, True, True]
    found = future_tick(model, tick, earliest_ns - 1)
    assert (found.what, found.found, found.expected) == ("future_tick", tick, model.to_tick(earliest_ns - 1))


def test_every_probe_is_kept_for_the_recording_once() -> None:
    model = ClockModel(TICK_HZ)
    for step in range(10):
        probed(model, step)
    samples = model.take_samples()
    assert samples.dtype == CLOCK_DTYPE
    assert samples["host_ns"].tolist() == [step * 97_000_000 + 50_000 for step in range(10)]
    assert len(model.take_samples()) == 0


@pytest.mark.parametrize("bits", [8, 32])
def test_a_narrow_counter_is_extended_over_its_wraps(bits: int) -> None:
    latest = 0
    for true in range(0, 5 << bits, (1 << bits) // 3):
        latest = unwrap_tick(true % (1 << bits), latest, bits)
        assert latest == true
        assert unwrap_tick((true - 1) % (1 << bits), latest, bits) == max(true - 1, (true - 1) % (1 << bits))
    half = 1 << (bits - 1)
    assert unwrap_tick(half, 3 << bits, bits) == (3 << bits) - half  # as far ahead as behind: an old value
    with pytest.raises(ValueError, match="does not fit"):
        unwrap_tick(1 << bits, 0, bits)
