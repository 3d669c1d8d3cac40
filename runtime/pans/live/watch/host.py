"""The computer around a run: the space left on the disk of the recording, and whether the computer's own clock was set.

What is found stands in `facts`, what is to be noted in `news`; a run must stop before its disk is full. The loop reads the news and never
waits for a look. Decisions use a monotonic clock: a clock that was set changes the times of day in a recording and nothing else.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pans.base.console import warn
from pans.live.stop import DISK_NEARLY_FULL, RECORDING_DELETED

from .state_file import Repeated

if TYPE_CHECKING:
    from pans.record.recorder import Recorder

EVERY_S = 5.0
FILE_EVERY_S = 0.5  # whether the recording still has a name
SLOPE_S, SLOPE_LEAST_S = 600.0, 300.0  # over which the present rate is taken; an installation fills a disk for a minute
SHORT_S, SHORT_RESERVES = 3600.0, 5  # a warning below that, or with less than so many reserves
STEP_NS = 50_000_000  # a slewed clock moves 2.5 ms in EVERY_S: 500 ppm, the most that NTP uses (adjtimex(2))
_UNSYNCHRONISED, _TIME_ERROR = 0x40, 5  # STA_UNSYNC and TIME_ERROR of adjtimex(2)


class HostWatch:
    """Watches the disk to which `recorder` writes (None: the clock alone) and calls `stop` once with fewer than `reserve` bytes free.

    `facts` belong into the picture of the run; `news` are events with a `kind` for its journal, the oldest first.
    """

    def __init__(self, recorder: Recorder | None, reserve: int, stop: Callable[[str], None]) -> None:
        self.facts: dict[str, Any] = {}
        self.news: deque[dict[str, Any]] = deque(maxlen=100)
        self._recorder, self._reserve, self._stop = recorder, reserve, stop
        self._disk, self._offset_ns, self._steps = DiskTrend(), clock_offset_ns(), 0
        self._is_short = self._is_full = self._is_deleted = False
        self.look()
        self._threads = [Repeated("pans-host", EVERY_S, self.look)]
        if recorder is not None:
            self._threads.append(Repeated("pans-file", FILE_EVERY_S, self._look_for_file))

    def close(self) -> None:
        """Stop looking."""
        for thread in self._threads:
            thread.close()

    def look(self) -> None:
        """Look at clock and disk once."""
        before_ns, self._offset_ns = self._offset_ns, clock_offset_ns()
        step_ns = self._offset_ns - before_ns
        if abs(step_ns) >= STEP_NS:
            self._steps += 1
            self.news.append({"kind": "host_clock_step", "step_s": round(step_ns / 1e9, 3)})
        facts: dict[str, Any] = {"host_clock_steps": self._steps}
        if (synchronised := clock_is_synchronised()) is not None:
            facts["host_clock_synchronised"] = synchronised
        if self._recorder is not None:
            with suppress(OSError):
                facts |= self._look_at_disk(self._recorder.open_file.path)
        self.facts = facts

    def _look_for_file(self) -> None:
        assert self._recorder is not None
        if self._is_deleted or not self._recorder.open_file.is_deleted:
            return
        self._is_deleted, path = True, self._recorder.open_file.path
        warn(f"{RECORDING_DELETED}: {path}; the run ends, and what can be kept is kept beside it")
        self.news.append({"kind": "recording_deleted", "path": str(path)})
        self._stop(RECORDING_DELETED)

    def _look_at_disk(self, path: Path) -> dict[str, Any]:
        free = shutil.disk_usage(path.parent).free
        left_s = self._disk.left_s(time.monotonic(), free)
        facts: dict[str, Any] = {"disk_free_bytes": free}
        if left_s is not None:
            facts["disk_left_s"] = round(left_s)
        with suppress(OSError):
            facts["recording_bytes"] = os.stat(path).st_size
        was_short, self._is_short = self._is_short, free < SHORT_RESERVES * self._reserve
        self._is_short |= left_s is not None and left_s < SHORT_S
        event = {"folder": str(path.parent), "free_bytes": free, "left_s": facts.get("disk_left_s")}
        if self._is_short and not was_short:
            self.news.append({"kind": "disk_short", **event})
        if free < self._reserve and not self._is_full:
            self._is_full = True
            self.news.append({"kind": "disk_nearly_full", **event, "reserve_bytes": self._reserve})
            self._stop(DISK_NEARLY_FULL)
        return facts


class DiskTrend:
    """How fast the free space of a disk shrinks, whoever writes to it."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int]] = deque(maxlen=round(SLOPE_S / EVERY_S))

    def left_s(self, at_s: float, free: int) -> float | None:
        """Add one look; return the seconds until the disk is full at the present rate, None if that is unknown or it does not fill up."""
        if self._seen and free > self._seen[-1][1] + max(1 << 20, self._seen[-1][1] // 100):
            self._seen.clear()  # something was deleted: the rate begins anew
        self._seen.append((at_s, free))
        if at_s - self._seen[0][0] < SLOPE_LEAST_S:
            return None
        seen = np.array(self._seen)
        off_s, off = (seen - seen.mean(axis=0)).T
        slope = float(off_s @ off / (off_s @ off_s))
        return free / -slope if slope < 0 else None


def clock_offset_ns() -> int:
    """Return time of day minus monotonic time, of the least disturbed of five readings."""
    found = []
    for _ in range(5):
        before, now, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        found.append((after - before, now - (before + after) // 2))
    return min(found)[1]


def clock_is_synchronised() -> bool | None:
    """Return whether the kernel holds its clock to be synchronised (NTP, PTP), None where that is not known."""
    if sys.platform != "linux" or sys.maxsize < 1 << 32:
        return None
    timex = ctypes.create_string_buffer(512)  # struct timex of 64 bits; it is only read, as its `modes` are 0
    try:
        state = ctypes.CDLL(None).adjtimex(timex)
    except (OSError, AttributeError):
        return None
    status = int.from_bytes(timex.raw[40:44], sys.byteorder)  # behind `modes` and four numbers of 8 bytes
    return None if state < 0 else state != _TIME_ERROR and not status & _UNSYNCHRONISED
