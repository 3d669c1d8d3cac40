"""Calibrations of simulated instruments whose brightness and dark rate are known: clicks drawn by the simulator, counted by the runtime."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.scene.detector_kernels import remembered_words, sample_words
from pans.firmware_sim.scene.detector_model import detector_model, first_click_probability
from pans.runtime.core.calibration import (
    TELLING,
    CalibrationCore,
    Design,
    calibration_exposure_us,
    calibration_values,
    count_model,
    counts_of,
    design_run,
    profile_level,
    shown_in_slots,
)
from pans.runtime.core.plan import Plan
from pans.runtime.instrument.click_law import ClickLaw, click_law, click_probability
from pans.runtime.instrument.estimate import CountModel, Counts, Interval, fit_light
from pans.runtime.instrument.profile import Profile
from pans.runtime.wire.messages import DARK_PATTERN, NO_OBJECT, ClickBlock, FrameBlock

BLOCK = 1 << 16
Rng = np.random.Generator


class Outcome(NamedTuple):
    """One calibration: truths and intervals of the photon level and the click probability of a dark exposure."""

    level: float
    level_interval: Interval
    dark: float
    dark_interval: Interval


def instrument(profile: Profile, rng: Rng) -> Profile:
    """One of many instruments of this kind: brightness within about 30 %, dark rate within a factor of 3."""
    peak = profile.projector.peak_photoelectrons_hz * math.exp(0.3 * rng.standard_normal())
    dark = profile.detector.dark_rate_hz * math.exp(rng.uniform(-math.log(3), math.log(3)))
    return replace(
        profile,
        projector=replace(profile.projector, peak_photoelectrons_hz=peak),
        detector=replace(profile.detector, dark_rate_hz=dark),
    )


def calibrate_one(profile: Profile, seconds: float, seed: int) -> Outcome:
    """Simulate one instrument and calibrate it for `seconds`, after a first stage that found the level to about a tenth."""
    rng = np.random.default_rng([seed, 6])
    truth = instrument(profile, rng)
    exposure_us = calibration_exposure_us(profile)
    level = profile_level(truth, exposure_us)
    design = design_run(profile, TELLING, level * math.exp(0.1 * rng.standard_normal()), seconds, seed)
    core = simulate(truth, design, seed)
    values = calibration_values(counts_of(core, design, profile), count_model(profile, exposure_us), design, profile)
    low, high = values["photons_per_level_ci"]
    found = Interval(values["photons_per_level"], low, math.inf if high is None else high)
    dark = float(click_probability(click_law(truth, exposure_us), 0.0))
    dark_interval = Interval(values["dark_per_exposure"], *values["dark_ci"])
    return Outcome(level, found, dark, dark_interval)


def simulate(truth: Profile, design: Design, seed: int, light: NDArray[np.float64] | None = None) -> CalibrationCore:
    """Draw all exposures of `design` on the instrument `truth` and let the runtime's core count them.

    `light` are the photoelectrons (patterns,) of an exposure; without it a clear field stands before the detector.
    """
    plan, core = design.plan, CalibrationCore(design.plan, design.n_cycles)
    model = detector_model(truth, plan.exposure_us)
    light = design.drives * profile_level(truth, plan.exposure_us) if light is None else light
    light = light.reshape(-1, core.channels)  # what is shown together; in parallel mode all
    light = np.concatenate([light, np.zeros((1, core.channels))])
    rows, shown = first_click_probability(model, light), shown_in_slots(plan)
    row_of_slot = np.where(plan.slot_pattern == DARK_PATTERN, len(rows) - 1, 0 if core.parallel else shown)
    previous, carriers = np.zeros(core.channels, np.uint8), np.zeros(core.channels)
    total = design.n_cycles * plan.slots_per_cycle
    for first in range(0, total, BLOCK):
        slots = np.arange(first, min(first + BLOCK, total)) % plan.slots_per_cycle
        words = np.zeros((len(slots), -(-core.channels // 8)), np.uint8)
        if model.remembers:
            remembered_words(model, rows, row_of_slot[slots], seed, first, carriers, words)
        else:
            sample_words(model, rows, row_of_slot[slots], seed, first, previous, words)
        core.take_block(_block(core, plan, first, shown[slots].astype(np.uint16), words))
    return core


def _block(
    core: CalibrationCore, plan: Plan, first: int, patterns: NDArray[np.uint16], words: NDArray[np.uint8]
) -> ClickBlock | FrameBlock:
    head = (0, 0, 0, first, 1, NO_OBJECT)
    return FrameBlock(*head, words) if core.parallel else ClickBlock(*head, patterns, words[:, 0], plan.largest)


def few_clicks(mean_clicks: float, seed: int) -> Outcome:
    """A calibration that expects `mean_clicks` clicks of light in 3000 exposures, and a tenth as many dark ones in 3000 more."""
    rng = np.random.default_rng([seed, 7])
    level = mean_clicks / 3000 * math.exp(rng.uniform(-0.3, 0.3))
    dark = 0.1 * mean_clicks / 3000 * math.exp(rng.uniform(-0.5, 0.5))
    drive, n = np.array([0.5, 1.0, 1.5, 0.0]), np.array([1000, 1000, 1000, 3000], np.int64)
    clicks = rng.binomial(n, -np.expm1(-(drive * level + dark)))
    fit = fit_light(Counts(drive, clicks, n, np.zeros(4), np.arange(4)), CountModel(ClickLaw()))
    return Outcome(level, fit.level, dark, fit.dark)
