"""Slow oracles for automata, from the definition: one walk, and sums over all click words in exact or mpmath numbers."""

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

from pans.bundle.automaton import Automaton


class Walk(NamedTuple):
    """The states that were shown, and the leaf."""

    states: list[int]
    leaf: int


def walk(automaton: Automaton, word: Sequence[int], counts: bool = False) -> Walk:
    """Walk a click word; bit t * channels + k is channel k in slot t. With `counts` number t is the photons of slot t."""
    states: list[int] = []
    node = 0
    while node < automaton.n_states:
        bits = word[len(states) * automaton.channels : (len(states) + 1) * automaton.channels]
        states.append(node)
        outcome = bits[0] if counts else sum(2**k for k, bit in enumerate(bits) if bit)
        node = int(automaton.successors[node][outcome])
    return Walk(states, node - automaton.n_states)


def word_chances(click: Sequence[Any], one: Any) -> list[Any]:
    """The chance of each outcome of an exposure of several channels, of which `click` are the chances to click: bit k is channel k."""
    found = []
    for word in range(2 ** len(click)):
        chance = one
        for channel, each in enumerate(click):
            chance *= each if word >> channel & 1 else one - each
        found.append(chance)
    return found


def expectation(automaton: Automaton, click: Sequence[Any], one: Any, afterpulse: Any = 0) -> dict[str, Any]:
    """Sums over all 2**T words of one object: `click[s]` is the chance of a click in state s, `one` the number 1 of their type.

    Behind a click, an exposure that would not have clicked does so with the chance `afterpulse`; before the walk there was none.
    Returns clicks, exposures, the chance that each state is shown and the chance of each leaf.
    """
    zero = one * 0
    found: dict[str, Any] = {"clicks": zero, "exposures": zero}
    found["shown"], found["leaves"] = [zero] * automaton.n_states, [zero] * automaton.n_leaves
    words: dict[tuple[int, ...], Walk] = {}
    for word in product((0, 1), repeat=automaton.n_slots):
        passed = walk(automaton, word)
        words[word[: len(passed.states)]] = passed  # words that differ after the leaf are one walk
    for word, passed in words.items():
        chance = one
        for state, bit, before in zip(passed.states, word, (0, *word)):
            miss = (one - click[state]) * (one - before * afterpulse)
            chance *= one - miss if bit else miss
        found["clicks"] += chance * sum(word)
        found["exposures"] += chance * len(passed.states)
        found["leaves"][passed.leaf] += chance
        for state in passed.states:
            found["shown"][state] += chance
    return found
