"""What is wrong with the detector, in plain words: hot and silent channels, light leaks, drift, told apart from the watch's alarms.

Owns the naming of causes, their levels, which state lasts, and the dark rate of a whole run beside the profile's (`DarkMonitor`); never
counts clicks (cusum.py) and never acts (dark_guard.py). `ChannelHealth.take` turns alarms into `Finding`s: one when a state begins
and one when it ends, however often a test passes its threshold meanwhile.

Told apart by who is concerned and how strongly: one channel with most of the excess is *hot*; all of them at once, five times
or more, is a *burst* (a light leak); all of them by less is a *drift*; fewer clicks than expected is *quiet* (none at all:
*dead*). With one detector "all" and "one" are the same, and strength alone decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.intervals import binomial_tail, wilson_interval

from .cusum import ALL_CHANNELS, Alarm, ChannelWatch

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
ALARM_PROBABILITY = 1e-6  # of seeing this many dark clicks or more, if the profile's dark rate were right
BURST_RATIO = 5.0  # of the present to the expected rate, from which an excess is an alarm, and of all channels a burst
WARNING_RATIO = 1.5  # the least ratio that a test looks for (WatchSettings.drift_ratio)
MOST = 0.5  # of the excess: a channel with more of it is the cause
RETURN_EVIDENCE = 14.0  # log likelihood ratio for the expected rate at which a state is over: e^14 to one
LEAST_CHANGE = 1.5  # times, that a state which lasts is taken to differ from what is expected
_UNIT = 1e-6  # of the log likelihood ratio, so that sums are whole numbers
LEVELS = ("notice", "warning", "alarm")


@dataclass(frozen=True, slots=True)
class Finding:
    """One state of the detector that began or ended; rates are clicks per dark exposure and channel."""

    kind: str  # hot, burst, drift, quiet, dead; "over" when one of them ended
    level: str  # notice, warning, alarm
    channels: tuple[int, ...]  # all of them for burst and drift
    exposure: int  # dark exposures so far
    since: int  # the dark exposure at which it began, estimated
    rate: float
    expected: float
    words: str

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        return {
            "kind": "dark_state",
            "state": self.kind,
            "level": self.level,
            "channels": list(self.channels),
            "dark_exposure": self.exposure,
            "since_dark_exposure": self.since,
            "rate": self.rate,
            "expected": self.expected,
            "words": self.words,
        }


@dataclass(slots=True)
class _State:
    """A state that lasts: what was found, the counts since then, and the evidence that it is over."""

    finding: Finding
    exposures: int
    clicks: int
    last: I64  # the watch's totals at the latest look
    evidence: int = 0
    since_exposure: int = field(default=0)


class ChannelHealth:
    """The present state of all channels behind one watch."""

    def __init__(self, watch: ChannelWatch) -> None:
        self._watch = watch
        self._states: dict[tuple[int, ...], _State] = {}

    @property
    def present(self) -> list[Finding]:
        """The states that last, the oldest first."""
        return [state.finding for state in self._states.values()]

    def rates(self) -> F64:
        """Present click probability of a dark exposure, float64 (n,): expected, or estimated since a state began."""
        rates = self._watch.expected.copy()
        for state in sorted(self._states.values(), key=lambda one: -len(one.finding.channels)):
            channels = list(state.finding.channels)
            rates[channels] = state.clicks / max(1, state.exposures * len(channels))
        return rates

    def take(self, alarms: Sequence[Alarm]) -> list[Finding]:
        """Digest the alarms of the exposures that the watch has just taken; call it after every update, also without alarms."""
        findings = self._look_again()
        for alarm in sorted(alarms, key=lambda one: one.exposure):
            finding = self._name(alarm)
            if any(set(finding.channels) <= set(channels) for channels in self._states):
                continue  # known already
            for channels in [channels for channels in self._states if set(channels) <= set(finding.channels)]:
                del self._states[channels]  # what looked like one channel is all of them
            chosen = alarm.clicks[list(finding.channels)]
            self._states[finding.channels] = _State(
                finding, alarm.exposures, int(chosen.sum()), self._watch.clicks.copy(), 0, self._watch.exposures
            )
            findings.append(finding)
        return findings

    def note_dead(self, channels: tuple[int, ...], words: str) -> list[Finding]:
        """Channels have been found dead by other means (dead_channels.py): return the finding, none where the state is known."""
        known = [state.finding for held, state in self._states.items() if set(channels) <= set(held)]
        if any(finding.kind == "dead" for finding in known):
            return []
        for held in [held for held in self._states if set(held) <= set(channels)]:
            del self._states[held]
        now, expected = self._watch.exposures, float(self._watch.expected[list(channels)].mean())
        level = "alarm" if len(channels) == self._watch.n_channels else "warning"
        finding = Finding("dead", level, channels, now, now, 0.0, expected, words)
        self._states[channels] = _State(finding, 0, 0, self._watch.clicks.copy(), 0, now)
        return [finding]

    def note_returned(self, channel: int) -> list[Finding]:
        """A channel clicks again: return that its being dead is over, nothing where it was not taken for dead."""
        over = []
        for channels, state in list(self._states.items()):
            if channel in channels and state.finding.kind == "dead":
                del self._states[channels]
                over.append(self._over(state))
        return over

    def _look_again(self) -> list[Finding]:
        """Add what came since to every state, and end those whose channels click as expected again."""
        over = []
        for channels, state in list(self._states.items()):
            chosen = list(channels)
            fresh = self._watch.exposures - state.since_exposure
            clicks = int((self._watch.clicks - state.last)[chosen].sum())
            if not fresh:
                continue
            trials = fresh * len(chosen)
            expected = float(self._watch.expected[chosen].mean())
            present = _present(state, len(chosen), expected)
            hit, miss = math.log(expected / present), math.log1p(-expected) - math.log1p(-present)
            gain = round(hit / _UNIT) * clicks + round(miss / _UNIT) * (trials - clicks)
            state.evidence = max(0, state.evidence + gain)
            state.exposures, state.clicks = state.exposures + fresh, state.clicks + clicks
            state.last, state.since_exposure = self._watch.clicks.copy(), self._watch.exposures
            if state.evidence * _UNIT > RETURN_EVIDENCE:
                del self._states[channels]
                self._watch.restart()
                over.append(self._over(state))
        return over

    def _over(self, state: _State) -> Finding:
        was, now = state.finding, self._watch.exposures
        length = now - was.since
        words = f"{_who(was.channels, self._watch.n_channels)} as expected again: {was.kind} is over after about {length} dark exposures"
        return Finding("over", "notice", was.channels, now, was.since, was.expected, was.expected, words)

    def _name(self, alarm: Alarm) -> Finding:
        watch = self._watch
        channels, rate, expected = self._concerned(alarm)
        ratio = rate / expected
        whole = len(channels) == watch.n_channels
        if ratio < 1:
            kind = "dead" if rate == 0 else "quiet"
        elif whole:
            kind = "burst" if ratio >= BURST_RATIO else "drift"
        else:
            kind = "hot"
        level = "alarm" if ratio >= BURST_RATIO else "warning" if ratio >= WARNING_RATIO else "notice"
        words = _words(kind, channels, ratio, rate, expected, alarm.exposure - alarm.since, watch.n_channels)
        return Finding(kind, level, channels, alarm.exposure, alarm.since, rate, expected, words)

    def _concerned(self, alarm: Alarm) -> tuple[tuple[int, ...], float, float]:
        """Return the channels concerned, their rate since the change, and the expected one."""
        watch = self._watch
        everyone = tuple(range(watch.n_channels))
        if watch.n_channels == 1:
            return everyone, alarm.rate, float(watch.expected[0])
        own = alarm.clicks / alarm.exposures
        excess = own - watch.expected
        if alarm.test == "fall":
            return (alarm.channel,), alarm.rate, float(watch.expected[alarm.channel])
        worst = int(np.argmax(excess)) if alarm.channel == ALL_CHANNELS else alarm.channel
        others = float(excess.sum() - excess[worst])
        significant = others > 0 and others * alarm.exposures > 4.0 * math.sqrt(
            float(watch.expected.sum()) * alarm.exposures
        )
        alone = excess[worst] > MOST * float(np.maximum(excess, 0.0).sum()) or not significant
        if alone:
            return (worst,), float(own[worst]), float(watch.expected[worst])
        return everyone, float(own.mean()), float(watch.expected.mean())


def _present(state: _State, n_channels: int, expected: float) -> float:
    """The rate held against the expected one: the nearer end of its interval, since an alarm may come after a click or two."""
    low, high = wilson_interval(state.clicks, state.exposures * n_channels)
    if state.finding.rate > expected:
        return max(low, min(LEAST_CHANGE * expected, 0.5 * (1 + expected)))
    return min(high, expected / LEAST_CHANGE)


def _who(channels: tuple[int, ...], n_channels: int) -> str:
    if n_channels == 1:
        return "the detector clicks"
    if len(channels) == n_channels:
        return "all channels click"
    return f"channel {', '.join(map(str, channels))} clicks"


def _words(
    kind: str, channels: tuple[int, ...], ratio: float, rate: float, expected: float, length: int, n_channels: int
) -> str:
    causes = {
        "hot": "a hot or noisy channel",
        "burst": "light from outside, or a detector that oscillates",
        "drift": "a warmer detector, a shifted threshold, or stray light",
        "quiet": "a threshold that has risen, a colder detector, or one that loses clicks",
        "dead": "a dead or disconnected channel",
    }
    return (
        f"{_who(channels, n_channels)} {ratio:.3g} times as often as expected in the dark ({rate:.3g} per exposure, "
        f"expected {expected:.3g}) for about {length} dark exposures: {causes[kind]}"
    )


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
