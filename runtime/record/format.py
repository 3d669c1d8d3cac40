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
from numpy.typing import NDArray

from pans.runtime.container import FILE_MAX_BYTES, MIB

MAGIC = b"PANSRECD"
FORMAT_VERSION = 3
WALKS_VERSION = 4  # of runs with an automaton: verdicts have exposures
RUNS_VERSION = 5  # of parallel frames, many decisions a block: TIMING_RUNS
COUNTS_VERSION = 6  # of runs whose exposures are numbers: MESSAGES hold COUNTS
READABLE_VERSIONS = (2, 3, 4, 5, 6)  # 2 has no ANSWERS
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
    TIMING_RUNS = 11


LIMITS = {int(kind): 2 * MIB for kind in Kind} | {int(Kind.HEADER): 4 * MIB, int(Kind.BUNDLE): FILE_MAX_BYTES}
_LIMITS_3 = {kind: limit for kind, limit in LIMITS.items() if kind != Kind.TIMING_RUNS}
_LIMITS_2 = {kind: limit for kind, limit in _LIMITS_3.items() if kind != Kind.ANSWERS}


def version_for(header: Mapping[str, Any]) -> int:
    """Return the lowest format version that holds what a run with this `header` records."""
    config = header.get("config")
    if not isinstance(config, Mapping):
        return FORMAT_VERSION
    if config.get("photon_number_max") or config.get("channels_at_once"):
        return COUNTS_VERSION
    if config.get("mode") == "parallel":
        return RUNS_VERSION
    return WALKS_VERSION if config.get("drive") else FORMAT_VERSION


def limits_of(version: int) -> dict[int, int]:
    """Return the most bytes of a payload by the kinds that a recording of this version may have."""
    return _LIMITS_2 if version == 2 else LIMITS if version >= RUNS_VERSION else _LIMITS_3


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
TIMING_ROWS_MAX = 1 << 20  # of one block of runs, so that a small file cannot ask for much memory


def expand_timings(runs: NDArray[np.void]) -> NDArray[np.void]:
    """Return the rows, TIMING_DTYPE, that `runs`, TIMING_RUN_DTYPE (n,), stand for."""
    counts = runs["count"].astype(np.int64)
    rows: NDArray[np.void] = np.empty(int(counts.sum()), TIMING_DTYPE)
    if len(rows) == len(runs):
        for name in TIMING_DTYPE.names or ():
            rows[name] = runs[name]
        return rows
    for name in TIMING_DTYPE.names or ():
        rows[name] = np.repeat(runs[name], counts)
    rows["index"] += (np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)).astype(np.uint64)
    return rows
