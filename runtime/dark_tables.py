"""Decision tables for a detector that has changed: more dark clicks than the table was made for, or channels that say nothing.

Owns the recomputation; never decides when it is due (dark_guard.py). A table holds scores of every click word; with P(y | c)
their softmax and P(c) how often each word comes, the joint P(c, y) is known, and what the changed detector makes of it is
exact: a dark click turns a 0 into a 1 with probability r, channel by channel, and a masked channel is summed over. New scores
are the logs of P(c', y). What is assumed: that the table's probabilities are right, and that P(c) is what the run has seen so
far (with few words seen, the product of the channels' own rates fills in).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .decide_table import TableDecider
from .verdict import softmax_winners

F64 = NDArray[np.float64]
PRIOR_WORDS = 200.0  # words' worth of the channels' own rates, beside what was seen


def word_prior(seen: NDArray[np.int64]) -> F64:
    """Return P(c) float64 (2**d_f,) from how often each word was `seen`, int64 (2**d_f,): seen, and smoothed by independent
    channels.
    """
    n_features = len(seen).bit_length() - 1
    total = float(seen.sum())
    product = np.ones(1)
    for feature in range(n_features):
        ones = float(seen[(np.arange(len(seen)) >> feature) & 1 == 1].sum())
        rate = (ones + 0.5) / (total + 1.0)
        product = np.concatenate([product * (1.0 - rate), product * rate])
    return (seen + PRIOR_WORDS * product) / (total + PRIOR_WORDS)


def adapted_scores(
    scores: NDArray[np.float32], prior: F64, extra: F64, masked: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return scores float32 (2**d_f, classes) for a detector with more dark clicks and masked channels.

    `extra` float64 (d_f,) is the probability that a silent exposure clicks now and did not before, `masked` bool (d_f,). Rows
    of masked channels are equal whatever their bits are.
    """
    wide = scores.astype(np.float64)
    wide -= wide.max(axis=1, keepdims=True)
    joint = np.exp(wide)
    joint *= (prior / joint.sum(axis=1))[:, None]
    n_features, n_classes = len(extra), joint.shape[1]
    for feature in range(n_features):
        view = joint.reshape(1 << (n_features - 1 - feature), 2, 1 << feature, n_classes)
        if masked[feature]:
            view[:] = view.sum(axis=1, keepdims=True)
        else:
            turned = extra[feature] * view[:, 0]
            view[:, 1] += turned
            view[:, 0] -= turned
    return np.log(np.maximum(joint, 1e-300)).astype(np.float32)


def extra_probability(present: F64, before: F64) -> F64:
    """The probability that an exposure which would have been silent clicks now: of dark clicks beyond those the table knows, at
    least 0.
    """
    return np.maximum(1.0 - (1.0 - present) / (1.0 - before), 0.0)


class AdaptedTable(TableDecider):
    """A table of other scores: it is not the bundle's, so it is not held against the golden vectors."""

    def __init__(self, scores: NDArray[np.float32]) -> None:
        self.choice = {"chosen": self.name, "why": "made for the present dark rates"}
        self.n_features, self.n_classes = len(scores).bit_length() - 1, scores.shape[1]
        self._scores = scores
        self.radix = 1 << np.arange(self.n_features, dtype=np.int64)
        wide, self.probabilities = softmax_winners(scores)
        self.labels = wide.astype(np.uint8) if self.n_classes <= 256 else wide
