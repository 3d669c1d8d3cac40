"""The detector's law with the effects that the profile declares, and the keys of its random numbers.

Sources: thresholded Poisson law, qCMOS threshold and dead time in pans.instrument.click_law.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pans.instrument.click_law import ClickLaw, click_law, click_probability
from pans.instrument.profile import FREE_RUNNING, Profile

GOLDEN = 0x9E3779B97F4A7C15  # the increment of splitmix64: 2^64 over the golden ratio, odd
CHANNEL_STEP = (
    0xD1342543DE82EF95  # odd, of good spectrum: the multiplier of Java's L64X128MixRandom (Steele and Vigna 2021)
)
MIX_1, MIX_2 = 0xBF58476D1CE4E5B9, 0x94D049BB133111EB  # of the splitmix64 finaliser
MASK = (1 << 64) - 1
CLICK_STREAM, LOWER_CROSSTALK_STREAM, UPPER_CROSSTALK_STREAM = 0, 1, 2
FURTHER_STREAM = 3  # of crosstalk from below by two channels, from above by two, from below by three, ...: up to 16
TRAP_STREAM, TELEGRAPH_STREAM, SWITCH_STREAM = 32, 33, 34
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)  # of a standard normal factor; 9 nodes are exact to degree 17
_GAUSSIAN = _NODES.tolist(), (_WEIGHTS / _WEIGHTS.sum()).tolist()


@dataclass(frozen=True, slots=True)
class DetectorModel:
    """What turns lambda into clicks at one exposure time; zeros switch an effect off."""

    law: ClickLaw
    afterpulse_probability: float = 0.0
    crosstalk_probability: float = 0.0
    fluctuation: float = 0.0  # relative standard deviation of the light from exposure to exposure
    trap_time: float = 0.0  # mean delay of a carrier, in exposures; 0: afterpulses come in the next exposure alone
    pause: float = (
        0.0  # between exposures, in exposures, and whether the detector is on in it: what traps release there
    )
    on_in_pause: bool = False
    crosstalk_further: tuple[float, ...] = ()  # of the second neighbour, the third, ...
    jitter: float = 0.0  # standard deviation of the time at which an event is seen, in exposures; `pause` is known then

    @property
    def remembers(self) -> bool:
        """Whether more than the clicks of the exposure before and of the next channels must be known."""
        return self.trap_time > 0 or bool(self.crosstalk_further)


def detector_model(profile: Profile, exposure_us: float) -> DetectorModel:
    """Collect the profile's effects for this exposure: crosstalk only where there are neighbours."""
    detector, parallel = profile.detector, profile.mode == "parallel"
    pause = profile.exposure.readout_us / exposure_us
    return DetectorModel(
        law=click_law(profile, exposure_us),
        afterpulse_probability=detector.afterpulse_probability,
        crosstalk_probability=detector.crosstalk_probability if parallel else 0.0,
        fluctuation=0.0 if profile.optics is None else profile.optics.source_fluctuation,
        trap_time=(detector.afterpulse_time_us or 0.0) / exposure_us,
        pause=pause if detector.afterpulse_time_us or detector.timing_jitter_ns else 0.0,
        on_in_pause=detector.between_exposures == FREE_RUNNING and detector.afterpulse_time_us is not None,
        crosstalk_further=detector.crosstalk_further if parallel else (),
        jitter=detector.timing_jitter_ns * 1e-3 / exposure_us,
    )


def first_click_probability(model: DetectorModel, photoelectrons: NDArray[np.float64]) -> NDArray[np.float64]:
    """Click probability before memory effects, float64 of the shape of `photoelectrons` (lambda, without dark counts).

    A source that fluctuates gives every exposure a Gaussian factor of its own (0 where it would be negative): the mean over it,
    by Gauss and Hermite, is exact as one exposure of one channel is one bit. Channels that click together share no factor.
    """
    if not model.fluctuation:
        return click_probability(model.law, photoelectrons)
    mean = np.zeros_like(photoelectrons)
    for node, weight in zip(*_GAUSSIAN):
        mean += weight * click_probability(model.law, photoelectrons * max(0.0, 1.0 + model.fluctuation * node))
    return mean


@lru_cache(maxsize=64)
def stream_key(seed: int, stream: int) -> int:
    """Return the 64-bit key of one stream of random numbers."""
    return mix_int(mix_int(seed & MASK) ^ mix_int(stream + 1))


def mix_int(word: int) -> int:
    """Return the next word of splitmix64 after `word`, of 64 bits."""
    word = (word + GOLDEN) & MASK
    word = ((word ^ (word >> 30)) * MIX_1) & MASK
    word = ((word ^ (word >> 27)) * MIX_2) & MASK
    return word ^ (word >> 31)
