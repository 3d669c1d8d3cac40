"""The kernel of the core: decoded CLICKS, FRAMES and MARK bodies in, rows of the decision log out.

`take_frames` and `take_clicks` receive the ordinary message: in order, nothing lost, a block that fits the plan. Any other they leave
untouched. Their caller gives it to `still.Core`, which goes on from the same state by `step_frames` or `step_clicks`. Nothing is allocated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pans.base.machine import bare, inner, load2, load4, load8, outer
from pans.bundle.backends import NO_LABEL
from pans.decide.decision import DecisionFlag
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT, UNKNOWN_TRUTH
from pans.protocol.wire import kernels as stream

from .window_kernels import (
    DARK_CLICKS,
    DARK_EXPOSURES,
    ONES,
    SPREAD,
    WindowArrays,
    add_exposures,
    add_walks,
    begin_visit,
    clicks_of,
    complete,
    spill,
    sum_up,
)


class DecisionTables(NamedTuple):
    """From clicks per pattern to label, probability and checksum; without `labels` (size 0) the counts go to `counts_out`.

    A label NO_LABEL abstains: its probability is below what was asked for, or 0 where the scores were not finite. `radix` int64 (d_f,):
    the row of a table is the sum of counts * radix; of an automaton it is the leaf. `crc` uint32 (bytes of a count, d_f, 256) and
    `crc_zero` uint32 (1,): CRC-32 is affine, so that the checksum of all counts is that of zeros, exclusive-or one entry per byte. For
    K = 1 with a table, `word_rows` int64 and `word_crc` uint32 (1 to 3 bytes of a word, 256) say the same of a byte of the click word;
    else they are empty.
    """

    labels: npt.NDArray[np.uint16]
    probabilities: npt.NDArray[np.float32]
    radix: npt.NDArray[np.int64]
    crc: npt.NDArray[np.uint32]
    crc_zero: npt.NDArray[np.uint32]
    word_rows: npt.NDArray[np.int64]
    word_crc: npt.NDArray[np.uint32]


class MarkArrays(NamedTuple):
    """The latest object numbers, truths and photons by object modulo MARK_SLOTS; int64, int16, float32 (MARK_SLOTS,)."""

    objects: npt.NDArray[np.int64]
    truths: npt.NDArray[np.int16]
    photons: npt.NDArray[np.float32]


def make_marks() -> MarkArrays:
    """Return the marks of no object."""
    return MarkArrays(
        np.full(MARK_SLOTS, -1, np.int64), np.full(MARK_SLOTS, 0, np.int16), np.full(MARK_SLOTS, 0, np.float32)
    )


class Block(NamedTuple):
    """An accepted block: its frames (of CLICKS: exposures) from `at` on in the buffer, from exposure `first`, `relative` in the visit, on.

    `end_tick` is that of the first exposure's end. `truth` is that of `object`, -1 where it is not known. `top_mask` are the bits of the
    last byte of a word that are channels.
    """

    frames: np.integer[Any]
    word_bytes: np.integer[Any]
    at: np.integer[Any]
    first: np.integer[Any]
    relative: np.integer[Any]
    end_tick: np.integer[Any]
    period_ticks: np.integer[Any]
    object: np.integer[Any]
    truth: np.integer[Any]
    top_mask: np.integer[Any]


class WalkArrays(NamedTuple):
    """What `take_clicks` continues: state CORE_DTYPE (1,), marks, windows, tables, rows DECISION_DTYPE (m,), counts int64 (m, d_f).

    `heard` is StreamTracker's: whoever calls the kernel fills it.
    """

    state: npt.NDArray[np.void]
    marks: MarkArrays
    windows: WindowArrays
    tables: DecisionTables
    rows: npt.NDArray[np.void]
    counts: npt.NDArray[np.int64]
    heard: npt.NDArray[np.int64]

    @staticmethod
    def kernel() -> tuple[Any, tuple[str, ...]]:
        """Return the kernel that takes a message, and the fields that it wants behind it; who calls it notes what was heard."""
        return take_clicks, WalkArrays._fields[:-1]


class FrameWalkArrays(WalkArrays):
    """The same of a stream of frames, for `take_frames`: the kernel is compiled for one of the two."""

    @staticmethod
    def kernel() -> tuple[Any, tuple[str, ...]]:
        """Return the kernel that takes a message, and the fields that it wants behind it."""
        return take_frames, WalkArrays._fields[:-1]


class IdleArrays(NamedTuple):
    """What the kernel has of a core that takes every message itself: state CORE_DTYPE (1,), rows DECISION_DTYPE (1,), `heard`."""

    state: npt.NDArray[np.void]
    rows: npt.NDArray[np.void]
    heard: npt.NDArray[np.int64]

    @staticmethod
    def kernel() -> tuple[Any, tuple[str, ...]]:
        """Return the kernel that leaves every message to the core; it wants the whole walk before the message."""
        return take_nothing, ()


# what `take_frames` and `take_clicks` return; TOOK_URGENT is a block of which the caller must know at once
ODD, TOOK_MARK, TOOK_BLOCK, TOOK_URGENT = range(4)
MARK_SLOTS = 4096  # as many objects as marks.MAX_MARKS

_U = np.uint64
_ABSTAINED = int(DecisionFlag.ABSTAINED)
_GAP, _WRONG = int(DecisionFlag.GAP) | _ABSTAINED, int(DecisionFlag.WRONG_PATTERN) | _ABSTAINED
_NOT_FINITE, _AMBIGUOUS = int(DecisionFlag.NOT_FINITE) | _ABSTAINED, int(DecisionFlag.AMBIGUOUS) | _ABSTAINED
_NO_LABEL, _NO_OBJECT, _UNKNOWN = NO_LABEL, NO_OBJECT, UNKNOWN_TRUTH


@inner
def take_frames(buffer, start, stop, states, marks, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Take a message of a stream of frames, from `start` to `stop`, uint64; ODD, and nothing done, where it is not ordinary."""
    state = states[0]
    if not is_ours(buffer, start, stop, state):
        return ODD
    kind, payload = buffer[start], start + _U(stream.BODY_HEADER)
    if kind == stream.MARK:
        return TOOK_MARK if _take_mark(buffer, payload, stop, state, marks) else ODD
    if kind != stream.FRAMES or not _accept_frames(buffer, payload, stop, state, windows):
        return ODD
    block = _block_of(buffer, payload, state, marks, windows)
    _decide_frames(buffer, block, state, windows, tables, rows, counts_out)
    return _took(state, tables)


