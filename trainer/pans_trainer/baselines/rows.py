"""What a baseline reaches at each of several levels of light: one row of figures per level.

Rows hold clicks, photons and illumination, the spread over trials and the error from having few objects, for all test objects and for the
first 200 (those of the paper's tables).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from pans.base.errors import UsageError
from pans_trainer.evaluate.accuracy import row_of
from pans_trainer.evaluate.walks import FIRST_OBJECTS
from pans_trainer.options import LEAST_PHOTONS, BaselineOptions
from pans_trainer.tasks.registry import Task

from .common import Decide, Light, Measurement, Report, Trials, detect, measure, run_trials, sends_light

EQUAL_TRIALS, EQUAL_DECISIONS = 10, 5000  # readouts per object of a comparison, fewer where all would be more than that

At = Callable[[float], tuple[Decide, dict[str, Any]]]  # photons per object -> the decision, and facts about it
AtLevel = Callable[[Light], tuple[Measurement, Decide, dict[str, Any]]]  # the same, and the measurement


def baseline_rows(
    task: Task, options: BaselineOptions, levels: Sequence[Light], report: Report
) -> Iterator[dict[str, Any]]:
    """Yield one row of figures per level of light, in the order of `levels`.

    Of `stopping` levels out of reach are left out. UsageError for light sent to a scene whose light is its own.
    """
    asked = [level.amount for level in levels if level.of == "illumination"]
    if asked and not sends_light(task):
        raise UsageError(
            f"--illumination {asked[0]:g}: the light of {task.name} is its own, nothing is sent",
            remedy="ask for --photons alone",
        )
    walk = _stopping if options.method == "stopping" else _by_level
    started = time.perf_counter()
    for level, n_readouts, done, extra in walk(task, options, levels, report):
        yield {
            **row_of(done.measured()),
            "first_200": row_of(done.measured(FIRST_OBJECTS)),
            "photons_asked": level.amount if level.of == "photons" else None,
            "illumination_asked": level.amount if level.of == "illumination" else None,
            "detector": options.detector,
            "brightness": options.brightness,
            "dark": options.dark,
            "features": n_readouts,
            "train_objects": len(task.train),
            **extra,
            "seconds": time.perf_counter() - started,
        }
        started = time.perf_counter()


def comparison_numbers(task: Task) -> float:
    """Return how many numbers one comparison at equal light goes through, about."""
    return float(len(task.train)) * len(task.test) * _equal_trials(task) * math.prod(task.image_shape)


def _equal_trials(task: Task) -> int:
    return max(1, min(EQUAL_TRIALS, EQUAL_DECISIONS // len(task.test)))


def at_equal_light(
    task: Task, photons: float, illumination: float, report: Report, *, seed: int = 0
) -> dict[str, Trials]:
    """Return what the exact posterior of direct imaging decides on as much light as a decision takes, detected and sent.

    Keys as in the answers of commands: `direct_imaging` at equal photons, `direct_imaging_as_illuminated` at equal illumination. One
    without light is left out.
    """
    options = BaselineOptions("direct", "bayes", trials=_equal_trials(task), seed=seed)
    camera = measure(task, None)
    levels = {
        "direct_imaging": Light("photons", photons),
        "direct_imaging_as_illuminated": Light("illumination", illumination),
    }
    return {
        name: done
        for name, level in levels.items()
        if level.amount > 0 and level.photons(camera) >= LEAST_PHOTONS
        for _, _, done, _ in _by_level(task, options, [level], report)
    }


def equal_light_figures(done: Trials) -> dict[str, Any]:
    """Return the figures of such a comparison as commands answer them."""
    wanted = "accuracy_mean", "accuracy_se_objects", "clicks_mean", "photons_mean", "illumination", "objects", "trials"
    figures = row_of(done.measured())
    return {key: figures[key] for key in wanted}


Level = tuple[Light, int, Trials, dict[str, Any]]  # asked for, readouts per object, what was decided, facts


def _stopping(task: Task, options: BaselineOptions, levels: Iterable[Light], report: Report) -> Iterator[Level]:
    from .end_to_end import masks_that_stop
    from .networks import SHORTEST, exposure_net, log_chances
    from .stopping import held_back, of_network, stopping

    if options.detector != "counting" or options.dark:
        raise ValueError("stopping counts every photon: allowed with a counting detector without dark counts only")
    if options.paradigm == "fsi":
        n_readouts, found = options.features, masks_that_stop(task, options, levels, report)
    else:
        measurement, seed = measure(task, None, options.brightness), options.seed
        n, n_readouts = measurement.train.shape
        net = exposure_net(measurement, n - held_back(n), task.name, seed=seed, epochs=options.epochs, report=report)
        network = of_network(partial(log_chances, net), n_readouts, SHORTEST)
        found = stopping(measurement, levels, network, seed=seed, trials=options.trials or 1, report=report)
    for level, facts, done in found:
        yield level, n_readouts, done, facts


def _by_level(task: Task, options: BaselineOptions, levels: Iterable[Light], report: Report) -> Iterator[Level]:
    at_level = _paradigm(task, options, report)
    trials = options.trials or (2 if options.method == "bayes" else 10)
    shared: dict[str, Any] = {"trials": trials, "seed": options.seed, "dark": options.dark}
    for level in levels:
        measurement, decide, extra = at_level(level)
        done = run_trials(measurement, level.photons(measurement), options.detector, decide, **shared)
        yield level, measurement.train.shape[1], done, extra


def _paradigm(task: Task, options: BaselineOptions, report: Report) -> AtLevel:
    """What gives measurement and decision at a level of light, with facts about them."""
    if options.paradigm == "fsi":  # masks are trained anew for every level: the measurement is of the level too
        from .end_to_end import masks_measured, train_masks

        return lambda level: (*masks_measured(train_masks(task, options, level, report), task, options.brightness), {})
    measurement, at = (_end_to_end if options.paradigm == "e2e" else _patterns)(task, options, report)
    return lambda level: (measurement, *at(level.photons(measurement)))


def _patterns(task: Task, options: BaselineOptions, report: Report) -> tuple[Measurement, At]:
    from .bayes import bayes

    patterns, facts = None, {}
    if options.paradigm == "compressive":
        from .networks import patterns as fixed_patterns

        patterns = fixed_patterns(options.patterns, options.features, task.image_shape, options.seed)
        facts = {"patterns": options.patterns}
    elif options.paradigm == "hadamard":
        from .networks import pairs

        patterns = pairs(options.features, task.image_shape)
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
    from pans_trainer.evaluate.information import fisher, posterior_information

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
    from .networks import EPOCHS, aware_net, clean_cnn, clean_mlp

    method = options.method
    shared: dict[str, Any] = {"seed": options.seed, "report": report, "epochs": options.epochs or EPOCHS[method]}
    if method == "clean-cnn":
        of_frame = clean_cnn(measurement, **shared)
        return lambda _photons: (of_frame, facts)
    if method == "clean-mlp":
        of_level = clean_mlp(measurement, **shared)
        return lambda photons: (of_level(photons, options.detector), facts)
    shared["dark"] = options.dark
    return lambda photons: (aware_net(method, measurement, photons, options.detector, **shared), facts)


def _end_to_end(task: Task, options: BaselineOptions, report: Report) -> tuple[Measurement, At]:
    from .end_to_end import EPOCHS, patterns_measured, train_conventionally

    bits = options.bits if options.method == "qat" else None
    model = train_conventionally(
        task, options.features, seed=options.seed, bits=bits, epochs=options.epochs or EPOCHS, report=report
    )
    measurement, of_level = patterns_measured(model, task, options.brightness)
    return measurement, lambda photons: (of_level(photons, options.detector), {"quantiser_bits": bits})
