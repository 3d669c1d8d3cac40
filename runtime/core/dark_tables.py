"""Decisions for a detector that has changed: more dark clicks than it was trained with, or channels that say nothing.

Owns the recomputation; never decides when it is due (dark_guard.py). Two ways, by what fits:

- `TableAdapter`: all vectors of counts, (K+1)^d_f rows (K = 1: click words). With P(y | c) from the scores' softmax and P(c), how often
  each vector comes, the joint P(c, y) is known, and what the changed detector makes of it is exact: each of the K - c silent exposures
  clicks with probability r, channel by channel, and a masked channel is summed over. New scores are the logs of P(c', y).
- `HeadAdapter`, for heads with too many vectors: the head is asked for every vector that the channels concerned may have meant, and
  its answers are averaged with the probability of each, P(c_f | c'_f), from what the run has counted on that channel. That holds the other
  channels as if they told nothing about this one, which a table need not. MAX_MIXED vectors at most; with more there is no decision.

What both assume: that the head's probabilities are right, and that P(c) is what the run has seen so far (with little seen, the
product of the channels' own rates fills in).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.decide.table import TableDecider, count_table, fits_count_table, n_features_of
from pans.runtime.decide.verdict import Decider, Verdict, softmax_winner
from pans.runtime.errors import UsageError

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
PRIOR_WORDS = 200.0  # words' worth of the channels' own rates, beside what was seen
MAX_MIXED = 256  # answers of a head that one decision may average


class Adapter(Protocol):
    """Remembers what comes while nothing is wrong, and makes back ends for when something is."""

    def count(self, counts: I64) -> None:
        """Remember one window's clicks, int64 (d_f,)."""

    def can_do(self, concerned: NDArray[np.bool_]) -> bool:
        """Whether a decision can be made with these channels masked or clicking more, bool (d_f,)."""

    def made(self, ordinary: Decider, extra: F64, masked: NDArray[np.bool_]) -> Decider:
        """Return the back end for silent exposures that click with `extra` float64 (d_f,), without channels `masked` bool (d_f,)."""


def make_adapter(bundle: Bundle, shots: int) -> Adapter:
    """Return what adapts `bundle`'s decisions over `shots` shots; UsageError for a bundle that gives pictures."""
    if bundle.automaton is not None:
        raise UsageError(
            f"{bundle.name} is an automaton: a dark click has already led to another pattern, so that no table mends it afterwards",
            remedy="use --on-dark abstain, or train for the present dark rate",
        )
    if bundle.largest > 1:
        raise UsageError(
            f"{bundle.name} takes photon numbers: no other decisions are made for dark counts of another rate",
            remedy="use --on-dark abstain",
        )
    if bundle.picture_shape is not None:
        raise UsageError("a bundle that gives pictures decides nothing", remedy="use --on-dark abstain")
    if shots == 1 and bundle.table is not None:
        return TableAdapter(bundle.table, 2)
    if bundle.head_onnx is None:
        raise UsageError(
            f"{bundle.name} has only a table of single clicks, which cannot answer {shots} shots",
            remedy="use --shots 1, or --on-dark abstain",
        )
    if fits_count_table(bundle.n_features, shots):
        return TableAdapter(count_table(bundle, shots).scores, shots + 1)
    return HeadAdapter(bundle.n_features, shots)


class TableAdapter:
    """For all vectors of counts, `scores` float32 (base**d_f, classes), `base` = K + 1."""

    def __init__(self, scores: NDArray[np.float32], base: int) -> None:
        self._scores, self._base = scores, base
        self._seen: I64 = np.zeros(len(scores), np.int64)
        self._radix = base ** np.arange(n_features_of(len(scores), base), dtype=np.int64)

    def count(self, counts: I64) -> None:
        """See Adapter."""
        self._seen[int(counts @ self._radix)] += 1

    def can_do(self, concerned: NDArray[np.bool_]) -> bool:
        """See Adapter: always."""
        return True

    def made(self, ordinary: Decider, extra: F64, masked: NDArray[np.bool_]) -> Decider:
        """See Adapter."""
        scores = adapted_scores(self._scores, word_prior(self._seen, self._base), extra, masked, self._base)
        return TableDecider(scores, self._base - 1, self._base - 1, {"why": "made for the present dark rates"})


class HeadAdapter:
    """For a head of `n_features` channels and `shots` shots whose vectors of counts are too many."""

    def __init__(self, n_features: int, shots: int) -> None:
        self._shots = shots
        self._seen: I64 = np.zeros((n_features, shots + 1), np.int64)
        self._rows = np.arange(n_features)

    def count(self, counts: I64) -> None:
        """See Adapter."""
        self._seen[self._rows, counts] += 1

    def can_do(self, concerned: NDArray[np.bool_]) -> bool:
        """See Adapter: as long as there are at most MAX_MIXED vectors."""
        return (self._shots + 1) ** int(np.count_nonzero(concerned)) <= MAX_MIXED

    def made(self, ordinary: Decider, extra: F64, masked: NDArray[np.bool_]) -> Decider:
        """See Adapter; the caller has asked `can_do`."""
        channels = np.flatnonzero(masked | (extra > 0))
        weights = [
            meant(self._seen[channel], float(extra[channel]), bool(masked[channel])) for channel in channels.tolist()
        ]
        return MixedHead(ordinary, self._shots, channels, weights)


