"""The compiled kernel of the streaming core: decoded FRAMES and MARK bodies in, rows of the decision log out.

Owns the ordinary case of parallel measurements: messages in order, nothing lost, blocks that fit the plan. Whatever else comes it leaves
untouched and says so: `stream.StreamCore` gives it to `core.Core`, whose state this kernel continues. Never allocates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from pans.runtime.wire.kernels import (
    BLOCK_HEADER,
    BODY_HEADER,
    MARK_BYTES,
    block_shape,
    block_times,
    is_next,
    load4,
    load8,
    mark_photons,
    mark_truth,
)
from pans.runtime.wire.schema import NO_OBJECT, UNKNOWN_TRUTH, MessageType

from .decision import NO_LABEL, DecisionFlag
from .window import DARK_CLICKS, DARK_EXPOSURES

# state, int64 (N_STATE,): where the walk stands, and the facts of Core, StreamTracker and DecisionWindows that it continues
MESSAGE, FRAME, N_ROWS, SESSION, NEXT_SEQ, NEXT_EXPOSURE, DROPS, MESSAGES, EXPOSURES = range(9)
VISIT, NEXT_WINDOW, OBJECT, N_DECISIONS, N_ABSTAINED, END_EXPOSURE, LAST_TICK = range(9, 16)
EXPOSURE_TICKS, VISIT_EXPOSURES, SHOTS, N_STATE = range(16, 20)
ALL_DONE, ROWS_FULL, ODD = range(3)  # what `walk_frames` returns
MARK_SLOTS = 4096  # as many objects as core.MAX_MARKS

_U = np.uint64
_LANE = _U(0xFF)
_FRAMES, _MARK = int(MessageType.FRAMES), int(MessageType.MARK)
_HEADER, _BLOCK_HEADER, _MARK_BYTES = BODY_HEADER, BLOCK_HEADER, MARK_BYTES
_ABSTAINED = int(DecisionFlag.ABSTAINED)
_GAP = int(DecisionFlag.GAP) | _ABSTAINED
_NOT_FINITE = int(DecisionFlag.NOT_FINITE) | _ABSTAINED
_NO_LABEL, _NO_OBJECT, _UNKNOWN = NO_LABEL, NO_OBJECT, UNKNOWN_TRUTH
SPREAD = np.array([sum((byte >> bit & 1) << 8 * bit for bit in range(8)) for byte in range(256)], np.uint64)
ONES = np.array([byte.bit_count() for byte in range(256)], np.int64)


class WindowArrays(NamedTuple):
    """The open windows of one visit (arrays of window.DecisionWindows) and the kernel's scratch.

    `lanes` uint64 (ceil(d_f / 8),) counts eight channels each, a byte per channel; `whole` int64 (d_f,) is one window's counts.
    """

    window_at: npt.NDArray[np.int32]
    last: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]
    seen: npt.NDArray[np.int64]
    tallies: npt.NDArray[np.int64]
    lanes: npt.NDArray[np.uint64]
    whole: npt.NDArray[np.int64]


class DecisionTables(NamedTuple):
    """From clicks per pattern to label, probability and checksum; without `labels` (size 0) the counts go to `counts_out`.

    `radix` int64 (d_f,): the row of a table is the sum of counts * radix. `crc` uint32 (bytes of a count, d_f, 256) and `crc_zero`
    uint32 (1,): CRC-32 is affine, so that the checksum of all counts is that of zeros, exclusive-or one entry per byte. For K = 1 with a
    table, `word_rows` int64 and `word_crc` uint32 (bytes of a word, 256) say the same of a byte of the click word; else they are empty.
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


