"""One decision at a time as the loop's kernel has it: every call timed by itself, from inside compiled code.

Owns the clock that compiled code can read and the loop around a call; the rows are bench_decide.py's. Both clock readings are within the
time of a call, as they are where Python times a call; what they cost is told beside it.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pans.runtime.decide.kernels import float_run
from pans.runtime.decide.mlp import SparseDecider

from .rows import Row, percentiles_us

CLOCK_MONOTONIC = 1  # on Linux: time.perf_counter_ns reads the same


def alone_row(decider: SparseDecider, counts: NDArray[np.int64], shots: int) -> Row:
    """Percentiles of single decisions on counts (n, d_f) in wall time, us, and `clock_us`, what reading the clock costs in each."""
    run = _timed_calls()
    if run is None:
        return {"skipped": "this system has no clock_gettime"}
    times, clock = np.zeros(len(counts), np.int64), np.zeros(len(counts), np.int64)
    out = np.empty((1, decider.n_classes), np.float32), np.empty(1, np.uint16), np.empty(1, np.float32)
    labels = np.zeros(len(counts), np.uint16)
    spec = np.zeros(2, np.int64)
    for _ in range(2):  # the first time compiles
        run(counts, shots, *decider.layers, decider.room, *out, (spec, times, clock, labels))
    return {
        **percentiles_us(times),
        "clock_us": percentiles_us(clock)["p50_us"],
        "checksum": int(labels.sum(dtype=np.int64)),
    }


@cache
def _timed_calls() -> Any:
    try:
        gettime = ctypes.CDLL(None).clock_gettime
    except (AttributeError, TypeError, OSError):
        return None
    gettime.argtypes, gettime.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_int

    @njit
    def now_ns(spec):  # type: ignore[no-untyped-def]
        gettime(CLOCK_MONOTONIC, spec.ctypes)
        return spec[0] * 1_000_000_000 + spec[1]

    @njit
    def timed_calls(counts, shots, meta, numbers, room, scores, labels, probabilities, book):  # type: ignore[no-untyped-def]
        spec, times, clock, decided = book
        for i in range(counts.shape[0]):
            start = now_ns(spec)
            float_run(counts[i : i + 1], shots, meta, numbers, room, scores, labels, probabilities)
            times[i] = now_ns(spec) - start
            decided[i] = labels[0]
            start = now_ns(spec)
            clock[i] = now_ns(spec) - start

    return timed_calls
