"""The compiled decisions of a flow: one message in, and of a block the rows of all objects that it settles, with their passages.

Owns the twin of what cells.py, tape.py and core.py do with a block, on state that they continue (steps.py joins them). The ordinary case is
walk.py's; what is not ordinary is left untouched, for `FlowCore`. A table decides; pulses are asked for, never sent. Never allocates.
"""

from __future__ import annotations

import numpy as np

from pans.runtime.core import stream_kernels as core
from pans.runtime.core.decision import NO_LABEL, DecisionFlag
from pans.runtime.core.window_kernels import sum_up
from pans.runtime.wire import walk as stream
from pans.runtime.wire.bare import load4
from pans.runtime.wire.inner import inner
from pans.runtime.wire.schema import UNKNOWN_TRUTH

from . import columns, kernels
from . import walk as walking
from .settings import WATCHED_FRAMES, Q

P_FIRST, P_LAST, P_CENTRE, P_LEAVE, P_CLICKS, N_PASSAGE = range(6)  # of core.decision.Passage
_GAP, _ABSTAINED, _NOT_FINITE, _AMBIGUOUS, _COINCIDENCE = (
    int(flag)
    for flag in (
        DecisionFlag.GAP,
        DecisionFlag.ABSTAINED,
        DecisionFlag.NOT_FINITE,
        DecisionFlag.AMBIGUOUS,
        DecisionFlag.COINCIDENCE,
    )
)
_U = np.uint64
_NO_LABEL, _UNKNOWN, _OBJECTS = NO_LABEL, UNKNOWN_TRUTH, 0xFFFFFFFF
_HALF, _PART, _WATCHED = 1 << (Q - 1), (1 << Q) - 1, WATCHED_FRAMES


@inner
def take_message(walk, buffer, start, stop):  # type: ignore[no-untyped-def]
    """As core/stream_kernels.py's, of a flow: the message from `start` to `stop`, uint64; TOOK_MARK, TOOK_BLOCK or ODD.

    TOOK_URGENT is a block of which a pulse is asked for.

    A mark is only counted: who compares decisions with the truth looks for it in what was kept.
    """
    state, flow = walk.state, walk.flow
    if stop < start + _U(stream.BODY_HEADER) or load4(buffer, start + _U(4)) != _U(state[core.SESSION]):
        return core.ODD
    if not stream.is_plain(buffer, start):
        return core.ODD
    payload = start + _U(stream.BODY_HEADER)
    if buffer[start] == stream.MARK:
        if not walking.mark_fits(buffer, payload, stop, state):
            return core.ODD
        stream.go_on(state, np.int64(0))
        return core.TOOK_MARK
    if buffer[start] != stream.FRAMES:
        return core.ODD
    count = walking.take_frames(buffer, payload, stop, state, walk.offsets, flow, walk.mask[0])
    if count == 0:
        return core.ODD
    behind = state[stream.NEXT_EXPOSURE]
    origin = state[core.LAST_TICK] - (behind - 1) * state[core.PERIOD_TICKS]
    if flow.limits.size:
        while flow.state[kernels.NEXT] < behind:
            n = kernels.scan(behind, flow.words, flow.counts, flow.limits, flow.state, flow.empty_channels, flow.out)
            for i in range(n):
                _take_passage(walk, flow.out[i], origin)
        if flow.state[kernels.EMPTY_FRAMES] >= state[columns.WATCH_AT]:
            _tell_empty(walk, behind)
    else:
        _take_bars(walk, behind, origin)
        flow.state[kernels.NEXT] = behind
    asks, state[columns.ASKS] = state[columns.ASKS], 0
    return core.TOOK_URGENT if asks else core.TOOK_BLOCK


@inner
def _tell_empty(walk, behind):  # type: ignore[no-untyped-def]
    """Keep what the empty field gave up to here."""
    state, flow = walk.state, walk.flow
    row = walk.empty[state[columns.TOLD] % walk.empty.shape[0]]
    row[0], row[1] = behind, flow.state[kernels.EMPTY_FRAMES]
    for channel in range(flow.empty_channels.size):
        row[2 + channel] = flow.empty_channels[channel]
    state[columns.TOLD] += 1
    state[columns.WATCH_AT] = flow.state[kernels.EMPTY_FRAMES] + _WATCHED


# -- cells -----------------------------------------------------------------------------------------------------------------


@inner
def _take_passage(walk, found, origin):  # type: ignore[no-untyped-def]
    """Decide on a passage, as CellCore does; exposure e ended at `origin` + e periods."""
    flow, state = walk.flow, walk.state
    limits, frames = flow.limits, state[columns.FRAMES]
    first, last, centre = found[kernels.P_FIRST], found[kernels.P_LAST], found[kernels.P_CENTRE]
    flags = 0
    if found[kernels.P_FLAGS] & kernels.BROKEN:
        flags = _GAP
    elif (
        found[kernels.P_FLAGS] & kernels.TOO_LONG
        or last - first >= limits[kernels.LONGEST]
        or kernels.has_two_maxima(
            flow.counts, first, last, limits[kernels.VALLEY_FRAMES], limits[kernels.VALLEY_SIGMA2]
        )
    ):
        flags = _COINCIDENCE
    start = (centre - 128 * (frames - 1) + 128) >> 8
    if state[columns.DARK_CYCLE]:
        dark = start + state[columns.DARK_CYCLE] - 1 - start % state[columns.DARK_CYCLE]
        if dark < start + frames:
            back, ahead = start + frames - dark, dark + 1 - start
            start += -back if back < ahead else ahead
    start = max(0, min(start, flow.state[kernels.NEXT] - frames))
    passage = walk.passages[state[core.N_ROWS]]
    passage[P_FIRST], passage[P_LAST], passage[P_CENTRE] = first, last, (centre + 128) >> 8
    passage[P_LEAVE] = origin + last * state[core.PERIOD_TICKS]
    passage[P_CLICKS] = found[kernels.P_CLICKS]
    _put_row(walk, start, origin + (start + frames - 1) * state[core.PERIOD_TICKS], flags)


