"""A profile and a target in; what each of two stages shows, and from its counts the estimate out.

First scattered pixels are shown, which tell something wherever the target is, then the patterns of most Fisher information about a target
that is roughly known. Patterns are levels, uint16 (patterns, pixels). The caller runs the session.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import UsageError, as_usage_error
from pans.base.numbers import CHI2_95
from pans.calibrate.measurement import (
    CalibrationCore,
    Design,
    calibration_exposure_us,
    count_model,
    counts_of,
    design_of,
    joined_counts,
    profile_level,
)
from pans.instrument.click_law import object_transmission
from pans.instrument.profile import Profile

from .estimate import Estimate, Library, Observed, estimate
from .parameters import DARK, PARAMETERS, WORTHS, Bench, Shape, information_per_exposure

F64 = NDArray[np.float64]
U16 = NDArray[np.uint16]

FIRST_SHARE = 0.12  # of the time
SATURATED_SHARE = 0.95  # of the exposures with light
MISFIT_CHANCE = 1e-4
PRECISION_PX, PRECISION_DEG = 0.05, 0.1  # half of the 95 % interval
LENGTHS, ANGLES = ("right_px", "down_px"), ("rotation_deg",)
SCATTERED, TELLING = 96, 128  # patterns of the two stages
# photoelectrons per exposure of scattered patterns, if the profile is right; the clicks tell most from 0.5 to 2
DRIVES = (0.4, 1.0, 2.5)
DRIVE = 1.0  # of telling ones: of a click's worth 0.92 of the most is left, and of an exposure's time 0.9
SIZES = (2, 4, 8, 16, 24, 32, 48)  # lit pixels of candidates
DIRECTIONS = 300
EMPTY_EVERY = 32  # one pattern in so many has no lit pixel: the black level alone
VISIBLE = 0.05  # transmission: a pixel that never sees more tells nothing


def bench_of(profile: Profile, target: NDArray[np.uint8]) -> Bench:
    """Return what is known of `profile` before the target, uint8 (rows, columns), with the exposure of a calibration."""
    exposure_us = calibration_exposure_us(profile)
    transmission = np.asarray(object_transmission(profile, target), np.float64)
    shape: Shape = (target.shape[0], target.shape[1])
    return Bench(
        transmission.reshape(-1),
        shape,
        profile_level(profile, exposure_us),
        profile.projector.levels,
        count_model(profile, exposure_us),
    )


class Registration:
    """One measurement: `first` and `second` lay out what is shown, `take` is given what was counted of it."""

    def __init__(self, profile: Profile, target: NDArray[np.uint8], seconds: float, seed: int) -> None:
        self.profile, self.seconds, self.seed = profile, seconds, seed
        self.bench = bench_of(profile, target)
        self.observed: Observed | None = None

    def words(self) -> str:
        """Return what will be looked for, in words."""
        rows, columns = self.bench.shape
        right, down, turn = PARAMETERS[:3]
        return (
            f"target of {columns} x {rows} pixels on {self.profile.name}, looked for within ±{min(right.high, down.high):g} px and "
            f"±{turn.high:g} degrees, {self.seconds:g} s of instrument time"
        )

    def prepare(self) -> None:
        """Compute the target's appearance at every place of the search."""
        self.library = Library(self.bench)

    def first(self) -> Design:
        """Return the first stage: scattered pixels."""
        levels = scattered(self.bench, self.library, self.seed, self._at_most(SCATTERED))
        return design_of(self.profile, levels, self.bench.shape, FIRST_SHARE * self.seconds)

    def second(self, known: Estimate) -> Design:
        """Return the second stage: the patterns that tell most where the target is `known` to be about."""
        seconds, count = (1 - FIRST_SHARE) * self.seconds, self._at_most(TELLING)
        trial = scattered(self.bench, self.library, self.seed, count)
        plan = design_of(self.profile, trial, self.bench.shape, seconds)
        exposures = plan.n_cycles * plan.plan.slots_per_cycle / (1.1 * count)
        levels = telling(self.bench, known, self.seed + 1, exposures, count)
        return design_of(self.profile, levels, self.bench.shape, seconds)

    def take(self, design: Design, core: CalibrationCore, known: Estimate | None = None) -> Estimate:
        """Add what was counted of `design` and return the estimate from all so far; UsageError where nothing can be told."""
        counts = joined_counts(counts_of(core, design, self.profile))
        seen = Observed.of(design.bundle.pattern_levels.astype(np.float64), counts)
        check_saturation(seen)
        self.observed = seen if self.observed is None else self.observed.joined(seen)
        with as_usage_error():
            return estimate(self.bench, self.observed, self.library, None if known is None else known.values)

    def _at_most(self, count: int) -> int:
        """As many patterns as the instrument can show: in parallel mode each channel has one."""
        profile = self.profile
        return profile.detector.channels if profile.mode == "parallel" else min(count, profile.projector.pattern_memory)


def check_saturation(observed: Observed) -> None:
    """Raise UsageError where nearly all exposures with light clicked, or hardly one did."""
    lit = observed.lit
    exposures, clicks = int(observed.exposures[lit].sum()), int(observed.clicks[lit].sum())
    if clicks > SATURATED_SHARE * exposures:
        raise UsageError(
            f"the detector saturates: {clicks} of {exposures} exposures with light clicked, allowed up to {SATURATED_SHARE:.0%}",
            remedy="put a filter of optical density 1 before the detector, or lower the light, and try again",
        )
    if not clicks:
        raise UsageError(
            f"none of {exposures} exposures with light clicked",
            remedy="check the light path: the target must stand before the detector, and the light must be on",
        )


