"""What a decision must be made of, in plain loops from the definition: the exposures of a window, and those of a walk.

Owns the definitions alone; they share no code with the host's windows and walks, and none with the instrument's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.core.plan import Plan
from pans.runtime.wire.messages import (
    DARK_PATTERN,
    ClickBlock,
    Frame,
    FrameBlock,
    Mark,
    MessageType,
    decode_clicks,
    decode_counts,
    decode_frames,
    decode_mark,
)


class WalkTruth(NamedTuple):
    """The exposures that a walk took (places in what was given), its clicks per slot int64 (slots,), and whether it came to a leaf."""

    taken: int
    clicks: NDArray[np.int64]
    ended: bool


def decoded(frame: Frame) -> ClickBlock | FrameBlock | Mark:
    """Return the stream message of a frame."""
    if frame.type == MessageType.CLICKS:
        return decode_clicks(frame.payload)
    if frame.type == MessageType.COUNTS:
        return decode_counts(frame.payload)
    return decode_frames(frame.payload) if frame.type == MessageType.FRAMES else decode_mark(frame.payload)


def walk_truth(automaton: Automaton, stamps: list[int], clicks: list[int]) -> WalkTruth:
    """Follow the walk through the adaptive slots of one cycle: each with its stamp, and its click, photon number or word of detectors.

    A walk has not ended where a stamp is not its state: it is then taken to be as long as the cycle. The clicks of several detectors
    stand one by one, those of a slot together.
    """
    detectors = automaton.channels
    counted = np.zeros((len(stamps), detectors), np.int64)
    node = 0
    for slot, (stamp, click) in enumerate(zip(stamps, clicks)):
        if stamp != node:
            break
        counted[slot] = click if detectors == 1 else [click >> detector & 1 for detector in range(detectors)]
        node = int(automaton.successors[node, click])
        if node >= automaton.n_states:
            return WalkTruth(slot + 1, counted.ravel(), True)
    return WalkTruth(len(stamps), counted.ravel(), False)


def window_members(plan: Plan, shots: int) -> tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]:
    """Return for each window of a visit its exposures, ascending, and the pattern of each; in plain loops, from the plan alone."""
    n_windows = plan.shots_per_cycle * plan.cycles_per_object // shots
    members: list[list[int]] = [[] for _ in range(n_windows)]
    features: list[list[int]] = [[] for _ in range(n_windows)]
    for cycle in range(plan.cycles_per_object):
        for slot in range(plan.slots_per_cycle):
            if plan.slot_pattern[slot] == DARK_PATTERN:
                continue
            window = (cycle * plan.shots_per_cycle + int(plan.slot_shot[slot])) // shots
            members[window].append(cycle * plan.slots_per_cycle + slot)
            features[window].append(int(plan.slot_pattern[slot]))  # of an automaton, nobody's
    return [np.array(one, np.int64) for one in members], [np.array(one, np.int64) for one in features]
