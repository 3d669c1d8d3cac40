"""The last stage of training: the patterns stay, the head is fitted to what they show.

Where the click words can be enumerated, one shot is fitted to the exact joint distribution of word and class, the whole training set at
every step; more shots, and more patterns, by sampling. The head takes mean clicks, so one head serves all numbers of shots; means of
several shots lie between the words, where a head that saw words alone has never been.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from pans_trainer.model.estimators import CLICKS, LossOf, Readings, cross_entropy
from pans_trainer.model.heads import Heads, PictureHead
from pans_trainer.options import EXACT_WORDS_MAX

SHOTS = (2, 3, 5, 8, 13, 21, 34, 55)  # numbers of shots that are fitted beside one, up to the largest wanted
SHARE_OF_SHOTS = 0.3  # of the loss, for all numbers of shots beside one
SHOTS_BATCH = 512  # objects of a step for these
CHUNK = 2000  # objects per pass where no gradient is needed
STEPS = 1500  # where the words are enumerated
SAMPLED_EPOCHS = 10
RATE = 2e-3

Losses = Iterator[tuple[float, Tensor]]  # a rate and a loss for every step


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
    head.eval()  # the normalisation stays: its mean is exact
    numbers = [number for number in SHOTS if number <= shots] or [shots]

    def of_shots() -> Tensor:
        """The mean loss of mean clicks of several shots, of a batch of objects and a number of shots drawn at random."""
        which = torch.randint(len(p), (SHOTS_BATCH,), generator=random)
        number = numbers[int(torch.randint(len(numbers), (1,), generator=random))]
        counts = torch.stack([readings.sample(p[which], random) for _ in range(number)]).sum(dim=0)
        return loss_of(head((counts / number).float()), target[which]).mean()

    def sampled() -> Losses:
        for epoch in range(SAMPLED_EPOCHS):
            for which in torch.randperm(len(p), generator=random).split(batch):
                loss = loss_of(head(readings.sample(p[which], random).float()), target[which]).mean()
                yield rate * (1 - epoch / SAMPLED_EPOCHS), loss

    losses = sampled()
    if readings.outcomes ** p.shape[1] <= EXACT_WORDS_MAX and loss_of is cross_entropy:
        assert not isinstance(head, PictureHead), "pictures have no cross-entropy"
        losses = exact_losses(head, joint_distribution(p, target, head.output.out_features, readings), readings)
    descend(head, losses, of_shots if shots > 1 else None)


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


def exact_losses(head: Heads, joint: Tensor, readings: Readings = CLICKS) -> Losses:
    """Yield rates and losses of `joint` (words, classes): the whole training set at every step, with a falling rate."""
    words, target = readings.words(head.norm.gain.numel()), joint.float()
    for step in range(STEPS):
        rate = RATE * 0.5 * (1 + math.cos(math.pi * step / STEPS))
        yield rate, -(target * torch.log_softmax(head(words), dim=1)).sum()


def descend(head: Heads, losses: Losses, more: Callable[[], Tensor] | None = None) -> None:
    """Take a step of Adam for each of `losses`, to which `more` adds the loss of several shots."""
    optimiser = torch.optim.Adam(head.parameters())
    for rate, loss in losses:
        optimiser.param_groups[0]["lr"] = rate
        if more is not None:
            loss = (1 - SHARE_OF_SHOTS) * loss + SHARE_OF_SHOTS * more()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