@njit(cache=True, nogil=True)
def walk_frames(buffer, spans, state, marks, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Take messages from state[MESSAGE] on until all are done, the rows are full, or one is not ordinary; say which.

    buffer uint8, spans int64 (n, 2), state int64 (N_STATE,), marks MarkArrays, windows WindowArrays, tables DecisionTables, rows
    DECISION_DTYPE (m,), counts_out int64 (m, d_f).
    """
    while state[MESSAGE] < spans.shape[0]:
        if state[N_ROWS] == rows.size:
            return ROWS_FULL
        start, stop = _U(spans[state[MESSAGE], 0]), _U(spans[state[MESSAGE], 1])
        if load4(buffer, start + _U(4)) != _U(state[SESSION]):
            return ODD
        kind = buffer[start]
        payload = start + _U(_HEADER)
        if kind == _MARK:
            if not _take_mark(buffer, payload, stop, state, marks):
                return ODD
        elif kind == _FRAMES:
            if state[FRAME] == 0 and not _accept_block(buffer, payload, stop, state, windows):
                return ODD
            if not _take_block(buffer, payload, state, marks, windows, tables, rows, counts_out):
                return ROWS_FULL
            state[FRAME] = 0
        else:
            return ODD
        state[MESSAGE] += 1
    return ALL_DONE


@njit(cache=True, nogil=True)
def _take_mark(buffer, payload, stop, state, marks):  # type: ignore[no-untyped-def]
    """Remember an object's truth; False, and nothing done, when the message is not the next one."""
    if stop - payload != _U(_MARK_BYTES) or load4(buffer, payload) != _U(state[NEXT_SEQ]):
        return False
    number = np.int64(load4(buffer, payload + _U(4)))
    slot = number % MARK_SLOTS
    marks.objects[slot] = number
    marks.truths[slot] = np.int16(mark_truth(buffer, payload))
    mark_photons(buffer, payload, marks.photons, slot)
    state[NEXT_SEQ] = (state[NEXT_SEQ] + 1) & 0xFFFFFFFF
    state[MESSAGES] += 1
    return True


@njit(cache=True, nogil=True)
def _accept_block(buffer, payload, stop, state, windows):  # type: ignore[no-untyped-def]
    """Account for a block that is the next one and fits the plan; else False, and nothing done."""
    count, word_bytes = block_shape(buffer, payload, stop)
    first = state[NEXT_EXPOSURE]
    if count == 0 or word_bytes < windows.lanes.size:
        return False
    if not is_next(buffer, payload, count, state[NEXT_SEQ], state[DROPS], first, state[END_EXPOSURE]):
        return False
    visit = first // state[VISIT_EXPOSURES]
    if first + count > (visit + 1) * state[VISIT_EXPOSURES]:
        return False
    if visit != state[VISIT]:
        if state[NEXT_WINDOW] != windows.counts.shape[0]:
            return False
        windows.counts[:] = 0
        windows.seen[:] = 0
        state[VISIT] = visit
        state[NEXT_WINDOW] = 0
    tick, period = block_times(buffer, payload)
    state[OBJECT] = np.int64(load4(buffer, payload + _U(32)))
    state[LAST_TICK] = tick + (count - 1) * period + state[EXPOSURE_TICKS]
    state[NEXT_SEQ] = (state[NEXT_SEQ] + 1) & 0xFFFFFFFF
    state[MESSAGES] += 1
    state[NEXT_EXPOSURE] += count
    state[EXPOSURES] += count
    return True


@njit(cache=True, nogil=True)
def _block_facts(buffer, payload, state, marks):  # type: ignore[no-untyped-def]
    """Of an accepted block: exposures, bytes per word, first exposure, its end tick, period, object and its truth (-1: unknown)."""
    count = np.int64(load4(buffer, payload + _U(28)) & _U(0xFFFF))
    word_bytes = load4(buffer, payload + _U(28)) >> _U(16)
    first = np.int64(load8(buffer, payload + _U(16)))
    tick, period = block_times(buffer, payload)
    number = state[OBJECT]
    known = number != _NO_OBJECT and marks.objects[number % MARK_SLOTS] == number
    truth = np.int64(marks.truths[number % MARK_SLOTS]) if known else np.int64(_UNKNOWN)
    return count, word_bytes, first, tick + state[EXPOSURE_TICKS], period, number, truth


@njit(cache=True, nogil=True)
def _take_block(buffer, payload, state, marks, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Count the frames of an accepted block from state[FRAME] on; False when the rows are full before its end."""
    if tables.word_rows.size:
        return _take_words(buffer, payload, state, marks, windows, tables, rows)
    return _take_windows(buffer, payload, state, marks, windows, tables, rows, counts_out)


@njit(cache=True, nogil=True)
def _take_words(buffer, payload, state, marks, windows, tables, rows):  # type: ignore[no-untyped-def]
    """K = 1 with a table: every frame with light is a window, every word a row.

    Arrays are taken out of their tuples once: inside the loop that would count references for every frame.
    """
    count, word_bytes, first, tick, period, number, truth = _block_facts(buffer, payload, state, marks)
    window_at, seen, tallies = windows.window_at, windows.seen, windows.tallies
    labels, probabilities, word_rows, word_crc = tables.labels, tables.probabilities, tables.word_rows, tables.word_crc
    n_features, n_lanes, crc_zero = windows.counts.shape[1], windows.lanes.size, tables.crc_zero[0]
    top_mask = np.int64(0xFF >> (8 * n_lanes - n_features))
    relative, n_rows, done = first - state[VISIT] * state[VISIT_EXPOSURES], state[N_ROWS], count
    at = payload + _U(_BLOCK_HEADER) + _U(state[FRAME]) * word_bytes
    for i in range(state[FRAME], count):
        here, clicks, index, crc = np.int64(window_at[relative + i]), 0, 0, crc_zero
        for p in range(n_lanes):
            byte = np.int64(buffer[at + _U(p)]) & (top_mask if p == n_lanes - 1 else 0xFF)
            clicks += ONES[byte]
            index += word_rows[p, byte]
            crc ^= word_crc[p, byte]
        at += word_bytes
        if here < 0:
            tallies[DARK_CLICKS] += clicks
            tallies[DARK_EXPOSURES] += n_features
            continue
        seen[here, 0] = n_features
        probability, label, flags = probabilities[index], np.int64(labels[index]), 0
        if not probability > 0:
            probability, label, flags = np.float32(0.0), np.int64(_NO_LABEL), _NOT_FINITE
        end = tick + i * period
        _fill(
            rows[n_rows],
            state[N_DECISIONS],
            end,
            first + i,
            number,
            here,
            clicks,
            label,
            truth,
            flags,
            probability,
            crc,
        )
        n_rows += 1
        state[N_DECISIONS] += 1
        state[N_ABSTAINED] += flags != 0
        state[NEXT_WINDOW] = here + 1
        if n_rows == rows.size:
            done = i + 1
            break
    state[N_ROWS], state[FRAME] = n_rows, done
    return done == count


@njit(cache=True, nogil=True)
def _take_windows(buffer, payload, state, marks, windows, tables, rows, counts_out):  # type: ignore[no-untyped-def]
    """Any K and any back end: clicks gather in byte lanes until a window, a block or a lane is full."""
    count, word_bytes, first, tick, period, number, truth = _block_facts(buffer, payload, state, marks)
    window_at, last, counts, seen = windows.window_at, windows.last, windows.counts, windows.seen
    lanes, whole, tallies = windows.lanes, windows.whole, windows.tallies
    labels, probabilities, radix, crc_table = tables.labels, tables.probabilities, tables.radix, tables.crc
    n_features, n_lanes, crc_zero, shots = counts.shape[1], lanes.size, tables.crc_zero[0], state[SHOTS]
    top_mask = np.int64(0xFF >> (8 * n_lanes - n_features))
    relative, n_rows, done = first - state[VISIT] * state[VISIT_EXPOSURES], state[N_ROWS], count
    at = payload + _U(_BLOCK_HEADER) + _U(state[FRAME]) * word_bytes
    window, held = np.int64(-1), 0  # `held` frames of `window` are in the lanes
    for i in range(state[FRAME], count):
        here = np.int64(window_at[relative + i])
        if here < 0:
            for p in range(n_lanes):
                tallies[DARK_CLICKS] += ONES[np.int64(buffer[at + _U(p)]) & (top_mask if p == n_lanes - 1 else 0xFF)]
            tallies[DARK_EXPOSURES] += n_features
            at += word_bytes
            continue
        window = here
        for p in range(n_lanes):
            lane = SPREAD[buffer[at + _U(p)]]
            lanes[p] = lane if held == 0 else lanes[p] + lane
        held += 1
        at += word_bytes
        if relative + i != last[here]:
            if held == 255:
                _spill(lanes, counts, seen, here, held)
                held = 0
            continue
        _complete(lanes, counts, seen, here, held, whole)
        held = 0
        clicks, index, crc = _sum_up(whole, radix, crc_table, crc_zero)
        flags, label, probability = 0, np.int64(_NO_LABEL), np.float32(0.0)
        if seen[here, 0] != shots * n_features:
            flags = _GAP
        elif labels.size:
            probability, label = probabilities[index], np.int64(labels[index])
            if not probability > 0:
                probability, label, flags = np.float32(0.0), np.int64(_NO_LABEL), _NOT_FINITE
        else:
            for feature in range(n_features):
                counts_out[n_rows, feature] = whole[feature]
        end, shot = tick + i * period, here * shots
        _fill(
            rows[n_rows],
            state[N_DECISIONS],
            end,
            first + i,
            number,
            shot,
            clicks,
            label,
            truth,
            flags,
            probability,
            crc,
        )
        n_rows += 1
        state[N_DECISIONS] += 1
        state[N_ABSTAINED] += flags != 0
        state[NEXT_WINDOW] = here + 1
        if n_rows == rows.size:
            done = i + 1
            break
    if held:
        _spill(lanes, counts, seen, window, held)
    state[N_ROWS], state[FRAME] = n_rows, done
    return done == count


@njit(cache=True, nogil=True)
def _complete(lanes, counts, seen, window, held, whole):  # type: ignore[no-untyped-def]
    """The counts of a window whose last exposure has come, into `whole`."""
    if seen[window, 0] != 0:  # it began in an earlier block
        _spill(lanes, counts, seen, window, held)
        for feature in range(whole.size):
            whole[feature] = counts[window, feature]
    else:
        _unpack(lanes, whole)
        seen[window, 0] = held * whole.size


@njit(cache=True, nogil=True)
def _fill(row, index, tick, exposure, number, shot, clicks, label, truth, flags, probability, crc):  # type: ignore[no-untyped-def]
    """Write one row of the decision log."""
    row["index"] = index
    row["tick"] = tick
    row["exposure_index"] = exposure
    row["object"] = number
    row["shot"] = shot
    row["clicks"] = clicks
    row["label"] = label
    row["truth"] = truth
    row["flags"] = flags
    row["probability"] = probability
    row["counts_crc"] = crc


@njit(cache=True, nogil=True)
def _spill(lanes, counts, seen, window, held):  # type: ignore[no-untyped-def]
    """Add the byte lanes to the counts of their window."""
    n_features = counts.shape[1]
    for p in range(lanes.size):
        lane = lanes[p]
        for feature in range(8 * p, min(8 * p + 8, n_features)):
            counts[window, feature] += np.int64(lane & _LANE)
            lane >>= _U(8)
    seen[window, 0] += held * n_features


@njit(cache=True, nogil=True)
def _unpack(lanes, whole):  # type: ignore[no-untyped-def]
    """The byte lanes as counts: all of a window that one block holds."""
    for p in range(lanes.size):
        lane = lanes[p]
        for feature in range(8 * p, min(8 * p + 8, whole.size)):
            whole[feature] = np.int64(lane & _LANE)
            lane >>= _U(8)


@njit(cache=True, nogil=True)
def _sum_up(whole, radix, crc_table, crc):  # type: ignore[no-untyped-def]
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
