"""Automata in bundles of versions 3 and 4, read as a lab would from docs/reference/formats.md ("Automata, versions 3 and 4") alone.

Owns the meaning of the parts: patterns out of bits, walks, the golden ones recomputed, stopping by a confidence. Plain Python where the
package has arrays and kernels. Imports nothing of the package.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lab_bundle import Bundle, demand
from numpy.typing import NDArray

ABSTAINS = 0xFFFF


@dataclass
class Automaton:
    """What the parts of one bundle mean."""

    patterns: NDArray[Any]  # (patterns, pixels)
    shows: list[int]
    dwell_share: list[float]
    successors: list[list[int]]
    posteriors: NDArray[np.float32]
    channels: int
    slots: int
    counts: bool = False  # version 4: a number of a click word is the outcome of a slot

    def walk(self, word: Sequence[int], confidence: float = 0.0) -> list[int]:
        """Return the nodes of a click word's walk, from state 0 to the node that decides."""
        nodes = [0]
        while nodes[-1] < len(self.successors):
            if confidence and len(nodes) > 1 and self.posteriors[nodes[-1]].max() >= np.float32(confidence):
                break
            first = (len(nodes) - 1) * self.channels
            outcome = word[first] if self.counts else sum(word[first + k] * 2**k for k in range(self.channels))
            nodes.append(self.successors[nodes[-1]][outcome])
        return nodes

    def decide(self, word: Sequence[int], confidence: float = 0.0) -> tuple[int, float]:
        """Return label and probability; label 0xFFFF below the confidence."""
        posterior = self.posteriors[self.walk(word, confidence)[-1]].tolist()
        most = max(posterior)
        return (posterior.index(most) if most >= np.float32(confidence) else ABSTAINS), most


def read_automaton(bundle: Bundle) -> Automaton:
    """Return the automaton of a bundle of version 3 or 4, every rule of the document checked."""
    header, parts = bundle.header, bundle.parts
    pixels = header["image_shape"][0] * header["image_shape"][1]
    steps = header["automaton"]["dwell_steps"]
    counts = "outcomes" in header["automaton"]
    keys = {"dwell_steps", "outcomes"} if counts else {"dwell_steps"}
    demand(header["encoder"] == "automaton" and set(header["automaton"]) == keys, "the keys of an automaton")
    demand(type(steps) is int and 1 <= steps <= 65_535, "dwell_steps")
    patterns = _patterns(header["levels"], parts, pixels)
    successors, posteriors = parts["successors"], parts["posteriors"]
    states, nodes = len(successors), len(posteriors)
    outcomes = successors.shape[1]
    channels = 1 if counts else outcomes.bit_length() - 1
    if counts:
        said = header["automaton"]["outcomes"]
        demand(type(said) is int and 3 <= said <= 16 and said == outcomes, "outcomes")
    else:
        demand(1 <= channels <= 8 and outcomes == 2**channels, "outcomes")
    demand(1 <= states <= 65_533 and 1 <= nodes - states <= 1 << 20, "states and leaves")
    demand(parts["state_pattern"].shape == parts["state_dwell"].shape == (states,), "one pattern and dwell per state")
    demand(int(parts["state_pattern"].max()) < len(patterns), "a pattern that is not there")
    demand(int(parts["state_dwell"].min()) >= 1 and int(parts["state_dwell"].max()) <= steps, "dwell")
    demand(posteriors.shape[1] == len(header["classes"]), "classes")
    for row in posteriors.tolist():
        demand(all(0 <= p <= 1 for p in row) and abs(math.fsum(row) - 1) <= 1e-5, "a posterior")
    slots = _slots(successors.tolist(), nodes)
    demand(slots <= 1024 and slots * channels <= 4096, "length of a walk")
    shares = [int(dwell) / steps for dwell in parts["state_dwell"]]
    shown = [int(pattern) for pattern in parts["state_pattern"]]
    automaton = Automaton(patterns, shown, shares, successors.tolist(), posteriors, channels, slots, counts)
    _check_golden(automaton, parts)
    _check_expected(header, automaton)
    return automaton


