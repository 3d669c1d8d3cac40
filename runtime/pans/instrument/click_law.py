"""The laws of one exposure: the probabilities of its outcomes, given the photoelectrons that reach the detector.

`ClickLaw` is of a detector that clicks or not, `CountLaw` of one that resolves photon numbers. What links exposures is elsewhere:
afterpulses in pans.instrument.detector, dead time by its mean effect in dead_time.py. Functions return float64 arrays of the shape of their
input, those of a count law (outcomes, *shape).

With mu = photoelectrons + dark_per_exposure (of which dead time leaves the counted mean), Poisson counts k are read with Gaussian
noise sigma against a threshold theta:
`1 - p = exp(-mu) * sum_k c_k mu^k`, `c_k = Phi((theta - k)/sigma)/k!`. Without read noise and with theta in (0, 1] this is
the thresholded Poisson law of the paper, `p = 1 - exp(-mu)`.

A count law puts readings into bins between `edges` e_1 < ... < e_n: outcome j is a reading in [e_j, e_j+1), with e_0 = -inf and
e_n+1 = inf, `P(j) = exp(-mu) * sum_k w_j(k) mu^k / k!`, `w_j(k) = Phi((e_j+1 - k)/sigma) - Phi((e_j - k)/sigma)`. With one edge it is the
click law. It knows no dead time: a detector that blinds itself counts no photons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from pans.instrument.detector.afterpulses import HOLDS_TO, afterpulses_of
from pans.instrument.detector.crosstalk import crosstalk_of
from pans.instrument.detector.dead_time import NO_DEAD_TIME, DeadTime, counted_mean, unequal_error

from .profile import Profile
from .profile_schema import FREE_RUNNING, PARALYSABLE

F64 = NDArray[np.float64]
DEAD_TIME_MATTERS = 1e-3  # of the exposure: below it, no probability changes by more than 3e-7
OUTCOMES_MAX = 16  # a reading is at most 15: beyond it the bins of a real detector overlap
_TINY = 1e-300  # Phi below this is negligible at any mean that a float can hold, and would soon be subnormal
_ENOUGH = 1e-18  # of a sum: what all further terms may add


@dataclass(frozen=True, slots=True)
class ClickLaw:
    """Dark photoelectrons per exposure, read noise and threshold in photoelectrons, dead time in exposures."""

    dark_per_exposure: float = 0.0
    read_noise_e: float = 0.0
    threshold_e: float = 0.5
    dead_time: DeadTime = NO_DEAD_TIME

    def __post_init__(self) -> None:
        _check_noise(self.dark_per_exposure, self.read_noise_e)
        if not 0 < self.threshold_e <= 10:
            raise ValueError(f"threshold_e must be above 0 and at most 10, found {self.threshold_e}")


def click_law(profile: Profile, exposure_us: float, dark: float | None = None) -> ClickLaw:
    """The law of one exposure of `exposure_us` microseconds on this profile's detector, with `dark` photoelectrons instead of its own."""
    detector = profile.detector
    dark = detector.dark_rate_hz * exposure_us * 1e-6 if dark is None else dark
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
    return both_chances(law, photoelectrons)[0]


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


@dataclass(frozen=True, slots=True)
class CountLaw:
    """Dark photoelectrons per exposure, read noise and the edges between the outcomes, in photoelectrons."""

    dark_per_exposure: float
    read_noise_e: float
    edges: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_noise(self.dark_per_exposure, self.read_noise_e)
        rising = all(low < high for low, high in zip(self.edges, self.edges[1:]))
        if not (1 <= len(self.edges) < OUTCOMES_MAX and rising and self.edges[0] > 0 and self.edges[-1] <= 20):
            raise ValueError(
                f"edges must be 1 to {OUTCOMES_MAX - 1}, rising, above 0 and at most 20, found {self.edges}"
            )

    @property
    def outcomes(self) -> int:
        """Number of outcomes: readings 0, 1, ... and "this many or more"."""
        return len(self.edges) + 1

    @property
    def is_plain(self) -> bool:
        """Whether outcome j is exactly j photoelectrons, and the last one that many or more."""
        return self.read_noise_e == 0 and all(j < edge <= j + 1 for j, edge in enumerate(self.edges))


