"""The click law: the probability that one exposure clicks, given the photoelectrons that reach the detector.

Owns the formulas and their stable forms; never samples clicks (the simulator does) and never models what links exposures
(afterpulsing; dead time counts by its mean effect, dead_time.py). All calls return float64 arrays of the shape of their input.

With mu = photoelectrons + dark_per_exposure (of which dead time leaves the counted mean), Poisson counts k are read with Gaussian
noise sigma against a threshold theta:
`1 - p = exp(-mu) * sum_k c_k mu^k`, `c_k = Phi((theta - k)/sigma)/k!`. Without read noise and with theta in (0, 1] this is
the thresholded Poisson law of the paper, `p = 1 - exp(-mu)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from .dead_time import NO_DEAD_TIME, DeadTime, counted_mean
from .profile import Profile
from .profile_schema import FREE_RUNNING, PARALYSABLE

F64 = NDArray[np.float64]
DEAD_TIME_MATTERS = 1e-3  # of the exposure: below it, no probability changes by more than 3e-7
_TINY = 1e-300  # Phi below this is negligible at any mean that a float can hold, and would soon be subnormal


@dataclass(frozen=True, slots=True)
class ClickLaw:
    """Dark photoelectrons per exposure, read noise and threshold in photoelectrons, dead time in exposures."""

    dark_per_exposure: float = 0.0
    read_noise_e: float = 0.0
    threshold_e: float = 0.5
    dead_time: DeadTime = NO_DEAD_TIME

    def __post_init__(self) -> None:
        if not 0 <= self.dark_per_exposure < math.inf:
            raise ValueError(f"dark_per_exposure must be finite and at least 0, found {self.dark_per_exposure}")
        if not 0 <= self.read_noise_e <= 3:
            raise ValueError(f"read_noise_e must be from 0 to 3, found {self.read_noise_e}")
        if not 0 < self.threshold_e <= 10:
            raise ValueError(f"threshold_e must be above 0 and at most 10, found {self.threshold_e}")


def click_law(profile: Profile, exposure_us: float) -> ClickLaw:
    """The law of one exposure of `exposure_us` microseconds on this profile's detector."""
    detector = profile.detector
    dark = detector.dark_rate_hz * exposure_us * 1e-6
    return ClickLaw(dark, detector.read_noise_e, detector.threshold_e, dead_time_of(profile, exposure_us))


def dead_time_of(profile: Profile, exposure_us: float) -> DeadTime:
    """The dead time in exposures of `exposure_us` microseconds, the readout being the pause; none where it changes nothing.

    It changes nothing below a permille of the exposure, and of a gated detector where the readout outlasts it.
    """
    detector = profile.detector
    pause, dead = profile.exposure.readout_us / exposure_us, detector.dead_time_ns * 1e-3 / exposure_us
    found = DeadTime(
        min(dead, 1 + pause),  # a profile allows as much; what is rounded to ticks may be a little shorter
        pause,
        detector.between_exposures == FREE_RUNNING,
        detector.dead_time_kind == PARALYSABLE,
    )
    return found if dead > DEAD_TIME_MATTERS and found.reach else NO_DEAD_TIME


def survival_coefficients(law: ClickLaw) -> F64:
    """The c_k of `1 - p = exp(-mu) * sum_k c_k mu^k`, float64 (n,), up to the last that is not negligible."""
    coefficients = np.exp(_log_coefficients(law))
    return coefficients[coefficients > _TINY]


def click_probability(law: ClickLaw, photoelectrons: ArrayLike) -> F64:
    """p for `photoelectrons` (any shape, per exposure, at least 0); accurate to a few ulp also where p is tiny."""
    mu = _mean(law, photoelectrons)
    if _is_plain(law):
        return np.asarray(-np.expm1(-mu))
    log_miss = _log_survival(law, mu)
    return np.where(log_miss < -math.log(2), -np.expm1(log_miss), _small_p(law, mu, log_miss))


def both_chances(law: ClickLaw, photoelectrons: ArrayLike) -> tuple[F64, F64]:
    """Return (p, 1 - p) for `photoelectrons` (any shape), each accurate to a few ulp of its own, however small."""
    mu = _mean(law, photoelectrons)
    if _is_plain(law):
        return np.asarray(-np.expm1(-mu)), np.asarray(np.exp(-mu))
    log_miss = _log_survival(law, mu)
    small, certain = _small_p(law, mu, log_miss), log_miss < -math.log(2)
    return np.where(certain, -np.expm1(log_miss), small), np.where(certain, np.exp(log_miss), 1.0 - small)


