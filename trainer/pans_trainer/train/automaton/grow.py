"""Growing an automaton level by level: new patterns for every state, trained on what their outcome tells, then merged.

Candidates come from the class means that each state sees; the best are trained by Adam on the expected cross-entropy of their children
and the price of their light. The children are merged by the agglomerative information bottleneck (Slonim and Tishby 1999): the pair goes
first whose merger loses least information on the class. Growing looks one exposure ahead; what lies further ahead is tuned (tune.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import reduce

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pans.base.machine import njit
from pans_trainer.options import AutomatonOptions

from .machine import COUNT_FLOOR, Aim, Grey, Level, Machine, Sight, Spent, brought, children
from .objects import Block
from .outcomes import by_row, by_state, channels_of, clicks_of, mean_reading, readings, slope_of

TRIED_BLOCKS = 6  # objects on which candidates are compared, in blocks
LIGHT_TRIED = (0.4, 1.6)  # mean photoelectrons of a candidate
REST_TRIED = (0.5, 1.5)  # how much of the mean of the other classes is taken away
RATE = 0.03  # of Adam, at the start of a level
GLOW = 1e-6  # least light of a pixel at the start: squares of 0 would never move
F64 = NDArray[np.float64]


class Growth:
    """An automaton that grows over fixed blocks of objects; `alphas` are the probabilities of its present states per block.

    A level has at most `states` behind it, and at most `top` photoelectrons in a pixel.
    """

    def __init__(
        self,
        blocks: list[Block],
        sight: Sight,
        random: torch.Generator,
        options: AutomatonOptions,
        states: int,
        top: float = math.inf,
    ) -> None:
        self.blocks, self.sight, self.random = blocks, sight, random
        self.options, self.states, self.top = options, states, top
        self.channels, self.clicks = channels_of(sight.law), clicks_of(sight.law)
        self.alphas = [torch.ones(1, len(block)) for block in blocks]
        self.levels: list[Level] = []
        self.spent = Spent()  # on an object so far
        self.counts = self._class_counts()

    def _class_counts(self) -> Tensor:
        return sum_of(alpha @ block.one_hot.T for alpha, block in zip(self.alphas, self.blocks))

    def grow(self, aim: Aim) -> None:
        """Add a level whose light has the prices of `aim`."""
        chosen = self._best_candidates(aim).clamp(min=GLOW)
        light = Grey(chosen.sqrt(), self.top)
        if self.options.dose_cap is not None:
            masses = self.counts.sum(dim=1)
            light.log_light = (masses @ chosen.sum(dim=1) / masses.sum()).log().reshape(1, 1)
        light.settle()
        self._train(light, aim)
        self._branch(light)

    def follow(self, levels: list[Level]) -> None:
        """Continue from levels that grew before over the same blocks."""
        for level in levels:
            assert isinstance(level.light, Grey)
            self._carry(level.light, level.successors, int(level.successors.max()) + 1)
            self.levels.append(level)
        self.counts = self._class_counts()

    def machine(self) -> Machine:
        """Return the automaton as it has grown; the present states are its leaves."""
        none = [torch.zeros(0, self.counts.shape[1]) for _ in self.levels[1:]]
        return Machine(self.levels, [*none, self.counts + COUNT_FLOOR])

    # ---- a level ----

    def _best_candidates(self, aim: Aim) -> Tensor:
        tried = min(TRIED_BLOCKS, len(self.blocks))
        means, masses = self._class_means(tried)
        best = torch.full((len(masses),), torch.inf)
        rows = by_row(means, self.channels), by_row(masses, self.channels)  # each channel has a split of its own
        chosen = torch.zeros(len(rows[0]), means.shape[2])
        for _ in range(self.options.candidates):
            patterns = self._candidate(*rows)
            cost = self._cost_of(patterns, tried, aim)
            better = cost < best
            best[better] = cost[better]
            of_better = by_row(better, self.channels)
            chosen[of_better] = patterns[of_better]
        return chosen

    def _class_means(self, tried: int) -> tuple[Tensor, Tensor]:
        """Mean transmission that every state sees of every class, (states, classes, pixels), and the mass behind it."""
        blocks, alphas = self.blocks[:tried], self.alphas[:tried]
        sums = []
        for label in range(blocks[0].one_hot.shape[0]):
            seen = (self.sight.mask_slope(a * block.one_hot[label], block.grey) for a, block in zip(alphas, blocks))
            sums.append(sum_of(seen))
        masses = sum_of(alpha @ block.one_hot.T for alpha, block in zip(alphas, blocks))
        means = torch.stack(sums, dim=1)
        return means / (masses.unsqueeze(2) + 1e-6), masses

    def _candidate(self, means: Tensor, masses: Tensor) -> Tensor:
        """One class split per state: relu(mean of some classes - c * mean of the others), scaled to about a photoelectron."""
        states, classes, _ = means.shape
        chosen = (torch.rand(states, classes, generator=self.random) < 0.5).float() * masses
        others = masses - chosen
        wanted = torch.bmm((chosen / (chosen.sum(1, keepdim=True) + 1e-6)).unsqueeze(1), means).squeeze(1)
        rest = torch.bmm((others / (others.sum(1, keepdim=True) + 1e-6)).unsqueeze(1), means).squeeze(1)
        pattern = torch.relu(wanted - self._uniform(states, REST_TRIED) * rest) + 1e-4
        seen = torch.bmm((masses / (masses.sum(1, keepdim=True) + 1e-6)).unsqueeze(1), means).squeeze(1)
        mean_light = (pattern * seen).sum(dim=1, keepdim=True)
        return pattern / (mean_light + 1e-6) * self._uniform(states, LIGHT_TRIED)

    def _uniform(self, states: int, limits: tuple[float, float]) -> Tensor:
        low, high = limits
        return low + (high - low) * torch.rand(states, 1, generator=self.random)

    def _cost_of(self, patterns: Tensor, tried: int, aim: Aim) -> Tensor:
        """What every state's pattern leaves unknown of the class, and the price of its light, (states,)."""
        spent, whole = torch.zeros(len(self.counts)), torch.zeros_like(self.counts)
        sent = aim.sent_price * by_state(patterns.sum(dim=1, keepdim=True), self.channels).squeeze(1)
        parts = [torch.zeros_like(whole) for _ in self.clicks[1:]]
        for alpha, block in zip(self.alphas[:tried], self.blocks[:tried]):
            light = self.sight.light(patterns, block.grey)
            for part, chance in zip(parts, readings(light, self.sight.law)[0]):
                part += (alpha * chance) @ block.one_hot.T
            whole += alpha @ block.one_hot.T
            spent += aim.price * (alpha * by_state(light, self.channels)).sum(dim=1) + alpha.sum(dim=1) * sent
        unknown = sum_of(mass_entropy(part) for part in [*parts, remainder(whole, parts).clamp(min=0)])
        return unknown + spent

    def _train(self, light: Grey, aim: Aim) -> None:
        """Adam on the children's expected cross-entropy under running class counts."""
        options = self.options
        optimiser = torch.optim.Adam(light.parameters(), lr=RATE, fused=True)
        n = sum(len(block) for block in self.blocks)
        # in float32 a child's count could vanish beside another's
        whole = self.counts.double() + len(self.clicks) * COUNT_FLOOR
        parts = [torch.minimum(p.double() + COUNT_FLOOR, whole - COUNT_FLOOR) for p in self._outcome_counts(light)]
        steps, done = options.grow_epochs * len(self.blocks), 0
        for epoch in range(options.grow_epochs):
            share = 0.05 if epoch == 0 else 0.03
            for index in torch.randperm(len(self.blocks), generator=self.random).tolist():
                alpha, block = self.alphas[index], self.blocks[index]
                shown, sent = brought(light, self.sight, block.grey)
                chances, falls = readings(shown, self.sight.law)
                arrived = [(alpha * chance) @ block.one_hot.T for chance in chances]
                slope = slope_of(falls, _gains(parts, whole, block), self.sight.law)
                slope.neg_().add_(aim.price).mul_(by_row(alpha, self.channels)).mul_(1.0 / len(block))
                mask_slope, scale = self.sight.mask_slope(slope, block.grey, light), light.scale()
                cost = by_row(alpha.mean(dim=1, keepdim=True), self.channels) * aim.sent_price
                mask_slope += cost
                light_slope = None
                if scale is not None:
                    light_slope = slope.mul_(shown).sum(dim=1, keepdim=True) + cost * sent
                    mask_slope *= scale
                light.set_gradients(mask_slope, light_slope)
                optimiser.param_groups[0]["lr"] = RATE * (1 - done / steps) + 1e-4
                optimiser.step()
                light.settle()
                done += 1
                for outcome, here in enumerate(arrived):
                    part = (1 - share) * parts[outcome] + share * n / len(block) * here
                    parts[outcome] = torch.minimum(part, whole - COUNT_FLOOR).clamp_(min=COUNT_FLOOR)

    def _outcome_counts(self, light: Grey) -> list[Tensor]:
        """Class counts of all outcomes but the last, each (states, classes)."""
        counted = []
        for alpha, block in zip(self.alphas, self.blocks):
            chances, _ = readings(brought(light, self.sight, block.grey)[0], self.sight.law)
            counted.append([(alpha * chance) @ block.one_hot.T for chance in chances])
        return [sum_of(parts) for parts in zip(*counted)]

    def _branch(self, light: Grey) -> None:
        """Carry the probabilities to the children and merge these."""
        states = len(self.counts)
        parts = self._outcome_counts(light)
        edges = torch.cat([*parts, remainder(self.counts, parts).clamp(min=0)])
        groups = merged(edges.double().cpu().numpy(), min(self.states, len(edges)))
        successors = torch.from_numpy(np.ascontiguousarray(groups)).to(edges.device).reshape(-1, states)
        n_nodes = int(groups.max()) + 1
        self._carry(light, successors, n_nodes)
        self.levels.append(Level(light, successors))
        self.counts = torch.zeros(n_nodes, edges.shape[1]).index_add_(0, successors.flatten(), edges)

    def _carry(self, light: Grey, successors: Tensor, n_nodes: int) -> None:
        """Carry the probabilities of all objects over one level, and add up its light and clicks."""
        sums = torch.zeros(3, dtype=torch.float64)
        for index, block in enumerate(self.blocks):
            alpha, (shown, sent) = self.alphas[index], brought(light, self.sight, block.grey)
            chances, _ = readings(shown, self.sight.law)
            each = mean_reading(chances, self.clicks), by_state(shown, self.channels), by_state(sent, self.channels)
            sums += torch.stack([(alpha * one).sum() for one in each]).double()
            self.alphas[index] = children(alpha, chances, successors, n_nodes)
        n = sum(len(block) for block in self.blocks)
        self.spent = Spent(*(torch.tensor(self.spent, dtype=torch.float64) + sums / n).tolist())


