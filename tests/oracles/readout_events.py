"""Single events that are seen at another time, and a pixel that jumps. Shares no code with the package."""

import numpy as np


def jittered(light: np.ndarray, sigma: float, pause: float, runs: int, seed: int) -> np.ndarray:
    """Return the mean number of events seen in each exposure, (exposures,), of `runs` runs; times in exposures.

    `light` (exposures,) are mean events of an exposure; in half of the pause before and after it the light is the same.
    """
    rng = np.random.default_rng(seed)
    period, n = 1.0 + pause, len(light)
    place = np.repeat(np.arange(n), rng.poisson(light * period * runs))
    seen = place * period - 0.5 * pause + rng.random(len(place)) * period + sigma * rng.standard_normal(len(place))
    exposure = np.floor(seen / period).astype(np.int64)
    inside = (seen - exposure * period < 1.0) & (exposure >= 0) & (exposure < n)
    return np.bincount(exposure[inside], minlength=n) / runs


def telegraph(times_s: np.ndarray, mean_s: float, seed: int) -> np.ndarray:
    """Return the level, 0 or 1, at `times_s` (n,) of one pixel that holds each level for an exponential time."""
    rng = np.random.default_rng(seed)
    level, now, found = int(rng.random() < 0.5), 0.0, np.zeros(len(times_s), np.int64)
    at = 0
    while at < len(times_s):
        now += rng.exponential(mean_s)
        while at < len(times_s) and times_s[at] < now:
            found[at] = level
            at += 1
        level = 1 - level
    return found