@inner
def take_clicks(buffer, start, stop, states, marks, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Take a message as `take_frames` does, of a stream of one detector's exposures."""
    state = states[0]
    if not is_ours(buffer, start, stop, state):
        return ODD
    kind, payload = buffer[start], start + _U(stream.BODY_HEADER)
    if kind == stream.MARK:
        return TOOK_MARK if _take_mark(buffer, payload, stop, state, marks) else ODD
    if kind != stream.CLICKS or not _accept_clicks(buffer, payload, stop, state, windows):
        return ODD
    block = _block_of(buffer, payload, state, marks, windows)
    _settle(block, state, windows, tables, rows, counts_out, 0)
    return _took(state, tables)


@inner
def take_nothing(walk, buffer, start, stop):  # type: ignore[no-untyped-def]
    """Leave every message to the caller."""
    return ODD


@inner
def _took(state, tables):  # type: ignore[no-untyped-def]
    """TOOK_URGENT where a back end that is not the kernel's has to decide."""
    return TOOK_URGENT if tables.labels.size == 0 and state.n_rows > 0 else TOOK_BLOCK


@inner
def is_ours(buffer, start, stop, state):  # type: ignore[no-untyped-def]
    """Whether a message has a plain header, of the session that is followed."""
    return (
        stop >= start + _U(stream.BODY_HEADER)
        and stream.is_plain(buffer, start)
        and load4(buffer, start + stream.SESSION_AT) == _U(state.session)
    )


@inner
def _take_mark(buffer, payload, stop, state, marks):  # type: ignore[no-untyped-def]
    """Remember an object's truth; False, and nothing done, when the message is not the next one."""
    if not stream.is_next_mark(buffer, payload, stop, state):
        return False
    number, first = (
        np.int64(load4(buffer, payload + stream.MARK_OBJECT_AT)),
        np.int64(load8(buffer, payload + stream.MARK_FIRST_AT)),
    )
    fits = load2(buffer, payload + stream.HALF_AT) == _U(0)  # it stands still
    fits = fits and number < _NO_OBJECT and number * state.visit_exposures == first and first < state.end_exposure
    if not fits or not stream.mark_fits(buffer, payload, state, state.n_classes):
        return False
    slot = number % MARK_SLOTS
    if marks.objects[slot] == number:
        return False  # marked once more: whoever adds up the rows so far must not see the later mark
    marks.objects[slot] = number
    marks.truths[slot] = np.int16(stream.mark_truth(buffer, payload))
    stream.mark_photons(buffer, payload, marks.photons, slot)
    stream.go_on(state, np.int64(0))
    return True


@inner
def _accept_frames(buffer, payload, stop, state, windows):  # type: ignore[no-untyped-def]
    """Account for a block of frames that is the next one and fits the plan; else False, and nothing done."""
    count, word_bytes = stream.next_block(buffer, payload, stop, state)
    if count == 0 or word_bytes < windows.lanes.size:
        return False
    return _accept(buffer, payload, count, state, windows)


@inner
def _accept_clicks(buffer, payload, stop, state, windows):  # type: ignore[no-untyped-def]
    """Count a block of one detector's exposures, if it is the next one and fits the plan; else False, and nothing done."""
    count = stream.next_clicks(buffer, payload, stop, state)
    if count == 0:
        return False
    stamps, bits = windows.stamps[:count], windows.bits[:count]
    stream.unpack_clicks(buffer, payload, count, stamps, bits)
    n_states = windows.walks.successors.shape[0]
    if n_states:
        for i in range(count):
            if stamps[i] >= n_states and stamps[i] != DARK_PATTERN:
                return False
    if not _accept(buffer, payload, count, state, windows):
        return False
    _add_clicks(state.next_exposure - count - state.visit * state.visit_exposures, stamps, bits, windows)
    return True


@inner
def _add_clicks(relative, stamps, bits, windows):  # type: ignore[no-untyped-def]
    """Count exposures from `relative` in the visit on: the patterns shown, and the clicks or photon numbers."""
    counts, seen, tallies = windows.counts, windows.seen, windows.tallies
    feature_at, window_at = windows.feature_at, windows.window_at
    if windows.walks.successors.shape[0]:
        add_walks(relative, stamps, bits, (feature_at, window_at), windows.walks, counts, seen, tallies)
    else:
        add_exposures(relative, stamps, bits, feature_at, window_at, counts, seen, tallies)


@inner
def _accept(buffer, payload, count, state, windows):  # type: ignore[no-untyped-def]
    """Account for the next block, of `count` exposures, if it fits the plan; else False, and nothing done."""
    first = state.next_exposure
    visit = first // state.visit_exposures
    if first + count > (visit + 1) * state.visit_exposures:
        return False
    tick, period = stream.block_times(buffer, payload)
    number = np.int64(load4(buffer, payload + stream.OBJECT_AT))
    if number != visit % _NO_OBJECT and number != _NO_OBJECT:
        return False
    if period != state.period_ticks or tick < planned_tick(first, state, windows.offsets) - period:
        return False
    if not _is_due(visit, first - visit * state.visit_exposures, state, windows):
        return False
    _enter(visit, number, state, windows)
    stream.go_on(state, count)
    note_end(tick, count, state, windows.offsets)
    return True


@inner
def _enter(visit, number, state, windows):  # type: ignore[no-untyped-def]
    """Begin `visit` with object `number` before the detector, unless it is under way."""
    if visit != state.visit:
        begin_visit(windows)
        state.visit = visit
        state.next_window = 0
    state.object_index = number


@inner
def planned_tick(exposure, state, offsets):  # type: ignore[no-untyped-def]
    """When an exposure begins by the plan."""
    cycle = exposure // offsets.size
    return state.start_tick + cycle * state.cycle_ticks + offsets[exposure - cycle * offsets.size]


@inner
def ticks_to_spare(walk):  # type: ignore[no-untyped-def]
    """Ticks from the end of the latest exposure to that of the last one before a decision can fall due; 0 where the next may bring it.

    A walk may end as early as its shortest way to a leaf allows, a fixed window ends with its last exposure.
    """
    state, windows = walk.state[0], walk.windows
    upcoming, n_windows = state.next_exposure, windows.last.size
    visit, window, node = upcoming // state.visit_exposures, np.int64(0), np.int64(0)
    n_states = windows.walks.successors.shape[0]
    if state.next_window < n_windows:
        if visit != state.visit:  # a window waits for what was lost
            return np.int64(0)
        window = state.next_window
        if n_states:
            node = windows.walks.nodes[window]
    elif visit == state.visit:  # only dark exposures are left of it
        visit += 1
    first = visit * state.visit_exposures
    earliest = first + windows.longest[1, window]
    if 0 <= node < n_states:
        begin = first + (windows.longest[1, window - 1] + 1 if window else 0)
        earliest = min(earliest, max(begin, upcoming) + windows.walks.to_leaf[node] - 1)
    last = min(earliest, state.end_exposure - 1) - 1
    if last < upcoming:
        return np.int64(0)
    return planned_tick(last, state, windows.offsets) - planned_tick(upcoming - 1, state, windows.offsets)


@inner
def note_end(tick, count, state, offsets):  # type: ignore[no-untyped-def]
    """Note when the last of `count` exposures that were accounted for ended, and how far that is from the plan's time."""
    state.last_tick = tick + (count - 1) * state.period_ticks + state.exposure_ticks
    due = planned_tick(state.next_exposure - 1, state, offsets) + state.exposure_ticks
    state.jitter_ticks = max(state.jitter_ticks, abs(state.last_tick - due))


@inner
def _is_due(visit, relative, state, windows):  # type: ignore[no-untyped-def]
    """Whether no window waits that ended before exposure `relative` of `visit`: a block before this one may have been left out."""
    n_windows = windows.last.size
    if visit == state.visit:
        return state.next_window == n_windows or windows.last[state.next_window] >= relative
    return visit == state.visit + 1 and state.next_window == n_windows and windows.longest[1, 0] >= relative


@inner
def _block_of(buffer, payload, state, marks, windows):  # type: ignore[no-untyped-def]
    first = np.int64(load8(buffer, payload + stream.FIRST_AT))
    tick, period = stream.block_times(buffer, payload)
    number = state.object_index
    known = number != _NO_OBJECT and marks.objects[number % MARK_SLOTS] == number
    truth = np.int64(marks.truths[number % MARK_SLOTS]) if known else np.int64(_UNKNOWN)
    return Block(
        stream.block_count(buffer, payload),
        load2(buffer, payload + stream.WIDTH_AT),
        payload + _U(stream.BLOCK_HEADER),
        first,
        first - state.visit * state.visit_exposures,
        tick + state.exposure_ticks,
        period,
        number,
        truth,
        _top_mask(windows),
    )


@inner
def _top_mask(windows):  # type: ignore[no-untyped-def]
    return np.int64(0xFF >> (8 * windows.lanes.size - windows.counts.shape[1]))


# -- an irregular message --------------------------------------------------------------------------------------------------


@outer
def step_clicks(walk, visit, relative, count, number, tick, period, flags):  # type: ignore[no-untyped-def]
    """Count `count` exposures of object `number`, in `stamps` and `bits`, from exposure `relative` of `visit` on, and settle windows.

    Without exposures, those before `relative` are settled that will never be complete, visit by visit: False where more are left, or the
    rows are full. Before exposures all is settled. Exposure e of the visit ends at `tick` + e * `period`; `flags` go with each row.
    """
    walk = bare(walk)
    state, windows = walk.state[0], walk.windows
    if count:
        _enter(visit, number, state, windows)
        _add_clicks(relative, windows.stamps[:count], windows.bits[:count], windows)
    return _settle_visit(walk, visit, relative + count, tick, period, flags)


@outer
def step_frames(walk, words, width, visit, relative, number, tick, period, flags):  # type: ignore[no-untyped-def]
    """As `step_clicks`, of frames: uint8 words of `width` bytes behind one another."""
    walk = bare(walk)
    state, windows = walk.state[0], walk.windows
    if words.size == 0:
        return _settle_visit(walk, visit, relative, tick, period, flags)
    _enter(visit, number, state, windows)
    count, first = np.int64(words.size) // width, visit * state.visit_exposures + relative
    times, unknown = tick + relative * period, np.int64(_UNKNOWN)
    block = Block(count, _U(width), _U(0), first, relative, times, period, number, unknown, _top_mask(windows))
    _decide_frames(words, block, state, windows, walk.tables, walk.rows, walk.counts)
    return True


@inner
def _settle_visit(walk, visit, relative, tick, period, flags):  # type: ignore[no-untyped-def]
    """Settle the windows of the visit under way, before `relative` if it is `visit`; False when more are left, or rows are full."""
    state, windows, zero = walk.state[0], walk.windows, np.int64(0)
    end, first = relative if state.visit >= visit else state.visit_exposures, state.visit * state.visit_exposures
    block = Block(end, _U(0), _U(0), first, zero, tick, period, state.object_index, np.int64(_UNKNOWN), zero)
    _settle(block, state, windows, walk.tables, walk.rows, walk.counts, flags)
    if state.visit >= visit:
        return state.n_rows < walk.rows.size
    if state.n_rows < walk.rows.size:
        _enter(state.visit + 1, np.int64(_NO_OBJECT), state, windows)
    return False


# -- the windows of a block ------------------------------------------------------------------------------------------------


@inner
def _decide_frames(buffer, block, state, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Count the frames of `block` and decide on the windows that they complete."""
    if tables.word_rows.shape[0]:
        _take_words(buffer, block, state, windows, tables, rows)
    else:
        _take_windows(buffer, block, state, windows, tables, rows, counts_out)


@inner
def _take_words(buffer, block, state, windows, tables, rows):  # type: ignore[no-untyped-def]
    """K = 1 with a table: every frame with light is a window, every word a row of the table."""
    window_at, tallies, n_features = windows.window_at, windows.tallies, windows.counts.shape[1]
    word_rows, word_crc, last = tables.word_rows, tables.word_crc, _U(tables.word_rows.shape[0] - 1)
    at, n = block.at, state.n_rows
    for i in range(block.frames):
        top = _U(buffer[at + last]) & _U(block.top_mask)
        clicks, index, crc = ONES[top], word_rows[last, top], tables.crc_zero[0] ^ word_crc[last, top]
        for byte in range(last):
            part = buffer[at + byte]
            clicks += ONES[part]
            index += word_rows[byte, part]
            crc ^= word_crc[byte, part]
        at += block.word_bytes
        here = np.int64(window_at[block.relative + i])
        if here < 0:
            tallies[DARK_CLICKS] += clicks
            tallies[DARK_EXPOSURES] += n_features
            continue
        label, probability, flags = _look_up(tables.labels, tables.probabilities, index)
        _put_row(rows[n], state, block, i, here, (clicks, label, flags, probability, crc))
        n += 1
        state.next_window = here + 1
    state.n_rows = n


@inner
def _take_windows(buffer, block, state, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Any K and any back end: clicks gather in byte lanes until a window, a block or a lane is full."""
    window_at, last, counts, seen = windows.window_at, windows.last, windows.counts, windows.seen
    lanes, whole, tallies = windows.lanes, windows.whole, windows.tallies
    labels, probabilities, radix, crc_table = tables.labels, tables.probabilities, tables.radix, tables.crc
    n_features, n_lanes, crc_zero, shots = counts.shape[1], lanes.size, tables.crc_zero[0], state.shots
    n_rows, at = state.n_rows, block.at
    window, held = np.int64(-1), np.int64(0)  # `held` frames of `window` are in the lanes
    for i in range(block.frames):
        here = np.int64(window_at[block.relative + i])
        if here < 0:
            for p in range(n_lanes):
                byte = np.int64(buffer[at + _U(p)]) & (block.top_mask if p == n_lanes - 1 else 0xFF)
                tallies[DARK_CLICKS] += ONES[byte]
            tallies[DARK_EXPOSURES] += n_features
            at += block.word_bytes
            continue
        window = here
        for p in range(n_lanes):
            lane = SPREAD[buffer[at + _U(p)]]
            lanes[p] = lane if held == 0 else lanes[p] + lane
        held += 1
        at += block.word_bytes
        if block.relative + i != last[here]:
            if held == 255:
                spill(lanes, counts, seen, here, held)
                held = np.int64(0)
            continue
        complete(lanes, counts, seen, here, held, whole)
        held = np.int64(0)
        clicks, index, crc = sum_up(whole, radix, crc_table, crc_zero)
        label, probability, flags = np.int64(_NO_LABEL), np.float32(0.0), 0
        if seen[here, 0] != shots * n_features:
            flags = _GAP
        elif labels.size:
            label, probability, flags = _look_up(labels, probabilities, index)
        else:
            _keep_counts(counts_out, np.int64(n_rows), whole)
        _put_row(rows[n_rows], state, block, i, here * shots, (clicks, label, flags, probability, crc))
        n_rows += 1
        state.next_window = here + 1
    if held:
        spill(lanes, counts, seen, window, held)
    state.n_rows = n_rows


@inner
def _keep_counts(counts_out, row, counts):  # type: ignore[no-untyped-def]
    """Keep the clicks of a window for the back end."""
    for feature in range(counts.size):
        counts_out[row, feature] = counts[feature]


@inner
def _settle(block, state, windows, tables, rows, counts_out, given):  # type: ignore[no-untyped-def]
    """Write a row, with the `given` flags, for each window that is complete or ends before CLICKS `block`, which is counted.

    Windows stay in order: one that is complete waits for none, since shots end in the order of their last exposure.
    """
    need, last, counts, seen = windows.walks.need, windows.last, windows.counts, windows.seen
    end, n_states = block.relative + block.frames, windows.walks.successors.shape[0]
    while state.next_window < counts.shape[0] and state.n_rows < rows.size:
        index = state.next_window
        right, wrong = seen[index, 0], seen[index, 1]
        if right < need[index] and last[index] >= end:
            return
        decided_on = clicks_of(counts[index], windows.whole)
        clicks, row, crc = sum_up(decided_on, tables.radix, tables.crc, tables.crc_zero[0])
        label, probability = np.int64(_NO_LABEL), np.float32(0.0)
        flags = given | (_WRONG if wrong else 0) | (_GAP if right + wrong < need[index] else 0)
        if flags == 0 and tables.labels.size:
            row = windows.walks.nodes[index] - n_states if n_states else row
            label, probability, flags = _look_up(tables.labels, tables.probabilities, row)
        elif flags == 0:
            _keep_counts(counts_out, state.n_rows, decided_on)
        decided = (clicks, label, flags, probability, crc)
        here = rows[state.n_rows]
        _put_row(here, state, block, last[index] - block.relative, index * state.shots, decided)
        here["exposures"] = right if n_states else 0
        state.n_rows += 1
        state.next_window += 1


@inner
def _look_up(labels, probabilities, index):  # type: ignore[no-untyped-def]
    """Label, probability and flags of a row of the table."""
    label, probability = np.int64(labels[index]), probabilities[index]
    if label != _NO_LABEL:
        return label, probability, 0
    return label, probability, _AMBIGUOUS if probability > 0 else _NOT_FINITE


@inner
def _put_row(row, state, block, i, shot, decided):  # type: ignore[no-untyped-def]
    """Write the decision `decided` (clicks, label, flags, probability, checksum) on a window that frame `i` ends, and count it."""
    row["index"] = state.n_decisions
    row["tick"] = block.end_tick + i * block.period_ticks
    row["exposure_index"] = block.first + i
    row["object"] = block.object
    row["shot"] = shot
    clicks, label, flags, probability, crc = decided
    row["clicks"] = clicks
    row["label"] = label
    row["truth"] = block.truth
    row["flags"] = flags
    row["probability"] = probability
    row["counts_crc"] = crc
    row["exposures"] = 0
    state.n_decisions += 1
    state.n_abstained += flags != 0
