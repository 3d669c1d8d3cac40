"""Losses, readings of an exposure, and gradient estimators: the loss of random readings with a gradient that reaches the light before them.

Every estimator is a function `(p, target, head, loss_of, random, readings) -> loss`: chances p, clicks (n, d_f) or photon numbers (n, d_f,
outcomes), a scalar whose value is the mean loss of the batch and whose gradient is the estimate. Heads normalise by the mean of p
(`ste`: by that of the sampled clicks, as in the paper). The last three know clicks alone.

| name | gradient in p | cost |
| --- | --- | --- |
| `ste` | straight-through: passed on from the sampled click. Biased unless the loss is affine in every click | 1 pass |
| `exact` | expectation over all 2**d_f words | 2**d_f words, once per batch |
| `local` | L(click i) - L(no click i), the other clicks sampled: unbiased | d_f + 1 passes, only the last layer in full |
| `identity` | as `ste`, passed on to the light itself, undamped (the paper's "naive" way): for comparison alone | 1 pass |
| `disarm` | antithetic pairs (Dong, Mnih, Tucker 2020): unbiased | 2 passes |
| `loo` | REINFORCE, other samples as the baseline (Kool, van Hoof, Welling 2019): unbiased | `LOO_SAMPLES` passes |

The true gradient is dp/dlambda * E[L(1) - L(0)], with dp/dlambda = exp(-lambda) for a plain detector (science of the paper's
appendix on gradient estimation, which calls `ste` unbiased; it is not).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Generator, Tensor

from pans.instrument.click_law import CountLaw, outcome_weights

from .detection import Law, click_probability, sample_clicks, word_probabilities
from .ssim import ssim

LOO_SAMPLES = 4
SHARPNESS = 2.0  # of the soft decision in `decision_loss`
WRONG = 3.0  # cost of a wrong decision there: about what cross-entropy charges for one
_DARK_MIN = 1e-6  # least chance of no click that `identity` divides by: float32 knows no less; beyond 13.8 photoelectrons it is damped
_P_MIN = 1e-4  # least chance by which a score-function gradient is divided: beyond it, one event would undo an epoch
_MU_MAX = 100.0  # beyond it every reading is the largest one

LossOf = Callable[[Tensor, Tensor], Tensor]  # scores (..., out), target (..., or broadcast) -> losses (...)


class Head(Protocol):
    """What an estimator asks of a digital back end."""

    def __call__(self, clicks: Tensor, mean: Tensor | None = None) -> Tensor:
        """Scores (n, out) of clicks (n, d_f), normalised by `mean` (d_f,)."""

    def changed(self, clicks: Tensor, mean: Tensor, by: Tensor) -> Tensor:
        """Scores (n, d_f, out): column i is that of the same clicks with `by` (n, d_f) added to click i alone."""


def cross_entropy(scores: Tensor, labels: Tensor) -> Tensor:
    """Return -log q(label): scores (..., classes) and whole-number labels (...), broadcast against each other."""
    log_q = torch.log_softmax(scores, dim=-1)
    return -torch.take_along_dim(log_q, labels.unsqueeze(-1), dim=-1).squeeze(-1)


def decision_loss(weight: float) -> LossOf:
    """Return a loss between cross-entropy (`weight` 0) and the rate of wrong decisions (towards 1).

    With few click words the two want different patterns: cross-entropy pays for being less wrong about every class, a decision
    only for the likeliest. A fifth of the cross-entropy stays, so that the scores remain those of a posterior.
    """

    def loss_of(scores: Tensor, labels: Tensor) -> Tensor:
        entropy = cross_entropy(scores, labels)
        if weight == 0:
            return entropy
        wrong = 1 - torch.exp(-cross_entropy(SHARPNESS * scores, labels))
        return (1 - 0.8 * weight) * entropy + WRONG * weight * wrong

    return loss_of


def squared_error(scores: Tensor, images: Tensor) -> Tensor:
    """Return the mean squared difference over the last axis."""
    return (scores - images).square().mean(dim=-1)


def similarity_loss(weight: float, image_shape: tuple[int, int]) -> LossOf:
    """Return a loss between the squared error (`weight` 0) and 1 - SSIM (1) of pictures of `image_shape`, each as pixels in a row.

    SSIM is of what is shown, cut to [0, 1]; the squared error is of what the head says, so that no pixel stays beyond black or white.
    """

    def loss_of(scores: Tensor, images: Tensor) -> Tensor:
        error = squared_error(scores, images)
        if weight == 0:
            return error
        shown, wanted = torch.broadcast_tensors(scores.clamp(0, 1), images)
        alike = ssim(shown.unflatten(-1, image_shape), wanted.unflatten(-1, image_shape))
        return (1 - weight) * error + weight * (1 - alike)

    return loss_of


# ---- readings ----


class Readings:
    """What the head is given of an exposure: photon numbers from 0 to `outcomes` - 1 (that many or more), over the largest: 0 to 1."""

    def __init__(self, outcomes: int) -> None:
        self.outcomes = outcomes

    def chances(self, photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
        """Return the chances of an exposure with `photoelectrons` (n, d_f), of their dtype and differentiable in them."""
        assert isinstance(law, CountLaw)
        mu = (photoelectrons.double() * slope + law.dark_per_exposure).clamp(max=_MU_MAX)
        return outcome_chances(mu, law).to(photoelectrons.dtype)

    def mean(self, chances: Tensor) -> Tensor:
        """Return the mean of what the head is given, (n, d_f) from 0 to 1."""
        return (chances * self._values(chances)).sum(dim=-1)

    def sample(self, chances: Tensor, random: Generator) -> Tensor:
        """Return what the head is given of one exposure of each pattern, (n, d_f); its gradient is that of the mean."""
        uniform = torch.rand(chances.shape[:-1], generator=random, dtype=torch.float64)
        with torch.no_grad():
            passed = uniform.unsqueeze(-1) >= chances.double().cumsum(dim=-1)[..., :-1]
            drawn = passed.sum(dim=-1).to(chances.dtype) / (self.outcomes - 1)
        mean = self.mean(chances)
        return drawn + (mean - mean.detach())

    def word_chances(self, chances: Tensor) -> Tensor:
        """Return P(word | object), (n, outcomes**d_f); pattern 0 is the lowest digit."""
        words = torch.ones(len(chances), 1, dtype=chances.dtype, device=chances.device)
        for i in range(chances.shape[1]):  # pattern i goes above the digits that are there
            words = torch.cat([words * chances[:, i, number, None] for number in range(self.outcomes)], dim=1)
        return words

    def words(self, n_features: int) -> Tensor:
        """Return what the head is given of all words, float32 (outcomes**d_f, d_f), in the order of `word_chances`."""
        index = torch.arange(self.outcomes**n_features)[:, None]
        digits = index // self.outcomes ** torch.arange(n_features) % self.outcomes
        return digits.float() / (self.outcomes - 1)

    def local_slope(
        self, chances: Tensor, drawn: Tensor, loss_with: Callable[[Tensor], Tensor], loss: Tensor
    ) -> Tensor:
        """Return the slope of the loss in `chances`, one exposure changed at a time; `loss_with(by)`: readings changed by that."""
        of_number = [loss_with(value - drawn) for value in self._values(chances)]
        return torch.stack(of_number, dim=-1) - loss[:, None, None]  # the chances of an exposure sum to 1

    def _values(self, like: Tensor) -> Tensor:
        return torch.arange(self.outcomes, dtype=like.dtype, device=like.device) / (self.outcomes - 1)


class Clicks(Readings):
    """A click or none: the chances are p (n, d_f)."""

    def __init__(self) -> None:
        super().__init__(2)

    def chances(self, photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
        return click_probability(photoelectrons, law, slope)

    def mean(self, chances: Tensor) -> Tensor:
        return chances

    def sample(self, chances: Tensor, random: Generator) -> Tensor:
        return sample_clicks(chances, random)

    def word_chances(self, chances: Tensor) -> Tensor:
        return word_probabilities(chances)

    def local_slope(
        self, chances: Tensor, drawn: Tensor, loss_with: Callable[[Tensor], Tensor], loss: Tensor
    ) -> Tensor:
        return (1 - 2 * drawn) * (loss_with(1 - 2 * drawn) - loss.unsqueeze(1))


CLICKS = Clicks()


def readings_of(outcomes: int) -> Readings:
    """Return what an exposure of so many `outcomes` says."""
    return CLICKS if outcomes == 2 else Readings(outcomes)


def outcome_chances(mu: Tensor, law: CountLaw) -> Tensor:
    """Return P(outcome), (*shape of mu, outcomes), for `mu` photoelectrons, dark ones included, float64 and at most 100.

    The same as `pans.instrument.click_law.count_chances`: exp(-mu) times a polynomial for every outcome but the last.
    """
    weights = outcome_weights(law)[:-1]
    factorials = np.array([math.factorial(k) for k in range(weights.shape[1])], np.float64)
    powers = torch.tensor(weights / factorials, dtype=mu.dtype, device=mu.device)
    below = torch.zeros((*mu.shape, len(weights)), dtype=mu.dtype, device=mu.device)
    for k in reversed(range(powers.shape[1])):
        below = below * mu.unsqueeze(-1) + powers[:, k]
    below = below * torch.exp(-mu).unsqueeze(-1)
    last = (1.0 - below.sum(dim=-1, keepdim=True)).clamp(min=0.0)
    return torch.cat([below, last], dim=-1)


# ---- estimators ----

Estimator = Callable[[Tensor, Tensor, Head, LossOf, Generator, Readings], Tensor]


def ste(p: Tensor, target: Tensor, head: Head, loss_of: LossOf, random: Generator, readings: Readings) -> Tensor:
    """The paper's: the gradient of a sampled click is given to its probability, of a number to the mean."""
    return loss_of(head(readings.sample(p, random), None), target).mean()  # normalised by the clicks of the batch


