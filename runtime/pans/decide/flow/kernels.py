"""The kernels of a flow: frames into a ring, onsets and releases, the windows that are decided on, rows of the decision log out.

`take_message` is the kernel's case for a flow (decide/kernel/receive.py); `settle` does the same for frames that `FlowCore` has put into
the ring by itself, behind a gap, say. Whatever is not ordinary, `take_message` leaves untouched. A table decides here; of any other back
end the clicks of the window are kept, and the row waits for its verdict. Nothing is allocated.

The ring holds the last frames by exposure number modulo its length, a power of two: `words` uint64 (ring,) (bit c is channel c) and
`counts` int16 (ring,) clicks, -1 for a dark frame and -2 for one that never came. tests/oracles/naive_flow.py has the loops in plain words.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from pans.base.machine import bare, inner, load4, outer
from pans.bundle.backends import NO_LABEL
from pans.decide.decision import DecisionFlag
from pans.decide.still import kernels as core
from pans.decide.still.kernels import DecisionTables
from pans.decide.still.window_kernels import sum_up
from pans.protocol.tracker import state_dtype
from pans.protocol.wire import NO_OBJECT, UNKNOWN_TRUTH
from pans.protocol.wire import kernels as stream

from .settings import WATCHED_FRAMES, Q

RING_DTYPE = state_dtype(  # what follows the ring; parts of a recording hold it in this order
    (
        "next_exposure",
        "recent_clicks",  # of the onset's window, in as many frames
        "recent_frames",
        "phase",  # IDLE, OPEN or BLIND
        "first",  # frame of the open passage, its clicks, their moment, and BROKEN or TOO_LONG
        "clicks",
        "moment",
        "faults",
        "hold_until",  # no onset before
        "whole_since",  # the exposure from which on no frame is missing
        "empty_frames",
        "dark_frames",
        "busy_at",  # when an object was in sight last
    )
)
IDLE, OPEN, BLIND = 0, 1, 2
# a passage, int64 (N_COLUMNS,): its frames, where it is centred (times 256), clicks, BROKEN or TOO_LONG, the exposure that settled it
P_FIRST, P_LAST, P_CENTRE, P_CLICKS, P_FLAGS, P_RELEASE, N_COLUMNS = range(7)
BROKEN, TOO_LONG = 1, 2
N_EDGES = 5  # figures of count_edges
DARK, NEVER_CAME = -1, -2
# limits, int64: the first eight of settings.FlowLimits
W, ON, OFF, LONGEST, REFRACTORY, BACKGROUND, VALLEY_FRAMES, VALLEY_SIGMA2 = range(8)

W_FIRST, W_LAST, W_CENTRE, W_LEAVE, W_CLICKS, N_PASSAGE = range(6)  # of decision.Passage
_GAP, _ABSTAINED, _NOT_FINITE, _AMBIGUOUS, _COINCIDENCE, _INCOMPLETE = (
    int(DecisionFlag[name]) for name in ("GAP", "ABSTAINED", "NOT_FINITE", "AMBIGUOUS", "COINCIDENCE", "INCOMPLETE")
)
_U = np.uint64
_NO_LABEL, _UNKNOWN, _OBJECTS, _NO_OBJECT = NO_LABEL, UNKNOWN_TRUTH, 0xFFFFFFFF, np.uint64(NO_OBJECT)
_HALF, _PART, _WATCHED = 1 << (Q - 1), (1 << Q) - 1, WATCHED_FRAMES


class FlowArrays(NamedTuple):
    """The ring and what follows it; `limits` is empty where no passages are looked for. `out` are the passages."""

    words: npt.NDArray[np.uint64]
    counts: npt.NDArray[np.int16]
    limits: npt.NDArray[np.int64]
    ring: npt.NDArray[np.void]
    dark_channels: npt.NDArray[np.int64]
    empty_channels: npt.NDArray[np.int64]
    out: npt.NDArray[np.int64]


class FlowWalk(NamedTuple):
    """What the kernel continues of a flow: the state, CORE_DTYPE (1,), the ring, and what comes of each object.

    `offsets` int64 (slots of a cycle,) in ticks; `mask` uint64 (1,) of the channels; `sure` float64 (1,): below it a posterior is
    ambiguous; `gated` uint8 (classes,): of which a pulse is asked. Decisions stand in `rows`, DECISION_DTYPE (m,), in the same place
    their passages int64 (m, 5), in the order of `decision.Passage`, and the clicks of their windows int64 (m, pool, d_f). What the
    empty field gave stands in `empty` int64 (k, 2 + d_f), by its number modulo k: the exposure behind the block, empty frames, clicks of
    each channel, since the run began. `heard` is StreamTracker's.
    """

    state: npt.NDArray[np.void]
    flow: FlowArrays
    offsets: npt.NDArray[np.int64]
    mask: npt.NDArray[np.uint64]
    tables: DecisionTables
    sure: npt.NDArray[np.float64]
    gated: npt.NDArray[np.uint8]
    rows: npt.NDArray[np.void]
    passages: npt.NDArray[np.int64]
    counts: npt.NDArray[np.int64]
    empty: npt.NDArray[np.int64]
    edges: npt.NDArray[np.int64]
    heard: npt.NDArray[np.int64]

    @staticmethod
    def kernel() -> tuple[Any, tuple[str, ...]]:
        """Return the kernel that takes a message; it wants the whole walk before the message."""
        return take_message, ()


@inner
def popcount(word):  # type: ignore[no-untyped-def]
    """Number of bits set in a uint64."""
    n = 0
    while word:
        word &= word - numba.uint64(1)
        n += 1
    return n


@inner
def _tally(word, channels):  # type: ignore[no-untyped-def]
    channel = 0
    while word:
        if word & numba.uint64(1):
            channels[channel] += 1
        word >>= numba.uint64(1)
        channel += 1


@outer
def put_frames(frames, first, words, counts, dark_cycle, ring, dark_channels, channel_mask):  # type: ignore[no-untyped-def]
    """Put frames uint8 (n, bytes), the first one exposure number `first`, into the ring.

    Frames of the plan that are dark are tallied in `dark_channels` int64 (d_f,) instead.
    """
    mask = len(words) - 1
    n_bytes = min(8, frames.shape[1])
    for i in range(frames.shape[0]):
        word = numba.uint64(0)
        for byte in range(n_bytes):
            word |= numba.uint64(frames[i, byte]) << numba.uint64(8 * byte)
        word &= channel_mask
        slot = (first + i) & mask
        if dark_cycle and (first + i) % dark_cycle == dark_cycle - 1:
            ring[0].dark_frames += 1
            _tally(word, dark_channels)
            words[slot], counts[slot] = numba.uint64(0), DARK
        else:
            words[slot], counts[slot] = word, popcount(word)


@outer
def skip_frames(first, stop, words, counts, ring):  # type: ignore[no-untyped-def]
    """Say that exposures `first`..`stop` - 1 never came: the windows start afresh, an open passage is broken."""
    state, mask = ring[0], len(words) - 1
    for exposure in range(max(first, stop - len(words)), stop):
        words[exposure & mask], counts[exposure & mask] = numba.uint64(0), NEVER_CAME
    state.recent_clicks = state.recent_frames = 0
    state.whole_since = state.next_exposure = stop
    if state.phase == OPEN:
        state.faults |= BROKEN


@inner
def _close(state, limits, last, release, flags, row):  # type: ignore[no-untyped-def]
    """Write the open passage into `row`: the centroid is that of the clicks beyond the background's."""
    n = release - state.first + 1
    light = (state.clicks << 16) - limits[BACKGROUND] * n
    moment = (state.moment << 16) - limits[BACKGROUND] * (n * (n - 1) // 2)
    centre = 128 * (last - state.first)
    if light > 0:
        centre = min(max(moment // (light >> 8 if light >> 8 else 1), 0), 256 * n)
    row[P_FIRST], row[P_LAST], row[P_CENTRE] = state.first, last, (state.first << 8) + centre
    row[P_CLICKS], row[P_FLAGS], row[P_RELEASE] = state.clicks, state.faults | flags, release
    state.hold_until = release + 1 + limits[REFRACTORY]


@outer
def scan(stop, words, counts, limits, ring, empty_channels, out):  # type: ignore[no-untyped-def]
    """Follow the click sums over exposures ring[0].next_exposure..stop - 1, which are in the ring; return the number of passages in `out`.

    An onset is a sum of `W` frames of at least `ON` clicks; the release is the first sum of at most `OFF`. A passage holds its frames from
    the first of the onset's to the last of the release's; `last` is the last frame before the quiet ones. Frames further than half the
    longest passage from any object or gap are empty, and tallied in `empty_channels` int64 (d_f,): nearer ones see the faint edges
    of cells. Stops early when `out` is full.
    """
    state, mask = ring[0], len(words) - 1
    n = 0
    width, guard = limits[W], max(limits[W], limits[LONGEST] // 2)
    for exposure in range(state.next_exposure, stop):
        clicks = counts[exposure & mask]
        clicks = clicks if clicks > 0 else 0
        state.recent_clicks += clicks
        if state.recent_frames == width:
            oldest = counts[(exposure - width) & mask]
            state.recent_clicks -= oldest if oldest > 0 else 0
        else:
            state.recent_frames += 1
        if state.phase == OPEN:
            state.clicks += clicks
            state.moment += clicks * (exposure - state.first)
            if state.recent_frames == width and state.recent_clicks <= limits[OFF]:
                _close(state, limits, exposure - width, exposure, 0, out[n])
                state.phase = IDLE
                n += 1
            elif exposure - state.first >= 2 * limits[LONGEST]:
                _close(state, limits, exposure, exposure, TOO_LONG, out[n])
                state.phase = BLIND
                n += 1
        elif state.phase == BLIND:
            if state.recent_frames == width and state.recent_clicks <= limits[OFF]:
                state.phase = IDLE
        elif state.recent_frames == width and state.recent_clicks >= limits[ON] and exposure >= state.hold_until:
            first = exposure - width + 1
            state.phase, state.first, state.clicks, state.moment = OPEN, first, state.recent_clicks, 0
            state.faults = BROKEN if first - state.whole_since < width else 0
            for back in range(width):
                earlier = counts[(first + back) & mask]
                state.moment += back * (earlier if earlier > 0 else 0)
        if state.phase != IDLE:
            state.busy_at = exposure
        empty = exposure - guard
        if state.busy_at < empty - guard and state.whole_since <= empty - guard and counts[empty & mask] >= 0:
            state.empty_frames += 1
            if counts[empty & mask] > 0:
                _tally(words[empty & mask], empty_channels)
        state.next_exposure = exposure + 1
        if n == len(out):
            break
    return n


@outer
def has_two_maxima(counts, first, last, span, sigma2):  # type: ignore[no-untyped-def]
    """Whether the sums over `span` frames between `first` and `last` dip between two maxima by more than chance.

    The dip from the lower maximum is held against its variance, that of a difference of two Poisson counts: dip^2 > sigma2 * sum.
    """
    mask = len(counts) - 1
    total = highest = lowest = 0
    for exposure in range(first, last + 1):
        clicks = counts[exposure & mask]
        total += clicks if clicks > 0 else 0
        if exposure - first >= span:
            left = counts[(exposure - span) & mask]
            total -= left if left > 0 else 0
        if exposure - first + 1 < span:
            continue
        lower = min(highest, total)
        if lower > lowest and (lower - lowest) ** 2 > sigma2 * (lower + lowest):
            return True
        if total > highest:
            highest = lowest = total
        lowest = min(lowest, total)
    return False


@outer
def window_clicks(words, counts, first, shots, out):  # type: ignore[no-untyped-def]
    """Sum the clicks per channel of `shots` frames from exposure `first` on, int64 (d_f,); return how many of them are no light frames."""
    mask = len(words) - 1
    unlit = 0
    out[:] = 0
    for exposure in range(first, first + shots):
        _tally(words[exposure & mask], out)
        unlit += counts[exposure & mask] < 0
    return unlit


@outer
def count_edges(words, counts, before, start, frames, out):  # type: ignore[no-untyped-def]
    """Which bars change between the windows of `frames` exposures from `before` and from `start` on, and what was lit between them.

    out int64 (N_EDGES,): channels that come on, that go off, clicks of the ones and of the others in the exposures in between, and
    how many of all these exposures were dark or never came.
    """
    mask = len(words) - 1
    out[:] = 0
    first, then = numba.uint64(0), numba.uint64(0)
    for k in range(frames):
        first |= words[(before + k) & mask]
        then |= words[(start + k) & mask]
        out[4] += (counts[(before + k) & mask] < 0) + (counts[(start + k) & mask] < 0)
    up, down = then & ~first, first & ~then
    out[0], out[1] = popcount(up), popcount(down)
    for exposure in range(before + frames, start):
        word = words[exposure & mask]
        out[2] += popcount(word & up)
        out[3] += popcount(word & down)
        out[4] += counts[exposure & mask] < 0


@outer
def total_clicks(counts, first, stop):  # type: ignore[no-untyped-def]
    """Clicks of all channels in the light frames from exposure `first` to `stop` - 1."""
    mask = len(counts) - 1
    total = 0
    for exposure in range(first, stop):
        clicks = counts[exposure & mask]
        total += clicks if clicks > 0 else 0
    return total


# -- messages --------------------------------------------------------------------------------------------------------------


@inner
def _take_frames(buffer, payload, stop, facts, slot_offsets, flow, mask):  # type: ignore[no-untyped-def]
    """Put the frames from `payload` to `stop` into the ring and return how many; 0, and nothing done, where they are not ordinary."""
    first = facts.next_exposure
    count, width = stream.next_block(buffer, payload, stop, facts)
    if count == 0 or count > facts.max_block or 8 * width < flow.dark_channels.size:
        return 0
    if flow.ring[0].next_exposure != first:  # the block before was left out: it did not fit the plan
        return 0
    tick, period = stream.block_times(buffer, payload)
    if period != facts.period_ticks or load4(buffer, payload + stream.OBJECT_AT) != _NO_OBJECT:
        return 0
    if tick < core.planned_tick(first, facts, slot_offsets) - period:
        return 0
    frames_at = np.int64(payload) + stream.BLOCK_HEADER
    frames = buffer[frames_at : frames_at + count * width].reshape(count, width)
    put_frames(frames, first, flow.words, flow.counts, facts.dark_every, flow.ring, flow.dark_channels, mask)
    stream.go_on(facts, count)
    core.note_end(tick, count, facts, slot_offsets)
    return count


@inner
def take_message(walk, buffer, start, stop):  # type: ignore[no-untyped-def]
    """As decide/still/kernels.py's, of a flow: the message from `start` to `stop`, uint64; TOOK_MARK, TOOK_BLOCK or ODD.

    TOOK_URGENT is a block of which a pulse is asked for.

    A mark is only counted: who compares decisions with the truth looks for it in what was kept. One of a passage that may have been marked
    before is ODD.
    """
    state, payload = walk.state[0], start + _U(stream.BODY_HEADER)
    if not core.is_ours(buffer, start, stop, state):
        return core.ODD
    if buffer[start] == stream.MARK:
        if not stream.is_next_mark(buffer, payload, stop, state):
            return core.ODD
        if not stream.mark_fits(buffer, payload, state, state.n_classes):
            return core.ODD
        number = np.int64(load4(buffer, payload + stream.MARK_OBJECT_AT))
        if number < state.marked:
            return core.ODD
        state.marked = number + 1
        stream.go_on(state, np.int64(0))
        return core.TOOK_MARK
    if buffer[start] != stream.FRAMES:
        return core.ODD
    count = _take_frames(buffer, payload, stop, state, walk.offsets, walk.flow, walk.mask[0])
    if count == 0:
        return core.ODD
    behind = state.next_exposure
    _settle(walk, behind, state.last_tick - (behind - 1) * state.period_ticks, 0)
    asks, state.asks = state.asks, 0
    return core.TOOK_URGENT if asks else core.TOOK_BLOCK


@outer
def settle(walk, behind, origin, flags):  # type: ignore[no-untyped-def]
    """Decide on what exposures before `behind`, in the ring, settle; exposure e ended at tick `origin` + e periods.

    With `flags` above 0 all of it is given up for that reason. False when the rows were full first: call again.
    """
    return _settle(bare(walk), behind, origin, flags)


@inner
def _settle(walk, behind, origin, flags):  # type: ignore[no-untyped-def]
    flow = walk.flow
    if not flow.limits.size:
        if not _take_bars(walk, behind, origin, flags):
            return False
        if not flags:
            flow.ring[0].next_exposure = behind
        return True
    while flow.ring[0].next_exposure < behind:
        if walk.state[0].n_rows + flow.out.shape[0] > walk.rows.size:
            return False
        n = scan(behind, flow.words, flow.counts, flow.limits, flow.ring, flow.empty_channels, flow.out)
        for i in range(n):
            _take_passage(walk, flow.out[i], origin)
    if flow.ring[0].empty_frames >= walk.state[0].watch_at:
        _tell_empty(walk, behind)
    return True


@outer
def close_passage(walk, last_tick):  # type: ignore[no-untyped-def]
    """Give up the passage that is open at the end of a stream, whose last exposure ended at `last_tick`."""
    walk = bare(walk)
    ring, state = walk.flow.ring[0], walk.state[0]
    if walk.flow.limits.size == 0 or ring.phase != OPEN:
        return
    first, last = ring.first, ring.next_exposure - 1
    passage = walk.passages[state.n_rows]
    passage[W_FIRST], passage[W_LAST], passage[W_CENTRE] = first, last, (first + last) // 2
    passage[W_LEAVE], passage[W_CLICKS] = last_tick, ring.clicks
    _put_row(walk, max(0, last + 1 - state.frames), last_tick, _INCOMPLETE)
    ring.phase = IDLE


@inner
def _tell_empty(walk, behind):  # type: ignore[no-untyped-def]
    """Keep what the empty field gave up to here."""
    state, flow = walk.state[0], walk.flow
    row = walk.empty[state.told % walk.empty.shape[0]]
    row[0], row[1] = behind, flow.ring[0].empty_frames
    for channel in range(flow.empty_channels.size):
        row[2 + channel] = flow.empty_channels[channel]
    state.told += 1
    state.watch_at = flow.ring[0].empty_frames + _WATCHED


# -- cells -----------------------------------------------------------------------------------------------------------------


@inner
def _take_passage(walk, found, origin):  # type: ignore[no-untyped-def]
    """Decide on a passage, of a cell; exposure e ended at `origin` + e periods."""
    flow, state = walk.flow, walk.state[0]
    limits, frames = flow.limits, state.frames
    first, last, centre = found[P_FIRST], found[P_LAST], found[P_CENTRE]
    flags = 0
    if found[P_FLAGS] & BROKEN:
        flags = _GAP
    elif (
        found[P_FLAGS] & TOO_LONG
        or last - first >= limits[LONGEST]
        or has_two_maxima(flow.counts, first, last, limits[VALLEY_FRAMES], limits[VALLEY_SIGMA2])
    ):
        flags = _COINCIDENCE
    start = (centre - 128 * (frames - 1) + 128) >> 8
    if state.dark_every:
        dark = start + state.dark_every - 1 - start % state.dark_every
        if dark < start + frames:
            back, ahead = start + frames - dark, dark + 1 - start
            start += -back if back < ahead else ahead
    start = max(0, min(start, flow.ring[0].next_exposure - frames))
    passage = walk.passages[state.n_rows]
    passage[W_FIRST], passage[W_LAST], passage[W_CENTRE] = first, last, (centre + 128) >> 8
    passage[W_LEAVE] = origin + last * state.period_ticks
    passage[W_CLICKS] = found[P_CLICKS]
    _put_row(walk, start, origin + (start + frames - 1) * state.period_ticks, flags)


# -- a tape ----------------------------------------------------------------------------------------------------------------


@inner
def _take_bars(walk, behind, origin, flags):  # type: ignore[no-untyped-def]
    """Decide on every position whose window ends before exposure `behind`; with `flags` none is decided. False when the rows are full."""
    state, flow = walk.state[0], walk.flow
    frames, period = state.frames, state.period_ticks
    while True:
        start = state.middle + ((state.middle_part - (frames - 1) * _HALF + _HALF) >> Q)
        last = start + frames - 1
        if last >= behind:
            return True
        if state.n_rows == walk.rows.size:
            return False
        pitch = state.pitch
        end, since = origin + last * period, max(0, last + 1 - (pitch >> Q))
        passage = walk.passages[state.n_rows]
        passage[W_FIRST], passage[W_LAST] = since, last
        passage[W_CENTRE] = state.middle + ((state.middle_part + _HALF) >> Q)
        part = pitch & _PART  # of an exposure; times the period it may be longer than a number
        ticks = (pitch >> Q) * period + (((part >> 16) * period + ((part & 0xFFFF) * period >> 16)) >> (Q - 16))
        passage[W_LEAVE] = end + (ticks >> 1)
        passage[W_CLICKS] = 0 if flags else total_clicks(flow.counts, since, last + 1)
        state.position += 1
        if state.track:
            _follow(walk, start, flags != 0)
        _move_on(state, state.pitch)
        _put_row(walk, start, end, flags)


@inner
def _move_on(state, by):  # type: ignore[no-untyped-def]
    """Move the middle of the next window by so many 2^-Q exposures."""
    part = state.middle_part + by
    state.middle += part >> Q
    state.middle_part = part & _PART


@inner
def _follow(walk, start, lost):  # type: ignore[no-untyped-def]
    """Correct phase and pitch by the bars that changed between the window before and the one at `start`, if they are known.

    A phase-locked loop of second order, directed by decisions: a channel whose bar changes tells when, by how many of the exposures in
    between were lit. Bars that come on are seen too early, since little light is enough for a click, and bars that go off too late by as
    much; the mean of both is the edge. Each edge moves the next window by 2^-track of what it is off and the pitch by 2^-(2 track + 2):
    critical damping. Exposures count from the window before, so that no number is too long.
    """
    state, flow, edges = walk.state[0], walk.flow, walk.edges
    before, middle_before, part_before = state.before, state.before_middle, state.before_part
    state.before, state.before_middle = np.int64(-1) if lost else start, state.middle
    state.before_part = state.middle_part
    if lost or before < 0:
        return
    count_edges(flow.words, flow.counts, before, start, state.frames, edges)
    up, down = edges[0], edges[1]
    if up == 0 or down == 0 or edges[4]:
        return
    between = (state.frames - 1 + start - before) << (Q - 1)
    found = between + ((edges[3] * up - edges[2] * down) << Q) // (2 * up * down)
    first = ((middle_before - before) << Q) + part_before
    then = ((state.middle - before) << Q) + state.middle_part
    limit, nominal = state.pitch >> 2, state.nominal_pitch
    off = min(max(found - ((first + then) >> 1), -limit), limit)
    _move_on(state, off >> state.track)
    pitch = state.pitch + (off >> (2 * state.track + 2))
    state.pitch = min(max(pitch, nominal - (nominal >> 3)), nominal + (nominal >> 3))


# -- one decision ----------------------------------------------------------------------------------------------------------


@inner
def _put_row(walk, first, end, flags):  # type: ignore[no-untyped-def]
    """Decide on the windows from exposure `first` on, which ended at tick `end`; `flags` why they must not be decided."""
    state, flow, tables = walk.state[0], walk.flow, walk.tables
    n_row = state.n_rows
    counts, clicks, crc, unlit = walk.counts[n_row], np.int64(0), np.uint32(0), 0
    label, probability, index = np.int64(_NO_LABEL), np.float32(0.0), np.int64(0)
    if not flags & _GAP:
        shots = state.frames // counts.shape[0]
        for window in range(counts.shape[0]):
            unlit += window_clicks(flow.words, flow.counts, first + window * shots, shots, counts[window])
        if unlit:
            flags |= _GAP
        elif counts.shape[0] == 1:
            clicks, index, crc = sum_up(counts[0], tables.radix, tables.crc, tables.crc_zero[0])
    if flags == 0 and tables.labels.size:
        label, probability = np.int64(tables.labels[index]), tables.probabilities[index]
        if not probability > 0:
            flags |= _NOT_FINITE
        elif np.float64(probability) < walk.sure[0] or label == _NO_LABEL:
            flags |= _AMBIGUOUS
    if flags:
        label, flags = np.int64(_NO_LABEL), flags | _ABSTAINED
        state.n_abstained += 1
    elif tables.labels.size == 0 or walk.gated[label]:
        state.asks = 1
    row = walk.rows[n_row]
    row["index"], row["tick"], row["exposure_index"] = state.n_decisions, end, max(0, first + state.frames - 1)
    row["object"], row["shot"], row["clicks"], row["label"] = state.objects, 0, clicks, label
    row["truth"], row["flags"], row["probability"] = _UNKNOWN, flags, probability
    row["counts_crc"], row["exposures"] = crc, 0
    state.n_decisions += 1
    state.objects = (state.objects + 1) & _OBJECTS
    state.n_rows += 1
