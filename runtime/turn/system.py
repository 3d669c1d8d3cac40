"""The system's calls that a compiled turn makes itself, without the interpreter: time, waiting, reading and writing a descriptor.

Owns how libc is reached from compiled code: by symbols that the just-in-time compiler's linker resolves when a kernel is loaded, so that
kernels can be cached. errno is read at once, in the thread that made the call. Where there is no POSIX system, a turn is only fed
(`offered` says so) and these calls fail; without the compiler they are Python's (system_plain.py).
"""

from __future__ import annotations

import errno
import sys
from typing import Any

import numba
import numpy as np
from numba import types

from pans.runtime.wire.inner import inner, outer

# perf_counter_ns, which stamps everything else, reads the same clock: CLOCK_MONOTONIC, on macOS CLOCK_UPTIME_RAW
_CLOCK = np.int32(8 if sys.platform == "darwin" else 1)
_IN, _OUT = np.int64(1), np.int64(4)  # POLLIN, POLLOUT
AGAIN, INTERRUPTED, _NOT_OFFERED = errno.EAGAIN, errno.EINTR, errno.ENOSYS
NS_PER_S = 1_000_000_000


def offered() -> str:
    """Return "" where compiled turns can be made, else why not."""
    if sys.platform not in ("linux", "darwin"):
        return "this system has no poll on descriptors: the turn is Python's"
    return "numba's compiler is switched off" if numba.config.DISABLE_JIT else ""


if numba.config.DISABLE_JIT:
    from .system_plain import now_ns as now_ns
    from .system_plain import read_now as read_now
    from .system_plain import wait_for as wait_for
    from .system_plain import write_now as write_now

elif sys.platform not in ("linux", "darwin"):

    @outer
    def now_ns(scratch):  # type: ignore[no-untyped-def]
        """No clock: whoever feeds a turn stamps what it took."""
        return np.int64(0)

    @inner
    def wait_for(fd, wait_ns, to_write, scratch):  # type: ignore[no-untyped-def]
        """Not offered here."""
        return np.int64(-_NOT_OFFERED)

    @inner
    def read_now(fd, buffer, at, size):  # type: ignore[no-untyped-def]
        """Not offered here."""
        return np.int64(-_NOT_OFFERED)

    write_now = read_now

else:
    _read = types.ExternalFunction("read", types.intp(types.int32, types.intp, types.uintp))
    _write = types.ExternalFunction("write", types.intp(types.int32, types.intp, types.uintp))
    _clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))
    _errno_at = types.ExternalFunction(
        "__error" if sys.platform == "darwin" else "__errno_location", types.CPointer(types.int32)()
    )
    if sys.platform == "darwin":
        _poll = types.ExternalFunction("poll", types.int32(types.intp, types.uint32, types.int32))
        _ppoll: Any = None
    else:
        _poll: Any = None
        _ppoll = types.ExternalFunction("ppoll", types.int32(types.intp, types.uintp, types.intp, types.intp))
    _DARWIN = sys.platform == "darwin"

    @outer
    def now_ns(scratch):  # type: ignore[no-untyped-def]
        """The host's clock in ns; scratch int64 (4,) is overwritten from place 2 on."""
        _clock_gettime(_CLOCK, scratch.ctypes.data + 16)
        return scratch[2] * NS_PER_S + scratch[3]

    @inner
    def wait_for(fd, wait_ns, to_write, scratch):  # type: ignore[no-untyped-def]
        """Wait at most `wait_ns` until `fd` can be read (or written): above 0 when it can or is gone, 0 when not, else minus errno."""
        scratch[0] = np.int64(fd) | (_OUT if to_write else _IN) << np.int64(32)
        if _DARWIN:
            found = _poll(scratch.ctypes.data, np.uint32(1), np.int32(max((wait_ns + 999_999) // 1_000_000, 0)))
        else:
            scratch[2], scratch[3] = max(wait_ns, 0) // NS_PER_S, max(wait_ns, 0) % NS_PER_S
            found = _ppoll(scratch.ctypes.data, np.uint64(1), scratch.ctypes.data + 16, 0)
        return np.int64(found) if found >= 0 else -np.int64(_errno_at()[0])

    @inner
    def read_now(fd, buffer, at, size):  # type: ignore[no-untyped-def]
        """Read at most `size` bytes to buffer[at:]: how many, 0 at the end (or of a terminal without data), else minus errno."""
        found = _read(np.int32(fd), buffer.ctypes.data + at, np.uint64(size))
        return np.int64(found) if found >= 0 else -np.int64(_errno_at()[0])

    @inner
    def write_now(fd, buffer, at, size):  # type: ignore[no-untyped-def]
        """Write buffer[at : at + size]: how many bytes were taken, else minus errno."""
        found = _write(np.int32(fd), buffer.ctypes.data + at, np.uint64(size))
        return np.int64(found) if found >= 0 else -np.int64(_errno_at()[0])
