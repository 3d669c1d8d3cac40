"""What is chosen from a user's own images: how they are varied, the encoder, the size of the training; each rule with its reason.

The rules were chosen on held-back parts of made-up folders of 300 to 3000 images (docs/measurements/index.md). A kind of change is right
when it makes the left-out images of a class more likely: each try computes the exact posterior of direct imaging with changed copies of the
other images as the world, and the mean log-loss on photon frames of the left-out images is compared. That takes seconds, and no network.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.instrument.click_law import click_law
from pans.instrument.profile import Profile
from pans_trainer.baselines.bayes import log_joint
from pans_trainer.baselines.common import detect, measure
from pans_trainer.tasks.changes import Variation, enlarged, varied
from pans_trainer.tasks.registry import Objects, Task

from .results import F64, balanced

OBJECTS = 8000  # training images with their varied copies, at most: more took longer and gained little
OBJECTS_PER_IMAGE = 16  # and of few images as many
PIXELS_MAX = 1 << 24  # of all of them: what trains within minutes on one core
# what a camera detects of a decision's budget of light, where none is asked for: the least that tells enough
PHOTONS = (10.0, 20.0, 40.0)
TOLD = 0.25  # of the way from chance to certainty is what a camera must tell of left-out images
LEAST_TOLD = 0.02  # less is chance
LEAST_GREY = 1e-3  # mean transmission: of darker images the budget would be without bound
EXPOSURES, STATES = 32, 128  # of an automaton trained on so few images; more states learn them by heart
FEW_STATES = 64  # where a class is so small that five sensors are trained, each in a third of the time
EXPOSURES_PER_PHOTON = 1.2  # more exposures for more light
# nats per photoelectron of the first exposure, at most; and so many times what a camera learns from one
FIRST_PRICE = 0.2
PUBLIC_NATS = 1.1  # that a camera learns of the public sets at 10 photons, for which prices of light were found
PRICE_OF_TOLD = 2.0  # dearer light stays off where bright objects tell little, and no training turns it on again
STEPS_PER_EPOCH = 40  # fewer steps than that hardly move the patterns
BATCH = (50, 500)
FEATURES = 10  # fixed patterns where none are asked for
FIXED_STEPS = 3000  # of a training of fixed patterns
FIXED_EPOCHS = (20, 400)
KEPT_PART = 12  # one in twelve training images chooses and calibrates, and has no copies
FEW_PER_CLASS = 30
UNEQUAL = 5.0  # times as many images in one class as in another
TRIES: dict[str, tuple[Any, ...]] = {  # one after the other: the best of each goes into the next
    "turn_deg": (8.0, 25.0, 180.0),
    "shift": (0.04, 0.1),
    "size": (0.1, 0.2),
    "mirror_x": (True,),
    "mirror_y": (True,),
    "stretch": (0.15,),
    "bend": (0.02,),
}
# times the light of a decision: shapes count, but a left-out image need not be matched pixel by pixel
FRAMES_LIGHT = 2.0
WORLD = 5000  # images of the world, changed copies included
LEFT_OUT_PART = 5
LEFT_OUT_MAX = 400
FRAMES = 400  # of all left-out images, several of each where they are few
LOSS_MAX = 4.0  # nats: one photon where no image of the class has light must not outweigh all others
FLOOR = 5e-3  # least transmission in the posterior
GAIN_SE = 0.5  # standard errors, over the images, of the mean gain that a change must bring
# of which the least is taken unless it clearly costs: else few images are learnt by heart
MILD = frozenset(("turn_deg", "shift", "size"))
STEP_SE = 1.0  # and a larger one beyond a smaller: needless turns cost the sensor 5 points of `shapes`


@dataclass(frozen=True, slots=True)
class Recipe:
    """What was chosen for a folder of images, and why, one sentence each."""

    encoder: str  # automaton, or active for fixed patterns
    objects: int  # training images with their varied copies
    kept: int  # the last training images, without copies
    photons: float
    illumination: float  # which brings a camera so many
    batch: int
    epochs: int
    reasons: tuple[str, ...]
    exposures: int = 0
    states: int = 0
    features: int = 0
    first_price: float = FIRST_PRICE
    price: float = 1.0


def choose_encoder(profile: Profile) -> tuple[str, str]:
    """Return the encoder for a user's own images, and the reason: an automaton wherever the profile can show one."""
    if profile.mode == "sequential":
        why = "an automaton: at equal photons it decides better than fixed patterns (--encoder active for those)"
        return "automaton", why
    return "active", f"fixed patterns: {profile.name} is a {profile.mode} profile, an automaton needs a sequential one"


