"""One detector, event by event: photons, dark counts, dead time, carriers that traps release, gates. Shares no code with the package.

Times are in exposures: exposure k lasts from k * (1 + pause) to k * (1 + pause) + 1. Every round begins with an awake detector and empty
traps. Compiled, since an error of 0.0003 takes a million rounds.
"""

import numpy as np
from numba import njit

MOST_PENDING = 4096  # carriers in traps at once


@njit(cache=True)
def play(light, dead, pause, kind, traps, rng, clicks):  # type: ignore[no-untyped-def]
    """Fill clicks uint8 (rounds, exposures): which exposures hold a detection.

    light float64 (exposures,): mean photons and dark counts of each exposure; kind (free-running, paralysable); traps (mean carriers of a
    detection, their time constant, 0 for none). A carrier comes after the dead time of its detection plus an exponential delay. A gated
    detector meets nothing in a pause, a free-running one the light of the exposure before it.
    """
    free_running, paralysable = kind
    carriers, tau = traps
    n = light.size
    period = 1.0 + pause
    pending = np.empty(MOST_PENDING)
    for r in range(clicks.shape[0]):
        waiting, now, blind_until = 0, 0.0, 0.0
        for k in range(n):
            clicks[r, k] = 0
        for k in range(n):
            begin, off = k * period, k * period + (period if free_running else 1.0)
            now = begin
            still, kept = 0, 0
            while still < waiting:  # released while the detector was off
                if pending[still] >= begin:
                    pending[kept] = pending[still]
                    kept += 1
                still += 1
            waiting = kept
            while True:
                photon = now + rng.standard_exponential() / light[k] if light[k] > 0.0 else np.inf
                first, at = photon, -1
                for i in range(waiting):
                    if pending[i] < first:
                        first, at = pending[i], i
                if first >= off:
                    break
                now = first
                if at >= 0:
                    waiting -= 1
                    pending[at] = pending[waiting]
                if now < blind_until:
                    if paralysable:
                        blind_until = now + dead
                    continue
                blind_until = now + dead
                if now < begin + 1.0:
                    clicks[r, k] = 1
                if tau > 0.0:
                    for _ in range(rng.poisson(carriers)):
                        pending[waiting] = now + dead + tau * rng.standard_exponential()
                        waiting += 1


def rounds_of(
    light: list[float],
    rounds: int,
    seed: int,
    *,
    dead: float = 0.0,
    pause: float = 0.0,
    free_running: bool = False,
    paralysable: bool = False,
    afterpulse: float = 0.0,
    tau: float = 0.0,
) -> np.ndarray:
    """Return uint8 (rounds, exposures): the clicks of `rounds` rounds of exposures of `light` photons each."""
    clicks = np.zeros((rounds, len(light)), np.uint8)
    kind, traps = (free_running, paralysable), (-np.log1p(-afterpulse), tau)
    play(np.array(light, np.float64), dead, pause, kind, traps, np.random.default_rng(seed), clicks)
    return clicks


def crosstalk_on(own: np.ndarray, by_distance: list[float], seed: int) -> np.ndarray:
    """Return clicks uint8 (rounds, channels) of `own` ones, each of which fires its neighbours at distance 1, 2, ... with a chance."""
    rng, found = np.random.default_rng(seed), own.copy()
    for distance, chance in enumerate(by_distance, 1):
        for fired, by in ((found[:, distance:], own[:, :-distance]), (found[:, :-distance], own[:, distance:])):
            fired |= by & (rng.random(by.shape) < chance).astype(np.uint8)
    return found
