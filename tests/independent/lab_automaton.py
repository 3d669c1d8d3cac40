"""Automata in bundles, read as a lab would from docs/reference/formats.md ("Automata") alone.

Patterns out of bits, walks, stopping by a confidence, and the decisions of runs that followed one ("Walks" and "Photon numbers" there).
"""

from __future__ import annotations

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
    """Return the automaton of a bundle, whose golden walks it makes."""
    header, parts = bundle.header, bundle.parts
    facts, levels = header["automaton"], header["levels"]
    stored = parts["pattern_bits" if levels == 2 else "pattern_bytes" if levels <= 256 else "pattern_levels"]
    pixels = header["image_shape"][0] * header["image_shape"][1]
    patterns = np.array([bits_of(row, pixels) for row in stored]) if levels == 2 else stored
    demand(patterns.shape[1] == pixels and int(patterns.max()) < levels, "pixels and levels")
    shares = [int(dwell) / facts["dwell_steps"] for dwell in parts["state_dwell"]]
    shown, successors = [int(pattern) for pattern in parts["state_pattern"]], parts["successors"].tolist()
    channels, slots, counts = facts.get("channels", 1), parts["golden_walks"].shape[1] - 1, "outcomes" in facts
    automaton = Automaton(patterns, shown, shares, successors, parts["posteriors"], channels, slots, counts)
    golden = zip(parts["golden_words"], parts["golden_walks"].tolist(), parts["golden_posteriors"])
    for row, wanted, posterior in golden:
        nodes = automaton.walk([int(number) for number in row] if counts else bits_of(row, slots * channels))
        demand(nodes + nodes[-1:] * (slots + 1 - len(nodes)) == wanted, "a golden walk")
        demand(posterior.tobytes() == automaton.posteriors[nodes[-1]].tobytes(), "a golden posterior")
    return automaton


def bits_of(row: NDArray[np.uint8], count: int) -> list[int]:
    """Return `count` bits of a row of bytes, lowest first; all further bits must be zero."""
    whole = int.from_bytes(row.tobytes(), "little")
    demand(len(row) == -(-count // 8) and whole >> count == 0, "bits")
    return [whole >> place & 1 for place in range(count)]


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