def exact(p: Tensor, target: Tensor, head: Head, loss_of: LossOf, _random: Generator, readings: Readings) -> Tensor:
    """All words, each once: no sampling noise in loss or gradient."""
    chances = readings.word_chances(p)
    return word_loss(chances, head(readings.words(p.shape[1]), readings.mean(p).mean(dim=0)), target, loss_of)


def word_loss(words: Tensor, scores: Tensor, target: Tensor, loss_of: LossOf) -> Tensor:
    """Return the mean loss over objects of which each shows every word, with `scores` (words, out), with chances `words` (n, words)."""
    if not target.is_floating_point():  # the same as below, by a matrix product instead of n * words losses
        n_classes = scores.shape[1]
        of_class = torch.nn.functional.one_hot(target, n_classes).to(words.dtype)
        losses = loss_of(scores.unsqueeze(1), torch.arange(n_classes, device=words.device)[None])  # (words, classes)
        return ((words.T @ of_class) * losses).sum() / len(words)
    return (words * loss_of(scores.unsqueeze(0), target.unsqueeze(1))).sum() / len(words)


def local(p: Tensor, target: Tensor, head: Head, loss_of: LossOf, random: Generator, readings: Readings) -> Tensor:
    """Every exposure with each of its readings, the others as sampled."""
    drawn, mean = readings.sample(p, random).detach(), readings.mean(p).mean(dim=0)
    loss = loss_of(head(drawn, mean), target)

    def loss_with(by: Tensor) -> Tensor:
        return loss_of(head.changed(drawn, mean, by), target.unsqueeze(1))

    with torch.no_grad():
        slope = readings.local_slope(p, drawn, loss_with, loss)
    return loss.mean() + gradient_only(p, slope)


