"""From the light of a run to its clicks: any stretch of exposures, drawn in one piece.

Clicks depend on the exposure's number and the click before it alone, so that the size of stretches changes nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .changes import Changes
from .detector import sample_clicks
from .detector_model import DetectorModel, first_click_probability
from .light import RunLight
from .program import Exposures

U8 = NDArray[np.uint8]


class ClickSource:
    """The clicks of one run; `first_draw` exposures were drawn in earlier runs: no number is used twice."""

    def __init__(
        self,
        light: RunLight,
        exposures: Exposures,
        model: DetectorModel,
        changes: Changes,
        seed: int,
        first_draw: int,
    ) -> None:
        self._light, self._exposures, self._model, self._changes = light, exposures, model, changes
        self._seed, self._first_draw = seed, first_draw
        self._moved: NDArray[np.float64] | None = None
        self._carriers: NDArray[np.float64] | None = (
            None  # in the traps of every channel: exposures are asked for in their order
        )

    def clicks(self, first: int, count: int, before: U8) -> U8:
        """Clicks uint8 (count, channels) of exposures first..first+count-1; before uint8 (channels,): those of the exposure before."""
        probability, row_of = self._probability(first, count)
        carriers = self._in_traps(probability.shape[1])
        return sample_clicks(self._model, probability[row_of], self._seed, self._first_draw + first, before, carriers)

    def _in_traps(self, channels: int) -> NDArray[np.float64]:
        if self._carriers is None:
            self._carriers = np.zeros(channels)
        return self._carriers

    def words(self, first: int, before: U8, words: U8) -> None:
        """Draw exposures from `first` on into `words`, uint8 (n, bytes), bit c of a word is channel c; set `before` to the last clicks."""
        from .detector_kernels import remembered_words, sample_words

        count = len(words)
        probability, row_of = self._probability(first, count)
        known = self._model, probability, row_of, self._seed, self._first_draw + first
        if self._model.remembers:
            remembered_words(*known, self._in_traps(probability.shape[1]), words)
        else:
            sample_words(*known, before, words)
        if self._changes and self._changes.any_dead:  # nor does crosstalk wake a dead channel
            times_s = self._exposures.seconds(self._exposures.begins(first, count))
            alive = self._changes.alive(times_s)
            packed = np.packbits(alive, axis=1, bitorder="little")
            words[:, : packed.shape[1]] &= packed
            before &= alive[-1]

    def _probability(self, first: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Click probabilities float64 (rows, channels), and int64 (count,) of the row of each exposure."""
        light, row_of = self._jittered(first, count) if self._model.jitter else self._light.rows(first, count)
        if self._changes:
            times_s = self._exposures.seconds(self._exposures.begins(first, count))
            exposure_s = self._exposures.exposure_ticks / self._exposures.tick_hz
            return self._changes.probability(self._model, light[row_of], times_s, exposure_s), np.arange(count)
        known = self._light.probability
        if known is None or self._model.jitter:
            return first_click_probability(self._model, light), row_of
        if len(known) > count:
            return known[row_of], np.arange(count)
        return known, row_of

    def _jittered(self, first: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """As `rows` of the light, with what jitter moves from and to the exposures about; before the first one the light is as in it."""
        if self._moved is None:
            self._moved = moved_parts(self._model.jitter, self._model.pause)
        reach = len(self._moved) // 2
        begin = max(0, first - reach)
        light, row_of = self._light.rows(begin, first + count + reach - begin)
        dense = light[row_of]
        dense = np.concatenate([np.repeat(dense[:1], reach - (first - begin), axis=0), dense])
        mixed = np.zeros((count, dense.shape[1]))
        for k, part in enumerate(self._moved):
            mixed += part * dense[k : k + count]
        return mixed, np.arange(count)


def moved_parts(jitter: float, pause: float) -> NDArray[np.float64]:
    """Return the parts of an exposure's events that are seen -reach ... reach exposures away, float64 (2 reach + 1,).

    An event is seen at its time plus a Gaussian; the light of a pause is that of the exposure nearer by; `jitter` and `pause` are in
    exposures. Over the times s of events, Phi((begin + 1 - s)/jitter) - Phi((begin - s)/jitter) is integrated: differences of the
    integral of Phi, x Phi(x) + phi(x). Poisson events that move independently stay Poisson, so that means simply add up.
    """
    period, reach = 1 + pause, math.ceil((4 * jitter + 0.5 * pause) / (1 + pause))
    parts = np.zeros(2 * reach + 1)
    for k in range(-reach, reach + 1):
        for edge, of_edge in ((k * period + 1, 1.0), (k * period, -1.0)):
            for source, of_source in ((-0.5 * pause, 1.0), (1 + 0.5 * pause, -1.0)):
                x = (edge - source) / jitter
                integral = 0.5 * x * math.erfc(-x / math.sqrt(2)) + math.exp(-0.5 * x * x) / math.sqrt(2 * math.pi)
                parts[k + reach] += of_edge * of_source * jitter * integral
    return parts / parts.sum()
