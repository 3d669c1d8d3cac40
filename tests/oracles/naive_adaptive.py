"""Slow oracles for automata that are trained: all click words one by one in exact numbers, and merging that recomputes every cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Any

from mpmath import mp, mpf


def every_word(
    successors: Sequence[Sequence[Sequence[int]]],
    n_states: Sequence[int],
    light: Sequence[Sequence[float]],
    dark: float,
) -> tuple[dict[tuple[int, int], Any], Any, Any, Any]:
    """Return the chance of every leaf (level, number), and the expected clicks, photons and exposures of one object.

    `successors[t][k][s]` is a node of level t + 1, `light[t][s]` what state s of level t brings; nodes from `n_states[t + 1]` on
    are leaves.
    All 2**T words are gone through; each ends at its leaf, and the bits behind it are summed out.
    """
    mp.dps = 60
    levels = len(successors)
    leaves: dict[tuple[int, int], Any] = {}
    clicks = photons = exposures = mpf(0)
    for word in product((0, 1), repeat=levels):
        chance, state, at = mpf(1), 0, 0
        of_clicks, of_photons = 0, mpf(0)
        for level in range(levels):
            brought = mpf(light[level][state])
            silent = mp.exp(-(brought + mpf(dark)))
            chance *= 1 - silent if word[level] else silent
            of_clicks += word[level]
            of_photons += brought
            at = level + 1
            node = successors[level][word[level]][state]
            if node >= n_states[at]:
                break
            state = node
        share = chance / 2 ** (levels - at)  # words that only differ behind the leaf are one walk
        leaf = at, node - n_states[at]
        leaves[leaf] = leaves.get(leaf, mpf(0)) + share
        clicks, photons, exposures = (
            clicks + share * of_clicks,
            photons + share * of_photons,
            exposures + share * at,
        )
    return leaves, clicks, photons, exposures


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
