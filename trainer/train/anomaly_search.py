"""An anomaly in a known scene, seen by few detectors: many coherent encoders at once, by the wrong decisions themselves.

Owns the search for W where class 0 is the scene as it should be and class 1 shows what should not be there; never sees held-out
objects. `search` returns what `train` would. It differs from loop.py, which descends from one start at a time by a network's
cross-entropy:

- W is sought among the fields that class 1 has and class 0 lacks (field_basis.py), in `Options.restarts` encoders side by side;
- no head: the chance of every click word and class is enumerated, and the loss turns from the class's entropy given the word to the
  rate of wrong Bayes decisions. With d_f words of few bits many starts end in rules that waste detectors ("any click"
  where "two of three" would stand dark counts), and only the rate of wrong decisions tells them apart;
- scenes without an up are shown in all eight turns and reflections, whose moments also make the fields: 12 000 objects are few
  against 1024 binned pixels, and fields from unturned ones promise contrasts that held-out objects do not have;
- the start with the fewest wrong decisions on the validation objects (unturned, never descended on) is kept.

Clicks are held by a weight per start that grows with their excess; photons are not limited.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from pans.runtime.instrument.click_law import click_law
from pans.runtime.instrument.profile import Profile
from pans.trainer.model.detection import Law, click_probability, word_probabilities
from pans.trainer.model.encoders import CoherentField
from pans.trainer.model.estimators import cross_entropy
from pans.trainer.model.field_basis import discriminant_basis, in_pixels, turns
from pans.trainer.model.heads import new_head
from pans.trainer.options import EXACT_FEATURES_MAX, Options
from pans.trainer.tasks.registry import Task

from .data import VALIDATION_PART, encoder_input
from .head_fit import fit_head
from .loop import Trained

ENTROPY_PART = 0.3  # of the steps, in which the entropy alone leads; then wrong decisions take over in as many
ENTROPY_LEFT = 0.2  # of the entropy, to the end: it also sees words that are nearly decided
WRONG = 1.6  # weight of the wrong decisions at the end
PRICE_START, PRICE_MAX = 0.03, 3.0  # of a click, in nats
PRICE_GAIN = 0.5  # how fast its logarithm follows the relative excess of the clicks, per step, up to a tenth
CLICKS_SLACK = 1.01  # times the budget, that a start may give and still be chosen


def search(task: Task, profile: Profile, options: Options, size: int) -> Trained:
    """Return the best of `options.restarts` encoders of `size` fields, with a head fitted to its click words.

    `epochs` are passes over all turned objects in batches of `batch`, `front_rate` the peak rate of Adam, `light` the mean
    photoelectrons per detector at the start. ValueError where the task has not two classes or the words cannot be enumerated.
    """
    if len(task.classes) != 2 or options.clicks is None or options.features > EXACT_FEATURES_MAX:
        raise ValueError(
            f"{task.name}: {len(task.classes)} classes, {options.features} patterns, clicks {options.clicks}; "
            f"allowed: two classes, at most {EXACT_FEATURES_MAX} patterns and a budget of clicks"
        )
    x, labels = encoder_input(task, task.train, profile, options), torch.from_numpy(task.train.labels)
    fields = discriminant_basis(x, labels, task.image_shape, size, turned=True)[:, size:]
    n_fit = len(x) - max(1, len(x) // VALIDATION_PART)
    views = [x @ fields[turn] for turn in turns(task.image_shape)]
    law = click_law(profile, profile.exposure.min_us)
    if options.dark is not None:
        law = replace(law, dark_per_exposure=options.dark)
    shown, target = torch.cat([view[:n_fit] for view in views]), labels[:n_fit].repeat(len(views))
    weights = descend(shown, target, law, options)
    wrong = judge(weights, views[0][n_fit:], labels[n_fit:], law, options.clicks)
    encoder = CoherentField(options.features, size, torch.Generator())
    with torch.no_grad():
        encoder.weight.copy_(weights[wrong.argmin()].unsqueeze(0))
        p = click_probability(torch.cat([encoder(view) for view in views]).double(), law)
    random = torch.Generator().manual_seed(options.seed)
    head = new_head(options, 2, task.image_shape, random)
    fit_head(head, p, labels.repeat(len(views)), cross_entropy, random, rate=options.head_rate)
    losses = tuple(wrong.tolist())
    return Trained(None, None, in_pixels(encoder, fields), head, p.mean(dim=0), law, min(losses), losses, options)


def descend(shown: Tensor, labels: Tensor, law: Law, options: Options) -> Tensor:
    """Return encoders, float32 (restarts, d_f, size), for coordinates `shown` (n, size) of objects of two classes."""
    assert options.clicks is not None
    random = torch.Generator().manual_seed(options.seed)
    shape = (options.restarts, options.features, shown.shape[1])
    weights = torch.randn(shape, generator=random) * math.sqrt(options.light / shown.shape[1])
    weights.requires_grad_()
    optimiser = torch.optim.Adam([weights])
    price = torch.full((options.restarts,), PRICE_START)
    per_epoch = max(1, len(shown) // options.batch)
    steps = options.epochs * per_epoch
    for step in range(steps):
        if step % per_epoch == 0:
            parts = torch.randperm(len(shown), generator=random).tensor_split(per_epoch)
        optimiser.param_groups[0]["lr"] = options.front_rate * _cycle(step / steps)
        batch = parts[step % per_epoch]
        p = _probability(weights, shown[batch], law)
        entropy, wrong = _losses(p, labels[batch])
        turned = min(1.0, max(0.0, (step / steps - ENTROPY_PART) / ENTROPY_PART))
        clicks = p.sum(dim=2).mean(dim=1)
        loss = (1 - (1 - ENTROPY_LEFT) * turned) * entropy + WRONG * turned * wrong + price * clicks
        optimiser.zero_grad()
        loss.sum().backward()
        optimiser.step()
        excess = (PRICE_GAIN * (clicks.detach() / options.clicks - 1)).clamp(-0.1, 0.1)
        price = (price * excess.exp()).clamp(1e-5, PRICE_MAX)
    return weights.detach()


def judge(weights: Tensor, shown: Tensor, labels: Tensor, law: Law, clicks: float) -> Tensor:
    """Return the rate of wrong Bayes decisions of every encoder (restarts,); of those above the clicks, their clicks instead."""
    with torch.no_grad():
        p = _probability(weights, shown, law)
        given = p.sum(dim=2).mean(dim=1)
        wrong = _losses(p, labels)[1]
    return torch.where(given <= CLICKS_SLACK * clicks, wrong, 1 + given)


def joint(p: Tensor, labels: Tensor) -> Tensor:
    """Return P(word, class) over objects (n,) of two classes with click probabilities (starts, n, d_f): (starts, 2**d_f, 2).

    Words are split in two halves, so that no object ever holds all of them.
    """
    starts, n, d_f = p.shape
    low, high = (
        word_probabilities(half.reshape(starts * n, half.shape[2])).reshape(starts, n, -1)
        for half in (p[:, :, : d_f // 2], p[:, :, d_f // 2 :])
    )
    of_class = [(high * (labels == label).to(p.dtype).reshape(1, n, 1)).transpose(1, 2) @ low / n for label in (0, 1)]
    return torch.stack([words.flatten(1) for words in of_class], dim=2)


def _losses(p: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """The entropy of the class given the word, and the rate of wrong Bayes decisions: (starts,) each."""
    chance = joint(p, labels)
    of_class = torch.log(chance.clamp(min=1e-12) / chance.sum(dim=2, keepdim=True).clamp(min=1e-12))
    return -(chance * of_class).sum(dim=(1, 2)), 1 - chance.max(dim=2).values.sum(dim=1)


def _probability(weights: Tensor, shown: Tensor, law: Law) -> Tensor:
    starts, d_f, size = weights.shape
    light = (shown @ weights.reshape(-1, size).T).square()
    return click_probability(light, law).reshape(len(shown), starts, d_f).transpose(0, 1)


def _cycle(progress: float) -> float:
    return min(1.0, progress / 0.1) * (0.5 + 0.5 * math.cos(math.pi * progress)) + 1e-4
