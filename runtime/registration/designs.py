"""Which patterns tell most of where the target stands, by the Fisher information.

Owns the two stages: scattered pixels, which tell something wherever the target is, and, once it is roughly known, the pixels on whose light
the parameters act most. Patterns are levels, uint16 (patterns, pixels), as few at the top level as the wanted mean allows. `seed`s
are arguments; nothing here counts or shows anything.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .estimate import Estimate, Library
from .parameters import DARK, worths
from .rates import Bench, information_per_exposure

F64 = NDArray[np.float64]
U16 = NDArray[np.uint16]
SCATTERED, TELLING = 96, 128  # patterns of the two stages
DRIVES = (
    0.4,
    1.0,
    2.5,
)  # photoelectrons per exposure of scattered patterns, if the profile is right; the clicks tell most from 0.5 to 2
DRIVE = 1.0  # of telling ones: of a click's worth 0.92 of the most is left, and of an exposure's time 0.9
SIZES = (2, 4, 8, 16, 24, 32, 48)  # lit pixels of candidates
DIRECTIONS = 300
EMPTY_EVERY = 32  # one pattern in so many has no lit pixel: the black level alone
VISIBLE = 0.05  # transmission: a pixel that never sees more tells nothing


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
    worth = np.append(worths(), 1.0)
    candidates = _candidates(bench, known, np.random.default_rng(seed), worth)
    _, telling_of = information_per_exposure(bench, known.values, candidates.astype(np.float64))
    scaled = telling_of * worth * np.sqrt(exposures)
    covariance = known.covariance / np.outer(worth, worth)
    counted = np.append(np.ones(DARK), 0.0)  # dark counts are not what is looked for
    chosen = []
    for _ in range(count):
        told = scaled @ covariance  # (candidates, 13)
        gain = ((told * told) @ counted) / (1.0 + (told * scaled).sum(axis=1))
        best = int(np.argmax(gain))
        chosen.append(best)
        covariance = covariance - np.outer(told[best], told[best]) / (1.0 + told[best] @ scaled[best])
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


def predicted(bench: Bench, vector: F64, patterns: F64, clicks: float) -> F64:
    """Return the standard errors, float64 (13,), after `clicks` clicks under `patterns`, all shown equally often, and dark exposures,
    a tenth as many.
    """
    with_dark = np.vstack([patterns, np.zeros(patterns.shape[1])])
    chance, told = information_per_exposure(bench, vector, with_dark)
    # dark exposures: no light at all, neither from black pixels
    means = np.full(1, max(vector[DARK], 1e-9))
    log_miss = bench.model.log_miss(means)
    told[-1] = 0.0
    told[-1, DARK] = float(-bench.model.log_miss_slope(means)[0] * np.sqrt(np.exp(log_miss) / -np.expm1(log_miss))[0])
    share = np.append(np.ones(len(patterns)), 0.1 * len(patterns))
    exposures = clicks / float(chance[:-1].sum())
    information = (told * (share * exposures)[:, None]).T @ told
    scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
    inverse = np.linalg.inv(information / np.outer(scale, scale) + 1e-13 * np.eye(len(scale)))
    return np.asarray(np.sqrt(np.diag(inverse)) / scale)


def dimmed(bench: Bench, vector: F64, patterns: F64, mean: float = DRIVE) -> Bench:
    """Return the bench with as much light as gives `mean` photoelectrons per exposure on average over `patterns`."""
    light = bench.means(vector, patterns).mean() - vector[DARK]
    return replace(bench, photons_per_level=bench.photons_per_level * mean / light)
