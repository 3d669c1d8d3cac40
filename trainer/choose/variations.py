"""Which changes leave the class of an image as it is: asked of the images themselves, not of the user.

Owns the kinds and sizes that are tried, and the way they are judged; never trains. A kind of change is right when it makes the left-out
images of a class more likely: each try computes the exact posterior of direct imaging (package baselines) with changed copies of the
other images as the world, and the mean log-loss on photon frames of the left-out images is compared. That takes seconds, and no network.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.trainer.baselines.bayes import log_joint
from pans.trainer.baselines.common import detect, measure
from pans.trainer.tasks.registry import Objects, Task
from pans.trainer.tasks.variation import Variation, varied

TRIES: tuple[dict[str, Any], ...] = (  # one after the other: the best of each goes into the next
    {"turn_deg": (8.0, 25.0, 180.0)},
    {"shift": (0.04, 0.1)},
    {"size": (0.1, 0.2)},
    {"mirror_x": (True,)},
    {"mirror_y": (True,)},
    {"stretch": (0.15,)},
    {"bend": (0.02,)},
)
PHOTONS = (
    20.0  # per frame: enough that shapes count, few enough that a left-out image need not be matched pixel by pixel
)
WORLD = 5000  # images of the world, changed copies included
LEFT_OUT_PART = 5
LEFT_OUT_MAX = 400
FRAMES = 400  # of all left-out images, several of each where they are few
LOSS_MAX = 4.0  # nats: one photon where no image of the class has light must not outweigh all others
FLOOR = 5e-3  # least transmission in the posterior
GAIN_SE = 0.5  # standard errors, over the images, of the mean gain that a change must bring

Report = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Choice:
    """The changes chosen, and the log-loss (nats) of left-out images without and with them."""

    variation: Variation
    loss_before: float
    loss: float


def choose_variation(task: Task, seed: int = 0, report: Report = lambda _what, _done: None) -> Choice:
    """Return the changes that serve the training images of `task` best; none where none helps."""
    judge = _Judge(task, seed)
    best = Variation()
    losses = before = judge.losses(best)
    for number, tried in enumerate(TRIES):
        report("which changes leave the class as it is", number / len(TRIES))
        (name, sizes), won = next(iter(tried.items())), None
        for size in sizes:
            changed = replace(best, **{name: size})
            found = judge.losses(changed)
            gain = losses - found
            clear = gain.mean() > GAIN_SE * gain.std(ddof=1) / math.sqrt(len(gain))
            if clear and (won is None or found.mean() < won[1].mean()):
                won = changed, found
        if won is not None:
            best, losses = won
    return Choice(best, float(before.mean()), float(losses.mean()))


class _Judge:
    """The left-out images, photon frames of each, and the images from which a world is made."""

    def __init__(self, task: Task, seed: int) -> None:
        n = len(task.train)
        n_out = max(1, min(LEFT_OUT_MAX, n // LEFT_OUT_PART))
        self.task, self.seed = task, seed
        self.out = Objects(task.train.images[n - n_out :], task.train.labels[n - n_out :])
        self.frames = -(-FRAMES // n_out)
        self.known = task.train.first(min(n - n_out, WORLD))

    def losses(self, variation: Variation) -> NDArray[np.float64]:
        """Return -log P(true class | frame), the mean over frames of every left-out image, in a world of changed images, (images,)."""
        known, plain = self.known, variation == Variation()
        copies = 0 if plain else max(1, WORLD // len(known))
        images = [known.images, *(varied(known.images, variation, [self.seed, copy]) for copy in range(copies))]
        world = Objects(np.concatenate(images), np.tile(known.labels, copies + 1))
        measured = measure(replace(self.task, train=world, test=self.out), None)
        light = np.repeat(measured.photoelectrons(measured.test, PHOTONS), self.frames, axis=0)
        frames = detect(light, "counting", np.random.default_rng([self.seed, 3]))
        joint = log_joint(measured, frames, PHOTONS, "counting", floor=FLOOR)
        joint -= np.logaddexp.reduce(joint, axis=1, keepdims=True)
        losses = -joint[np.arange(len(frames)), np.repeat(self.out.labels, self.frames)]
        return np.minimum(losses, LOSS_MAX).reshape(-1, self.frames).mean(axis=1)
