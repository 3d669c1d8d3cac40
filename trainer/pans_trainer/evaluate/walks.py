"""What an automaton decides on held-out objects: exact sums over all walks, or sampled walks; calibration of its posteriors.

The sums over walks are `pans.bundle.backends.expectation`. SIMULATED figures: the click law of the profile, no instrument.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.bundle.automaton import Automaton, stopped
from pans.bundle.backends import NO_LABEL, ExpectedWalk, expected_walk, leaf_verdicts, pattern_light
from pans.bundle.sensor import Bundle
from pans.bundle.sensor import expected_differences as expected_differences
from pans.instrument.click_law import (
    ClickLaw,
    CountLaw,
    click_probability,
    count_chances,
    log_no_click,
    object_transmission,
)
from pans.instrument.detector import Afterpulses, afterpulses_of
from pans.instrument.optics import Bleaching, Imaging, mean_left, met
from pans.instrument.profile import Profile
from pans_trainer.options import Conditions

from .accuracy import AS_IT_IS, ByClass, among_classes, demand_sequence, exposure_of, outcome_law_of
from .information import Conveyed, conveyed

CALIBRATION_BINS = 15  # of equal width over the probability: as Guo et al., ICML 2017
LEAST = 2.0**-126  # of a probability in float32, which a 0 stands for
FIRST_OBJECTS = 200  # the paper's objects: judged beside all of them
BEGIN_OBJECTS, BEGIN_ROUNDS = 500, 4  # by which the memory is found with which an object comes
_LEAF_NUMBERS = 1 << 22  # objects times leaves at once
_LIGHT_NUMBERS = 1 << 22

F64 = NDArray[np.float64]
OF_OBJECTS = (
    "right",
    "decided",
    "shares",
    "clicks",
    "photons",
    "illumination",
    "exposures",
    "first_clicked",
    "surprise",
    "labels",
)
ONE_DOSE = 1e-3  # of the dose that leaves 1/e: by so much the doses of walks to one state may differ, by steps of the dwell time
BLEACHED_AT_ONCE = 512  # objects, whose pixels stand in memory


@dataclass(frozen=True, slots=True)
class MeasuredWalks(Conveyed):
    """Means per decision of an automaton.

    With a confidence `accuracy_mean` is that of what is decided, and `abstained` the share of the decisions that are not. `accuracy_std` is
    the spread over trials (exact without trials), `accuracy_se_objects` the error from having few objects.
    """

    accuracy_mean: float | None  # None where nothing is decided; so are the next two
    accuracy_std: float | None
    accuracy_se_objects: float | None
    clicks_mean: float
    photons_mean: float
    illumination: float
    exposures_mean: float
    expected_calibration_error: float | None
    abstained: float
    objects: int
    trials: int  # 0: exact, no trials were needed
    shots: int = 1
    by_class: ByClass | None = None
    first_state_clicked: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Walks:
    """Sums per object, float64 (n,): chances of a right decision and of any, clicks and so on; `by_class` (classes, leaves)."""

    right: F64
    decided: F64
    shares: F64  # (n, classes): the chance that this class is decided
    clicks: F64
    photons: F64
    illumination: F64
    exposures: F64
    first_clicked: F64  # chance that state 0 clicks
    surprise: F64  # -log2 of the true class's probability at the leaf
    by_class: F64  # chance that an object of this class ends at this leaf, summed over the objects
    automaton: Automaton  # the one that ran
    leaf_labels: NDArray[np.uint16]
    labels: NDArray[np.int64]  # the true ones
    classes: tuple[str, ...] = ()
    trials: int = 0

    def first(self, count: int) -> Walks:
        """Return the sums of the first `count` objects; `by_class` remains that of all."""
        return replace(self, **{name: getattr(self, name)[:count] for name in OF_OBJECTS})


@dataclass(frozen=True, slots=True)
class CalibrationBin:
    """Decisions of about one probability: their share of all, mean probability, and accuracy."""

    share: float
    probability: float
    accuracy: float


def walks_of(
    bundle: Bundle,
    profile: Profile,
    images: NDArray[np.uint8],
    labels: NDArray[np.int64],
    conditions: Conditions = AS_IT_IS,
    trials: int | None = None,
) -> Walks:
    """Show the automaton of `bundle` to `images` (n, height, width) through `profile`; exact, or `trials` walks per object.

    `conditions` say how; their profile and data seed are the caller's to follow. Bleaching needs `trials` where what is left in a state
    depends on the walk to it. ValueError for what does not fit.
    """
    whole = _fitting(bundle, profile, images, conditions, trials)
    automaton = stopped(whole, conditions.confidence) if conditions.confidence else whole
    leaf_labels = leaf_verdicts(automaton, conditions.confidence).labels
    step = _at_once(bundle, automaton, conditions)
    sums_of = _walking(bundle, automaton, profile, images, conditions, trials)
    parts: list[Walks] = []
    for start in range(0, len(images), step):
        sums = sums_of(images[start : start + step])
        parts.append(_judged(sums, labels[start : start + step], automaton, leaf_labels))
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in OF_OBJECTS}
    by_class = sum((part.by_class for part in parts[1:]), parts[0].by_class)
    return replace(parts[0], **joined, by_class=by_class, trials=trials or 0, classes=bundle.classes)


def leaf_chances(bundle: Bundle, profile: Profile, images: NDArray[np.uint8], conditions: Conditions = AS_IT_IS) -> F64:
    """Return the chance that a walk on each of `images` (n, height, width) ends at each leaf, float64 (n, leaves); see `walks_of`."""
    automaton = _fitting(bundle, profile, images, conditions, None)
    return _walking(bundle, automaton, profile, images, conditions, None)(images)[-1]


def _walking(
    bundle: Bundle,
    automaton: Automaton,
    profile: Profile,
    images: NDArray[np.uint8],
    conditions: Conditions,
    trials: int | None,
) -> Callable[[NDArray[np.uint8]], _Sums]:
    """Return what gives the sums of a part of `images`: exactly, or of `trials` walks."""
    law = outcome_law_of(bundle, profile, conditions.eta, conditions.dark)
    afterpulses = afterpulses_of(profile, exposure_of(bundle, profile))
    patterns, scale = patterns_met(bundle, conditions.imaging_on(profile)), bundle.photons_per_level * conditions.eta
    if trials is not None:
        rng = np.random.default_rng(conditions.seed)

        def sampled(part: NDArray[np.uint8]) -> _Sums:
            light = automaton, patterns, _seen(profile, part), scale
            return _sampled(light, (law, afterpulses), conditions.bleaching, trials, rng)

        return sampled
    sent = patterns.sum(axis=1, dtype=np.float64)[automaton.rows].sum(axis=1) * automaton.dwell / automaton.dwell_steps
    left = left_by_state(automaton, sent * scale, conditions.bleaching, bundle.n_pixels)
    if left is None:
        raise ValueError("bleaching depends on the walk, there is no exact expectation (sample trials instead)")

    def walk(part: NDArray[np.uint8], begins: tuple[float, float]) -> ExpectedWalk:
        seen = _seen(profile, part)
        return expected_walk(automaton, patterns, seen, law, scale, afterpulses=afterpulses, begins=begins, left=left)

    begins = 0.0, 0.0
    if afterpulses.time:
        some = np.linspace(0, len(images) - 1, min(_at_once(bundle, automaton, conditions), BEGIN_OBJECTS, len(images)))
        # objects begin with the memory that those before them leave, which begin with it too
        for _ in range(BEGIN_ROUNDS):
            ends = walk(images[some.astype(np.int64)], begins).ends
            assert ends is not None
            mean, square = ends.mean(axis=0).tolist()
            begins = mean, max(square - mean**2, 0.0)

    def expected(part: NDArray[np.uint8]) -> _Sums:
        found = walk(part, begins)
        return found.clicks, found.photons, found.illumination, found.exposures, found.first_clicked, found.leaves

    return expected


def _at_once(bundle: Bundle, automaton: Automaton, conditions: Conditions) -> int:
    """How many objects are looked at together, so that memory stays small."""
    step = max(1, min(_LEAF_NUMBERS // automaton.n_leaves, _LIGHT_NUMBERS // bundle.n_patterns))
    return step if conditions.bleaching.is_none else min(step, BLEACHED_AT_ONCE)


def _seen(profile: Profile, images: NDArray[np.uint8]) -> NDArray[Any]:
    return object_transmission(profile, images.reshape(len(images), -1))


def _fitting(
    bundle: Bundle, profile: Profile, images: NDArray[np.uint8], conditions: Conditions, trials: int | None
) -> Automaton:
    """Return the automaton of `bundle`; ValueError where bundle, images, conditions and trials do not fit each other."""
    if bundle.automaton is None:
        raise ValueError(f"{bundle.name} has no automaton")
    if images.shape[1:] != bundle.image_shape:
        raise ValueError(f"images are {images.shape[1:]}, allowed with {bundle.name}: {bundle.image_shape}")
    if not conditions.bleaching.is_none:
        demand_sequence(profile)
        if bundle.n_channels > 1:
            raise ValueError(f"bleaching under {bundle.n_channels} patterns at once, allowed: under one")
    return bundle.automaton


def left_by_state(automaton: Automaton, light: F64, law: Bleaching, pixels: int) -> F64 | None:
    """Return what bleaching has left in each state, float64 (states,), of objects of so many `pixels`; None: it depends on the walk.

    `light` (states,) is what each state sends. It does not depend on the walk where emitters mix and all walks to a state bring
    one dose, within `ONE_DOSE`; the largest counts.
    """
    if law.is_none:
        return np.ones(automaton.n_states)
    least, most = np.full((2, len(automaton.posteriors)), [[np.inf], [-np.inf]])
    least[0] = most[0] = 0.0
    for slot in range(automaton.n_slots):
        states = np.flatnonzero(automaton.depth == slot)
        for after in automaton.successors[states].T:
            np.minimum.at(least, after, least[states] + light[states])
            np.maximum.at(most, after, most[states] + light[states])
    fades, n = law.dose * pixels, automaton.n_states
    if not law.mixed or float((most - least)[:n].max()) > ONE_DOSE * fades:
        return None
    return np.asarray(np.exp(-most[:n] / fades) * mean_left(light / fades))


def patterns_met(bundle: Bundle, imaging: Imaging) -> NDArray[Any]:
    """Return the patterns in levels, (patterns, pixels), as they meet the object."""
    if imaging.is_identity:
        return bundle.pattern_levels
    return met(imaging, bundle.pattern_levels.astype(np.float64), bundle.image_shape, bundle.levels - 1.0)


_Sums = tuple[
    F64, F64, F64, F64, F64, F64
]  # clicks, photons, illumination, exposures, state 0's clicks (n,), leaves (n, leaves)


def _judged(sums: _Sums, labels: NDArray[np.int64], automaton: Automaton, leaf_labels: NDArray[np.uint16]) -> Walks:
    leaves = sums[-1]
    surprise, by_class = np.empty(len(labels)), np.zeros((automaton.n_classes, automaton.n_leaves))
    surprises = -np.log2(np.maximum(automaton.posteriors[automaton.n_states :].astype(np.float64), LEAST))
    for label in range(automaton.n_classes):
        of_class = labels == label
        surprise[of_class] = leaves[of_class] @ surprises[:, label]
        by_class[label] = leaves[of_class].sum(axis=0)
    shares = leaves @ (leaf_labels[:, None] == np.arange(automaton.n_classes)).astype(np.float64)
    right, decided = shares[np.arange(len(labels)), labels], shares.sum(axis=1)
    return Walks(right, decided, shares, *sums[:-1], surprise, by_class, automaton, leaf_labels, labels)


def _sampled(
    light: tuple[Automaton, NDArray[Any], NDArray[Any], float],
    detector: tuple[ClickLaw | CountLaw, Afterpulses],
    bleaching: Bleaching,
    trials: int,
    rng: np.random.Generator,
) -> _Sums:
    """Draw `trials` walks of every object; means per walk, and the share of each leaf.

    `light`: an automaton, patterns, objects of transmission `seen` (n, pixels), and photoelectrons per level of a pattern.
    With a time constant a walk begins with the memory that another object's left, and every walk has its own clicks for memory.
    """
    (automaton, patterns, seen, scale), (law, afterpulses) = light, detector
    n, rows, share = len(seen), np.arange(len(seen)), automaton.dwell / automaton.dwell_steps
    of_pattern = patterns.sum(axis=1, dtype=np.float64) * scale  # sent in one exposure
    steady = pattern_light(patterns, seen, scale) if bleaching.is_none else np.empty(0)
    left = np.empty(seen.shape)  # of what bleaches, less after each exposure of its own walk

    def bleached(active: NDArray[np.int64], state: NDArray[np.int64]) -> F64:
        which, of_row = np.unique(state, return_inverse=True)
        shown = patterns[automaton.pattern[which]] * (scale * share[which])[:, None]
        dose, before = bleaching.doses(shown), left[active]
        left[active] = before * np.exp(-dose)[of_row]
        return np.asarray(np.einsum("kp,kp->k", before, (shown * mean_left(dose))[of_row]))

    sums, leaves = np.zeros((5, n)), np.zeros((n, automaton.n_leaves))
    memory = np.zeros((2, n))
    for trial in range(-BEGIN_ROUNDS if afterpulses.time else 0, trials):
        if trial == 0:
            sums[:], leaves[:] = 0.0, 0.0
        node, active = np.zeros(n, np.int64), rows
        memory = rng.permutation(memory, axis=1) if afterpulses.time else np.zeros((2, n))
        if not bleaching.is_none:
            left[:] = seen
        for slot in range(automaton.n_slots):
            if not active.size:
                memory = afterpulses.in_the_dark(memory)
                continue
            state = node[active]
            displayed, part = automaton.rows[state], share[state]
            sent = of_pattern[displayed].sum(axis=1) * part
            if not bleaching.is_none:
                photoelectrons = bleached(active, state)
            elif automaton.channels > 1:
                photoelectrons = steady[active[:, None], displayed] * part[:, None]
            else:
                photoelectrons = steady[active, displayed[:, 0]] * part
            clicks = outcome = _drawn(law, photoelectrons, afterpulses.sight(memory[:, active]), rng)
            if automaton.channels > 1:
                clicks, outcome = outcome.sum(axis=1), outcome @ (1 << np.arange(automaton.channels))
                photoelectrons = photoelectrons.sum(axis=1)
            if afterpulses and isinstance(law, ClickLaw):
                known = afterpulses.after(-log_no_click(law, photoelectrons), memory[:, active], outcome)
                memory = afterpulses.in_the_dark(memory)
                memory[:, active] = known
            each: tuple[Any, ...] = (clicks, photoelectrons, sent, 1.0, (clicks > 0) & (slot == 0))
            for total, values in zip(sums, each):
                total[active] += values
            node[active] = automaton.successors[state, outcome]
            active = active[node[active] < automaton.n_states]
        leaves[rows, node - automaton.n_states] += 1.0
    sums /= trials
    return sums[0], sums[1], sums[2], sums[3], sums[4], leaves / trials


def _drawn(law: ClickLaw | CountLaw, light: F64, sight: F64, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw the outcome of each exposure (n,), of several channels their clicks (n, channels).

    `sight` (n,) is what afterpulses add to -log of silence.
    """
    if isinstance(law, CountLaw):
        passed = rng.random(light.size) >= np.cumsum(count_chances(law, light)[:-1], axis=0)
        return np.asarray(passed.sum(axis=0), np.int64)
    probability = click_probability(law, light)
    if light.ndim == 1:
        probability -= (1 - probability) * np.expm1(-sight)
    return np.asarray(rng.random(light.shape) < probability, np.int64)


