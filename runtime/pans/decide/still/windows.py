"""Exposures -> windows: the K-shot click counts of each object, complete or reported incomplete, in a fixed order.

`DecisionWindows.push` returns the windows that a block completes or
that can no longer become complete; each exposure is counted once, and dark slots are tallied apart.

A *visit* is the time one object stands before the detector (`cycles_per_object` cycles); its shots are grouped by K into windows. With an
automaton a window is one walk, and a cycle holds one: its clicks so far say which state each exposure must have shown.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.base.errors import PlanError
from pans.base.machine import inner, outer
from pans.decide.plan.plan import Plan
from pans.protocol.wire import ADAPTIVE_PATTERN, DARK_PATTERN, NO_OBJECT, ClickBlock, FrameBlock, read_only

DARK_EXPOSURES, DARK_CLICKS, WRONG_PATTERNS, LATE_SLOTS, N_TALLIES = 0, 1, 2, 3, 4
_U = np.uint64
_LANE = _U(0xFF)
SPREAD = np.array([sum((byte >> bit & 1) << 8 * bit for bit in range(8)) for byte in range(256)], np.uint64)
ONES = np.array([byte.bit_count() for byte in range(256)], np.int64)
BROKEN = -1  # where a walk stands whose exposure was lost or showed the wrong state: nobody knows


class Walks(NamedTuple):
    """The walks of the visit under way, one per window; arrays of length 0 where the patterns are fixed.

    `successors` uint32 (states, outcomes). `nodes` int64 (windows,) is where each walk stands: a state, `states` + a leaf, or BROKEN.
    `need` int64 (windows,) is how many right exposures make it whole, `last` int64 (windows,) the last exposure of the visit that belongs
    to it. `shown` and `clicked` int64 (states,) count the exposures of each state in the whole run, and those with a click.
    """

    successors: npt.NDArray[np.uint32]
    nodes: npt.NDArray[np.int64]
    need: npt.NDArray[np.int64]
    last: npt.NDArray[np.int64]
    shown: npt.NDArray[np.int64]
    clicked: npt.NDArray[np.int64]


class WindowArrays(NamedTuple):
    """The open windows of one visit (arrays of window.DecisionWindows) and the kernel's scratch.

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


@outer
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


@outer
def add_frames(relative, words, window_at, counts, seen, tallies):  # type: ignore[no-untyped-def]
    """Add frames of all channels `relative`... of a visit: words uint8 (n, bytes), bit c of a word is channel c.

    window_at int32 (visit,), -1 for a dark frame; counts int64 (windows, d_f), seen int64 (windows, 2), tallies int64 (3,).
    """
    n_features = counts.shape[1]
    for i in range(words.shape[0]):
        window = window_at[relative + i]
        for feature in range(n_features):
            bit = (words[i, feature >> 3] >> (feature & 7)) & 1
            if window < 0:
                tallies[DARK_EXPOSURES] += 1
                tallies[DARK_CLICKS] += bit
            else:
                counts[window, feature] += bit
        if window >= 0:
            seen[window, 0] += n_features


@outer
def add_walks(relative, patterns, bits, maps, walks, counts, seen, tallies):  # type: ignore[no-untyped-def]
    """Follow the walks of a visit through exposures `relative`...; tests/oracles/naive_window.py has the meaning in plain loops.

    patterns uint16 (n,) are the states that the device says it showed, bits uint8 (n,) clicks, or photon numbers below `outcomes`; maps is
    int32 (visit,) slots of the walk (-1: dark) and int32 (visit,) windows; walks Walks, counts int64 (windows, slots) the clicks, seen
    int64 (windows, 2) right and wrong exposures, tallies int64 (N_TALLIES,). What stands in a walk behind its leaf must be dark, and so
    counts for the dark counts. Behind a lost or a wrong exposure nothing is known of a walk: there, what says that it was dark counts as
    dark, and all else for nothing.
    """
    slot_at, window_at = maps
    successors, nodes, need, last, shown, clicked = walks
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


MAX_VISIT_EXPOSURES = 1 << 24
WINDOWS_SEEN = 64

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]


class Window(NamedTuple):
    """One object's K shots: `counts` int64 (d_f,) clicks per pattern, a view that is valid until the next `push`.

    `first_shot` counts within the visit. `missing` exposures never came, `wrong` ones showed another pattern than planned: with
    either above 0 no decision may be made from it. Of a walk: `counts` are the clicks per slot and channel, `exposures` how many it
    took (0 where the patterns are fixed), and of the exposures that may be `missing` nobody knows how many the walk would have had.
    """

    object_index: int
    first_shot: int
    last_exposure: int
    counts: I64
    missing: int
    wrong: int
    exposures: int = 0


