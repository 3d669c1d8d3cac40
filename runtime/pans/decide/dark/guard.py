"""From dark exposures to consequences: the watch, what it means, and what the policy does about it, for one core.

Changes are found by decide/dark/cusum.py and named by decide/dark/health.py. The same blocks give the same findings and the same
decisions, live and in a replay. A core gives it every block, asks `flags` and `decider` for every decision, and passes its findings on.

Policies: `warn` tells and changes no decision; `tables` decides with a table for the present dark rates, without dead channels; `mask`
leaves channels out that are hot, quiet or dead; both abstain where all are left out, or more than can be done;
`abstain` gives no label while a warning or an alarm lasts. Decisions made meanwhile carry DARK_ALARM, but for `warn`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.errors import UsageError
from pans.base.numbers import wilson_interval
from pans.bundle.backends import (
    Decider,
    TableDecider,
    Verdict,
    count_table,
    fits_count_table,
    n_features_of,
    softmax_winner,
)
from pans.bundle.sensor import Bundle
from pans.decide.decision import DecisionFlag
from pans.decide.plan.plan import Plan
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT, ClickBlock, FrameBlock

from .cusum import FLOOR_RATE, Alarm, ChannelWatch, WatchSettings
from .health import LEVELS, ChannelHealth, DarkReport, DeadChannelTest, Finding, Silence, dark_report

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
MOST_AFTER_CLICKS = 0.49  # a test for twice the chance needs one below a half
PRIOR_WORDS = 200.0  # words' worth of the channels' own rates, beside what was seen
MAX_MIXED = 256  # answers of a head that one decision may average


class Adapter(Protocol):
    """Remembers what comes while nothing is wrong, and makes back ends for when something is."""

    def count(self, counts: I64) -> None:
        """Remember one window's clicks, int64 (d_f,)."""

    def can_do(self, concerned: NDArray[np.bool_]) -> bool:
        """Whether a decision can be made with these channels masked or clicking more, bool (d_f,)."""

    def made(self, ordinary: Decider, extra: F64, masked: NDArray[np.bool_]) -> Decider:
        """Return the back end for silent exposures that click with `extra` float64 (d_f,), without channels `masked` bool (d_f,)."""


def make_adapter(bundle: Bundle, shots: int) -> Adapter:
    """Return what adapts `bundle`'s decisions over `shots` shots; UsageError for a bundle that gives pictures."""
    if bundle.automaton is not None:
        raise UsageError(
            f"{bundle.name} is an automaton: a dark click has already led to another pattern, so that no table mends it afterwards",
            remedy="use --on-dark abstain, or train for the present dark rate",
        )
    if bundle.largest > 1:
        raise UsageError(
            f"{bundle.name} takes photon numbers: no other decisions are made for dark counts of another rate",
            remedy="use --on-dark abstain",
        )
    if bundle.picture_shape is not None:
        raise UsageError("a bundle that gives pictures decides nothing", remedy="use --on-dark abstain")
    if shots == 1 and bundle.table is not None:
        return TableAdapter(bundle.table, 2)
    if bundle.head_onnx is None:
        raise UsageError(
            f"{bundle.name} has only a table of single clicks, which cannot answer {shots} shots",
            remedy="use --shots 1, or --on-dark abstain",
        )
    if fits_count_table(bundle.n_features, shots):
        return TableAdapter(count_table(bundle, shots).scores, shots + 1)
    return HeadAdapter(bundle.n_features, shots)


class TableAdapter:
    """For all vectors of counts, `scores` float32 (base**d_f, classes), `base` = K + 1."""

    def __init__(self, scores: NDArray[np.float32], base: int) -> None:
        self._scores, self._base = scores, base
        self._seen: I64 = np.zeros(len(scores), np.int64)
        self._radix = base ** np.arange(n_features_of(len(scores), base), dtype=np.int64)

    def count(self, counts: I64) -> None:
        """See Adapter."""
        self._seen[int(counts @ self._radix)] += 1

    def can_do(self, concerned: NDArray[np.bool_]) -> bool:
        """See Adapter: always."""
        return True

    def made(self, ordinary: Decider, extra: F64, masked: NDArray[np.bool_]) -> Decider:
        """See Adapter."""
        scores = adapted_scores(self._scores, word_prior(self._seen, self._base), extra, masked, self._base)
        return TableDecider(scores, self._base - 1, self._base - 1, {"why": "made for the present dark rates"})