def measured_walks(walks: Walks) -> MeasuredWalks:
    """Return the means of `walks`."""
    n, decided = len(walks.right), float(walks.decided.sum())
    accuracy = float(walks.right.sum()) / decided if decided else 0.0
    # the ratio's error by its derivative: of each object right - accuracy * decided, whose mean is 0
    excess = walks.right - accuracy * walks.decided
    # its variance within one walk
    per_walk = walks.right * (1 - 2 * accuracy) + accuracy**2 * walks.decided - excess**2
    return MeasuredWalks(
        accuracy_mean=accuracy if decided else None,
        accuracy_std=math.sqrt(max(float(per_walk.sum()), 0.0)) / decided if decided else None,
        accuracy_se_objects=math.sqrt(float((excess**2).sum()) * n / max(n - 1, 1)) / decided if decided else None,
        clicks_mean=float(walks.clicks.mean()),
        photons_mean=float(walks.photons.mean()),
        illumination=float(walks.illumination.mean()),
        exposures_mean=float(walks.exposures.mean()),
        expected_calibration_error=calibration_error(calibration_bins(walks)) if decided else None,
        abstained=0.0 if (walks.leaf_labels != NO_LABEL).all() else 1.0 - decided / n,
        objects=n,
        trials=walks.trials,
        by_class=among_classes(walks.right, walks.labels, walks.classes, walks.decided) if walks.classes else None,
        first_state_clicked=float(walks.first_clicked.mean()),
        **conveyed(walks.surprise, walks.labels, walks.photons, walks.illumination),
    )


