"""The computer around a run: the space left on the disk of the recording, and whether the computer's own clock was set.

A thread looks every EVERY_S. What it finds stands in `facts`, what is to be noted comes out of `news`, and a run must stop before its disk
is full. The loop takes the news; it never waits for a look. Decisions use a monotonic clock: a clock that was set changes the times of
day in a recording and nothing else.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pans.runtime.cli import warn
from pans.runtime.live.continuous import DISK_NEARLY_FULL, RECORDING_DELETED

EVERY_S = 5.0
FILE_EVERY_S = 0.5  # whether the recording still has a name
SLOPE_S, SLOPE_LEAST_S = 600.0, 30.0  # over which the present rate is taken
SHORT_S, SHORT_RESERVES = 3600.0, 5  # a warning below that, or with less than so many reserves
STEP_NS = 50_000_000  # a slewed clock moves 2.5 ms in EVERY_S: 500 ppm, the most that NTP uses (adjtimex(2))
_UNSYNCHRONISED, _TIME_ERROR = 0x40, 5  # STA_UNSYNC and TIME_ERROR of adjtimex(2)


class HostWatch:
    """Watches `recording`'s disk (None: the clock alone) and calls `stop` once with fewer than `reserve` bytes free (0: never)."""

    def __init__(
        self,
        recording: Callable[[], Path | None],
        reserve: int,
        stop: Callable[[str], None],
        is_deleted: Callable[[], bool] = lambda: False,
    ) -> None:
        self._recording, self._reserve, self._stop, self._is_deleted = recording, reserve, stop, is_deleted
        self._disk, self._clock = DiskTrend(), ClockSteps()
        self._facts: dict[str, Any] = {}
        self._news: deque[dict[str, Any]] = deque(maxlen=100)
        self._is_short = self._asked = False
        self._ending = threading.Event()
        self.look()
        self._thread = threading.Thread(target=self._keep, name="pans-host", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop looking."""
        self._ending.set()
        self._thread.join()

    def facts(self) -> dict[str, Any]:
        """Return what was found last, for the picture of the run."""
        return dict(self._facts)

    def news(self) -> Iterator[dict[str, Any]]:
        """Yield what is to be noted since the last call, as events with a `kind`."""
        while self._news:
            yield self._news.popleft()

    def look(self) -> None:
        """Look once."""
        if step_ns := self._clock.step_ns(clock_offset_ns()):
            self._news.append({"kind": "host_clock_step", "step_s": round(step_ns / 1e9, 3)})
        facts: dict[str, Any] = {"host_clock_steps": self._clock.steps}
        if (synchronised := clock_is_synchronised()) is not None:
            facts["host_clock_synchronised"] = synchronised
        if (path := self._recording()) is not None:
            with suppress(OSError):
                facts |= self._look_at_disk(path)
        self._facts = facts

    def _keep(self) -> None:
        due_s, deleted = time.monotonic() + EVERY_S, False
        while not self._ending.wait(FILE_EVERY_S):
            if not deleted and self._is_deleted():
                deleted, path = True, self._recording()
                warn(f"{RECORDING_DELETED}: {path}; the run ends, and what can be kept is kept beside it")
                self._news.append({"kind": "recording_deleted", "path": str(path)})
                self._stop(RECORDING_DELETED)
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + EVERY_S
                self.look()

    def _look_at_disk(self, path: Path) -> dict[str, Any]:
        free = shutil.disk_usage(path.parent).free
        self._disk.add(time.monotonic(), free)
        left_s = self._disk.left_s()
        facts: dict[str, Any] = {"disk_free_bytes": free}
        if left_s is not None:
            facts["disk_left_s"] = round(left_s)
        with suppress(OSError):
            facts["recording_bytes"] = os.stat(path).st_size
        is_short = (left_s is not None and left_s < SHORT_S) or free < SHORT_RESERVES * self._reserve
        event = {"folder": str(path.parent), "free_bytes": free, "left_s": facts.get("disk_left_s")}
        if is_short and not self._is_short:
            self._news.append({"kind": "disk_short", **event})
        self._is_short = is_short
        if free < self._reserve and not self._asked:
            self._asked = True
            self._news.append({"kind": "disk_nearly_full", **event, "reserve_bytes": self._reserve})
            self._stop(DISK_NEARLY_FULL)
        return facts


class DiskTrend:
    """How fast the free space of a disk shrinks, whoever writes to it."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque(maxlen=round(SLOPE_S / EVERY_S))

    def add(self, at_s: float, free: int) -> None:
        """Add one look."""
        if self._seen and free > self._seen[-1][1] + max(1 << 20, self._seen[-1][1] // 100):
            self._seen.clear()  # something was deleted: the rate begins anew
        self._seen.append((at_s, free))

    def left_s(self) -> float | None:
        """Return the seconds until the disk is full at the present rate, None while it is not known or the disk does not fill up."""
        if len(self._seen) < 2 or self._seen[-1][0] - self._seen[0][0] < SLOPE_LEAST_S:
            return None
        seen = np.array(self._seen)
        off_s, off = (seen - seen.mean(axis=0)).T
        slope = float(off_s @ off / (off_s @ off_s))
        return self._seen[-1][1] / -slope if slope < 0 else None


class ClockSteps:
    """Finds jumps in the offset of the time of day from the monotonic clock."""

    def __init__(self) -> None:
        self.steps = 0
        self._before: int | None = None

    def step_ns(self, offset_ns: int) -> int:
        """Return how far the clock jumped since the call before, 0 where it did not."""
        moved = 0 if self._before is None else offset_ns - self._before
        self._before = offset_ns
        if abs(moved) < STEP_NS:
            return 0
        self.steps += 1
        return moved


def clock_offset_ns() -> int:
    """Return time of day minus monotonic time, of the least disturbed of five readings."""
    found = []
    for _ in range(5):
        before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        found.append((after - before, now - (before + after) // 2))
    return min(found)[1]


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2), as Linux has it on 64 bits; read only (modes 0)."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        *((name, ctypes.c_long) for name in ("offset", "freq", "maxerror", "esterror")),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


def clock_is_synchronised() -> bool | None:
    """Return whether the kernel takes its clock for synchronised (NTP, PTP), None where it does not tell."""
    if sys.platform != "linux":
        return None
    facts = _Timex()
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.byref(facts))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR and not facts.status & _UNSYNCHRONISED
