"""Compiled loops of a recording: rows of decisions to runs, verdicts and codes of the log (log.py), messages to a block."""

from __future__ import annotations

import numpy as np

from pans.runtime.wire.bare import copy_span
from pans.runtime.wire.inner import inner, outer

from .format import LONG_VERDICT, MESSAGE, RUN_ROWS_MAX

# state, uint64 (N_STATE,): the run that is open, as its next row would have to be, the verdicts known so far, and of the block under way
# its runs and the rows of the last of them. A run of one has no steps yet: they are 0, and its next row is compared with it
RUN_ROWS, NEXT_INDEX, NEXT_TICK, NEXT_EXPOSURE, NEXT_SHOT, OBJECT, TRUTH = range(7)
TICK_STEP, EXPOSURE_STEP, SHOT_STEP, N_VERDICTS, SLOT_MASK, N_RUNS, PART, N_STATE = range(7, 15)

_MESSAGE_HEAD = MESSAGE.size
_U = np.uint64
SLOTS_PER_VERDICT = _U(8)  # at least, so that a look-up hardly ever meets another verdict on its way
_ZERO, _ONE, _U32, _HALF_LEFT, _TRUTH_MASK = _U(0), _U(1), _U(1 << 32), _U(32), _U(0xFFFF)
_LONG, _RUN_MAX = _U(LONG_VERDICT), _U(RUN_ROWS_MAX)
_MIX, _FOLD = _U(0x9E3779B97F4A7C15), _U(40)  # 2^64 over the golden ratio: spreads keys over slots


@outer
def encode_rows(rows, state, keys, slots, runs, verdicts, lengths, codes):  # type: ignore[no-untyped-def]
    """Encode rows, DECISION_DTYPE (n,), behind those before; return how many runs and how many verdicts were written.

    state uint64 (N_STATE,), keys uint64 (LONG_VERDICT, 3) and slots uint16 (LONG_VERDICT: free) are the known verdicts;
    runs RUN_DTYPE, verdicts VERDICT_DTYPE with `lengths` uint32 of walks, and codes uint16 have room for n.
    """
    return _find_runs(rows, state, runs), _find_codes(rows, state, keys, slots, verdicts, lengths, codes)


@inner
def _find_runs(rows, state, runs):  # type: ignore[no-untyped-def]
    """Tell the runs that rows are made of; return how many were written."""
    # Columns are taken out of the rows once: a row at a time would count references for each.
    indices, ticks, exposures, objects = rows["index"], rows["tick"], rows["exposure_index"], rows["object"]
    shots, truths = rows["shot"], rows["truth"]
    state[N_RUNS], state[PART] = _ZERO, _ZERO
    i, n = _ZERO, _U(rows.size)
    while i < n:
        if state[RUN_ROWS] > _ONE:  # in the middle of a run, up to the first row that does not go on with it
            index, tick, exposure, shot = state[NEXT_INDEX], state[NEXT_TICK], state[NEXT_EXPOSURE], state[NEXT_SHOT]
            tick_step, exposure_step, shot_step = state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP]
            truth, number, first = state[TRUTH], state[OBJECT], i
            stop = min(n, i + (_RUN_MAX - state[RUN_ROWS]))
            while i < stop:
                apart = (_U(indices[i]) ^ index) | (_U(ticks[i]) ^ tick) | (_U(exposures[i]) ^ exposure)
                apart |= (_U(shots[i]) ^ shot) | (_U(objects[i]) ^ number) | ((_U(truths[i]) & _TRUTH_MASK) ^ truth)
                if apart:
                    break
                index, tick, exposure, shot = index + _ONE, tick + tick_step, exposure + exposure_step, shot + shot_step
                i += _ONE
            if i > first:
                _go_on(i - first, state, runs)
            if i == n:
                break
        truth = _U(truths[i]) & _TRUTH_MASK
        _add_row(_U(indices[i]), _U(ticks[i]), _U(exposures[i]), _U(shots[i]), _U(objects[i]), truth, state, runs)
        i += _ONE
    return _close(state, runs)


