"""From the light of a run to its clicks: any stretch of exposures, drawn in one piece.

Owns how light, changes and the detector's model come together; never knows about blocks, messages or ticks of the device. Clicks depend
on the exposure's number and the click before it alone, so that the size of stretches changes nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .changes import Changes
from .detector import sample_clicks
from .detector_model import DetectorModel, first_click_probability
from .exposure_times import Exposures
from .light import RunLight

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

    def clicks(self, first: int, count: int, before: U8) -> U8:
        """Clicks uint8 (count, channels) of exposures first..first+count-1; before uint8 (channels,): those of the exposure before."""
        probability, row_of = self._probability(first, count)
        return sample_clicks(self._model, probability[row_of], self._seed, self._first_draw + first, before)

    def words(self, first: int, before: U8, words: U8) -> None:
        """Draw exposures from `first` on into `words`, uint8 (n, bytes), bit c of a word is channel c; set `before` to the last clicks."""
        from .detector_kernels import sample_words  # numba is loaded only for instruments of many channels

        count = len(words)
        probability, row_of = self._probability(first, count)
        sample_words(self._model, probability, row_of, self._seed, self._first_draw + first, before, words)
        if self._changes and self._changes.any_dead:  # nor does crosstalk wake a dead channel
            times_s = self._exposures.seconds(self._exposures.begins(first, count))
            alive = self._changes.alive(times_s)
            packed = np.packbits(alive, axis=1, bitorder="little")
            words[:, : packed.shape[1]] &= packed
            before &= alive[-1]

    def _probability(self, first: int, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Click probabilities float64 (rows, channels), and int64 (count,) of the row of each exposure."""
        light, row_of = self._light.rows(first, count)
        if self._changes:
            times_s = self._exposures.seconds(self._exposures.begins(first, count))
            exposure_s = self._exposures.exposure_ticks / self._exposures.tick_hz
            return self._changes.probability(self._model, light[row_of], times_s, exposure_s), np.arange(count)
        known = self._light.probability
        if known is None:
            return first_click_probability(self._model, light), row_of
        if len(known) > count:
            return known[row_of], np.arange(count)
        return known, row_of
