"""A run's figures over its whole time, from its pictures in their order, in bounded memory: sums per bin of time.

Whenever there are more than MAX_BINS, bins become twice as long. No numpy is loaded: the process that draws shall start at once and stay
small.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

from pans.runtime.intervals import wilson_interval

MAX_BINS = 240
FIRST_BIN_S = 1.0
RATE_OVER_S = 5.0
SUMS = ("decisions", "known", "right", "abstained", "late", "lost", "dark_exposures", "dark_clicks", "exposures")


@dataclass(slots=True)
class Bin:
    """What came between `begin_s` and `end_s` of the run."""

    begin_s: float
    end_s: float
    sums: Counter[str] = field(default_factory=Counter)
    latency: Counter[int] = field(default_factory=Counter)
    drift_ppm: float | None = None

    def absorb(self, later: Bin) -> None:
        """Add the bin behind this one."""
        self.end_s = later.end_s
        self.sums.update(later.sums)
        self.latency.update(later.latency)
        self.drift_ppm = later.drift_ppm if later.drift_ppm is not None else self.drift_ppm


class History:
    """The latest picture, the sums of all, and those of each bin of time."""

    def __init__(self) -> None:
        self.begin: dict[str, Any] = {}
        self.picture: dict[str, Any] = {}
        self.latency: Counter[int] = Counter()
        self.pixels: dict[str, Any] = {}
        self.bins: list[Bin] = []
        self.bin_s = FIRST_BIN_S
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
        now_s = float(picture["elapsed_s"])
        if not self.bins or now_s >= self.bins[-1].begin_s + self.bin_s:
            self._new_bin(now_s)
        here = self.bins[-1]
        here.end_s = now_s
        for name in SUMS:
            here.sums[name] += picture.get(name, 0) - self.picture.get(name, 0)
        here.latency.update(grown)
        here.drift_ppm = picture.get("clock_drift_ppm", here.drift_ppm)
        self.latency.update(grown)
        self.picture = picture
        self._recent.append(picture)
        while len(self._recent) > 2 and now_s - float(self._recent[1]["elapsed_s"]) >= RATE_OVER_S:
            self._recent.popleft()

    def _new_bin(self, now_s: float) -> None:
        begin_s = self.bins[-1].end_s if self.bins else 0.0
        if len(self.bins) >= MAX_BINS:
            for first, second in zip(self.bins[::2], self.bins[1::2]):
                first.absorb(second)
            self.bins = self.bins[::2]
            self.bin_s *= 2
            if now_s < self.bins[-1].begin_s + self.bin_s:
                return
        self.bins.append(Bin(begin_s, now_s))

    def rate(self, name: str) -> float:
        """Return how much `name` grew per second of late."""
        if len(self._recent) < 2:
            return 0.0
        first, last = self._recent[0], self._recent[-1]
        seconds = float(last["elapsed_s"]) - float(first["elapsed_s"])
        return (last.get(name, 0) - first.get(name, 0)) / seconds if seconds > 0 else 0.0

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