def log_no_click(law: ClickLaw, photoelectrons: ArrayLike) -> F64:
    """log(1 - p) for `photoelectrons` (any shape); finite for every finite input."""
    mu = _mean(law, photoelectrons)
    if _is_plain(law):
        return np.asarray(-mu)
    log_miss = _log_survival(law, mu)
    return np.where(log_miss < -math.log(2), log_miss, np.log1p(-_small_p(law, mu, log_miss)))


def log_click(law: ClickLaw, photoelectrons: ArrayLike) -> F64:
    """log p for `photoelectrons` (any shape); -inf where no click can happen (no light, dark counts or read noise)."""
    mu = _mean(law, photoelectrons)
    log_miss = -mu if _is_plain(law) else _log_survival(law, mu)
    small = -np.expm1(-mu) if _is_plain(law) else _small_p(law, mu, log_miss)
    with np.errstate(divide="ignore"):
        return np.where(log_miss < -math.log(2), np.log1p(-np.exp(log_miss)), np.log(small))


def object_transmission(
    profile: Profile | None, images: NDArray[np.uint8], dtype: DTypeLike = np.float64
) -> NDArray[np.floating]:
    """Transmission in [black, 1] of 8-bit `images` (any shape) on the profile's object modulator; same shape.

    Without a profile, or without a modulator in it, black is 0 and white is 1. A modulator of fewer than 256 levels rounds
    to its own.
    """
    if images.dtype != np.uint8:
        raise ValueError(f"images must be uint8 (0 is black, 255 is white), found {images.dtype}")
    gray = np.arange(256) / 255.0
    modulator = None if profile is None else profile.object_modulator
    if modulator is not None:
        if modulator.levels < 256:
            gray = np.rint(gray * (modulator.levels - 1)) / (modulator.levels - 1)
        darkest = profile.min_transmission if profile is not None else 0.0
        gray = darkest + (1.0 - darkest) * gray
    table = gray.astype(dtype)
    return np.asarray(table[images])


def _is_plain(law: ClickLaw) -> bool:
    return law.read_noise_e == 0 and law.threshold_e <= 1


def _mean(law: ClickLaw, photoelectrons: ArrayLike) -> F64:
    mu = np.asarray(photoelectrons, dtype=np.float64) + law.dark_per_exposure
    if mu.size and not (mu.min() >= law.dark_per_exposure and mu.max() < math.inf):  # also false for nan
        low, high = mu.min() - law.dark_per_exposure, mu.max() - law.dark_per_exposure
        raise ValueError(f"photoelectrons must be finite and at least 0, found {low:g} to {high:g}")
    return counted_mean(law.dead_time, mu)


def _above(law: ClickLaw, k: int) -> float:
    """P(reading >= threshold | k photoelectrons)."""
    if law.read_noise_e == 0:
        return float(k >= law.threshold_e)
    return 0.5 * math.erfc((law.threshold_e - k) / (law.read_noise_e * math.sqrt(2)))


def _below(law: ClickLaw, k: int) -> float:
    if law.read_noise_e == 0:
        return float(k < law.threshold_e)
    return 0.5 * math.erfc((k - law.threshold_e) / (law.read_noise_e * math.sqrt(2)))


def _log_coefficients(law: ClickLaw) -> F64:
    """log c_k: the last ones matter at large means, though c_k itself is no float any more."""
    logs: list[float] = []
    while (below := _below(law, len(logs))) > _TINY:
        logs.append(math.log(below) - math.lgamma(len(logs) + 1))
    return np.array(logs)


def _log_survival(law: ClickLaw, mu: F64) -> F64:
    """log(1 - p), accurate in absolute terms: summed in log space, as mu^k overflows and exp(-mu) underflows."""
    log_c = _log_coefficients(law)
    with np.errstate(divide="ignore"):
        log_mu = np.log(mu)
    total = np.full(mu.shape, log_c[0])
    for k in range(1, len(log_c)):
        total = np.logaddexp(total, log_c[k] + k * log_mu)
    return np.minimum(total - mu, 0.0)


def _small_p(law: ClickLaw, mu: F64, log_miss: F64) -> F64:
    """p = exp(-mu) sum_k Q((theta - k)/sigma) mu^k/k!, right where it is below 1/2: all terms are positive, nothing cancels."""
    mu = np.where(log_miss < -math.log(2), 0.0, mu)
    term = np.exp(-mu)
    total = _above(law, 0) * term
    k = 0
    while k < law.threshold_e or np.any(term > 1e-18 * total):
        k += 1
        term = term * (mu / k)
        total = total + _above(law, k) * term
    return np.asarray(total)
