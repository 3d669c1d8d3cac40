"""The timing contract: latency histograms per stage, deadlines, and the real-time set-up of the process.

Owns how time is judged, never what is done about it. Latencies count from the device's tick, not from when the host got around to
looking, so a stalled host cannot hide its own delay (coordinated omission). `LatencyHistogram.summary` returns microseconds;
`arm_realtime` returns what was asked for against what was granted.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
import threading
from array import array
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .page_faults import held_heap

I64 = NDArray[np.int64]

SUB_BITS = 5  # 32 steps per octave: a quantile is at most 3.2 % above the true value
N_BUCKETS = 64 << SUB_BITS
SWITCH_INTERVAL_S = 0.0005
FIFO_PRIORITY = 10
MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4


class LatencyHistogram:
    """Log-linear counts of durations in ns; integer, exact maximum, no allocation in `add`."""

    def __init__(self) -> None:
        self.counts = array("q", bytes(8 * N_BUCKETS))
        self.numbers = np.frombuffer(self.counts, np.int64)  # the same, as an array
        self.total = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one duration; negative ones (clock uncertainty) count as 0."""
        value = duration_ns if duration_ns > 0 else 0
        shift = max(value.bit_length() - SUB_BITS - 1, 0)
        self.counts[(shift << SUB_BITS) + (value >> shift)] += 1
        self.total += 1
        if value > self.max_ns:
            self.max_ns = value

    def add_many(self, durations_ns: I64, counts: I64 | int = 1) -> None:
        """Count durations below 2^53 ns, int64 (n,), each `counts` times, as `add` does one."""
        if not len(durations_ns):
            return
        values = np.maximum(durations_ns, 0)
        shift = np.maximum(np.frexp(values.astype(np.float64))[1] - SUB_BITS - 1, 0)
        np.add.at(self.numbers, (shift << SUB_BITS) + (values >> shift), counts)
        self.total += int(np.sum(np.broadcast_to(counts, values.shape)))
        self.max_ns = max(self.max_ns, int(values.max()))

    def quantile_ns(self, q: float) -> int:
        """Return the upper edge of the bucket that holds quantile `q` (never above the exact maximum); 0 without data."""
        wanted = max(1, -int(-q * self.total // 1))
        seen = 0
        for bucket, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted:
                return min(upper_edge(bucket), self.max_ns)
        return 0

    def summary(self) -> dict[str, float]:
        """Return {p50, p99, p999, max} in microseconds."""
        edges = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        return {name: self.quantile_ns(q) / 1000 for name, q in edges.items()} | {"max": self.max_ns / 1000}


def upper_edge(bucket: int) -> int:
    """Return the longest duration in ns that a bucket of LatencyHistogram counts."""
    if bucket < 2 << SUB_BITS:
        return bucket
    shift = (bucket >> SUB_BITS) - 1
    return ((bucket - (shift << SUB_BITS) + 1) << shift) - 1


STAGES = ("link", "decode", "decide", "record")


@dataclass(slots=True)
class TimingLedger:
    """Latencies per stage and in total, late decisions and the stage that took longest in each (JSON: `blame`).

    link: end of the last exposure (device tick, converted) -> bytes read; decode: -> message ready; decide: -> decision made;
    record: -> handed to the recorder. A decision is late when its total, less the clock's uncertainty, exceeds the deadline.
    """

    deadline_ns: int
    total: LatencyHistogram = field(default_factory=LatencyHistogram)
    stages: dict[str, LatencyHistogram] = field(default_factory=lambda: {name: LatencyHistogram() for name in STAGES})
    late: int = 0
    blame: dict[str, int] = field(default_factory=dict)
    worst_uncertainty_ns: int = 0

    def judge(self, marks_ns: I64, uncertainty_ns: I64, counts: I64) -> NDArray[np.bool_]:
        """Count decisions and return which are late, bool (n,); `counts` of them share each row.

        marks_ns (n, 5): device end, arrival, decoded, decided, recorded; uncertainty_ns (n,): of the device end.
        """
        steps = np.diff(marks_ns, axis=1)
        latency = marks_ns[:, 3] - marks_ns[:, 0]
        for histogram, durations in zip((*self.stages.values(), self.total), (*steps.T, latency)):
            histogram.add_many(durations, counts)
        self.worst_uncertainty_ns = max(self.worst_uncertainty_ns, int(uncertainty_ns.max(initial=0)))
        late: NDArray[np.bool_] = latency - uncertainty_ns > self.deadline_ns
        self.late += int(counts[late].sum())
        for slowest, count in zip(steps[late, :3].argmax(axis=1).tolist(), counts[late].tolist()):
            self.blame[STAGES[slowest]] = self.blame.get(STAGES[slowest], 0) + count
        return late


class _Heap:
    """Whether a caller has frozen what this process holds; the interpreter would count every object to say so."""

    frozen = False


_heap = _Heap()


@contextmanager
def frozen_heap() -> Iterator[None]:
    """Freeze what this process has loaded, for many short runs: none of them looks for garbage in it, which takes 50 to 100 ms."""
    gc.collect()
    gc.freeze()
    _heap.frozen = True
    try:
        yield
    finally:
        _heap.frozen = False
        gc.unfreeze()


@contextmanager
def arm_realtime(wanted: bool, other_threads: Sequence[int] = ()) -> Iterator[dict[str, Any]]:
    """Ask for a steady process while the loop runs; yield {what: "granted" or the reason why not}, undo it afterwards.

    The garbage collector is frozen and switched off in any case: a collection costs milliseconds with numba loaded. With `wanted`,
    SCHED_FIFO (for this thread and `other_threads`, by native id) and locked memory are asked for; both need privileges, and
    neither is needed to be correct. Locked is what has been touched, and what will be: libraries that the loop never calls stay out.
    The interpreter's other threads that are there go one step below: whoever holds the interpreter must not wait for the rest of the
    machine, since the loop may be waiting for it.
    """
    granted: dict[str, Any] = {}
    interval = sys.getswitchinterval()
    if gc.isenabled():  # else all is as it was loaded, and to look through it takes 50 ms
        gc.collect()
    if not _heap.frozen:
        gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    granted["gc_off"] = "granted"
    granted["switch_interval_s"] = SWITCH_INTERVAL_S
    threads, held = [0, *other_threads], ExitStack()
    try:
        if wanted:
            granted["sched_fifo"] = request_fifo(threads)
            if granted["sched_fifo"] == "granted":
                threads += _raised(threads)
            granted["mlockall"] = request_mlockall()
            granted["heap_touched"] = held.enter_context(held_heap())
        yield granted
    finally:
        held.close()
        sys.setswitchinterval(interval)
        gc.enable()
        if not _heap.frozen:
            gc.unfreeze()
        if granted.get("sched_fifo") == "granted":
            for thread in threads:
                with suppress(ProcessLookupError):  # a thread that has ended needs nothing
                    _set_scheduler([thread], "SCHED_OTHER", 0)
        if granted.get("mlockall") == "granted":
            ctypes.CDLL(None).munlockall()


def request_fifo(threads: Sequence[int]) -> str:
    """Ask for SCHED_FIFO for `threads` (native ids, 0 for the calling one); return "granted" or the reason why not."""
    if not hasattr(os, "sched_setscheduler"):
        return "this system has no SCHED_FIFO"
    try:
        _set_scheduler(threads, "SCHED_FIFO", FIFO_PRIORITY)
    except OSError as error:
        return f"refused: {error.strerror}"
    return "granted"


def _raised(threads: Sequence[int]) -> list[int]:
    """Put the interpreter's threads of ordinary priority, but for `threads`, one step below these; return which."""
    found = []
    for thread in threading.enumerate():
        number = thread.native_id
        if number is None or number in (*threads, threading.get_native_id()):
            continue
        with suppress(OSError):  # it has ended
            if os.sched_getscheduler(number) == os.SCHED_OTHER:
                _set_scheduler([number], "SCHED_FIFO", FIFO_PRIORITY - 1)
                found.append(number)
    return found


def _set_scheduler(threads: Sequence[int], policy: str, priority: int) -> None:
    for thread in threads:
        os.sched_setscheduler(thread, getattr(os, policy), os.sched_param(priority))


def request_mlockall() -> str:
    """Ask for all memory of this process to stay resident; return "granted" or the reason why not."""
    if sys.platform != "linux":
        return "not asked for on this system"
    libc = ctypes.CDLL(None, use_errno=True)
    # Without ONFAULT (Linux 4.4), the whole of LLVM and every thread's stack are read into memory: 190 MiB become 440.
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) == 0:
        return "granted"
    return f"refused: {os.strerror(ctypes.get_errno())}"
