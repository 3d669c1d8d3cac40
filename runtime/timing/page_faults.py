"""What the kernel did to one thread: page faults, and how often another thread was put in its place; a heap that makes none.

Counts come from getrusage of the calling thread (Linux; elsewhere nothing is known). A minor fault is the first touch of a page, one to a
few microseconds. A major fault waits for the disk. An involuntary switch means that the scheduler took the core away for somebody else.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

HELD_BYTES = 8 << 20  # more than a run of the fastest shipped profile keeps between two writes of its recording
HELD_LARGEST = 32 << 20  # glibc takes no more as M_MMAP_THRESHOLD
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h of glibc
USUAL_THRESHOLD = 128 << 10  # of both
PAGE_BYTES = 4096
SMALL_BYTES, PIN_EVERY_BYTES = 400, 128 << 10  # pymalloc: objects to 512 bytes, in arenas of 256 KiB or 1 MiB
FIELDS = {"minor": "ru_minflt", "major": "ru_majflt", "involuntary_switches": "ru_nivcsw"}


class ThreadCounts:
    """Counts of the calling thread since construction, or since the last `restart`."""

    def __init__(self) -> None:
        self._before = _counts()

    def restart(self) -> None:
        """Count from here on."""
        self._before = _counts()

    def since(self) -> dict[str, int]:
        """Return {minor, major, involuntary_switches} so far; {} where the system does not tell."""
        return {name: count - self._before[name] for name, count in _counts().items() if name in self._before}


@contextmanager
def held_heap(n_bytes: int = HELD_BYTES) -> Iterator[str]:
    """Touch `n_bytes` of heap and keep what is freed: what is allocated in the block has been touched before.

    Else the C library maps large blocks afresh each time and gives them back, so that every page is touched for the first time again.
    Yields "granted" or the reason why not.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        yield "this C library has no mallopt"
        return
    granted = mallopt(M_MMAP_THRESHOLD, HELD_LARGEST) and mallopt(M_TRIM_THRESHOLD, 1 << 30)
    room = bytearray(n_bytes)
    room[::PAGE_BYTES] = bytes(len(range(0, n_bytes, PAGE_BYTES)))
    del room
    pinned = _touched_arenas(n_bytes)
    try:
        yield "granted" if granted else "refused"
    finally:
        del pinned
        mallopt(M_MMAP_THRESHOLD, USUAL_THRESHOLD)
        mallopt(M_TRIM_THRESHOLD, USUAL_THRESHOLD)


def _touched_arenas(n_bytes: int) -> list[bytes]:
    """Touch `n_bytes` of the interpreter's memory for small objects; return a few, which keep it from giving that back."""
    objects = [bytes(SMALL_BYTES) for _ in range(n_bytes // SMALL_BYTES)]
    return objects[:: (PIN_EVERY_BYTES // SMALL_BYTES)]


def fault_words(counts: Mapping[str, int]) -> str:
    """Return the counts in words.

    >>> fault_words({"minor": 12, "major": 0, "involuntary_switches": 3})
    '12 minor, 0 major; the core was taken away 3 times'
    """
    if not counts:
        return "not told by this system"
    switches = counts.get("involuntary_switches", 0)
    return f"{counts.get('minor', 0)} minor, {counts.get('major', 0)} major; the core was taken away {switches} times"


def _counts() -> dict[str, int]:
    try:
        import resource

        usage = resource.getrusage(resource.RUSAGE_THREAD)
    except (ImportError, AttributeError, ValueError):  # Windows; macOS knows whole processes only
        return {}
    return {name: int(getattr(usage, field)) for name, field in FIELDS.items()}
