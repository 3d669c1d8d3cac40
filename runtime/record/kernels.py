"""The compiled kernels of a recording: rows to runs, verdicts and codes of the compact decision log; messages to a block.

Owns the loops over rows and bytes; what its output means is told in log.py, which also owns the arrays. Never allocates.
"""

from __future__ import annotations

import numpy as np

from pans.runtime.wire.bare import copy_span
from pans.runtime.wire.inner import inner, outer

from .format import LONG_VERDICT, MESSAGE, RUN_ROWS_MAX

# state, uint64 (N_STATE,): the run that is open, as its next row would have to be, and the verdicts known so far
RUN_ROWS, NEXT_INDEX, NEXT_TICK, NEXT_EXPOSURE, NEXT_SHOT, OBJECT, TRUTH = range(7)
TICK_STEP, EXPOSURE_STEP, SHOT_STEP, N_VERDICTS, SLOT_MASK, N_STATE = range(7, 13)

_MESSAGE_HEAD = MESSAGE.size
_U = np.uint64
SLOTS_PER_VERDICT = _U(
    8
)  # at least: a look-up that meets no other verdict on its way is one whose branches are foreseen
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
    count, truth, number = state[RUN_ROWS], state[TRUTH], state[OBJECT]
    index, tick, exposure, shot = state[NEXT_INDEX], state[NEXT_TICK], state[NEXT_EXPOSURE], state[NEXT_SHOT]
    tick_step, exposure_step, shot_step = state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP]
    n_runs, part = 0, _ZERO  # part: rows of the open run that stand in this block
    i, n = _ZERO, _U(rows.size)
    while i < n:
        if count > _ONE:  # in the middle of a run, up to the first row that does not go on with it
            first, stop = i, min(n, i + (_RUN_MAX - count))
            while i < stop:
                apart = (_U(indices[i]) ^ index) | (_U(ticks[i]) ^ tick) | (_U(exposures[i]) ^ exposure)
                apart |= (_U(shots[i]) ^ shot) | (_U(objects[i]) ^ number) | ((_U(truths[i]) & _TRUTH_MASK) ^ truth)
                if apart:
                    break
                index, tick, exposure, shot = index + _ONE, tick + tick_step, exposure + exposure_step, shot + shot_step
                i += _ONE
            if part == _ZERO and i > first:
                _open(runs[n_runs], rows[first], True)
                n_runs += 1
            count, part = count + (i - first), part + (i - first)
            if i == n:
                break
        here_tick, here_exposure, here_shot = _U(ticks[i]), _U(exposures[i]), _U(shots[i])
        here_index, here_truth, here_object = _U(indices[i]), _U(truths[i]) & _TRUTH_MASK, _U(objects[i])
        fits = count == _ONE and here_index == index and here_object == number and here_truth == truth
        if count == _ONE:  # the second row says what the steps are
            tick_step, exposure_step, shot_step = here_tick - tick, here_exposure - exposure, here_shot - shot
            fits = fits and tick_step < _U32 and exposure_step < _U32 and shot_step < _U32
        if not fits:
            if part:
                _close(runs[n_runs - 1], part, tick_step, exposure_step, shot_step, count)
            count, part = _ZERO, _ZERO
            number, truth, index = here_object, here_truth, here_index
        if part == _ZERO:
            _open(runs[n_runs], rows[i], count != _ZERO)
            n_runs += 1
        count, part, index = count + _ONE, part + _ONE, index + _ONE
        tick, exposure, shot = here_tick, here_exposure, here_shot
        if count > _ONE:  # a run of one has no steps yet: the next row is compared with this one
            tick, exposure, shot = tick + tick_step, exposure + exposure_step, shot + shot_step
        i += _ONE
    if part:
        _close(runs[n_runs - 1], part, tick_step, exposure_step, shot_step, count)
    state[RUN_ROWS], state[TRUTH], state[OBJECT] = count, truth, number
    state[NEXT_INDEX], state[NEXT_TICK], state[NEXT_EXPOSURE], state[NEXT_SHOT] = index, tick, exposure, shot
    state[TICK_STEP], state[EXPOSURE_STEP], state[SHOT_STEP] = tick_step, exposure_step, shot_step
    return n_runs


