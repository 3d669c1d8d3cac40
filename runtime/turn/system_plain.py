"""The system's calls of a turn in plain Python: what runs where the compiler is switched off, and what system.py's must do.

Owns nothing else; results as in system.py.
"""

from __future__ import annotations

import os
import select
import time
from typing import Any

from .rings import I64, U8


def now_ns(scratch: I64) -> int:
    """The host's clock in ns."""
    return time.perf_counter_ns()


def wait_for(fd: Any, wait_ns: Any, to_write: Any, scratch: I64) -> int:
    """Wait at most `wait_ns` until `fd` can be read (or written): above 0 when it can or is gone, 0 when not, else minus errno."""
    wanted, none = [int(fd)], []  # type: ignore[var-annotated]
    try:
        found = select.select(none if to_write else wanted, wanted if to_write else none, [], max(wait_ns, 0) / 1e9)
    except OSError as error:
        return -(error.errno or 1)
    return len(found[0]) + len(found[1])


def read_now(fd: int, buffer: U8, at: int, size: int) -> int:
    """Read at most `size` bytes to buffer[at:]: how many, 0 at the end (or of a terminal without data), else minus errno."""
    try:
        data = os.read(int(fd), int(size))
    except OSError as error:
        return -(error.errno or 1)
    buffer[at : at + len(data)] = memoryview(data)
    return len(data)


def write_now(fd: int, buffer: U8, at: int, size: int) -> int:
    """Write buffer[at : at + size]: how many bytes were taken, else minus errno."""
    try:
        return os.write(int(fd), buffer[at : at + size].tobytes())
    except OSError as error:
        return -(error.errno or 1)
