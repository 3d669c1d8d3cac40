"""What stands in a recording: block kinds with their limits, the decision log's row and its flags.

Owns the vocabulary that writer (record.py), reader (recording.py) and core share; never touches a file. The bytes are in
docs/FORMATS.md.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag

import numpy as np

from pans.runtime.container import FILE_MAX_BYTES, MIB

MAGIC = b"PANSRECD"
FORMAT_VERSION = 2
READABLE_VERSIONS = (1, 2)  # they differ in DECISIONS blocks alone: record_log.py
MESSAGE_MAX_BYTES = MIB
NO_LABEL = 0xFFFF  # the label of a decision that abstained
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


LIMITS = {int(kind): 2 * MIB for kind in Kind} | {int(Kind.HEADER): 4 * MIB, int(Kind.BUNDLE): FILE_MAX_BYTES}


class DecisionFlag(IntFlag):
    """Why a decision is not to be trusted; lateness is a host's matter and stands in TIMINGS and EVENTS, not here."""

    GAP = 1  # exposures of the window never arrived
    WRONG_PATTERN = 2  # the device stamped another pattern than planned
    INCOMPLETE = 4  # the run ended within the window
    ABSTAINED = 8  # no label was given: label is 0xFFFF
    DARK_ALARM = 16  # the dark counts had changed when the window was measured
    STALE = 32  # the clicks were older than the decision may be
    NOT_FINITE = 64  # the back end gave no finite score
    COINCIDENCE = 128  # two objects passed at once: too long, or two maxima
    AMBIGUOUS = 256  # no class was sure enough


DECISION_DTYPE = np.dtype(
    [
        ("index", "<u8"),
        ("tick", "<u8"),  # end of the last exposure, device ticks
        ("exposure_index", "<u8"),  # the last exposure
        ("object", "<u4"),
        ("shot", "<u4"),  # the first shot of the window within the object's visit
        ("clicks", "<u4"),
        ("label", "<u2"),  # 0xFFFF: abstained
        ("truth", "<i2"),  # -1: unknown
        ("flags", "<u4"),  # DecisionFlag
        ("probability", "<f4"),  # softmax of the winner
        ("counts_crc", "<u4"),  # CRC-32 of the clicks per pattern as int64 little-endian
    ]
)
TIMING_DTYPE = np.dtype(
    [
        ("index", "<u8"),
        ("device_end_ns", "<i8"),  # end of the last exposure, on the host's clock
        ("arrival_ns", "<i8"),
        ("decided_ns", "<i8"),
        ("recorded_ns", "<i8"),
    ]
)