def check_estimate(
    found: Estimate, seconds: float, precision: tuple[float, float] = (PRECISION_PX, PRECISION_DEG)
) -> None:
    """Raise UsageError for an estimate at the edge of the search, one that does not explain the counts, or one that is too uncertain.

    `precision` is what half of the 95 % interval may be, in px of shift and degrees of rotation.
    """
    edges = [
        f"{one.name} {value:.4g}, looked for from {one.low:g} to {one.high:g}"
        for one, value in zip(PARAMETERS, found.values.tolist())
        if not (one.low < value < one.high or (one.name == "psf_px" and value <= one.low))
    ]
    if edges:
        raise UsageError(
            f"the estimate lies at the edge of the search: {'; '.join(edges)}",
            remedy="align the target by hand first, or check that it is the one that was named",
        )
    if found.p_value < MISFIT_CHANCE:
        raise UsageError(
            f"the model does not explain the counts: chi-square {found.chi2:.0f} over {found.degrees} degrees of freedom "
            f"(p = {found.p_value:.1g}, allowed from {MISFIT_CHANCE:g})",
            remedy="check that the target is the one that was named, that nothing moved, and that the light is steady",
        )
    wanted = {**dict.fromkeys(LENGTHS, precision[0]), **dict.fromkeys(ANGLES, precision[1])}
    half = {one.name: math.sqrt(CHI2_95) * error for one, error in zip(PARAMETERS, found.errors.tolist())}
    worst = max(wanted, key=lambda name: half[name] / wanted[name])
    if half[worst] > wanted[worst]:
        factor = (half[worst] / wanted[worst]) ** 2
        raise UsageError(
            f"too few photons: {worst} is known to ±{half[worst]:.3g} from {found.clicks} clicks, wanted ±{wanted[worst]:g}",
            remedy=f"--seconds {seconds * factor * 1.1:.3g}: {seconds * (factor * 1.1 - 1):.3g} s more",
        )


def scattered(bench: Bench, library: Library, seed: int, count: int = SCATTERED) -> U16:
    """Return `count` patterns of random lit pixels where the target may stand, uint16 (count, pixels)."""
    rng = np.random.default_rng(seed)
    visible = np.flatnonzero(library.appearance.max(axis=0) > VISIBLE)
    mean = float(library.appearance[:, visible].mean()) * bench.photons_per_level
    levels = np.zeros((count, len(bench.target)), np.uint16)
    for number, row in enumerate(levels):
        if number % EMPTY_EVERY == EMPTY_EVERY - 1:
            continue
        wanted = DRIVES[number % len(DRIVES)] / mean  # levels, over all lit pixels
        level = int(min(bench.levels - 1, max(1, np.ceil(wanted / (len(visible) // 2)))))
        lit = int(np.clip(np.rint(wanted / level), 1, len(visible)))
        row[rng.permutation(visible)[:lit]] = level
    return levels


def telling(bench: Bench, known: Estimate, seed: int, exposures: float, count: int = TELLING) -> U16:
    """Return `count` patterns for the second stage, uint16 (count, pixels), a pattern twice where it tells so much.

    From candidates that each serve one direction among the parameters, the one that lowers the sum of the variances, in units of what
    each parameter is worth, most is taken in turn; `exposures` is how many each will have.
    """
    worth = np.append(WORTHS, 1.0)
    candidates = _candidates(bench, known, np.random.default_rng(seed), worth)
    _, telling_of = information_per_exposure(bench, known.values, candidates.astype(np.float64))
    scaled = telling_of * worth * np.sqrt(exposures)
    covariance = known.covariance / np.outer(worth, worth)
    counted = np.append(np.ones(DARK), 0.0)  # dark counts are not what is looked for
    chosen = []
    for _ in range(count):
        lowers = scaled @ covariance  # (candidates, 13)
        gain = ((lowers * lowers) @ counted) / (1.0 + (lowers * scaled).sum(axis=1))
        best = int(np.argmax(gain))
        chosen.append(best)
        covariance = covariance - np.outer(lowers[best], lowers[best]) / (1.0 + lowers[best] @ scaled[best])
    return candidates[chosen]


def _candidates(bench: Bench, known: Estimate, rng: np.random.Generator, worth: F64) -> U16:
    """Return patterns of the pixels whose light changes most along directions among the parameters, and one without a lit pixel."""
    pixels = np.eye(len(bench.target))
    black_out = known.values.copy()
    black_out[6] = 0.0  # what a lit pixel adds
    light, slopes = bench.slopes(black_out, pixels)
    light = light - known.values[DARK]
    root = np.linalg.cholesky(known.covariance / np.outer(worth, worth) + 1e-12 * np.eye(len(worth)))
    directions = np.vstack([np.eye(DARK + 1), rng.standard_normal((DIRECTIONS, DARK + 1)) @ root.T])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    effect = (slopes * worth) @ np.vstack([directions, -directions]).T / np.sqrt(light + light.max() / 20)[:, None]
    order = np.argsort(-effect, axis=0)
    found = [np.zeros((1, len(pixels)), np.uint16)]
    for size in SIZES:
        lit = order[:size]  # (size, directions)
        level = np.clip(np.rint(DRIVE / np.maximum(light[lit].sum(axis=0), 1e-12)), 1, bench.levels - 1)
        levels = np.zeros((lit.shape[1], len(pixels)), np.uint16)
        np.put_along_axis(levels, lit.T, level[:, None].astype(np.uint16), axis=1)
        found.append(levels)
    return np.unique(np.vstack(found), axis=0)
