"""Posteriors of single rows, drawn from what was seen there towards what is believed of all.

    posterior(c) = (seen(c) + kappa * believed(c)) / (seen + kappa)

Owns kappa, the objects that the belief is worth: that of greatest marginal likelihood of the counts (Dirichlet-multinomial). Where rows
agree with the belief, kappa is large and nothing changes.
"""

from __future__ import annotations

import math

import numpy as np

from .evidence import F64

KAPPAS = np.exp(np.arange(0.0, 10.0, 0.5))  # objects; beyond, no row of a few thousand objects moves by a hundredth
_log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])
_LEAST = 1e-12  # of a belief


def shrunk(believed: F64, counts: F64, kappa: float) -> F64:
    """Return the posteriors of rows (n, classes) from beliefs and counts of the same shape; rows without counts stay as they are."""
    return np.asarray((counts + kappa * believed) / (counts.sum(axis=1, keepdims=True) + kappa))


def best_kappa(believed: F64, counts: F64) -> float:
    """Return the kappa of `KAPPAS` under which `counts` (rows, classes), fractions allowed, are likeliest."""
    likelihoods = [log_likelihood(believed, counts, kappa) for kappa in KAPPAS]
    return float(KAPPAS[int(np.argmax(likelihoods))])


def log_likelihood(believed: F64, counts: F64, kappa: float) -> float:
    """Return the logarithm of the marginal likelihood of the counts' order of arrival under a Dirichlet prior of weight kappa."""
    row, label = np.nonzero(counts)
    weight = kappa * np.maximum(believed[row, label], _LEAST)
    total = counts.sum(axis=1)
    seen = total[total > 0]
    per_class = _log_gamma(counts[row, label] + weight) - _log_gamma(weight)
    return float(per_class.sum() - (_log_gamma(seen + kappa) - math.lgamma(kappa)).sum())