def word_prior(seen: I64, base: int = 2) -> F64:
    """Return P(c) float64 (base**d_f,) from how often each vector was `seen`, int64 (base**d_f,): seen, and smoothed by
    independent channels.
    """
    total = float(seen.sum())
    product = np.ones(1)
    digits = np.arange(len(seen))
    for _ in range(n_features_of(len(seen), base)):
        own = np.bincount(digits % base, weights=seen, minlength=base)
        rates = (own + 0.5) / (total + 0.5 * base)
        rates[0] = 1.0 - rates[1:].sum()
        product = np.concatenate([product * rate for rate in rates])
        digits //= base
    return (seen + PRIOR_WORDS * product) / (total + PRIOR_WORDS)


def adapted_scores(
    scores: NDArray[np.float32], prior: F64, extra: F64, masked: NDArray[np.bool_], base: int = 2
) -> NDArray[np.float32]:
    """Return scores float32 (base**d_f, classes) for a detector with more dark clicks and masked channels.

    `extra` float64 (d_f,) is the probability that a silent exposure clicks now and did not before, `masked` bool (d_f,). Rows
    of masked channels are equal whatever their counts are.
    """
    wide = scores.astype(np.float64)
    wide -= wide.max(axis=1, keepdims=True)
    joint = np.exp(wide)
    joint *= (prior / joint.sum(axis=1))[:, None]
    n_features, n_classes = len(extra), joint.shape[1]
    for feature in range(n_features):
        view = joint.reshape(base ** (n_features - 1 - feature), base, base**feature, n_classes)
        if masked[feature]:
            view[:] = view.sum(axis=1, keepdims=True)
            continue
        moves = dark_clicks(base - 1, float(extra[feature]))
        for count in range(base - 2, -1, -1):  # from above: what has moved up does not move again
            before = view[:, count].copy()
            for more in range(count + 1, base):
                turned = moves[count, more] * before
                view[:, more] += turned
                view[:, count] -= turned
    return np.log(np.maximum(joint, 1e-300)).astype(np.float32)


def dark_clicks(shots: int, extra: float) -> F64:
    """Return P(c' | c) float64 (K+1, K+1): each of the K - c silent exposures of `shots` clicks with probability `extra`."""
    moves = np.zeros((shots + 1, shots + 1))
    for count in range(shots + 1):
        silent = shots - count
        for more in range(silent + 1):
            moves[count, count + more] = math.comb(silent, more) * extra**more * (1.0 - extra) ** (silent - more)
    return moves


def meant(seen: I64, extra: float, masked: bool) -> F64:
    """Return P(c | c') float64 (K+1 found, K+1 meant) on one channel that was `seen` to give each count, int64 (K+1,)."""
    own = (seen + 0.5) / (seen.sum() + 0.5 * len(seen))
    if masked:
        return np.tile(own, (len(seen), 1))
    joint = (own[:, None] * dark_clicks(len(seen) - 1, extra)).T
    weights: F64 = joint / joint.sum(axis=1, keepdims=True)
    return weights


def extra_probability(present: F64, before: F64) -> F64:
    """The probability that an exposure which would have been silent clicks now: of dark clicks beyond those the table knows, at
    least 0.
    """
    return np.maximum(1.0 - (1.0 - present) / (1.0 - before), 0.0)


class MixedHead:
    """A head asked for all that some channels may have meant: `weights[i]` float64 (found, meant) of channel `channels[i]`."""

    name = "mixed"

    def __init__(self, head: Decider, shots: int, channels: I64, weights: list[F64]) -> None:
        self.n_features, self.n_classes = head.n_features, head.n_classes
        self._head, self._shots, self._channels, self._weights = head, shots, channels, weights
        grids = np.meshgrid(*[np.arange(shots + 1)] * len(channels), indexing="ij")
        self._meant = np.stack([grid.ravel() for grid in grids], axis=1)  # (vectors, channels)
        self._rows: I64 = np.zeros((len(self._meant), head.n_features), np.int64)

    def decide(self, counts: I64, shots: int) -> Verdict:
        """Decide from clicks per pattern, int64 (d_f,)."""
        return softmax_winner(self._mixed(counts, shots))

    def scores_batch(self, counts: ArrayLike, shots: int) -> NDArray[np.float32]:
        """Return the logs of the mixed probabilities, float32 (n, classes), of click counts (n, d_f)."""
        return np.array([self._mixed(row, shots) for row in np.asarray(counts)], np.float32)

    def decide_batch(self, counts: ArrayLike, shots: int) -> I64:
        """Return the labels, int64 (n,), of click counts (n, d_f)."""
        return self.scores_batch(counts, shots).argmax(axis=1).astype(np.int64)

    def _mixed(self, counts: I64, shots: int) -> F64:
        self._rows[:] = counts
        self._rows[:, self._channels] = self._meant
        wide = self._head.scores_batch(self._rows, shots).astype(np.float64)
        wide -= wide.max(axis=1, keepdims=True)
        chances = np.exp(wide)
        weight = np.ones(len(chances))
        for column, (channel, weights) in enumerate(zip(self._channels.tolist(), self._weights)):
            weight *= weights[int(counts[channel]), self._meant[:, column]]
        mixed: F64 = np.log(np.maximum((weight / chances.sum(axis=1)) @ chances, 1e-300))
        return mixed