def remainder(whole: Tensor, parts: list[Tensor]) -> Tensor:
    """Return what `parts` leave of `whole`, all (states, classes)."""
    return reduce(torch.sub, parts, whole)


def _gains(parts: list[Tensor], whole: Tensor, block: Block) -> list[Tensor]:
    """By how much the cross-entropy of each outcome but the last is above that of the last, (states, objects), by their class counts."""
    rest = remainder(whole, parts)
    if len(parts) > 1:
        rest.clamp_(min=COUNT_FLOOR)  # each part alone leaves it, all together may not
    last = log_posterior(rest)
    return [(last - log_posterior(part)).float() @ block.one_hot for part in parts]


def sum_of(parts: Iterable[Tensor]) -> Tensor:
    """Return the sum of tensors, at least one."""
    return reduce(torch.add, parts)


def log_posterior(counts: Tensor) -> Tensor:
    """Return the logarithm of the class posterior of every row of counts."""
    return torch.log(counts / counts.sum(dim=1, keepdim=True))


def mass_entropy(counts: Tensor) -> Tensor:
    """Return mass times class entropy of every row of counts, nats."""
    mass = counts.sum(dim=1)
    return torch.special.xlogy(mass, mass) - torch.special.xlogy(counts, counts).sum(dim=1)


