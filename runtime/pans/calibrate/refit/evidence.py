"""Labelled clicks in; posteriors of single rows, and corrections of scores that are linear in them, out.

Each object counts once, however often it was shown. The posterior of a row is drawn from what was seen there towards what is believed:

    posterior(c) = (seen(c) + kappa * believed(c)) / (seen + kappa)

Kappa, the objects that the belief is worth, is that of greatest marginal likelihood of the counts (Dirichlet-multinomial). A correction is

    new score = old score + bias + A (old score) + B (clicks)

A change of the click rates of class c, from p to p' under pattern i, changes the log likelihood of independent clicks by exactly a term
linear in them: B has its place there. Each block (bias, A, B) has a Gaussian prior around zero; its width is that of greatest marginal
likelihood, by Laplace's approximation (D. MacKay, "Bayesian interpolation", Neural Computation 4, 415, 1992).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

KAPPAS = np.exp(np.arange(0.0, 10.0, 0.5))  # objects; beyond, no row of a few thousand objects moves by a hundredth
PRECISION_RANGE = (1e-2, 1e6)  # of a prior: a score moves by 10 at the one end and by a thousandth at the other
_FIRST_PRECISION = 10.0
_ROUNDS, _STEPS, _LAST_STEPS = 12, 4, 30  # of the prior's width; Newton steps in a round, and at the end
_CONVERGED = 0.05  # change of the logarithm of a precision that ends the search
_FLAT = 1e-9  # variance of a feature that says nothing
_LEAST = 1e-12  # of a belief
_RIDGE = 1e-6  # of the mean variance of the clicks: channels that never or always click have none of their own
REPEATED_MIN = 20  # objects shown again, below which their scatter is no measure
_log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])


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

    def per_class(self, chosen: NDArray[np.bool_] | slice = slice(None)) -> list[int]:
        """Return the number of objects of each class, of all or of those `chosen` (objects,)."""
        return [int(count) for count in np.bincount(self.classes[chosen], minlength=self.n_classes)]

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


def evidence_of(scores: Array, clicks: Array, row: Array, truth: Array, object_id: Array, shots: int = 1) -> Evidence:
    """Return the evidence with scores centred on each row's mean, in float64, and objects numbered without gaps."""
    numbers = np.unique(object_id, return_inverse=True)[1]
    wide = np.asarray(clicks, np.float64)
    return Evidence(centred(scores), wide, row.astype(np.int64), truth.astype(np.int64), numbers, shots)


def centred(scores: Array) -> F64:
    """Return scores (n, classes) around the mean of each row."""
    wide = np.asarray(scores, np.float64)
    return np.asarray(wide - wide.mean(axis=1, keepdims=True))


def log_softmax(scores: F64) -> F64:
    """Return the logarithms of the class probabilities of scores (n, classes), float64."""
    moved = scores - scores.max(axis=1, keepdims=True)
    moved -= np.log(np.exp(moved).sum(axis=1, keepdims=True))
    return moved


# ---- eigentasks ----


def eigentasks(evidence: Evidence, chosen: NDArray[np.bool_] | None = None) -> F64 | None:
    """Return the eigentasks of the clicks of the objects `chosen`, a readout (d_f, d_f): column k times the clicks is eigentask k.

    They solve N r = share T r, the smallest share of noise first: T is the covariance of the click means over decisions, N (diagonal)
    that part which the photons' randomness makes (F. Hu et al., Phys. Rev. X 13, 041020, 2023). N is measured by objects that were shown
    several times, or by decisions of several shots; without either the answer is None, and of an automaton too.
    """
    taken = np.ones(len(evidence.row), bool) if chosen is None else chosen[evidence.object_id]
    clicks, object_id = evidence.clicks[evidence.row[taken]], evidence.object_id[taken]
    times = np.bincount(object_id)
    again = times > 1
    if not clicks.shape[1] or len(clicks) < 2:
        return None
    if again.sum() >= REPEATED_MIN:
        sums = np.zeros((len(times), clicks.shape[1]))
        np.add.at(sums, object_id, clicks)
        means = sums / np.maximum(times, 1)[:, None]
        noise = ((clicks - means[object_id]) ** 2).sum(axis=0) / (times[again] - 1).sum()
    elif evidence.shots > 1:
        noise = (clicks * (1 - clicks)).mean(axis=0) / (evidence.shots - 1)
    else:
        return None
    total = np.cov(clicks.T).reshape(len(noise), len(noise))
    total += np.eye(len(noise)) * _RIDGE * max(float(np.trace(total)) / len(noise), _RIDGE)
    # with T = L L^T the problem is an ordinary one: (L^-1 N L^-T) q = share q, r = L^-T q
    inverse = np.linalg.inv(np.linalg.cholesky(total))
    return np.asarray(inverse.T @ np.linalg.eigh(inverse * noise @ inverse.T)[1])


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


# ---- corrections ----


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """`gain` (features, classes) and `offset` (classes,): added to the scores are `features @ gain + offset`."""

    blocks: tuple[str, ...]
    gain: F64
    offset: F64

    def apply(self, scores: F64, clicks: F64) -> F64:
        """Return the corrected scores of centred `scores` (n, classes) and `clicks` (n, d_f)."""
        return scores + _raw_features(self.blocks, scores, clicks) @ self.gain + self.offset


