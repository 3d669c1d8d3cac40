"""Accuracy against photons: what fixed patterns decide on held-out objects through a profile's optics and detector.

`light_of` shows the patterns, `evaluate_exactly` and `evaluate_sampled` decide. The spread over repeated trials (shot noise) and the spread
over objects (a different test set) are kept apart. SIMULATED figures: the click law of the profile, no instrument. No torch.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import as_usage_error
from pans.base.files import likeness
from pans.bundle.backends import PictureDecider, make_decider
from pans.bundle.sensor import Bundle
from pans.instrument.click_law import (
    ClickLaw,
    CountLaw,
    cannot_count,
    cannot_read_at_once,
    click_probability,
    count_chances,
    count_law,
    object_transmission,
)
from pans.instrument.detector import Kernel, afterpulses_of, crosstalk_of, fired, seen_from_own, with_crosstalk
from pans.instrument.optics import IDENTITY, NO_BLEACHING, Bleaching, Imaging, bleached, met
from pans.instrument.profile import Profile
from pans_trainer.figures import Result
from pans_trainer.model.exposure import exposure_us_of
from pans_trainer.options import Conditions

from .information import Conveyed, conveyed, surprises
from .readings import Chain, Numbers, outcome_probabilities, vector_chances

EXACT_OUTCOMES_MAX = 1 << 20  # count vectors that an exact evaluation may enumerate
MAJORITY_SE = 2.0  # standard errors that a sensor must be above the largest class
MAJORITY_ROUNDING = 1e-9  # sums of chances round
_CHUNK_NUMBERS = 1 << 22  # numbers per piece of work, so that memory stays small

F64 = NDArray[np.float64]


AS_IT_IS = Conditions()


@dataclass(frozen=True, slots=True)
class ByClass:
    """How the decisions fall among the classes, and whether they tell more than always naming the largest one."""

    majority_class: str  # the class with most of the objects
    majority_share: float  # the accuracy of always naming it
    above_majority: float  # the accuracy beyond that
    above_majority_se: float  # its standard error over the objects, of paired differences
    better_than_majority: bool  # by more than two standard errors
    balanced_accuracy: float  # mean of the recalls
    recall: dict[str, float | None]  # None of a class without objects, or without decisions


def among_classes(
    right: F64, labels: NDArray[np.int64], classes: tuple[str, ...], decided: F64 | None = None
) -> ByClass | None:
    """Return how decisions that are `right` with these chances (n,) fall among `classes`; None where there are no decisions.

    `decided` (n,) are the chances that there is a decision at all, by default 1.
    """
    decided = np.ones(len(right)) if decided is None else decided
    whole, n = float(decided.sum()), len(right)
    if not whole:
        return None
    weights = np.bincount(labels, decided, len(classes))
    found = np.bincount(labels, right, len(classes))
    largest = int(weights.argmax())
    gain = right - decided * (labels == largest)
    above = float(gain.sum()) / whole
    rest = gain - above * decided
    error = math.sqrt(float((rest**2).sum()) * n / max(n - 1, 1)) / whole
    recall = {
        name: float(found[label] / weights[label]) if weights[label] else None for label, name in enumerate(classes)
    }
    known = [share for share in recall.values() if share is not None]
    return ByClass(
        majority_class=classes[largest],
        majority_share=float(weights[largest]) / whole,
        above_majority=above,
        above_majority_se=error,
        better_than_majority=above > MAJORITY_SE * error and above > MAJORITY_ROUNDING,
        balanced_accuracy=sum(known) / len(known),
        recall=recall,
    )


@dataclass(frozen=True, slots=True)
class Measured(Conveyed):
    """Means per decision. `accuracy_std` is the spread over trials, `accuracy_se_objects` the error from having few objects."""

    accuracy_mean: float
    accuracy_std: float
    accuracy_se_objects: float
    clicks_mean: float
    photons_mean: float
    illumination: float
    objects: int
    trials: int  # 0: exact, no trials were needed
    shots: int = 1
    by_class: ByClass | None = None


def means_of(
    right: F64, spread: float, clicks: float, photons: F64, illumination: float, *, trials: int = 0, **more: Any
) -> Measured:
    """Return the means of objects that are decided `right` with these chances, (n,), and give `photons` (n,); `more` as in `Measured`."""
    n = len(right)
    return Measured(
        accuracy_mean=float(right.mean()),
        accuracy_std=spread,
        accuracy_se_objects=float(right.std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0,
        clicks_mean=clicks,
        photons_mean=float(photons.mean()),
        illumination=illumination,
        objects=n,
        trials=trials,
        **more,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """What was decided: `right` (trials, objects), the readouts' clicks, expected photons and true labels, each (objects,)."""

    right: NDArray[np.bool_]
    clicks: F64
    photons: F64
    illumination: float
    labels: NDArray[np.int64] | None = None
    surprise: F64 | None = None  # -log2 of the true label's posterior, (objects,); None without one

    def measured(self, first: int | None = None) -> Measured:
        """Return means over the first `first` objects (default: all), with the spread over trials and over objects apart.

        `clicks_mean` counts readouts with at least one photon, for a counting detector too: what a binary one would report.
        """
        right, photons, light = self.right[:, :first], self.photons[:first], self.illumination
        spread = float(right.mean(axis=1).std(ddof=1)) if len(right) > 1 else 0.0
        known: dict[str, Any] = {}
        if self.surprise is not None and self.labels is not None:
            known = conveyed(self.surprise[:first], self.labels[:first], photons, light)
        clicks = float(self.clicks[:first].mean())
        return means_of(right.mean(axis=0), spread, clicks, photons, light, trials=len(right), **known)


