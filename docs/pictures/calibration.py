"""Draws docs/pictures/calibration.png: clicks by drive with the fitted law, and the profile likelihood of the level. SIMULATED.

python docs/pictures/calibration.py       (extra `plot`)
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot

from pans.base.numbers import CHI2_95, jeffreys_interval
from pans.calibrate.estimate import Counts, fit_light, log_likelihood
from pans.calibrate.measurement import (
    LADDER,
    TELLING,
    Design,
    calibration_exposure_us,
    count_model,
    design_run,
    profile_level,
)
from pans.instrument.click_law import click_law, click_probability
from pans.instrument.profile import Profile, load_profile
from pans.protocol.wire import DARK_PATTERN


def drawn(truth: Profile, design: Design, seed: int) -> Counts:
    """Draw the clicks of every pattern, and of dark exposures, on `truth`: its exposures do not depend on each other."""
    shown, exposure_us = design.plan.slot_pattern.astype(np.int64), design.plan.exposure_us
    pattern = np.append(np.arange(len(design.drives)), -1)
    slots = [int((shown == (DARK_PATTERN if one < 0 else one)).sum()) for one in pattern]
    exposures, drive = design.n_cycles * np.array(slots), np.append(design.drives, 0.0)
    chance = click_probability(click_law(truth, exposure_us), drive * profile_level(truth, exposure_us))
    clicks = np.random.default_rng(seed).binomial(exposures, chance)
    return Counts(drive, clicks, exposures, np.zeros(len(drive)), pattern)


def main() -> None:
    """Simulate both stages on an instrument a quarter brighter than its profile, fit, and draw."""
    profile = load_profile("oled-qcmos")
    truth = replace(profile, projector=replace(profile.projector, peak_photoelectrons_hz=5000.0))
    exposure = calibration_exposure_us(profile)
    model, true_level = count_model(profile, exposure), profile_level(truth, exposure)
    stages = []
    guess = profile_level(profile, exposure)
    for targets, seconds in ((LADDER, 1.0), (TELLING, 9.0)):
        design = design_run(profile, targets, guess, seconds, 1)
        counts = drawn(truth, design, 3)
        fit = fit_light(counts, model)
        guess = fit.level.value
        stages.append((counts, fit))
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    drives = np.geomspace(1, 1500, 300)
    for (counts, fit), name, colour in zip(
        stages, ("first stage, 1 s", "second stage, 9 s"), ("tab:orange", "tab:blue")
    ):
        for drive in np.unique(counts.drive[counts.drive > 0]):
            alike = counts.drive == drive
            k, n = int(counts.clicks[alike].sum()), int(counts.exposures[alike].sum())
            low, high = jeffreys_interval(k, n)
            bars = [[k / n - low], [high - k / n]]
            left.errorbar([drive], [k / n], yerr=np.maximum(bars, 0), fmt="o", ms=4, color=colour, capsize=2)
        curve = -np.expm1(model.log_miss(drives * fit.level.value + fit.dark.value))
        left.plot(drives, curve, color=colour, lw=1, label=name)
        levels = np.linspace(0.85, 1.15, 161) * true_level
        height = np.array([log_likelihood(counts, model, level, fit.dark.value) for level in levels])
        right.plot(levels / true_level, 2 * (height - fit.log_likelihood), color=colour, label=name)
        for bound in (fit.level.low, fit.level.high):
            right.axvline(bound / true_level, color=colour, lw=0.8, ls=":")
    left.set(xscale="log", xlabel="lit levels of the pattern", ylabel="clicks per exposure", ylim=(0, 1.02))
    left.legend(fontsize=9)
    right.axhline(-CHI2_95, color="black", ls="--", lw=0.8)
    right.axvline(1.0, color="black", lw=0.8)
    right.set(
        xlabel="photon level / true level", ylabel="2 (log likelihood - maximum)", ylim=(-12, 0.5), xlim=(0.85, 1.15)
    )
    right.legend(fontsize=9, loc="lower left")
    figure.suptitle("SIMULATED: oled-qcmos, a quarter brighter than its profile; dotted: 95 % intervals", fontsize=10)
    figure.savefig(Path(__file__).with_name("calibration.png"), dpi=90)


if __name__ == "__main__":
    main()
