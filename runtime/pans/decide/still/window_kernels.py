"""Windows of shots in compiled code: exposures in, click counts of each window out.

add_exposures and add_walks count one detector's exposures; complete, spill and unpack gather frames of many channels in byte lanes.
windows.py says what a window is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.base.machine import inner
from pans.protocol.wire import DARK_PATTERN

DARK_EXPOSURES, DARK_CLICKS, WRONG_PATTERNS, LATE_SLOTS, N_TALLIES = 0, 1, 2, 3, 4
_U = np.uint64
_LANE = _U(0xFF)
SPREAD = np.array([sum((byte >> bit & 1) << 8 * bit for bit in range(8)) for byte in range(256)], np.uint64)
ONES = np.array([byte.bit_count() for byte in range(256)], np.int64)
BROKEN = -1  # where a walk stands whose exposure was lost or showed the wrong state: nobody knows


class Walks(NamedTuple):
    """The walks of the visit under way, one per window; arrays of length 0 where the patterns are fixed.

    `successors` uint32 (states, outcomes). `to_leaf` int64 (states,) are the fewest exposures from a state to a leaf.
    `nodes` int64 (windows,) is where each walk stands: a state, `states` + a leaf, or BROKEN.
    `need` int64 (windows,) is how many right exposures make it whole, `last` int64 (windows,) the last exposure of the visit that belongs
    to it. `shown` and `clicked` int64 (states,) count the exposures of each state in the whole run, and those with a click.
    """

    successors: npt.NDArray[np.uint32]
    to_leaf: npt.NDArray[np.int64]
    nodes: npt.NDArray[np.int64]
    need: npt.NDArray[np.int64]
    last: npt.NDArray[np.int64]
    shown: npt.NDArray[np.int64]
    clicked: npt.NDArray[np.int64]


class WindowArrays(NamedTuple):
    """The open windows of one visit (windows.DecisionWindows) and the kernel's scratch.

    `offsets` int64 (slots of a cycle,) are the ticks at which exposures begin, as decide/follower.py's rules have them.
    `lanes` uint64 (ceil(d_f / 8),) counts eight channels each, a byte per channel; `whole` int64 (d_f,) is one window's counts.
    `stamps` uint16 and `bits` uint8 (65535,) are the patterns shown and the clicks of the latest CLICKS block.
    """

    feature_at: npt.NDArray[np.int32]
    window_at: npt.NDArray[np.int32]
    last: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]
    seen: npt.NDArray[np.int64]
    tallies: npt.NDArray[np.int64]
    walks: Walks
    longest: npt.NDArray[np.int64]
    lanes: npt.NDArray[np.uint64]
    whole: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]
    stamps: npt.NDArray[np.uint16]
    bits: npt.NDArray[np.uint8]


@inner
def add_exposures(relative, patterns, bits, feature_at, window_at, counts, seen, tallies):  # type: ignore[no-untyped-def]
    """Add exposures `relative`... of a visit to its windows; see tests/oracles/naive_window.py for the meaning in plain loops.

    patterns uint16 (n,), bits uint8 (n,) clicks or photon numbers, feature_at int32 and window_at int32 (visit,), counts int64
    (windows, d_f), seen int64 (windows, 2) right and wrong exposures, tallies int64 (3,).
    """
    for i in range(patterns.shape[0]):
        feature = feature_at[relative + i]
        shown = patterns[i]
        if feature < 0:
            if shown == DARK_PATTERN:
                tallies[DARK_EXPOSURES] += 1
                tallies[DARK_CLICKS] += bits[i] != 0
            else:
                tallies[WRONG_PATTERNS] += 1
            continue
        window = window_at[relative + i]
        if shown == feature:
            counts[window, feature] += bits[i]
            seen[window, 0] += 1
        else:
            tallies[WRONG_PATTERNS] += 1
            seen[window, 1] += 1


@inner
def add_walks(relative, patterns, bits, maps, walks, counts, seen, tallies):  # type: ignore[no-untyped-def]
    """Follow the walks of a visit through exposures `relative`...; tests/oracles/naive_window.py has the meaning in plain loops.

    patterns uint16 (n,) are the states that the device says it showed, bits uint8 (n,) clicks, or photon numbers below `outcomes`; maps is
    int32 (visit,) slots of the walk (-1: dark) and int32 (visit,) windows; walks Walks, counts int64 (windows, slots) the clicks, seen
    int64 (windows, 2) right and wrong exposures, tallies int64 (N_TALLIES,). What stands in a walk behind its leaf must be dark, and so
    counts for the dark counts. Behind a lost or a wrong exposure nothing is known of a walk: there, what says that it was dark counts as
    dark, and all else for nothing.
    """
    slot_at, window_at = maps
    successors, _, nodes, need, last, shown, clicked = walks
    n_states = successors.shape[0]
    for i in range(patterns.shape[0]):
        slot, window, stamp = slot_at[relative + i], window_at[relative + i], patterns[i]
        node = nodes[window] if slot >= 0 else n_states
        if 0 <= node < n_states and seen[window, 0] != slot:
            node = nodes[window] = BROKEN
        if 0 <= node < n_states and stamp == node:
            counts[window, slot] = bits[i]
            seen[window, 0] += 1
            shown[node] += 1
            clicked[node] += bits[i] != 0
            nodes[window] = np.int64(successors[node, bits[i]])
            if nodes[window] >= n_states:
                need[window], last[window] = seen[window, 0], relative + i
        elif 0 <= node < n_states:
            nodes[window] = BROKEN
            seen[window, 1] += 1
            need[window] = seen[window, 0] + seen[window, 1]
            tallies[WRONG_PATTERNS] += 1
            tallies[LATE_SLOTS] += stamp == DARK_PATTERN
        elif stamp == DARK_PATTERN:
            tallies[DARK_EXPOSURES] += 1
            tallies[DARK_CLICKS] += bits[i] != 0
        elif node != BROKEN:
            tallies[WRONG_PATTERNS] += 1


@inner
def begin_visit(windows):  # type: ignore[no-untyped-def]
    """No window has anything yet; element by element: numba takes seconds to compile the assignment of a slice."""
    counts, seen, nodes = windows.counts, windows.seen, windows.walks.nodes
    need, last, longest = windows.walks.need, windows.last, windows.longest
    for window in range(counts.shape[0]):
        for feature in range(counts.shape[1]):
            counts[window, feature] = 0
        seen[window, 0], seen[window, 1] = 0, 0
        need[window], last[window] = longest[0, window], longest[1, window]
    for walk in range(nodes.size):
        nodes[walk] = 0


@inner
def complete(lanes, counts, seen, window, held, whole):  # type: ignore[no-untyped-def]
    """The counts of a window whose last exposure has come, into `whole`."""
    if seen[window, 0] != 0:  # it began in an earlier block
        spill(lanes, counts, seen, window, held)
        for feature in range(whole.size):
            whole[feature] = counts[window, feature]
    else:
        unpack(lanes, whole)
        seen[window, 0] = held * whole.size


@inner
def spill(lanes, counts, seen, window, held):  # type: ignore[no-untyped-def]
    """Add the byte lanes to the counts of their window."""
    n_features = counts.shape[1]
    for p in range(lanes.size):
        lane = lanes[p]
        for feature in range(8 * p, min(8 * p + 8, n_features)):
            counts[window, feature] += np.int64(lane & _LANE)
            lane >>= _U(8)
    seen[window, 0] += held * n_features


@inner
def unpack(lanes, whole):  # type: ignore[no-untyped-def]
    """The byte lanes as counts: all of a window that one block holds."""
    for p in range(lanes.size):
        lane = lanes[p]
        for feature in range(8 * p, min(8 * p + 8, whole.size)):
            whole[feature] = np.int64(lane & _LANE)
            lane >>= _U(8)


@inner
def clicks_of(counts, whole):  # type: ignore[no-untyped-def]
    """The counts of a window as they are decided on: of several channels bit t * channels + k is the click of channel k in slot t."""
    channels = whole.size // counts.size
    if channels == 1:
        return counts
    for slot in range(counts.size):
        for channel in range(channels):
            whole[slot * channels + channel] = counts[slot] >> channel & 1
    return whole


@inner
def sum_up(whole, radix, crc_table, crc):  # type: ignore[no-untyped-def]
    """Clicks, row of the table and checksum of a window's counts."""
    clicks, index = np.int64(0), np.int64(0)
    for feature in range(whole.size):
        count = whole[feature]
        clicks += count
        index += count * radix[feature]
        crc ^= crc_table[0, feature, count & 0xFF]
    for byte in range(1, crc_table.shape[0]):
        for feature in range(whole.size):
            crc ^= crc_table[byte, feature, (whole[feature] >> (8 * byte)) & 0xFF]
    return clicks, index, crc
