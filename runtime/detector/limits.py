"""Where the laws of the detector stop holding to `STATED`, in words: for a plan, a training and an evaluation to warn of.

The figures are from single events (tests/runtime/detector/test_laws.py); docs/explanation/detector.md has them.
"""

from __future__ import annotations

from pans.runtime.instrument.click_law import dead_time_of
from pans.runtime.instrument.dead_time import unequal_error
from pans.runtime.instrument.profile import Profile

from .afterpulses import HOLDS_TO, afterpulses_of
from .crosstalk import crosstalk_of

STATED = 0.003  # of a chance of a click
NEGLIGIBLE = 0.005  # chance of an effect, below which leaving it out is not worth a word
BRIGHT = 30.0  # photoelectrons of an exposure, where nothing better is known


def law_warnings(
    profile: Profile, exposure_us: float, brightest: float = BRIGHT, *, one_by_one: bool = False
) -> list[str]:
    """Return what of `profile` lies outside the stated range, for exposures of `exposure_us` with 0 to `brightest` photoelectrons.

    `one_by_one`: the clicks of an exposure are taken to be independent, as in training.
    """
    detector, found = profile.detector, []
    dead_time = dead_time_of(profile, exposure_us)
    if dead_time.reach and (off := unequal_error(dead_time, brightest)) > STATED:
        found.append(
            f"detector.dead_time_ns reaches {dead_time.reach:.2g} of an exposure into the next one; where dim and bright exposures (up to "
            f"{brightest:.3g} photoelectrons) follow each other, chances of clicks are off by up to {off:.2g}, more than {STATED:g}"
        )
    if profile.mode == "parallel" and detector.afterpulse_probability > NEGLIGIBLE:
        found.append(
            f"detector.afterpulse_probability {detector.afterpulse_probability:g} is left out of parallel exposures, allowed: at most "
            f"{NEGLIGIBLE:g}"
        )
    elif detector.afterpulse_time_us is not None and detector.afterpulse_probability > HOLDS_TO:
        found.append(
            f"detector.afterpulse_probability {detector.afterpulse_probability:g} with a time constant, chances of clicks hold to "
            f"{STATED:g} up to {HOLDS_TO:g}"
        )
    elif (off := afterpulses_of(profile, exposure_us).blinded_error(brightest)) > STATED:
        found.append(
            f"detector.dead_time_ns and afterpulses of up to {brightest:.3g} photoelectrons together put chances of clicks off by up to "
            f"{off:.2g}, more than {STATED:g}"
        )
    kernel = crosstalk_of(profile)
    if one_by_one and max(kernel, default=0.0) > NEGLIGIBLE:
        found.append(
            f"crosstalk of {max(kernel):g}: every click has its right chance, but that clicks of neighbours come together is left out "
            "(pans evaluate has it)"
        )
    return [f"{profile.name}: {text}" for text in found]
