"""A detector with traps, carrier by carrier, in continuous time: what the law of afterpulses must say of exposures.

Shares no code with the package. Detections come in generations: first those of light, at random times in which the detector is on; every
detection then sets free a Poisson number of carriers, each after an exponential delay; those that meet a detector that is on are the next
generation. Many instruments run side by side. Times are in exposures; exposure k lasts from k * (1 + pause) to k * (1 + pause) + 1.
"""

from __future__ import annotations

import numpy as np


def clicks(light: np.ndarray, carriers: float, tau: float, pause: float, free_running: bool, seed: int) -> np.ndarray:
    """Return uint8 (2, instruments, exposures): which exposures hold a detection, of light alone and with what traps release.

    `light` float (instruments, exposures) are the mean photons of each exposure. A free-running detector meets the same light in the pause
    behind an exposure; a gated one is off there.
    """
    rng = np.random.default_rng(seed)
    n, exposures = light.shape
    period = 1.0 + pause
    open_for = period if free_running else 1.0
    place = np.repeat(np.arange(n * exposures), rng.poisson(light * open_for).ravel())
    who, when = place // exposures, (place % exposures) * period + rng.random(len(place)) * open_for
    found = np.zeros((2, n, exposures), np.uint8)
    generation = 0
    while len(who):
        exposure = (when // period).astype(np.int64)
        inside = when - exposure * period < 1.0
        found[1, who[inside], exposure[inside]] = 1
        if generation == 0:
            found[0] = found[1]
        generation += 1
        born = rng.poisson(carriers, len(who))
        who, when = np.repeat(who, born), np.repeat(when, born) + rng.exponential(tau, int(born.sum()))
        there = when < exposures * period
        if not free_running:
            there &= when % period < 1.0
        who, when = who[there], when[there]
    return found