class _Standard(NamedTuple):
    """Features of mean 0 and variance 1 over what was seen, the bias first; `block` is the number of each one's block."""

    features: F64
    mean: F64
    scale: F64
    block: I64


class Prior(NamedTuple):
    """What a fit begins with, and leaves to one on nearly the same data: precisions (blocks,) and weights (1 + features, classes)."""

    precision: F64
    weights: F64


def fit(
    blocks: tuple[str, ...], scores: F64, clicks: F64, counts: F64, prior: Prior | None = None
) -> tuple[Correction, Prior]:
    """Fit the `blocks` to `counts` (rows, classes) of rows with `scores` and `clicks`; `prior` fixes the precisions."""
    standard = _standardised(blocks, scores, clicks, counts)
    if prior is None:
        prior = _widest_likelihood(standard, scores, counts)
    weights, _ = _maximised(standard, scores, counts, prior, _LAST_STEPS)
    gain = weights[1:] / standard.scale[:, None]
    return Correction(blocks, gain, weights[0] - standard.mean @ gain), Prior(prior.precision, weights)


def _raw_features(blocks: tuple[str, ...], scores: F64, clicks: F64) -> F64:
    parts = {"scores": scores, "clicks": clicks}
    chosen = [parts[block] for block in blocks if block != "bias"]
    return np.concatenate(chosen, axis=1) if chosen else np.zeros((len(scores), 0))


def _standardised(blocks: tuple[str, ...], scores: F64, clicks: F64, counts: F64) -> _Standard:
    raw = _raw_features(blocks, scores, clicks)
    weight = counts.sum(axis=1) / counts.sum()
    mean = weight @ raw
    variance = weight @ (raw - mean) ** 2
    scale = np.where(variance > _FLAT, np.sqrt(variance + _FLAT), np.inf)  # what never varies keeps a gain of 0
    features = np.concatenate([np.ones((len(raw), 1)), (raw - mean) / scale], axis=1)
    sizes = {"bias": 1, "scores": scores.shape[1], "clicks": clicks.shape[1]}
    block = np.repeat(np.arange(len(blocks)), [sizes[name] for name in blocks])
    return _Standard(features, mean, scale, block)


def _widest_likelihood(standard: _Standard, scores: F64, counts: F64) -> Prior:
    """Return the precisions of greatest marginal likelihood, and the weights there."""
    n_blocks, n_classes = int(standard.block.max()) + 1, counts.shape[1]
    found = Prior(np.full(n_blocks, _FIRST_PRECISION), np.zeros((len(standard.block), n_classes)))
    for _ in range(_ROUNDS):
        weights, hessian = _maximised(standard, scores, counts, found, _STEPS)
        variance = np.diag(np.linalg.inv(hessian)).reshape(weights.shape)
        precision = np.empty(n_blocks)
        for block in range(n_blocks):
            of_block = standard.block == block
            measured = of_block.sum() * n_classes - found.precision[block] * variance[of_block].sum()
            precision[block] = max(measured, _FLAT) / max((weights[of_block] ** 2).sum(), _FLAT)
        precision = precision.clip(*PRECISION_RANGE)
        converged = np.abs(np.log(precision / found.precision)).max() < _CONVERGED
        found = Prior(precision, weights)
        if converged:
            break
    return found


def _maximised(standard: _Standard, scores: F64, counts: F64, prior: Prior, steps: int) -> tuple[F64, F64]:
    """Return the weights of greatest posterior density by Newton's method, from the prior's, and the Hessian of the last step."""
    features, weights = standard.features, prior.weights
    precision = prior.precision[standard.block]
    total = counts.sum(axis=1)

    def loss_at(weights: F64) -> tuple[float, F64]:
        logs = log_softmax(scores + features @ weights)
        return float(-(counts * logs).sum() + 0.5 * (precision[:, None] * weights**2).sum()), logs

    loss, logs = loss_at(weights)
    hessian = np.zeros((0, 0))
    for _ in range(steps):
        chance = np.exp(logs)
        slope = features.T @ (total[:, None] * chance - counts) + precision[:, None] * weights
        hessian = _hessian(features, total, chance, precision)
        step = np.linalg.solve(hessian, slope.ravel()).reshape(weights.shape)
        wanted, length = float((step * slope).sum()), 1.0
        after, logs_after = loss_at(weights - step)
        while after > loss - 1e-4 * length * wanted and length > 1e-6:
            length /= 2
            after, logs_after = loss_at(weights - length * step)
        if after >= loss:
            break
        weights, gained, loss, logs = weights - length * step, loss - after, after, logs_after
        if gained < 1e-9 * total.sum():
            break
    return weights, hessian


def _hessian(features: F64, total: F64, chance: F64, precision: F64) -> F64:
    """Second derivatives by all weights, (size, size): the sum over rows of n (diag(p) - p p^T), taken with the features."""
    n_features, n_classes = features.shape[1], chance.shape[1]
    found = np.zeros((n_features, n_classes, n_features, n_classes))
    for one in range(n_classes):
        for other in range(one + 1):
            weight = total * chance[:, one] * ((one == other) - chance[:, other])
            found[:, one, :, other] = found[:, other, :, one] = (features * weight[:, None]).T @ features
    flat = found.reshape(n_features * n_classes, -1)
    flat[np.diag_indices(len(flat))] += np.repeat(precision, n_classes)
    return flat
