"""Change detection on dark clicks: one exact CUSUM per channel and side, and two over all channels, in whole numbers.

`ChannelWatch` takes dark exposures, or exposures of an empty field, in the order of time and returns an `Alarm` where a sum passes its
threshold; health.py names the cause. Every channel is tested against twice and half its rate; with several channels, their sum
against ten times (a light leak, soon) and one and a half times (a drift, surely). `WatchSettings.arl_exposures` is for all tests together.

`design_cusum` makes one test. Page's test of rate p0 against p1 adds the log likelihood ratio of each exposure and never falls below 0:
`S = max(0, S + x)`, alarm at `S >= threshold`. The steps are scaled to whole numbers, so that the test is exact, the same on every machine
and in a replay, and so is the chain whose run length is computed. A sum changes by the same amount with every silent exposure: the kernel
works per click and is still exact per exposure.

Sources: Page, Biometrika 41 (1954); Moustakides, Annals of Statistics 14 (1986): no test of the same false-alarm rate has a
shorter worst mean delay; Reynolds and Stoumbos, Journal of Quality Technology 31 (1999), for Bernoulli steps. Run lengths by
Page's cycles: from 0 a cycle ends at 0 again or at the threshold, so `ARL = mean length of a cycle / probability that it ends
in an alarm`; both are sums of positive terms, which keeps their digits whatever their size (a Brook-Evans matrix does not).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.base.machine import inner, outer
from pans.base.numbers import bisect
from pans.protocol.wire import read_only

I64 = npt.NDArray[np.int64]
F64 = npt.NDArray[np.float64]
RATE_MIN, RATE_MAX = 1e-12, 0.5
FLOOR_RATE = 1e-9  # a detector that is said to have no dark clicks at all is watched as one with this rate
FINE_RATE = 1e-3  # rarer clicks are designed at this rate and scaled: the Poisson limit, right to about the rate itself
STEP_ERROR = 2e-3  # of the steps' ratio, by rounding to whole numbers
STATES_MAX = 1 << 22
# between the rates that are told apart where the expected one is an estimate: nearer ones would take very long
GUARD_RATIO = 1.5
ENOUGH_CLICKS = 1e4  # between false alarms: beyond, log(ARL) is a straight line to about 1/ARL (Wald's identity)
_TOLERANCE = 1e-10  # relative, of the sums of a cycle: far below STEP_ERROR
_SWEEPS_MAX = 200_000  # a guard against a sum that does not settle
ALL_CHANNELS = -1
# Of the false alarms, by test: a larger share gives a lower threshold and a shorter delay, but only by the logarithm of the share. Most
# goes to rising channels, which spoil decisions soonest.
SHARES = {"rise": 0.6, "fall": 0.2, "burst": 0.1, "drift": 0.1}
MAX_CHANNELS = 4096
_ALARM_ROOM = 256  # alarms of one call; more are not kept
# columns of a test's state
SUM, THRESHOLD, CLICK_STEP, SILENT_STEP, LAST, SINCE, N_STATE = range(7)


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
        return _solved(rate, ratio, arl_exposures)
    scale = FINE_RATE / rate
    fine = _solved(FINE_RATE, ratio, max(1.0, arl_exposures / scale))
    sign = 1 if ratio > 1 else -1
    click, silent = sign * round(abs(fine.click_step) * scale), -sign * abs(fine.silent_step)
    return CusumDesign(rate, ratio, click, silent, math.ceil(fine.threshold * scale), fine.arl_exposures * scale)


def _solved(rate: float, ratio: float, arl: float) -> CusumDesign:
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
    return bisect(excess, 0.0, high)  # the mean step is below 0, so the excess falls before it rises


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


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """What to look for: ratios of the present to the expected rate; `arl_exposures` lie between two false alarms, of any test,
    in the mean."""

    arl_exposures: float = 1e8
    rise_ratio: float = 2.0
    fall_ratio: float = 0.5
    burst_ratio: float = 10.0
    drift_ratio: float = 1.5


class Alarm(NamedTuple):
    """One test that passed its threshold at dark exposure `exposure` (they alone are counted, from 0).

    `test` is rise, fall, burst or drift; `channel` is ALL_CHANNELS for the last two. The change is put at `since`, where the
    sum last was 0; `clicks` are those of each channel from there to the alarm (int64 (n,)), so that `rate` is their estimate
    per exposure and channel."""

    test: str
    channel: int
    exposure: int
    since: int
    clicks: I64
    expected: float

    @property
    def exposures(self) -> int:
        """Exposures from the estimated change to the alarm."""
        return max(1, self.exposure - self.since)

    @property
    def rate(self) -> float:
        """Clicks per exposure and channel since the estimated change: of the channel, or of all."""
        if self.channel != ALL_CHANNELS:
            return float(self.clicks[self.channel]) / self.exposures
        return float(self.clicks.sum()) / (self.exposures * len(self.clicks))


class ChannelWatch:
    """Follows the dark rates of `n_channels`; all memory is allocated here, before arming.

    `expected` float64 (n,) are click probabilities of a dark exposure; `guard_low`, `guard_high` (n,) the ends of their
    intervals where they are estimates: the false-alarm rate then holds up to there."""

    def __init__(
        self,
        n_channels: int,
        expected: F64,
        settings: WatchSettings | None = None,
        guard_low: F64 | None = None,
        guard_high: F64 | None = None,
    ) -> None:
        if not 1 <= n_channels <= MAX_CHANNELS or np.shape(expected) != (n_channels,):
            raise ValueError(
                f"{n_channels} channels and rates of shape {np.shape(expected)}, allowed: 1 to {MAX_CHANNELS}, (n,)"
            )
        self.settings = settings or WatchSettings()
        self.n_channels = n_channels
        self.expected = np.clip(np.asarray(expected, np.float64), FLOOR_RATE, RATE_MAX)
        self.clicks: I64 = np.zeros(n_channels, np.int64)
        self.exposures = 0
        high = self.expected if guard_high is None else np.clip(guard_high, self.expected, RATE_MAX)
        low = self.expected if guard_low is None else np.clip(guard_low, FLOOR_RATE, self.expected)
        self.low = low
        self.high = high  # up to here a rate is what was expected
        self.designs = _designs(self.expected, low, high, self.settings)
        self._tests = [name for name, _, _ in self.designs]
        self._channel_of = np.array([channel for _, channel, _ in self.designs], np.int64)
        self._state: I64 = np.zeros((len(self.designs), N_STATE), np.int64)
        for row, (_, _, design) in enumerate(self.designs):
            self._state[row, THRESHOLD : SILENT_STEP + 1] = design.threshold, design.click_step, design.silent_step
        # clicks of each channel when the sum was last 0
        self._at_zero: I64 = np.zeros((len(self.designs), n_channels), np.int64)
        self._room: I64 = np.zeros((_ALARM_ROOM, 3 + n_channels), np.int64)

    def update_words(self, words: npt.NDArray[np.uint8]) -> list[Alarm]:
        """Take dark exposures in the order of time, words uint8 (n, bytes), bit c is channel c; exact for each exposure."""
        n = take_words(
            read_only(words), self.exposures, self.clicks, self._state, self._channel_of, self._at_zero, self._room
        )
        self.exposures += len(words)
        return self._alarms(int(n))

    def update(self, dark_exposures: int, clicks_per_channel: I64) -> list[Alarm]:
        """Take a block of which only the counts are known: clicks int64 (n,) in `dark_exposures` exposures.

        The sums are then looked at where blocks end: `S = max(0, S + clicks and silences)`. That is never above the exact sum
        and at most the silent step times the exposures of one block below it, whatever the number of blocks: no more false
        alarms than stated, and an alarm at most about a block later. ValueError for counts that cannot be."""
        clicks, state = np.asarray(clicks_per_channel, np.int64), self._state
        if clicks.shape != (self.n_channels,) or clicks.min() < 0 or clicks.max() > dark_exposures:
            raise ValueError(
                f"clicks {clicks.tolist()} of {self.n_channels} channels in {dark_exposures} exposures cannot be"
            )
        self.clicks += clicks
        self.exposures += dark_exposures
        pooled = self._channel_of == ALL_CHANNELS
        trials: I64 = np.where(pooled, self.n_channels, 1)
        clicked: I64 = np.where(pooled, clicks.sum(), clicks[self._channel_of])
        state[:, SUM] += clicked * state[:, CLICK_STEP] + (dark_exposures * trials - clicked) * state[:, SILENT_STEP]
        state[:, LAST] = self.exposures * trials
        passed = np.flatnonzero(state[:, SUM] >= state[:, THRESHOLD])
        for place, row in enumerate(passed[:_ALARM_ROOM]):
            since = state[row, SINCE] // trials[row]
            self._room[place] = row, self.exposures, since, *(self.clicks - self._at_zero[row])
        state[passed, SUM] = 0
        zero = state[:, SUM] <= 0
        state[zero, SUM], state[zero, SINCE] = 0, state[zero, LAST]
        self._at_zero[zero] = self.clicks
        return self._alarms(len(passed))

    def warm_up(self) -> None:
        """Compile or load the kernel; nothing is counted."""
        self.update_words(np.zeros((0, 1), np.uint8))

    def restart(self) -> None:
        """Begin every test from 0: what their sums hold belongs to a state that is over."""
        self._state[:, SUM] = 0
        self._state[:, SINCE] = self._state[:, LAST]
        self._at_zero[:] = self.clicks

    def sums(self) -> F64:
        """Return every test's sum as a fraction of its threshold, float64 (tests,), for a live view; 1 is an alarm."""
        return self._state[:, SUM] / self._state[:, THRESHOLD]

    def alarm_after(self) -> int | None:
        """Return how many more dark exposures at the rates counted so far lead to an alarm, None where no test would give one."""
        if not self.exposures:
            return None
        own, state, pooled = self.clicks / self.exposures, self._state, self._channel_of == ALL_CHANNELS
        rates = np.where(pooled, own.mean(), own[self._channel_of])
        steps = rates * state[:, CLICK_STEP] + (1 - rates) * state[:, SILENT_STEP]
        gains = steps * np.where(pooled, self.n_channels, 1)
        needed = (state[:, THRESHOLD] - state[:, SUM])[gains > 0] / gains[gains > 0]
        return math.ceil(needed.min()) if len(needed) else None

    def _alarms(self, n: int) -> list[Alarm]:
        alarms = []
        for row in self._room[: min(n, _ALARM_ROOM)]:
            test = int(row[0])
            channel = int(self._channel_of[test])
            expected = float(self.expected.mean() if channel == ALL_CHANNELS else self.expected[channel])
            alarms.append(Alarm(self._tests[test], channel, int(row[1]), int(row[2]), row[3:].copy(), expected))
        return alarms


