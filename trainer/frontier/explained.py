"""What an automaton does, in numbers that explain it: how often each node is reached, where its light goes, what is known after how much.

Owns the exact sums over given objects and the sampling of single walks; numpy only, on a detector without dark counts or read noise (the
profile `ideal`): a click has the chance 1 - exp(-lambda). Never draws.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.bundle.model import Bundle

F64 = NDArray[np.float64]
_OBJECTS = 250  # at a time


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """Exact means over objects; by slot means exposures 0 ... T - 1, and for `entropy` 0 ... T exposures made.

    `reach` is by node (states, then leaves), `click` by state: its chance where the state is reached (nan where none is).
    `pixel_light` (pixels,) is what all exposures of a decision send to each pixel, photoelectrons at transmission 1.
    `entropy` (T + 1, 3): mean, lowest and highest tenth, in bits; walks that have ended keep theirs.
    """

    reach: F64
    click: F64
    lit: F64
    photons: F64
    clicks: F64
    pixel_light: F64
    entropy: F64


def state_light(bundle: Bundle) -> F64:
    """Return photoelectrons per exposure at transmission 1 of each state, float64 (states, pixels)."""
    automaton = automaton_of(bundle)
    dwell = automaton.dwell.astype(np.float64) / automaton.dwell_steps
    return bundle.pattern_levels[automaton.pattern].astype(np.float64) * (bundle.photons_per_level * dwell)[:, None]


def automaton_of(bundle: Bundle) -> Automaton:
    """Return the automaton of a bundle; ValueError where it has none."""
    if bundle.automaton is None:
        raise ValueError(f"{bundle.name} has no automaton")
    return bundle.automaton


def explain(bundle: Bundle, transmission: NDArray[np.floating]) -> Explained:
    """Return the exact sums over objects of that transmission, (n, pixels), 0 to 1."""
    automaton, n = automaton_of(bundle), len(transmission)
    if n < 1:
        raise ValueError("no objects to explain an automaton by, allowed: at least one")
    n_states, n_nodes, slots = automaton.n_states, len(automaton.posteriors), automaton.n_slots
    light, reach, clicked = state_light(bundle), np.zeros(n_nodes), np.zeros(n_states)
    photons = np.zeros(slots)
    for start in range(0, n, _OBJECTS):
        rows = transmission[start : start + _OBJECTS].astype(np.float64)
        alpha = np.zeros((n_nodes, len(rows)))
        alpha[0] = 1.0
        for slot, states in _by_slot(automaton):
            expected = light[states] @ rows.T
            click = alpha[states] * -np.expm1(-expected)
            clicked[states] += click.sum(axis=1) / n
            photons[slot] += (alpha[states] * expected).sum() / n
            np.add.at(alpha, automaton.successors[states, 1], click)
            np.add.at(alpha, automaton.successors[states, 0], alpha[states] * np.exp(-expected))
        reach += alpha.sum(axis=1) / n
    with np.errstate(invalid="ignore"):
        chance = np.where(reach[:n_states] > 0, clicked / reach[:n_states], np.nan)
    lit, clicks = (np.bincount(automaton.depth, of, slots).astype(np.float64) for of in (reach[:n_states], clicked))
    return Explained(
        reach, chance, lit, photons, clicks, reach[:n_states] @ light, _entropies(automaton, reach, clicked)
    )


def _by_slot(automaton: Automaton) -> Iterator[tuple[int, NDArray[np.int64]]]:
    for slot in range(automaton.n_slots):
        yield slot, np.flatnonzero(automaton.depth == slot)


def entropy_of(posteriors: NDArray[np.floating]) -> F64:
    """Return the entropy of each row in bits."""
    p = posteriors.astype(np.float64)
    return -np.where(p > 0, p * np.log2(np.where(p > 0, p, 1.0)), 0.0).sum(axis=1)


def _entropies(automaton: Automaton, reach: F64, clicked: F64) -> F64:
    """Mean and tenths of the entropy after 0 ... T exposures: of the states that come next, and of the leaves reached before."""
    n_states, bits = automaton.n_states, entropy_of(automaton.posteriors)
    taken = np.stack([reach[:n_states] - clicked, clicked], axis=1)  # mass of each edge
    at_leaves, out = np.zeros(len(bits)), np.empty((automaton.n_slots + 1, 3))
    for made in range(automaton.n_slots + 1):
        states = np.flatnonzero(automaton.depth == made)
        weights = at_leaves.copy()
        weights[states] = reach[states]
        weights /= weights.sum()
        order = np.argsort(bits)
        tenths = np.searchsorted(np.cumsum(weights[order]), (0.1, 0.9)).clip(max=len(bits) - 1)
        out[made] = [weights @ bits, *bits[order][tenths]]
        edges, mass = automaton.successors[states].reshape(-1), taken[states].reshape(-1)
        np.add.at(at_leaves, edges[edges >= n_states], mass[edges >= n_states])
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """One sampled walk: the states shown, the clicks, the expected photoelectrons of each exposure, and the nodes passed (one more)."""

    states: NDArray[np.int64]
    clicks: NDArray[np.bool_]
    expected: F64
    nodes: NDArray[np.int64]


def sample_walk(bundle: Bundle, transmission: NDArray[np.floating], rng: np.random.Generator) -> Walk:
    """Draw the walk of one object, transmission (pixels,)."""
    automaton, light = automaton_of(bundle), state_light(bundle)
    nodes, clicks, expected = [0], [], []
    while nodes[-1] < automaton.n_states:
        expected.append(float(light[nodes[-1]] @ transmission))
        clicks.append(bool(rng.random() < -np.expm1(-expected[-1])))
        nodes.append(int(automaton.successors[nodes[-1], int(clicks[-1])]))
    return Walk(np.array(nodes[:-1]), np.array(clicks), np.array(expected), np.array(nodes))
