"""Small automata for tests: written by hand, drawn at random, and in a bundle."""

from typing import Any

import numpy as np
from bundles import made_bundle

from pans.bundle.automaton import Automaton, reachable_automaton
from pans.bundle.sensor import Bundle

EXPECTED: dict[str, Any] = {
    **{"profile": "ideal", "task": "test", "split": "test", "objects": 100},
    **{"accuracy": 0.5, "clicks": 1.2, "photons": 3.0, "illumination": 9.0, "exposures": 2.5},
}


def early_leaf() -> Automaton:
    """Two states, two slots: a click in slot 0 decides at once."""
    return Automaton(
        pattern=[0, 1],
        dwell=[4, 1],
        dwell_steps=4,
        successors=[[1, 2], [3, 4]],
        posteriors=[[0.5, 0.5], [0.7, 0.3], [0.1, 0.9], [0.8, 0.2], [0.4, 0.6]],
    )


def diamond() -> Automaton:
    """Five states, three slots: two states share a pattern, two walks meet again, one edge ends early."""
    return Automaton(
        pattern=[0, 1, 2, 1, 0],
        dwell=[2, 1, 2, 2, 1],
        dwell_steps=2,
        successors=[[1, 2], [3, 3], [3, 4], [5, 6], [7, 6]],
        posteriors=[
            *([0.4, 0.3, 0.3], [0.6, 0.2, 0.2], [0.2, 0.4, 0.4], [0.5, 0.3, 0.2], [0.1, 0.1, 0.8]),
            *([0.7, 0.2, 0.1], [0.2, 0.7, 0.1], [0.05, 0.05, 0.9]),
        ],
    )


def random_automaton(
    seed: int, slots: int = 6, width: int = 5, classes: int = 3, channels: int = 1, patterns: int = 7, outcomes: int = 0
) -> Automaton:
    """At most `width` states per slot, edges at random to the next slot or, one in eight, to a leaf.

    With `outcomes` they follow photon numbers, else clicks.
    """
    rng = np.random.default_rng(seed)
    of_slot = [1, *(width for _ in range(slots - 1))]
    starts = np.concatenate([[0], np.cumsum(of_slot)])
    n_states, n_leaves = int(starts[-1]), 2 * width
    successors = np.empty((n_states, outcomes or 1 << channels), np.int64)
    for slot, n in enumerate(of_slot):
        rows = slice(int(starts[slot]), int(starts[slot]) + n)
        shape = (n, successors.shape[1])
        successors[rows] = n_states + rng.integers(0, n_leaves, shape)
        if slot + 1 < slots:
            inner = rng.integers(int(starts[slot + 1]), int(starts[slot + 2]), shape)
            goes_on = rng.random(shape) < 7 / 8
            goes_on[0, 0] = True  # one path passes every slot
            inner[0, 0] = starts[slot + 1]
            successors[rows] = np.where(goes_on, inner, successors[rows])
    posteriors = rng.dirichlet(np.full(classes, 0.7), n_states + n_leaves)
    shown = rng.integers(0, patterns, n_states), rng.integers(1, 9, n_states), 8
    return reachable_automaton(*shown, successors, posteriors, outcomes > 0)


def automaton_bundle(automaton: Automaton | None = None, **facts: Any) -> Bundle:
    """A bundle of `automaton` (the diamond by default) with random patterns of 2 x 2 pixels and 4 levels."""
    automaton = diamond() if automaton is None else automaton
    n_patterns = int(automaton.pattern.max()) + automaton.channels
    levels = facts.get("levels", 4)
    pattern_levels = np.random.default_rng(7).integers(0, levels, (n_patterns, 4))
    pattern_levels[:, 0] = levels - 1
    given: dict[str, Any] = {"image_shape": (2, 2), "levels": levels, "pattern_levels": pattern_levels}
    return made_bundle(n_classes=automaton.n_classes, automaton=automaton, **given | {"photons_per_level": 0.2} | facts)