@inner
def _add_row(index, tick, exposure, shot, number, truth, state, runs):  # type: ignore[no-untyped-def]
    """Add one decision: as the second of the open run, whose steps it then says, else as the first of a run of its own."""
    by = tick - state[NEXT_TICK], exposure - state[NEXT_EXPOSURE], shot - state[NEXT_SHOT]
    fits = state[RUN_ROWS] == _ONE and index == state[NEXT_INDEX] and number == state[OBJECT] and truth == state[TRUTH]
    if fits and by[0] < _U32 and by[1] < _U32 and by[2] < _U32:
        state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP] = by
    else:
        _close(state, runs)
        state[RUN_ROWS], state[PART], state[OBJECT], state[TRUTH] = _ZERO, _ZERO, number, truth
        state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP] = _ZERO, _ZERO, _ZERO  # a single one has none
    state[NEXT_INDEX], state[NEXT_TICK], state[NEXT_EXPOSURE], state[NEXT_SHOT] = index, tick, exposure, shot
    _go_on(_ONE, state, runs)


@inner
def _go_on(count, state, runs):  # type: ignore[no-untyped-def]
    """Count `count` decisions more into the open run, which the next of them fits: it is opened in this block, where it is not yet."""
    if state[PART] == _ZERO:
        run = runs[state[N_RUNS]]
        run["index"], run["tick"], run["exposure_index"] = state[NEXT_INDEX], state[NEXT_TICK], state[NEXT_EXPOSURE]
        run["object"], run["shot"], run["truth"] = state[OBJECT], state[NEXT_SHOT], state[TRUTH]
        run["continues"] = state[RUN_ROWS] != _ZERO
        state[N_RUNS] += _ONE
    state[RUN_ROWS], state[PART], state[NEXT_INDEX] = (
        state[RUN_ROWS] + count,
        state[PART] + count,
        state[NEXT_INDEX] + count,
    )
    state[NEXT_TICK] += count * state[TICK_STEP]
    state[NEXT_EXPOSURE] += count * state[EXPOSURE_STEP]
    state[NEXT_SHOT] += count * state[SHOT_STEP]


@inner
def _close(state, runs):  # type: ignore[no-untyped-def]
    """Say how many decisions of this block the last run has, and their steps; return how many runs there are."""
    if state[PART]:
        run = runs[state[N_RUNS] - _ONE]
        run["count"], run["tick_step"] = state[PART], state[TICK_STEP]
        run["exposure_step"], run["shot_step"] = state[EXPOSURE_STEP], state[SHOT_STEP]
    return np.int64(state[N_RUNS])


@inner
def _find_codes(rows, state, keys, slots, verdicts, lengths, codes):  # type: ignore[no-untyped-def]
    """Give each row the number of its verdict; return how many verdicts were written, which no row had before."""
    labels, flags, clicks, walked = rows["label"], rows["flags"], rows["clicks"], rows["exposures"]
    probabilities, checksums = rows["probability_bits"], rows["counts_crc"]
    mask, n_new = state[SLOT_MASK], 0
    for i in range(_U(rows.size)):
        key = _key_of(clicks[i], labels[i], probabilities[i], flags[i], walked[i], checksums[i])
        at, known = _look_for(key, mask, keys, slots)
        if known == _LONG:
            known = _learn(key, at, state, keys, slots)
            mask = state[SLOT_MASK]
            _keep(rows[i], verdicts[n_new])
            lengths[n_new] = walked[i]
            n_new += 1
        codes[i] = known
    return n_new


@inner
def _key_of(clicks, label, probability_bits, flags, walked, checksum):  # type: ignore[no-untyped-def]
    """A verdict as three numbers."""
    first, second = _U(clicks) << _HALF_LEFT | _U(label), _U(probability_bits) << _HALF_LEFT | _U(flags)
    return first, second, _U(walked) << _HALF_LEFT | _U(checksum)