def _patterns(levels: int, parts: dict[str, NDArray[Any]], pixels: int) -> NDArray[Any]:
    name = "pattern_bits" if levels == 2 else "pattern_bytes" if levels <= 256 else "pattern_levels"
    others = {"state_pattern", "state_dwell", "successors", "posteriors"}
    demand(set(parts) == {name, *others, "golden_words", "golden_walks", "golden_posteriors"}, "the parts")
    stored = parts[name]
    demand(1 <= len(stored) <= 65_535 and len(stored) * pixels <= 40_000_000, "patterns")
    patterns = np.array([bits_of(row, pixels) for row in stored]) if levels == 2 else stored
    demand(patterns.shape[1] == pixels and int(patterns.max()) < levels, "pixels and levels")
    return patterns


def bits_of(row: NDArray[np.uint8], count: int) -> list[int]:
    """Return `count` bits of a row of bytes, lowest first; all further bits must be zero."""
    whole = int.from_bytes(row.tobytes(), "little")
    demand(len(row) == -(-count // 8) and whole >> count == 0, "bits")
    return [whole >> place & 1 for place in range(count)]


def _slots(successors: list[list[int]], nodes: int) -> int:
    """Demand that nodes rise, that every node is reached, and every state in one slot; return the longest walk."""
    slot_of: dict[int, int] = {0: 0}
    for state, after in enumerate(successors):  # successors are higher: a state's own slot is settled when it comes
        demand(state in slot_of, f"state {state} is never reached")
        for node in after:
            demand(state < node < nodes, "a successor")
            if node < len(successors):
                slot = slot_of.setdefault(node, slot_of[state] + 1)
                demand(slot == slot_of[state] + 1, f"state {node} in two slots")
    demand({node for after in successors for node in after} >= set(range(len(successors), nodes)), "a leaf")
    return max(slot_of.values()) + 1


def _check_golden(automaton: Automaton, parts: dict[str, NDArray[Any]]) -> None:
    words, walks, posteriors = parts["golden_words"], parts["golden_walks"], parts["golden_posteriors"]
    demand(1 <= len(words) <= 4096 and len(words) == len(walks) == len(posteriors), "golden walks")
    demand(
        len(words) * automaton.slots * automaton.channels <= 1 << 20 and posteriors.size <= 1 << 22, "golden numbers"
    )
    demand(walks.shape[1] == automaton.slots + 1, "length of a golden walk")
    for row, wanted, posterior in zip(words, walks.tolist(), posteriors):
        nodes = automaton.walk(_golden_word(automaton, row))
        nodes += nodes[-1:] * (automaton.slots + 1 - len(nodes))
        demand(nodes == wanted, "a golden walk")
        demand(posterior.tobytes() == automaton.posteriors[nodes[-1]].tobytes(), "a golden posterior")


def _golden_word(automaton: Automaton, row: NDArray[np.uint8]) -> list[int]:
    if not automaton.counts:
        return bits_of(row, automaton.slots * automaton.channels)
    most = len(automaton.successors[0]) - 1
    demand(len(row) == automaton.slots and int(row.max()) <= most, "a golden word")
    return [int(number) for number in row]


def _check_expected(header: dict[str, Any], automaton: Automaton) -> None:
    if "expected" not in header:
        return
    expected = header["expected"]
    texts = ("profile", "task", "split")
    figures = ("objects", "accuracy", "clicks", "photons", "illumination", "exposures")
    demand(set(expected) == {*texts, *figures}, "expected figures")
    demand(all(isinstance(expected[name], str) for name in texts), "expected texts")
    demand(0 <= expected["accuracy"] <= 1 and 1 <= expected["exposures"] <= automaton.slots * (1 + 1e-9), "expected")