@njit(cache=True)
def _entropy(counts: F64) -> float:
    """Mass times entropy of the class, nats."""
    mass = 0.0
    total = 0.0
    for count in counts:
        mass += count
        if count > 0.0:
            total -= count * math.log(count)
    return total + mass * math.log(mass) if mass > 0.0 else 0.0


@njit(cache=True)
def _cost(a: F64, b: F64, own: float) -> float:
    """Information lost when a and b become one; `own` is the sum of their entropies."""
    mass = 0.0
    total = 0.0
    for c in range(len(a)):
        count = a[c] + b[c]
        mass += count
        if count > 0.0:
            total -= count * math.log(count)
    return max(0.0, total + mass * math.log(mass) - own) if mass > 0.0 else 0.0


@njit(cache=True)
def _nearest(costs: F64, alive: NDArray[np.bool_], row: int) -> int:
    """The partner of a row with the least cost, -1 without one; the lower number wins a draw."""
    best = -1
    for column in range(len(alive)):
        if alive[column] and column != row and (best < 0 or costs[row, column] < costs[row, best]):
            best = column
    return best


@njit(cache=True)
def _merge(counts: F64, wanted: int, label: NDArray[np.int64]) -> None:
    n = len(counts)
    alive = np.ones(n, np.bool_)
    entropy = np.empty(n)
    costs = np.zeros((n, n))
    nearest = np.empty(n, np.int64)
    for i in range(n):
        entropy[i] = _entropy(counts[i])
        for j in range(i):
            costs[i, j] = costs[j, i] = _cost(counts[i], counts[j], entropy[i] + entropy[j])
    for i in range(n):
        nearest[i] = _nearest(costs, alive, i)
    for _ in range(n - wanted):
        kept = -1
        for i in range(n):
            if alive[i] and (kept < 0 or costs[i, nearest[i]] < costs[kept, nearest[kept]]):
                kept = i
        gone = nearest[kept]
        if gone < kept:
            kept, gone = gone, kept
        counts[kept] += counts[gone]
        entropy[kept] = _entropy(counts[kept])
        alive[gone] = False
        for i in range(n):
            if label[i] == gone:
                label[i] = kept
        for i in range(n):
            if alive[i] and i != kept:
                costs[i, kept] = costs[kept, i] = _cost(counts[i], counts[kept], entropy[i] + entropy[kept])
        for i in range(n):
            if not alive[i]:
                continue
            if i == kept or nearest[i] == gone or nearest[i] == kept:
                nearest[i] = _nearest(costs, alive, i)
            elif costs[i, kept] < costs[i, nearest[i]]:
                nearest[i] = kept


def merged(counts: F64, wanted: int) -> NDArray[np.int64]:
    """Return the new number 0..wanted-1 of every node, int64 (nodes,), after merging `counts` (nodes, classes) down to `wanted`.

    Nodes keep their order; a group has the place of its lowest member.
    """
    label = np.arange(len(counts), dtype=np.int64)
    if wanted < len(counts):
        _merge(np.array(counts, np.float64), wanted, label)
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64)
