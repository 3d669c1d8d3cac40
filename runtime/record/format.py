"""What stands in a recording: block kinds with their limits, and the row of timings.

Owns the vocabulary that writer (recorder.py) and reader (recording.py) share; never touches a file. The decision log's row is in
core/decision.py, the bytes are in docs/reference/formats.md.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from pans.runtime.container import FILE_MAX_BYTES, MIB

MAGIC = b"PANSRECD"
FORMAT_VERSION = 3
WALKS_VERSION = 4  # of runs with an automaton: verdicts have exposures
READABLE_VERSIONS = (2, 3, 4)  # 2 has no ANSWERS
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


def version_for(header: Mapping[str, Any]) -> int:
    """Return the lowest format version that holds what a run with this `header` records."""
    config = header.get("config")
    return WALKS_VERSION if isinstance(config, Mapping) and config.get("drive") else FORMAT_VERSION


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