def row_of(measured: Any) -> dict[str, Any]:
    """Return figures (Measured, or those of walks) as a row of a table: without the ones by class."""
    return {name: value for name, value in asdict(measured).items() if name != "by_class"}


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """What reaches the detector: photoelectrons per exposure, float64 (objects, d_f), and the law that turns them to clicks.

    `probability` holds afterpulses and crosstalk in the mean, where the profile states them; word by word afterpulses are in
    runtime/pans/instrument/detector/afterpulses.py. Of photon numbers it is the mean number.
    """

    photoelectrons: F64
    probability: F64
    law: ClickLaw | CountLaw
    illumination: float  # of one shot
    chain: Chain | None = None  # what links exposures: None without afterpulses
    numbers: Numbers | None = None  # of a bundle that takes photon numbers
    crosstalk: Kernel = ()
    own: F64 | None = None  # of a click without crosstalk, where there is some

    @property
    def chances(self) -> F64:
        """P(reading) of every exposure by itself, float64 (objects, d_f, outcomes): of no click and a click, or of photon numbers."""
        if self.numbers is not None:
            return self.numbers.chances
        return np.stack([1 - self.probability, self.probability], axis=2)

    def counts(self, shots: int, rng: np.random.Generator, rows: slice = slice(None)) -> NDArray[np.int64]:
        """Draw the clicks of `shots` exposures of every pattern, int64 (objects, d_f), for the objects in `rows`."""
        if self.numbers is not None:
            return self.numbers.counts(shots, rng, rows)
        if self.own is not None:
            own = self.own[rows]
            counts = np.zeros(own.shape, np.int64)
            for _ in range(shots):
                counts += fired(rng.random(own.shape) < own, self.crosstalk, rng)
            return counts
        if self.chain is None:
            return rng.binomial(shots, self.probability[rows])
        return self.chain.counts(shots, rng, rows)


