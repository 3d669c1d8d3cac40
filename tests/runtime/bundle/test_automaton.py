"""Automata: what is impossible is refused, walks are those of the definition, stopped and capped ones too."""

import itertools
from typing import Any

import numpy as np
import pytest
from automata import EXPECTED, automaton_bundle, diamond, early_leaf, random_automaton

from pans.base.errors import UsageError
from pans.bundle.automaton import (
    SLOTS_MAX,
    Automaton,
    capped,
    golden_nodes,
    greatest_light,
    reachable_automaton,
    stopped,
    walk_nodes,
    words_to,
)
from pans.bundle.sensor import with_expected

HALF = [0.5, 0.5]


def arrays(**changes: Any) -> dict[str, Any]:
    facts: dict[str, Any] = {"pattern": [0, 1], "dwell": [1, 2], "dwell_steps": 2, "successors": [[1, 2], [3, 2]]}
    return facts | {"posteriors": [HALF] * 4} | changes


IMPOSSIBLE = [
    ({"pattern": [0]}, "pattern has shape"),
    ({"pattern": [0, 65536]}, "pattern runs from 0 to 65536"),
    ({"pattern": [0.0, 1.0]}, "allowed: integers"),
    ({"dwell": [0, 1]}, "dwell runs from 0"),
    ({"dwell": [1, 3]}, "to 3, allowed: 1 to dwell_steps = 2"),
    ({"dwell_steps": 0}, "dwell_steps is 0"),
    ({"dwell_steps": True}, "dwell_steps is True"),
    ({"successors": [[1, 2], [1, 3]]}, "state 1 has the successors"),
    ({"successors": [[0, 2], [3, 2]]}, "state 0 has the successors"),
    ({"successors": [[1, 2], [3, 4]]}, "a successor is 4"),
    ({"successors": [[1, 2, 2], [3, 2, 2]]}, "3 outcomes"),
    ({"successors": [[1], [2]]}, "1 outcomes"),
    ({"successors": [[2, 2], [3, 2]]}, "no walk reaches state 1"),
    ({"successors": [[1, 2], [2, 2]]}, "no walk reaches leaf 1"),
    ({"posteriors": [HALF, HALF]}, "0 leaves"),
    ({"posteriors": [[1.0]] * 4}, "posteriors of 1 classes"),
    ({"posteriors": [HALF, HALF, HALF, [0.5, 0.50003]]}, "the posterior of node 3"),
    ({"posteriors": [HALF, [np.nan, 1.0], HALF, HALF]}, "posteriors run from nan"),
    ({"posteriors": [HALF, [-0.5, 1.5], HALF, HALF]}, "posteriors run from -0.5 to 1.5"),
    ({"posteriors": [HALF, [1e300, 0.0], HALF, HALF]}, "to inf"),
]


@pytest.mark.parametrize(("change", "words"), IMPOSSIBLE, ids=lambda one: one if isinstance(one, str) else "")
def test_the_impossible_is_named(change: dict[str, Any], words: str) -> None:
    Automaton(**arrays())
    with pytest.raises(ValueError, match=words):
        Automaton(**arrays(**change))


def chain(n: int) -> Automaton:
    successors = np.stack([np.arange(1, n + 1)] * 2, axis=1)
    return Automaton(np.zeros(n, int), np.ones(n, int), 1, successors, [HALF] * (n + 1))


def test_a_walk_has_an_end_and_a_state_stands_in_one_slot() -> None:
    assert chain(SLOTS_MAX).n_slots == SLOTS_MAX
    with pytest.raises(ValueError, match="more than 1024 exposures"):
        chain(SLOTS_MAX + 1)
    with pytest.raises(ValueError, match="state 2 is reached after 1 and after 2 exposures"):
        Automaton([0, 0, 0], [1, 1, 1], 1, [[1, 2], [2, 3], [3, 3]], [HALF] * 4)


def test_arrays_are_the_automatons_own() -> None:
    given = np.array([0, 1], np.uint16)
    automaton = Automaton(**arrays(pattern=given))
    given[0] = 7
    assert automaton.pattern.tolist() == [0, 1]
    for array in (automaton.pattern, automaton.dwell, automaton.successors, automaton.posteriors, automaton.depth):
        assert not array.flags.writeable


def walk_by_hand(automaton: Automaton, word: np.ndarray) -> list[int]:
    node, passed = 0, [0]
    for slot in range(automaton.n_slots):
        if node < automaton.n_states:
            bits = word[slot * automaton.channels : (slot + 1) * automaton.channels]
            node = int(automaton.successors[node, sum(int(bit) << k for k, bit in enumerate(bits))])
        passed.append(node)
    return passed


@pytest.mark.parametrize("automaton", [early_leaf(), diamond(), random_automaton(1), random_automaton(2, channels=2)])
def test_walks_are_those_of_the_definition(automaton: Automaton) -> None:
    words = np.random.default_rng(3).integers(0, 2, (200, automaton.n_bits))
    walks = walk_nodes(automaton, words)
    assert walks.tolist() == [walk_by_hand(automaton, word) for word in words]
    states = walks < automaton.n_states
    slots = np.broadcast_to(np.arange(walks.shape[1]), walks.shape)
    assert (automaton.depth[walks[states]] == slots[states]).all()


