"""The system's calls that the kernel makes itself, without the interpreter: time, waiting, reading and writing a descriptor.

Compiled code reaches libc by symbols that the just-in-time compiler's linker resolves when a kernel is loaded, so that
kernels can be cached. errno is read at once, in the thread that made the call. Where there is no POSIX system, the kernel is only fed
(`offered` says so) and these calls fail; without the compiler they are Python's.
"""

from __future__ import annotations

import errno
import os
import select
import sys
import time
from typing import Any

import numba
import numpy as np
from numba import types

from pans.base.machine import inner, outer

from .arrays import I64, U8

# perf_counter_ns, which stamps everything else, reads the same clock: CLOCK_MONOTONIC, on macOS CLOCK_UPTIME_RAW
_CLOCK = np.int32(8 if sys.platform == "darwin" else 1)
_IN, _OUT = np.int64(1), np.int64(4)  # POLLIN, POLLOUT
AGAIN, INTERRUPTED, _NOT_OFFERED = errno.EAGAIN, errno.EINTR, errno.ENOSYS
NS_PER_S = 1_000_000_000


def offered() -> str:
    """Return "" where the kernel can read descriptors, else why not."""
    if sys.platform not in ("linux", "darwin"):
        return "this system has no poll on descriptors"
    return ""


if numba.config.DISABLE_JIT:

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

    def wait_both(fd: Any, wake_fd: Any, wait_ns: Any, scratch: I64) -> int:
        """Wait at most `wait_ns` until `fd` or `wake_fd` can be read: 1 and 2 added up say which, 0 neither, below 0 minus errno."""
        try:
            found = select.select([int(fd), int(wake_fd)], [], [], max(wait_ns, 0) / 1e9)[0]
        except OSError as error:
            return -(error.errno or 1)
        return (int(fd) in found) + 2 * (int(wake_fd) in found)

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
    def wait_both(fd, wake_fd, wait_ns, scratch):  # type: ignore[no-untyped-def]
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
        return _polled(1, wait_ns, scratch)

    @inner
    def wait_both(fd, wake_fd, wait_ns, scratch):  # type: ignore[no-untyped-def]
        """Wait at most `wait_ns` until `fd` or `wake_fd` can be read: 1 and 2 added up say which, 0 neither, below 0 minus errno."""
        scratch[0], scratch[1] = np.int64(fd) | _IN << np.int64(32), np.int64(wake_fd) | _IN << np.int64(32)
        found = _polled(2, wait_ns, scratch)
        if found <= 0:
            return found
        return np.int64(scratch[0] >> 48 != 0) + 2 * np.int64(scratch[1] >> 48 != 0)  # revents are the highest 16 bits

    @inner
    def _polled(count, wait_ns, scratch):  # type: ignore[no-untyped-def]
        """Poll the first `count` of two descriptors in `scratch`."""
        if _DARWIN:
            found = _poll(scratch.ctypes.data, np.uint32(count), np.int32(max((wait_ns + 999_999) // 1_000_000, 0)))
        else:
            scratch[2], scratch[3] = max(wait_ns, 0) // NS_PER_S, max(wait_ns, 0) % NS_PER_S
            found = _ppoll(scratch.ctypes.data, np.uint64(count), scratch.ctypes.data + 16, 0)
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