def identity(p: Tensor, target: Tensor, head: Head, loss_of: LossOf, random: Generator, _readings: Readings) -> Tensor:
    """The gradient of a sampled click is given to the photoelectrons, as if d click / d lambda were 1.

    The click law behind damps by exp(-lambda), the chance of no click of a plain detector: divided by that beforehand.
    """
    clicks = sample_clicks(p, random).detach()
    undamped = p / (1 - p.detach()).clamp(min=_DARK_MIN)
    return loss_of(head(clicks + (undamped - undamped.detach()), None), target).mean()


def disarm(p: Tensor, target: Tensor, head: Head, loss_of: LossOf, random: Generator, _readings: Readings) -> Tensor:
    """Two words from the same random numbers, one from u and one from 1 - u; only clicks that differ get a gradient."""
    uniform = torch.rand(p.shape, generator=random, dtype=torch.float64)
    first, second = (uniform < p).to(p.dtype), (1 - uniform < p).to(p.dtype)
    mean = p.mean(dim=0)
    losses = [loss_of(head(clicks, mean), target) for clicks in (first, second)]
    with torch.no_grad():
        rarer = torch.minimum(p, 1 - p).clamp(min=_P_MIN)
        slope = 0.5 * (losses[0] - losses[1]).unsqueeze(1) * (first - second) / rarer
    return 0.5 * (losses[0] + losses[1]).mean() + gradient_only(p, slope)


def loo(p: Tensor, target: Tensor, head: Head, loss_of: LossOf, random: Generator, _readings: Readings) -> Tensor:
    """Score function times how much worse a sample is than the others."""
    mean = p.mean(dim=0)
    drawn = [sample_clicks(p, random).detach() for _ in range(LOO_SAMPLES)]
    losses = torch.stack([loss_of(head(clicks, mean), target) for clicks in drawn])
    with torch.no_grad():
        excess = (losses - losses.mean(dim=0)) * (LOO_SAMPLES / (LOO_SAMPLES - 1))
        variance = (p * (1 - p)).clamp(min=_P_MIN)
        slope = torch.stack([e.unsqueeze(1) * (c - p) / variance for e, c in zip(excess, drawn)]).mean(dim=0)
    return losses.mean() + gradient_only(p, slope)


def gradient_only(p: Tensor, slope: Tensor) -> Tensor:
    """Return a scalar of value 0 whose gradient in p (n, ...) is `slope` / n."""
    weighted = (slope * p).sum() / len(p)
    return weighted - weighted.detach()


ESTIMATORS: dict[str, Estimator] = {one.__name__: one for one in (ste, identity, exact, local, disarm, loo)}
