"""What a recording holds: the kinds of blocks with their limits, and the rows of timings (docs/reference/formats.md)."""

from __future__ import annotations

import struct
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pans.base.files import FILE_MAX_BYTES, MIB

MAGIC = b"PANSRECD"
FORMAT_VERSION = 1
MESSAGE_MAX_BYTES = MIB
LONG_VERDICT = 0xFFFF  # the code of a verdict that has no number, since so many others have one
RUN_ROWS_MAX = 1 << 31
MESSAGE = struct.Struct("<qI")
PART_EVENT = "part"  # the first event of a part: where in the run it begins


class Kind(IntEnum):
    """What a block holds."""

    HEADER = 1
    BUNDLE = 2
    MESSAGES = 3
    COMMANDS = 4
    CLOCK = 5
    DECISIONS = 6
    TIMINGS = 7
    EVENTS = 8
    END = 9
    ANSWERS = 10


LIMITS = {int(kind): 2 * MIB for kind in Kind} | {int(Kind.HEADER): 4 * MIB, int(Kind.BUNDLE): FILE_MAX_BYTES}

TIMING_DTYPE = np.dtype(
    [
        ("index", "<u8"),
        ("device_end_ns", "<i8"),  # end of the last exposure, on the host's clock
        ("arrival_ns", "<i8"),
        ("decided_ns", "<i8"),
        ("recorded_ns", "<i8"),
    ]
)
TIMING_RUN_DTYPE = np.dtype([*TIMING_DTYPE.descr, ("count", "<u4")])  # decisions from `index` on that share their times
TIMING_ROWS_MAX = 1 << 20  # decisions of one block, so that a small file cannot ask for much memory


def expand_timings(runs: NDArray[np.void]) -> NDArray[np.void]:
    """Return the rows, TIMING_DTYPE, that `runs`, TIMING_RUN_DTYPE (n,), stand for."""
    counts = runs["count"].astype(np.int64)
    rows: NDArray[np.void] = np.empty(int(counts.sum()), TIMING_DTYPE)
    for name in TIMING_DTYPE.names or ():
        rows[name] = np.repeat(runs[name], counts)
    rows["index"] += (np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)).astype(np.uint64)
    return rows
