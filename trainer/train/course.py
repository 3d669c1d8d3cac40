"""The course of a training: accuracy on training and held-out objects, and how uneven the patterns are, after every epoch.

Owns the measuring between epochs; training is that of train.Run, whose random numbers it never touches. SIMULATED.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import Profile
from pans.trainer.model.detection import click_probability, sample_clicks
from pans.trainer.model.encoders import ActiveIllumination
from pans.trainer.options import Options
from pans.trainer.tasks.registry import Task

from .data import CHUNK, TrainingData, encoder_input
from .loop import EpochReport, Run, Trained

TRAINING_OBJECTS = 5000  # by which the accuracy on training objects is judged: the first ones
FIRST = 200


@dataclass(frozen=True, slots=True)
class EpochFigures:
    """The state after one epoch, one draw of clicks (K = 1); accuracies in %. The light is the mean over the epoch's batches."""

    loss: float
    training: float
    held_out: float
    held_out_first_200: float
    clicks: float
    photons: float
    illumination: float
    peak: float  # brightest pixel over the mean of all pixels of all patterns


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """All epochs, the patterns (d_f, pixels) after some of them, and the finished model."""

    epochs: list[EpochFigures]
    patterns: dict[int, NDArray[np.float32]]
    trained: Trained

    def columns(self) -> dict[str, list[float]]:
        """Return the figures of all epochs, one list per quantity, five digits each."""
        rows = [asdict(epoch) for epoch in self.epochs]
        return {key: [float(f"{row[key]:.5g}") for row in rows] for key in rows[0]}


def follow(
    task: Task,
    profile: Profile,
    options: Options,
    *,
    patterns_after: tuple[int, ...] = (),
    report: Callable[[EpochReport], None] = lambda _: None,
) -> Course:
    """Train one run of active illumination by `options` and judge it after every epoch; the result is that of `train`.

    UsageError for passive encoders.
    """
    if options.encoder != "active":
        raise UsageError(f"the course of a training with --encoder {options.encoder}", remedy="--encoder active")
    data = TrainingData(task, profile, options)
    run = Run(data, profile, options, 0)
    assert isinstance(run.encoder, ActiveIllumination)
    held_out, labels = encoder_input(task, task.test, profile, options), torch.from_numpy(task.test.labels)
    n = min(TRAINING_OBJECTS, data.n_fit)
    random = torch.Generator().manual_seed(options.seed)
    epochs: list[EpochFigures] = []
    patterns: dict[int, NDArray[np.float32]] = {}
    while run.epoch < options.epochs:
        told = run.one_epoch()
        report(told)
        of_training = _right(run, data.shown[:n], data.labels[:n], random)
        of_held_out = _right(run, held_out, labels, random)
        intensity = (run.encoder.weight.detach() ** 2).cpu().numpy()
        epochs.append(
            EpochFigures(
                loss=told.loss,
                training=100 * float(of_training.mean()),
                held_out=100 * float(of_held_out.mean()),
                held_out_first_200=100 * float(of_held_out[:FIRST].mean()),
                clicks=told.clicks,
                photons=told.photons,
                illumination=told.illumination,
                peak=float(intensity.max() / intensity.mean()),
            )
        )
        if run.epoch in patterns_after:
            patterns[run.epoch] = intensity
    return Course(epochs, patterns, run.finish((run.validation_loss(),)))


def _right(run: Run, shown: Tensor, labels: Tensor, random: torch.Generator) -> Tensor:
    """Whether each object is decided right, from one draw of clicks by the present patterns and head."""
    law = run.law()
    run.head.eval()
    with torch.no_grad():
        p = torch.cat([click_probability(run.encoder(part, run.data.floor), law) for part in shown.split(CHUNK)])
        return (run.head(sample_clicks(p, random).float()).argmax(dim=1) == labels).double()