@dataclass(frozen=True, slots=True)
class Light:
    """The light of a decision: what a camera detects of it, and the nats that it learns."""

    photons: float
    nats: float

    @property
    def prices(self) -> dict[str, Any]:
        """What light may cost: options of an automaton."""
        first = min(FIRST_PRICE, PRICE_OF_TOLD * self.nats / self.photons)
        return {"first_price": first, "price": min(1.0, self.nats / PUBLIC_NATS)}


PLAIN_LIGHT = Light(PHOTONS[0], PUBLIC_NATS)


def choose_training(task: Task, variation: Variation, encoder: str, light: Light = PLAIN_LIGHT) -> Recipe:
    """Return the training of `encoder` for a user's own images; what the user asks for takes the place of what is here."""
    n, pixels = len(task.train), math.prod(task.image_shape)
    kept = max(1, n // KEPT_PART)
    objects = n if variation == Variation() else max(n, min(OBJECTS, OBJECTS_PER_IMAGE * n, PIXELS_MAX // pixels))
    budget = light.photons, float(f"{light.photons / max(task.train.images.mean() / 255, LEAST_GREY):.2g}")
    exposures, states = max(EXPOSURES, round(EXPOSURES_PER_PHOTON * light.photons)), STATES
    if np.bincount(task.train.labels).min() < FEW_PER_CLASS:
        exposures, states = EXPOSURES, FEW_STATES
    batch = min(BATCH[1], max(BATCH[0], objects // STEPS_PER_EPOCH))
    reasons = [
        f"{objects} training images from {n}: {variation}; with these changes left-out images were at least as likely as without"
    ]
    if variation == Variation():
        reasons = [f"{n} training images as they are: every change of them made left-out images less likely"]
    if encoder == "automaton":
        reasons.append(f"{exposures} exposures of at most {states} states: more would learn so few images by heart")
        made = Recipe(encoder, objects, kept, *budget, batch, 6, tuple(reasons), exposures, states)
        return replace(made, **light.prices)
    epochs = min(FIXED_EPOCHS[1], max(FIXED_EPOCHS[0], math.ceil(FIXED_STEPS * batch / objects)))
    reasons.append(f"{epochs} epochs in batches of {batch}: about {epochs * objects // batch} steps")
    return Recipe(encoder, objects, kept, *budget, batch, epochs, tuple(reasons), features=FEATURES)


def as_trained_on(task: Task, provenance: Mapping[str, Any]) -> Task:
    """Return `task` with the changed copies on which a bundle of that provenance was trained; as it is where there were none."""
    found, options = provenance.get("variation"), provenance.get("options")
    if not (isinstance(found, Mapping) and isinstance(options, Mapping)) or provenance["data_sha256"] != task.sha256:
        return task
    sizes = {name: found[name] for name, tried in TRIES.items() if found.get(name) in tried}
    variation = Variation(**sizes)
    recipe = choose_training(task, variation, "automaton")  # of whose size here nothing depends on the encoder
    equal = provenance.get("equal_classes") is True
    return enlarged(task, variation, recipe.objects, recipe.kept, int(options["seed"]), equal=equal)


def warnings_of(task: Task, profile: Profile, recipe: Recipe, clicks: float | None) -> Iterator[str]:
    """Yield what the user should know before the training: too few images, unequal classes, a budget out of reach."""
    yield from class_warnings(task)
    dark = click_law(profile, profile.exposure.min_us).dark_per_exposure * (recipe.exposures or recipe.features)
    budget = recipe.photons if clicks is None else clicks
    if dark > budget / 2:
        yield (
            f"dark counts alone bring about {dark:.2g} clicks per decision on {profile.name}, the budget is {budget:g}: ask for "
            "more light, or for fewer exposures"
        )


def class_warnings(task: Task) -> Iterator[str]:
    """Yield what is wrong with the sizes of the classes: too few images of one, very unequal ones, few held-out images."""
    counts = np.bincount(task.train.labels, minlength=len(task.classes))
    fewest, most = int(counts.argmin()), int(counts.argmax())
    if counts[fewest] < FEW_PER_CLASS:
        yield (
            f"class {task.classes[fewest]!r} has {counts[fewest]} training images, wanted are {FEW_PER_CLASS} or more: the accuracy on "
            "new images is uncertain"
        )
    if counts[most] > UNEQUAL * counts[fewest]:
        yield (
            f"class {task.classes[most]!r} has {counts[most]} training images, {task.classes[fewest]!r} has {counts[fewest]}: every class "
            "counts the same in training unless --keep-shares is given, so look at the balanced accuracy"
        )
    error = 0.5 / math.sqrt(len(task.test))
    if error > 0.05:
        yield f"{len(task.test)} held-out images: the standard error of the accuracy is up to {100 * error:.0f} points"


@dataclass(frozen=True, slots=True)
class Choice:
    """The changes chosen, and the log-loss (nats) of left-out images without and with them."""

    variation: Variation
    loss_before: float
    loss: float
    light: Light  # at which left-out images can be told


def choose_variation(task: Task, seed: int = 0) -> Choice:
    """Return the light that the images need, and the changes that serve the training images of `task` best; none where none helps."""
    judge = _Judge(task, seed)
    for photons in PHOTONS:
        told = max(LEAST_TOLD, judge.told(photons))
        if told >= TOLD:
            break
    judge.photons = FRAMES_LIGHT * photons
    best = Variation()
    losses = before = judge.losses(best)
    for name, sizes in TRIES.items():
        won = None
        for size in sizes:
            changed = replace(best, **{name: size})
            found = judge.losses(changed)
            gain, error = balanced((losses if won is None else won[1]) - found, judge.labels)
            mild = name in MILD and size == sizes[0]
            if gain > (-GAIN_SE if mild else GAIN_SE if won is None else STEP_SE) * error:
                won = changed, found
        if won is not None:
            best, losses = won
    means = [balanced(values, judge.labels)[0] for values in (before, losses)]
    return Choice(best, means[0], means[1], Light(photons, told * math.log(len(task.classes))))


class _Judge:
    """The left-out images, photon frames of each, and the images from which a world is made: of few images several parts in turn."""

    def __init__(self, task: Task, seed: int) -> None:
        n = len(task.train)
        n_out = max(1, min(LEFT_OUT_MAX, n // LEFT_OUT_PART))
        turns = min(LEFT_OUT_PART, n // n_out, -(-LEFT_OUT_MAX // n_out))
        places = np.arange(n)
        self.task, self.seed = task, seed
        self.parts = [places[n - (turn + 1) * n_out : n - turn * n_out] for turn in range(turns)]
        self.known = [np.delete(places, part)[:WORLD] for part in self.parts]
        self.labels = np.concatenate([task.train.labels[part] for part in self.parts])
        self.frames = -(-FRAMES // len(self.labels))
        self.photons = FRAMES_LIGHT * PHOTONS[0]

    def told(self, photons: float) -> float:
        """Return how far from chance (0) to certainty (1) the recalls of left-out images are, on average, at so many photons."""
        self.photons, chance = photons, 1 / len(self.task.classes)
        # few images alone would tell too little
        mild = Variation(**{name: TRIES[name][0] for name in MILD if name in TRIES})
        right = [self._joint(*part, mild)[1] for part in zip(self.parts, self.known)]
        return (balanced(np.concatenate(right), self.labels)[0] - chance) / (1 - chance)

    def losses(self, variation: Variation) -> F64:
        """Return -log P(true class | frame), the mean over frames of every left-out image, in a world of changed images, (images,)."""
        return np.concatenate([self._joint(*part, variation)[0] for part in zip(self.parts, self.known)])

    def _joint(self, out: NDArray[np.int64], of_world: NDArray[np.int64], variation: Variation) -> tuple[F64, F64]:
        """The losses, and shares of right decisions, of the left-out images `out` in a world of the images `of_world`."""
        known, left_out = self.task.train.take(of_world), self.task.train.take(out)
        copies = 0 if variation == Variation() else max(1, WORLD // min(2, len(self.parts)) // len(known))
        images = [known.images, *(varied(known.images, variation, [self.seed, copy]) for copy in range(copies))]
        world = Objects(np.concatenate(images), np.tile(known.labels, copies + 1))
        measured = measure(replace(self.task, train=world, test=left_out), None)
        light = np.repeat(measured.photoelectrons(measured.test, self.photons), self.frames, axis=0)
        frames = detect(light, "counting", np.random.default_rng([self.seed, 3]))
        joint = log_joint(measured, frames, self.photons, "counting", floor=FLOOR)
        joint -= np.log(np.maximum(1, np.bincount(world.labels, minlength=joint.shape[1])))  # every class is as likely
        joint -= np.logaddexp.reduce(joint, axis=1, keepdims=True)
        labels = np.repeat(left_out.labels, self.frames)
        losses = np.minimum(-joint[np.arange(len(frames)), labels], LOSS_MAX)
        right = (joint.argmax(axis=1) == labels).astype(np.float64)
        return losses.reshape(-1, self.frames).mean(axis=1), right.reshape(-1, self.frames).mean(axis=1)