class DecisionWindows:
    """Follows the visits of a run; all memory is allocated here, before arming."""

    def __init__(self, plan: Plan, n_features: int, shots: int) -> None:
        shots_per_object = plan.shots_per_cycle * plan.cycles_per_object
        if shots < 1 or shots_per_object % shots:
            raise PlanError(
                f"{shots_per_object} shots per object cannot be cut into windows of {shots}",
                remedy="choose a multiple: --trials N gives N windows of --shots K each",
            )
        self.shots = shots
        self.n_windows = shots_per_object // shots
        self.parallel = plan.mode == "parallel"
        self.largest = plan.largest
        self.visit_exposures = plan.slots_per_cycle * plan.cycles_per_object
        if self.visit_exposures > MAX_VISIT_EXPOSURES:
            raise PlanError(f"an object takes {self.visit_exposures} exposures, allowed {MAX_VISIT_EXPOSURES}")
        self.tallies: I64 = np.zeros(N_TALLIES, np.int64)
        self._channels = plan.channels_at_once  # of several, a slot's clicks are one number until its window is settled
        n_features //= self._channels
        self._counts: I64 = np.zeros((self.n_windows, n_features), np.int64)
        self._out: I64 = np.zeros((self.n_windows, n_features * self._channels), np.int64)
        self._seen: I64 = np.zeros((self.n_windows, 2), np.int64)
        self._feature_at, self._window_at = visit_maps(plan, shots)
        self._last = _last_exposures(self._window_at, self.n_windows, self.visit_exposures)
        self.walks = _make_walks(plan, n_features, shots, self._last)
        self._need, self._last = self.walks.need, self.walks.last
        self._adaptive = bool(len(self.walks.nodes))
        self._longest: I64 = np.stack([self._need, self._last])  # at the beginning of a visit
        self.lit: npt.NDArray[np.bool_] = self._window_at >= 0  # by exposure of a visit
        self._visit = 0
        self._next_window = 0
        self._object = NO_OBJECT

    def fits(self, block: ClickBlock | FrameBlock) -> bool:
        """Whether `block` is of the plan's kind, lies within one visit and has a bit for every channel: what `push` relies on.

        No number of it is above the largest, so that each is a successor of the automaton.
        """
        if isinstance(block, FrameBlock):
            n_exposures, word_bytes = block.words.shape
            if not self.parallel or 8 * word_bytes < self._counts.shape[1]:
                return False
        else:
            n_exposures = len(block.patterns)
            if self.parallel or block.largest != self.largest:
                return False
        return block.exposure_index % self.visit_exposures + n_exposures <= self.visit_exposures

    def push(self, block: ClickBlock | FrameBlock) -> list[Window]:
        """Count a block and return the windows that are settled by it, oldest first."""
        visit, relative = divmod(block.exposure_index, self.visit_exposures)
        settled = self._advance_to(visit)
        self._object = block.object_index
        if isinstance(block, FrameBlock):
            n_exposures = len(block.words)
            add_frames(relative, block.words, self._window_at, self._counts, self._seen, self.tallies)
        else:
            n_exposures = len(block.patterns)
            self._add_clicks(relative, block.patterns, block.bits)
        settled += self._settle(relative + n_exposures)
        return settled

    def _add_clicks(self, relative: int, patterns: npt.NDArray[np.uint16], bits: npt.NDArray[np.uint8]) -> None:
        maps = (self._feature_at, self._window_at)
        if self._adaptive:
            add_walks(relative, patterns, bits, maps, self.walks, self._counts, self._seen, self.tallies)
        else:
            add_exposures(relative, patterns, bits, *maps, self._counts, self._seen, self.tallies)

    def skip_to(self, exposure_index: int) -> list[Window]:
        """Report every window before `exposure_index` that will never be complete (a gap, or the end of the stream)."""
        visit, relative = divmod(exposure_index, self.visit_exposures)
        return self._advance_to(visit) + self._settle(relative)

    @property
    def position(self) -> tuple[int, int, int]:
        """The visit under way, its next window to be settled, and the object before the detector; the kernel continues from here."""
        return self._visit, self._next_window, self._object

    @position.setter
    def position(self, value: tuple[int, int, int]) -> None:
        self.advance(value)
        # at a leaf: what is left of the cycle is dark
        self.walks.nodes[: self._next_window] = len(self.walks.successors)

    def advance(self, position: tuple[int, int, int]) -> None:
        """Take over a `position` to which a kernel has brought the same arrays."""
        self._visit, self._next_window, self._object = position

    def walk_state(self, visit: int, window: int, step: int) -> int:
        """Return the state that a walk must show in its exposure number `step`; -1 when it is over, or what came before is not known."""
        if visit != self._visit:
            return 0 if step == 0 else -1
        state = int(self.walks.nodes[window])
        known = 0 <= state < len(self.walks.successors) and self._seen[window, 0] == step
        return state if known else -1

    def seen_now(self) -> I64:
        """Return a copy of the clicks of the visit's first WINDOWS_SEEN windows as they are decided on, int64 (windows, d_f).

        For a view beside the loop, in another thread: a row that the loop writes meanwhile is no window's, as its checksum shows.
        """
        return np.stack([self._clicks(at) for at in range(min(self.n_windows, WINDOWS_SEEN))])

    def _clicks(self, window: int) -> I64:
        """The counts of a window as they are decided on: of several channels bit t * channels + k is the click of channel k in slot t."""
        counts = self._counts[window]
        return counts if self._channels == 1 else (counts[:, None] >> np.arange(self._channels) & 1).reshape(-1)

    @property
    def half_seen(self) -> bool:
        """Whether a window that is not settled holds exposures already."""
        return bool(self._seen[self._next_window :].any())

    def arrays(self) -> tuple[I32, I32, I64, I64, I64, I64, Walks, I64]:
        """Return the arrays that hold the visit under way, the first eight of kernel_state.py."""
        visit = self._counts, self._seen, self.tallies
        return self._feature_at, self._window_at, self._last, *visit, self.walks, self._longest

    @property
    def visits_begun(self) -> int:
        """Visits of which something has been seen or settled."""
        return self._visit + (self._next_window > 0 or bool(self._seen.any()))

    def restart(self) -> list[Window]:
        """Give up the visit under way and count from exposure 0 again; return its windows that were still open."""
        open_windows = self._advance_to(self.visits_begun)
        self._visit = 0
        return open_windows

    def warm_up(self) -> None:
        """Compile or load the kernel that `push` will use, without counting anything."""
        if self.parallel:
            # a block's words are a read-only view of its message, which is a type of its own to the compiler
            no_words = np.frombuffer(b"", np.uint8).reshape(0, 1)
            add_frames(0, no_words, self._window_at, self._counts, self._seen, self.tallies)
        else:
            self._add_clicks(0, np.zeros(0, np.uint16), np.zeros(0, np.uint8))

    def _advance_to(self, visit: int) -> list[Window]:
        settled: list[Window] = []
        while self._visit < visit:
            settled += [window._replace(counts=window.counts.copy()) for window in self._settle(self.visit_exposures)]
            self._visit += 1
            self._next_window = 0
            self._object = NO_OBJECT
            self._counts[:] = 0
            self._seen[:] = 0
            self.walks.nodes[:] = 0
            self._need[:], self._last[:] = self._longest
        return settled

    def _settle(self, relative_end: int) -> list[Window]:
        """Windows stay in order: one that is complete waits for none, since shots end in the order of their last exposure."""
        settled: list[Window] = []
        while self._next_window < self.n_windows:
            index = self._next_window
            right, wrong = int(self._seen[index, 0]), int(self._seen[index, 1])
            need = int(self._need[index])
            if right < need and self._last[index] >= relative_end:
                break
            self._out[index] = self._clicks(index)
            last = self._visit * self.visit_exposures + int(self._last[index])
            exposures = right if self._adaptive else 0
            missing, shot = need - right - wrong, index * self.shots
            settled.append(Window(self._object, shot, last, self._out[index], missing, wrong, exposures))
            self._next_window += 1
        return settled


