"""The last stage of training: the patterns stay, the head is fitted to what they show.

Owns the fit of a head to fixed click probabilities; never touches a pattern. Where the click words can be enumerated, one shot
is fitted to the exact joint distribution of word and class, the whole training set at every step; more shots, and more patterns,
by sampling. The head takes mean clicks, so one head serves all numbers of shots; means of several shots lie between the words,
where a head that saw words alone has never been.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pans.trainer.model.estimators import Clicks, LossOf, Readings, cross_entropy
from pans.trainer.model.heads import Heads, PictureHead
from pans.trainer.options import EXACT_WORDS_MAX

SHOTS = (2, 3, 5, 8, 13, 21, 34, 55)  # numbers of shots that are fitted beside one, up to the largest wanted
SHARE_OF_SHOTS = 0.3  # of the loss, for all numbers of shots beside one
CLICKS = Clicks()
CHUNK = 2000  # objects per pass where no gradient is needed
STEPS = 1500
SAMPLED_EPOCHS = 10
RATE = 2e-3


def joint_distribution(p: Tensor, labels: Tensor, n_classes: int, readings: Readings = CLICKS) -> Tensor:
    """Return P(word, class) over objects with click probabilities `p` (n, d_f), float64 (2**d_f, classes); sums to 1.

    Of other `readings` p are their chances, and there are outcomes**d_f words.
    """
    joint = torch.zeros(readings.outcomes ** p.shape[1], n_classes, dtype=torch.float64)
    for start in range(0, len(p), CHUNK):
        words = readings.word_chances(p[start : start + CHUNK].double())
        of_class = torch.nn.functional.one_hot(labels[start : start + CHUNK], n_classes).double()
        joint += words.T @ of_class
    return joint / len(p)


def fit_head_exactly(
    head: Heads,
    joint: Tensor,
    steps: int = STEPS,
    rate: float = RATE,
    *,
    more: _Shots | None = None,
    readings: Readings = CLICKS,
) -> None:
    """Fit the head to `joint` (words, classes): the whole training set at every step, with a falling rate.

    `more` adds the loss of several shots, by sampling.
    """
    words, target = readings.words(head.norm.gain.numel()), joint.float()
    optimiser = torch.optim.Adam(head.parameters(), lr=rate)
    head.eval()  # the normalisation stays: its mean is exact
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.zero_grad()
        loss = -(target * torch.log_softmax(head(words), dim=1)).sum()
        if more is not None:
            loss = (1 - SHARE_OF_SHOTS) * loss + SHARE_OF_SHOTS * more.loss(head)
        loss.backward()
        optimiser.step()


def fit_head_by_samples(
    head: Heads,
    p: Tensor,
    target: Tensor,
    loss_of: LossOf,
    random: torch.Generator,
    *,
    batch: int = 512,
    rate: float = 1e-3,
    more: _Shots | None = None,
    readings: Readings = CLICKS,
) -> None:
    """Fit the head to sampled clicks of objects with click probabilities `p` (n, d_f), with a falling rate."""
    optimiser = torch.optim.Adam(head.parameters(), lr=rate)
    head.eval()
    for epoch in range(SAMPLED_EPOCHS):
        optimiser.param_groups[0]["lr"] = rate * (1 - epoch / SAMPLED_EPOCHS)
        for which in torch.randperm(len(p), generator=random).split(batch):
            optimiser.zero_grad()
            loss = loss_of(head(readings.sample(p[which], random).float()), target[which]).mean()
            if more is not None:
                loss = (1 - SHARE_OF_SHOTS) * loss + SHARE_OF_SHOTS * more.loss(head)
            loss.backward()
            optimiser.step()


class _Shots:
    """Losses of mean clicks of several shots, each of a batch of objects and a number of shots drawn at random."""

    def __init__(
        self,
        p: Tensor,
        target: Tensor,
        loss_of: LossOf,
        random: torch.Generator,
        shots: int,
        readings: Readings,
        batch: int = 512,
    ) -> None:
        self.readings = readings
        self.p, self.target, self.loss_of, self.random, self.batch = p, target, loss_of, random, batch
        self.numbers = [number for number in SHOTS if number <= shots] or [shots]

    def loss(self, head: Heads) -> Tensor:
        """Return the mean loss of one batch."""
        which = torch.randint(len(self.p), (self.batch,), generator=self.random)
        shots = self.numbers[int(torch.randint(len(self.numbers), (1,), generator=self.random))]
        p = self.p[which]
        counts = torch.stack([self.readings.sample(p, self.random) for _ in range(shots)]).sum(dim=0)
        return self.loss_of(head((counts / shots).float()), self.target[which]).mean()


def fit_head(
    head: Heads,
    p: Tensor,
    target: Tensor,
    loss_of: LossOf,
    random: torch.Generator,
    *,
    shots: int = 1,
    batch: int = 512,
    rate: float = 1e-3,
    readings: Readings = CLICKS,
) -> None:
    """Fit `head` to click probabilities `p` (n, d_f) of all training objects, for 1 to `shots` shots; of `readings` p are their chances.

    The words of one shot are enumerated where they are few enough and a class is asked for by cross-entropy. The normalisation is set
    to the exact mean before.
    """
    head.norm.running_mean.copy_(readings.mean(p).mean(dim=0))
    more = _Shots(p, target, loss_of, random, shots, readings) if shots > 1 else None
    if readings.outcomes ** p.shape[1] <= EXACT_WORDS_MAX and loss_of is cross_entropy:
        assert not isinstance(head, PictureHead), "pictures have no cross-entropy"
        joint = joint_distribution(p, target, head.output.out_features, readings)
        fit_head_exactly(head, joint, more=more, readings=readings)
    else:
        fit_head_by_samples(head, p, target, loss_of, random, batch=batch, rate=rate, more=more, readings=readings)
    head.eval()
