"""From a user's own images to a sensor and its results, without a word printed: `train_own`, and its parts for `pans train`.

Held-out images choose nothing. Where a class has too few of them, as many sensors are trained as there are parts (`fold_tasks`), each on
the other parts and with choices of its own, and every image is judged by the one that has not seen it.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pans.base.console import work_bar
from pans.base.errors import UsageError, as_usage_error, in_python_words
from pans.base.numbers import Range
from pans.bundle.sensor import Bundle
from pans.instrument.profile import Profile, load_profile
from pans_trainer.baselines.common import Report, Trials, named, silent
from pans_trainer.baselines.rows import at_equal_light
from pans_trainer.device import one_thread
from pans_trainer.evaluate.accuracy import EXACT_OUTCOMES_MAX, decision_shares, light_of
from pans_trainer.evaluate.held_out import DEFAULT_TRIALS
from pans_trainer.evaluate.walks import walks_of
from pans_trainer.export.automaton import bundle_of, export_automaton
from pans_trainer.options import LEAST_PHOTONS, AutomatonOptions, stated_tolerance
from pans_trainer.tasks.changes import Variation, enlarged
from pans_trainer.tasks.registry import HOLD_OUT_EVERY, Objects, Task, fold_tasks, load_task, own_task
from pans_trainer.train.automaton.train import train_automaton
from pans_trainer.train.automaton.tune import Progress

from .recipe import PLAIN_LIGHT, Recipe, choose_training, choose_variation
from .results import Judged, SensorResults, results_of

FEW_HELD_OUT = 10  # images of a class: of fewer the recall is hardly known, and each image is held out once
FOLDS = Range(1, HOLD_OUT_EVERY, whole=True)
PRICES = "first_price", "price"
CAMERAS = "direct_imaging", "direct_imaging_as_illuminated"


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """What was chosen from the training images of `task`, and the task with their changed copies; `facts` for the bundle."""

    task: Task
    recipe: Recipe
    facts: dict[str, Any]

    def prices(self) -> dict[str, Any]:
        """Return what light may cost, as options of an automaton."""
        return {one: getattr(self.recipe, one) for one in PRICES}


def prepared(task: Task, encoder: str, *, seed: int = 0, equal: bool = True, vary: bool = True) -> Prepared:
    """Choose how the images may be varied (unless not `vary`) and the size of the training; with `equal` every class counts the same."""
    variation, losses, light = Variation(), [0.0, 0.0], PLAIN_LIGHT
    if vary and task.target == "class":
        choice = choose_variation(task, seed)
        variation, losses = choice.variation, [round(choice.loss_before, 4), round(choice.loss, 4)]
        light = choice.light
    recipe = choose_training(task, variation, encoder, light)
    unequal = equal and len(set(np.bincount(task.train.labels))) > 1 and task.target == "class"
    bigger = enlarged(task, variation, recipe.objects, recipe.kept, seed, equal=unequal)
    changes = {name: value for name, value in asdict(variation).items() if value}
    facts = {"training_objects": len(bigger.train), "variation": changes, "left_out_loss": losses}
    return Prepared(bigger, recipe, facts | {"equal_classes": unequal})


def folds_needed(task: Task) -> int:
    """Return 5 where a class has so few held-out images that each image should be held out once, else 1."""
    few = np.bincount(task.test.labels, minlength=len(task.classes)).min() < FEW_HELD_OUT
    return HOLD_OUT_EVERY if few and task.split_here else 1


def judged(bundle: Bundle, varied: Task, profile: Profile, seed: int = 0, report: Report = silent) -> Judged:
    """Return what `bundle` and a camera with as much light decide on the held-out images of `varied`, whose copies the camera knows."""
    objects = varied.test
    if bundle.automaton is not None:
        walks = walks_of(bundle, profile, objects.images, objects.labels)
        shares, clicks, photons, sent = walks.shares, walks.clicks, walks.photons, walks.illumination
    else:
        light = light_of(bundle, profile, objects.images)
        photons, clicks = light.photoelectrons.sum(axis=1), light.probability.sum(axis=1)
        sent = np.full(len(objects), light.illumination)
        exact = (bundle.largest + 1) ** bundle.n_features <= EXACT_OUTCOMES_MAX
        shares = decision_shares(bundle, light, None if exact else DEFAULT_TRIALS, seed)
    cameras: dict[str, Trials] = {}
    if varied.light == "transmission" and photons.mean() >= LEAST_PHOTONS:
        cameras = at_equal_light(varied, float(photons.mean()), float(sent.mean()), report, seed=seed)
    return Judged(objects, shares, clicks, photons, sent, [cameras.get(name) for name in CAMERAS])


def other_folds(
    task: Task,
    profile: Profile,
    options: AutomatonOptions,
    folds: int,
    *,
    equal: bool,
    first_s: float,
    report: Report = silent,
) -> list[Judged]:
    """Train and judge the sensors of all folds but the first, which is `task` itself; fewer where Ctrl-C interrupts.

    `report` has the time that is left, at first by the seconds that the first sensor took, `first_s`.
    """
    found: list[Judged] = []
    began_s, each_s = time.perf_counter(), first_s

    def tell(what: str, _part: float) -> None:
        spent_s, rest = time.perf_counter() - began_s, folds - 2 - len(found)
        left_s = max(each_s * (folds - 1) - spent_s, each_s * rest, 1.0)
        report(f"sensor {len(found) + 2} of {folds}: {what}, {about(left_s)} left", spent_s / (spent_s + left_s))

    with suppress(KeyboardInterrupt):
        for fold in fold_tasks(task)[1:folds]:
            tell("choosing", 0.0)
            chosen = prepared(fold, "automaton", seed=options.seed, equal=equal)
            recipe = replace(options, batch=chosen.recipe.batch, **chosen.prices())
            varied = chosen.task
            trained = train_automaton(varied, profile, recipe, held_back=varied.kept, report=reporting(tell))
            bundle = bundle_of(trained, fold, profile, f"fold-{len(found) + 2}", {})
            found.append(judged(bundle, varied, profile, options.seed))
            each_s = (time.perf_counter() - began_s) / len(found)
    return found


def about(seconds: float) -> str:
    """Return a time as a person says it: "about 40 s", "about 6 min"."""
    return f"about {seconds:.0f} s" if seconds < 100 else f"about {seconds / 60:.0f} min"


def reporting(report: Report) -> Callable[[Progress], None]:
    """Return what takes an automaton's progress and says it to `report`."""
    return lambda step: report(f"{step.stage}, accuracy {100 * step.accuracy:.1f} %", step.done / step.steps)


