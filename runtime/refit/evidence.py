"""Labelled clicks as numbers: which row of scores each decision came to, what the object was, and which decisions share an object.

Owns the weights (each object counts once, however often it was shown), the folds and the losses per object, and the posteriors of single
rows, drawn from what was seen there towards what is believed of all:

    posterior(c) = (seen(c) + kappa * believed(c)) / (seen + kappa)

Kappa, the objects that the belief is worth, is that of greatest marginal likelihood of the counts (Dirichlet-multinomial). Where rows
agree with the belief, kappa is large and nothing changes. Never fits a head and never reads a file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

KAPPAS = np.exp(np.arange(0.0, 10.0, 0.5))  # objects; beyond, no row of a few thousand objects moves by a hundredth
_log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])
_LEAST = 1e-12  # of a belief


@dataclass(frozen=True, eq=False)
class Evidence:
    """Decisions with a known truth. A *row* is a click word, a vector of counts or a node: decisions of one row have the same scores."""

    scores: F64  # (rows, classes): of the old back end, as logarithms
    clicks: F64  # (rows, features): click means of fixed patterns; (rows, 0) of nodes
    row: I64  # (n,)
    truth: I64  # (n,)
    object_id: I64  # (n,): the object, 0..objects-1; an object has one truth
    shots: int = 1  # of a decision, whose mean `clicks` are

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return int(self.scores.shape[1])

    @cached_property
    def n_objects(self) -> int:
        """Number of objects."""
        return int(self.object_id.max()) + 1

    @cached_property
    def shown(self) -> I64:
        """How many decisions there are of each object, (objects,)."""
        return np.bincount(self.object_id, minlength=self.n_objects)

    @cached_property
    def classes(self) -> I64:
        """The truth of each object, (objects,)."""
        found = np.zeros(self.n_objects, np.int64)
        found[self.object_id] = self.truth
        return found

    def counts(self, chosen: NDArray[np.bool_]) -> F64:
        """Return how often each class came to each row, (rows, classes), over the objects `chosen` (objects,), each with weight 1."""
        taken = chosen[self.object_id]
        found = np.zeros(self.scores.shape)
        np.add.at(found, (self.row[taken], self.truth[taken]), 1.0 / self.shown[self.object_id[taken]])
        return found

    def losses(self, scores: F64) -> tuple[F64, F64]:
        """Return the log loss and the share of right decisions of each object, (objects,), by other `scores` of the rows."""
        logs = log_softmax(scores)
        loss = -logs[self.row, self.truth]
        right = (logs.argmax(axis=1)[self.row] == self.truth).astype(np.float64)
        return self._per_object(loss), self._per_object(right)

    def folds(self, n_folds: int, chosen: NDArray[np.bool_], rng: np.random.Generator) -> I64:
        """Return the fold of each object, (objects,), -1 outside `chosen`; the classes are spread evenly over the folds."""
        fold = np.full(self.n_objects, -1, np.int64)
        objects = rng.permutation(np.flatnonzero(chosen))
        objects = objects[np.argsort(self.classes[objects], kind="stable")]
        fold[objects] = np.arange(len(objects)) % n_folds
        return fold

    def _per_object(self, values: F64) -> F64:
        return np.bincount(self.object_id, values, self.n_objects) / self.shown


def evidence_of(
    scores: NDArray[Any],
    clicks: NDArray[Any],
    row: NDArray[Any],
    truth: NDArray[Any],
    object_id: NDArray[Any],
    shots: int = 1,
) -> Evidence:
    """Return the evidence with scores centred on each row's mean, in float64, and objects numbered without gaps."""
    wide = np.asarray(scores, np.float64)
    _, numbers = np.unique(object_id, return_inverse=True)
    centred = wide - wide.mean(axis=1, keepdims=True)
    wide_clicks = np.asarray(clicks, np.float64)
    return Evidence(centred, wide_clicks, row.astype(np.int64), truth.astype(np.int64), numbers, shots)


def log_softmax(scores: F64) -> F64:
    """Return the logarithms of the class probabilities of scores (n, classes), float64."""
    moved = scores - scores.max(axis=1, keepdims=True)
    moved -= np.log(np.exp(moved).sum(axis=1, keepdims=True))
    return moved


# ---- single rows ----


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
