"""What total intensity alone gives away about a class: the check that a task needs more than counting light.

Owns this one measurement; never trains anything else. A classifier that sees only the total intensity of an object is fitted on
the training objects (the most frequent class in each of 32 equally filled intervals: the best one-dimensional decision, and
so no worse than any threshold) and judged on the held-out ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

N_INTERVALS = 32


@dataclass(frozen=True, slots=True)
class BrightnessRow:
    """Accuracy on total intensity for some classes, beside `chance`, the share of the most frequent of them."""

    classes: tuple[int, ...]
    accuracy: float
    chance: float

    @property
    def excess(self) -> float:
        """Accuracy above chance."""
        return self.accuracy - self.chance


def total_intensity(images: NDArray[np.uint8], light: str) -> NDArray[np.float64]:
    """Return the mean intensity of every image, float64 (n,), full scale 1; grey is an amplitude where `light` is "field"."""
    grey = images.reshape(len(images), -1) / 255.0
    return np.asarray((grey**2 if light == "field" else grey).mean(axis=1))


def decide_on_total(
    fit: NDArray[np.float64], fit_labels: NDArray[np.int64], total: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the most frequent class of the interval that each `total` falls into; intervals hold equally many of `fit`."""
    edges = np.unique(np.quantile(fit, np.arange(1, N_INTERVALS) / N_INTERVALS))
    counts = np.zeros((len(edges) + 1, int(fit_labels.max()) + 1), np.int64)
    np.add.at(counts, (np.searchsorted(edges, fit, side="right"), fit_labels), 1)
    return np.asarray(counts.argmax(axis=1)[np.searchsorted(edges, total, side="right")])


def brightness_rows(
    fit: NDArray[np.float64],
    fit_labels: NDArray[np.int64],
    held_out: NDArray[np.float64],
    held_out_labels: NDArray[np.int64],
) -> tuple[BrightnessRow, ...]:
    """Return the accuracy on totals over all classes, then for every pair of classes."""
    classes = tuple(int(label) for label in np.unique(held_out_labels))
    groups = [classes, *(combinations(classes, 2) if len(classes) > 2 else ())]
    rows = []
    for group in groups:
        mine, theirs = np.isin(fit_labels, group), np.isin(held_out_labels, group)
        truth = held_out_labels[theirs]
        found = decide_on_total(fit[mine], fit_labels[mine], held_out[theirs])
        chance = max(float((truth == label).mean()) for label in group)
        rows.append(BrightnessRow(group, float((found == truth).mean()), chance))
    return tuple(rows)
