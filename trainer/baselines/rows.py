"""What a baseline reaches at each of several photon levels: one row of figures per level.

Owns the walk over the levels; the ways to measure and to decide are in the other modules of this package.
Every row holds clicks, photons and illumination, the spread over trials and the error from having few
objects, for all test objects and for the first 200 (those of the paper's tables).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from pans.trainer.tasks.registry import Task

from .common import Decide, Measurement, Report, detect, measure, run_trials
from .options import BaselineOptions

FIRST = 200  # test objects, those of the paper's tables

At = Callable[[float], tuple[Decide, dict[str, Any]]]  # photons per object -> the decision, and facts about it


def baseline_rows(
    task: Task, options: BaselineOptions, levels: Iterable[float], report: Report
) -> Iterator[dict[str, Any]]:
    """Yield one row of figures per photon level, in the order of `levels` (photoelectrons per decision)."""
    measurement, at = _paradigm(task, options, report)
    trials = options.trials or (2 if options.method == "bayes" else 10)
    for photons in levels:
        started = time.perf_counter()
        decide, extra = at(photons)
        done = run_trials(
            measurement, photons, options.detector, decide, trials=trials, seed=options.seed, dark=options.dark
        )
        yield {
            **asdict(done.measured()),
            "first_200": asdict(done.measured(FIRST)),
            "photons_asked": photons,
            "detector": options.detector,
            "brightness": options.brightness,
            "dark": options.dark,
            "features": measurement.train.shape[1],
            "train_objects": len(task.train),
            **extra,
            "seconds": time.perf_counter() - started,
        }


def _paradigm(task: Task, options: BaselineOptions, report: Report) -> tuple[Measurement, At]:
    """The measurement, and what gives the decision at a photon level, with facts about it."""
    if options.paradigm == "e2e":
        return _end_to_end(task, options, report)
    from .bayes import bayes

    patterns, facts = None, {}
    if options.paradigm == "compressive":
        from .compressive import patterns as fixed_patterns

        patterns = fixed_patterns(options.patterns, options.features, task.image_shape, options.seed)
        facts = {"patterns": options.patterns}
    measurement = measure(task, patterns, options.brightness)
    if options.method != "bayes":
        return measurement, _network(measurement, options, facts, report)

    def exact(photons: float) -> tuple[Decide, dict[str, Any]]:
        decide, floor = bayes(
            measurement,
            photons,
            options.detector,
            seed=options.seed,
            dark=options.dark,
            floor=options.floor,
            report=report,
        )
        known = _information(measurement, photons, floor, options) if options.information else {}
        return decide, facts | {"floor": floor} | known

    return measurement, exact


def _information(measurement: Measurement, photons: float, floor: float, options: BaselineOptions) -> dict[str, Any]:
    """One more readout of every test object, judged by the posterior; and what its statistics alone say."""
    from pans.trainer.evaluate.information import fisher, posterior_information

    from .bayes import log_joint

    light = measurement.photoelectrons(measurement.test, photons)
    readouts = detect(light, options.detector, np.random.default_rng([options.seed, 4]), options.dark)
    joint = log_joint(measurement, readouts, photons, options.detector, floor=floor, dark=options.dark)
    mean = light.astype(np.float64) + options.dark  # of Poisson counts, and their variance too
    return {
        "information": asdict(posterior_information(joint, measurement.test_labels)),
        "fisher": asdict(fisher(mean, mean, measurement.test_labels)),
    }


def _network(measurement: Measurement, options: BaselineOptions, facts: dict[str, Any], report: Report) -> At:
    from .compressive import aware_mlp, clean_mlp
    from .direct import aware_cnn, clean_cnn

    shared: dict[str, Any] = {"seed": options.seed, "report": report}
    if options.epochs:
        shared["epochs"] = options.epochs
    if options.method == "clean-cnn":
        of_frame = clean_cnn(measurement, **shared)
        return lambda _photons: (of_frame, facts)
    if options.method == "clean-mlp":
        of_level = clean_mlp(measurement, **shared)
        return lambda photons: (of_level(photons, options.detector), facts)
    aware = aware_cnn if options.method == "cnn" else aware_mlp
    return lambda photons: (aware(measurement, photons, options.detector, dark=options.dark, **shared), facts)


def _end_to_end(task: Task, options: BaselineOptions, report: Report) -> tuple[Measurement, At]:
    from .e2e import EPOCHS, measured_by, train_conventionally

    bits = options.bits if options.method == "qat" else None
    model = train_conventionally(
        task, options.features, seed=options.seed, bits=bits, epochs=options.epochs or EPOCHS, report=report
    )
    measurement, of_level = measured_by(model, task, options.brightness)
    return measurement, lambda photons: (of_level(photons, options.detector), {"bits": bits})