def count_law(profile: Profile, exposure_us: float, outcomes: int, dark: float | None = None) -> CountLaw | ClickLaw:
    """The law of one exposure of `exposure_us` microseconds whose reading is one of `outcomes`; of two the click law.

    The first edge is the profile's threshold, the others lie halfway between whole numbers. ValueError for what the profile's detector
    cannot tell apart, and for dead time and afterpulses.
    """
    clicks = click_law(profile, exposure_us, dark)
    if outcomes == 2:
        return clicks
    why = cannot_count(profile, outcomes)
    if why:
        raise ValueError(why)
    return counting(clicks, outcomes)


def counting(law: ClickLaw, outcomes: int) -> CountLaw:
    """The law of `outcomes` readings on a detector whose clicks follow `law`; ValueError where its threshold is 1.5 or more."""
    return CountLaw(
        law.dark_per_exposure, law.read_noise_e, (law.threshold_e, *(j + 0.5 for j in range(1, outcomes - 1)))
    )


def outcomes_of(law: ClickLaw | CountLaw) -> int:
    """Return how many outcomes an exposure has under `law`; two are no click and a click."""
    return law.outcomes if isinstance(law, CountLaw) else 2


def cannot_count(profile: Profile, outcomes: int) -> str:
    """Return why `profile` cannot tell `outcomes` readings of an exposure apart, or "" if it can."""
    detector = profile.detector
    most = detector.photon_number_max + 1
    if not 2 <= outcomes <= OUTCOMES_MAX:
        return f"{outcomes} outcomes per exposure, allowed: 2 to {OUTCOMES_MAX}"
    if outcomes == 2:
        return ""
    if outcomes > most:
        return f"{outcomes} outcomes per exposure, {profile.name} tells {most} apart (detector.photon_number_max)"
    for key in ("dead_time_ns", "afterpulse_probability"):
        if getattr(detector, key) > 0:
            return (
                f"{outcomes} outcomes per exposure, but {profile.name} has detector.{key}: it clicks, it does not count"
            )
    if detector.threshold_e >= 1.5:
        found = f"detector.threshold_e of {profile.name} is {detector.threshold_e:g}"
        return f"{outcomes} outcomes per exposure, but {found}, allowed: below 1.5"
    return ""


def cannot_read_at_once(profile: Profile, channels: int) -> str:
    """Return why no exact law tells what `channels` detectors of `profile` read in one exposure, pattern after pattern, or "" if one does.

    Each clicks by the click law, and given the light they are independent.
    """
    detector = profile.detector
    if profile.mode != "sequential":
        return f"{channels} channels per exposure of a walk, {profile.name} measures in {profile.mode} mode"
    if channels > detector.channels:
        return f"{channels} channels per exposure, {profile.name} has {detector.channels} (detector.channels)"
    for key in ("crosstalk_probability", "afterpulse_probability"):
        if getattr(detector, key) > 0:
            return f"{channels} channels per exposure, but {profile.name} has detector.{key}: their clicks are not independent"
    return ""


def outcome_weights(law: CountLaw) -> F64:
    """The w_j(k), float64 (outcomes, n): P(outcome j | k photoelectrons), up to the last k at which any but the last outcome counts."""
    columns: list[list[float]] = []
    while not columns or max(columns[-1][:-1]) > _TINY:
        columns.append(_weights(law, len(columns)))
    return np.array(columns).T


def count_chances(law: CountLaw, photoelectrons: ArrayLike) -> F64:
    """P(outcome) for `photoelectrons` (any shape, per exposure, at least 0), (outcomes, *shape); accurate however small."""
    mu = _light(photoelectrons) + law.dark_per_exposure
    weights = outcome_weights(law)
    found = np.zeros((law.outcomes, *mu.shape))
    for k in range(weights.shape[1]):
        found[:-1] += _each(weights[:-1, k], mu) * _poisson(mu, k)
    rest = 1.0 - found[:-1].sum(axis=0)
    found[-1] = np.where(rest > 0.5, rest, _tail(law.read_noise_e, law.edges[-1], np.where(rest > 0.5, 0.0, mu)))
    return found


