"""What fixed patterns decide when a dose cap leaves only the first of them: the rest of a word is summed over.

A word is what all exposures of one shot read, clicks or photon numbers. Owns the bundle of the first patterns. A table's rows are weighed
by how often training objects show their words, and added over what is not seen: P(class | seen) = sum of P(class | word) P(word) / sum
of P(word). A head without a table takes the mean reading of each pattern that is not shown. Never trains; the knowledge of training objects
is their light under the bundle's own patterns.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.layers import Layer, read_layers
from pans.runtime.bundle.model import BackEnd, Bundle, Shown, make_bundle
from pans.runtime.instrument.profile import Profile
from pans.runtime.refit.onnx_chain import chain_onnx
from pans.trainer.tasks.registry import Objects

from .accuracy import EXACT_OUTCOMES_MAX, light_of
from .held_out import trained_bleaching
from .numbers import vector_chances

TRAINING_OBJECTS = 20_000  # the first ones, from which words are known
WORDS_MAX = 1 << 12  # whose chances are summed over training objects; beyond, the head's mean readings
LEAST_WORD = 1e-12  # of the chance of a word, so that a word that no training object shows has a posterior too
_CHUNK_NUMBERS = 1 << 22

F64 = NDArray[np.float64]


def patterns_within(bundle: Bundle, cap: float) -> int:
    """Return how many of the fixed patterns of `bundle`, in their order, stay within `cap` of illumination; ValueError for none."""
    light = bundle.pattern_levels.sum(axis=1, dtype=np.uint64).astype(np.float64) * bundle.photons_per_level
    within = int(np.count_nonzero(np.cumsum(light) <= cap * (1 + 1e-9)))
    if within == 0:
        raise ValueError(f"the first pattern alone brings {light[0]:.6g}, the dose may not pass {cap:.6g}")
    return within


def training_readings(bundle: Bundle, profile: Profile, training: Objects) -> F64:
    """Return P(reading) of the first training objects under the patterns of `bundle` as they were trained, (n, d_f, outcomes)."""
    images, imaging = training.first(TRAINING_OBJECTS).images, profile.imaging()
    return light_of(bundle, profile, images, imaging=imaging, bleaching=trained_bleaching(bundle)).chances


def word_chances(readings: F64) -> F64:
    """Return the mean P(word) over objects with `readings` (n, d_f, outcomes): (outcomes**d_f,), pattern 0 the lowest digit."""
    words = readings.shape[2] ** readings.shape[1]
    if words > EXACT_OUTCOMES_MAX:
        raise ValueError(f"{words} words, allowed: {EXACT_OUTCOMES_MAX}")
    total, step = np.zeros(words), max(1, _CHUNK_NUMBERS // words)
    for start in range(0, len(readings), step):
        total += vector_chances(readings[start : start + step]).sum(axis=0)
    return total / len(readings)


def marginal_scores(table: NDArray[Any], chances: F64, words_seen: int) -> F64:
    """Return log posteriors of the words of the first patterns, float64 (words_seen, classes).

    `table` (words, classes) are scores of all words, `chances` (words,) how often they come.
    """
    wide = table.astype(np.float64)
    posterior = np.exp(wide - wide.max(axis=1, keepdims=True))
    posterior /= posterior.sum(axis=1, keepdims=True)
    joint = posterior * (chances + LEAST_WORD)[:, None]
    seen = joint.reshape(-1, words_seen, table.shape[1]).sum(axis=0)  # the words that share their lowest digits
    return np.asarray(np.log(seen) - np.log(seen.sum(axis=1, keepdims=True)))


def demand_fixed_patterns(bundle: Bundle) -> None:
    """Raise ValueError unless `bundle` shows fixed patterns and decides among classes."""
    if bundle.automaton is not None or bundle.analyser is not None or bundle.picture_shape is not None:
        raise ValueError(f"{bundle.name} has no fixed patterns that decide among classes, allowed: bundles that have")


def of_first(bundle: Bundle, count: int, readings: F64) -> Bundle:
    """Return the bundle of the first `count` patterns of `bundle`, whose back end has summed over the others.

    `readings` (n, d_f, outcomes) are `training_readings`. ValueError for a bundle without fixed patterns or with pictures, and for a
    head that is no plain chain of layers.
    """
    demand_fixed_patterns(bundle)
    if not 1 <= count <= bundle.n_features:
        raise ValueError(f"{count} patterns of {bundle.n_features}")
    if count == bundle.n_features:
        return bundle
    outcomes = bundle.largest + 1
    if bundle.table is not None and outcomes**bundle.n_features <= WORDS_MAX:
        scores = marginal_scores(bundle.table, word_chances(readings), outcomes**count)
        back_end = BackEnd(table=scores, outcomes=outcomes)
    else:
        means = readings.mean(axis=0) @ np.arange(outcomes) / bundle.largest
        back_end = BackEnd(head_onnx=chain_onnx(_of_means(_layers(bundle), count, means)), outcomes=outcomes)
    return _with(bundle, back_end, bundle.pattern_levels[:count], {"patterns_left_out": bundle.n_features - count})


def _layers(bundle: Bundle) -> tuple[Layer, ...]:
    layers = None
    if bundle.head_onnx is not None:
        layers = read_layers(bundle.head_onnx, bundle.n_features, bundle.n_classes)
    if layers is None:
        raise ValueError(
            f"{bundle.name} has {bundle.n_features} patterns and no head of plain layers, allowed: a table of at most "
            f"{WORDS_MAX} words, or such a head"
        )
    return layers


def _of_means(layers: tuple[Layer, ...], count: int, means: F64) -> tuple[Layer, ...]:
    """The layers for the first `count` patterns, the others at what the head is given of them in the mean."""
    first = layers[0]
    wide = first.weights.astype(np.float64)
    bias = first.bias.astype(np.float64) + means[count:] @ wide[count:]
    return (Layer(wide[:count].astype(np.float32), bias.astype(np.float32), first.relu), *layers[1:])


def _with(bundle: Bundle, back_end: BackEnd, levels: NDArray[Any], facts: Mapping[str, Any]) -> Bundle:
    return make_bundle(
        name=bundle.name,
        task=bundle.task,
        classes=bundle.classes,
        image_shape=bundle.image_shape,
        optics=Shown(bundle.levels, levels, bundle.photons_per_level),
        provenance={**bundle.provenance, **facts},
        back_end=back_end,
    )
