"""The size and price of an automaton from its budget of light, and what of its options is impossible on a task or profile.

`check_automaton_options` returns nothing, or raises with the numbers.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pans.base.console import check_options as check_ranges
from pans.base.errors import PlanError, UsageError, as_usage_error
from pans.bundle.automaton import STATES_MAX
from pans.bundle.sensor import Bundle
from pans.instrument.click_law import cannot_count, cannot_read_at_once
from pans.instrument.optics import bleaching_of
from pans.instrument.profile import Profile
from pans_trainer.options import AutomatonOptions, check_optics
from pans_trainer.tasks.registry import Task

from .finish import bit_grid
from .machine import Aim, Spent
from .tune import SENT, Price, Prices

SENT_PER_PHOTON = 3.5  # of an automaton that is trained for light sent, about: 3.2 to 4.3 were measured
# photoelectrons detected, about, for each that a budget counts: only to choose defaults and the first price
DETECTED_PER = {"photons": 1.0, "clicks": 1.85, SENT: 1 / SENT_PER_PHOTON}
# of an excess over the budget while growing: without it 56 levels through optics spent 31 of 12 photons, and 48 held to light sent 461 of
# 305 units
DEARER_POWER, DEARER_MAX = 2.0, 100.0
PRICE_AT_10 = 0.02  # nats per photoelectron at which training spends about 10 of them on the public sets
PRICE_POWER = 1.6  # how the price falls with the budget
GROWN_PRICE = 0.7  # of the last level grown, over the price of the budget: tuning saves light
DEFAULT_PHOTONS = 10.0
GREY_EPOCHS = 3
# over the steps of the brightness: by which part of a cap the doses of walks to one state differ (8 and 12 were measured); and what is
# allowed of the dose that leaves 1/e, as of `pans evaluate`
ROUNDED, FADES_WITHIN = 12.0, 1e-3
# by task, where they helped on held-back objects (docs/how-to/automaton.md)
COPIES_OF = {"mnist": 20}
SOFT_OF = {"fashion-mnist": 0.5}


def budgets_of(options: AutomatonOptions) -> dict[str, float]:
    """Return the budgets that were given: fields of `Spent`. A cap on the dose is one of light sent, which every walk takes."""
    found = {kind: budget for kind in Spent._fields if (budget := getattr(options, kind)) is not None}
    return found if options.dose_cap is None else found | {SENT: options.dose_cap}


def first_prices(options: AutomatonOptions) -> Prices:
    """Return the prices at which training spends about the budgets of `options`; each of two begins with half of it."""
    prices, budgets = [], budgets_of(options)
    for kind, budget in budgets.items():
        price = PRICE_AT_10 * (10.0 / (budget * DETECTED_PER[kind])) ** PRICE_POWER
        prices.append(Price(kind, options.price * price * _share(kind, len(budgets)), budget))
    return Prices(prices)


def _share(kind: str, budgets: int) -> float:
    """Which part of the price of a photoelectron detected one of this kind costs, where there are so many budgets."""
    return 1.0 / (budgets * (SENT_PER_PHOTON if kind == SENT else 1.0))


def states_at_most(exposures: int, states: int, outcomes: int = 2) -> int:
    """Return how many states an automaton can have: `outcomes` times as many from exposure to exposure, and `states` at most."""
    return sum(min(outcomes ** min(level, 32), states) for level in range(exposures))


def patterns_at_most(options: AutomatonOptions, profile: Profile) -> int:
    """Return how many patterns may be shown: what was asked for, within the projector's memory."""
    return min(options.patterns or profile.projector.pattern_memory, profile.projector.pattern_memory)


