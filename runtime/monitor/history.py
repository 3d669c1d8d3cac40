"""A run's figures over its whole time, from its pictures in their order: sums per bin of time, at several resolutions.

Memory is bounded: each of LEVELS keeps its last BINS bins, 3072 together. A bin holds a dozen sums and as many counts as there were
different latencies (32 steps per octave), so that a month of history takes about 40 MB, and most of it is there after an hour. Sums and
latency histograms merge exactly; what is older than six weeks is in the sums of the whole run alone. No numpy is loaded: a process that
draws in the terminal shall start at once and stay small.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

from pans.runtime.intervals import wilson_interval

LEVELS = (1.0, 5.0, 30.0, 180.0, 1200.0, 7200.0)  # seconds of a bin
BINS = 512  # of a level: 8 minutes, 42 minutes, 4 hours, 1 day, 1 week, 6 weeks
RATE_OVER_S = 5.0
RECENT_S = 60.0
SUMS: tuple[str, ...] = (
    "decisions",
    "known",
    "right",
    "abstained",
    "late",
    "lost",
    "dark_exposures",
    "dark_clicks",
    "exposures",
)
SUMS += ("clicks", "photons", "photons_known")


@dataclass(slots=True)
class Bin:
    """What came between `begin_s` and `end_s` of the run; `sums` are in the order of SUMS."""

    begin_s: float
    end_s: float
    sums: list[float] = field(default_factory=lambda: [0] * len(SUMS))
    latency: Counter[int] = field(default_factory=Counter)
    drift_ppm: float | None = None


class History:
    """The latest picture, the sums of all, and those of each bin of time: `bins` by their length in seconds."""

    def __init__(self) -> None:
        self.begin: dict[str, Any] = {}
        self.picture: dict[str, Any] = {}
        self.latency: Counter[int] = Counter()
        self.pixels: dict[str, Any] = {}
        self.bins: dict[float, deque[Bin]] = {level: deque(maxlen=BINS) for level in LEVELS}
        self.number = 0  # of pictures
        self._recent: deque[dict[str, Any]] = deque()

    def take(self, message: dict[str, Any]) -> None:
        """Take what the run's process sent: its beginning or a picture."""
        if message.get("kind") == "begin":
            self.begin = message
        else:
            self._take_picture(message)
        self.number += 1

    def _take_picture(self, picture: dict[str, Any]) -> None:
        grown = {int(duration_ns): int(count) for duration_ns, count in picture.pop("latency", ())}
        self.pixels.update(picture.pop("pixels", {}))
        if "word" not in picture and "word" in self.picture:
            picture["word"] = self.picture["word"]
        before, now_s = self.picture, float(picture["elapsed_s"])
        sums = [picture.get(name, 0) - before.get(name, 0) for name in SUMS]
        for level, bins in self.bins.items():
            if not bins or now_s // level > bins[-1].end_s // level:
                bins.append(Bin(float(before.get("elapsed_s", 0.0)), now_s))
            here = bins[-1]
            here.end_s = now_s
            here.sums = [a + b for a, b in zip(here.sums, sums)]
            here.latency.update(grown)
            here.drift_ppm = picture.get("clock_drift_ppm", here.drift_ppm)
        self.latency.update(grown)
        self.picture = picture
        self._recent.append(picture)
        while len(self._recent) > 2 and now_s - float(self._recent[1]["elapsed_s"]) >= RATE_OVER_S:
            self._recent.popleft()

    def rate(self, name: str) -> float:
        """Return how much `name` grew per second of late."""
        if len(self._recent) < 2:
            return 0.0
        first, last = self._recent[0], self._recent[-1]
        seconds = float(last["elapsed_s"]) - float(first["elapsed_s"])
        return (last.get(name, 0) - first.get(name, 0)) / seconds if seconds > 0 else 0.0

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

    def recent(self) -> tuple[dict[str, float], Counter[int]]:
        """Return the sums and the latencies of the last minute."""
        sums, latency = dict.fromkeys(SUMS, 0.0), Counter[int]()
        for one in self.bins[LEVELS[0]]:
            if one.end_s > self.picture["elapsed_s"] - RECENT_S:
                sums = {name: sums[name] + value for name, value in zip(SUMS, one.sums)}
                latency.update(one.latency)
        return sums, latency

    def dark(self, sums: dict[str, float]) -> tuple[float, float]:
        """Return the dark clicks and dark exposures of `sums`, those of the whole run where these hold none."""
        some = sums if sums["dark_exposures"] > 0 else self.picture
        return some["dark_clicks"], some["dark_exposures"]

    def accuracy(self, sums: dict[str, Any], objects: int | None = None) -> tuple[float, float, float] | None:
        """Return accuracy and its 95 % interval (Wilson), in which the trials of one visit and showings of one object count once."""
        known = int(sums.get("known", 0))
        if known <= 0:
            return None
        share = sums.get("right", 0) / known
        trials = max(1, int(self.begin.get("trials", 1)))
        n = max(1, min(known // trials, known if objects is None else objects))
        low, high = wilson_interval(round(share * n), n)
        return share, min(low, share), max(high, share)


def quantile_us(counts: Counter[int], q: float) -> float | None:
    """Return quantile `q` of durations, ns with their counts, in microseconds; None without any."""
    total = sum(counts.values())
    if not total:
        return None
    wanted, seen = max(1, -int(-q * total // 1)), 0
    for duration_ns in sorted(counts):
        seen += counts[duration_ns]
        if seen >= wanted:
            return duration_ns / 1000
    return None
