"""Automata in bundles, read as a lab would from docs/reference/formats.md ("Automata") alone.

Owns the meaning of the parts: patterns out of bits, walks, the golden ones recomputed, stopping by a confidence. It owns the decisions of
runs that followed one, too ("Walks" and "Photon numbers" there); all else of a run is lab_decisions.py's. Plain Python where the package
has arrays and kernels. Imports nothing of the package.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lab_bundle import Bundle, demand
from lab_decisions import DARK, Decisions, Plan, Window, run_again
from lab_recording import Recording
from numpy.typing import NDArray

ABSTAINS = 0xFFFF
ADAPTIVE = 0xFFFE  # the pattern of a slot that a walk fills


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
    counts: bool = False  # a number of a click word is the outcome of a slot

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
    """Return the automaton of a bundle, every rule of the document checked."""
    header, parts = bundle.header, bundle.parts
    pixels = header["image_shape"][0] * header["image_shape"][1]
    steps = header["automaton"]["dwell_steps"]
    counts = "outcomes" in header["automaton"]
    more = set(header["automaton"]) & {"outcomes", "channels"}
    keys = {"dwell_steps"} | more
    demand(len(more) < 2, "outcomes beside channels")
    demand(header["encoder"] == "automaton" and set(header["automaton"]) == keys, "the keys of an automaton")
    demand(type(steps) is int and 1 <= steps <= 65_535, "dwell_steps")
    patterns = _patterns(header["levels"], parts, pixels)
    successors, posteriors = parts["successors"], parts["posteriors"]
    states, nodes = len(successors), len(posteriors)
    outcomes = successors.shape[1]
    channels = header["automaton"].get("channels", 1)
    if counts:
        said = header["automaton"]["outcomes"]
        demand(type(said) is int and 3 <= said <= 16 and said == outcomes, "outcomes")
    else:
        demand(type(channels) is int and 1 + len(more) <= channels <= 4 and outcomes == 2**channels, "outcomes")
    demand(1 <= states <= 65_533 and 1 <= nodes - states <= 1 << 20, "states and leaves")
    demand(parts["state_pattern"].shape == parts["state_dwell"].shape == (states,), "one pattern and dwell per state")
    demand(int(parts["state_pattern"].max()) + channels <= len(patterns), "a pattern that is not there")
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


# ---- runs that followed an automaton ----


@dataclass
class Walk(Window):
    """One cycle: where its walk stands, and the exposure that brought it to a leaf."""

    node: int = 0
    broken: bool = False
    leaf_at: int = -1


class WalkDecisions(Decisions):
    """Follows the walks of one still run."""

    def __init__(self, plan: Plan, automaton: Automaton) -> None:
        self.automaton = automaton
        demand(max(1, plan.channels) == automaton.channels, "as many detectors as the automaton has channels")
        super().__init__(plan, lambda counts, shots: np.zeros(0), 1)

    def _open_visit(self) -> None:
        plan = self.plan
        steps = [slot for slot, (_, pattern, _) in enumerate(plan.slots) if pattern == ADAPTIVE]
        demand(len(steps) == self.automaton.slots, "as many adaptive slots as the longest walk has steps")
        self.windows = []
        self.window_of = {}
        for cycle in range(plan.cycles_per_object):
            members = [cycle * len(plan.slots) + slot for slot in steps]
            self.windows.append(Walk(members, np.zeros(len(steps) * self.automaton.channels, np.int64)))
            self.window_of |= dict.fromkeys(members, self.windows[-1])
        self.next_window, self.object = 0, 0xFFFFFFFF

    def _stamps_fit(self, stamps: Sequence[int]) -> bool:
        return all(one == DARK or one < len(self.automaton.successors) for one in stamps)

    def _count_one(self, exposure: int, shown: int, bit: int) -> None:
        within = exposure % self.plan.visit
        walk = self.window_of.get(within)
        if not isinstance(walk, Walk) or walk.broken or walk.leaf_at >= 0:
            return
        step = walk.members.index(within)
        if step != walk.right:  # one before it never came
            walk.broken = True
        elif shown != walk.node:
            walk.broken, walk.wrong = True, 1
        else:
            channels = self.automaton.channels
            clicks = [bit >> channel & 1 for channel in range(channels)] if channels > 1 else [bit]
            walk.counts[step * channels : (step + 1) * channels] = clicks
            walk.right += 1
            walk.node = self.automaton.successors[walk.node][bit]
            if walk.node >= len(self.automaton.successors):
                walk.leaf_at = within

    def _last(self, window: Window) -> int:
        assert isinstance(window, Walk)
        return window.leaf_at if window.leaf_at >= 0 else window.members[-1]

    def _needed(self, window: Window) -> int:
        assert isinstance(window, Walk)
        whole = window.leaf_at >= 0 or window.wrong
        return window.right + window.wrong if whole else len(window.members)

    def _verdict(self, window: Window) -> tuple[int, np.float32, int]:
        assert isinstance(window, Walk)
        posterior = self.automaton.posteriors[window.node]
        return int(posterior.argmax()), posterior.max(), 0

    def _exposures(self, window: Window) -> int:
        return window.right


def walk_again(recording: Recording, automaton: Automaton) -> NDArray[np.void]:
    """Return the rows that the messages of `recording` give, ROW (n,); it followed the whole `automaton`."""
    config = recording.header["config"]
    demand(config["drive"] in ("device", "host") and config["shots"] == 1 and not config["confidence"], "a whole walk")
    return run_again(recording, lambda plan: WalkDecisions(plan, automaton))
