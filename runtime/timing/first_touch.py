"""What the first touch of memory costs, in memory as it comes and in memory that is locked.

Owns the measurement; the memory is its own and is given back.
"""

from __future__ import annotations

import ctypes
import mmap
import time
from typing import Any

from .conditions import GRANTED, locked
from .page_faults import ThreadCounts
from .wakeups import figures

PAGES = 1024  # 4 MiB: within what every user may lock on most systems (8 MiB)


def first_touch(*, lock: bool, pages: int = PAGES) -> dict[str, Any]:
    """Touch `pages` new pages of memory, locked before or not; return figures of the times, `faults` and, if locked, `asked`."""
    with mmap.mmap(-1, pages * mmap.PAGESIZE) as memory:
        if hasattr(mmap, "MADV_NOHUGEPAGE"):
            memory.madvise(mmap.MADV_NOHUGEPAGE)  # else one fault brings hundreds of pages
        if not lock:
            return _touched(memory, pages)
        place = ctypes.c_char.from_buffer(memory)
        with locked(ctypes.addressof(place), pages * mmap.PAGESIZE) as answer:
            found = _touched(memory, pages) if answer == GRANTED else figures([])
        del place  # else the memory cannot be given back
        return {"asked": answer, **found}


def _touched(memory: mmap.mmap, pages: int) -> dict[str, Any]:
    clock, took = time.perf_counter_ns, [0] * pages
    counts = ThreadCounts()
    for page in range(pages):
        begin = clock()
        memory[page * mmap.PAGESIZE] = 1
        took[page] = clock() - begin
    return {"faults": counts.since().get("minor"), **figures(took)}
