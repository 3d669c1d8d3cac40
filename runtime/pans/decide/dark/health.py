"""What is wrong with the detector, in plain words: hot and silent channels, light leaks, drift, told apart.

`ChannelHealth.take` turns the alarms of cusum.py into `Finding`s: one when a state begins and one when it ends, however often a test passes
its threshold meanwhile. It tells states apart by which channels differ and how strongly: one channel with most of the excess is *hot*; all
of them at once, five times or more, is a *burst* (a light leak); all of them by less is a *drift*; fewer clicks than expected is *quiet*
(none at all: *dead*). With one detector "all" and "one" are the same, and strength alone decides. `dark_report` compares the dark rate of a
whole run with the profile's.

`DeadChannelTest` finds dead channels in exposures with light; in the dark silence is no news for a long time. It has two tests, each with a
stated number of exposures or objects between false alarms, all channels together:

- *Proved.* Whatever the scene, a living channel clicks at least at its dark rate r in every exposure, lit or not. A silence of n
  exposures has probability (1 - r)^n after each click, so that false alarms come every 1 / (r (1 - r)^n) exposures. For r half the
  lower end of what is expected is taken: a channel that has become quiet is not dead.
- *Inferred*, much sooner. A channel that clicked in a share q of the objects is silent in m of them in a row with probability
  (1 - q)^m after each click; q is the run's own running mean up to its last click, at the lower end of its interval. A scene that
  has come to give a pattern no light looks the same to this channel, but not to the others: a dead channel changes nothing in them,
  other objects do. So the shares of the others since the last click are compared with those before; where they differ the test says
  nothing, and the proof must decide. It assumes that objects come in no order, and that objects without light on one pattern differ from
  the others in other patterns too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import binomial_tail, number, wilson_interval

from .cusum import ALL_CHANNELS, FLOOR_RATE, Alarm, ChannelWatch

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
ALARM_PROBABILITY = 1e-6  # of seeing this many dark clicks or more, if the profile's dark rate were right
BURST_RATIO = 5.0  # of the present to the expected rate, from which an excess is an alarm, and of all channels a burst
WARNING_RATIO = 1.5  # the least ratio that a test looks for (WatchSettings.drift_ratio)
MOST = 0.5  # of the excess: a channel with more of it is the cause
RETURN_EVIDENCE = 14.0  # log likelihood ratio for the expected rate at which a state is over: e^14 to one
LEAST_CHANGE = 1.5  # times, that a state which lasts is taken to differ from what is expected
_UNIT = 1e-6  # of the log likelihood ratio, so that sums are whole numbers
QUIET = 0.5  # of the expected dark rate: less often clicks only a dead channel
MAX_COMPARED = 64  # other channels that are compared, evenly spread
# objects in which a channel has clicked before it is judged by them: its share is then known to about a fifth
LEAST_CLICKED = 30
LEAST_OBJECTS = 8  # in a row without a click
LOOK_AGAIN = 1.25  # times the objects, where the others have changed
# Of the others' changes, in squared standard errors, beyond which the scene is another. One change alone is chi-square with one degree
# of freedom: 12.0 is passed with probability 5e-4. Their mean over d channels has standard deviation sqrt(2 / d): 1.6 lies 1.3 of them
# above 1 for ten channels and 3.4 for MAX_COMPARED. The test errs to the side of saying nothing: then the proof decides, later.
MEAN_Z2_MAX, Z2_MAX = 1.6, 12.0
RETURN_BLOCKS = 3  # with a click: the channel lives
_NEVER = 1 << 62
LEVELS = ("notice", "warning", "alarm")
_CAUSES = {
    "hot": "a hot or noisy channel",
    "burst": "light from outside, or a detector that oscillates",
    "drift": "a warmer detector, a shifted threshold, or stray light",
    "quiet": "a threshold that has risen, a colder detector, or one that loses clicks",
    "dead": "a dead or disconnected channel",
}


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
    after_clicks: bool = False  # found, and counted, in dark exposures within reach of afterpulses

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
        } | ({"after_clicks": True} if self.after_clicks else {})


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
    """The present state of all channels behind one watch, which has seen dark exposures `after_clicks` or others."""

    def __init__(self, watch: ChannelWatch, *, after_clicks: bool = False) -> None:
        self._watch, self._after_clicks = watch, after_clicks
        self._states: dict[tuple[int, ...], _State] = {}

    @property
    def present(self) -> list[Finding]:
        """The states that last, the oldest first; any thread may ask."""
        return [state.finding for state in list(self._states.values())]

    def rates(self) -> F64:
        """Present click probability of a dark exposure, float64 (n,): expected, or estimated since a state began; any thread may ask."""
        rates = self._watch.expected.copy()
        for state in sorted(list(self._states.values()), key=lambda one: -len(one.finding.channels)):
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
        """Channels have been found dead in the light (`DeadChannelTest`): return the finding, none where the state is known."""
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
        words = f"{self._when}{words}"
        return Finding(
            "over", "notice", was.channels, now, was.since, was.expected, was.expected, words, self._after_clicks
        )

    @property
    def _when(self) -> str:
        return "right after clicks " if self._after_clicks else ""

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
        length = alarm.exposure - alarm.since
        ends = wilson_interval(int(alarm.clicks[list(channels)].sum()), alarm.exposures * len(channels))
        between = " to ".join(number(end / expected) for end in ends)
        words = (
            f"{self._when}{_who(channels, watch.n_channels)} {number(ratio)} times as often as expected in the dark "
            f"(95 % interval {between}; "
            f"{rate:.3g} per exposure, expected {expected:.3g}) in the {length} dark exposures before it was noticed: {_CAUSES[kind]}"
        )
        return Finding(kind, level, channels, alarm.exposure, alarm.since, rate, expected, words, self._after_clicks)

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
    findings: tuple[dict[str, Any], ...] = ()  # states of the detector that began or ended, in order
    present: tuple[str, ...] = ()  # those that last, in words
    # exposures, clicks, rate and interval by channel, where a guard watched
    channels: tuple[dict[str, float], ...] = ()


def dark_report(expected: float, exposures: int, clicks: int) -> DarkReport:
    """Return the estimate from tallied dark clicks, its interval, and the alarm's sentence ("" if none) where they contradict `expected`,
    the click probability of a dark exposure.
    """
    low, high = wilson_interval(clicks, exposures)
    rate = clicks / exposures if exposures else 0.0
    alarm = ""
    if exposures and binomial_tail(clicks, exposures, expected) < ALARM_PROBABILITY:
        alarm = (
            f"{clicks} clicks in {exposures} dark exposures, expected are {expected * exposures:.3g}: "
            "look for stray light, a warm detector or a wrong threshold"
        )
    return DarkReport(exposures, clicks, rate, low, high, expected, alarm)


class Silence(NamedTuple):
    """A channel found dead: `length` exposures (proved) or objects (inferred) without a click, `rate` per one of them expected."""

    channel: int
    proved: bool
    length: int
    rate: float


class DeadChannelTest:
    """Follows the silence of `n` channels; all memory is allocated here, before arming.

    `dark_low` float64 (n,) are the lower ends of their dark rates; `arl_exposures` lie between false proofs and `arl_objects`
    between false inferences, of any channel, in the mean.
    """

    def __init__(self, dark_low: F64, arl_exposures: float, arl_objects: float) -> None:
        n = len(dark_low)
        self.n_channels = n
        self.silent: I64 = np.zeros(n, np.int64)  # exposures since the last block with a click
        self.clicking: I64 = np.zeros(n, np.int64)  # blocks with a click
        self.objects = 0
        self.clicked: I64 = np.zeros(n, np.int64)  # objects with a click
        self._proofs = np.array(
            [silence_limit(max(FLOOR_RATE, QUIET * float(low)), n, arl_exposures) for low in dark_low], np.int64
        )
        self._dark, self._limits = dark_low, self._proofs.copy()
        self._arl_objects = arl_objects
        self._compared: I64 = np.unique(np.linspace(0, n - 1, min(n, MAX_COMPARED)).round().astype(np.int64))
        self._clicks = np.zeros(n, np.bool_)  # which channels have clicked in the object under way
        self._object, self._open = -1, False
        self._quiet: I64 = np.zeros(n, np.int64)  # objects since the one of the last click
        self._then: I64 = np.zeros((n, len(self._compared)), np.int64)  # `clicked` of the compared channels at that one
        self._first: I64 = np.full(n, LEAST_OBJECTS, np.int64)  # objects of silence at which a channel is looked at
        self._due: I64 = self._first.copy()
        self._told: I64 = np.full(n, -1, np.int64)  # of the dead: `clicking` when they were told of
        self._any_due, self._n_told = False, 0

    def take_exposures(self, words: U8) -> None:
        """Take the exposures of a block, lit or dark: words uint8 (n, bytes), bit c is channel c.

        A channel that clicked in the block is silent for 0 exposures at its end: no silence is ever counted too long.
        """
        if len(words):
            clicked = np.unpackbits(
                any_click(words, np.zeros(1, np.int64))[0], count=self.n_channels, bitorder="little"
            )
            self.take_counts(len(words), clicked)

    def take_counts(self, exposures: int, clicks: NDArray[np.integer]) -> None:
        """Take exposures of which only the clicks of each channel are known, (n,)."""
        silent = clicks == 0
        self.clicking += ~silent
        self.silent += exposures
        self.silent *= silent
        self._any_due |= bool((self.silent >= self._limits).any())

    @property
    def has_news(self) -> bool:
        """Whether `look` or `returned` may have something to tell; cheap."""
        return self._any_due or self._n_told > 0

    def take_objects(self, clicked: NDArray[np.bool_], numbers: I64, *, look_between: bool = False) -> bool:
        """Take which channels clicked in windows that followed one another, bool (m, n), of objects `numbers` int64 (m,).

        Neighbours with the same number are one object, -1 is always another. With `look_between` nothing is done, and False returned,
        where `look` might find something before the last window has been taken.
        """
        begins = np.flatnonzero((np.diff(numbers, prepend=self._object if self._open else -1) != 0) | (numbers < 0))
        if not len(begins) or begins[0] > 0:  # the object under way goes on
            begins = np.append(0, begins)
            objects = np.logical_or.reduceat(clicked, begins)
            objects[0] |= self._clicks
        else:
            objects = np.logical_or.reduceat(clicked, begins)
            if self._open:
                objects = np.concatenate([self._clicks[None], objects])
        if not self._end_objects(objects[:-1], look_between):
            return False
        self._clicks, self._object, self._open = objects[-1], int(numbers[-1]), True
        return True

    def end_object(self) -> None:
        """The object under way has gone: what comes next is another."""
        if self._open:
            self._end_objects(self._clicks[None], False)
            self._open = False

    def _end_objects(self, clicked: NDArray[np.bool_], look_between: bool) -> bool:
        """Account for objects that have gone, with the channels that clicked in each, bool (m, n); see `take_objects`."""
        if not len(clicked):
            return True
        number = np.arange(1, len(clicked) + 1)[:, None]
        last = np.maximum.accumulate(np.where(clicked, number, 0))  # the object of the last click, 0: before these
        quiet = np.where(last > 0, number - last, self._quiet + number)
        due = bool((quiet >= np.where(last > 0, self._first, self._due)).any())
        if due and look_between:
            return False
        totals = self.clicked + np.cumsum(clicked, axis=0)
        clicking = np.flatnonzero(last[-1])
        self._then[clicking] = totals[last[-1][clicking] - 1][:, self._compared]
        self._due[clicking] = self._first[clicking]
        self.objects, self.clicked, self._quiet = self.objects + len(clicked), totals[-1], quiet[-1]
        self._any_due |= due
        return True

    def look(self) -> list[Silence]:
        """Return the channels that have been found dead since the last look; no work where none has been silent for long."""
        if not self._any_due:
            return []
        self._any_due = False
        found = [
            Silence(channel, True, int(self.silent[channel]), float(self._dark[channel]))
            for channel in np.flatnonzero(self.silent >= self._limits).tolist()
        ]
        for channel in np.flatnonzero((self._quiet >= self._due) & (self.silent < self._limits)).tolist():
            found += self._judge(channel)
        self._n_told += len(found)
        for silence in found:
            self._told[silence.channel] = self.clicking[silence.channel]
            self._limits[silence.channel] = self._due[silence.channel] = _NEVER  # until it has clicked again
        return found

    def returned(self) -> list[int]:
        """Return the dead channels that click again, once."""
        dead = np.flatnonzero(self._told >= 0)
        if not len(dead):
            return []
        back = dead[self.clicking[dead] >= self._told[dead] + RETURN_BLOCKS]
        self._told[back], self._limits[back] = -1, self._proofs[back]
        self._n_told -= len(back)
        return [int(channel) for channel in back]

    def _judge(self, channel: int) -> list[Silence]:
        """Is a channel that was silent in the last objects dead? Set when it is looked at again where that cannot be said."""
        quiet = int(self._quiet[channel])
        before, clicked = self.objects - quiet, int(self.clicked[channel])
        rate = wilson_interval(clicked, before)[0] if clicked >= LEAST_CLICKED else 0.0
        limit = silence_limit(rate, self.n_channels, self._arl_objects) if rate > 0 else 2 * quiet
        self._first[channel] = max(LEAST_OBJECTS, min(limit, _NEVER))
        if quiet < limit:
            self._due[channel] = self._first[channel]
            return []
        if not self._others_as_before(channel, before, quiet):
            self._due[channel] = math.ceil(LOOK_AGAIN * quiet)
            return []
        return [Silence(channel, False, quiet, clicked / before)]

    def _others_as_before(self, channel: int, before: int, quiet: int) -> bool:
        others = self._compared != channel
        if not others.any():
            return True  # one detector
        then = self._then[channel, others].astype(np.float64)
        since = self.clicked[self._compared[others]] - then
        share = (then + since) / (before + quiet)
        varies = (share > 0) & (share < 1)
        if not varies.any():
            return False  # nothing else clicks, or all do: they say nothing
        error2 = (share * (1 - share) * (1 / before + 1 / quiet))[varies]
        z2 = (since[varies] / quiet - then[varies] / before) ** 2 / error2
        return bool(z2.mean() <= MEAN_Z2_MAX and z2.max() <= Z2_MAX)


def any_click(words: U8, begins: I64, lit: NDArray[np.bool_] | None = None) -> U8:
    """Return the channels that clicked in each run of exposures, uint8 (runs, bytes): words uint8 (n, bytes), runs from `begins` on.

    `lit` bool (n,) leaves the others out.
    """
    kind = {1: np.uint8, 2: np.uint16, 4: np.uint32, 8: np.uint64}.get(words.shape[1])
    if kind is None or not words.flags.c_contiguous:
        return np.bitwise_or.reduceat(words if lit is None else np.where(lit[:, None], words, 0), begins)
    whole = words.view(kind)[:, 0]
    found = np.bitwise_or.reduceat(whole if lit is None else whole * lit, begins)
    return found.view(np.uint8).reshape(-1, words.shape[1])


def silence_limit(rate: float, n_channels: int, arl: float) -> int:
    """Return after how many silent trials in a row a channel that clicks with probability `rate` is taken for dead.

    False alarms of `n_channels` such channels lie `arl` trials apart in the mean: a silence of n begins with each click, so
    they come every 1 / (n_channels rate (1 - rate)^n) trials.
    """
    if rate >= 1.0:
        return 1
    needed = math.log(max(1.0, arl * n_channels * rate)) / -math.log1p(-rate)
    return max(1, math.ceil(min(needed, float(_NEVER))))
