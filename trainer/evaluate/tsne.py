"""t-SNE maps of readouts in two dimensions, for pictures only (scikit-learn, extra `plot`).

Distances on a map mean nothing beyond near and far. The same features and seed give the same map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

OBJECTS_MAX = 2000  # the method is exact: several matrices of n x n
PERPLEXITY = 30.0  # the default of van der Maaten and Hinton's code (2008)

F64 = NDArray[np.float64]


def tsne(features: NDArray[np.floating], *, perplexity: float = PERPLEXITY, seed: int = 0) -> F64:
    """Return positions, float64 (n, 2), of `features` (n, d); ValueError for too few or too many points.

    The map starts from the principal components, so that it does not depend on where random points fall; a little noise on top
    lets equal features part.
    """
    from sklearn.manifold import TSNE

    n = len(features)
    if features.ndim != 2 or not 3 * perplexity < n <= OBJECTS_MAX:
        raise ValueError(
            f"{n} points, allowed for a map at perplexity {perplexity:g}: {int(3 * perplexity) + 1} to {OBJECTS_MAX}"
        )
    centred = features.astype(np.float64) - features.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:2]
    start = np.zeros((n, 2))
    start[:, : len(axes)] = centred @ axes.T
    start *= 1e-4 / max(float(start.std()), 1e-12)  # the size that scikit-learn gives its own starts
    start += np.random.default_rng(seed).normal(0, 1e-5, start.shape)
    placed = TSNE(perplexity=perplexity, init=start, method="exact", random_state=seed).fit_transform(centred)
    return np.asarray(placed, np.float64)