def _designs(expected: F64, low: F64, high: F64, settings: WatchSettings) -> list[tuple[str, int, CusumDesign]]:
    n = len(expected)
    shares = dict(SHARES)
    if n == 1:  # the one channel's own test sees a drift
        shares["burst"] += shares.pop("drift")
    arl = {test: settings.arl_exposures / share for test, share in shares.items()}
    designs = []
    for channel in range(n):
        rate = float(expected[channel])
        designs.append(("rise", channel, _design(rate, settings.rise_ratio, n * arl["rise"], float(high[channel]))))
        designs.append(("fall", channel, _design(rate, settings.fall_ratio, n * arl["fall"], float(low[channel]))))
    pool, guard = float(expected.mean()), float(high.mean())  # the pool's trial is one channel in one exposure
    designs.append(("burst", ALL_CHANNELS, _design(pool, settings.burst_ratio, n * arl["burst"], guard)))
    if n > 1:
        designs.append(("drift", ALL_CHANNELS, _design(pool, settings.drift_ratio, n * arl["drift"], guard)))
    return designs


@lru_cache(maxsize=512)
def _design(rate: float, ratio: float, arl: float, guard: float) -> CusumDesign:
    """As design_cusum; near 1/2 a rate cannot be doubled, so the test looks for half the way to 1."""
    if ratio > 1 and rate * ratio > 0.5 * (1 + rate):
        ratio = 0.5 * (1 + rate) / rate
    return design_cusum(rate, ratio, arl, guard)