@inner
def _find_codes(rows, state, keys, slots, verdicts, lengths, codes):  # type: ignore[no-untyped-def]
    """Give each row the number of its verdict; return how many verdicts were written, which no row had before."""
    labels, flags, clicks, walked = rows["label"], rows["flags"], rows["clicks"], rows["exposures"]
    probabilities, checksums = rows["probability_bits"], rows["counts_crc"]
    n_known, mask, n_new = state[N_VERDICTS], state[SLOT_MASK], 0
    for i in range(_U(rows.size)):
        first = _U(clicks[i]) << _HALF_LEFT | _U(labels[i])
        second = _U(probabilities[i]) << _HALF_LEFT | _U(flags[i])
        third = _U(walked[i]) << _HALF_LEFT | _U(checksums[i])
        at = _slot_of(first, second, third) & mask
        known = _U(slots[at])
        while known != _LONG and (keys[known, 2] ^ third) | (keys[known, 1] ^ second) | (keys[known, 0] ^ first):
            at = (at + _ONE) & mask
            known = _U(slots[at])
        if known != _LONG:
            codes[i] = known
            continue
        codes[i] = n_known  # the next number, while there is room: LONG_VERDICT afterwards
        _keep(rows[i], verdicts[n_new])
        lengths[n_new] = walked[i]
        n_new += 1
        if n_known < _LONG:
            keys[n_known, 0], keys[n_known, 1], keys[n_known, 2] = first, second, third
            slots[at] = n_known
            n_known += _ONE
            if SLOTS_PER_VERDICT * n_known > mask + _ONE:
                mask = _widen(n_known, mask, keys, slots)
    state[N_VERDICTS], state[SLOT_MASK] = n_known, mask
    return n_new


@inner
def _open(run, row, continues):  # type: ignore[no-untyped-def]
    run["index"] = row["index"]
    run["tick"] = row["tick"]
    run["exposure_index"] = row["exposure_index"]
    run["object"] = row["object"]
    run["shot"] = row["shot"]
    run["truth"] = row["truth"]
    run["continues"] = continues


@inner
def _close(run, part, tick_step, exposure_step, shot_step, count):  # type: ignore[no-untyped-def]
    stepped = count != _ONE  # of a single row no steps are known
    run["count"] = part
    run["tick_step"] = tick_step if stepped else _U(0)
    run["exposure_step"] = exposure_step if stepped else _U(0)
    run["shot_step"] = shot_step if stepped else _U(0)


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
def pack_messages(buffer, spans, first, stop, host_ns, out, used):  # type: ignore[no-untyped-def]
    """Put the bodies at spans[first:stop] of `buffer` behind out[:used], each with `host_ns` and its length (record_format.MESSAGE).

    Ends at the first that does not fit; return its place, or `stop`, and the bytes used.
    """
    while first < stop:
        begin, end = spans[first, 0], spans[first, 1]
        if used + _MESSAGE_HEAD + end - begin > out.size:
            break
        used = _pack(buffer, begin, end, host_ns, out, used)
        first += 1
    return first, used


@outer
def pack_stamped(buffer, spans, first, out, used):  # type: ignore[no-untyped-def]
    """As `pack_messages`, from `first` on, with a time for each: spans int64 (n, 4) of begin, end, time in ns, and what does not matter."""
    while first < spans.shape[0]:
        begin, end = spans[first, 0], spans[first, 1]
        if used + _MESSAGE_HEAD + end - begin > out.size:
            break
        used = _pack(buffer, begin, end, spans[first, 2], out, used)
        first += 1
    return first, used


@inner
def _pack(buffer, begin, end, host_ns, out, used):  # type: ignore[no-untyped-def]
    """Put one body behind out[:used]; return the bytes used."""
    for i in range(8):
        out[used + i] = np.uint8(host_ns >> 8 * i & 0xFF)
    for i in range(4):
        out[used + 8 + i] = np.uint8(end - begin >> 8 * i & 0xFF)
    used += _MESSAGE_HEAD
    copy_span(buffer, _U(begin), _U(end), out, _U(used))
    return used + end - begin
