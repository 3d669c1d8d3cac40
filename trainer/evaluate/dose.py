"""Accuracy against dose: what a bundle decides when an object may receive only so much light, and when the light bleaches it.

Owns the caps of a curve and its points; the figures of one cap are those of held_out.py. Exact expectations, but for automata before
samples that bleach: what is left in a state depends on the walk to it, and walks are sampled. SIMULATED.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import STATES_MAX, capped
from pans.runtime.bundle.model import Bundle
from pans.runtime.imaging import NO_BLEACHING

from .accuracy import Measured
from .held_out import Conditions, HeldOut, measure, trials_needed
from .shown import of_first, patterns_within, training_readings
from .walks import MeasuredWalks

CURVE_PARTS = (1 / 8, 3 / 16, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 3 / 4, 1.0)  # of the most that a walk may take
CAP_MAX = 1e300  # beyond any light
BLEACHED_TRIALS = 4  # walks per object before samples that bleach

F64 = NDArray[np.float64]
Figures = Measured | MeasuredWalks
Told = Callable[[int, int], None]
_SHOWN = (
    "accuracy_mean",
    "accuracy_std",
    "accuracy_se_objects",
    "clicks_mean",
    "photons_mean",
    "illumination",
    "trials",
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


class Knowledge:
    """What training objects show under a bundle's fixed patterns, computed when it is first needed."""

    def __init__(self, bundle: Bundle, held_out: HeldOut) -> None:
        self._bundle, self._held_out = bundle, held_out
        self._readings: F64 | None = None

    @property
    def readings(self) -> F64:
        """P(reading) of training objects, (n, d_f, outcomes)."""
        if self._readings is None:
            self._readings = training_readings(self._bundle, self._held_out.profile, self._held_out.task.train)
        return self._readings


def within_cap(bundle: Bundle, cap: float, held_out: HeldOut, known: Knowledge, eta: float = 1.0) -> Capped:
    """Return `bundle` so that no object receives more illumination than `cap`, as the bundle states its patterns, times `eta`.

    ValueError where the first exposure alone brings more, for passive bundles and for pictures.
    """
    if bundle.analyser is not None or bundle.picture_shape is not None:
        raise ValueError(
            f"{bundle.name} sends no light or returns pictures, allowed with a dose cap: patterns and classes"
        )
    own = cap / eta if eta > 0 else math.inf
    if bundle.automaton is None:
        count = patterns_within(bundle, own)
        found = bundle if count == bundle.n_features else of_first(bundle, count, known.readings)
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
        bleached_walks = bundle.automaton is not None and not conditions.bleaching.is_none
        trials = BLEACHED_TRIALS if bleached_walks else trials_needed(bundle)
    measured = measure(bundle, held_out, trials=trials, conditions=conditions)
    assert isinstance(measured, (Measured, MeasuredWalks))
    return measured


def dose_curve(
    bundle: Bundle, held_out: HeldOut, conditions: Conditions, told: Told = lambda done, of: None
) -> list[dict[str, Any]]:
    """Return the points of accuracy against dose, from small caps to none; each with light, both spreads and, before samples
    that bleach, the accuracy that it would have without (`accuracy_unbleached`)."""
    known, caps, points = Knowledge(bundle, held_out), caps_of(bundle), []
    for number, cap in enumerate(caps):
        found = within_cap(bundle, cap * (conditions.eta or 1.0), held_out, known, conditions.eta)
        measured = asdict(figures_of(found, held_out, conditions))
        steady = None
        if not conditions.bleaching.is_none:
            plain = figures_of(found, held_out, replace(conditions, bleaching=NO_BLEACHING))
            steady = plain.accuracy_mean
        point = found.facts() | {name: measured[name] for name in _SHOWN} | {"accuracy_unbleached": steady}
        points.append(point | {"accuracy_se_trials": trial_error(measured)})
        told(number + 1, len(caps))
    return points


def trial_error(measured: dict[str, Any]) -> float:
    """Return the error of the mean accuracy that comes from sampling decisions: 0 where nothing is sampled."""
    trials = measured["trials"]
    if not trials or measured["accuracy_std"] is None:
        return 0.0
    # of walks the spread is that of the shares p(1 - p) that were found, too small by (trials - 1) / trials
    walks = "exposures_mean" in measured
    return float(measured["accuracy_std"]) / math.sqrt(max(1, trials - 1) if walks else trials)