def light_of(
    bundle: Bundle,
    profile: Profile,
    images: NDArray[np.uint8],
    *,
    eta: float = 1.0,
    dark: float | None = None,
    imaging: Imaging = IDENTITY,
    bleaching: Bleaching = NO_BLEACHING,
) -> Light:
    """Show the patterns of `bundle` on `images` (n, height, width) through `profile`, or look at them through its passive optics.

    `eta` scales the light, `dark` replaces the profile's dark photoelectrons per exposure, `imaging` is how the object stands on the
    grid of the patterns, `bleaching` what the light does to it: patterns are shown in their order, once. ValueError for images of
    another shape, for an `imaging` of passive optics, and for bleaching where no pattern follows another.
    """
    if images.shape[1:] != bundle.image_shape:
        raise ValueError(f"images are {images.shape[1:]}, allowed with {bundle.name}: {bundle.image_shape}")
    if bundle.automaton is not None:
        raise ValueError(f"{bundle.name} has an automaton: what it shows depends on the clicks (walks.walks_of)")
    law = outcome_law_of(bundle, profile, eta, dark)
    if bundle.analyser is not None:
        if not (imaging.is_identity and bleaching.is_none):
            raise ValueError(f"{bundle.name} is passive: it shows no patterns that could miss or bleach the object")
        with as_usage_error():
            light = bundle.analyser.photoelectrons(images) * eta
        return _lit(light, law, 0.0, profile, bundle)
    patterns, illumination = bundle.patterns() * eta, bundle.illumination() * eta
    if not imaging.is_identity:
        full = bundle.photons_per_level * (bundle.levels - 1) * eta
        patterns = met(imaging, patterns, bundle.image_shape, full)
        illumination = float(patterns.sum())
    if not bleaching.is_none:
        demand_sequence(profile)
        patterns = bleached(bleaching, patterns)
    light = np.empty((len(images), bundle.n_features))
    step = max(1, _CHUNK_NUMBERS // bundle.n_pixels)
    for start in range(0, len(images), step):
        part = images[start : start + step]
        light[start : start + step] = object_transmission(profile, part.reshape(len(part), -1)) @ patterns.T
    return _lit(light, law, illumination, profile, bundle)


def _lit(light: F64, law: ClickLaw | CountLaw, illumination: float, profile: Profile, bundle: Bundle) -> Light:
    """Passive detectors click at once, each with traps of its own, which objects pass one after the other: as without afterpulses."""
    if isinstance(law, CountLaw):
        numbers = Numbers(np.moveaxis(count_chances(law, light), 0, -1))
        return Light(light, numbers.mean(), law, illumination, numbers=numbers)
    first = click_probability(law, light)
    afterpulses = afterpulses_of(profile, exposure_of(bundle, profile))
    if kernel := crosstalk_of(profile):
        return Light(light, with_crosstalk(first, kernel), law, illumination, crosstalk=kernel, own=first)
    if not afterpulses or profile.mode == "parallel":
        return Light(light, first, law, illumination)
    chain = Chain.of(first, afterpulses)
    return Light(light, chain.mean_chances(), law, illumination, chain)


def demand_sequence(profile: Profile) -> None:
    """Raise ValueError where `profile` shows all patterns at once: there no dose comes before another."""
    if profile.mode != "sequential":
        what = f"{profile.name} shows all patterns at once ({profile.mode}), allowed with a dose: profiles that show pattern after pattern"
        raise ValueError(what)


def exposure_of(bundle: Bundle, profile: Profile) -> float:
    """Return the exposure time of `bundle` on `profile`, microseconds."""
    if bundle.analyser is not None:
        return bundle.analyser.exposure_us
    return exposure_us_of(profile, bundle.photons_per_level * (bundle.levels - 1))


def outcome_law_of(
    bundle: Bundle, profile: Profile, eta: float = 1.0, dark: float | None = None
) -> ClickLaw | CountLaw:
    """Return the law of one exposure of `bundle` on `profile`, of clicks or photon numbers; `dark` photoelectrons replace the profile's.

    ValueError for an `eta` or `dark` that is not finite or below 0, and for a profile that cannot tell so many photon numbers apart, or
    read so many channels at once.
    """
    if not (0 <= eta < math.inf and (dark is None or 0 <= dark < math.inf)):
        raise ValueError(f"eta is {eta:g}, dark is {dark}, allowed: finite and at least 0")
    outcomes, channels = bundle.largest + 1, bundle.n_channels
    why = cannot_count(profile, outcomes) or (cannot_read_at_once(profile, channels) if channels > 1 else "")
    if why:
        raise ValueError(f"{bundle.name} needs {why}")
    return count_law(profile, exposure_of(bundle, profile), outcomes, dark)


def evaluate_exactly(bundle: Bundle, light: Light, labels: NDArray[np.int64], *, shots: int = 1) -> Measured:
    """Enumerate all count vectors, (shots + 1)**d_f of clicks: the expected accuracy without trials.

    `accuracy_std` is then the exact spread that trials over these objects would show.
    """
    scores = _scores_of_all(bundle, shots)
    right, surprise = (
        _expected(bundle, light, of_outcome, shots)[np.arange(len(labels)), labels]
        for of_outcome in (_decided(scores), surprises(scores))
    )
    right = np.clip(right, 0.0, 1.0)
    over_trials = math.sqrt(float((right * (1 - right)).sum())) / len(labels)
    photons, illumination = shots * light.photoelectrons.sum(axis=1), light.illumination * shots
    return means_of(
        right,
        over_trials,
        shots * float(light.probability.sum()) / len(right),
        photons,
        illumination,
        shots=shots,
        by_class=among_classes(right, labels, bundle.classes),
        **conveyed(surprise, labels, photons, illumination),
    )


def decision_shares(bundle: Bundle, light: Light, trials: int | None = None, seed: int = 0) -> F64:
    """Return P(decided class | object) of one shot, float64 (n, classes): by enumeration of all words, or the shares of `trials`."""
    if trials is None:
        return np.clip(_expected(bundle, light, _decided(_scores_of_all(bundle, 1)), 1), 0.0, 1.0)
    decider, rng = make_decider(bundle), np.random.default_rng(seed)
    objects = np.arange(len(light.probability))
    decided = np.zeros((len(objects), bundle.n_classes), np.int64)
    for _ in range(trials):
        decided[objects, decider.decide_batch(light.counts(1, rng), 1)] += 1
    return decided / trials


def _decided(scores: NDArray[np.float32]) -> F64:
    return np.eye(scores.shape[1])[scores.argmax(axis=1)]


def _scores_of_all(bundle: Bundle, shots: int) -> NDArray[np.float32]:
    """Scores of every count vector; pattern 0 varies fastest."""
    base = shots * bundle.largest + 1
    outcomes = base**bundle.n_features
    if outcomes > EXACT_OUTCOMES_MAX:
        raise ValueError(
            f"{shots} shots of {bundle.n_features} patterns have {outcomes} outcomes, allowed: {EXACT_OUTCOMES_MAX} "
            "(sample trials instead)"
        )
    digits = base ** np.arange(bundle.n_features)
    counts = (np.arange(outcomes)[:, None] // digits) % base
    return make_decider(bundle, shots=shots).scores_batch(counts, shots)


def _expected(bundle: Bundle, light: Light, of_outcome: F64, shots: int) -> F64:
    """The mean of `of_outcome` (count vectors, m) over the readings of each object, (n, m)."""
    chances, one_shot = light.probability, shots == 1
    if light.own is not None and one_shot:
        chances, of_outcome = light.own, seen_from_own(of_outcome, bundle.n_features, light.crosstalk)
    found = np.empty((len(light.probability), of_outcome.shape[1]))
    step = max(1, _CHUNK_NUMBERS // len(of_outcome))
    for start in range(0, len(found), step):
        part = slice(start, start + step)
        if light.numbers is not None:
            found[part] = vector_chances(light.numbers.sums(shots, part)) @ of_outcome
        elif light.chain is not None and one_shot:
            found[part] = light.chain.word_chances(part) @ of_outcome
        else:  # of several shots, afterpulses and crosstalk are in the mean
            found[part] = outcome_probabilities(chances[part], shots) @ of_outcome
    return found


def evaluate_sampled(
    bundle: Bundle, light: Light, labels: NDArray[np.int64], *, shots: int = 1, trials: int = 30, seed: int = 0
) -> Measured:
    """Sample `trials` independent decisions per object, each from `shots` shots."""
    decider, rng, n = make_decider(bundle, shots=shots), np.random.default_rng(seed), len(labels)
    right, clicks, surprise = np.empty((trials, n), bool), np.zeros(n), np.zeros(n)
    for trial in range(trials):
        counts = light.counts(shots, rng)
        clicks += counts.sum(axis=1) / trials
        scores = decider.scores_batch(counts, shots)
        right[trial] = scores.argmax(axis=1) == labels
        surprise += surprises(scores)[np.arange(n), labels] / trials
    photons = shots * light.photoelectrons.sum(axis=1)
    found = Trials(right, clicks, photons, light.illumination * shots, labels, surprise).measured()
    return replace(found, shots=shots, by_class=among_classes(right.mean(axis=0), labels, bundle.classes))


@dataclass(frozen=True, slots=True)
class MeasuredPictures(Result):
    """Means per picture returned. `ssim_std` is the spread over trials, `ssim_se_objects` the error from having few objects."""

    ssim_mean: float
    ssim_std: float
    ssim_se_objects: float
    mse_mean: float
    clicks_mean: float
    photons_mean: float
    illumination: float
    objects: int
    trials: int
    shots: int


def evaluate_pictures(
    bundle: Bundle, light: Light, images: NDArray[np.uint8], *, shots: int = 1, trials: int = 1, seed: int = 0
) -> MeasuredPictures:
    """Give back `trials` pictures of every object from `shots` shots and compare them with its image, uint8 (n, height, width)."""
    decider = PictureDecider(bundle)
    rng = np.random.default_rng(seed)
    likes, of_trial, squares, clicks = np.zeros(len(images)), np.empty(trials), 0.0, 0
    step = max(1, _CHUNK_NUMBERS // (64 * bundle.n_outputs))
    for trial in range(trials):
        found = np.empty(len(images))
        for start in range(0, len(images), step):
            counts = light.counts(shots, rng, slice(start, start + step))
            clicks += int(counts.sum())
            alike = likeness(decider.pictures(counts, shots), images[start : start + step])
            found[start : start + step] = alike.ssim
            squares += float(alike.mse.sum())
        likes += found
        of_trial[trial] = found.mean()
    n = len(images)
    return MeasuredPictures(
        ssim_mean=float(likes.mean()) / trials,
        ssim_std=float(of_trial.std(ddof=1)) if trials > 1 else 0.0,
        ssim_se_objects=float((likes / trials).std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0,
        mse_mean=squares / (n * trials),
        clicks_mean=clicks / (n * trials),
        photons_mean=shots * float(light.photoelectrons.sum()) / n,
        illumination=light.illumination * shots,
        objects=n,
        trials=trials,
        shots=shots,
    )