def _is_plain(law: ClickLaw) -> bool:
    return law.read_noise_e == 0 and law.threshold_e <= 1


def _check_noise(dark_per_exposure: float, read_noise_e: float) -> None:
    if not 0 <= dark_per_exposure < math.inf:
        raise ValueError(f"dark_per_exposure must be finite and at least 0, found {dark_per_exposure}")
    if not 0 <= read_noise_e <= 3:
        raise ValueError(f"read_noise_e must be from 0 to 3, found {read_noise_e}")


def _light(photoelectrons: ArrayLike) -> F64:
    light = np.asarray(photoelectrons, dtype=np.float64)
    if light.size and not (light.min() >= 0 and light.max() < math.inf):  # also false for nan
        raise ValueError(f"photoelectrons must be finite and at least 0, found {light.min():g} to {light.max():g}")
    return light


def _mean(law: ClickLaw, photoelectrons: ArrayLike) -> F64:
    return counted_mean(law.dead_time, _light(photoelectrons) + law.dark_per_exposure)


def _above(noise_e: float, edge: float, k: int) -> float:
    """P(reading >= edge | k photoelectrons)."""
    return float(k >= edge) if noise_e == 0 else 0.5 * math.erfc((edge - k) / (noise_e * math.sqrt(2)))


def _below(noise_e: float, edge: float, k: int) -> float:
    return float(k < edge) if noise_e == 0 else 0.5 * math.erfc((k - edge) / (noise_e * math.sqrt(2)))


def _log_coefficients(law: ClickLaw) -> F64:
    """log c_k: the last ones matter at large means, though c_k itself is no float any more."""
    logs: list[float] = []
    while (below := _below(law.read_noise_e, law.threshold_e, len(logs))) > _TINY:
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
    return _tail(law.read_noise_e, law.threshold_e, np.where(log_miss < -math.log(2), 0.0, mu))


def _tail(noise_e: float, edge: float, mu: F64) -> F64:
    """P(reading >= edge), right where it is below 1/2: all terms are positive, nothing cancels."""
    term = np.exp(-mu)
    total = _above(noise_e, edge, 0) * term
    k = 0
    while k < edge or np.any(term > _ENOUGH * total):
        k += 1
        term = term * (mu / k)
        total = total + _above(noise_e, edge, k) * term
    return np.asarray(total)


def _each(values: F64, mu: F64) -> F64:
    return values.reshape((-1,) + (1,) * mu.ndim)


def _poisson(mu: F64, k: int) -> F64:
    """exp(-mu) mu^k / k!, in log space: mu^k overflows and exp(-mu) underflows where their product is an ordinary number."""
    if k == 0:
        return np.asarray(np.exp(-mu))
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(k * np.log(mu) - mu - math.lgamma(k + 1)))


def _weights(law: CountLaw, k: int) -> list[float]:
    """P(outcome | k photoelectrons) of every outcome, each from the tails that are small there, so that none cancels."""
    below = [_below(law.read_noise_e, edge, k) for edge in law.edges]
    above = [_above(law.read_noise_e, edge, k) for edge in law.edges]
    between = []
    for low, high in zip(range(len(below)), range(1, len(below))):
        if law.edges[low] > k:
            between.append(above[low] - above[high])
        elif law.edges[high] < k:
            between.append(below[high] - below[low])
        else:
            between.append(1.0 - below[low] - above[high])
    return [below[0], *between, above[-1]]


# Where the laws of the detector stop holding, in words, for a plan, a training and an evaluation to warn of. The figures are from single
# events (tests/runtime/instrument/detector/test_laws.py); docs/explanation/detector.md has them.
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