class HeadAdapter:
    """For a head of `n_features` channels and `shots` shots whose vectors of counts are too many."""

    def __init__(self, n_features: int, shots: int) -> None:
        self._shots = shots
        self._seen: I64 = np.zeros((n_features, shots + 1), np.int64)
        self._rows = np.arange(n_features)

    def count(self, counts: I64) -> None:
        """See Adapter."""
        self._seen[self._rows, counts] += 1

    def can_do(self, concerned: NDArray[np.bool_]) -> bool:
        """See Adapter: as long as there are at most MAX_MIXED vectors."""
        return (self._shots + 1) ** int(np.count_nonzero(concerned)) <= MAX_MIXED

    def made(self, ordinary: Decider, extra: F64, masked: NDArray[np.bool_]) -> Decider:
        """See Adapter; the caller has asked `can_do`."""
        channels = np.flatnonzero(masked | (extra > 0))
        weights = [
            meant(self._seen[channel], float(extra[channel]), bool(masked[channel])) for channel in channels.tolist()
        ]
        return MixedHead(ordinary, self._shots, channels, weights)


def word_prior(seen: I64, base: int = 2) -> F64:
    """Return P(c) float64 (base**d_f,) from how often each vector was `seen`, int64 (base**d_f,): seen, and smoothed by
    independent channels.
    """
    total = float(seen.sum())
    product = np.ones(1)
    digits = np.arange(len(seen))
    for _ in range(n_features_of(len(seen), base)):
        own = np.bincount(digits % base, weights=seen, minlength=base)
        rates = (own + 0.5) / (total + 0.5 * base)
        rates[0] = 1.0 - rates[1:].sum()
        product = np.concatenate([product * rate for rate in rates])
        digits //= base
    return (seen + PRIOR_WORDS * product) / (total + PRIOR_WORDS)


def adapted_scores(
    scores: NDArray[np.float32], prior: F64, extra: F64, masked: NDArray[np.bool_], base: int = 2
) -> NDArray[np.float32]:
    """Return scores float32 (base**d_f, classes) for a detector with more dark clicks and masked channels.

    `extra` float64 (d_f,) is the probability that a silent exposure clicks now and did not before, `masked` bool (d_f,). Rows
    of masked channels are equal whatever their counts are.
    """
    wide = scores.astype(np.float64)
    wide -= wide.max(axis=1, keepdims=True)
    joint = np.exp(wide)
    joint *= (prior / joint.sum(axis=1))[:, None]
    n_features, n_classes = len(extra), joint.shape[1]
    for feature in range(n_features):
        view = joint.reshape(base ** (n_features - 1 - feature), base, base**feature, n_classes)
        if masked[feature]:
            view[:] = view.sum(axis=1, keepdims=True)
            continue
        moves = dark_clicks(base - 1, float(extra[feature]))
        for count in range(base - 2, -1, -1):  # from above: what has moved up does not move again
            before = view[:, count].copy()
            for more in range(count + 1, base):
                turned = moves[count, more] * before
                view[:, more] += turned
                view[:, count] -= turned
    return np.log(np.maximum(joint, 1e-300)).astype(np.float32)


def dark_clicks(shots: int, extra: float) -> F64:
    """Return P(c' | c) float64 (K+1, K+1): each of the K - c silent exposures of `shots` clicks with probability `extra`."""
    moves = np.zeros((shots + 1, shots + 1))
    for count in range(shots + 1):
        silent = shots - count
        for more in range(silent + 1):
            moves[count, count + more] = math.comb(silent, more) * extra**more * (1.0 - extra) ** (silent - more)
    return moves


def meant(seen: I64, extra: float, masked: bool) -> F64:
    """Return P(c | c') float64 (K+1 found, K+1 meant) on one channel that was `seen` to give each count, int64 (K+1,)."""
    own = (seen + 0.5) / (seen.sum() + 0.5 * len(seen))
    if masked:
        return np.tile(own, (len(seen), 1))
    joint = (own[:, None] * dark_clicks(len(seen) - 1, extra)).T
    weights: F64 = joint / joint.sum(axis=1, keepdims=True)
    return weights


def extra_probability(present: F64, before: F64) -> F64:
    """The probability that an exposure which would have been silent clicks now: of dark clicks beyond those the table knows, at
    least 0.
    """
    return np.maximum(1.0 - (1.0 - present) / (1.0 - before), 0.0)


