"""Sweeps over a tuned automaton, from the last level to the first: better successors, and patterns that many states share.

With the expected loss beta' of every node of the next level, exact for every object, `reroute` moves an edge (state s, outcome k) to the
node n of least sum over objects of alpha(s) q_k(s) beta'(n). Levels before it are not touched, levels behind it are done, so that the
expected loss falls with every move (policy iteration for finite-state controllers, Hansen 1998). Nodes that lose their last edge take over
edges of the fullest nodes, as copies of them.

`share_patterns` groups one-bit patterns (k-means on their directions) into a pool; `choose_patterns` gives every state the pattern and
brightness of the pool that cost its objects least.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .grow import sum_of
from .machine import (
    BRIGHTNESS_MIN,
    COUNT_FLOOR,
    Aim,
    Bits,
    Grey,
    Light,
    Machine,
    Sight,
    forward,
    leaf_losses,
    sent_by,
)
from .objects import Block
from .outcomes import by_state, channels_of, readings

SURE = 0.5  # standard errors by which a node must be better; the difference of an object's losses varies by about LOSS_SPREAD
LOSS_SPREAD = 0.5  # nats
ROUNDS = 12  # of k-means
NEAREST = 48  # patterns of the pool that a state tries, the most alike
BRIGHTER = (0.6, 0.8, 1.0, 1.25, 1.6)  # times the brightness that keeps the light as it was
ROWS_AT_ONCE = 1024  # patterns that are compared with all others
NUMBERS_MAX = 1 << 27  # objects times patterns, of which the light is kept: 512 MiB
HARDLY = 1e-3  # chance to reach a state, below which an object is left out of that state's choice
GLARE = 1e-3  # of the price of a detected photoelectron, what one sent out costs: else a bright spot where hardly anything is would do
GLARE_MIN = 1e-5  # nats, where detected light is cheap: at 40 photons 96 patterns took an illumination of 5269 without it, and take 1065
SURE_OF_PATTERN = 1e-4  # of a state's cost, by which another pattern must be better


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
        parts = []
        for kept, beta, block in zip(self.kept, self.betas, self.blocks):
            edges = self._edges(kept[number])
            parts.append((edges @ beta.T, edges @ block.one_hot.T, edges.square().sum(dim=1)))
        by_outcome = len(self.machine.levels[number].successors), -1
        costs, arrived, squares = (sum_of(part).unflatten(0, by_outcome) for part in zip(*parts))
        return costs, arrived, LOSS_SPREAD * squares.sqrt()

    def step_back(self, number: int, aim: Aim) -> None:
        """Replace the expected losses behind level `number` by those before it, under its present successors."""
        level, channels = self.machine.levels[number], channels_of(self.sight.law)
        fixed = aim.exposure_price + aim.sent_price * by_state(sent_by(level.light), channels)
        for index, (kept, block) in enumerate(zip(self.kept, self.blocks)):
            light = kept[number][1].float()
            beta = self.betas[index]
            before = after = beta[level.successors[-1]]
            for chance, outcome in zip(readings(light, self.sight.law)[0], level.successors):
                before = before + chance * (beta[outcome] - after)
            before = before + aim.price * by_state(light, channels) + fixed
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


def reroute(machine: Machine, sight: Sight, blocks: list[Block], aim: Aim) -> int:
    """Move the edges of `machine` to better nodes, by the objects in `blocks` and the prices of `aim`, and return how many.

    Where an exposure has a price, an edge may end the walk: it goes to a new leaf where to decide at once costs less than what follows.
    """
    with torch.no_grad():
        sweep = Sweep(machine, sight, blocks)
        moved = 0
        for number in range(len(machine.levels) - 1, -1, -1):
            level = machine.levels[number]
            costs, arrived, error = sweep.costs(number)
            now = costs.gather(2, level.successors.unsqueeze(2)).squeeze(2)
            least, best = costs.min(dim=2)
            better = least < now - SURE * error
            level.successors = torch.where(better, best, level.successors)
            moved += int(better.sum())
            if aim.exposure_price and number + 1 < len(machine.levels):
                moved += _stop(sweep, number, torch.minimum(now, least), arrived, error)
            _revive(sweep, number, arrived)
            sweep.step_back(number, aim)
    return moved


def _stop(sweep: Sweep, number: int, cost: Tensor, arrived: Tensor, error: Tensor) -> int:
    """Give edges leaves of their own where that costs less than `cost`; all (outcomes, states). Returns how many.

    A leaf states the posterior of the objects that arrive, with one more object spread over the classes, so that few of them
    promise little.
    """
    counts = arrived + 1.0 / arrived.shape[2]
    at_once = -(arrived * torch.log(counts / counts.sum(dim=2, keepdim=True))).sum(dim=2)
    machine, ends = sweep.machine, at_once < cost - SURE * error
    n_leaves, n_nodes = int(ends.sum()), machine.n_nodes(number)
    if n_leaves:
        machine.levels[number].successors[ends] = torch.arange(n_nodes, n_nodes + n_leaves)
        leaves = counts[ends] * sweep.scale
        machine.counts[number] = torch.cat([machine.counts[number], leaves])
        for index, block in enumerate(sweep.blocks):
            sweep.betas[index] = torch.cat([sweep.betas[index], leaf_losses(leaves, block.one_hot)])
    return n_leaves


def _revive(sweep: Sweep, number: int, arrived: Tensor) -> None:
    """Give every node behind level `number` an edge: an empty one becomes a copy of the fullest and takes half of its edges."""
    machine = sweep.machine
    level, n_nodes = machine.levels[number], machine.n_nodes(number)
    n_states = n_nodes - len(machine.counts[number])
    targets, edges = level.successors.flatten(), arrived.flatten(0, 1)
    mass = edges.sum(dim=1)
    in_edges = torch.bincount(targets, minlength=n_nodes)
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
        for beta in sweep.betas:
            beta[empty] = beta[full]
    level.successors = targets.unflatten(0, (len(level.successors), -1))


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


def share_patterns(
    machine: Machine, wanted: int, masses: list[Tensor], own: list[Tensor], random: torch.Generator
) -> None:
    """Let all states of `machine` show at most `wanted` patterns; `masses` (states,) per level say how often a state is reached.

    The light on `own`, the mean object of every state (states, pixels) per level, stays as it was. Nothing happens where there are no
    more states than that.
    """
    bits = [level.light for level in machine.levels if isinstance(level.light, Bits)]
    masks = torch.cat([light.displayed()[0] for light in bits])
    if len(bits) < len(machine.levels) or len(masks) <= wanted:
        return
    weights = torch.cat(masses).clamp(min=1e-9)
    points = directions(masks)
    group = k_means(points, weights, wanted, random)
    sums = torch.zeros(wanted, masks.shape[1], dtype=masks.dtype).index_add_(0, group, points * weights.unsqueeze(1))
    pool, first = one_bit(sums), 0
    for light, mean in zip(bits, own):
        before = light.displayed()[0]
        light.rows, light.lean = group[first : first + len(before)], pool
        first += len(before)
        if not one_brightness(bits):
            _keep_light(light, (before * mean).sum(dim=1), mean)
        light.settle()


def one_brightness(lights: list[Bits]) -> bool:
    """Return whether all levels share one brightness."""
    return len(lights) > 1 and lights[0].log_light is lights[1].log_light


def directions(masks: Tensor) -> Tensor:
    """Return patterns (n, pixels) as vectors of length 1: two that differ in brightness alone are one direction; dark ones stay 0."""
    return masks / masks.square().sum(dim=1, keepdim=True).sqrt().clamp(min=1e-9)


def one_bit(sums: Tensor) -> Tensor:
    """Return the parameters (lit above 0) of the one-bit patterns that point most nearly along `sums`, (n, pixels), none below 0.

    Of the brightest k pixels the cosine with the sum is their part of it over the square root of k: the best k is taken. A mean of the
    parameters themselves would leave few pixels lit, or none, where the patterns of a group differ.
    """
    values, _ = sums.sort(dim=1, descending=True)
    number = torch.arange(1, sums.shape[1] + 1, dtype=sums.dtype)
    best = (values.cumsum(dim=1) / number.sqrt()).argmax(dim=1, keepdim=True)
    last = values.gather(1, best)
    following = torch.where(best + 1 < sums.shape[1], values.gather(1, (best + 1).clamp(max=sums.shape[1] - 1)), 0.0)
    return (sums - (last + following) / 2) / values[:, :1].clamp(min=1e-30)


def _keep_light(light: Bits, before: Tensor, mean: Tensor) -> None:
    """Set the brightness so that the light on the mean objects is `scale * before` again, (states,)."""
    after = (light.displayed()[0] * mean).sum(dim=1).clamp(min=BRIGHTNESS_MIN)
    light.log_light += (before.clamp(min=BRIGHTNESS_MIN) / after).log().unsqueeze(1)


def k_means(points: Tensor, weights: Tensor, wanted: int, random: torch.Generator) -> Tensor:
    """Return the group 0..wanted-1 of every point (n, dimensions), int64 (n,), by Lloyd's rounds from heavy points drawn at random."""
    centres = points[torch.multinomial(weights, wanted, generator=random)]
    group = torch.zeros(len(points), dtype=torch.int64)
    for _ in range(ROUNDS):
        distance = centres.square().sum(dim=1) - 2 * points @ centres.T
        least, group = distance.min(dim=1)
        mass = torch.zeros(wanted, dtype=points.dtype).index_add_(0, group, weights)
        sums = torch.zeros_like(centres).index_add_(0, group, points * weights.unsqueeze(1))
        centres = torch.where(mass.unsqueeze(1) > 0, sums / mass.clamp(min=1e-30).unsqueeze(1), centres)
        empty = (mass == 0).nonzero().flatten()
        if len(empty):  # they go to the points that are served worst
            error = (least + points.square().sum(dim=1)) * weights
            centres[empty] = points[error.topk(len(empty)).indices]
    return group


