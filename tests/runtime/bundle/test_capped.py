"""Automata under a dose cap: every walk held against one that adds up its own light."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from automata import diamond, random_automaton

from pans.runtime.bundle.automaton import Automaton, capped

RNG = np.random.default_rng(4)


def walk(
    automaton: Automaton, light: np.ndarray, word: tuple[int, ...], cap: float = np.inf
) -> tuple[float, np.ndarray, int]:
    """The dose of a walk that ends where the next state would pass `cap`, the posterior there, and its exposures."""
    node, dose = 0, 0.0
    for place, click in enumerate(word):
        if node >= automaton.n_states or dose + light[node] > cap:
            return dose, automaton.posteriors[node], place
        dose += light[node]
        node = int(automaton.successors[node, click])
    return dose, automaton.posteriors[node], len(word)


def light_of(automaton: Automaton, patterns: np.ndarray) -> np.ndarray:
    return patterns[automaton.pattern] * automaton.dwell / automaton.dwell_steps


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.15, 0.4, 0.8])
def test_a_capped_walk_ends_where_the_next_light_would_pass_the_cap(seed: int, share: float) -> None:
    whole = random_automaton(seed, slots=7, width=3)
    patterns = RNG.random(7) * 5
    light = light_of(whole, patterns)
    words = list(itertools.product((0, 1), repeat=whole.n_slots))
    most = max(walk(whole, light, word)[0] for word in words)
    cap = max(light[0], share * most)
    found = capped(whole, light, cap)
    of_found, shorter = light_of(found, patterns), 0
    for word in words:
        dose, posterior, exposures = walk(found, of_found, word)
        wanted, own, most_exposures = walk(whole, light, word, cap)
        assert dose <= cap * (1 + 1e-9)
        if exposures == most_exposures:
            np.testing.assert_array_equal(posterior, own)
            assert dose == pytest.approx(wanted)
        else:  # walks that meet with nearly the same dose go by the larger one: they end early, never late
            assert exposures < most_exposures
            shorter += 1
    assert shorter <= 0.02 * len(words)


def test_a_cap_beyond_the_longest_walk_changes_no_walk() -> None:
    whole = diamond()
    light = light_of(whole, np.array([1.0, 2.0, 3.0]))
    found = capped(whole, light, 1e9)
    for word in itertools.product((0, 1), repeat=whole.n_slots):
        one, other = walk(whole, light, word), walk(found, light_of(found, np.array([1.0, 2.0, 3.0])), word)
        assert one[0] == other[0]
        np.testing.assert_array_equal(one[1], other[1])
    assert found.n_states <= whole.n_states


def test_few_states_make_a_cap_cautious_and_never_wrong() -> None:
    whole = random_automaton(3, slots=10, width=6)
    patterns = np.random.default_rng(3).random(7) * 5
    light = light_of(whole, patterns)
    fine, coarse = capped(whole, light, 8.0), capped(whole, light, 8.0, most_states=whole.n_states)
    assert coarse.n_states <= whole.n_states < fine.n_states
    words = list(itertools.product((0, 1), repeat=whole.n_slots))
    assert max(walk(coarse, light_of(coarse, patterns), word)[0] for word in words) <= 8.0 * (1 + 1e-9)
    spent = [sum(walk(one, light_of(one, patterns), word)[0] for word in words) for one in (coarse, fine)]
    assert spent[0] < spent[1]


def test_what_cannot_be_capped_is_refused() -> None:
    whole = diamond()
    with pytest.raises(ValueError, match="the first exposure brings 2, the dose may not pass 1"):
        capped(whole, np.full(5, 2.0), 1.0)
    with pytest.raises(ValueError, match="one number of 0 or more each"):
        capped(whole, np.full(4, 2.0), 10.0)
    with pytest.raises(ValueError, match="one number of 0 or more each"):
        capped(whole, np.array([1.0, np.nan, 1, 1, 1]), 10.0)