@in_python_words()
@one_thread()
def train_own(
    images: ArrayLike | str | Path,
    labels: Sequence[Any] | NDArray[Any] | None = None,
    *,
    classes: Sequence[str] | None = None,
    out: str | Path | None = None,
    profile: Profile | str = "ideal",
    photons: float | None = None,
    illumination: float | None = None,
    seed: int = 0,
    folds: int | None = None,
    equal_classes: bool = True,
    name: str = "own",
    data_dir: str | Path | None = None,
    progress: bool | Report = True,
    **options: Any,
) -> SensorResults:
    """Train an automaton on images, and return what it decides on those held out, beside a camera.

    `images` are uint8 (n, height, width) of `labels` (n,), numbers into `classes` or names: every fifth image is held out. Or `images` is
    all of it: the name of a task (`pans data list`; `data_dir` as there), a folder of class folders with photos, or a .npz file.
    `photons` and `illumination` are the budget of a decision (default: chosen from the images). `out` is the bundle to write, which is
    not replaced; without it the bundle is in `sensor` alone. With `folds` 2 to 5 so many sensors are trained and judged (default 5 where
    a class has fewer than 10 held-out images, else 1); Ctrl-C then returns the results so far, with a warning. `progress` displays a bar
    on a terminal or in a notebook; a function is called with words and the part that is done. `options` are other fields of
    `AutomatonOptions`. UsageError for what does not fit. Fixed patterns are `pans.PansClassifier`'s.

    >>> import numpy as np
    >>> images = np.zeros((60, 4, 4), np.uint8)
    >>> images[::2, :, :2] = images[1::2, :, 2:] = 255
    >>> found = train_own(images, ["left", "right"] * 30, exposures=6, states=4, epochs=1, folds=1, progress=False)
    >>> found.classes, found.accuracy > 0.8, found.sensor.n_features
    (('left', 'right'), True, 6)
    """
    started = time.perf_counter()
    task = _task_of(images, labels, classes, name, data_dir)
    device = load_profile(profile) if isinstance(profile, str) else profile
    shown = work_bar() if progress is True else nullcontext(progress or silent)
    with shown as report:
        own, equal = task.split_here, equal_classes and task.split_here
        chosen = prepared(task, "automaton", seed=seed, equal=equal, vary=own)
        recipe = chosen.recipe
        if photons is None and illumination is None and not {"clicks", "dose_cap"} & options.keys():
            photons, illumination = recipe.photons, recipe.illumination
        sizes = {one: getattr(recipe, one) for one in ("exposures", "states", "batch", "epochs")} | chosen.prices()
        with as_usage_error():
            asked = AutomatonOptions(
                **{"copies": 0, "soft": 0.0, "optics": stated_tolerance(device), **sizes, **options},
                photons=photons,
                illumination=illumination,
                seed=seed,
            )
            number = folds_needed(task) if folds is None else int(FOLDS.checked(folds, "folds"))
            trained = train_automaton(
                chosen.task, device, asked, held_back=chosen.task.kept, report=reporting(named("training", report))
            )
            facts = chosen.facts | {"options": asdict(trained.options)}
            with tempfile.TemporaryDirectory() as folder:
                path = Path(out) if out is not None else Path(folder) / f"{name}.pans"
                exported = export_automaton(path, trained, task, device, name=path.stem, provenance=facts)
            parts = [judged(exported.bundle, chosen.task, device, seed, report)]
            first_s = time.perf_counter() - started
            parts += other_folds(task, device, trained.options, number, equal=equal, first_s=first_s, report=report)
    if len(parts) < number:
        warnings.warn(f"interrupted: {number - len(parts)} of {number} sensors are missing", stacklevel=4)
    return results_of(
        parts,
        task.classes,
        seconds=time.perf_counter() - started,
        bundle=None if out is None else path,
        sha256=exported.sha256,
        sensor=exported.bundle,
        missing=number - len(parts),
    )


def _task_of(
    images: ArrayLike | str | Path,
    labels: ArrayLike | None,
    classes: Sequence[str] | None,
    name: str,
    data_dir: str | Path | None,
) -> Task:
    if isinstance(images, str | Path):
        if labels is not None or classes is not None:
            what = f"labels and classes belong to arrays, {str(images)!r} has its own"
            raise UsageError(what, remedy="leave them out")
        return load_task(str(images), data_dir)
    found, given = np.asarray(images), np.asarray(labels)
    if found.dtype != np.uint8 or found.ndim != 3 or given.shape != found.shape[:1]:
        what = (
            f"images are {found.dtype} {found.shape}, labels {given.shape}, allowed: uint8 (n, height, width) and (n,)"
        )
        raise UsageError(what, remedy="scale grey values to 0 to 255, one channel")
    if classes is None:
        named, given = np.unique(given, return_inverse=True)
        classes = [str(one) for one in named]
    return own_task(name, tuple(classes), Objects(found, given.astype(np.int64)))