# ---- which pattern of the pool a state shows ----


@dataclass(frozen=True, slots=True)
class _Pool:
    """What a state can choose: `light` of every pattern on the objects (patterns, objects), the pixels that each lights (patterns,), which
    patterns are most like which, the pattern itself first (patterns, tried), and by what the brightness may change.
    """

    light: Tensor
    lit: Tensor
    near: Tensor
    factors: Tensor


def choose_patterns(machine: Machine, sight: Sight, blocks: list[Block], aim: Aim) -> int:
    """Let every state show the pattern of the pool, and have the brightness, that cost the objects in `blocks` least.

    Returns how many states changed. Light has the prices of `aim`. From the last level to the first, so that the expected cost
    falls with every change. Only the first of the blocks are taken where all are too many for memory. Patterns that nothing shows
    afterwards become copies of those that are shown most, and take half of their states.
    """
    lights = [level.light for level in machine.levels]
    pooled = [light for light in lights if isinstance(light, Bits) and light.rows is not None]
    if len(pooled) < len(lights):
        return 0
    blocks = blocks[: max(1, NUMBERS_MAX // (len(blocks[0]) * len(pooled[0].lean)))]
    with torch.no_grad():
        sweep = Sweep(machine, sight, blocks)
        pool = _pool_of(pooled, sight, blocks)
        changed, reached = 0, []
        for number in range(len(lights) - 1, -1, -1):
            alphas = torch.cat([kept[number][0] for kept in sweep.kept], dim=1).float()
            reached.append(alphas.sum(dim=1))
            changed += _choose(pooled[number], number, sweep, alphas, pool, aim)
            sweep.step_back(number, aim)
        _use_all(pooled, reached[::-1])
    return changed


def _pool_of(pooled: list[Bits], sight: Sight, blocks: list[Block]) -> _Pool:
    mask = torch.gt(pooled[0].lean, 0).to(sight.sums)
    near = nearest(directions(mask), min(NEAREST, len(mask)))
    light = torch.cat([sight.light(mask, block.grey) for block in blocks], dim=1)
    factors = (1.0,) if one_brightness(pooled) else BRIGHTER
    return _Pool(light, mask.sum(dim=1), near, torch.tensor(factors, dtype=light.dtype))


def nearest(vectors: Tensor, count: int) -> Tensor:
    """Return the numbers of the `count` vectors (n, dimensions) that are most like each, (n, count), itself first."""
    found = []
    for first in range(0, len(vectors), ROWS_AT_ONCE):
        rows = vectors[first : first + ROWS_AT_ONCE]
        alike = rows @ vectors.T
        own = torch.arange(len(rows))
        alike[own, first + own] = torch.inf
        found.append(alike.topk(count, dim=1).indices)
    return torch.cat(found)


def _choose(light: Bits, number: int, sweep: Sweep, alphas: Tensor, pool: _Pool, aim: Aim) -> int:
    """Choose for all states of one level, reached with `alphas` (states, objects); returns how many changed."""
    assert light.rows is not None
    to = sweep.machine.levels[number].successors
    rest = [beta[to[-1]] for beta in sweep.betas]  # below: what each other outcome costs more than the last
    gains = [torch.cat([beta[one] - last for beta, last in zip(sweep.betas, rest)], dim=1) for one in to[:-1]]
    glare = aim.sent_price + max(GLARE * aim.price, GLARE_MIN)
    changed, before = 0, light.scale().flatten().clone()
    for state in range(len(light.rows)):
        some = (alphas[state] > HARDLY).nonzero().flatten()
        if not len(some):
            continue
        candidates = pool.near[light.rows[state]]
        seen, alpha = pool.light[candidates][:, some], alphas[state, some]
        # about the brightness that keeps the light; the same where all states share one
        brought, now = seen @ alpha, before[state]
        several = len(pool.factors) > 1
        keeping = brought[0] / brought.clamp(min=1e-9) * now if several else now.expand(len(brought))
        bright = (keeping.unsqueeze(1) * pool.factors).clamp(light.bottom, light.top)
        lights = seen.unsqueeze(1) * bright.unsqueeze(2)  # (candidates, factors, objects)
        sent = glare * pool.lit[candidates].unsqueeze(1) * bright * alpha.sum()
        chances, _ = readings(lights, sweep.sight.law)
        expected = sum_of(chance @ (alpha * gain[state, some]) for chance, gain in zip(chances, gains))
        costs = expected + aim.price * (lights @ alpha) + sent
        best = int(costs.argmin())
        if costs.flatten()[best] < costs[0, len(pool.factors) // 2] - SURE_OF_PATTERN * alpha.sum():
            light.rows[state] = candidates[best // len(pool.factors)]
            if several:
                light.log_light[state] = bright.flatten()[best].log()
            changed += 1
    _keep_new_light(light, number, sweep, pool)
    return changed


def _keep_new_light(light: Bits, number: int, sweep: Sweep, pool: _Pool) -> None:
    """Let the sweep step back with the light that the new patterns bring."""
    first = 0
    for kept in sweep.kept:
        alpha = kept[number][0]
        brought = pool.light[light.rows, first : first + alpha.shape[1]] * light.scale()
        kept[number] = alpha, brought.bfloat16()
        first += alpha.shape[1]


def _use_all(pooled: list[Bits], masses: list[Tensor]) -> None:
    """Let patterns that no state shows be copies of those that serve most, and give them half of their states."""
    pool = pooled[0].lean
    rows = torch.cat([light.rows for light in pooled if light.rows is not None])
    weights = torch.cat(masses)
    served = torch.zeros(len(pool)).index_add_(0, rows, weights)
    shown = torch.bincount(rows, minlength=len(pool))
    for empty in (shown == 0).nonzero().flatten().tolist():
        full = int(torch.where(shown > 1, served, -1.0).argmax())
        if shown[full] < 2:
            break
        states = (rows == full).nonzero().flatten()
        moved = states[len(states) // 2 :]  # those of later exposures
        rows[moved] = empty
        pool[empty] = pool[full]
        for one in (full, empty):
            shown[one], served[one] = int((rows == one).sum()), float(weights[rows == one].sum())
    first = 0
    for light in pooled:
        assert light.rows is not None
        light.rows.copy_(rows[first : first + len(light.rows)])
        first += len(light.rows)
