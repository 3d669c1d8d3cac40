"""Draws docs/pictures/dark-watch.png: the sums of a dark-count watch over a doubled rate and over a light leak. SIMULATED.

python docs/pictures/dark_watch.py        (extra `plot`)
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot

from pans.decide.dark import ChannelHealth, ChannelWatch, WatchSettings
from pans_sim.scene.detector_kernels import click_thresholds, plain_words
from pans_sim.scene.detector_model import CLICK_STREAM, stream_key

RATE, CHANNELS, STEP = 0.01, 4, 20
LEGS = ((12_000, 1.0), (6_000, 2.0), (6_000, 1.0), (300, 20.0), (6_000, 1.0))


class Detector:
    """Dark exposures of one simulated detector, drawn one after another with a rate that may change."""

    def __init__(self, channels: int, seed: int) -> None:
        self._channels, self._key, self._next = channels, np.uint64(stream_key(seed, CLICK_STREAM)), 0

    def expose(self, n: int, rate: float) -> np.ndarray:
        """Return the next `n` exposures at `rate`, words uint8 (n, bytes)."""
        words = np.zeros((n, -(-self._channels // 8)), np.uint8)
        thresholds = click_thresholds(np.full((1, self._channels), rate))
        plain_words(thresholds, np.zeros(n, np.int64), self._key, self._next, words)
        self._next += n
        return words


def main() -> None:
    """Simulate, watch and draw."""
    watch = ChannelWatch(CHANNELS, np.full(CHANNELS, RATE), WatchSettings(arl_exposures=1e7))
    health, detector = ChannelHealth(watch), Detector(CHANNELS, 4)
    exposures, sums, found = [], [], []
    for number, (n, factor) in enumerate(LEGS):
        for _ in range(0, n, STEP):
            words = detector.expose(STEP, RATE * factor)
            if number == 1:  # only channel 1 is hot
                words = (words & 0b0010) | (detector.expose(STEP, RATE) & 0b1101)
            found += health.take(watch.update_words(words))
            exposures.append(watch.exposures)
            sums.append(watch.sums())
    path = np.array(sums)
    names = [f"{test}{'' if channel < 0 else f', channel {channel}'}" for test, channel, _ in watch.designs]
    figure, axes = pyplot.subplots(figsize=(10, 4.2), layout="constrained")
    for row, name in enumerate(names):
        shown = name in ("rise, channel 1", "burst", "drift")
        axes.plot(
            exposures,
            path[:, row],
            lw=1.6 if shown else 0.6,
            color=None if shown else "0.8",
            label=name if shown else None,
        )
    axes.axhline(1.0, color="black", ls="--", lw=0.8)
    begin = 0
    for (n, factor), word in zip(LEGS, ("as expected", "channel 1 doubled", "as expected", "leak", "as expected")):
        if factor != 1.0:
            axes.axvspan(begin, begin + n, color="tab:orange", alpha=0.15)
        axes.text(begin + n / 2, 1.22 if word != "leak" else 1.32, word, ha="center", fontsize=9)
        begin += n
    for finding in found:
        where = "" if len(finding.channels) == CHANNELS else f" {finding.channels[0]}"
        over = finding.kind == "over"
        words, colour = f"{finding.kind}{where}", "tab:green" if over else "tab:red"
        beside = (finding.exposure + (700 if over else -300), 1.1)
        arrow = {"arrowstyle": "-"}
        axes.annotate(words, (finding.exposure, 1.0), beside, ha="center", fontsize=9, color=colour, arrowprops=arrow)
    axes.set(xlabel="dark exposures", ylabel="sum / threshold", ylim=(0, 1.42), xlim=(0, begin))
    axes.set_title(
        f"SIMULATED: {CHANNELS} channels at {RATE} clicks per dark exposure; grey: the other tests", fontsize=10
    )
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.82), fontsize=9)
    figure.savefig(Path(__file__).with_name("dark-watch.png"), dpi=90)


if __name__ == "__main__":
    main()
