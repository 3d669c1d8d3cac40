"""Direct imaging of barcodes, exactly: one detector looks at each bar, and every string and every click word is gone through.

No sampling, no training. A counting detector would say no more without dark counts: a dark bar gives no photon.
"""

from __future__ import annotations

import math

import numpy as np

from pans.trainer.tasks.barcode import N_BARS, all_strings, weights

from .common import F64

LIT = N_BARS / 2  # bars of a string that are bright, on average


def word_chances(bright: float, dark: float = 0.0) -> F64:
    """Return P(click word | string), (1024, 1024), where a bright bar gives `bright` photoelectrons and every detector `dark` counts.

    Bar 0 is the highest bit of the string's number, its detector that of the word's.
    """
    silent = np.exp(-np.array([dark, bright + dark]))
    of_bar = np.stack([silent, 1 - silent], axis=1)  # (dark or bright, silent or click)
    chances = np.ones((1, 1))
    for _ in range(N_BARS):
        chances = np.kron(chances, of_bar)
    return chances


def imaged(bright: float, dark: float = 0.0) -> dict[str, float]:
    """Return `value` (accuracy in % of the best decision), and mean `clicks`, `photons` and `illumination` of one decision.

    All strings are equally likely; the illumination is the light of all bars, as a camera needs it.
    """
    labels = all_strings()[1]
    share, chances = weights(), word_chances(bright, dark)
    joint = np.stack([share[labels == label] @ chances[labels == label] for label in (0, 1)])
    return {
        "value": 100 * float(joint.max(axis=0).sum()),
        "clicks": -LIT * math.expm1(-bright - dark) - (N_BARS - LIT) * math.expm1(-dark),
        "photons": LIT * bright,
        "illumination": N_BARS * bright,
    }


def at_photons(photons: float, dark: float = 0.0) -> dict[str, float]:
    """Return what `imaged` gives at that many detected photoelectrons per decision."""
    return imaged(photons / LIT, dark)


def at_clicks(clicks: float, dark: float = 0.0) -> dict[str, float] | None:
    """Return what `imaged` gives at that many clicks per decision; None where no light gives so many, or none so few."""
    clicking = (clicks + (N_BARS - LIT) * math.expm1(-dark)) / LIT  # share of the bright bars that click
    if not -math.expm1(-dark) <= clicking < 1.0:
        return None
    return imaged(-math.log1p(-clicking) - dark, dark)