class MixedHead(Decider):
    """A head asked for all that some channels may have meant: `weights[i]` float64 (found, meant) of channel `channels[i]`."""

    name = "mixed"

    def __init__(self, head: Decider, shots: int, channels: I64, weights: list[F64]) -> None:
        self.n_features, self.n_classes = head.n_features, head.n_classes
        self._head, self._shots, self._channels, self._weights = head, shots, channels, weights
        grids = np.meshgrid(*[np.arange(shots + 1)] * len(channels), indexing="ij")
        self._meant = np.stack([grid.ravel() for grid in grids], axis=1)  # (vectors, channels)
        self._rows: I64 = np.zeros((len(self._meant), head.n_features), np.int64)

    def decide(self, counts: I64, shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,)."""
        return softmax_winner(self._mixed(counts, shots))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the logs of the mixed probabilities, float32 (n, classes), of click counts (n, d_f)."""
        return np.array([self._mixed(row, shots) for row in np.asarray(counts)], np.float32)

    def decide_batch(self, counts: ArrayLike, shots: int) -> I64:
        """Return the labels, int64 (n,), of click counts (n, d_f)."""
        return self.scores_batch(counts, shots).argmax(axis=1).astype(np.int64)

    def _mixed(self, counts: I64, shots: int) -> F64:
        self._rows[:] = counts
        self._rows[:, self._channels] = self._meant
        wide = self._head.scores_batch(self._rows, shots).astype(np.float64)
        wide -= wide.max(axis=1, keepdims=True)
        chances = np.exp(wide)
        weight = np.ones(len(chances))
        for column, (channel, weights) in enumerate(zip(self._channels.tolist(), self._weights)):
            weight *= weights[int(counts[channel]), self._meant[:, column]]
        mixed: F64 = np.log(np.maximum((weight / chances.sum(axis=1)) @ chances, 1e-300))
        return mixed


POLICIES = ("warn", "tables", "mask", "abstain")
# From so many dark exposures on, it is a fault if each followed a click. If one in four usually does not, that happens by chance once
# in a million runs: 0.75^48.
UNWATCHED_MOST = 48
MAX_FINDINGS = 1000  # kept for the summary; the recording has them all