# -- a tape ----------------------------------------------------------------------------------------------------------------


@inner
def _take_bars(walk, behind, origin):  # type: ignore[no-untyped-def]
    """Decide on every position whose window ends before exposure `behind`, as TapeCore does."""
    state, flow, period = walk.state, walk.flow, walk.state[core.PERIOD_TICKS]
    frames = state[columns.FRAMES]
    while True:
        start = state[columns.MIDDLE] + ((state[columns.MIDDLE_PART] - (frames - 1) * _HALF + _HALF) >> Q)
        last = start + frames - 1
        if last >= behind:
            return
        pitch = state[columns.PITCH]
        end, since = origin + last * period, max(0, last + 1 - (pitch >> Q))
        passage = walk.passages[state[core.N_ROWS]]
        passage[P_FIRST], passage[P_LAST] = since, last
        passage[P_CENTRE] = state[columns.MIDDLE] + ((state[columns.MIDDLE_PART] + _HALF) >> Q)
        passage[P_LEAVE] = end + (pitch * period >> (Q + 1))
        passage[P_CLICKS] = kernels.total_clicks(flow.counts, since, last + 1)
        state[columns.POSITION] += 1
        if state[columns.TRACK]:
            _follow(walk, start)
        _move_on(state, state[columns.PITCH])
        _put_row(walk, start, end, 0)


@inner
def _move_on(state, by):  # type: ignore[no-untyped-def]
    """Move the middle of the next window by so many 2^-Q exposures."""
    part = state[columns.MIDDLE_PART] + by
    state[columns.MIDDLE] += part >> Q
    state[columns.MIDDLE_PART] = part & _PART


@inner
def _follow(walk, start):  # type: ignore[no-untyped-def]
    """Correct phase and pitch as TapeCore does; exposures count from the window before, so that no number is too long."""
    state, flow, edges, frames = walk.state, walk.flow, walk.edges, walk.state[columns.FRAMES]
    before, middle_before, part_before = (
        state[columns.BEFORE],
        state[columns.BEFORE_MIDDLE],
        state[columns.BEFORE_PART],
    )
    state[columns.BEFORE], state[columns.BEFORE_MIDDLE] = start, state[columns.MIDDLE]
    state[columns.BEFORE_PART] = state[columns.MIDDLE_PART]
    if before < 0:
        return
    kernels.count_edges(flow.words, flow.counts, before, start, frames, edges)
    up, down = edges[0], edges[1]
    if up == 0 or down == 0 or edges[4]:
        return
    between = (frames - 1 + start - before) << (Q - 1)
    found = between + ((edges[3] * up - edges[2] * down) << Q) // (2 * up * down)
    first = ((middle_before - before) << Q) + part_before
    then = ((state[columns.MIDDLE] - before) << Q) + state[columns.MIDDLE_PART]
    limit, nominal = state[columns.PITCH] >> 2, state[columns.NOMINAL_PITCH]
    off = min(max(found - ((first + then) >> 1), -limit), limit)
    _move_on(state, off >> state[columns.TRACK])
    pitch = state[columns.PITCH] + (off >> (2 * state[columns.TRACK] + 2))
    state[columns.PITCH] = min(max(pitch, nominal - (nominal >> 3)), nominal + (nominal >> 3))


# -- one decision ----------------------------------------------------------------------------------------------------------


@inner
def _put_row(walk, first, end, flags):  # type: ignore[no-untyped-def]
    """Decide on the window from exposure `first` on, which ended at tick `end`, as FlowCore does; `flags` why it must not be decided."""
    state, flow, tables, n_row = walk.state, walk.flow, walk.tables, walk.state[core.N_ROWS]
    counts, frames, clicks, crc = walk.counts[n_row], state[columns.FRAMES], np.int64(0), np.uint32(0)
    label, probability, index = np.int64(_NO_LABEL), np.float32(0.0), np.int64(0)
    if not flags & _GAP:
        if kernels.window_clicks(flow.words, flow.counts, first, frames, counts):
            flags |= _GAP
        else:
            clicks, index, crc = sum_up(counts, tables.radix, tables.crc, tables.crc_zero[0])
    if flags == 0:
        label, probability = np.int64(tables.labels[index]), tables.probabilities[index]
        if not probability > 0:
            flags |= _NOT_FINITE
        elif np.float64(probability) < walk.sure[0]:
            flags |= _AMBIGUOUS
    if flags:
        label, flags = np.int64(_NO_LABEL), flags | _ABSTAINED
        state[core.N_ABSTAINED] += 1
    elif walk.gated[label]:
        state[columns.ASKS] = 1
    row = walk.rows[n_row]
    row["index"], row["tick"], row["exposure_index"] = state[core.N_DECISIONS], end, max(0, first + frames - 1)
    row["object"], row["shot"], row["clicks"], row["label"] = state[columns.OBJECTS], 0, clicks, label
    row["truth"], row["flags"], row["probability"] = _UNKNOWN, flags, probability
    row["counts_crc"], row["exposures"] = crc, 0
    state[core.N_DECISIONS] += 1
    state[columns.OBJECTS] = (state[columns.OBJECTS] + 1) & _OBJECTS
    state[core.N_ROWS] += 1