def _make_walks(plan: Plan, n_features: int, shots: int, last: I64) -> Walks:
    """Return what the windows of `plan` need and, of an automaton, its walks; PlanError if they cannot be followed."""
    automaton = plan.automaton
    if automaton is None:
        none = read_only(np.zeros((0, 2), np.uint32)), np.zeros(0, np.int64)
        return Walks(*none, np.full(len(last), shots * n_features, np.int64), last, *np.zeros((2, 0), np.int64))
    slots = int(np.count_nonzero(plan.slot_pattern == ADAPTIVE_PATTERN))
    if shots != 1:
        raise PlanError(
            f"{shots} walks make one decision; allowed: 1",
            remedy="one walk is one decision: --shots 1, and --trials N for more of them",
        )
    if not automaton.n_slots <= slots <= n_features:
        raise PlanError(f"walks of {automaton.n_slots} exposures in cycles of {slots} for numbers of {n_features}")
    nodes, (shown, clicked) = np.zeros(len(last), np.int64), np.zeros((2, automaton.n_states), np.int64)
    return Walks(read_only(automaton.successors), nodes, np.full(len(last), slots, np.int64), last, shown, clicked)


def visit_maps(plan: Plan, shots: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Return, for each exposure of a visit, its pattern or its slot in the walk (-1: dark) and its window, both int32 (visit,)."""
    pattern = plan.slot_pattern.astype(np.int32)
    adaptive = pattern == ADAPTIVE_PATTERN
    feature = np.where(adaptive, np.cumsum(adaptive) - 1, np.where(pattern == DARK_PATTERN, -1, pattern))
    cycles = np.arange(plan.cycles_per_object, dtype=np.int64)[:, None]
    shot = cycles * plan.shots_per_cycle + plan.slot_shot.astype(np.int64)[None, :]
    window = np.where(feature[None, :] < 0, -1, shot // shots)
    return np.tile(feature, plan.cycles_per_object).astype(np.int32), window.ravel().astype(np.int32)


def _last_exposures(window_at: npt.NDArray[np.int32], n_windows: int, visit_exposures: int) -> I64:
    last: I64 = np.full(n_windows, -1, np.int64)
    lit = window_at >= 0
    np.maximum.at(last, window_at[lit], np.arange(visit_exposures, dtype=np.int64)[lit])
    return last
