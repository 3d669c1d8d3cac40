"""Accuracy against dose: what a bundle decides when an object may receive only so much light, and when the light bleaches it.

A cap leaves the first of the fixed patterns; what the others would read is summed over: P(class | seen) = sum of P(class | word) P(word) /
sum of P(word), with words as training objects show them. A head without a table takes the mean reading of each pattern that is left out.
Exact expectations, but for automata before samples that bleach: what is left depends on the walk, and walks are sampled. SIMULATED.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.bundle.automaton import STATES_MAX, capped
from pans.bundle.heads import Layer, read_layers
from pans.bundle.sensor import BackEnd, Bundle, Shown, make_bundle
from pans.calibrate.refit import chain_onnx, log_softmax
from pans.instrument.optics import NO_BLEACHING
from pans.instrument.profile import Profile
from pans_trainer.options import Conditions
from pans_trainer.tasks.registry import Objects

from .accuracy import Measured, light_of
from .held_out import HeldOut, measure, trained_bleaching, trials_needed
from .optics import SHOWN, Figures, Report
from .readings import vector_chances
from .walks import MeasuredWalks, left_by_state

TRAINING_OBJECTS = 20_000  # the first ones, from which words are known
WORDS_MAX = 1 << 12  # whose chances are summed over training objects; beyond, the head's mean readings
LEAST_WORD = 1e-12  # of the chance of a word, so that a word that no training object shows has a posterior too
_CHUNK_NUMBERS = 1 << 22

F64 = NDArray[np.float64]
CURVE_PARTS = (1 / 8, 3 / 16, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 3 / 4, 1.0)  # of the most that a walk may take
CAP_MAX = 1e300  # beyond any light
BLEACHED_TRIALS = 4  # walks per object before samples that bleach


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
    total, step = np.zeros(words), max(1, _CHUNK_NUMBERS // words)
    for start in range(0, len(readings), step):
        total += vector_chances(readings[start : start + step]).sum(axis=0)
    return total / len(readings)


def marginal_scores(table: NDArray[Any], chances: F64, words_seen: int) -> F64:
    """Return log posteriors of the words of the first patterns, float64 (words_seen, classes).

    `table` (words, classes) are scores of all words, `chances` (words,) how often they come.
    """
    joint = np.exp(log_softmax(table.astype(np.float64))) * (chances + LEAST_WORD)[:, None]
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
    if count == bundle.n_features:
        return bundle
    outcomes = bundle.largest + 1
    if bundle.table is not None and outcomes**bundle.n_features <= WORDS_MAX:
        scores = marginal_scores(bundle.table, word_chances(readings), outcomes**count)
        back_end = BackEnd(table=scores, outcomes=outcomes)
    else:
        means = readings.mean(axis=0) @ np.arange(outcomes) / bundle.largest
        back_end = BackEnd(head_onnx=chain_onnx(_of_means(plain_layers(bundle), count, means)), outcomes=outcomes)
    return rebuilt(bundle, back_end, range(count), {"patterns_left_out": bundle.n_features - count})


def plain_layers(bundle: Bundle) -> tuple[Layer, ...]:
    """Return the layers of the head of `bundle`; ValueError where it is no plain chain of them (Gemm, Relu), or there is none."""
    layers = None
    if bundle.head_onnx is not None:
        layers = read_layers(bundle.head_onnx, bundle.n_features, bundle.n_classes)
    if layers is None:
        raise ValueError(
            f"the head of {bundle.name} is no plain chain of layers (Gemm, Relu), allowed: such a head, or to leave patterns out of a "
            f"table of at most {WORDS_MAX} words"
        )
    return layers


def _of_means(layers: tuple[Layer, ...], count: int, means: F64) -> tuple[Layer, ...]:
    """The layers for the first `count` patterns, the others at what the head is given of them in the mean."""
    first = layers[0]
    wide = first.weights.astype(np.float64)
    bias = first.bias.astype(np.float64) + means[count:] @ wide[count:]
    return (Layer(wide[:count].astype(np.float32), bias.astype(np.float32), first.relu), *layers[1:])


def rebuilt(bundle: Bundle, back_end: BackEnd, patterns: Sequence[int], facts: Mapping[str, Any]) -> Bundle:
    """Return `bundle` with these of its patterns, another back end, and `facts` beside its provenance."""
    return make_bundle(
        name=bundle.name,
        task=bundle.task,
        classes=bundle.classes,
        image_shape=bundle.image_shape,
        optics=Shown(bundle.levels, bundle.pattern_levels[list(patterns)], bundle.photons_per_level),
        provenance={**bundle.provenance, **facts},
        back_end=back_end,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Capped:
    """The bundle that stays within a dose: its first patterns, or its automaton with walks that end in time."""

    bundle: Bundle
    cap: float
    exposures_most: int
    states: int | None  # of an automaton

    def facts(self) -> dict[str, Any]:
        """Return what was left, for JSON."""
        return {"dose_cap": self.cap, "exposures_most": self.exposures_most, "states": self.states}


def knowledge_of(bundle: Bundle, held_out: HeldOut) -> Callable[[], F64]:
    """Return what gives `training_readings` of `bundle`, computed when they are first needed."""
    return cache(lambda: training_readings(bundle, held_out.profile, held_out.task.train))


def within_cap(bundle: Bundle, cap: float, held_out: HeldOut, known: Callable[[], F64], eta: float = 1.0) -> Capped:
    """Return `bundle` so that no object receives more illumination than `cap`, as the bundle states its patterns, times `eta`.

    ValueError where the first exposure alone brings more, for passive bundles and for pictures.
    """
    if bundle.analyser is not None or bundle.picture_shape is not None:
        what = f"{bundle.name} sends no light or returns pictures, allowed with a dose cap: patterns and classes"
        raise ValueError(what)
    own = cap / eta if eta > 0 else math.inf
    if bundle.automaton is None:
        count = patterns_within(bundle, own)
        found = bundle if count == bundle.n_features else of_first(bundle, count, known())
        return Capped(found, cap, count, None)
    most = held_out.profile.projector.automaton_states or STATES_MAX
    automaton = capped(bundle.automaton, bundle.state_light(), min(own, CAP_MAX), most)
    return Capped(replace(bundle, automaton=automaton), cap, automaton.n_slots, automaton.n_states)


def caps_of(bundle: Bundle) -> list[float]:
    """Return the caps of a curve: after every pattern; of an automaton parts of the walk that takes most."""
    if bundle.automaton is None:
        light = bundle.pattern_levels.sum(axis=1, dtype=np.uint64).astype(np.float64) * bundle.photons_per_level
        return [float(dose) for dose in np.cumsum(light) if dose > 0]
    first, most = float(bundle.state_light()[0]), bundle.illumination()
    return sorted({max(first, part * most) for part in CURVE_PARTS})


def figures_of(found: Capped, held_out: HeldOut, conditions: Conditions, trials: int | None = None) -> Figures:
    """Return what the bundle decides within its cap, from `trials` decisions per object or (None) as few as can be."""
    bundle = found.bundle
    if trials is None:
        trials = BLEACHED_TRIALS if depends_on_walk(bundle, conditions) else trials_needed(bundle)
    measured = measure(bundle, held_out, trials=trials, conditions=conditions)
    assert isinstance(measured, (Measured, MeasuredWalks))
    return measured


def depends_on_walk(bundle: Bundle, conditions: Conditions) -> bool:
    """Return whether what bleaching leaves in a state depends on the walk to it, so that walks must be sampled."""
    if bundle.automaton is None:
        return False
    light = bundle.state_light() * conditions.eta
    return left_by_state(bundle.automaton, light, conditions.bleaching, bundle.n_pixels) is None


def dose_curve(
    bundle: Bundle, held_out: HeldOut, conditions: Conditions, report: Report = lambda done, of: None
) -> list[dict[str, Any]]:
    """Return the points of accuracy against dose, from small caps to none; each with light, both spreads and, before samples
    that bleach, the accuracy that it would have without (`accuracy_unbleached`)."""
    known, caps, points = knowledge_of(bundle, held_out), caps_of(bundle), []
    for cap in caps:
        found = within_cap(bundle, cap * (conditions.eta or 1.0), held_out, known, conditions.eta)
        measured = asdict(figures_of(found, held_out, conditions))
        steady = None
        if not conditions.bleaching.is_none:
            plain = figures_of(found, held_out, replace(conditions, bleaching=NO_BLEACHING))
            steady = plain.accuracy_mean
        point = (
            found.facts()
            | {name: measured[name] for name in (*SHOWN, "accuracy_std", "trials")}
            | {"accuracy_unbleached": steady}
        )
        points.append(point | {"accuracy_se_trials": trial_error(measured)})
        report(len(points), len(caps))
    return points


def trial_error(measured: dict[str, Any]) -> float:
    """Return the error of the mean accuracy that comes from sampling decisions: 0 where nothing is sampled."""
    trials = measured["trials"]
    if not trials or measured["accuracy_std"] is None:
        return 0.0
    # of walks the spread is that of the shares p(1 - p) that were found, too small by (trials - 1) / trials
    walks = "exposures_mean" in measured
    return float(measured["accuracy_std"]) / math.sqrt(max(1, trials - 1) if walks else trials)
