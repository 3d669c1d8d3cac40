"""The dark-count watch against loops over exposures, its run lengths against exact linear algebra and against the definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pans.decide.dark.cusum import (
    ALL_CHANNELS,
    SUM,
    ChannelWatch,
    CusumDesign,
    WatchSettings,
    design_cusum,
    run_length,
    whole_steps,
)

mpmath = pytest.importorskip("mpmath", reason="needs the test extra")


def exact_run_length(rate: float, click: int, silent: int, threshold: int) -> float:
    """Solve the chain's linear equations in 40 digits: no cycles, no sweeps."""
    mpmath.mp.dps = 40
    p = mpmath.mpf(rate)
    matrix = mpmath.eye(threshold)
    for s in range(threshold):
        for step, weight in ((click, p), (silent, 1 - p)):
            after = max(0, s + step)
            if after < threshold:
                matrix[s, after] -= weight
    return float(mpmath.lu_solve(matrix, mpmath.ones(threshold, 1))[0])


@pytest.mark.parametrize(
    ("rate", "click", "silent", "threshold"),
    [(0.1, 6, -1, 30), (0.1, -6, 1, 25), (0.4, 3, -2, 40), (0.02, 30, -1, 61), (0.3, -25, 7, 60), (0.05, 7, -1, 7)],
)
def test_run_length_is_that_of_the_chain(rate: float, click: int, silent: int, threshold: int) -> None:
    assert run_length(rate, click, silent, threshold) == pytest.approx(
        exact_run_length(rate, click, silent, threshold), rel=1e-7
    )


@pytest.mark.parametrize("rate", [1e-9, 1e-4, 0.01, 0.3])
@pytest.mark.parametrize("ratio", [2.0, 0.5])
def test_steps_have_the_ratio_of_the_log_likelihoods(rate: float, ratio: float) -> None:
    mpmath.mp.dps = 40
    p0, p1 = mpmath.mpf(rate), mpmath.mpf(rate) * ratio
    click, silent = whole_steps(rate, ratio)
    exact = mpmath.log(p1 / p0) / mpmath.log((1 - p1) / (1 - p0))
    assert click / silent == pytest.approx(float(exact), rel=2e-3)


def test_a_rare_rate_is_scaled_from_a_frequent_one() -> None:
    design = design_cusum(1e-4, 2.0, 1e8)  # rarer than the finest that is solved as it is
    assert run_length(1e-4, design.click_step, design.silent_step, design.threshold) == pytest.approx(1e8, rel=0.05)
    assert design.arl_exposures == pytest.approx(1e8, rel=0.02)
    assert 1.6e5 < design.delay(2e-4) < 2e5


def test_a_guarded_test_keeps_its_promise_at_the_guard() -> None:
    design = design_cusum(0.01, 2.0, 1e6, guard_rate=0.012)
    assert run_length(0.012, design.click_step, design.silent_step, design.threshold) == pytest.approx(1e6, rel=0.01)
    assert design.delay(0.02) > design_cusum(0.01, 2.0, 1e6).delay(0.02)
    poor = design_cusum(0.01, 2.0, 1e6, guard_rate=0.03)  # known so badly that a doubling is within its interval
    assert poor.rate * poor.ratio == pytest.approx(0.045)
    assert run_length(0.01, poor.click_step, poor.silent_step, poor.threshold) > 1e6


@pytest.mark.parametrize(("rate", "ratio", "arl"), [(0.01, 2.0, 1e9), (0.05, 0.5, 1e8), (0.3, 1.5, 1e9)])
def test_long_run_lengths_follow_their_slope(rate: float, ratio: float, arl: float) -> None:
    design = design_cusum(rate, ratio, arl)
    solved = run_length(rate, design.click_step, design.silent_step, design.threshold)
    assert design.arl_exposures == pytest.approx(solved, rel=5e-3)
    assert solved == pytest.approx(arl, rel=0.05)


@pytest.mark.parametrize(("rate", "ratio"), [(0.0, 2.0), (0.6, 2.0), (0.1, 1.0), (0.1, -1.0)])
def test_what_is_no_test_is_refused(rate: float, ratio: float) -> None:
    with pytest.raises(ValueError, match="no test"):
        design_cusum(rate, ratio, 1e6)


