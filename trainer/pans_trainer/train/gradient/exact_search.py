"""Searches that enumerate all click words, for two small tasks of the paper: barcodes, and an anomaly in a known scene.

`solve` (the task `barcode`): nothing is sampled, all 1024 strings count.

1. **Which bars** (`search_bars`). At much light and without dark counts a pattern clicks exactly when one of its bars is bright,
   so that accuracy and clicks of a choice of bars are counts. Simulated annealing flips, moves and restarts single patterns. Gradient
   descent from random light stops in poor valleys here (4 to 12 points lower).
2. **How brightly** (`descend_bars`). From there Adam on squared weights, with the exact rate of wrong Bayes decisions over all 2**d_f
   words, at the wanted dark count. Clicks are held by a weight that grows with their excess; a photon costs `PHOTON_PRICE`.

`search` (two classes: the scene as it should be, and what should not be there) finds a coherent encoder:

- W is sought among the fields that class 1 has and class 0 lacks (field_basis.py), in `Options.restarts` encoders side by side;
- no head: the loss turns from the class's entropy given the word to the rate of wrong Bayes decisions. With d_f words of few bits many
  starts end in rules that waste detectors ("any click" where "two of three" would stand dark counts), and only that rate tells them apart;
- scenes without an up are seen in all eight turns and reflections: 12 000 objects are few against 1024 binned pixels;
- the start with the fewest wrong decisions on the validation objects (unturned, never descended on) is kept. Photons are not limited.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.base.errors import UsageError, as_usage_error
from pans.bundle.making import quantise_patterns
from pans.instrument.click_law import ClickLaw, click_law
from pans.instrument.profile import Profile
from pans_trainer.model.detection import Law, click_probability, word_probabilities
from pans_trainer.model.encoders import ActiveIllumination, CoherentField
from pans_trainer.model.estimators import cross_entropy
from pans_trainer.model.exposure import exposure_us_of, top_limits
from pans_trainer.model.field_basis import in_pixels, turns
from pans_trainer.model.heads import new_head
from pans_trainer.options import Options
from pans_trainer.tasks.barcode import N_BARS, all_strings, weights
from pans_trainer.tasks.registry import Task

from .data import VALIDATION_PART, discriminant_fields, encoder_input
from .head_fit import fit_head
from .loop import Trained

ANNEALING_STEPS = 4000
HOT, COLD = 0.02, 1e-5  # temperatures, in accuracy
CLICK_PRICE = 0.3  # accuracy lost per click above the budget, in the search
LIGHT = 8.0  # photoelectrons of a lit bar at the start of the descent: it is missed once in 3000 times
GLOW = 0.01  # of the other bars: squared weights of zero would never move
DESCENT_STEPS = 120
RATE = 0.03
PHOTON_PRICE = 5e-5  # accuracy per photon: without one the light would grow without end
BARS_PRICE_GAIN = 10.0  # how fast the price of a click follows the relative excess, per step
ENTROPY = 0.2  # weight of the label's entropy beside the wrong decisions: it also sees words that are nearly decided

Bars = NDArray[np.bool_]
ENTROPY_PART = 0.3  # of the steps, in which the entropy alone leads; then wrong decisions take over in as many
ENTROPY_LEFT = 0.2  # of the entropy, to the end: it also sees words that are nearly decided
WRONG = 1.6  # weight of the wrong decisions at the end
PRICE_START, PRICE_MAX = 0.03, 3.0  # of a click, in nats
PRICE_GAIN = 0.5  # how fast its logarithm follows the relative excess of the clicks, per step, up to a tenth
CLICKS_SLACK = 1.01  # times the budget, that a start may give and still be chosen


@dataclass(frozen=True, slots=True)
class Found:
    """Patterns, photoelectrons per bar (d_f, 10), and what they give over all strings: accuracy (0 to 1) and clicks."""

    patterns: Tensor
    accuracy: float
    clicks: float


def count(bars_lit: Bars, prior: str = "uniform") -> tuple[float, float]:
    """Return accuracy (0 to 1) and mean clicks of patterns (d_f, 10) at much light and no dark counts."""
    strings, labels = all_strings()
    share = weights(prior)
    clicks = (strings.astype(np.int64) @ bars_lit.T.astype(np.int64)) > 0
    words = clicks @ (1 << np.arange(len(bars_lit)))
    of_word = np.bincount(2 * words + labels, share, minlength=2 << len(bars_lit)).reshape(-1, 2)
    return float(of_word.max(axis=1).sum()), float(clicks.sum(axis=1) @ share)


def search_bars(
    features: int, clicks_max: float, seed: int, prior: str = "uniform", steps: int = ANNEALING_STEPS
) -> Bars:
    """Return the best choice of bars that simulated annealing finds, bool (features, 10), at no more than `clicks_max` clicks."""
    random = np.random.default_rng([seed, features])
    lit = np.zeros((features, N_BARS), np.bool_)
    lit[np.arange(features), random.integers(0, N_BARS, features)] = True
    now = best_score = -math.inf
    best = lit
    for step in range(steps):
        temperature = HOT * (1 - step / steps) ** 2 + COLD
        tried = _neighbour(lit, random)
        accuracy, clicks = count(tried, prior)
        score = accuracy - CLICK_PRICE * max(0.0, clicks - clicks_max)
        if score >= now or random.random() < math.exp((score - now) / temperature):
            lit, now = tried, score
        if score > best_score:
            best, best_score = tried, score
    return best


def _neighbour(lit: Bars, random: np.random.Generator) -> Bars:
    """One pattern changed: a bar flipped, the whole pattern moved by a bar, or begun again with one bar."""
    changed = lit.copy()
    pattern, kind = random.integers(len(lit)), random.random()
    if kind < 0.6:
        bar = random.integers(N_BARS)
        changed[pattern, bar] ^= True
    elif kind < 0.8:
        changed[pattern] = np.roll(lit[pattern], 1 if random.random() < 0.5 else -1)
    else:
        changed[pattern] = False
        changed[pattern, random.integers(N_BARS)] = True
    return changed


def descend_bars(
    patterns: Tensor, law: Law, clicks_max: float, prior: str = "uniform", steps: int = DESCENT_STEPS
) -> Found:
    """Return the best patterns within `clicks_max` on the way of an exact descent from `patterns` (d_f, 10), photoelectrons."""
    strings, labels = all_strings()
    x, of_label = torch.from_numpy(strings).double(), torch.nn.functional.one_hot(torch.from_numpy(labels)).double()
    share = torch.from_numpy(weights(prior))
    weight = patterns.double().sqrt().requires_grad_()
    optimiser = torch.optim.Adam([weight], lr=RATE)
    price, best = 0.01, Found(patterns, -math.inf, math.inf)
    for step in range(steps + 1):
        light = x @ (weight**2).T
        p = click_probability(light, law)
        joint = word_probabilities(p).T @ (of_label * share.unsqueeze(1))
        accuracy, clicks = joint.amax(dim=1).sum(), p.sum(dim=1) @ share
        if clicks <= clicks_max and accuracy > best.accuracy:
            best = Found((weight.detach() ** 2).clone(), float(accuracy.detach()), float(clicks.detach()))
        of_word = joint.sum(dim=1, keepdim=True)
        entropy = -torch.special.xlogy(joint, joint / of_word.clamp(min=1e-300)).sum()
        loss = -accuracy + ENTROPY * entropy + price * clicks + PHOTON_PRICE * (light.sum(dim=1) @ share)
        optimiser.param_groups[0]["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        excess = min(0.2, max(-0.2, BARS_PRICE_GAIN * (float(clicks.detach()) / clicks_max - 1)))
        price = min(1.0, max(1e-4, price * math.exp(excess)))
    return best


def solve_patterns(options: Options, profile: Profile, prior: str = "uniform") -> tuple[list[Found], Law]:
    """Return what `options.restarts` searches and descents found, the best first, and the click law they were found for."""
    clicks_max = options.features if options.clicks is None else options.clicks
    top = min(LIGHT, top_limits(profile)[1])
    law, found = _law(profile, exposure_us_of(profile, top), options), []
    for start in range(options.restarts):
        lit = search_bars(options.features, clicks_max, options.seed + start, prior)
        patterns = torch.where(torch.from_numpy(lit), top, GLOW).double()
        found.append(descend_bars(patterns, law, clicks_max, prior))
    found.sort(key=lambda one: -one.accuracy)
    if found[0].accuracy < 0:
        raise ValueError(f"no patterns were found within {clicks_max:g} clicks: allow more, or more restarts")
    return found, law


def _law(profile: Profile, exposure_us: float, options: Options) -> ClickLaw:
    """The click law of an exposure, of the shortest where it is shorter, with the dark counts that are asked for."""
    return click_law(profile, max(profile.exposure.min_us, exposure_us), options.dark)


def solve(options: Options, profile: Profile) -> Trained:
    """Return the solved task, all strings equally likely: the best patterns in whole levels, and their head.

    Of `options` count: features, clicks (the most, of one inference), dark, restarts, seed, hidden and shots.
    """
    found, law = solve_patterns(options, profile)
    best, random = found[0], torch.Generator().manual_seed(options.seed)
    low, high = top_limits(profile)
    encoder = ActiveIllumination(options.features, N_BARS, (low, high), random)
    with torch.no_grad():
        encoder.weight.copy_(best.patterns.sqrt())
    top = min(high, max(low, float(best.patterns.max())))
    with as_usage_error():
        shown = quantise_patterns(best.patterns.numpy(), profile.projector.levels, top)
    strings, labels = (torch.from_numpy(part) for part in all_strings())
    p = click_probability(strings.double() @ torch.from_numpy(shown.patterns()).T, law)
    head = new_head(options, 2, (1, N_BARS), random)
    fit_head(head, p, labels, cross_entropy, random, shots=options.shots)
    losses = tuple(1 - one.accuracy for one in found)
    return Trained(shown, encoder, head, p.mean(dim=0), law, losses, options)


def search(task: Task, profile: Profile, options: Options) -> Trained:
    """Return the best of `options.restarts` encoders of `options.fields` fields, with a head fitted to its click words.

    The task has two classes, and square images. `epochs` are passes over all turned objects in batches of `batch`, `front_rate` the peak
    rate of Adam, `light` the mean photoelectrons per detector at the start, `clicks` the budget. UsageError for another task.
    """
    height, width = task.image_shape
    if len(task.classes) != 2 or height != width:
        what = f"--search: {task.name} has {len(task.classes)} classes, images of {height} x {width} pixels"
        raise UsageError(f"{what}, allowed: 2 classes, square images", remedy="leave --search out")
    x, labels, size = (
        encoder_input(task, task.train, profile, options),
        torch.from_numpy(task.train.labels),
        options.fields,
    )
    fields = discriminant_fields(task, options, turned=True)[:, size:]
    n_fit = len(x) - max(1, len(x) // VALIDATION_PART)
    views = [x @ fields[turn] for turn in turns(task.image_shape)]
    law = _law(profile, 0.0, options)
    shown, target = torch.cat([view[:n_fit] for view in views]), labels[:n_fit].repeat(len(views))
    weights = descend(shown, target, law, options)
    assert options.clicks is not None
    wrong = judge(weights, views[0][n_fit:], labels[n_fit:], law, options.clicks)
    encoder = CoherentField(options.features, fields.shape[1], torch.Generator())
    with torch.no_grad():
        encoder.weight.copy_(weights[wrong.argmin()].unsqueeze(0))
        p = click_probability(torch.cat([encoder(view) for view in views]).double(), law)
    random = torch.Generator().manual_seed(options.seed)
    head = new_head(options, 2, task.image_shape, random)
    fit_head(head, p, labels.repeat(len(views)), cross_entropy, random, rate=options.head_rate)
    losses = tuple(wrong.tolist())
    return Trained(None, in_pixels(encoder, fields), head, p.mean(dim=0), law, losses, options)


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
