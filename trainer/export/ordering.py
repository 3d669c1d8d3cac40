"""In which order fixed patterns tell most first: greedy, by the information between the clicks so far and the class.

Owns the order; never changes a bundle (reorder.py). Up to 12 patterns all click words are summed over training objects, so that the
information of the objects' mixture is exact; beyond, words are sampled from it and the last click of each is summed over. Before
samples that bleach, a pattern's clicks are those that the patterns chosen before it leave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle
from pans.runtime.imaging import NO_BLEACHING, Bleaching, mean_left, met
from pans.runtime.instrument.click_law import click_probability, object_transmission
from pans.runtime.instrument.profile import Profile
from pans.trainer.evaluate.accuracy import demand_sequence, law_of, outcome_probabilities
from pans.trainer.evaluate.information import mutual_information_bits
from pans.trainer.evaluate.shown import demand_click_patterns
from pans.trainer.tasks.registry import Objects

EXACT_PATTERNS_MAX = 12  # 4096 click words per object
OBJECTS = 20_000  # the first training objects
SAMPLED_OBJECTS = 1500  # and as many words, where they are sampled
WAYS = ("information", "dose")  # most information per pattern, or per light that it sends
LEAST = 1e-12  # of a click and of a dark exposure, so that a word that was drawn is never impossible
_CHUNK_NUMBERS = 1 << 22

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Order:
    """`patterns` in the order to show them; `bits` are the information about the class after each of them."""

    patterns: tuple[int, ...]
    bits: tuple[float, ...]
    by: str
    objects: int
    exact: bool


class _Clicks:
    """Click probabilities of the patterns that are not chosen yet, on objects that the chosen ones have bleached."""

    def __init__(self, bundle: Bundle, profile: Profile, objects: Objects, bleaching: Bleaching) -> None:
        demand_click_patterns(bundle)
        demand_sequence(profile)
        imaging = profile.imaging()
        self.light = bundle.patterns()
        if not imaging.is_identity:
            full = bundle.photons_per_level * (bundle.levels - 1)
            self.light = met(imaging, self.light, bundle.image_shape, full)
        self._seen = object_transmission(profile, objects.images.reshape(len(objects), -1))
        self._law, self._bleaching = law_of(bundle, profile), bleaching
        self._dose = np.zeros((1, self.light.shape[1]))

    def of(self, candidates: Sequence[int]) -> F64:
        """Return the click probabilities of `candidates`, one of which comes next: float64 (objects, candidates)."""
        shown = self.light[list(candidates)]
        if not self._bleaching.is_none:
            shown = shown * np.exp(-self._dose) * mean_left(self._bleaching.doses(shown))
        return click_probability(self._law, self._seen @ shown.T)

    def choose(self, pattern: int) -> None:
        """Let the light of `pattern` act."""
        if not self._bleaching.is_none:
            self._dose = self._dose + self._bleaching.doses(self.light[[pattern]])


def information_order(
    bundle: Bundle,
    profile: Profile,
    training: Objects,
    *,
    by: str = "information",
    bleaching: Bleaching = NO_BLEACHING,
    seed: int = 0,
) -> Order:
    """Return the order of the patterns of `bundle` in which each brings most information about the class, given those before it.

    `by` "dose": most information per light that the pattern sends. `training` are the objects it is measured on, the first of them.
    ValueError for a bundle without fixed patterns, and for a profile that shows all of them at once.
    """
    if by not in WAYS:
        raise ValueError(f"an order by {by!r}, allowed: {', '.join(WAYS)}")
    exact = bundle.n_features <= EXACT_PATTERNS_MAX
    objects = training.first(OBJECTS if exact else SAMPLED_OBJECTS)
    clicks = _Clicks(bundle, profile, objects, bleaching)
    known = _Words(objects.labels, bundle.n_classes) if exact else _Samples(objects.labels, bundle.n_classes, seed)
    cost = clicks.light.sum(axis=1) if by == "dose" else np.ones(bundle.n_features)
    left, order, bits = list(range(bundle.n_features)), list[int](), list[float]()
    while left:
        probability = clicks.of(left)
        after = known.bits_with(probability)
        before = bits[-1] if bits else 0.0
        best = int(np.argmax((after - before) / np.maximum(cost[left], LEAST)))
        bits.append(float(after[best]))
        known.take(probability[:, best])
        clicks.choose(left[best])
        order.append(left.pop(best))
    return Order(tuple(order), tuple(bits), by, len(objects), exact)


class _Words:
    """All click words of the patterns chosen so far."""

    def __init__(self, labels: I64, n_classes: int) -> None:
        self._of_class = (labels[:, None] == np.arange(n_classes)).astype(np.float64)
        self._chosen = np.zeros((len(labels), 0))

    def bits_with(self, probability: F64) -> F64:
        """Return I(class; clicks) with each of the candidates (objects, k) beside those chosen, float64 (k,)."""
        n, k = probability.shape
        n_classes, words = self._of_class.shape[1], 1 << self._chosen.shape[1]
        plain, clicked = np.zeros((words, n_classes)), np.zeros((words, k * n_classes))
        step = max(1, _CHUNK_NUMBERS // max(words, k * n_classes))
        for start in range(0, n, step):
            rows = slice(start, start + step)
            chance = outcome_probabilities(self._chosen[rows], 1).T
            plain += chance @ self._of_class[rows]
            each = probability[rows, :, None] * self._of_class[rows, None, :]
            clicked += chance @ each.reshape(len(each), -1)
        parts = clicked.reshape(words, k, n_classes)
        return np.array(
            [
                mutual_information_bits(np.concatenate([parts[:, j], np.maximum(plain - parts[:, j], 0.0)]) / n)
                for j in range(k)
            ]
        )

    def take(self, probability: F64) -> None:
        """Add a pattern with these click probabilities (objects,)."""
        self._chosen = np.column_stack([self._chosen, probability])


class _Samples:
    """Click words drawn from the mixture of the objects, one from each; P(word | object) stands beside all objects."""

    def __init__(self, labels: I64, n_classes: int, seed: int) -> None:
        self._of_class = (labels[:, None] == np.arange(n_classes)).astype(np.float64)
        self._log = np.zeros((len(labels), len(labels)))  # (words, objects)
        self._random = np.random.default_rng(seed)
        self._label_bits = float(_entropy(self._of_class.sum(axis=0)[None, :])[0])

    def bits_with(self, probability: F64) -> F64:
        """See `_Words.bits_with`: an estimate."""
        n, k = probability.shape
        weight = np.exp(self._log - self._log.max(axis=1, keepdims=True))
        plain = weight @ self._of_class
        each = (probability[:, :, None] * self._of_class[:, None, :]).reshape(n, -1)
        clicked = (weight @ each).reshape(n, k, -1)
        whole = plain.sum(axis=1, keepdims=True)
        of_click = clicked.sum(axis=2) / whole
        dark = np.maximum(plain[:, None, :] - clicked, 0.0)
        rest = of_click * _entropy(clicked) + (1 - of_click) * _entropy(dark)
        return np.asarray(self._label_bits - rest.mean(axis=0))

    def take(self, probability: F64) -> None:
        """Draw the click of the pattern that was chosen for every word."""
        p = np.clip(probability, LEAST, 1 - LEAST)
        clicks = self._random.random(len(p)) < p  # word i is drawn from object i
        self._log += np.where(clicks[:, None], np.log(p), np.log1p(-p))


def _entropy(rows: F64) -> F64:
    """Entropy in bits of weights along the last axis, whatever they sum to; 0 where they are all 0."""
    total = rows.sum(axis=-1, keepdims=True)
    share = np.divide(rows, total, out=np.zeros_like(rows), where=total > 0)
    logs = np.log2(share, out=np.zeros_like(share), where=share > 0)
    return np.asarray(-(share * logs).sum(axis=-1))
