"""In which order fixed patterns tell most first, and a bundle in that order: tables, heads and golden vectors go with the patterns.

The order is greedy, by the information between the readings so far and the class. Up to 4096 words, of 12 patterns that click, all are
summed over training objects, so that the information of the objects' mixture is exact; beyond, words are sampled from it and the last
reading of each is summed over. Before samples that bleach, a pattern's readings are those that the patterns before it leave.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.bundle.heads import Int8Head, Layer
from pans.bundle.sensor import BackEnd, Bundle
from pans.calibrate.refit import chain_onnx
from pans.instrument.click_law import CountLaw, click_probability, count_chances, object_transmission
from pans.instrument.optics import NO_BLEACHING, Bleaching, mean_left
from pans.instrument.profile import Profile
from pans_trainer.evaluate.accuracy import demand_sequence, outcome_law_of
from pans_trainer.evaluate.dose import TRAINING_OBJECTS, WORDS_MAX, demand_fixed_patterns, plain_layers, rebuilt
from pans_trainer.evaluate.information import entropy_bits, mutual_information_bits
from pans_trainer.evaluate.readings import vector_chances
from pans_trainer.evaluate.walks import patterns_met
from pans_trainer.tasks.registry import Objects

SAMPLED_OBJECTS = 1500  # and as many words, where they are sampled
WAYS = ("information", "dose")  # most information per pattern, or per light that it sends
LEAST = 1e-12  # of every reading, so that a word that was drawn is never impossible
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


class _Readings:
    """Chances of the readings of the patterns that are not chosen yet, on objects that the chosen ones have bleached."""

    def __init__(self, bundle: Bundle, profile: Profile, objects: Objects, bleaching: Bleaching) -> None:
        demand_fixed_patterns(bundle)
        demand_sequence(profile)
        self.light = patterns_met(bundle, profile.imaging()) * bundle.photons_per_level
        self._seen = object_transmission(profile, objects.images.reshape(len(objects), -1))
        self._law, self._bleaching = outcome_law_of(bundle, profile), bleaching
        self._dose = np.zeros((1, self.light.shape[1]))

    def of(self, candidates: Sequence[int]) -> F64:
        """Return the chances of the readings of `candidates`, one of which comes next: float64 (objects, candidates, outcomes)."""
        shown = self.light[list(candidates)]
        if not self._bleaching.is_none:
            shown = shown * np.exp(-self._dose) * mean_left(self._bleaching.doses(shown))
        light = self._seen @ shown.T
        if isinstance(self._law, CountLaw):
            return np.moveaxis(count_chances(self._law, light), 0, -1)
        click = click_probability(self._law, light)
        return np.stack([1 - click, click], axis=2)

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
    exact = (bundle.largest + 1) ** bundle.n_features <= WORDS_MAX
    objects = training.first(TRAINING_OBJECTS if exact else SAMPLED_OBJECTS)
    readings = _Readings(bundle, profile, objects, bleaching)
    known = _Words(objects.labels, bundle.n_classes) if exact else _Samples(objects.labels, bundle.n_classes, seed)
    cost = readings.light.sum(axis=1) if by == "dose" else np.ones(bundle.n_features)
    left, order, bits = list(range(bundle.n_features)), list[int](), list[float]()
    while left:
        chances = readings.of(left)
        after = known.bits_with(chances)
        before = bits[-1] if bits else 0.0
        best = int(np.argmax((after - before) / np.maximum(cost[left], LEAST)))
        bits.append(float(after[best]))
        known.take(chances[:, best])
        readings.choose(left[best])
        order.append(left.pop(best))
    return Order(tuple(order), tuple(bits), by, len(objects), exact)


class _Words:
    """All words of the patterns chosen so far."""

    def __init__(self, labels: I64, n_classes: int) -> None:
        self._of_class = (labels[:, None] == np.arange(n_classes)).astype(np.float64)
        self._chosen: list[F64] = []  # of each pattern, (objects, outcomes)

    def bits_with(self, chances: F64) -> F64:
        """Return I(class; readings) with each of the candidates (objects, k, outcomes) beside those chosen, float64 (k,)."""
        n, k, outcomes = chances.shape
        n_classes, words = self._of_class.shape[1], outcomes ** len(self._chosen)
        plain, lit = np.zeros((words, n_classes)), np.zeros((words, k * (outcomes - 1) * n_classes))
        step = max(1, _CHUNK_NUMBERS // max(words, lit.shape[1]))
        for start in range(0, n, step):
            rows = slice(start, start + step)
            chosen = [pattern[rows] for pattern in self._chosen]
            seen = np.stack(chosen, axis=1) if chosen else np.zeros((len(chances[rows]), 0, outcomes))
            chance = vector_chances(seen).T
            plain += chance @ self._of_class[rows]
            each = chances[rows, :, 1:, None] * self._of_class[rows, None, None, :]
            lit += chance @ each.reshape(len(each), -1)
        parts = lit.reshape(words, k, outcomes - 1, n_classes)
        dark = np.maximum(plain[:, None, :] - parts.sum(axis=2), 0.0)
        joint = np.concatenate([parts, dark[:, :, None, :]], axis=2).swapaxes(0, 1)
        return np.array([mutual_information_bits(one.reshape(-1, n_classes) / n) for one in joint])

    def take(self, chances: F64) -> None:
        """Add a pattern with these chances (objects, outcomes)."""
        self._chosen.append(chances)


class _Samples:
    """Words drawn from the mixture of the objects, one from each; P(word | object) stands beside all objects."""

    def __init__(self, labels: I64, n_classes: int, seed: int) -> None:
        self._of_class = (labels[:, None] == np.arange(n_classes)).astype(np.float64)
        self._log = np.zeros((len(labels), len(labels)))  # (words, objects)
        self._random = np.random.default_rng(seed)
        self._label_bits = float(entropy_bits(self._of_class.sum(axis=0)))

    def bits_with(self, chances: F64) -> F64:
        """See `_Words.bits_with`: an estimate."""
        n, k, outcomes = chances.shape
        weight = np.exp(self._log - self._log.max(axis=1, keepdims=True))
        plain = weight @ self._of_class
        each = (chances[:, :, 1:, None] * self._of_class[:, None, None, :]).reshape(n, -1)
        lit = (weight @ each).reshape(n, k, outcomes - 1, -1)
        dark = np.maximum(plain[:, None, :] - lit.sum(axis=2), 0.0)
        of_reading = lit.sum(axis=3) / plain.sum(axis=1)[:, None, None]
        rest = (of_reading * entropy_bits(lit)).sum(axis=2) + (1 - of_reading.sum(axis=2)) * entropy_bits(dark)
        return np.asarray(self._label_bits - rest.mean(axis=0))

    def take(self, chances: F64) -> None:
        """Draw the reading of the pattern that was chosen, (objects, outcomes), for every word."""
        sure = np.maximum(chances, LEAST)
        from_the_most = sure[:, ::-1].cumsum(axis=1)[:, :-1]
        behind = (self._random.random(len(sure))[:, None] >= from_the_most).sum(axis=1)  # word i is drawn from object i
        self._log += np.log(sure).T[sure.shape[1] - 1 - behind]


def reordered(bundle: Bundle, order: Sequence[int], facts: Mapping[str, Any]) -> Bundle:
    """Return `bundle` with pattern `order[i]` as its pattern i, and `facts` beside its provenance.

    ValueError for a bundle without fixed patterns, and for a head that is no plain chain of layers.
    """
    places = [int(place) for place in order]
    demand_fixed_patterns(bundle)
    return rebuilt(bundle, _back_end(bundle, places), places, facts)


def order_facts(order: Order, bundle: Bundle) -> dict[str, Any]:
    """Return what a bundle says of its order; pattern numbers are those of `bundle`, as it was before."""
    known = bundle.provenance.get("order")
    first = list(order.patterns)
    if isinstance(known, Mapping) and isinstance(known.get("patterns"), Sequence):
        first = [int(known["patterns"][place]) for place in order.patterns]  # of the bundle as it was trained
    bits = [round(value, 5) for value in order.bits]
    return {"order": {"by": order.by, "patterns": first, "bits": bits, "objects": order.objects, "exact": order.exact}}


def _back_end(bundle: Bundle, places: list[int]) -> BackEnd:
    outcomes = bundle.largest + 1
    table = None
    if bundle.table is not None:  # digit i of a new row was that of pattern places[i]
        word = np.arange(outcomes**bundle.n_features, dtype=np.int64)
        digits = (word // outcomes**new % outcomes * outcomes**old for new, old in enumerate(places))
        table = bundle.table[np.asarray(sum(digits), np.int64)]
    if bundle.head_onnx is None:
        return BackEnd(table=table, outcomes=outcomes)
    layers = plain_layers(bundle)
    first = Layer(np.ascontiguousarray(layers[0].weights[places]), layers[0].bias, layers[0].relu)
    int8 = None if bundle.int8_head is None else _int8(bundle.int8_head, places)
    quantised = None
    if int8 is not None and bundle.int8_onnx is not None:
        from .onnx_heads import int8_onnx  # and the package onnx, which nothing else here needs

        quantised = int8_onnx(int8)
    return BackEnd(chain_onnx((first, *layers[1:])), table, int8, quantised, outcomes)


def _int8(head: Int8Head, places: list[int]) -> Int8Head:
    n_in, n_out = (int(size) for size in head.sizes[:2])
    first = head.weights[: n_in * n_out].reshape(n_in, n_out)[places].ravel()
    return Int8Head(head.sizes, np.concatenate([first, head.weights[n_in * n_out :]]), head.affine)
