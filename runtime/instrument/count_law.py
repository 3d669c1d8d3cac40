"""The count law: what a detector that resolves photon numbers reads in one exposure, given the photoelectrons that reach it.

Owns the probability of every reading and its slope, in stable forms; never samples readings, and knows no dead time: a detector that
blinds itself counts no photons. Calls return float64 arrays (outcomes, *shape of their input).

With mu = photoelectrons + dark_per_exposure, Poisson counts k are read with Gaussian noise sigma and put into bins between `edges`
e_1 < ... < e_n: outcome j is a reading in [e_j, e_j+1), with e_0 = -inf and e_n+1 = inf,
`P(j) = exp(-mu) * sum_k w_j(k) mu^k / k!`, `w_j(k) = Phi((e_j+1 - k)/sigma) - Phi((e_j - k)/sigma)`. With one edge it is the click law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .click_law import ClickLaw, click_law
from .profile import Profile

F64 = NDArray[np.float64]
OUTCOMES_MAX = 16  # a reading is at most 15: beyond it the bins of a real detector overlap
_TINY = 1e-300  # a weight below this is negligible at any mean that a float can hold
_ENOUGH = 1e-18  # of a sum: what all further terms may add


@dataclass(frozen=True, slots=True)
class CountLaw:
    """Dark photoelectrons per exposure, read noise and the edges between the outcomes, in photoelectrons."""

    dark_per_exposure: float
    read_noise_e: float
    edges: tuple[float, ...]

    def __post_init__(self) -> None:
        if not 0 <= self.dark_per_exposure < math.inf:
            raise ValueError(f"dark_per_exposure must be finite and at least 0, found {self.dark_per_exposure}")
        if not 0 <= self.read_noise_e <= 3:
            raise ValueError(f"read_noise_e must be from 0 to 3, found {self.read_noise_e}")
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


def count_law(profile: Profile, exposure_us: float, outcomes: int) -> CountLaw | ClickLaw:
    """The law of one exposure of `exposure_us` microseconds whose reading is one of `outcomes`; of two the click law.

    The first edge is the profile's threshold, the others lie halfway between whole numbers. ValueError for what the profile's detector
    cannot tell apart, and for dead time and afterpulses.
    """
    clicks = click_law(profile, exposure_us)
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
    mu = _mean(law, photoelectrons)
    weights = outcome_weights(law)
    found = np.zeros((law.outcomes, *mu.shape))
    for k in range(weights.shape[1]):
        found[:-1] += _each(weights[:-1, k], mu) * _poisson(mu, k)
    rest = 1.0 - found[:-1].sum(axis=0)
    found[-1] = np.where(rest > 0.5, rest, _last(law, np.where(rest > 0.5, 0.0, mu)))
    return found


def count_slopes(law: CountLaw, photoelectrons: ArrayLike) -> F64:
    """d P(outcome) / d photoelectrons, (outcomes, *shape): sum_k (w_j(k + 1) - w_j(k)) exp(-mu) mu^k / k!, a finite sum."""
    mu = _mean(law, photoelectrons)
    weights = outcome_weights(law)
    last = np.zeros(law.outcomes)
    last[-1] = 1.0
    rise = np.diff(np.column_stack([weights, last]), axis=1)
    found = np.zeros((law.outcomes, *mu.shape))
    for k in range(weights.shape[1]):
        found += _each(rise[:, k], mu) * _poisson(mu, k)
    return found


def _mean(law: CountLaw, photoelectrons: ArrayLike) -> F64:
    light = np.asarray(photoelectrons, dtype=np.float64)
    if light.size and not (light.min() >= 0 and light.max() < math.inf):  # also false for nan
        raise ValueError(f"photoelectrons must be finite and at least 0, found {light.min():g} to {light.max():g}")
    return light + law.dark_per_exposure


def _each(values: F64, mu: F64) -> F64:
    return values.reshape((-1,) + (1,) * mu.ndim)


def _poisson(mu: F64, k: int) -> F64:
    """exp(-mu) mu^k / k!, in log space: mu^k overflows and exp(-mu) underflows where their product is an ordinary number."""
    if k == 0:
        return np.asarray(np.exp(-mu))
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(k * np.log(mu) - mu - math.lgamma(k + 1)))


def _last(law: CountLaw, mu: F64) -> F64:
    """The chance of the last outcome where it is below 1/2: all terms are positive, nothing cancels."""
    term = np.exp(-mu)
    total = _above(law, law.edges[-1], 0) * term
    k = 0
    while k < law.edges[-1] or np.any(term > _ENOUGH * total):
        k += 1
        term = term * (mu / k)
        total = total + _above(law, law.edges[-1], k) * term
    return np.asarray(total)


def _weights(law: CountLaw, k: int) -> list[float]:
    """P(outcome | k photoelectrons) of every outcome, each from the tails that are small there, so that none cancels."""
    below = [_below(law, edge, k) for edge in law.edges]
    above = [_above(law, edge, k) for edge in law.edges]
    between = []
    for low, high in zip(range(len(below)), range(1, len(below))):
        if law.edges[low] > k:
            between.append(above[low] - above[high])
        elif law.edges[high] < k:
            between.append(below[high] - below[low])
        else:
            between.append(1.0 - below[low] - above[high])
    return [below[0], *between, above[-1]]


def _above(law: CountLaw, edge: float, k: int) -> float:
    """P(reading >= edge | k photoelectrons)."""
    if law.read_noise_e == 0:
        return float(k >= edge)
    return 0.5 * math.erfc((edge - k) / (law.read_noise_e * math.sqrt(2)))


def _below(law: CountLaw, edge: float, k: int) -> float:
    if law.read_noise_e == 0:
        return float(k < edge)
    return 0.5 * math.erfc((k - edge) / (law.read_noise_e * math.sqrt(2)))