@inner
def _put(zero, row, clicks):  # type: ignore[no-untyped-def]
    """zero[row] = clicks, channel by channel: numba takes seconds to compile the assignment of a slice."""
    for channel in range(clicks.size):
        zero[row, channel] = clicks[channel]


@inner
def _silence(state, row, until, zero, clicks):  # type: ignore[no-untyped-def]
    """Take the silent trials before number `until`; return the trial at which the threshold was passed, else -1."""
    n = until - state[row, LAST]
    if n <= 0:
        return -1
    step, before = state[row, SILENT_STEP], state[row, SUM]
    if step > 0:
        needed = -((before - state[row, THRESHOLD]) // step)  # rounded up
        if needed <= n:
            state[row, LAST] += needed
            return state[row, LAST]
        state[row, SUM] = before + n * step
    elif before + n * step > 0:
        state[row, SUM] = before + n * step
    else:
        state[row, SUM] = 0
        state[row, SINCE] = until
        _put(zero, row, clicks)
    state[row, LAST] = until
    return -1


@inner
def _note(alarms, n, test, exposure, trials, state, zero, clicks):  # type: ignore[no-untyped-def]
    """Write down an alarm and start the test again from 0."""
    if n < alarms.shape[0]:
        alarms[n, 0], alarms[n, 1], alarms[n, 2] = test, exposure, state[test, SINCE] // trials
        for channel in range(clicks.size):
            alarms[n, 3 + channel] = clicks[channel] - zero[test, channel]
    state[test, SUM] = 0
    state[test, SINCE] = state[test, LAST]
    _put(zero, test, clicks)
    return n + 1


@inner
def _catch_up(state, row, until, trials, zero, clicks, alarms, n):  # type: ignore[no-untyped-def]
    """Take silent trials up to `until`, as many alarms as they give."""
    while True:
        passed = _silence(state, row, until, zero, clicks)
        if passed < 0:
            return n
        n = _note(alarms, n, row, passed // trials, trials, state, zero, clicks)


@inner
def _click(state, row, trial, trials, zero, clicks, alarms, n):  # type: ignore[no-untyped-def]
    """Take the click of trial `trial`; the silent ones before it have been taken, and `clicks` holds it already."""
    total = state[row, SUM] + state[row, CLICK_STEP]
    state[row, LAST] = trial + 1
    state[row, SUM] = total
    if total <= 0:
        state[row, SUM], state[row, SINCE] = 0, trial + 1
        _put(zero, row, clicks)
    elif total >= state[row, THRESHOLD]:
        n = _note(alarms, n, row, trial // trials + 1, trials, state, zero, clicks)
    return n


@outer
def take_words(words, first, clicks, state, channel_of, zero, alarms):  # type: ignore[no-untyped-def]
    """Take exposures `first`..., words uint8 (n, bytes); returns the number of alarms. Rows 2c and 2c+1 of `state` are channel c's tests,
    the others the pool's, whose trials are counted channel by channel. clicks int64 (channels,) are totals, updated."""
    channels, found = clicks.size, np.int64(0)
    n_tests = 2 + channel_of.size - 2 * channels  # of one channel and of the pool
    for t in range(words.shape[0]):
        for byte in range(words.shape[1]):
            rest = np.int64(words[t, byte])
            while rest:
                bit = 0
                while not (rest >> bit) & 1:
                    bit += 1
                rest &= rest - 1
                channel = 8 * byte + bit
                if channel >= channels:
                    break
                pooled = (first + t) * channels + channel
                for clicked in range(2):  # the silence before it, then the click
                    clicks[channel] += clicked
                    for test in range(n_tests):
                        row = 2 * channel + test if test < 2 else 2 * channels + test - 2
                        trials = np.int64(1) if test < 2 else channels
                        trial = first + t if test < 2 else pooled
                        if clicked:
                            found = _click(state, row, trial, trials, zero, clicks, alarms, found)
                        else:
                            found = _catch_up(state, row, trial, trials, zero, clicks, alarms, found)
    until = first + words.shape[0]
    for row in range(channel_of.size):
        trials = np.int64(1) if channel_of[row] >= 0 else channels
        found = _catch_up(state, row, until * trials, trials, zero, clicks, alarms, found)
    return found


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
