"""Walks of an automaton by the slow, plain way: which nodes a click word passes, and the golden walks that bind a bundle to them.

Owns the reference that the kernels of decide and the independent walks of instrument and core are held against, and what an automaton is
expected to achieve. Numpy over many words at once; nothing here is in a hot path.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.ranges import Range, demand

from .automaton import Automaton

GOLDEN_NODES = 512  # nodes, evenly spread, to which a golden walk leads
LEAST_POSTERIOR = 1e-30  # of a score, so that it is finite: scores are log posteriors
_TEXTS = ("profile", "task", "split")
_MANY = 1e30
EXPECTED_RANGES = {
    "objects": Range(1, 1 << 53, whole=True),
    "accuracy": Range(0.0, 1.0),
    "clicks": Range(0.0, 8 * 1024),
    "photons": Range(0.0, _MANY),
    "illumination": Range(0.0, _MANY),
    "exposures": Range(1.0, 1024),
}
EXPECTED_KEYS = (*_TEXTS, *EXPECTED_RANGES)
EXPECTED_TOLERANCE = 1e-6  # of an exact figure, times max(1, |figure|): the sums are float64


def walk_nodes(automaton: Automaton, words: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the node in each slot, uint32 (n, n_slots + 1), of click words of zeros and ones (n, n_bits); the leaf is repeated to the end.

    Bit t * channels + k is the click of channel k in slot t; where photons are counted, number t is theirs. What follows the leaf does
    not matter.
    """
    n_states, channels = automaton.n_states, automaton.channels
    bits = words.astype(np.uint32).reshape(len(words), automaton.n_slots, channels)
    outcomes = (bits << np.arange(channels, dtype=np.uint32)).sum(axis=2, dtype=np.uint32)
    nodes = np.zeros((len(words), automaton.n_slots + 1), np.uint32)
    for slot in range(automaton.n_slots):
        here = nodes[:, slot]
        going = here < n_states
        nodes[:, slot + 1] = here
        nodes[going, slot + 1] = automaton.successors[here[going], outcomes[going, slot]]
    return nodes


def words_to(automaton: Automaton, nodes: NDArray[Any]) -> NDArray[np.float32]:
    """Return one click word per node of `nodes` that leads to it, float32 (n, n_bits), zeros beyond."""
    n_nodes, outcomes = len(automaton.posteriors), automaton.n_outcomes
    edge = np.full(n_nodes, -1, np.int64)
    edge[automaton.successors.reshape(-1)] = np.arange(automaton.successors.size)
    bits = np.zeros((len(nodes), automaton.n_slots, automaton.channels), np.float32)
    row, here = np.arange(len(nodes)), np.asarray(nodes, np.int64)
    while (moving := here > 0).any():
        row, here = row[moving], here[moving]
        state, outcome = np.divmod(edge[here], outcomes)
        slot = automaton.depth[state].astype(np.int64)
        bits[row, slot] = (
            outcome[:, None] if automaton.counts else outcome[:, None] >> np.arange(automaton.channels) & 1
        )
        here = state
    return bits.reshape(len(nodes), automaton.n_bits)


def golden_nodes(automaton: Automaton) -> NDArray[np.int64]:
    """Return nodes that golden walks lead to: at most `GOLDEN_NODES`, evenly spread, the last leaf among them."""
    last = len(automaton.posteriors) - 1
    return np.unique(np.linspace(1, last, min(last, GOLDEN_NODES)).round().astype(np.int64))


def check_words(automaton: Automaton, words: NDArray[Any], what: str) -> None:
    """Raise ValueError for click words with a number that no outcome of `automaton` has; `what` names them."""
    most = automaton.n_outcomes - 1 if automaton.counts else 1
    fits = bool(((words >= 0) & (words <= most) & (words == np.floor(words))).all())
    allowed = f"whole ones from 0 to {most}" if automaton.counts else "0 and 1"
    demand(fits, f"{what} hold other numbers than {allowed}")


def log_scores(posteriors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return scores of posteriors (n, classes), float32: their logarithms, at least log(1e-30)."""
    return np.log(np.maximum(posteriors, np.float32(LEAST_POSTERIOR)))


def walk_difference(automaton: Automaton, words: NDArray[Any], walks: NDArray[Any]) -> str:
    """Return what differs between golden walks (n, n_slots + 1) and the automaton's, or "" if nothing does."""
    found = walk_nodes(automaton, words)
    if found.shape != walks.shape:
        return f"golden walks of shape {walks.shape}, expected {found.shape}"
    differs = (found != walks).any(axis=1)
    if not differs.any():
        return ""
    row = int(differs.argmax())
    slot = int((found[row] != walks[row]).argmax())
    return (
        f"golden walk {row} is at node {walks[row, slot]} after {slot} exposures, the automaton at {found[row, slot]}"
    )


def greatest_light(automaton: Automaton, light: NDArray[np.float64]) -> float:
    """Return the most light that one walk can take, of the light of each state, float64 (states,)."""
    order = np.argsort(automaton.depth, kind="stable")
    ends = np.searchsorted(automaton.depth[order], np.arange(automaton.n_slots + 1))
    most = np.zeros(len(automaton.posteriors))
    for slot in range(automaton.n_slots - 1, -1, -1):
        states = order[ends[slot] : ends[slot + 1]]
        most[states] = light[states] + most[automaton.successors[states]].max(axis=1)
    return float(most[0])


def shortest_walk(automaton: Automaton) -> int:
    """Return the exposures of the shortest walk: one more than the depth of the first state with a leaf behind it."""
    ends = (automaton.successors >= automaton.n_states).any(axis=1)
    return int(automaton.depth[ends].min()) + 1


def check_expected(expected: Mapping[str, Any], automaton: Automaton) -> None:
    """Raise ValueError for figures that are not in range or that no walk of `automaton` can have."""
    demand(
        set(expected) == set(EXPECTED_KEYS),
        f"expected has the keys {ascii(sorted(expected))[:200]}, needed: {EXPECTED_KEYS}",
    )
    for name in _TEXTS:
        text = expected[name]
        fine = isinstance(text, str) and 0 < len(text) <= 200 and text.isprintable()
        demand(fine, f"expected.{name} is {ascii(text)[:80]}, allowed: 1 to 200 printable characters")
    for name, allowed in EXPECTED_RANGES.items():
        allowed.checked(expected[name], f"expected.{name}")
    exposures, clicks = float(expected["exposures"]), float(expected["clicks"])
    slack = 1 + 1e-9  # of sums of rounded numbers
    demand(
        exposures <= automaton.n_slots * slack, f"expected.exposures is {exposures:g} of {automaton.n_slots} at most"
    )
    most = exposures * (automaton.n_outcomes - 1 if automaton.counts else automaton.channels)
    demand(clicks <= most * slack, f"expected.clicks is {clicks:g} of {exposures:g} exposures")


def expected_differences(kept: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """Return which figures of a bundle's `expected` are others now; those of other conditions cannot be compared, and give none."""
    names = EXPECTED_KEYS
    if any(kept[name] != found[name] for name in names[:4]):
        return []
    return [
        f"expected {name} is {kept[name]:.9g} in the bundle, {found[name]:.9g} here"
        for name in names[4:]
        if not math.isclose(kept[name], found[name], rel_tol=EXPECTED_TOLERANCE, abs_tol=EXPECTED_TOLERANCE)
    ]
