"""From a trained automaton to a bundle, with the check that the bundle walks as the model does, and what it is expected to achieve.

`export_automaton` writes the file, reads it back and raises when its walks differ from the model's. Exact expectations, SIMULATED.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.errors import PansError, PlanError
from pans.base.files import whole_file
from pans.bundle.automaton import DOSE_ROUNDING, log_scores, walk_nodes
from pans.bundle.backends import expected_walk, make_decider
from pans.bundle.sensor import Bundle, load_bundle, make_bundle, with_expected, write_bundle
from pans.instrument.click_law import object_transmission
from pans.instrument.optics import NO_BLEACHING
from pans.instrument.profile import Profile
from pans_trainer.evaluate.accuracy import AS_IT_IS, outcome_law_of
from pans_trainer.evaluate.held_out import as_trained
from pans_trainer.evaluate.walks import (
    FIRST_OBJECTS,
    ONE_DOSE,
    MeasuredWalks,
    expected_figures,
    left_by_state,
    measured_walks,
    walks_of,
)
from pans_trainer.options import Conditions
from pans_trainer.tasks.registry import Objects, Task
from pans_trainer.train.automaton.train import TrainedAutomaton

from .writer import origin, programs, with_tolerance

COMPARED_OBJECTS = 100
TOLERANCE = 1e-5  # of chances and of relative light: posteriors are stored in float32
SAMPLED_WALKS = 1000


@dataclass(frozen=True, slots=True)
class ExportedAutomaton:
    """The written bundle, and what it does on all held-out objects and on the first 200."""

    bundle: Bundle
    sha256: str
    measured: MeasuredWalks
    first_200: MeasuredWalks
    difference: float  # of class chances between the file and the model, the largest


def export_automaton(
    path: Path,
    trained: TrainedAutomaton,
    task: Task,
    profile: Profile,
    *,
    name: str,
    provenance: Mapping[str, Any],
    force: bool = False,
) -> ExportedAutomaton:
    """Write what `train_automaton` returned to `path`; UsageError if it exists, unless `force`. A wrong bundle never stands there."""
    bundle = bundle_of(trained, task, profile, name, provenance)
    demand_within(bundle, trained.options.dose_cap)
    conditions = replace(as_trained(bundle), dark=trained.options.dark)
    bundle = with_tolerance(bundle, task, profile, trained.options.optics, trained.options.dark)
    difference = compare_walks(bundle, trained, task, profile)
    found = measure_walks(bundle, task.test, profile, conditions)
    first = measure_walks(bundle, task.test.first(FIRST_OBJECTS), profile, conditions)
    # what a bundle says of itself is of objects that do not bleach, as `pans evaluate` judges unless it is told
    steady = found
    if not conditions.bleaching.is_none:
        steady = measure_walks(bundle, task.test, profile, replace(conditions, bleaching=NO_BLEACHING))
    expected = expected_figures(steady, profile.name, task.name, "test")
    with whole_file(path, force=force) as unchecked:
        write_bundle(with_expected(bundle, expected), unchecked)
        written, digest = load_bundle(unchecked)
        compare_decider(written, trained.options.seed)
    return ExportedAutomaton(written, digest, found, first, difference)


def bundle_of(
    trained: TrainedAutomaton, task: Task, profile: Profile, name: str, provenance: Mapping[str, Any]
) -> Bundle:
    """Return the bundle of a trained automaton."""
    facts = {
        **origin(task, profile),
        "held_back": {key: round(value, 6) for key, value in asdict(trained.held_back).items()},
        "calibration_error": trained.posteriors.calibration_error,
        "trained_with": programs(),
        **provenance,
    }
    return make_bundle(
        name=name,
        task=task.name,
        classes=task.classes,
        image_shape=task.image_shape,
        optics=trained.shown,
        automaton=trained.automaton,
        provenance=facts,
    )


def demand_within(bundle: Bundle, cap: float | None) -> None:
    """Raise PlanError where a walk of `bundle` sends more than `cap`."""
    if cap is not None and bundle.illumination() > cap * (1 + DOSE_ROUNDING):
        raise PlanError(
            f"a walk of {bundle.name} sends {bundle.illumination():.9g}, the cap is {cap:.9g}: steps of the brightness are too coarse",
            remedy="fewer --exposures, or a profile with finer steps (projector.dwell_steps, or levels)",
        )


def measure_walks(
    bundle: Bundle, objects: Objects, profile: Profile, conditions: Conditions = AS_IT_IS
) -> MeasuredWalks:
    """Return what the automaton of `bundle` does on `objects` through `profile`, exactly."""
    return measured_walks(walks_of(bundle, profile, objects.images, objects.labels, conditions))


def compare_walks(bundle: Bundle, trained: TrainedAutomaton, task: Task, profile: Profile) -> float:
    """Hold the file's chances of every class and its light against the model's, on held-out objects; PansError where they differ.

    Both without afterpulses: a training has the mean memory of a state, the expectation that of a state and the click before it.
    """
    objects = task.test.first(COMPARED_OBJECTS)
    assert bundle.automaton is not None
    law = outcome_law_of(bundle, profile, dark=trained.options.dark)
    seen = object_transmission(profile, objects.images.reshape(len(objects), -1))
    left = left_by_state(bundle.automaton, bundle.state_light(), as_trained(bundle).bleaching, bundle.n_pixels)
    if left is None:
        raise PlanError(
            f"on {profile.name} walks to one state differ in dose by more than {ONE_DOSE:.0%} of that which leaves 1/e",
            remedy="choose a profile with finer steps (projector.dwell_steps, or levels), or leave out --bleach",
        )
    found = expected_walk(bundle.automaton, bundle.pattern_levels, seen, law, bundle.photons_per_level, left=left)
    of_class = found.leaves @ bundle.automaton.posteriors[bundle.automaton.n_states :].astype(np.float64)
    wanted, photons = trained.chances(objects)
    difference = float(np.abs(of_class - wanted).max())
    of_light = float((np.abs(found.photons - photons) / np.maximum(1e-9, photons)).max())
    if not (difference <= TOLERANCE and of_light <= TOLERANCE):
        raise PansError(
            f"the walks of {bundle.name} differ from the trained automaton: chances of a class by {difference:.3g}, light by "
            f"{of_light:.3g} of itself, allowed {TOLERANCE:g}",
            remedy="report this with the bundle: the export is wrong",
        )
    return difference


def compare_decider(bundle: Bundle, seed: int) -> None:
    """Hold the back end that will decide against plain walks of random click words; PansError where a decision differs."""
    automaton = bundle.automaton
    assert automaton is not None
    outcomes = automaton.n_outcomes if automaton.counts else 2
    words = np.random.default_rng(seed).integers(0, outcomes, (SAMPLED_WALKS, automaton.n_bits))
    wanted = automaton.posteriors[walk_nodes(automaton, words)[:, -1]]
    decider = make_decider(bundle, backend="automaton")
    labels, scores = decider.decide_batch(words, 1), decider.scores_batch(words, 1)
    # labels by the posteriors, not by the scores: logarithms in float32 may be equal where posteriors are not
    if not (np.array_equal(labels, wanted.argmax(axis=1)) and np.array_equal(scores, log_scores(wanted))):
        what = f"the back end of {bundle.name} decides otherwise than its leaves"
        raise PansError(what, remedy="report this with the bundle: the export is wrong")
