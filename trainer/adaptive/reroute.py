"""Better successors for what is already tuned: every edge goes to the node behind it that costs its objects least.

Owns one sweep from the last level to the first: with the expected loss beta' of every node of the next level, exact for every object, an
edge (state s, outcome k) moves to the node n of least sum over objects of alpha(s) q_k(s) beta'(n). Levels above are not touched by
it, levels below are already done, so that the expected loss on the objects of the sweep falls with every move (the improvement step of
Hansen's policy iteration for finite-state controllers). Nodes that lose their last edge take over edges of the fullest
nodes, as copies of them; what only the old node led to is revived by the next sweep.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .light import Grey, Light
from .machine import COUNT_FLOOR, Machine, Sight, forward, leaf_losses
from .objects import Block
from .outcomes import by_state, channels_of, readings

SURE = 0.5  # standard errors by which a node must be better; the difference of an object's losses varies by about LOSS_SPREAD
LOSS_SPREAD = 0.5  # nats


@dataclass(frozen=True, slots=True)
class Rerouted:
    """How many edges moved (`stopped`: to leaves of their own) and empty nodes were revived, and the loss saved per object, nats."""

    moved: int
    revived: int
    saved: float
    stopped: int = 0


class Sweep:
    """What a sweep keeps of every block: probability and light of all states, and the expected loss behind the present level."""

    def __init__(self, machine: Machine, sight: Sight, blocks: list[Block]) -> None:
        self.machine, self.sight, self.blocks = machine, sight, blocks
        self.n_states = sum(level.n_states for level in machine.levels)
        counted = sum(float(counts.sum()) for counts in machine.counts)
        self.scale = counted / sum(len(block) for block in blocks)  # the sweep may be over a part of the objects
        self.kept: list[list[tuple[Tensor, Tensor]]] = []
        for block in blocks:
            steps = forward(machine, sight, block.grey).steps
            self.kept.append([(step.alpha.bfloat16(), step.light.bfloat16()) for step in steps])
        self.betas = [leaf_losses(machine.counts[-1], block.one_hot) for block in blocks]

    def costs(self, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """Expected loss of every edge at every node, (outcomes, states, nodes), class counts of the edges, (outcomes, states, classes),
        and the standard error of a difference of losses, (outcomes, states)."""
        costs: Tensor | None = None
        arrived: Tensor | None = None
        squares: Tensor | None = None
        for kept, beta, block in zip(self.kept, self.betas, self.blocks):
            edges = self._edges(kept[number])
            part, counted, square = edges @ beta.T, edges @ block.one_hot.T, edges.square().sum(dim=1)
            costs = part if costs is None else costs + part
            arrived = counted if arrived is None else arrived + counted
            squares = square if squares is None else squares + square
        assert costs is not None
        assert arrived is not None
        assert squares is not None
        error = LOSS_SPREAD * squares.sqrt()
        by_outcome = len(self.machine.levels[number].successors), -1
        return costs.unflatten(0, by_outcome), arrived.unflatten(0, by_outcome), error.unflatten(0, by_outcome)

    def copy_node(self, source: int, target: int) -> None:
        """Let the expected loss of `target` behind the present level be that of `source`."""
        for beta in self.betas:
            beta[target] = beta[source]

    def add_leaves(self, counts: Tensor) -> None:
        """Put leaves of these class counts (leaves, classes) behind the nodes behind the present level."""
        for index, block in enumerate(self.blocks):
            self.betas[index] = torch.cat([self.betas[index], leaf_losses(counts, block.one_hot)])

    def step_back(self, number: int, price: float, exposure_price: float) -> None:
        """Replace the expected losses behind level `number` by those before it, under its present successors."""
        level = self.machine.levels[number]
        for index, (kept, block) in enumerate(zip(self.kept, self.blocks)):
            light = kept[number][1].float()
            beta = self.betas[index]
            before = after = beta[level.successors[-1]]
            for chance, outcome in zip(readings(light, self.sight.law)[0], level.successors):
                before = before + chance * (beta[outcome] - after)
            before = before + price * by_state(light, channels_of(self.sight.law))
            before += exposure_price
            if number and len(self.machine.counts[number - 1]):
                before = torch.cat([before, leaf_losses(self.machine.counts[number - 1], block.one_hot)])
            self.betas[index] = before

    def _edges(self, kept: tuple[Tensor, Tensor]) -> Tensor:
        """Probability of every edge, (outcomes * states, objects)."""
        alpha, light = kept[0].float(), kept[1].float()
        parts = [alpha * chance for chance in readings(light, self.sight.law)[0]]
        rest = alpha - parts[0]
        for part in parts[1:]:
            rest = (rest - part).clamp_(min=0)
        return torch.cat([*parts, rest])


def reroute(machine: Machine, sight: Sight, blocks: list[Block], price: float, exposure_price: float = 0.0) -> Rerouted:
    """Move the edges of `machine` to better nodes, by the objects in `blocks`; `price` is that of a photoelectron.

    With an `exposure_price` an edge may end the walk: it goes to a new leaf where to decide at once costs less than what follows.
    """
    with torch.no_grad():
        sweep = Sweep(machine, sight, blocks)
        moved = revived = stopped = 0
        saved = 0.0
        for number in range(len(machine.levels) - 1, -1, -1):
            level = machine.levels[number]
            costs, arrived, error = sweep.costs(number)
            now = costs.gather(2, level.successors.unsqueeze(2)).squeeze(2)
            least, best = costs.min(dim=2)
            better = least < now - SURE * error
            level.successors = torch.where(better, best, level.successors)
            moved += int(better.sum())
            saved += float((now - least)[better].sum())
            if exposure_price and number + 1 < len(machine.levels):
                ended, gained = _stop(machine, number, sweep, torch.minimum(now, least), arrived, error)
                stopped, saved = stopped + ended, saved + gained
            for full, empty in _revive(machine, number, arrived):
                sweep.copy_node(full, empty)
                revived += 1
            sweep.step_back(number, price, exposure_price)
    return Rerouted(moved + stopped, revived, saved / sum(len(block) for block in blocks), stopped)


def _stop(
    machine: Machine, number: int, sweep: Sweep, cost: Tensor, arrived: Tensor, error: Tensor
) -> tuple[int, float]:
    """Give edges leaves of their own where that costs less than `cost`; all (outcomes, states). Returns how many, and what is saved.

    A leaf states the posterior of the objects that arrive, with one more object spread over the classes, so that few of them
    promise little.
    """
    counts = arrived + 1.0 / arrived.shape[2]
    at_once = -(arrived * torch.log(counts / counts.sum(dim=2, keepdim=True))).sum(dim=2)
    level, ends = machine.levels[number], at_once < cost - SURE * error
    n_leaves, n_nodes = int(ends.sum()), machine.n_nodes(number)
    if n_leaves:
        level.successors[ends] = torch.arange(n_nodes, n_nodes + n_leaves)
        leaves = counts[ends] * sweep.scale
        machine.counts[number] = torch.cat([machine.counts[number], leaves])
        sweep.add_leaves(leaves)
    return n_leaves, float((cost - at_once)[ends].sum())


def _revive(machine: Machine, number: int, arrived: Tensor) -> list[tuple[int, int]]:
    """Give every node behind level `number` an edge: an empty one becomes a copy of the fullest and takes half of its edges.

    Returns the copies made, (full, empty).
    """
    level, n_nodes = machine.levels[number], machine.n_nodes(number)
    n_states = n_nodes - len(machine.counts[number])
    targets, edges = level.successors.flatten(), arrived.flatten(0, 1)
    mass = edges.sum(dim=1)
    in_edges = torch.bincount(targets, minlength=n_nodes)
    revived: list[tuple[int, int]] = []
    for empty in (in_edges == 0).nonzero().flatten().tolist():
        load = torch.zeros(n_nodes).index_add_(0, targets, mass)
        load[in_edges < 2] = -1.0
        load[(torch.arange(n_nodes) < n_states) != (empty < n_states)] = -1.0  # a leaf is no copy of a state
        full = int(load.argmax())
        if load[full] < 0:
            break
        own = (targets == full).nonzero().flatten()
        half = _other_half(edges[own])
        targets[own[half]] = empty
        in_edges[full] -= int(half.sum())
        in_edges[empty] = int(half.sum())
        _copy_node(machine, number, full, empty, edges[own[half]].sum(dim=0))
        revived.append((full, empty))
    level.successors = targets.unflatten(0, (len(level.successors), -1))
    return revived


def _other_half(counts: Tensor) -> Tensor:
    """Part edges by their classes: the edge furthest from the sum, and those nearer to it than to the rest; never all."""
    share = (counts + COUNT_FLOOR) / (counts + COUNT_FLOOR).sum(dim=1, keepdim=True)
    whole = (counts.sum(dim=0) + COUNT_FLOOR) / (counts.sum(dim=0) + COUNT_FLOOR).sum()
    distance = (share * (share / whole).log()).sum(dim=1) * counts.sum(dim=1)
    far = share[int(distance.argmax())]
    to_far, to_whole = (far * (far / share).log()).sum(dim=1), (whole * (whole / share).log()).sum(dim=1)
    half = to_far < to_whole
    half[int(distance.argmax())] = True
    if bool(half.all()):
        half[int(to_whole.argmin())] = False
    return half


def _copy_node(machine: Machine, number: int, source: int, target: int, counts: Tensor) -> None:
    """Let node `target` behind level `number` do what `source` does; a leaf takes the class counts of its own edges."""
    n_states = machine.n_nodes(number) - len(machine.counts[number])
    if source >= n_states and target >= n_states:
        whole = machine.counts[number]
        share = counts / counts.sum().clamp(min=1e-9)
        whole[target - n_states] = share * whole[source - n_states].sum() / 2 + COUNT_FLOOR
        return
    level = machine.levels[number + 1]
    for tensor in _by_state(level.light):
        blocks = tensor.view(level.n_states, -1)
        blocks[target] = blocks[source]
    level.successors[:, target] = level.successors[:, source]


def _by_state(light: Light) -> list[Tensor]:
    """The tensors of which a state has rows of its own."""
    if isinstance(light, Grey):
        return [light.root]
    own = [light.lean if light.rows is None else light.rows]
    return own if len(light.log_light) == 1 else [*own, light.log_light]
