"""What a registration's model leaves of the counts, pattern by pattern, for people to look at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .estimate import Observed
from .rates import Bench

F64 = NDArray[np.float64]


def pattern_residuals(bench: Bench, observed: Observed, vector: F64) -> tuple[F64, F64, F64]:
    """Return of every pattern the expected and the measured share of clicks, and their difference in standard errors, float64 (patterns,).

    Exposures behind a click and behind none are taken together.
    """
    lit, n = observed.lit, len(observed.patterns)
    log_miss = (
        bench.model.log_miss(bench.means(vector, observed.patterns))[observed.pattern[lit]] + observed.log_other[lit]
    )
    chance, exposures = -np.expm1(log_miss), observed.exposures[lit]
    sums = np.zeros((4, n))
    for row, values in zip(
        sums, (exposures, observed.clicks[lit], exposures * chance, exposures * chance * (1 - chance))
    ):
        np.add.at(row, observed.pattern[lit], values)
    shown = np.maximum(sums[0], 1.0)
    return sums[2] / shown, sums[1] / shown, (sums[1] - sums[2]) / np.sqrt(np.maximum(sums[3], 1e-12))