class DarkGuard:
    """Watches the dark exposures of one run and does what `policy` says."""

    def __init__(
        self,
        plan: Plan,
        watch: ChannelWatch,
        policy: str = "warn",
        bundle: Bundle | None = None,
        shots: int = 1,
        afterpulses: int = 0,
        lit: DeadChannelTest | None = None,
        behind: ChannelWatch | None = None,
    ) -> None:
        if policy not in POLICIES:
            raise UsageError(f"--on-dark {policy!r}, allowed: {', '.join(POLICIES)}")
        self._parallel, self._at_once = plan.mode == "parallel", plan.channels_at_once
        self._adapter: Adapter | None = None
        if policy in ("tables", "mask"):
            if bundle is None:
                raise UsageError(f"--on-dark {policy} needs a bundle")
            self._adapter = make_adapter(bundle, shots)
        self._n_features = plan.n_patterns
        self.policy, self.watch, self.health = policy, watch, ChannelHealth(watch)
        self.lit = lit  # finds dead channels in lit exposures; None: dark ones alone tell
        # Dark exposures within reach of afterpulses: only more clicks than the highest chance of one tell anything.
        self.behind = behind
        self._health_behind = None if behind is None else ChannelHealth(behind, after_clicks=True)
        self._news: list[Finding] = []
        self.findings: list[Finding] = []
        self.dropped_findings = 0
        self._dark_slot = plan.slot_pattern == DARK_PATTERN
        self._afterpulses = int(afterpulses)  # so many exposures after a click are judged apart; 0: none
        self._any_dark = bool(self._dark_slot.any())
        self._silent_before = 0  # exposures without a click before the next block, as far as is known
        self._next = 0
        self._made: Decider | None = None
        self._made_for: tuple[Any, ...] = ()

    def warm_up(self) -> None:
        """Compile or load the kernels, before arming."""
        for watch in filter(None, (self.watch, self.behind)):
            watch.warm_up()

    def restart(self) -> None:
        """Follow another stream: its exposures count from 0 again, the rates go on."""
        if self.lit is not None:
            self.lit.end_object()
        self._next = self._silent_before = 0

    def take(self, block: ClickBlock | FrameBlock) -> list[Finding]:
        """Take a block: its dark exposures, and what its lit ones say about dead channels; return the findings.

        With one detector that afterpulses, dark exposures close after a click are held against the highest chance of an afterpulse.
        """
        if self.lit is not None:
            words = block.words if isinstance(block, FrameBlock) else self._words(block)
            self.lit.take_exposures(words)
            self._look_for_dead()
        events = self._take_dark(block)
        return self.news() + events

    def take_object(self, counts: NDArray[np.int64], number: int) -> None:
        """Take the clicks of a whole window, int64 (d_f,), of object `number` (NO_OBJECT: one of its own).

        What it says holds from this decision on; `news` has the findings.
        """
        of_channels = counts if self._parallel else counts.reshape(-1, self._at_once).sum(axis=0)
        self.take_objects(of_channels[None] > 0, np.array([number]))

    def take_objects(self, clicked: NDArray[np.bool_], numbers: NDArray[np.integer[Any]]) -> None:
        """Take which channels clicked in windows that followed one another, bool (n, channels), and the objects in them, (n,)."""
        if self.lit is None or not len(numbers):
            return
        objects: I64 = np.where(numbers == NO_OBJECT, -1, numbers.astype(np.int64))
        waiting = [(0, len(numbers))]
        while waiting:  # where something may be found, window by window
            first, stop = waiting.pop()
            if not self.lit.take_objects(clicked[first:stop], objects[first:stop], look_between=stop - first > 1):
                middle = (first + stop) // 2
                waiting += (middle, stop), (first, middle)
            else:
                self._look_for_dead()

    def news(self) -> list[Finding]:
        """Return what was found with objects, once."""
        news, self._news = self._news, []
        return news

    def _look_for_dead(self) -> None:
        """Ask the test of lit exposures what it has found, if it has."""
        assert self.lit is not None
        if not self.lit.has_news:
            return
        found = [one for channel in self.lit.returned() for one in self.health.note_returned(channel)]
        dead = self.lit.look()
        if len(dead) > 1 and len(dead) == self.lit.n_channels:
            words = _silence_words("no channel", True, dead[0])
            found += self.health.note_dead(tuple(range(len(dead))), words)
        else:
            for one in dead:
                several = self.lit.n_channels > 1
                who = f"channel {one.channel} never" if several else "the detector never"
                found += self.health.note_dead((one.channel,), _silence_words(who, several, one))
        self._news += self._keep(found)

    def _take_dark(self, block: ClickBlock | FrameBlock) -> list[Finding]:
        if isinstance(block, FrameBlock):
            if not self._any_dark:
                return []
            dark = cut_out(self._dark_slot, block.exposure_index, len(block.words))
            return self.take_dark_words(np.ascontiguousarray(block.words[dark]))
        words, dark = self._words(block), np.asarray(block.patterns) == DARK_PATTERN
        if not self._afterpulses:
            return self.take_dark_words(words[dark])
        bits = words[:, 0]
        if block.exposure_index != self._next:
            self._silent_before = 0
        places = np.arange(len(bits) + 1)
        last = np.maximum.accumulate(
            np.append(-1 - self._silent_before, np.where(bits != 0, places[:-1], -1 - self._silent_before))
        )
        silent = places - 1 - last  # exposures without a click before each one, and before the next block
        self._next, self._silent_before = block.exposure_index + len(bits), int(silent[-1])
        far = silent[:-1] >= self._afterpulses
        return self.take_dark_words(words[dark & far]) + self._take_behind(words[dark & ~far])

    def _take_behind(self, words: NDArray[np.uint8]) -> list[Finding]:
        """Take dark exposures within reach of afterpulses, words uint8 (n, 1)."""
        if self.behind is None or self._health_behind is None or not len(words):
            return []
        return self._keep(self._health_behind.take(self.behind.update_words(words)))

    def _words(self, block: ClickBlock) -> NDArray[np.uint8]:
        """Which channels clicked in each exposure, uint8 (n, 1), bit c is channel c; of photon numbers all above 0 are a click."""
        bits = np.asarray(block.bits)
        return (bits if block.largest == 1 or self._at_once > 1 else (bits != 0).astype(np.uint8)).reshape(-1, 1)

    def take_dark_words(self, words: NDArray[np.uint8]) -> list[Finding]:
        """Take dark exposures, words uint8 (n, bytes), in the order of time; return the findings."""
        return self._found(self.watch.update_words(words)) if len(words) else []

    def take_empty(self, frames: int, clicks: NDArray[np.int64]) -> list[Finding]:
        """Take `frames` frames of an empty field of which only the clicks of each channel are known, int64 (n,); return the findings."""
        if not frames:
            return []
        if self.lit is not None:
            self.lit.take_counts(frames, clicks)
            self._look_for_dead()
        return self.news() + self._found(self.watch.update(frames, clicks))

    def _found(self, alarms: list[Alarm]) -> list[Finding]:
        """Take alarms that came at once; return the findings."""
        return self._keep(self.health.take(alarms))

    def _keep(self, found: list[Finding]) -> list[Finding]:
        kept = found[: max(0, MAX_FINDINGS - len(self.findings))]
        self.findings += kept
        self.dropped_findings += len(found) - len(kept)
        return found

    @property
    def serious(self) -> list[Finding]:
        """The states of level warning or alarm that last."""
        return [finding for finding in self.present if LEVELS.index(finding.level) >= 1 or finding.kind == "dead"]

    def present_rate(self, finding: Finding) -> float:
        """Return clicks per dark exposure of the finding's channels, as they are by now; any thread may ask."""
        health = self._health_behind if finding.after_clicks and self._health_behind is not None else self.health
        return float(health.rates()[list(finding.channels)].mean())

    @property
    def present(self) -> list[Finding]:
        """The states that last, the oldest first; any thread may ask."""
        return self.health.present + ([] if self._health_behind is None else self._health_behind.present)

    @property
    def flags(self) -> DecisionFlag:
        """What a decision made now carries."""
        serious = self.serious if self.policy != "warn" else []
        if not serious:
            return DecisionFlag(0)
        if self.policy == "abstain":
            return DecisionFlag.DARK_ALARM | DecisionFlag.ABSTAINED
        assert self._adapter is not None
        extra, masked = self._concerned(serious)
        # Right after a click no other table helps: its dark clicks depend on that click.
        abstains = (
            any(one.after_clicks for one in serious) or masked.all() or not self._adapter.can_do(masked | (extra > 0))
        )
        return DecisionFlag.DARK_ALARM | (DecisionFlag.ABSTAINED if abstains else DecisionFlag(0))

    def decider(self, ordinary: Decider) -> Decider:
        """The back end for a decision made now, unless `flags` say that there is none."""
        serious = self.serious if self._adapter is not None else []
        if not serious:
            return ordinary
        assert self._adapter is not None
        extra, masked = self._concerned(serious)
        looks = 0
        if self.policy == "tables":
            looks = max(1, self.watch.exposures - min(finding.since for finding in serious)).bit_length()
        key = (looks, masked.tobytes(), *(finding.channels for finding in serious))
        if self._made is None or key != self._made_for:
            self._made, self._made_for = self._adapter.made(ordinary, extra, masked), key
        return self._made

    def count_word(self, counts: NDArray[np.int64]) -> None:
        """Remember the clicks of a decision made while nothing was wrong, int64 (d_f,): how often they come is what other tables
        are made with.
        """
        if self._adapter is not None and not self.present:
            self._adapter.count(counts)

    def _concerned(self, serious: list[Finding]) -> tuple[F64, NDArray[np.bool_]]:
        """How much more often a silent exposure of each channel clicks, float64 (d_f,), and which channels are left out, bool (d_f,)."""
        masked = np.zeros(self._n_features, np.bool_)
        for finding in serious:
            if self.policy == "mask" or finding.kind == "dead":
                masked[list(finding.channels) if self._parallel else slice(None)] = True
        if self.policy == "mask":
            return np.zeros(self._n_features), masked
        extra = np.resize(extra_probability(self.health.rates(), self.watch.expected), self._n_features)
        return np.where(masked, 0.0, extra), masked

    def report(self, report: DarkReport) -> DarkReport:
        """Return `report` with the findings, what lasts, and every channel's rate with its interval.

        Its alarm is judged anew: from the exposures that were watched (after no click, where the detector afterpulses), and against the
        end of the interval where the expected rate is an estimate; then from those after clicks.
        """
        watch = self.watch
        expected = float(watch.high.mean()) if watch.high.max() > FLOOR_RATE else 0.0
        judged = dark_report(expected, watch.exposures * watch.n_channels, int(watch.clicks.sum()))
        n = self.watch.exposures
        alarm = judged.alarm or self._alarm_behind(report)
        rows = []
        for clicks, expected in zip(self.watch.clicks.tolist(), self.watch.expected.tolist()):
            low, high = wilson_interval(clicks, n)
            rate = clicks / n if n else 0.0
            rows.append(
                {"exposures": n, "clicks": clicks, "per_exposure": rate, "low": low, "high": high, "expected": expected}
            )
        return replace(
            report,
            alarm=alarm,
            policy=self.policy,
            findings=tuple(finding.event() for finding in self.findings),
            present=tuple(f"{finding.level}: {finding.words}" for finding in self.present),
            channels=tuple(rows),
        )

    def _alarm_behind(self, report: DarkReport) -> str:
        """Return what is wrong with the dark exposures after clicks, or that no dark exposure could be watched; "" if nothing is."""
        behind = self.behind
        if behind is not None and (
            found := dark_report(float(behind.high[0]), behind.exposures, int(behind.clicks[0])).alarm
        ):
            return f"right after clicks: {found}"
        if self.watch.exposures or report.exposures < UNWATCHED_MOST:
            return ""
        return (
            f"none of {report.exposures} dark exposures could be watched: each came within {self._afterpulses} exposures of a click; "
            "use more dark slots (--dark-slots), or put them after patterns that seldom click"
        )