@pytest.mark.parametrize("seed", range(5))
def test_a_word_leads_to_every_node(seed: int) -> None:
    automaton = random_automaton(seed, slots=9, channels=1 + seed % 2)
    nodes = np.arange(len(automaton.posteriors))
    walks = walk_nodes(automaton, words_to(automaton, nodes))
    assert all(node in walk for node, walk in zip(nodes, walks))
    assert len(automaton.posteriors) - 1 in golden_nodes(automaton)


@pytest.mark.parametrize("seed", range(8))
def test_stopping_ends_walks_where_a_state_is_sure(seed: int) -> None:
    automaton = random_automaton(seed, slots=7)
    sooner = stopped(automaton, 0.8)
    words = np.random.default_rng(seed).integers(0, 2, (300, automaton.n_slots))
    walks = walk_nodes(automaton, words)
    for word, walk in zip(words, walks):
        ends = next((node for node in walk[1:] if automaton.posteriors[node].max() >= np.float32(0.8)), int(walk[-1]))
        leaf = walk_nodes(sooner, word[None, : sooner.n_slots])[0, -1]
        assert leaf >= sooner.n_states
        assert sooner.posteriors[leaf].tolist() == automaton.posteriors[ends].tolist()


def test_stopping_refuses_what_is_no_confidence() -> None:
    for confidence in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(ValueError, match="confidence is"):
            stopped(diamond(), confidence)
    assert stopped(diamond(), 1.0).n_states == diamond().n_states


def test_what_no_walk_reaches_is_left_out() -> None:
    whole = reachable_automaton([0, 1, 2], [1, 1, 1], 1, [[2, 3], [3, 4], [4, 5]], [HALF] * 6)
    assert (whole.n_states, whole.n_leaves, whole.pattern.tolist()) == (2, 3, [0, 2])
    assert whole.successors.tolist() == [[1, 2], [3, 4]]


def test_the_greatest_light_is_that_of_a_walk() -> None:
    automaton = random_automaton(4, slots=8)
    light = np.random.default_rng(1).random(automaton.n_states)
    words = (np.arange(1 << automaton.n_slots)[:, None] >> np.arange(automaton.n_slots)) & 1
    walks = walk_nodes(automaton, words)[:, :-1].astype(np.int64)
    of_walk = np.where(walks < automaton.n_states, np.append(light, 0.0)[np.minimum(walks, automaton.n_states)], 0.0)
    assert greatest_light(automaton, light) == pytest.approx(of_walk.sum(axis=1).max(), rel=1e-12)


def test_a_bundle_counts_slots_and_patterns_apart() -> None:
    bundle = automaton_bundle(diamond())
    assert (bundle.n_features, bundle.n_patterns, bundle.n_shown, bundle.encoder) == (3, 3, 3, "automaton")
    two_channels = automaton_bundle(random_automaton(2, slots=4, channels=2))
    assert two_channels.n_features == 8
    whole = bundle.pattern_levels.sum(axis=1) * 0.2
    of_states = [whole[p] * d / 2 for p, d in zip(diamond().pattern, diamond().dwell)]
    assert bundle.state_light() == pytest.approx(of_states)


def test_a_bundle_that_does_not_fit_is_refused() -> None:
    for facts, words in (
        ({"pattern_levels": np.ones((2, 4), int)}, "a state shows pattern 2"),
        ({"classes": ("a", "b")}, "posteriors of 3 classes, the bundle has 2"),
        ({"table": np.zeros((8, 3))}, "an automaton beside a head"),
    ):
        with pytest.raises(UsageError, match=words):
            automaton_bundle(diamond(), **facts)


def test_expected_figures_are_kept_and_checked() -> None:
    bundle = with_expected(automaton_bundle(), EXPECTED)
    assert bundle.expected == EXPECTED
    assert bundle.expected_on(str(EXPECTED["profile"]), bundle.automaton) == EXPECTED
    assert bundle.expected_on("another", bundle.automaton) is None
    assert bundle.expected_on(str(EXPECTED["profile"]), diamond()) is None  # not the one that is judged
    more = with_expected(
        automaton_bundle(), EXPECTED | {"first_state_clicked": 0.25}
    )  # bundles made before do not state it
    assert more.expected == EXPECTED | {"first_state_clicked": 0.25}
    with pytest.raises(UsageError, match="first_state_clicked"):
        with_expected(automaton_bundle(), EXPECTED | {"first_state_clicked": 1.5})
    for change in ({"accuracy": 1.5}, {"clicks": 2.6}, {"exposures": 3.5}, {"objects": 0}, {"split": ""}, {"more": 1}):
        with pytest.raises(UsageError, match=rf"expected.*{next(iter(change))}|expected has the keys"):
            with_expected(automaton_bundle(), EXPECTED | change)


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
