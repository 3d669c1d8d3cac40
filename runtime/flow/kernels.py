"""The compiled kernels of a flow: frames into a ring, onsets and releases, two maxima, the clicks of a window.

Owns the loops over frames; keeps no state of its own and allocates nothing. Each kernel has a twin in plain loops in
tests/naive_flow.py. The ring holds the last frames by exposure number modulo its length, a power of two: `words` uint64 (ring,) (bit c
is channel c) and `counts` int16 (ring,) clicks, -1 for a dark frame and -2 for one that never came.
"""

from __future__ import annotations

import numba

from pans.runtime.wire.inner import inner, outer

# state, int64 (N_STATE,)
(
    NEXT,
    SUM,
    SEEN,
    STATE,
    FIRST,
    CLICKS,
    MOMENT,
    FLAGS,
    HOLD,
    WHOLE_SINCE,
    EMPTY_FRAMES,
    DARK_FRAMES,
    BUSY,
    N_STATE,
) = range(14)
IDLE, OPEN, BLIND = 0, 1, 2
# a passage, int64 (N_COLUMNS,): its frames, where it is centred (times 256), clicks, BROKEN or TOO_LONG, the exposure that settled it
P_FIRST, P_LAST, P_CENTRE, P_CLICKS, P_FLAGS, P_RELEASE, N_COLUMNS = range(7)
BROKEN, TOO_LONG = 1, 2
N_EDGES = 5  # figures of count_edges
DARK, NEVER_CAME = -1, -2
# limits, int64: the first eight of flow_settings.FlowLimits, then the frames of a cycle that ends with a dark one (0: none does)
W, ON, OFF, LONGEST, REFRACTORY, BACKGROUND, VALLEY_FRAMES, VALLEY_SIGMA2, DARK_CYCLE, N_LIMITS = range(10)


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
def put_frames(frames, first, words, counts, dark_cycle, state, dark_channels, channel_mask):  # type: ignore[no-untyped-def]
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
            state[DARK_FRAMES] += 1
            _tally(word, dark_channels)
            words[slot], counts[slot] = numba.uint64(0), DARK
        else:
            words[slot], counts[slot] = word, popcount(word)


@outer
def skip_frames(first, stop, words, counts, state):  # type: ignore[no-untyped-def]
    """Say that exposures `first`..`stop` - 1 never came: the windows start afresh, an open passage is broken."""
    mask = len(words) - 1
    for exposure in range(max(first, stop - len(words)), stop):
        words[exposure & mask], counts[exposure & mask] = numba.uint64(0), NEVER_CAME
    state[SUM] = state[SEEN] = 0
    state[WHOLE_SINCE] = state[NEXT] = stop
    if state[STATE] == OPEN:
        state[FLAGS] |= BROKEN


@inner
def _close(state, limits, last, release, flags, row):  # type: ignore[no-untyped-def]
    """Write the open passage into `row`: the centroid is that of the clicks beyond the background's."""
    n = release - state[FIRST] + 1
    light = (state[CLICKS] << 16) - limits[BACKGROUND] * n
    moment = (state[MOMENT] << 16) - limits[BACKGROUND] * (n * (n - 1) // 2)
    centre = 128 * (last - state[FIRST])
    if light > 0:
        centre = min(max(moment // (light >> 8 if light >> 8 else 1), 0), 256 * n)
    row[P_FIRST], row[P_LAST], row[P_CENTRE] = state[FIRST], last, (state[FIRST] << 8) + centre
    row[P_CLICKS], row[P_FLAGS], row[P_RELEASE] = state[CLICKS], state[FLAGS] | flags, release
    state[HOLD] = release + 1 + limits[REFRACTORY]


@outer
def scan(stop, words, counts, limits, state, empty_channels, out):  # type: ignore[no-untyped-def]
    """Follow the click sums over exposures state[NEXT]..stop - 1, which are in the ring; return the number of passages in `out`.

    An onset is a sum of `W` frames of at least `ON` clicks; the release is the first sum of at most `OFF`. A passage holds its frames from
    the first of the onset's to the last of the release's; `last` is the last frame before the quiet ones. Frames further than half the
    longest passage from any object or gap are empty, and tallied in `empty_channels` int64 (d_f,): nearer ones see the faint edges
    of cells. Stops early when `out` is full.
    """
    mask = len(words) - 1
    n = 0
    width, guard = limits[W], max(limits[W], limits[LONGEST] // 2)
    for exposure in range(state[NEXT], stop):
        clicks = counts[exposure & mask]
        clicks = clicks if clicks > 0 else 0
        state[SUM] += clicks
        if state[SEEN] == width:
            oldest = counts[(exposure - width) & mask]
            state[SUM] -= oldest if oldest > 0 else 0
        else:
            state[SEEN] += 1
        if state[STATE] == OPEN:
            state[CLICKS] += clicks
            state[MOMENT] += clicks * (exposure - state[FIRST])
            if state[SEEN] == width and state[SUM] <= limits[OFF]:
                _close(state, limits, exposure - width, exposure, 0, out[n])
                state[STATE] = IDLE
                n += 1
            elif exposure - state[FIRST] >= 2 * limits[LONGEST]:
                _close(state, limits, exposure, exposure, TOO_LONG, out[n])
                state[STATE] = BLIND
                n += 1
        elif state[STATE] == BLIND:
            if state[SEEN] == width and state[SUM] <= limits[OFF]:
                state[STATE] = IDLE
        elif state[SEEN] == width and state[SUM] >= limits[ON] and exposure >= state[HOLD]:
            first = exposure - width + 1
            state[STATE], state[FIRST], state[CLICKS], state[MOMENT] = OPEN, first, state[SUM], 0
            state[FLAGS] = BROKEN if first - state[WHOLE_SINCE] < width else 0
            for back in range(width):
                earlier = counts[(first + back) & mask]
                state[MOMENT] += back * (earlier if earlier > 0 else 0)
        if state[STATE] != IDLE:
            state[BUSY] = exposure
        empty = exposure - guard
        if state[BUSY] < empty - guard and state[WHOLE_SINCE] <= empty - guard and counts[empty & mask] >= 0:
            state[EMPTY_FRAMES] += 1
            if counts[empty & mask] > 0:
                _tally(words[empty & mask], empty_channels)
        state[NEXT] = exposure + 1
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
