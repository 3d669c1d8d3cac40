"""Training of an automaton: grow, tune, one bit, reroute, meet the budget, calibrate; a checkpoint after each step.

`train_automaton` returns a `TrainedAutomaton` whose figures are of objects held back; the held-out objects stay unseen.

Sources: finite-state controllers and their improvement (Hansen 1998), decision jungles (Shotton et al. 2013), the agglomerative
information bottleneck (Slonim and Tishby 1999), distillation (Hinton, Vinyals and Dean 2015), sequential decisions
on photons (Chen and Perona 2017) and in general (Wald 1945).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pans.bundle.automaton import Automaton
from pans.bundle.sensor import Bundle, Shown
from pans.instrument.profile import Profile
from pans_trainer.device import new_generator, product_dtype
from pans_trainer.model.detection import trained_through
from pans_trainer.model.exposure import exposure_us_of, top_limits
from pans_trainer.options import AutomatonOptions
from pans_trainer.tasks.registry import Objects, Task
from pans_trainer.train.gradient.checkpoint import read_checkpoint, write_checkpoint
from pans_trainer.train.gradient.teacher import Taught, read_targets, soft_targets, write_targets

from .budget import (
    aim_at,
    check_automaton_options,
    fades_of,
    first_prices,
    for_task,
    patterns_at_most,
    tune_epochs_of,
    with_defaults,
)
from .finish import (
    Posteriors,
    bit_grid,
    calibrated,
    finished,
    meet_budget,
    node_counts,
    send_evenly,
    set_top,
    to_grid,
)
from .grow import Growth
from .machine import (
    COUNT_FLOOR,
    Aim,
    Bits,
    Grey,
    Machine,
    Sight,
    Spent,
    as_bits,
    forward,
    machine_from,
    machine_of,
    machine_state,
)
from .objects import Block, TrainingObjects
from .outcomes import by_row, law_of
from .sweeps import choose_patterns, reroute, share_patterns
from .tune import Figures, Progress, Tuning, figures, hold_cap, masses, mean_objects

KEPT_EVERY = 8  # levels: a checkpoint holds all patterns
REACH_BLOCKS = 3  # of objects, by which it is judged how often a state is reached
CHOICES, CHOICE_BLOCKS = 3, 20  # of shared patterns, before they are tuned; blocks of objects for one of them
GROWTH_BLOCK = 1000  # objects; larger than in tuning, as fewer steps serve one level
REROUTE_NUMBERS = 1 << 29  # objects times states that a sweep keeps: 2 GiB
TOP_SHARE = 0.99  # of the exposures of all objects need no brighter pixel than the top
HEADROOM = 1.25  # of the top over that, where states send the same light: they would light more pixels for it from epoch to epoch
DARK_COUNTS = 0.5  # per decision, at most: 0.15 to 0.8 were tried on held-back images (docs/measurements/index.md)
BUDGET_BLOCKS = 6  # of objects, by which the budget is met
CAP_ROUNDING = 1e-6  # of a cap on the dose, for sums in float32
STAGES = ("grow", "grey", "shown")
NETWORK = "network"  # a stage before them, where targets are soft
FIRST_EPOCH = {"grey": 1, "shown": 100_001}  # in the order of all: no epoch repeats the order and shifts of another


@dataclass(frozen=True, slots=True, eq=False)
class TrainedAutomaton:
    """What a bundle holds, and figures of the held-back objects; `prices` are nats per photoelectron detected and sent in the end."""

    shown: Shown
    automaton: Automaton
    machine: Machine
    posteriors: Posteriors
    sight: Sight
    grey: Callable[[Objects], torch.Tensor]  # grey values as the machine takes them, float64 (objects, pixels)
    held_back: Figures
    prices: tuple[float, float]
    options: AutomatonOptions

    def chances(self, objects: Objects) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the chance of every class by the leaves' posteriors, (objects, classes), and photons (objects,), without afterpulses."""
        with torch.no_grad():
            passed = forward(self.machine, self.sight.exact(), self.grey(objects))
        total = np.zeros((len(objects), self.posteriors.levels[0].shape[1]))
        for number, leaves in enumerate(passed.leaves):
            posterior = self.posteriors.levels[number + 1]
            total += leaves.T.cpu().numpy() @ posterior[len(posterior) - len(leaves) :]
        return total, passed.photons().cpu().numpy()


