"""What stands in a recording: block kinds with their limits, and the row of timings.

Owns the vocabulary that writer (recorder.py) and reader (recording.py) share; never touches a file. The decision log's row is in
core/decision.py, the bytes are in docs/reference/formats.md.
"""

from __future__ import annotations

import struct
from enum import IntEnum

import numpy as np

from pans.runtime.container import FILE_MAX_BYTES, MIB

MAGIC = b"PANSRECD"
FORMAT_VERSION = 3
READABLE_VERSIONS = (2, 3)  # 2 has no ANSWERS
MESSAGE_MAX_BYTES = MIB
LONG_VERDICT = 0xFFFF  # the code of a verdict that has no number, since so many others have one
RUN_ROWS_MAX = 1 << 31
MESSAGE = struct.Struct("<qI")


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
_LIMITS_2 = {kind: limit for kind, limit in LIMITS.items() if kind != Kind.ANSWERS}


def limits_of(version: int) -> dict[int, int]:
    """Return the most bytes of a payload by the kinds that a recording of this version may have."""
    return _LIMITS_2 if version == 2 else LIMITS


TIMING_DTYPE = np.dtype(
    [
        ("index", "<u8"),
        ("device_end_ns", "<i8"),  # end of the last exposure, on the host's clock
        ("arrival_ns", "<i8"),
        ("decided_ns", "<i8"),
        ("recorded_ns", "<i8"),
    ]
)
