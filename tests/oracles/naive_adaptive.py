"""A slow oracle for automata that are trained: merging that recomputes every cost."""

import math
from collections.abc import Sequence


def entropy(counts: Sequence[float]) -> float:
    """Mass times entropy, nats."""
    mass = math.fsum(counts)
    return math.fsum(-c * math.log(c / mass) for c in counts if c > 0)


def merged(counts: Sequence[Sequence[float]], wanted: int) -> list[list[int]]:
    """Groups of node numbers after greedy merging of the pair that loses least; in the order of their lowest members."""
    groups = [[i] for i in range(len(counts))]

    def total(group: list[int]) -> list[float]:
        return [math.fsum(counts[i][c] for i in group) for c in range(len(counts[0]))]

    while len(groups) > wanted:
        costs = {
            (a, b): entropy(total(groups[a] + groups[b])) - entropy(total(groups[a])) - entropy(total(groups[b]))
            for b in range(len(groups))
            for a in range(b)
        }
        a, b = min(costs, key=lambda pair: costs[pair])
        groups[a] = groups[a] + groups[b]
        del groups[b]
    return sorted((sorted(group) for group in groups), key=lambda group: group[0])
