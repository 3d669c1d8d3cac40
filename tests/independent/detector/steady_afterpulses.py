"""Afterpulses under steady light, without approximation: how often exposures click, and how clicks depend on each other.

The carriers X still to come are an affine process: E[exp(-u X(t)) | X(0)] = exp(-v X(0) - m w) with dv/dt = -(v - 1 + exp(-a v))/tau,
dw/dt = 1 - exp(-a v), v(0) = u, w(0) = 0 (Hawkes and Oakes, Journal of Applied Probability 11, 493, 1974; Errais, Giesecke and Goldberg,
SIAM Journal on Financial Mathematics 1, 642, 2010). An exposure is silent with exp(-m - q X). Going back period by period until v
vanishes gives the stationary mean of exp(-u X); the product of two silences is another such mean.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pans.runtime.detector import Afterpulses

_STEPS, _STEPS_LEAST = 12, 4  # of Runge and Kutta in a time constant, and beside those
_GONE = 1e-12
_PERIODS_MAX = 100_000


def stationary_chance(afterpulses: Afterpulses, mean: float) -> float:
    """Return the chance that an exposure clicks in steady light of `mean` (photoelectrons and dark counts), after a long time."""
    if not afterpulses.time:
        first, again = -math.expm1(-mean), afterpulses.probability
        return first / (1 - again * (1 - first))  # c = first + (1 - first) again c
    return 1 - _silences(afterpulses, mean, None)


def correlation(afterpulses: Afterpulses, mean: float, lags: int) -> NDArray[np.float64]:
    """Return the covariance of clicks of exposures 0 and 1, 0 and 2, ... `lags`, float64 (lags,), in steady light."""
    chance = stationary_chance(afterpulses, mean)
    if not afterpulses.time:
        kept = afterpulses.probability * math.exp(-mean)  # of a chain of two states: its second eigenvalue
        return np.asarray(chance * (1 - chance) * kept ** np.arange(1.0, lags + 1))
    return np.array([_silences(afterpulses, mean, lag) for lag in range(1, lags + 1)]) - (1 - chance) ** 2


def _silences(afterpulses: Afterpulses, mean: float, lag: int | None) -> float:
    """The chance that exposure 0 is silent, and exposure `lag` too where there is one."""
    u, log_chance = 0.0, 0.0
    if lag is not None:
        u, log_chance = afterpulses.seen, -mean
        for back in range(lag):
            u, passed = _pause(afterpulses, u)
            log_chance -= mean * passed
            if back < lag - 1:
                u, passed = _on(afterpulses, u, 1.0)
                log_chance -= mean * passed
        u *= math.exp(-1 / afterpulses.time)  # through exposure 0, in which nothing was detected
    u, log_chance = u + afterpulses.seen, log_chance - mean
    for _ in range(_PERIODS_MAX):
        if u < _GONE:
            return math.exp(log_chance)
        u, in_pause = _pause(afterpulses, u)
        u, exposed = _on(afterpulses, u, 1.0)
        log_chance -= mean * (in_pause + exposed)
    raise ValueError(f"a time constant of {afterpulses.time:g} exposures is too long for this sum")


def _pause(afterpulses: Afterpulses, u: float) -> tuple[float, float]:
    if afterpulses.free_running:
        return _on(afterpulses, u, afterpulses.pause)
    return u * math.exp(-afterpulses.pause / afterpulses.time), 0.0


def _on(afterpulses: Afterpulses, u: float, duration: float) -> tuple[float, float]:
    """v and w after `duration` in which the detector is on."""
    if not duration:
        return u, 0.0
    a, tau = afterpulses.carriers, afterpulses.time
    n = math.ceil(_STEPS_LEAST + _STEPS * duration / tau)
    step, v, w = duration / n, u, 0.0

    def slope(v: float) -> tuple[float, float]:
        filled = -math.expm1(-a * v)
        return -(v - filled) / tau, filled

    for _ in range(n):
        v1, w1 = slope(v)
        v2, w2 = slope(v + 0.5 * step * v1)
        v3, w3 = slope(v + 0.5 * step * v2)
        v4, w4 = slope(v + step * v3)
        v += step / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
        w += step / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
    return v, w
