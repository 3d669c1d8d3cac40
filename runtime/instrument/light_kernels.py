"""The compiled kernel of the light watch: the clicks of many decisions at once.

Owns the twin of `LightWatch.take` up to where something is to be done: a baseline may be known, or a sum has passed its threshold.
light_level.py owns what is done then. Never allocates.
"""

from __future__ import annotations

import math

import numpy as np

from pans.runtime.wire.inner import inner, outer

# counts, int64 (N_COUNTS,): LightWatch's own, by their names there; decisions, batches and clicks when each sum last was 0
DECISIONS, CLICKS, IN_BATCH, N, SUM, SQUARES, BATCHES, TOTAL, FALL, RISE, BATCH, N_COUNTS = *range(9), 11, 14, 15
# levels, float64 (N_LEVELS,): the two sums; of the baseline mean, slack and threshold; before it, its least error and batches
LOW, HIGH, MEAN, SLACK, THRESHOLD, ERROR, LEAST, MOST, N_LEVELS = range(9)
_U = np.uint64
ALL_TAKEN, LEARNT, FELL, ROSE = range(4)  # why a call ended


@outer
def take_clicks(rows, numbers, left_out, first, counts, levels):  # type: ignore[no-untyped-def]
    """Take decisions from `first` on, but those with one of the flags `left_out`; return where it ended, behind which, and why.

    Decision i is rows[numbers[i]]; numbers uint32 (n,). Rows have fields `clicks` and `flags`, uint32: rows, since numba tells a column of
    one from a column of many. LEARNT: the batches
    so far may make a baseline (levels[MEAN] is NaN without one). FELL, ROSE: that sum has passed the threshold; the other one has not
    been looked at, if it is the later.
    """
    clicks, flags, batch = rows["clicks"], rows["flags"], counts[BATCH]
    i, total, taken = np.int64(first), counts[CLICKS], counts[IN_BATCH]
    while i < numbers.size:
        begun = taken
        if not left_out:  # no need to look at the flags
            stop = min(i + batch - taken, numbers.size)
            for k in range(_U(i), _U(stop)):
                total += np.int64(clicks[numbers[k]])
            i, taken = stop, taken + stop - i
        while i < numbers.size and taken < batch:
            if not flags[numbers[i]] & left_out:
                total += np.int64(clicks[numbers[i]])
                taken += 1
            i += 1
        counts[DECISIONS] += taken - begun
        counts[CLICKS], counts[IN_BATCH] = total, taken
        if taken < batch:
            break
        counts[CLICKS], counts[IN_BATCH] = 0, 0
        if math.isnan(levels[MEAN]):
            if _learn(total, counts, levels):
                return i, LEARNT
        else:
            why = _compare(total, counts, levels)
            if why != ALL_TAKEN:
                return i, why
        total, taken = np.int64(0), np.int64(0)
    return np.int64(numbers.size), ALL_TAKEN


@inner
def _learn(total, counts, levels):  # type: ignore[no-untyped-def]
    """Add a batch; whether its mean is known well enough."""
    counts[N] += 1
    counts[SUM] += total
    counts[SQUARES] += total * total
    n = counts[N]
    if n < levels[LEAST]:
        return False
    mean = counts[SUM] / n
    variance = (counts[SQUARES] - counts[SUM] * mean) / (n - 1)
    error = math.sqrt(max(variance, mean, 1.0)) / math.sqrt(n)
    return mean > 0 and (error <= levels[ERROR] * mean or n >= levels[MOST])


@inner
def _compare(total, counts, levels):  # type: ignore[no-untyped-def]
    """Add a batch to both sums; which of them has passed."""
    counts[BATCHES] += 1
    counts[TOTAL] += total
    levels[LOW] = max(0.0, levels[LOW] + levels[MEAN] - total - levels[SLACK])
    levels[HIGH] = max(0.0, levels[HIGH] + total - levels[MEAN] - levels[SLACK])
    for side in range(2):
        since = FALL if side == 0 else RISE
        if levels[LOW + side] == 0.0:
            counts[since], counts[since + 1], counts[since + 2] = counts[DECISIONS], counts[BATCHES], counts[TOTAL]
        elif levels[LOW + side] >= levels[THRESHOLD]:
            return FELL + side
    return ALL_TAKEN