def train_automaton(
    task: Task,
    profile: Profile,
    options: AutomatonOptions,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    report: Callable[[Progress], None] = lambda _: None,
    held_back: int = 0,
    teacher: Path | None = None,
    start: Bundle | None = None,
) -> TrainedAutomaton:
    """Train `task` through `profile`; the same options, machine and number of threads give the same result.

    After every level and epoch the state goes to `checkpoint`; with `resume` a training continues from there. `held_back` objects (0: one
    in twelve) set the price and calibrate; no pattern is trained on them. Soft targets are read from the file
    `teacher` where there is one, else made and kept there. With `start`, an automaton that `started_from` gave
    the options for, nothing is grown: its patterns and edges are trained on. KeyboardInterrupt passes through.
    """
    check_automaton_options(options, task, profile)
    saved = read_checkpoint(checkpoint, options, task.sha256) if resume and checkpoint else {}
    run = _Run(task, profile, options, report, held_back)
    if saved:
        run.restore(saved["run"])
    elif start is not None:
        run.start_from(start)

    def keep() -> None:
        if checkpoint:
            write_checkpoint(checkpoint, options, task.sha256, {"run": run.state()})

    run.soften(task, teacher, keep)
    run.grow(keep)
    run.tune("grey", tune_epochs_of(options), options.tune_rate, keep)
    run.start_showing()
    run.tune("shown", options.epochs, options.rate, keep)
    return run.finish()


