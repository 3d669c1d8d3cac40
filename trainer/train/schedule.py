"""What changes in the course of a training: stages, learning rates, black, slope, clamp and loss.

Owns every schedule, as functions of the options and of `now`, the epochs that have passed (with the part of the present one);
never holds state and never trains.
"""

from __future__ import annotations

import math

from pans.trainer.model.estimators import LossOf, decision_loss, similarity_loss
from pans.trainer.options import STRAIGHT_THROUGH, Options


def second_stage(options: Options) -> int:
    """Return the epoch at which stage 2 begins; the end when there is no stage 2."""
    return options.epochs if options.estimator in STRAIGHT_THROUGH else round(options.warm * options.epochs)


def whole_levels(options: Options) -> int:
    """Return the epoch at which the patterns become whole levels."""
    return round(0.75 * options.epochs)


def estimator(options: Options, epoch: int) -> str:
    """Return the name of the estimator of an epoch."""
    first = options.estimator if options.estimator in STRAIGHT_THROUGH else "ste"
    return first if epoch < second_stage(options) else options.estimator


def stage(options: Options, epoch: int) -> str:
    """Return the name of the stage of an epoch, for reports."""
    return estimator(options, epoch) + (", levels" if epoch >= whole_levels(options) else "")


def rates(options: Options, now: float) -> tuple[float, float]:
    """Return learning rates of patterns and head: one cycle per estimator, the second one half as high in front."""
    if options.constant:
        return options.front_rate, options.head_rate
    first, second = now < second_stage(options), second_stage(options)
    start, end = (0, second) if first else (second, options.epochs)
    at = (now - start) / (end - start)
    rising, falling = math.pi * at / 0.25, math.pi * (at - 0.25) / 0.75
    cycle = 0.5 - 0.5 * math.cos(rising) if at < 0.25 else 0.5 + 0.5 * math.cos(falling)
    front = options.front_rate * (1.0 if first else 0.5)
    return front * cycle + 1e-6, options.head_rate * cycle + 1e-6


def black(options: Options, now: float, floor: float) -> float:
    """Return the transmission of black: 0 in stage 1, then rising to the modulator's; patterns found at once are worse by points."""
    start = 0.3 * options.epochs if options.estimator in STRAIGHT_THROUGH else second_stage(options)
    return floor * min(1.0, max(0.0, (now - start) / (0.4 * options.epochs)))


def slope_and_clamp(options: Options, now: float) -> tuple[float, float]:
    """Return the factor on the light and the most photoelectrons that count; 1 and infinity once stage 1 is over."""
    done = min(1.0, now / (0.3 * options.epochs))
    if now >= second_stage(options) or done == 1.0:
        return 1.0, math.inf
    return options.slope ** (1 - done), options.clamp


def loss_at(options: Options, now: float, picture_shape: tuple[int, int] | None) -> LossOf:
    """Return the cross-entropy, which turns to wrong decisions in the last part of the epochs; of pictures error and similarity.

    Similarity waits for stage 2, where there is one: it takes most of the time, and to start without it cost nothing measurable.
    """
    if picture_shape is not None:
        waits = now < second_stage(options) < options.epochs
        return similarity_loss(0.0 if waits else options.similarity, picture_shape)
    part = options.polish * options.epochs
    into = now - (options.epochs - part)
    return decision_loss(min(1.0, into / (0.3 * part)) if part > 0 and into > 0 else 0.0)
