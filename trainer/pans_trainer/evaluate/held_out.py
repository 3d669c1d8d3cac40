"""From a bundle and a task's name to figures: what `pans evaluate` and a notebook call. SIMULATED."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pans.bundle.sensor import Bundle, bundle_path, load_bundle
from pans.instrument.detector import crosstalk_of
from pans.instrument.optics import NO_BLEACHING, Bleaching, bleaching_of
from pans.instrument.profile import Profile, load_profile
from pans_trainer.options import Conditions
from pans_trainer.tasks.registry import Objects, Task, load_task, remembered_reading, remembered_task

from .accuracy import (
    AS_IT_IS,
    EXACT_OUTCOMES_MAX,
    Measured,
    MeasuredPictures,
    evaluate_exactly,
    evaluate_pictures,
    evaluate_sampled,
    light_of,
)
from .walks import MeasuredWalks, Walks, measured_walks, walks_of

DEFAULT_PROFILE = "oled-qcmos"
DEFAULT_TRIALS = 30  # as many as the paper's experiment repeats
PICTURE_TRIALS = 3  # a picture is hundreds of numbers
EXACT_NUMBERS_MAX = 1 << 16  # vectors of photon numbers, gone through unasked: ten thousand objects in half a minute


def trained_bleaching(bundle: Bundle) -> Bleaching:
    """Return the bleaching that the back end of `bundle` was trained through."""
    options = bundle.provenance.get("options")
    text = options.get("bleach") if isinstance(options, Mapping) else None
    return bleaching_of(text) if isinstance(text, str) else NO_BLEACHING


def as_trained(bundle: Bundle) -> Conditions:
    """Return the conditions that `bundle` was trained for."""
    return Conditions(bleaching=trained_bleaching(bundle))


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """The objects that a bundle is judged on, and the profile through which it sees them."""

    task: Task
    objects: Objects
    profile: Profile
    apart: bool = True  # from the task's training objects


def evaluate(
    bundle: Bundle | str | Path,
    *,
    task: str | None = None,
    shots: int = 1,
    trials: int | None = None,
    exact: bool = True,
    objects: int | None = None,
    data_dir: str | Path | None = None,
    conditions: Conditions = AS_IT_IS,
) -> Measured | MeasuredPictures | MeasuredWalks:
    """Return what `bundle` (or the .pans file at that path) decides on held-out objects, per decision of `shots` shots.

    `task` and `objects` (the first so many) are by default what the bundle was trained on, and all. With `trials` decisions are
    sampled; without, they are exact expectations, or, where not `exact` and for pictures, a default number of trials.
    ValueError where the outcomes are too many to enumerate or an argument is out of range.
    """
    model = bundle if isinstance(bundle, Bundle) else load_bundle(bundle)[0]
    if task is None and not isinstance(bundle, Bundle):
        task = remembered_task(model.provenance, model.task, bundle_path(bundle))
    held_out = held_out_of(model, task, objects, data_dir, conditions)
    exact = exact or model.automaton is not None
    if trials is None and (not exact or model.picture_shape is not None):
        trials = default_trials(model)
    return measure(model, held_out, shots=shots, trials=trials, conditions=conditions)


def default_trials(bundle: Bundle) -> int:
    """Return how often every object is decided on unless asked otherwise: 30 times, pictures 3 times."""
    return DEFAULT_TRIALS if bundle.picture_shape is None else PICTURE_TRIALS


def held_out_of(
    bundle: Bundle, task: str | None, count: int | None, data_dir: str | Path | None, conditions: Conditions
) -> HeldOut:
    """Return the first `count` held-out objects (None: all) of `task`, by default what `bundle` was trained on.

    All objects of a file without a test part are held out, unless the bundle was trained on that very file.
    """
    facts = bundle.provenance
    if count is not None and count < 1:
        raise ValueError(f"objects is {count}, allowed: 1 or more")
    data_seed = int(facts.get("data_seed", 0)) if conditions.data_seed is None else conditions.data_seed
    name = task or str(facts.get("task_argument", bundle.task))
    found = load_task(name, data_dir, data_seed=data_seed, reading=remembered_reading(facts))
    if bundle.picture_shape not in (None, found.image_shape):
        raise ValueError(f"{bundle.name} returns pictures of {bundle.picture_shape}, the task has {found.image_shape}")
    if bundle.picture_shape is None and found.classes != bundle.classes:
        raise ValueError(
            f"{bundle.name} decides among {len(bundle.classes)} classes ({', '.join(bundle.classes[:3])}, ...), the task "
            f"{found.name} has {len(found.classes)} ({', '.join(found.classes[:3])}, ...), allowed: the same classes in that order"
        )
    whole = found.split_here and facts.get("data_sha256") != found.sha256
    profile = load_profile(conditions.profile or str(facts.get("profile", DEFAULT_PROFILE)))
    return HeldOut(found, (found.everything() if whole else found.test).first(count), profile, not whole)


def measure(
    bundle: Bundle, held_out: HeldOut, *, shots: int = 1, trials: int | None = None, conditions: Conditions = AS_IT_IS
) -> Measured | MeasuredPictures | MeasuredWalks:
    """Return what `bundle` decides on the objects: from `trials` decisions per object, or exact without (not of pictures)."""
    objects = held_out.objects
    if trials is not None and trials < 1:
        raise ValueError(f"trials is {trials}, allowed: 1 or more")
    if bundle.automaton is not None:
        return measured_walks(walks_on(bundle, held_out, shots=shots, trials=trials, conditions=conditions))
    if conditions.confidence:
        raise ValueError(f"confidence is {conditions.confidence:g}, but {bundle.name} has no automaton")
    if shots != 1 and not conditions.bleaching.is_none:
        raise ValueError(f"shots is {shots}, allowed with bleaching: 1 (each shot would meet another sample)")
    light = light_of(
        bundle,
        held_out.profile,
        objects.images,
        eta=conditions.eta,
        dark=conditions.dark,
        imaging=conditions.imaging_on(held_out.profile),
        bleaching=conditions.bleaching,
    )
    if bundle.picture_shape is not None:
        if trials is None:
            raise ValueError("pictures are compared by trials, there is no exact expectation")
        return evaluate_pictures(bundle, light, objects.images, shots=shots, trials=trials, seed=conditions.seed)
    if trials is None:
        return evaluate_exactly(bundle, light, objects.labels, shots=shots)
    return evaluate_sampled(bundle, light, objects.labels, shots=shots, trials=trials, seed=conditions.seed)


def walks_on(
    bundle: Bundle, held_out: HeldOut, *, shots: int = 1, trials: int | None = None, conditions: Conditions = AS_IT_IS
) -> Walks:
    """Return what the automaton of `bundle` does on the objects: `trials` walks of each, or exact without."""
    if shots != 1:
        raise ValueError(f"shots is {shots}, allowed with an automaton: 1 (several shots are several trials)")
    objects = held_out.objects
    return walks_of(bundle, held_out.profile, objects.images, objects.labels, conditions, trials)


def afterpulses_in(bundle: Bundle, held_out: HeldOut, shots: int = 1, trials: int | None = None) -> str:
    """Return how the figures of `measure` hold afterpulses: none, exact, mean memory or sampled."""
    detector = held_out.profile.detector
    if not detector.afterpulse_probability or (bundle.automaton is None and held_out.profile.mode == "parallel"):
        return "none"
    if trials:
        return "sampled"
    merged = bundle.automaton is not None and detector.afterpulse_time_us is not None
    return "mean memory" if merged or shots > 1 else "exact"


def crosstalk_in(bundle: Bundle, held_out: HeldOut, shots: int = 1, trials: int | None = None) -> str:
    """Return how the figures of `measure` hold crosstalk: none, exact, mean or sampled."""
    if not crosstalk_of(held_out.profile) or bundle.largest > 1:
        return "none"
    return "sampled" if trials else "exact" if shots == 1 else "mean"


def trials_needed(bundle: Bundle, shots: int = 1) -> int | None:
    """Return None where the exact expectation can be had, else a number of trials: 30, of pictures one."""
    if bundle.picture_shape is not None:
        return 1
    if bundle.automaton is not None:
        return None
    most = EXACT_OUTCOMES_MAX if bundle.largest == 1 else EXACT_NUMBERS_MAX
    return DEFAULT_TRIALS if (shots * bundle.largest + 1) ** bundle.n_features > most else None