def cut_out(pattern: NDArray[np.bool_], first: int, n: int) -> NDArray[np.bool_]:
    """Return places `first` to `first` + `n` of `pattern`, bool (m,), repeated without end."""
    begin = first % len(pattern)
    if begin + n <= len(pattern):
        return pattern[begin : begin + n]
    return np.resize(np.concatenate([pattern[begin:], pattern[:begin]]), n)


def recorded_guard(header: Mapping[str, Any], plan: Plan, bundle: Bundle, shots: int) -> DarkGuard | None:
    """Return the guard that a header speaks of, None if of none; KeyError, TypeError or ValueError if it is damaged."""
    if not header:
        return None
    expected, low, high = (np.array(header[key], np.float64) for key in ("expected", "low", "high"))
    for rates in (expected, low, high):
        if rates.shape != (plan.n_channels,) or not ((rates >= 0) & (rates <= 1)).all():
            raise ValueError(f"dark rates of shape {rates.shape}, allowed: {plan.n_channels} of 0 to 1")
    settings = WatchSettings(arl_exposures=float(header["arl_dark_exposures"]))
    watch = ChannelWatch(len(expected), expected, settings, low, high)
    lit = None
    if "lit" in header:  # recordings made before have none
        lit = DeadChannelTest(low, float(header["lit"]["arl_exposures"]), float(header["lit"]["arl_objects"]))
    behind = None
    if header.get("after_clicks") is not None:  # recordings made before have none
        most = np.array([float(header["after_clicks"])])
        if not 0 <= most[0] <= 1:
            raise ValueError(f"after_clicks {most[0]}, allowed: 0 to 1")
        behind = ChannelWatch(1, np.minimum(most, MOST_AFTER_CLICKS), settings, np.array([FLOOR_RATE]))
    left_out = _exposures_left_out(header["afterpulses"])
    return DarkGuard(plan, watch, str(header["policy"]), bundle, shots, left_out, lit, behind)


def _exposures_left_out(said: Any) -> int:
    """How many exposures behind a click are left out; recordings made before say whether one is."""
    if not isinstance(said, int) or not 0 <= said < 1 << 31:
        raise ValueError(f"afterpulses {said!r}, allowed: true, false or a number of exposures")
    return int(said)


def _silence_words(who: str, has_others: bool, silence: Silence) -> str:
    if silence.proved:
        return (
            f"{who} clicked in {silence.length} exposures, lit and dark, though dark counts alone would make it "
            f"({silence.rate:.2g} per exposure at least): dead or disconnected, whatever the scene"
        )
    others = "; the other channels click as before" if has_others else ""
    cause = (
        "a dead or disconnected channel" if has_others else "dead or disconnected, or no light at all (lamp, shutter)"
    )
    return f"{who} clicked with {silence.length} objects in a row, of which {silence.rate:.3g} made it click before{others}: {cause}"
