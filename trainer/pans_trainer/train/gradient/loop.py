"""Training through the instrument: one flat loop from random patterns to whole projector levels and a finished head.

`train` returns a `Trained` whose patterns are already what the projector will show. Stages (one epoch is one pass over the training
objects):

1. straight-through on sampled clicks (paper, algorithm for active PANS), on an object modulator with perfect black;
2. with the exact estimator: the expectation over all 2**d_f click words, while black rises to what the modulator can do;
3. the same with patterns rounded to levels; the photoelectrons of the top level are trained with them;
4. the patterns stay, the head is fitted to them alone.

What changes in the course of a training (stages, rates, black, slope, loss) are functions of the options and of `now`, the epochs that have
passed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.base.errors import as_usage_error
from pans.bundle.making import QuantisedPatterns, quantise_patterns
from pans.instrument.click_law import CountLaw, count_law
from pans.instrument.detector import Afterpulses, crosstalk_of
from pans.instrument.profile import Profile
from pans_trainer.device import new_generator
from pans_trainer.model.detection import Law, trained_through, with_crosstalk, with_mean_memory
from pans_trainer.model.encoders import ActiveIllumination, Encoder, concentration, new_encoder
from pans_trainer.model.estimators import (
    ESTIMATORS,
    LossOf,
    cross_entropy,
    decision_loss,
    readings_of,
    similarity_loss,
)
from pans_trainer.model.exposure import exposure_us_of
from pans_trainer.model.field_basis import in_pixels
from pans_trainer.model.heads import Heads, new_head
from pans_trainer.options import BUDGETS, EXACT_WORDS_MAX, STRAIGHT_THROUGH, Options, check_options
from pans_trainer.tasks.registry import Task

from .checkpoint import read_checkpoint, write_checkpoint
from .data import CHUNK, TrainingData
from .head_fit import fit_head

VALIDATION_SAMPLES = 8  # of the clicks, where the words cannot be enumerated
DUAL_RATE = 0.02  # how fast the weight of a budget follows its excess, per batch; faster where the batches are few
DUAL_TRAVEL = 20.0  # the least sum of these rates over a training, so that small tasks reach their budgets too
DUAL_RATE_MAX = 0.06
# of patterns through optics, from the start: dark pixels leak a part of the top level, which is then trained too
FINE_LEVELS = 1 << 16
FINAL_DRAWS = 1 << 40  # of optics: those of validation and of the head's fit come after those of all epochs
HEAD_DRAWS = 4  # optics through which the head sees every object when it is fitted


def second_stage(options: Options) -> int:
    """Return the epoch at which stage 2 begins; the end when there is no stage 2."""
    return options.epochs if options.estimator in STRAIGHT_THROUGH else round(options.warm * options.epochs)


def whole_levels(options: Options) -> int:
    """Return the epoch at which the patterns become whole levels."""
    return round(0.75 * options.epochs)


def estimator_at(options: Options, epoch: int) -> str:
    """Return the name of the estimator of an epoch."""
    first = options.estimator if options.estimator in STRAIGHT_THROUGH else "ste"
    return first if epoch < second_stage(options) else options.estimator


def stage_at(options: Options, epoch: int) -> str:
    """Return the name of the stage of an epoch, for reports."""
    return estimator_at(options, epoch) + (", levels" if epoch >= whole_levels(options) else "")


def rates_at(options: Options, now: float) -> tuple[float, float]:
    """Return the learning rates of patterns and head: one cycle per estimator, the second one half as high in front."""
    if options.constant:
        return options.front_rate, options.head_rate
    first, second = now < second_stage(options), second_stage(options)
    start, end = (0, second) if first else (second, options.epochs)
    at = (now - start) / (end - start)
    rising, falling = math.pi * at / 0.25, math.pi * (at - 0.25) / 0.75
    cycle = 0.5 - 0.5 * math.cos(rising) if at < 0.25 else 0.5 + 0.5 * math.cos(falling)
    front = options.front_rate * (1.0 if first else 0.5)
    return front * cycle + 1e-6, options.head_rate * cycle + 1e-6


def black_at(options: Options, now: float, floor: float) -> float:
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


@dataclass(frozen=True, slots=True)
class EpochReport:
    """How one epoch went: means over its batches."""

    restart: int
    epoch: int
    stage: str
    patterns: NDArray[np.float32] = field(repr=False, compare=False)  # (d_f, pixels), or the modulus of W
    loss: float
    clicks: float
    photons: float
    illumination: float


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """A finished model: the shown patterns, the head in evaluation mode, the law it was trained for."""

    quantised: QuantisedPatterns | None  # of active sensing; None of a passive encoder
    encoder: Encoder
    head: Heads
    click_mean: Tensor  # mean of what the head is given of every pattern over the training objects, float64 (d_f,)
    law: Law | CountLaw
    validation_losses: tuple[float, ...]  # of all restarts
    options: Options


def train(
    task: Task,
    profile: Profile,
    options: Options,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Callable[[EpochReport], None] = lambda _: None,
    law: Law | None = None,
) -> Trained:
    """Train `task` through `profile`; the same options, machine and number of threads give the same result.

    `law` replaces the click law of the profile (thermal light, or any differentiable function from photoelectrons to p); what
    is exported is still judged by the profile's. A checkpoint does not know of it. With `Options.fields` the encoder is trained as
    coefficients of fields (model/field_basis.py), and the one returned is W = coefficients @ basis.T.

    After every epoch the state goes to `checkpoint`; with `resume` a run continues from there. KeyboardInterrupt passes
    through, with the state of the last whole epoch on disk.
    """
    check_options(options, profile)
    data = TrainingData(task, profile, options)
    saved = read_checkpoint(checkpoint, options, task.sha256) if resume and checkpoint else {}
    best: dict[str, Any] | None = saved.get("best")
    losses: list[float] = saved.get("losses", [])
    for restart in range(len(losses), options.restarts):
        started: list[float] = saved.pop("started", [])  # losses of the starts of this restart
        chosen: dict[str, Any] | None = saved.pop("chosen", None)  # and the best of them
        for start in range(len(started), options.starts + 1):  # the last round continues with the best start
            seed = restart * options.starts + min(start, options.starts - 1)
            run = Run(data, profile, options, seed, law)
            if "run" in saved:
                run.restore(saved.pop("run"))
            elif start == options.starts and chosen is not None:
                run.restore(chosen)
            until = second_stage(options) if start < options.starts else options.epochs
            while run.epoch < until:
                report(run.one_epoch())
                if checkpoint:
                    now = {"run": run.state(), "best": best, "losses": losses, "started": started, "chosen": chosen}
                    write_checkpoint(checkpoint, options, task.sha256, now)
            if start < options.starts:
                started.append(run.validation_loss())
                chosen = run.state() if started[-1] <= min(started) else chosen
        losses = [*losses, run.validation_loss()]
        if losses[-1] <= min(losses):
            best = run.state()
    run = Run(data, profile, options, losses.index(min(losses)), law)
    if best is not None:
        run.restore(best)
    trained = run.finish(tuple(losses))
    if data.basis is None:
        return trained
    with torch.device("cpu"):  # as all of a finished model
        return replace(trained, encoder=in_pixels(trained.encoder, data.basis))


class Run:
    """One restart: patterns, head, optimiser, random numbers, and how far it has come."""

    def __init__(
        self, data: TrainingData, profile: Profile, options: Options, restart: int, law: Law | None = None
    ) -> None:
        self.own_law, self.readings = law, readings_of(options.outcomes)
        self.data, self.profile, self.options, self.restart = data, profile, options, restart
        self.crosstalk = crosstalk_of(profile) if options.outcomes == 2 else ()
        self.random = new_generator(options.seed + restart)
        self.encoder = new_encoder(data.shown.shape[1], profile, options, self.random)
        if data.optics is not None and isinstance(self.encoder, ActiveIllumination):
            self.encoder.start_quantising(FINE_LEVELS)
            self.encoder.pulled = True
        self.head = new_head(options, data.n_outputs, data.image_shape, self.random)
        self.epoch = 0
        steps = options.epochs * math.ceil(data.n_fit / options.batch)
        self.dual_rate = min(DUAL_RATE_MAX, max(DUAL_RATE, DUAL_TRAVEL / steps))
        # of the budgets; they follow the excess
        self.weights = dict.fromkeys(("photons", "clicks", "illumination"), 1e-3)
        self.optimiser = self._new_optimiser()

    # ---- the loop ----

    def one_epoch(self) -> EpochReport:
        """Pass once over the training objects, in random order."""
        options, data = self.options, self.data
        if self.epoch == second_stage(options):
            self.optimiser = self._new_optimiser()  # the moments of another estimator would mislead
        if self.epoch == whole_levels(options) and isinstance(self.encoder, ActiveIllumination):
            self.encoder.start_quantising(self.profile.projector.levels)
        readings, estimate = self.readings, ESTIMATORS[estimator_at(options, self.epoch)]
        law, traps = self.law(), self.afterpulses()
        order = torch.randperm(data.n_fit, generator=self.random)
        batches = [part for part in order.split(options.batch) if len(part) > 1]
        sums = torch.zeros(4, dtype=torch.float64)
        shown, lifted = data.drawn(
            self.restart * options.epochs + self.epoch, black_at(options, self.epoch, data.floor)
        )
        self.head.train()
        for i, batch in enumerate(batches):
            now = self.epoch + i / len(batches)
            light = self.encoder(shown[batch], black_at(options, now, data.floor) if data.optics is None else lifted)
            photons = light.sum(dim=1).mean()
            slope, clamp = slope_and_clamp(options, now)
            p = self._linked(readings.chances(light.clamp(max=clamp), law, slope), traps)
            loss_of = loss_at(options, now, data.picture_shape)
            loss = estimate(p, data.target[batch], self.head, loss_of, self.random, readings)
            if options.mix > 0 and self.epoch >= second_stage(options):
                loss = (1 - options.mix) * loss + options.mix * self._several_shots(p, data.target[batch], loss_of)
            clicks = readings.mean(p).sum(dim=1).mean() * (readings.outcomes - 1)
            illumination = self.encoder.illumination()
            total = loss + self._penalty(clicks, photons, illumination)
            for group, rate in zip(self.optimiser.param_groups, rates_at(options, now)):
                group["lr"] = rate
            self.optimiser.zero_grad()
            total.backward()
            self.optimiser.step()
            if isinstance(self.encoder, ActiveIllumination):
                self.encoder.dim_to_top()
            sums += torch.stack([loss, clicks, photons, illumination]).detach().double()
        stage = stage_at(options, self.epoch)
        self.epoch += 1
        squares = self.encoder.weight.detach().cpu().square()
        shown = squares.sum(dim=0).sqrt() if options.encoder == "coherent" else squares
        return EpochReport(self.restart, self.epoch, stage, shown.numpy(), *(sums / len(batches)).tolist())

    def _several_shots(self, p: Tensor, target: Tensor, loss_of: LossOf) -> Tensor:
        """The loss of mean clicks of 2 to `shots` shots, straight-through: the more shots, the smaller its bias."""
        shots = 2 + int(torch.randint(self.options.shots - 1, (1,), generator=self.random))
        clicks = torch.stack([self.readings.sample(p, self.random) for _ in range(shots)]).mean(dim=0)
        return loss_of(self.head(clicks, self.readings.mean(p).mean(dim=0)), target).mean()

    def law(self) -> Law | CountLaw:
        """The law at the exposure that the present brightest pixel needs; of passive sensing, at the shortest one."""
        if self.own_law is not None:
            return self.own_law
        return count_law(self.profile, self._exposure_us(), self.options.outcomes, self.options.dark)

    def afterpulses(self) -> Afterpulses | None:
        """What the clicks before add to a click at the same exposure, where that is trained through."""
        return None if self.own_law is not None else trained_through(self.profile, self._exposure_us())

    def _linked(self, p: Tensor, traps: Afterpulses | None) -> Tensor:
        """Chances of clicks with what other clicks add in the mean: those before, and those of neighbours in the same exposure."""
        return with_mean_memory(p if self.own_law is not None else with_crosstalk(p, self.crosstalk), traps)

    def _exposure_us(self) -> float:
        if not isinstance(self.encoder, ActiveIllumination):
            return self.profile.exposure.min_us
        low, high = self.encoder.top_limits
        return exposure_us_of(self.profile, min(max(self.encoder.brightest(), low), high))

    def _penalty(self, clicks: Tensor, photons: Tensor, illumination: Tensor) -> Tensor:
        """Return the price of the light: `alpha` per unit of illumination; that of a budget grows while it is exceeded, else it shrinks."""
        penalty = (self.options.alpha or 0.0) * illumination
        if self.options.spread and isinstance(self.encoder, ActiveIllumination):
            penalty = penalty + self.options.spread * concentration(self.encoder.patterns())
        for name, measured in (("photons", photons), ("clicks", clicks), ("illumination", illumination)):
            target = getattr(self.options, name)
            if target is not None:
                penalty = penalty + self.weights[name] * measured
                gain, weight_min = BUDGETS[self.options.budget]
                excess = min(1.0, max(-1.0, gain * (float(measured.detach()) / target - 1)))
                weight = self.weights[name] * math.exp(self.dual_rate * excess)
                self.weights[name] = min(10.0, max(weight_min, weight))
        return penalty

    def _new_optimiser(self) -> torch.optim.Adam:
        groups = [{"params": self.encoder.parameters()}, {"params": self.head.parameters()}]
        return torch.optim.Adam(groups, lr=1e-3)

    # ---- after the last epoch ----

    def probabilities(self, start: int, stop: int, draw: int = 0) -> Tensor:
        """Click probabilities, float64 (n, d_f), or chances of readings.py, of the training objects start..stop through the instrument.

        `draw` counts draws of optics that no epoch has seen.
        """
        law, traps, parts = self.law(), self.afterpulses(), []
        shown, floor = self.data.drawn(FINAL_DRAWS + draw, self.data.floor)
        with torch.no_grad():
            for first in range(start, stop, CHUNK):
                which = torch.arange(first, min(first + CHUNK, stop))
                parts.append(self.readings.chances(self.encoder(shown[which], floor).double(), law))
        return self._linked(torch.cat(parts), traps)

    def validation_loss(self) -> float:
        """The loss of the present epoch on the validation objects: exact where the words can be enumerated, else of 8 samples.

        With `mix`, several shots have the same share of it as of the training loss.
        """
        p = self.probabilities(self.data.n_fit, len(self.data.labels))
        target = self.data.target[self.data.n_fit :]
        loss_of = loss_at(self.options, self.epoch, self.data.picture_shape)
        random = new_generator(self.options.seed)
        self.head.eval()
        with torch.no_grad():
            readings = self.readings
            if readings.outcomes**self.options.features <= EXACT_WORDS_MAX and not self.data.is_image:
                scores, words = self.head(readings.words(self.options.features)).double(), readings.word_chances(p)
                one = float((words * loss_of(scores.unsqueeze(0), target.unsqueeze(1))).sum() / len(p))
            else:
                one = self._mean_loss(p, loss_of, 1, random)
            if self.options.mix == 0:
                return one
            numbers = range(2, self.options.shots + 1)
            more = [self._mean_loss(p, loss_of, shots, random) for shots in numbers]
            return (1 - self.options.mix) * one + self.options.mix * sum(more) / len(more)

    def _mean_loss(self, p: Tensor, loss_of: LossOf, shots: int, random: torch.Generator) -> float:
        """Return the mean loss of the validation objects over `VALIDATION_SAMPLES` draws of mean clicks of `shots` shots."""
        target, losses = self.data.target[self.data.n_fit :], []
        for _ in range(VALIDATION_SAMPLES):
            clicks = torch.stack([self.readings.sample(p, random) for _ in range(shots)]).mean(dim=0)
            losses.append(loss_of(self.head(clicks.float()), target).mean())
        return float(torch.stack(losses).mean())

    def finish(self, losses: tuple[float, ...]) -> Trained:
        """Freeze the optics (active: as levels), then fit the head to what they show of all training objects."""
        quantised = None
        if isinstance(self.encoder, ActiveIllumination):
            if self.encoder.levels != self.profile.projector.levels:  # too few epochs for the stage of whole levels
                self.encoder.start_quantising(self.profile.projector.levels)
            self.encoder.lower_top()
            with torch.no_grad():
                floats = (self.encoder.weight**2).cpu().numpy().copy()
            with as_usage_error():
                quantised = quantise_patterns(floats, self.profile.projector.levels, float(self.encoder.top().detach()))
        n, shape = len(self.data.labels), self.data.picture_shape
        draws = 1 if self.data.optics is None else HEAD_DRAWS
        p = torch.cat([self.probabilities(0, n, draw) for draw in range(draws)])
        fit_head(
            self.head,
            p,
            torch.cat([self.data.target] * draws),
            cross_entropy if shape is None else similarity_loss(self.options.similarity, shape),
            self.random,
            shots=self.options.shots,
            batch=self.options.batch,
            rate=self.options.head_rate,
            readings=self.readings,
        )
        mean, law = self.readings.mean(p).mean(dim=0).cpu(), self.law()
        self.encoder.cpu()  # what follows is export and judgement
        self.head.cpu()
        return Trained(quantised, self.encoder, self.head, mean, law, losses, self.options)

    # ---- checkpoints ----

    def state(self) -> dict[str, Any]:
        """Everything that the next epoch depends on, as copies."""
        copied = {
            name: {key: value.clone() for key, value in module.state_dict().items()} for name, module in self._modules()
        }
        return copied | {
            "optimiser": self.optimiser.state_dict(),
            "random": self.random.get_state(),
            "epoch": self.epoch,
            "weights": dict(self.weights),
            "levels": self.encoder.levels,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        for name, module in self._modules():
            module.load_state_dict(state[name])
        self.optimiser.load_state_dict(state["optimiser"])
        self.random.set_state(state["random"])
        self.epoch, self.weights = state["epoch"], dict(state["weights"])
        if isinstance(self.encoder, ActiveIllumination):
            self.encoder.levels = state["levels"]

    def _modules(self) -> tuple[tuple[str, torch.nn.Module], ...]:
        return ("encoder", self.encoder), ("head", self.head)
