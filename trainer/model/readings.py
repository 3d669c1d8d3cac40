"""What an exposure says, clicks or photon numbers, as one stochastic layer: its chances, its mean, samples, and all words of a shot.

Owns the way from light to what the head is given: readings over the largest, from 0 to 1. Of clicks it is detection.py's; the count law
is here in torch. `chances` are p (n, d_f) of clicks, and P(number) (n, d_f, outcomes) of photon numbers; nobody else looks into them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from pans.runtime.instrument.count_law import CountLaw, outcome_weights

from .detection import Law, click_probability, click_words, sample_clicks, word_probabilities
from .estimators import ESTIMATORS, Head, LossOf, gradient_only, word_loss

_MU_MAX = 100.0  # beyond it every reading is the largest one


class NumberHead(Head, Protocol):
    """A head that knows what one other number would change."""

    def changed(self, clicks: Tensor, mean: Tensor, by: Tensor) -> Tensor:
        """Scores (n, d_f, out): column i is that of the same clicks with `by` (n, d_f) added to click i alone."""


Estimate = Callable[[Tensor, Tensor, NumberHead, LossOf, torch.Generator], Tensor]


class Readings(Protocol):
    """What an exposure can say."""

    outcomes: int  # 2: no click and a click

    def chances(self, photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
        """Return the chances of an exposure with `photoelectrons` (n, d_f), of their dtype and differentiable in them."""

    def mean(self, chances: Tensor) -> Tensor:
        """Return the mean of what the head is given, (n, d_f) from 0 to 1."""

    def sample(self, chances: Tensor, random: torch.Generator) -> Tensor:
        """Return what the head is given of one exposure of each pattern, (n, d_f); its gradient is that of the mean."""

    def word_chances(self, chances: Tensor) -> Tensor:
        """Return P(word | object), (n, outcomes**d_f); pattern 0 is the lowest digit."""

    def words(self, n_features: int) -> Tensor:
        """Return what the head is given of all words, float32 (outcomes**d_f, d_f), in the order of `word_chances`."""

    def estimator(self, name: str) -> Estimate:
        """Return the estimator of that name."""


class Clicks:
    """A click or none."""

    outcomes = 2

    def chances(self, photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
        """See `Readings`."""
        return click_probability(photoelectrons, law, slope)

    def mean(self, chances: Tensor) -> Tensor:
        """See `Readings`."""
        return chances

    def sample(self, chances: Tensor, random: torch.Generator) -> Tensor:
        """See `Readings`."""
        return sample_clicks(chances, random)

    def word_chances(self, chances: Tensor) -> Tensor:
        """See `Readings`."""
        return word_probabilities(chances)

    def words(self, n_features: int) -> Tensor:
        """See `Readings`."""
        return click_words(n_features)

    def estimator(self, name: str) -> Estimate:
        """See `Readings`."""
        return ESTIMATORS[name]


class Numbers:
    """Photon numbers from 0 to `outcomes` - 1, which stands for that many or more."""

    def __init__(self, outcomes: int) -> None:
        self.outcomes = outcomes

    def chances(self, photoelectrons: Tensor, law: Law | CountLaw, slope: float = 1.0) -> Tensor:
        """See `Readings`."""
        assert isinstance(law, CountLaw)
        mu = (photoelectrons.double() * slope + law.dark_per_exposure).clamp(max=_MU_MAX)
        return outcome_chances(mu, law).to(photoelectrons.dtype)

    def mean(self, chances: Tensor) -> Tensor:
        """See `Readings`."""
        return (chances * self.values(chances)).sum(dim=-1)

    def sample(self, chances: Tensor, random: torch.Generator) -> Tensor:
        """See `Readings`."""
        uniform = torch.rand(chances.shape[:-1], generator=random, dtype=torch.float64)
        with torch.no_grad():
            passed = uniform.unsqueeze(-1) >= chances.double().cumsum(dim=-1)[..., :-1]
            drawn = passed.sum(dim=-1).to(chances.dtype) / (self.outcomes - 1)
        mean = self.mean(chances)
        return drawn + (mean - mean.detach())

    def word_chances(self, chances: Tensor) -> Tensor:
        """See `Readings`."""
        words = torch.ones(len(chances), 1, dtype=chances.dtype, device=chances.device)
        for i in range(chances.shape[1]):  # pattern i goes above the digits that are there
            words = torch.cat([words * chances[:, i, number, None] for number in range(self.outcomes)], dim=1)
        return words

    def words(self, n_features: int) -> Tensor:
        """See `Readings`."""
        index = torch.arange(self.outcomes**n_features)[:, None]
        digits = index // self.outcomes ** torch.arange(n_features) % self.outcomes
        return digits.float() / (self.outcomes - 1)

    def estimator(self, name: str) -> Estimate:
        """See `Readings`."""
        return partial(NUMBER_ESTIMATORS[name], self)

    def values(self, like: Tensor) -> Tensor:
        """Return what the head is given of each number, (outcomes,), of the dtype and on the device of `like`."""
        return torch.arange(self.outcomes, dtype=like.dtype, device=like.device) / (self.outcomes - 1)


def readings_of(outcomes: int) -> Readings:
    """Return what an exposure of so many `outcomes` says."""
    return Clicks() if outcomes == 2 else Numbers(outcomes)


def outcome_chances(mu: Tensor, law: CountLaw) -> Tensor:
    """Return P(outcome), (*shape of mu, outcomes), for `mu` photoelectrons, dark ones included, float64 and at most 100.

    The same as `pans.runtime.instrument.count_law.count_chances`: exp(-mu) times a polynomial for every outcome but the last.
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


# ---- estimators: as in estimators.py, of an outcome that is one of several ----


def _straight_through(
    numbers: Numbers, chances: Tensor, target: Tensor, head: NumberHead, loss_of: LossOf, random: torch.Generator
) -> Tensor:
    """The gradient of a sampled number is given to the mean."""
    return loss_of(head(numbers.sample(chances, random), None), target).mean()


def _exact(
    numbers: Numbers, chances: Tensor, target: Tensor, head: NumberHead, loss_of: LossOf, _random: torch.Generator
) -> Tensor:
    """All words, each once."""
    scores = head(numbers.words(chances.shape[1]), numbers.mean(chances).mean(dim=0))
    return word_loss(numbers.word_chances(chances), scores, target, loss_of)


def _local_expectation(
    numbers: Numbers, chances: Tensor, target: Tensor, head: NumberHead, loss_of: LossOf, random: torch.Generator
) -> Tensor:
    """Every exposure with each of its numbers, the others as sampled: unbiased."""
    drawn, mean = numbers.sample(chances, random).detach(), numbers.mean(chances).mean(dim=0)
    loss = loss_of(head(drawn, mean), target)
    with torch.no_grad():
        of_number = [
            loss_of(head.changed(drawn, mean, value - drawn), target.unsqueeze(1)) for value in numbers.values(chances)
        ]
        slope = torch.stack(of_number, dim=-1) - loss[:, None, None]  # the chances of an exposure sum to 1
    return loss.mean() + gradient_only(chances, slope)


NUMBER_ESTIMATORS = {"ste": _straight_through, "exact": _exact, "local": _local_expectation}