def calibration_bins(walks: Walks) -> list[CalibrationBin]:
    """Return what becomes of decisions by their probability, in bins of equal width; empty ones are left out."""
    decides = walks.leaf_labels != NO_LABEL
    leaves = np.flatnonzero(decides)
    mass = walks.by_class[:, leaves].sum(axis=0)
    right = walks.by_class[walks.leaf_labels[leaves], leaves]
    probability = walks.automaton.posteriors[walks.automaton.n_states + leaves].max(axis=1).astype(np.float64)
    place = np.minimum((probability * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)
    whole = float(mass.sum()) or 1.0
    share, stated, found = (np.bincount(place, one) / whole for one in (mass, mass * probability, right))
    kept = np.flatnonzero(share)
    columns = share[kept], stated[kept] / share[kept], found[kept] / share[kept]
    return [CalibrationBin(*one) for one in np.stack(columns, axis=1).tolist()]


def calibration_error(bins: list[CalibrationBin]) -> float:
    """Return the expected calibration error: the mean distance of probability and accuracy over the bins, by their shares."""
    return sum(one.share * abs(one.probability - one.accuracy) for one in bins)


def confusion_of(walks: Walks) -> F64:
    """Return how often, in expectation, truth (rows) is decided as what (columns), float64 (classes, classes)."""
    labels, n_classes = walks.leaf_labels, walks.automaton.n_classes
    return np.stack([walks.by_class[:, labels == label].sum(axis=1) for label in range(n_classes)], axis=1)


def expected_figures(found: MeasuredWalks, profile: str, task: str, split: str) -> dict[str, Any]:
    """Return exact figures as a bundle keeps them (`with_expected`); ValueError for sampled ones."""
    if found.trials:
        raise ValueError("sampled figures are no expectation")
    conditions: dict[str, Any] = {"profile": profile, "task": task, "split": split, "objects": found.objects}
    conditions |= {"accuracy": found.accuracy_mean, "clicks": found.clicks_mean, "photons": found.photons_mean}
    conditions |= {"illumination": found.illumination, "exposures": found.exposures_mean}
    return conditions | {"first_state_clicked": found.first_state_clicked}


def walk_payload(walks: Walks) -> dict[str, Any]:
    """Return the calibration and the figures of the first objects, for `--json`."""
    first = None
    if len(walks.right) > FIRST_OBJECTS:
        first = asdict(measured_walks(walks.first(FIRST_OBJECTS)))
        del first["expected_calibration_error"]  # of so few objects it is mostly noise
    bins = [asdict(one) for one in calibration_bins(walks)]
    return {"exposures_longest": walks.automaton.n_slots, "calibration": bins, f"first_{FIRST_OBJECTS}": first}
