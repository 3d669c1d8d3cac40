"""What total intensity alone gives away about a class: the check that a task needs more than counting light.

A classifier that sees only the total intensity of an object is fitted on the training objects (the most frequent class in each of 32
equally filled intervals: the best one-dimensional decision, no worse than any threshold) and judged on the held-out ones.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

N_INTERVALS = 32


def total_intensity(images: NDArray[np.uint8], light: str) -> NDArray[np.float64]:
    """Return the mean intensity of every image, float64 (n,), full scale 1; grey is an amplitude where `light` is "field"."""
    grey = images.reshape(len(images), -1) / 255.0
    return np.asarray((grey**2 if light == "field" else grey).mean(axis=1))


def excess_of_pairs(
    fit: NDArray[np.float64],
    fit_labels: NDArray[np.int64],
    total: NDArray[np.float64],
    labels: NDArray[np.int64],
) -> dict[tuple[int, ...], float]:
    """Return by how much the accuracy on totals exceeds the share of the most frequent class: over all classes, and for every pair."""
    classes = tuple(int(label) for label in np.unique(labels))
    found = {}
    for group in dict.fromkeys((classes, *combinations(classes, 2))):
        mine, theirs = np.isin(fit_labels, group), np.isin(labels, group)
        edges = np.unique(np.quantile(fit[mine], np.arange(1, N_INTERVALS) / N_INTERVALS))
        counts = np.zeros((len(edges) + 1, int(fit_labels.max()) + 1), np.int64)
        np.add.at(counts, (np.searchsorted(edges, fit[mine], side="right"), fit_labels[mine]), 1)
        decided = counts.argmax(axis=1)[np.searchsorted(edges, total[theirs], side="right")]
        chance = max(float((labels[theirs] == label).mean()) for label in group)
        found[group] = float((decided == labels[theirs]).mean()) - chance
    return found