def naive_alarms(design: CusumDesign, bits: np.ndarray) -> tuple[list[int], int]:
    """Follow one sum trial by trial; return the trials taken at each alarm, and the sum."""
    total, alarms = 0, []
    for trial, bit in enumerate(bits.ravel(), 1):
        total = max(0, total + (design.click_step if bit else design.silent_step))
        if total >= design.threshold:
            alarms.append(trial)
            total = 0
    return alarms, total


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_channels=st.sampled_from([1, 2, 3, 9]),
    rate=st.sampled_from([0.003, 0.05, 0.3]),
    cuts=st.lists(st.integers(0, 400), max_size=6),
)
def test_watch_is_exact_for_every_exposure(seed: int, n_channels: int, rate: float, cuts: list[int]) -> None:
    rng = np.random.default_rng(seed)
    bits = rng.random((400, n_channels)) < rate * rng.choice([0.2, 1.0, 3.0])
    words = np.packbits(bits, axis=1, bitorder="little")
    watch = ChannelWatch(n_channels, np.full(n_channels, rate), WatchSettings(arl_exposures=50.0))
    alarms = [
        alarm
        for part in np.split(words, sorted({*cuts, *range(10, 400, 10)}))
        for alarm in watch.update_words(np.ascontiguousarray(part))
    ]
    for row, (name, channel, design) in enumerate(watch.designs):
        expected, total = naive_alarms(design, bits if channel == ALL_CHANNELS else bits[:, channel])
        found = [alarm for alarm in alarms if (alarm.test, alarm.channel) == (name, channel)]
        trials = n_channels if channel == ALL_CHANNELS else 1
        late = name == "fall"  # passed in silence: the trial before which the threshold was reached
        assert len(found) == len(expected)
        for alarm, trial in zip(found, expected):
            assert alarm.exposure in ({trial} if trials == 1 or late else {-(-trial // trials), trial // trials + 1})
            if trials == 1:
                assert alarm.clicks[channel] == bits[alarm.since : alarm.exposure, channel].sum()
        assert watch._state[row, SUM] == total
    assert watch.clicks.tolist() == bits.sum(axis=0).tolist()
    assert watch.exposures == 400


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 50))
def test_blocks_of_counts_stay_within_their_bound(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    bits = (rng.random((600, 3)) < 0.02).astype(np.uint8)
    never = WatchSettings(arl_exposures=1e7)
    exact, blocks = (ChannelWatch(3, np.full(3, 0.02), never) for _ in range(2))
    for first in range(0, 600, size):
        part = bits[first : first + size]
        assert exact.update_words(np.packbits(part, axis=1, bitorder="little")) == []
        assert blocks.update(len(part), part.sum(axis=0, dtype=np.int64)) == []
        below = exact._state[:, SUM] - blocks._state[:, SUM]
        assert (below >= 0).all()
        for row, (_, channel, design) in enumerate(exact.designs):
            down = -min(design.click_step, design.silent_step)
            if design.click_step > 0:
                assert below[row] <= down * size * (3 if channel == ALL_CHANNELS else 1)


def test_a_block_of_counts_that_passes_a_threshold_is_an_alarm_with_its_clicks() -> None:
    watch = ChannelWatch(3, np.full(3, 0.01), WatchSettings(arl_exposures=1e4))
    assert watch.update(100, np.array([1, 1, 1])) == []
    alarms = watch.update(1000, np.array([10, 90, 10]))
    rise = next(alarm for alarm in alarms if alarm.test == "rise")
    assert (rise.channel, rise.exposure) == (1, 1100)
    assert rise.rate == pytest.approx(0.09, rel=0.1)
    assert "fall" not in {alarm.test for alarm in alarms}
    assert watch.update(100, np.array([1, 1, 1])) == []  # the sums began again


def test_counters_beyond_32_bits() -> None:
    watch = ChannelWatch(2, np.full(2, 1e-4), WatchSettings(arl_exposures=1e12))
    n = 1 << 33
    clicks = np.full(2, round(n * 1e-4), np.int64)
    assert watch.update(n, clicks) == []
    assert watch.exposures == n
    assert watch.clicks.tolist() == clicks.tolist()
    words = np.zeros((100_000, 1), np.uint8)
    words[::500] = 1  # channel 0 twenty times too often
    found = watch.update_words(words)
    assert found[0].test in ("rise", "burst")
    assert found[0].since >= n
    assert {alarm.channel for alarm in found if alarm.test == "rise"} == {0}
    first = next(alarm for alarm in found if alarm.test == "rise")
    assert first.rate == pytest.approx(2e-3, rel=0.2)
    assert first.clicks[1] == 0


def test_no_clicks_and_all_clicks() -> None:
    silent = ChannelWatch(1, np.array([0.05]), WatchSettings(arl_exposures=1e4))
    assert {alarm.test for alarm in silent.update_words(np.zeros((2000, 1), np.uint8))} == {"fall"}
    loud = ChannelWatch(1, np.array([0.05]), WatchSettings(arl_exposures=1e4))
    assert {alarm.test for alarm in loud.update_words(np.ones((200, 1), np.uint8))} == {"rise", "burst"}
    ideal = ChannelWatch(1, np.array([0.0]))
    assert ideal.update_words(np.zeros((100_000, 1), np.uint8)) == []
    # a detector that never clicks has clicked
    assert ideal.update_words(np.ones((1, 1), np.uint8))[0].exposure == 100_001


def test_blocks_that_cannot_be_are_refused() -> None:
    watch = ChannelWatch(2, np.full(2, 0.01))
    with pytest.raises(ValueError, match="cannot be"):
        watch.update(1, np.array([2, 0]))
    with pytest.raises(ValueError, match="channels"):
        ChannelWatch(2, np.zeros(3))
