"""Compiled loops of a recording: rows of decisions to runs, verdicts and codes of the log (decision_log.py), messages to a block."""

from __future__ import annotations

import numpy as np

from pans.base.machine import copy_span, inner, outer

from .format import LONG_VERDICT, MESSAGE, RUN_ROWS_MAX

# state, uint64 (N_STATE,): how many rows the open run has, its last row (the index: of the next one), its steps, and how many verdicts are
# known
RUN_ROWS, INDEX, TICK, EXPOSURE, SHOT, OBJECT, TRUTH, TICK_STEP, EXPOSURE_STEP, SHOT_STEP, N_VERDICTS, N_STATE = range(
    12
)

_MESSAGE_HEAD = MESSAGE.size
_U = np.uint64
_ZERO, _ONE, _U32, _HALF_LEFT, _TRUTH_MASK = _U(0), _U(1), _U(1 << 32), _U(32), _U(0xFFFF)
_LONG, _RUN_MAX = _U(LONG_VERDICT), _U(RUN_ROWS_MAX)
_MIX, _FOLD = _U(0x9E3779B97F4A7C15), _U(40)  # 2^64 over the golden ratio: spreads keys over slots


@outer
def encode_rows(rows, state, keys, slots, runs, verdicts, lengths, codes):  # type: ignore[no-untyped-def]
    """Encode rows, DECISION_DTYPE (n,), behind those before; return how many runs and how many verdicts were written.

    state uint64 (N_STATE,), keys uint64 (LONG_VERDICT, 3) and slots uint16 (LONG_VERDICT: free), a power of 2 of them, are the known
    verdicts; runs RUN_DTYPE, verdicts VERDICT_DTYPE with `lengths` uint32 of walks, and codes uint16 have room for n.
    """
    return _find_runs(rows, state, runs), _find_codes(rows, state, keys, slots, verdicts, lengths, codes)


@inner
def _find_runs(rows, state, runs):  # type: ignore[no-untyped-def]
    """Find the runs that rows are made of; return how many were written."""
    # Columns are taken out of the rows once: a row at a time would count references for each.
    indices, ticks, exposures, objects = rows["index"], rows["tick"], rows["exposure_index"], rows["object"]
    shots, truths = rows["shot"], rows["truth"]
    n, part = 0, _ZERO  # runs, and the rows of the last of them, in this block
    for i in range(rows.size):
        tick, exposure, shot = _U(ticks[i]), _U(exposures[i]), _U(shots[i])
        truth, number = _U(truths[i]) & _TRUTH_MASK, _U(objects[i])
        fits = state[RUN_ROWS] > _ZERO and _U(indices[i]) == state[INDEX]
        fits = fits and number == state[OBJECT] and truth == state[TRUTH]
        by, by_exposures, by_shots = tick - state[TICK], exposure - state[EXPOSURE], shot - state[SHOT]
        if fits and state[RUN_ROWS] == _ONE:  # the second one sets the steps
            fits = by < _U32 and by_exposures < _U32 and by_shots < _U32
            if fits:
                state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP] = by, by_exposures, by_shots
        elif fits:
            fits = by == state[TICK_STEP] and by_exposures == state[EXPOSURE_STEP] and by_shots == state[SHOT_STEP]
            fits = fits and state[RUN_ROWS] < _RUN_MAX
        if not fits or part == _ZERO:
            _close(n, part, state, runs)
            run = runs[n]
            run["index"], run["tick"], run["exposure_index"] = indices[i], tick, exposure
            run["object"], run["shot"], run["truth"], run["continues"] = number, shot, truth, fits
            n, part = n + 1, _ZERO
        if not fits:
            state[RUN_ROWS], state[OBJECT], state[TRUTH] = _ZERO, number, truth
            state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP] = _ZERO, _ZERO, _ZERO
        state[RUN_ROWS], part = state[RUN_ROWS] + _ONE, part + _ONE
        state[INDEX], state[TICK], state[EXPOSURE], state[SHOT] = _U(indices[i]) + _ONE, tick, exposure, shot
    _close(n, part, state, runs)
    return n


@inner
def _close(n, part, state, runs):  # type: ignore[no-untyped-def]
    """Say how many rows of this block the last of `n` runs has, and their steps."""
    if n:
        run = runs[n - 1]
        run["count"], run["tick_step"] = part, state[TICK_STEP]
        run["exposure_step"], run["shot_step"] = state[EXPOSURE_STEP], state[SHOT_STEP]


@inner
def _find_codes(rows, state, keys, slots, verdicts, lengths, codes):  # type: ignore[no-untyped-def]
    """Give each row the number of its verdict; return how many verdicts were written, which no row had before."""
    labels, flags, clicks, walked = rows["label"], rows["flags"], rows["clicks"], rows["exposures"]
    probabilities, checksums = rows["probability_bits"], rows["counts_crc"]
    mask, n_new = _U(slots.size - 1), 0
    for i in range(rows.size):
        first, second = _U(clicks[i]) << _HALF_LEFT | _U(labels[i]), _U(probabilities[i]) << _HALF_LEFT | _U(flags[i])
        third = _U(walked[i]) << _HALF_LEFT | _U(checksums[i])
        at = ((first ^ (second * _MIX) ^ (third << _U(13))) * _MIX) >> _FOLD & mask
        known = _U(slots[at])
        while known != _LONG and (keys[known, 2] ^ third) | (keys[known, 1] ^ second) | (keys[known, 0] ^ first):
            at = (at + _ONE) & mask
            known = _U(slots[at])
        if known == _LONG:
            known = state[N_VERDICTS]
            if known < _LONG:  # there is room for one more number
                keys[known, 0], keys[known, 1], keys[known, 2] = first, second, third
                slots[at], state[N_VERDICTS] = known, known + _ONE
            verdict = verdicts[n_new]
            verdict["clicks"], verdict["label"], verdict["flags"] = clicks[i], labels[i], flags[i]
            verdict["probability_bits"], verdict["counts_crc"] = probabilities[i], checksums[i]
            lengths[n_new] = walked[i]
            n_new += 1
        codes[i] = known
    return n_new


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
