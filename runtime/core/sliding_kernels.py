"""The compiled kernels of sliding windows: the last K frames of a stream, in the same few operations whatever K is.

Owns the loops; never allocates and never knows of gaps (sliding.py starts a window afresh after one). Every kernel takes the frames of one
piece behind the K frames before them, so that a frame that leaves the window is simply read again. Sums are integers: nothing drifts.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from .stream_kernels import SPREAD

_U = np.uint64
_LANE, _EIGHT = _U(0xFF), _U(8)


@njit(cache=True, nogil=True)
def slide_index(words, shots, parts, index, labels, out):  # type: ignore[no-untyped-def]
    """Label every window of `shots` frames from a table of counts; return the index of the last one.

    words uint16 (shots + n,), of which the first `shots` are already in `index`; parts int64 (2, 256): what each byte of a word adds to
    the row of the table; labels uint16 (rows,) and out uint16 (n,).
    """
    low, high = parts[0], parts[1]
    n = out.size
    fresh = words[shots:]
    for i in range(n):
        new, old = fresh[i], words[i]
        index += (low[new & 0xFF] + high[new >> 8]) - (low[old & 0xFF] + high[old >> 8])
        out[i] = labels[index]
    return index


@njit(cache=True, nogil=True)
def slide_scores(words, shots, table, sums, n_classes, out):  # type: ignore[no-untyped-def]
    """Label every window of `shots` frames by the sum of its frames' class scores; ties go to the lowest label.

    words uint16 (shots + n,), of which the first `shots` are already in `sums`; table int32 (2**d_f, 16 or a multiple): fixed-point scores
    whose sum over a window stays in int32; sums int32 (columns,), out uint16 (n,). Columns beyond n_classes are padding.
    """
    columns = table.shape[1]
    fresh = words[shots:]
    for i in range(out.size):
        new, old = fresh[i], words[i]
        for k in range(columns):
            sums[k] += table[new, k] - table[old, k]
        best, label = sums[0], 0
        for k in range(1, n_classes):
            label = k if sums[k] > best else label
            best = max(best, sums[k])
        out[i] = label


@njit(cache=True, nogil=True)
def slide_counts(words, shots, lanes, stride, phase, out):  # type: ignore[no-untyped-def]
    """Keep the clicks per channel of the last `shots` <= 255 frames; write them out after every `stride`-th frame; return the new phase.

    words uint8 (shots + n, bytes), of which the first `shots` are already in `lanes`, uint64 (bytes,), a byte per channel; phase: frames
    since the last output; out uint8 ((phase + n) // stride, channels).
    """
    n_bytes, n_channels, row = lanes.size, out.shape[1], 0
    for i in range(words.shape[0] - shots):
        for p in range(n_bytes):
            lanes[p] = (lanes[p] - SPREAD[words[i, p]]) + SPREAD[words[i + shots, p]]
        phase += 1
        if phase == stride:
            phase = 0
            for p in range(n_bytes):
                lane = lanes[p]
                for channel in range(8 * p, min(8 * p + 8, n_channels)):
                    out[row, channel] = lane & _LANE
                    lane >>= _EIGHT
            row += 1
    return phase


@njit(cache=True, nogil=True)
def slide_objects(words, objects, parts, rings, state, labels, no_label, out):  # type: ignore[no-untyped-def]
    """As `slide_index` for several objects at once, each with its own window.

    words uint16 (n,), objects int32 (n,): whose frame it is; rings uint16 (objects, shots): the last frames of each; state int64
    (objects, 3): index, place in the ring, frames seen up to `shots`. A window that is not full yet gives `no_label`.
    """
    low, high, shots = parts[0], parts[1], rings.shape[1]
    for i in range(words.size):
        which, new = objects[i], words[i]
        place = state[which, 1]
        index = state[which, 0] + (low[new & 0xFF] + high[new >> 8])
        if state[which, 2] == shots:
            old = rings[which, place]
            index -= low[old & 0xFF] + high[old >> 8]
        else:
            state[which, 2] += 1
        rings[which, place] = new
        state[which, 0] = index
        state[which, 1] = 0 if place + 1 == shots else place + 1
        out[i] = labels[index] if state[which, 2] == shots else no_label
