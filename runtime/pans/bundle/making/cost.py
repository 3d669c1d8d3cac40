"""Patterns before and after rounding, and objects with known labels, in; what the rounding costs in accuracy out.

The same objects and the same random numbers go through both, decided by the bundle's own head or table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.bundle.backends.choose import make_decider
from pans.bundle.sensor.facts import Bundle
from pans.instrument.click_law import ClickLaw, click_law, click_probability, object_transmission
from pans.instrument.profile import Profile

F64 = NDArray[np.float64]
IDEAL = ClickLaw(0.0, 0.0, 0.5)
TRIALS = 20
SEED = 0
CHUNK_OBJECTS = 4096


@dataclass(frozen=True, slots=True)
class QuantisationCost:
    """Shares of right decisions with the patterns as given and as shown, and the standard error of the difference over objects."""

    accuracy_given: float
    accuracy_shown: float
    difference_se: float
    objects: int
    trials: int


def quantisation_cost(
    patterns: NDArray[np.floating],
    bundle: Bundle,
    images: NDArray[np.uint8],
    labels: NDArray[np.int64],
    exposure_us: float,
    profile: Profile | None = None,
) -> QuantisationCost:
    """Return what the bundle's rounded `patterns` (photons, (d_f, pixels)) cost on `images` uint8 (n, h, w) with `labels` int (n,).

    Each object is decided on TRIALS times from sampled clicks. Without a profile every photon counts and black is black. ValueError for
    images that are not of the bundle's size, or labels beyond its classes.
    """
    if bundle.picture_shape is not None:
        raise ValueError(f"{bundle.name} makes pictures, which are not right or wrong")
    if images.shape[1:] != bundle.image_shape:
        raise ValueError(f"images are {images.shape[1:]}, allowed with these patterns: {bundle.image_shape}")
    if len(images) == 0 or labels.min() < 0 or labels.max() >= bundle.n_classes:
        raise ValueError(f"labels must be 0 to {bundle.n_classes - 1}, one for each image")
    law = IDEAL if profile is None else click_law(profile, exposure_us)
    decider, rng = make_decider(bundle, shots=1), np.random.default_rng(SEED)
    right = np.zeros((2, len(images)))
    for start in range(0, len(images), CHUNK_OBJECTS):
        part = slice(start, start + CHUNK_OBJECTS)
        seen = object_transmission(profile, images[part].reshape(len(images[part]), -1))
        chances = [
            click_probability(law, seen @ np.asarray(shown, np.float64).T) for shown in (patterns, bundle.patterns())
        ]
        for _ in range(TRIALS):
            drawn = rng.random(chances[0].shape)
            for way, chance in enumerate(chances):
                right[way, part] += decider.decide_batch((drawn < chance).astype(np.int64), 1) == labels[part]
    right /= TRIALS
    spread = float((right[1] - right[0]).std(ddof=1)) if len(images) > 1 else 0.0
    given, shown = right.mean(axis=1)
    return QuantisationCost(float(given), float(shown), spread / math.sqrt(len(images)), len(images), TRIALS)