@inner
def _look_for(key, mask, keys, slots):  # type: ignore[no-untyped-def]
    """The slot of a verdict, and its number: LONG_VERDICT where it has none yet."""
    first, second, third = key
    at = _slot_of(first, second, third) & mask
    known = _U(slots[at])
    while known != _LONG and (keys[known, 2] ^ third) | (keys[known, 1] ^ second) | (keys[known, 0] ^ first):
        at = (at + _ONE) & mask
        known = _U(slots[at])
    return at, known


@inner
def _learn(key, at, state, keys, slots):  # type: ignore[no-untyped-def]
    """Give the verdict that belongs to slot `at` the next number, while there is room, and return it: LONG_VERDICT afterwards."""
    number = state[N_VERDICTS]
    if number < _LONG:
        keys[number, 0], keys[number, 1], keys[number, 2] = key
        slots[at] = number
        state[N_VERDICTS] = number + _ONE
        if SLOTS_PER_VERDICT * state[N_VERDICTS] > state[SLOT_MASK] + _ONE:
            state[SLOT_MASK] = _widen(state[N_VERDICTS], state[SLOT_MASK], keys, slots)
    return number


@inner
def _slot_of(first, second, third):  # type: ignore[no-untyped-def]
    return ((first ^ (second * _MIX) ^ (third << _U(13))) * _MIX) >> _FOLD


@inner
def _widen(n_known, mask, keys, slots):  # type: ignore[no-untyped-def]
    """Twice as many slots, whose mask is returned: few verdicts stay close together, where the cache has them."""
    mask = _U(2) * mask + _ONE
    for at in range(mask + _ONE):
        slots[at] = _LONG
    for number in range(n_known):
        at = _slot_of(keys[number, 0], keys[number, 1], keys[number, 2]) & mask
        while slots[at] != _LONG:
            at = (at + _ONE) & mask
        slots[at] = number
    return mask


@inner
def _keep(row, verdict):  # type: ignore[no-untyped-def]
    verdict["clicks"] = row["clicks"]
    verdict["label"] = row["label"]
    verdict["flags"] = row["flags"]
    verdict["probability_bits"] = row["probability_bits"]
    verdict["counts_crc"] = row["counts_crc"]


@outer
def message_spans(payload, at, spans):  # type: ignore[no-untyped-def]
    """Find the bodies of a block of messages from byte `at` on; put where they begin and end into spans int64 (n, 2).

    Return how many, and the place of the first that was not looked at: the end of the payload, where the spans are full, or a message that
    reaches past its block.
    """
    n = 0
    while n < spans.shape[0] and at + _MESSAGE_HEAD <= payload.size:
        length = np.int64(0)
        for i in range(4):
            length |= np.int64(payload[at + 8 + i]) << 8 * i
        if at + _MESSAGE_HEAD + length > payload.size:
            break
        spans[n, 0], spans[n, 1] = at + _MESSAGE_HEAD, at + _MESSAGE_HEAD + length
        at += _MESSAGE_HEAD + length
        n += 1
    return n, at


@outer
def pack_stamped(buffer, spans, first, out, used):  # type: ignore[no-untyped-def]
    """Put the bodies at spans[first:] of `buffer` behind out[:used], each with its time and its length (format.MESSAGE).

    spans int64 (n, 4): begin, end, time in ns, and what does not matter. Return the place of the first that does not fit, or n, and the
    bytes used.
    """
    while first < spans.shape[0]:
        begin, end, host_ns = spans[first, 0], spans[first, 1], spans[first, 2]
        if used + _MESSAGE_HEAD + end - begin > out.size:
            break
        for i in range(8):
            out[used + i] = np.uint8(host_ns >> 8 * i & 0xFF)
        for i in range(4):
            out[used + 8 + i] = np.uint8(end - begin >> 8 * i & 0xFF)
        used += _MESSAGE_HEAD
        copy_span(buffer, _U(begin), _U(end), out, _U(used))
        used += end - begin
        first += 1
    return first, used
