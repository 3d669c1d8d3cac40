"""A run's figures over its whole time, from its pictures in their order: sums per bin of time, at several resolutions.

Memory is bounded: each of LEVELS keeps its last BINS bins, 3072 together. A bin holds a dozen sums and as many counts as there were
different latencies (32 steps per octave), so that a month of history takes about 40 MB, and most of it is there after an hour. Sums and
latency histograms merge exactly; what is older than six weeks is in the sums of the whole run alone. No numpy is loaded: a process that
draws in the terminal shall start at once and stay small.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

from pans.base.numbers import GROUPS, LIGHT, has_quantile, wilson_interval

LEVELS = (1.0, 5.0, 30.0, 180.0, 1200.0, 7200.0)  # seconds of a bin
BINS = 512  # of a level: 8 minutes, 42 minutes, 4 hours, 1 day, 1 week, 6 weeks
SUMS: tuple[str, ...] = (*GROUPS, *(f"{of}_{what}" for of in GROUPS for what in LIGHT), "right", "late")
SUMS += ("lost_exposures", "dark_exposures", "dark_clicks")


@dataclass(slots=True)
class Bin:
    """What came between `begin_s` and `end_s` of the run; `sums` are in the order of SUMS."""

    begin_s: float
    end_s: float
    sums: list[float] = field(default_factory=lambda: [0] * len(SUMS))
    latency: Counter[int] = field(default_factory=Counter)


class History:
    """The latest picture, the latencies of all, and the sums of each bin of time: `bins` by their length in seconds."""

    def __init__(self) -> None:
        self.begin: dict[str, Any] = {}
        self.picture: dict[str, Any] = {}
        self.latency: Counter[int] = Counter()
        self.pixels: dict[str, Any] = {}
        self.bins: dict[float, deque[Bin]] = {level: deque(maxlen=BINS) for level in LEVELS}
        self.number = 0  # of pictures

    def take(self, message: dict[str, Any]) -> None:
        """Take what the run's process sent: its beginning or a picture."""
        self.number += 1
        if message.get("kind") == "begin":
            self.begin = message
            return
        grown = {int(duration_ns): int(count) for duration_ns, count in message.pop("latency", ())}
        self.pixels.update(message.pop("pixels", {}))
        before, now_s = self.picture, float(message["elapsed_s"])
        if "word" in before:
            message.setdefault("word", before["word"])
        sums = [message.get(name, 0) - before.get(name, 0) for name in SUMS]
        for level, bins in self.bins.items():
            if not bins or now_s // level > bins[-1].end_s // level:
                bins.append(Bin(float(before.get("elapsed_s", 0.0)), now_s))
            here = bins[-1]
            here.end_s = now_s
            here.sums = [a + b for a, b in zip(here.sums, sums)]
            here.latency.update(grown)
        self.latency.update(grown)
        self.picture = message

    def recent(self, seconds: float) -> tuple[dict[str, float], Counter[int], float]:
        """Return the sums and the latencies of the last `seconds`, in whole bins, and how long these are together."""
        some = [one for one in self.bins[LEVELS[0]] if one.end_s > self.picture["elapsed_s"] - seconds]
        sums = dict(zip(SUMS, map(math.fsum, zip(*(one.sums for one in some)))))
        return sums, sum((one.latency for one in some), Counter()), some[-1].end_s - some[0].begin_s

    def when(self, name: str, count: float) -> float:
        """Return when the sum `name` of the run was `count`, in seconds of the run, between the ends of the bin that it lies in."""
        at = SUMS.index(name)
        for bins in self.bins.values():
            later = self.picture[name] - count
            for one in reversed(bins):
                if one.sums[at] > 0 and later <= one.sums[at]:
                    return one.end_s - (one.end_s - one.begin_s) * max(0.0, later) / one.sums[at]
                later -= one.sums[at]
        return 0.0

    def accuracy(self, sums: dict[str, Any], objects: int | None = None) -> tuple[float, float, float]:
        """Return accuracy and its 95 % interval (Wilson), in which the trials of one visit and showings of one object count once.

        NaN where no decision is judged.
        """
        if (judged := int(sums["judged"])) <= 0:
            return math.nan, math.nan, math.nan
        share = sums["right"] / judged
        n = max(1, min(judged // max(1, int(self.begin.get("trials", 1))), judged if objects is None else objects))
        low, high = wilson_interval(round(share * n), n)
        return share, min(low, share), max(high, share)


def quantile_us(counts: Counter[int], q: float) -> float | None:
    """Return quantile `q` of durations, ns with their counts, in microseconds; None of too few."""
    total = sum(counts.values())
    if not has_quantile(total, q):
        return None
    wanted, seen = max(1, -int(-q * total // 1)), 0
    for duration_ns in sorted(counts):
        seen += counts[duration_ns]
        if seen >= wanted:
            return duration_ns / 1000
    return None
