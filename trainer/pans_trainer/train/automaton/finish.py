"""The end of a training: the budget is met, brightness is rounded, posteriors are calibrated, and the arrays of a bundle are made.

Posteriors come from class counts of training objects, smoothed and sharpened by the log loss of objects held back. Exact expectations in
float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from pans.bundle.automaton import Automaton, reachable_automaton
from pans.bundle.sensor import Shown
from pans.instrument.profile import Profile

from .grow import sum_of
from .machine import Bits, Machine, Sight, forward, sent_by
from .objects import Block
from .tune import Prices, figures

F64 = NDArray[np.float64]
SMOOTHINGS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # pseudo-objects of every class
SHARPNESSES = tuple(0.5 + 0.02 * i for i in range(36))
BINS = 15
UNDER_BUDGET = 0.99  # of the budget is what drawn objects may take: others take a little more or less
FEW_PIXELS = 3  # that are lit more or fewer, so that states send the same light in whole steps
WORTH_A_PIXEL = 1e-3  # of that light
DIMMINGS = 6  # steps of the search for the brightness that meets the budget


@dataclass(frozen=True, slots=True, eq=False)
class Posteriors:
    """Per level 0..T the posteriors of its nodes, float64 (nodes, classes), states first; the error on the held-back objects."""

    levels: list[F64]
    smoothing: float
    calibration_error: float
    loss: float


def node_counts(machine: Machine, sight: Sight, blocks: list[Block]) -> list[F64]:
    """Return the expected class counts of the nodes before every exposure and at the end, T + 1 arrays (nodes, classes)."""
    counted = []
    with torch.no_grad():
        for block in blocks:
            passed = forward(machine, sight, block.grey)
            nodes = [passed.steps[0].alpha]
            for number, leaves in enumerate(passed.leaves):
                states = passed.steps[number + 1].alpha if number + 1 < len(passed.steps) else leaves[:0]
                nodes.append(torch.cat([states, leaves]))
            counted.append([(part @ block.one_hot.T).double() for part in nodes])
    return [sum_of(parts).cpu().numpy() for parts in zip(*counted)]


def smoothed(counts: F64, smoothing: float, sharpness: float = 1.0) -> F64:
    """Return posteriors of class counts (nodes, classes) with pseudo-objects, to a power, rows summing to 1."""
    share = counts + smoothing
    logs = sharpness * np.log(share / share.sum(axis=1, keepdims=True))
    powers = np.exp(logs - logs.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True))


def log_loss(posterior: F64, arrived: F64) -> float:
    """Return the sum of -log posterior over arrivals (nodes, classes)."""
    return float(-(arrived * np.log(posterior)).sum())


def calibrated(fitted: list[F64], held_back: list[F64], leaf_from: list[int]) -> Posteriors:
    """Return posteriors of all nodes from the counts of fitted objects, smoothed and sharpened by those of held-back ones.

    `leaf_from[t]`: number of states of level t, behind which its leaves stand. The smoothing is chosen on the leaves, the sharpness for
    every level.
    """
    ends = [(f[n:], h[n:]) for f, h, n in zip(fitted, held_back, leaf_from) if len(f) > n]
    smoothing = min(SMOOTHINGS, key=lambda a: sum(log_loss(smoothed(f, a), h) for f, h in ends))
    levels = []
    for counts, arrived in zip(fitted, held_back):
        best = min(SHARPNESSES, key=lambda k: log_loss(smoothed(counts, smoothing, k), arrived))
        levels.append(smoothed(counts, smoothing, best))
    leaves = np.concatenate([level[n:] for level, n in zip(levels, leaf_from)])
    arrived = np.concatenate([h[n:] for h, n in zip(held_back, leaf_from)])
    total = float(arrived.sum())
    error = calibration_error(leaves, arrived)
    return Posteriors(levels, smoothing, error, log_loss(leaves, arrived) / total)


def calibration_error(posterior: F64, arrived: F64) -> float:
    """Return the expected calibration error: mean distance of confidence and share of right decisions, over bins of confidence."""
    confidence, decided = posterior.max(axis=1), posterior.argmax(axis=1)
    mass, right = arrived.sum(axis=1), arrived[np.arange(len(arrived)), decided]
    bins = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
    stated = np.bincount(bins, mass * confidence, BINS)
    found = np.bincount(bins, right, BINS)
    return float(np.abs(stated - found).sum() / mass.sum())


@dataclass(frozen=True, slots=True)
class Grid:
    """What brightness a profile can show: `steps` of `top` photoelectrons; as dwell, or (`by_level`) as the level of the lit pixels."""

    top: float
    steps: int
    by_level: bool


def bit_grid(top: float, profile: Profile) -> Grid:
    """Return the grid for one-bit patterns of which the brightest pixel gives `top` photoelectrons in a whole exposure."""
    steps = profile.projector.dwell_steps
    by_level = steps == 1 and profile.projector.levels > 2
    return Grid(top, profile.projector.levels - 1 if by_level else steps, by_level)


def set_top(machine: Machine, top: float, profile: Profile) -> None:
    """Let `top` photoelectrons be the most of a lit pixel, and one step of the dwell time, where there are steps, the least."""
    steps = bit_grid(top, profile).steps
    for level in machine.levels:
        light = level.light
        assert isinstance(light, Bits)
        light.top = top
        if steps > 1:  # no state can be darker than one step; training then lights fewer pixels
            light.bottom = top / steps
        with torch.no_grad():
            light.settle()


def to_grid(machine: Machine, grid: Grid) -> None:
    """Round the brightness of all one-bit patterns to whole steps, at least one; down, where states send the same light."""
    with torch.no_grad():
        for level in machine.levels:
            light = level.light
            assert isinstance(light, Bits)
            if light.even:  # by a few pixels more or less, what remains of the light is small
                wanted = light.log_light.exp() / grid.top * grid.steps
                change = torch.arange(-FEW_PIXELS, FEW_PIXELS + 1)
                tried = light.lit() + change
                cost = torch.remainder(wanted, tried) / wanted + WORTH_A_PIXEL * change.abs()
                cost = cost.masked_fill((tried < 1) | (tried * grid.steps < wanted), math.inf)
                light.light_up(tried.gather(1, cost.argmin(dim=1, keepdim=True)))
            units = (light.brightness() if light.even else light.log_light.exp()) / grid.top * grid.steps
            units = units.floor() if light.even else units.round()
            rounded = (units.clamp(1, grid.steps) / grid.steps * grid.top).log()
            if light.even:
                light.log_light, light.even = rounded, False
            else:
                light.log_light.copy_(rounded)


def send_evenly(machine: Machine, masses: list[torch.Tensor], cap: float, fades: float) -> None:
    """Let all states of a level send the same light, all levels together `cap`.

    What acts keeps the proportions that the mean light of the levels had, by the `masses` (states,) of their states; of objects that
    bleach (`fades`, as of Sight) later levels send more for it.
    """
    with torch.no_grad():
        lights = [level.light for level in machine.levels]
        sent = [sent_by(light).flatten() for light in lights]
        means = torch.stack([(one @ mass.to(one.dtype)) / mass.sum() for one, mass in zip(sent, masses)]).double()
        acting = (means.cumsum(0) / means.sum()).cpu().numpy()
        doses = cap * acting
        if fades < math.inf:
            doses = -fades * np.log1p(acting * math.expm1(-cap / fades))
        for light, own in zip(lights, np.diff(doses, prepend=0.0)):
            light.log_light = torch.full((1, 1), math.log(own))
            if isinstance(light, Bits):
                light.even = True
                light.settle()


def meet_budget(
    machine: Machine, prices: Prices, grid: Grid | None, sight: Callable[[], Sight], drawn: list[Block]
) -> None:
    """Dim or brighten all patterns alike until the objects `drawn` take 99 % of the budget, of two that of which they take more.

    They are drawn from those that were fitted. A large automaton learns a little of their light by heart: one of 72 exposures for MNIST
    took 4 % more of test images, small ones no more.
    """
    bits = [level.light for level in machine.levels if isinstance(level.light, Bits)]
    exact = [light.log_light.clone() for light in bits]  # before it is rounded to whole steps, which raises the darkest
    for _ in range(DIMMINGS):
        if grid is not None:
            to_grid(machine, grid)
        spent = prices.excess(figures(machine, sight(), drawn))
        # where all patterns are dark no brightness helps
        if not spent or 0.995 <= (wanted := UNDER_BUDGET / spent) <= 1.0:
            return
        for light, before in zip(bits, exact):
            light.log_light.copy_(before)
        scale_light(machine, wanted**1.1)
        exact = [light.log_light.clone() for light in bits]


def scale_light(machine: Machine, factor: float) -> None:
    """Multiply the light of all patterns by `factor`."""
    with torch.no_grad():
        done: set[int] = set()
        for level in machine.levels:
            light = level.light
            if isinstance(light, Bits):
                if id(light.log_light) not in done:
                    light.log_light.add_(torch.log(torch.tensor(factor)))
                    done.add(id(light.log_light))
                light.settle()
            else:
                light.root.mul_(factor**0.5)
                light.top *= factor


def finished(
    machine: Machine, posteriors: Posteriors, profile: Profile, grid: Grid | None, counts: bool
) -> tuple[Shown, Automaton]:
    """Return what `machine` is in a bundle; its patterns are whole levels (no `grid`) or bits on the grid, `counts` as of `Automaton`.

    States and leaves that no walk reaches are left out, and patterns that none shows.
    """
    rows, dwells, top, channels = [], [], 0.0, 1
    levels = profile.projector.levels
    for level in machine.levels:
        mask, scale = level.light.displayed()
        shown, dwell = mask.double().cpu().numpy(), np.ones(level.n_states, np.int64)
        channels = len(shown) // level.n_states
        if grid is None or scale is None:
            top, shown = float(level.light.top), np.rint(shown)
        else:
            top, units = grid.top, np.rint(scale.double().cpu().numpy() / grid.top * grid.steps).astype(np.int64)
            shown = shown * (units if grid.by_level else levels - 1)
            dwell = dwell if grid.by_level else units[::channels, 0]
        rows.append(shown.astype(np.uint16))
        dwells.append(dwell)
    n_pixels = rows[0].shape[1]  # what a state shows on all its channels is one
    of_states = np.concatenate(rows).reshape(-1, channels * n_pixels)
    steps = 1 if grid is None or grid.by_level else grid.steps
    sizes = [*(level.n_states for level in machine.levels), 0]
    of_nodes = [level[:n] for level, n in zip(posteriors.levels, sizes)]  # states first
    of_nodes += [level[n:] for level, n in zip(posteriors.levels, sizes)]
    nodes = _numbered(machine), np.concatenate(of_nodes).astype(np.float32)
    automaton = reachable_automaton(np.arange(len(of_states)), np.concatenate(dwells), steps, *nodes, counts)
    different, pattern = np.unique(of_states[automaton.pattern], axis=0, return_inverse=True)
    automaton = replace(automaton, pattern=(channels * pattern.reshape(-1)).astype(np.uint16))
    return Shown(levels, different.reshape(-1, n_pixels), top / (levels - 1)), automaton


def _numbered(machine: Machine) -> NDArray[np.int64]:
    """Successors (states, outcomes) as numbers of nodes: all states in order of their levels, then all leaves."""
    sizes = [level.n_states for level in machine.levels]
    first_state, n_states = np.concatenate([[0], np.cumsum(sizes)]), sum(sizes)
    first_leaf = n_states + np.concatenate([[0], np.cumsum([len(counts) for counts in machine.counts])])
    rows = []
    for number, level in enumerate(machine.levels):
        n_next = sizes[number + 1] if number + 1 < len(sizes) else 0
        to = level.successors.T.cpu().numpy()
        rows.append(np.where(to < n_next, first_state[number + 1] + to, first_leaf[number] + to - n_next))
    return np.concatenate(rows).astype(np.int64)