def with_defaults(options: AutomatonOptions, profile: Profile) -> tuple[int, int]:
    """Return exposures and states per level: those asked for, else those of the budget, as far as the profile holds them.

    Many cheap exposures beat few dear ones; several channels need fewer, in proportion.
    """
    # the budget in photoelectrons detected, about, however it was given; of two the smaller one
    budgets = budgets_of(options).items()
    photons = min((budget * DETECTED_PER[kind] for kind, budget in budgets), default=DEFAULT_PHOTONS)
    wanted, states = min(96, max(16, 4 * round(photons * 0.45 + 7))), 256 if photons <= 12 else 384
    exposures = options.exposures or -(-wanted // options.channels)
    if options.states:
        return exposures, options.states
    most = min(profile.projector.pattern_memory // options.channels, profile.projector.automaton_states or STATES_MAX)
    while states > 1 and states_at_most(exposures, states, options.successors) > most:
        states -= 1
    return exposures, states


def aim_at(options: AutomatonOptions, level: int, levels: int, spent: Spent) -> Aim:
    """Return the prices of light in one of `levels` that grow: dear at first, when every photon is spent on all objects.

    `spent` is what the levels before it took. Light sent, and all light through optics, is dearer where more was spent than their share
    of the budget. A level of several channels counts as so many: else half of the budget was left when two had grown, and tuning
    overshot it.
    """
    prices, part = first_prices(options), level / levels
    for price in prices.all:
        last = GROWN_PRICE * price.value
        first = max(last, options.first_price * _share(price.kind, len(prices.all)))
        excess = price.excess(spent, part) if price.kind == SENT or options.optics is not None else 0.0
        price.value = last + (first - last) * 0.5 ** (level * options.channels / options.half)
        price.value *= min(DEARER_MAX, max(1.0, excess**DEARER_POWER))
    return prices.aim()


def for_task(options: AutomatonOptions, task: str) -> AutomatonOptions:
    """Return `options` with soft targets and copies spelt out where they were left to the task of that name."""
    soft = SOFT_OF.get(task, 0.0) if options.soft is None else options.soft
    copies = COPIES_OF.get(task, 0) if options.copies is None else options.copies
    return replace(options, soft=soft, copies=copies)


def tune_epochs_of(options: AutomatonOptions) -> int:
    """Return how many epochs grey patterns are tuned: those asked for, else 3, or none where light leaks through dark pixels."""
    if options.tune_epochs is not None:
        return options.tune_epochs
    return GREY_EPOCHS if options.optics is None else 0


def started_from(
    options: AutomatonOptions, start: Bundle, sha256: str, task: Task, profile: Profile
) -> AutomatonOptions:
    """Return `options` for starting from the automaton of `start`, a file of that hash: its exposures and states.

    UsageError or PlanError where the options ask for others, the automaton is of other classes, images or outcomes, or `profile`
    holds fewer patterns than it has states.
    """
    automaton = start.automaton
    if automaton is None:
        raise UsageError(f"--start: {start.name} holds no automaton", remedy="give one of --encoder automaton")
    if options.grey:
        raise UsageError("--start: not with --grey, what is trained on are patterns of one bit and a brightness")
    exposures, states = automaton.n_slots, int(np.bincount(automaton.depth).max())
    outcomes = automaton.n_outcomes if automaton.counts else 2
    found = {"exposures": exposures, "states": states, "outcomes": outcomes, "channels": automaton.channels}
    for name, value in found.items():
        if getattr(options, name) not in (0, value):
            what = f"--{name} is {getattr(options, name)}, the automaton of --start has {value}"
            raise UsageError(what, remedy=f"--{name} {value}")
    if (start.classes, start.image_shape) != (task.classes, task.image_shape):
        raise UsageError(
            f"--start: {start.name} tells {len(start.classes)} classes of images {start.image_shape}, "
            f"{task.name} has {len(task.classes)} of {task.image_shape}",
            remedy="start from an automaton of the same task",
        )
    most = patterns_at_most(options, profile)
    if most < automaton.n_states * automaton.channels:
        raise PlanError(
            f"--start: {automaton.n_states} states with {automaton.channels} pattern(s) each, {most} patterns are allowed; only a "
            "training that grows shares them",
            remedy="leave out --start or --patterns, or choose a profile with a larger pattern memory",
        )
    return replace(options, exposures=exposures, states=states, start=sha256)


def check_automaton_options(options: AutomatonOptions, task: Task, profile: Profile) -> None:
    """Raise UsageError or PlanError for what cannot be trained for this task on this profile."""
    check_ranges(options)
    if options.photons is not None and options.clicks is not None:
        what = "an automaton is trained for --photons or --clicks, not for both"
        raise UsageError(what, remedy="leave one of them out")
    if not budgets_of(options):
        raise UsageError(
            "an automaton is trained for a budget of light",
            remedy="give --photons or --clicks, --illumination or --dose-cap, or one of the first two with one of the others",
        )
    _check_dose(options, task, profile)
    if options.optics is not None:
        check_optics(options.optics)
    if task.target == "image":
        what = f"--encoder automaton: {task.name} asks for a picture, the leaves of an automaton hold classes"
        raise UsageError(what, remedy="use --encoder coherent")
    if task.light != "transmission" or task.optics != "none":
        what = f"--encoder automaton: in {task.name} the light is the scene's own, no pattern of ours can follow the clicks"
        raise UsageError(what, remedy="use a passive encoder: coherent or incoherent")
    _check_fits(options, profile)


def _check_dose(options: AutomatonOptions, task: Task, profile: Profile) -> None:
    """Refuse what does not go with a dose cap, or with bleaching."""
    if options.bleach is not None:
        with as_usage_error():
            law = bleaching_of(options.bleach)
        if options.dose_cap is None or not law.mixed:
            raise UsageError(
                f"--bleach {options.bleach}: an automaton is trained exactly where a state has one dose, whichever walk led to it",
                remedy=f"--bleach {law.dose:g}:mixed --dose-cap D: every walk then sends the same light, exposure by exposure",
            )
        if options.optics is not None:
            what = "--bleach: an automaton is trained for it on perfect optics only"
            raise UsageError(what, remedy="leave out --optics")
        fades = fades_of(options, math.prod(task.image_shape))
        rounding = ROUNDED / bit_grid(1.0, profile).steps * options.dose_cap / fades
        if rounding > FADES_WITHIN:
            raise PlanError(
                f"--bleach: by the steps of {profile.name} doses of walks to one state would differ by about {rounding:.1%} of that which "
                f"leaves 1/e, allowed {FADES_WITHIN:.1%}",
                remedy="a smaller --dose-cap, or a profile with finer steps (projector.dwell_steps, or levels)",
            )
    if options.dose_cap is None:
        return
    if options.illumination is not None:
        what = "--dose-cap is the light that every walk sends: --illumination adds nothing"
        raise UsageError(what, remedy="leave one of them out")
    if options.channels > 1:
        raise UsageError("--dose-cap: allowed with one detector only", remedy="leave out --channels")
    if options.grey or (profile.projector.levels == 2 and profile.projector.dwell_steps == 1):
        what = "--dose-cap: each state needs a one-bit pattern and a brightness of its own"
        raise UsageError(what, remedy="leave out --grey, or choose a profile with levels or projector.dwell_steps")
    exposures, states = with_defaults(options, profile)
    most = states_at_most(exposures, states, options.successors)
    if patterns_at_most(options, profile) < most:
        what = f"--dose-cap: states share no patterns, up to {most} may be needed, {patterns_at_most(options, profile)} are allowed"
        raise UsageError(what, remedy="fewer --exposures or --states, or leave out --patterns")


def fades_of(options: AutomatonOptions, pixels: int) -> float:
    """Return the illumination of a whole object of so many pixels after which 1/e of its light is left; see Sight."""
    return math.inf if options.bleach is None else bleaching_of(options.bleach).dose * pixels


def _check_fits(options: AutomatonOptions, profile: Profile) -> None:
    exposures, states = with_defaults(options, profile)
    if profile.mode != "sequential":
        what = f"an automaton shows one pattern after another, {profile.name} is a {profile.mode} profile"
        raise PlanError(what, remedy="choose a sequential profile, such as ideal or dmd-spad")
    if why := cannot_count(profile, options.outcomes):
        raise PlanError(why, remedy="--outcomes 2, or a profile whose detector.photon_number_max is at least one less")
    if options.channels > 1 and options.outcomes > 2:
        what = f"--channels {options.channels} with --outcomes {options.outcomes}: detectors that are read at once click, they do not count"
        raise UsageError(what, remedy="leave out one of them")
    if options.channels > 1 and (why := cannot_read_at_once(profile, options.channels)):
        raise PlanError(why, remedy="fewer --channels, or a sequential profile with as many detectors: dmd-four-snspd")
    most = states_at_most(exposures, states, options.successors)
    if most > STATES_MAX:
        what = f"{exposures} exposures of {states} states are up to {most} states, allowed at most {STATES_MAX}"
        raise PlanError(what, remedy=f"--states {STATES_MAX // exposures}, or fewer")
    few = patterns_at_most(options, profile)
    if options.channels > 1 and few < most * options.channels:
        what = f"up to {most} states show {options.channels} patterns each, {few} patterns are allowed, and channels share none"
        raise PlanError(what, remedy="fewer --exposures or --states, or leave out --patterns")
    if few < most and (options.grey or (profile.projector.dwell_steps == 1 and profile.projector.levels > 2)):
        raise PlanError(
            f"{few} patterns for up to {most} states: on {profile.name} a state's brightness is part of its pattern, so "
            "that states cannot share one",
            remedy="fewer --exposures or --states, or a profile with projector.dwell_steps",
        )
    clicks = exposures * options.channels
    if options.clicks is not None and options.clicks >= clicks:
        raise UsageError(f"--clicks is {options.clicks}, allowed: below {clicks}, one click per exposure at most")