class _Run:
    """One training: the machine, its stage and epoch, the price, and the optimiser of the present stage."""

    def __init__(
        self,
        task: Task,
        profile: Profile,
        options: AutomatonOptions,
        report: Callable[[Progress], None],
        held_back: int,
    ) -> None:
        self.profile, self.options, self.report = profile, for_task(options, task.name), report
        options = self.options
        self.objects = TrainingObjects(task, profile, options, held_back)
        self.exposures, self.states = with_defaults(options, profile)
        self.stage, self.epoch = "grow", 0
        self.machine = Machine([], [])
        self.prices = first_prices(options)
        self.tuning: Tuning | None = None
        self.saved_tuning: dict[str, Any] | None = None
        self.products = product_dtype()
        self.cap = math.inf if options.dose_cap is None else options.dose_cap * (1 - CAP_ROUNDING)
        self.answers: NDArray[np.float32] | None = None

    @property
    def steps(self) -> int:
        """Levels to grow and epochs to tune."""
        return self.exposures + tune_epochs_of(self.options) + self.options.epochs

    def _prices(self) -> tuple[float, float]:
        return self.prices.detected, self.prices.sent

    # ---- the instrument ----

    def sight(self, products: torch.dtype = torch.float32) -> Sight:
        """How the instrument sees objects at the exposure that the present brightest pixel needs."""
        low, high = top_limits(self.profile)
        top = self.machine.levels[0].light.top if self.stage == "shown" else low
        exposure_us = exposure_us_of(self.profile, min(high, max(low, top)))
        asked = self.options
        law = law_of(self.profile, exposure_us, asked.outcomes, asked.channels, asked.dark)
        links = trained_through(self.profile, exposure_us)
        fades = fades_of(asked, self.objects.n_pixels) if self.stage != "grow" else math.inf
        return Sight(law, self.objects.gain, self.objects.floor, products, asked.optics is not None, links, fades)

    # ---- the stages ----

    def start_from(self, start: Bundle) -> None:
        """Take the states and patterns of `start` in place of growing, and count its leaves on some of the objects."""
        self.machine, self.stage = machine_of(start), "shown"
        lights = [level.light for level in self.machine.levels if isinstance(level.light, Bits)]
        low = top_limits(self.profile)[0]
        if self._one_brightness():
            for light in lights:
                light.log_light, light.bottom = lights[0].log_light, low
        self._set_top(max(float(light.log_light.max().exp()) for light in lights))
        self._send_evenly()
        found = node_counts(self.machine, self.sight(self.products), self._some_blocks())
        share = self.objects.n_fit / float(found[0].sum())
        for counts, arrived in zip(self.machine.counts, found[1:]):
            counts.add_(torch.from_numpy(arrived[len(arrived) - len(counts) :]), alpha=share).add_(COUNT_FLOOR)

    def soften(self, task: Task, file: Path | None, keep: Callable[[], None]) -> None:
        """Let a network's answers take the place of the labels, as far as is wanted: those of the checkpoint, of `file`, or new ones."""
        weight = self.options.soft
        if not weight:
            return
        taught = Taught(task.sha256, self.objects.n_fit, self.options.teacher_epochs)
        if self.answers is None and file is not None and file.exists():
            self.answers = read_targets(file, taught, self.objects.n_classes)
        if self.answers is None:
            epochs, prices = self.options.teacher_epochs, self._prices()

            def report(epoch: int, loss: float) -> None:
                self.report(Progress(NETWORK, epoch + 1, epochs, loss, math.nan, *Spent(), *prices))

            self.answers = soft_targets(self.objects.fitted, self.objects.n_classes, epochs, report)
            if file is not None:
                write_targets(file, self.answers, taught)
            keep()
        self.objects.soften(self.answers, weight)

    def grow(self, keep: Callable[[], None]) -> None:
        """Grow levels until there are as many as exposures."""
        if self.stage != "grow":
            return
        blocks = self.objects.epoch(0, GROWTH_BLOCK, self.products, plain=True)
        with torch.no_grad():
            sight, random = self.sight(self.products), new_generator(self.options.seed)
            growth = Growth(blocks, sight, random, self.options, self.states, self._highest_top())
            growth.follow(self.machine.levels)
            while len(growth.levels) < self.exposures:
                aim = aim_at(self.options, len(growth.levels), self.exposures, growth.spent)
                growth.grow(aim)
                self.machine = growth.machine()
                self.report(self._grown(growth, aim))
                if len(growth.levels) % KEPT_EVERY == 0:
                    keep()
        self.stage, self.epoch = "grey", 0
        self._send_evenly()

    def _grown(self, growth: Growth, aim: Aim) -> Progress:
        counts = growth.counts
        known, n = counts / counts.sum(dim=1, keepdim=True).clamp(min=1e-9), float(counts.sum())
        loss = -float(torch.special.xlogy(counts, known).sum()) / n
        right = float(counts.amax(dim=1).sum()) / n
        return Progress("grow", len(growth.levels), self.steps, loss, right, *growth.spent, aim.price, aim.sent_price)

    def _some_blocks(self) -> list[Block]:
        """Some of the objects, by which it is judged how often a state is reached."""
        return self.objects.epoch(0, GROWTH_BLOCK, self.products, plain=True)[:REACH_BLOCKS]

    def _masses(self) -> list[torch.Tensor]:
        return masses(self.machine, self.sight(self.products), self._some_blocks())

    @torch.no_grad()
    def start_showing(self) -> None:
        """Kernel grey patterns into what the projector shows: one bit and a brightness, or whole levels."""
        if self.stage != "grey":
            return
        low, high = top_limits(self.profile)
        shown = [level.light.displayed() for level in self.machine.levels]
        lights = [mask if scale is None else mask * scale for mask, scale in shown]
        if self.options.grey:
            top = min(high, max(low, max(float(light.max()) for light in lights)))
            for level, light in zip(self.machine.levels, lights):
                level.light = Grey(light.clamp(max=top).sqrt(), top, self.profile.projector.levels)
        else:
            self._start_bits(lights, low)
        self.stage, self.epoch, self.tuning = "shown", 0, None

    def _send_evenly(self) -> None:
        """With a cap on the dose, let every walk send it."""
        if self.cap < math.inf:
            fades = fades_of(self.options, self.objects.n_pixels)
            send_evenly(self.machine, self._masses(), self.cap, fades)
            self.prices.drop_sent()

    def _highest_top(self) -> float:
        """Return the brightest top that the profile allows and that brings no more than `DARK_COUNTS` to a decision."""
        low, high = top_limits(self.profile)
        rate_hz = self.profile.detector.dark_rate_hz
        if rate_hz > 0:
            exposure_s = DARK_COUNTS / (self.exposures * self.options.channels) / rate_hz
            high = min(high, max(low, self.profile.projector.peak_photoelectrons_hz * exposure_s))
        return high

    def _one_brightness(self) -> bool:
        return self.profile.projector.levels == 2 and self.profile.projector.dwell_steps == 1

    def _start_bits(self, lights: list[torch.Tensor], low: float) -> None:
        shared, top = self._one_brightness(), self._highest_top()
        parts = self.options.channels
        means = list(mean_objects(self.machine, self.sight(self.products), self._some_blocks()))
        made = [as_bits(light, by_row(own, parts), top, parts) for light, own in zip(lights, means)]
        typical = torch.cat([bits.log_light for bits in made]).median().reshape(1, 1)
        for level, bits in zip(self.machine.levels, made):
            if shared:
                bits.log_light, bits.bottom = typical, low
            if level.light.even and level.light.log_light is not None:
                bits.log_light, bits.even = level.light.log_light, True
            bits.settle()
            level.light = bits
        most = patterns_at_most(self.options, self.profile)
        if most < sum(len(light) for light in lights):
            share_patterns(self.machine, most, self._masses(), means, new_generator(self.options.seed + 1))
            for _ in range(CHOICES):
                self._choose_patterns()
            # the price would else rise for a whole epoch until the brightness has followed it
            meet_budget(self.machine, self.prices, None, self.sight, self._drawn())

    def tune(self, stage: str, epochs: int, rate: float, keep: Callable[[], None]) -> None:
        """Train all levels together for the rest of a stage's epochs."""
        if self.stage != stage:
            return
        size = self.options.batch
        steps = max(1, epochs * -(-self.objects.n_fit // size))
        if self.tuning is None:
            self.tuning = Tuning(self.machine, self.sight(self.products), self.prices, rate, steps)
            self.tuning.exposure_price, self.tuning.spread = self.options.exposure_price, self.options.spread
            self.tuning.cap = self.cap
            if self.saved_tuning is not None:
                self.tuning.restore(self.saved_tuning)
                self.saved_tuning = None
        while self.epoch < epochs:
            if stage == "shown" and not self.options.grey:
                self._choose_top()
            self.tuning.sight = self.sight(self.products)
            self.tuning.decide = self.options.decide if stage == "shown" and self.epoch else 0.0
            if stage == "shown" and 1 <= self.epoch <= min(self.options.reroutes, epochs - 2):
                sight, blocks = self.tuning.sight, self._sweep_blocks()
                reroute(self.machine, sight, blocks, self.prices.aim(self.options.exposure_price))
            if stage == "shown" and 1 <= self.epoch <= epochs - 2:
                self._choose_patterns()
            blocks = self.objects.epoch(FIRST_EPOCH[stage] + self.epoch, size, self.products)
            found = [*self.tuning.epoch(blocks), *self._prices()]
            self.epoch += 1
            before = self.exposures + (tune_epochs_of(self.options) if stage == "shown" else 0)
            self.report(Progress(stage, before + self.epoch, self.steps, *found))
            keep()

    def _choose_top(self) -> None:
        """Set the brightness of the top, which sets the exposure, by what most objects meet; brighter states are dimmed to it.

        One bright state that is hardly ever reached would else bring its dark counts to every exposure.
        """
        lights = torch.cat([level.light.brightness().flatten() for level in self.machine.levels])  # type: ignore[union-attr]
        masses, order = torch.cat(self._masses()), lights.argsort()
        below = masses[order].cumsum(0) / masses.sum()
        top = float(lights[order][int((below < TOP_SHARE).sum().clamp(max=len(lights) - 1))])
        self._set_top(top if self.cap == math.inf else HEADROOM * top)

    def _set_top(self, top: float) -> None:
        set_top(self.machine, min(self._highest_top(), max(top_limits(self.profile)[0], top)), self.profile)

    def _sweep_blocks(self) -> list[Block]:
        """The objects of a sweep over all levels, as many as memory should hold."""
        states = sum(level.n_states for level in self.machine.levels)
        blocks = self.objects.epoch(FIRST_EPOCH["shown"] + max(0, self.epoch - 1), GROWTH_BLOCK, self.products)
        return blocks[: max(1, REROUTE_NUMBERS // (GROWTH_BLOCK * states))]

    def _choose_patterns(self) -> None:
        light = self.machine.levels[0].light
        if isinstance(light, Bits) and light.rows is not None:
            sight = self.sight(self.products)
            blocks = self._sweep_blocks()[:CHOICE_BLOCKS]
            choose_patterns(self.machine, sight, blocks, self.prices.aim(self.options.exposure_price))

    # ---- the end ----

    def finish(self) -> TrainedAutomaton:
        """Meet the budget, round the brightness, count the leaves anew and calibrate the posteriors."""
        held_back = self.objects.held_back(GROWTH_BLOCK, torch.float32)
        grid = None
        if self.prices.all and not self.options.grey:  # first without steps, see below
            meet_budget(self.machine, self.prices, None, self.sight, self._drawn())
        with torch.no_grad():
            hold_cap(self.machine, self.cap, brighten=not self.prices.all)
        if not self.options.grey:  # an exposure is no longer than the brightest state then needs
            self._set_top(max(float(level.light.brightness().max()) for level in self.machine.levels))  # type: ignore[union-attr]
            grid = bit_grid(self.machine.levels[0].light.top, self.profile)
        if self.cap == math.inf:
            meet_budget(self.machine, self.prices, grid, self.sight, self._drawn())
        if grid is not None:
            to_grid(self.machine, grid)
        sight = self.sight()
        posteriors = self._posteriors(sight, held_back)
        measured = figures(self.machine, sight, held_back)
        found = finished(self.machine, posteriors, self.profile, grid, self.options.outcomes > 2)
        how = self._prices(), self.options
        return TrainedAutomaton(*found, self.machine, posteriors, sight, self.objects.wide, measured, *how)

    def _drawn(self) -> list[Block]:
        """Objects drawn from all that were fitted: the last ones of a file need not be like the others (those of MNIST are darker)."""
        return self.objects.epoch(0, GROWTH_BLOCK, torch.float32, plain=True)[:BUDGET_BLOCKS]

    def _posteriors(self, sight: Sight, held_back: list[Block]) -> Posteriors:
        """Calibrated posteriors of all nodes; the machine's leaves are counted anew."""
        fitted = node_counts(self.machine, sight, self.objects.epoch(0, GROWTH_BLOCK, torch.float32, plain=True))
        sizes = [*(level.n_states for level in self.machine.levels), 0]
        for counts, found, states in zip(self.machine.counts, fitted[1:], sizes[1:]):
            counts.copy_(torch.from_numpy(found[states:]) + COUNT_FLOOR)
        return calibrated(fitted, node_counts(self.machine, sight, held_back), sizes)

    # ---- checkpoints ----

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs: tensors and plain values."""
        return {
            "stage": self.stage,
            "epoch": self.epoch,
            "prices": [price.value for price in self.prices.all],
            "machine": machine_state(self.machine),
            "tuning": None if self.tuning is None else self.tuning.state(),
            "answers": None if self.answers is None else torch.from_numpy(self.answers),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`."""
        self.stage, self.epoch = state["stage"], state["epoch"]
        if self.stage != "grow" and self.cap < math.inf:
            self.prices.drop_sent()
        for price, value in zip(self.prices.all, state["prices"]):
            price.value = value
        self.machine = machine_from(state["machine"])
        self.saved_tuning = state["tuning"]
        self.answers = None if state["answers"] is None else state["answers"].numpy()
