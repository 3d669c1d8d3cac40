"""The decision log on disk and its hash: what a decision needs in bytes, and the way back to the rows.

DECISIONS blocks (docs/reference/formats.md): each different verdict stands once
and is named by its number; what else a row holds goes up in equal steps, so that a run of decisions needs its first row and the steps:
2 bytes for a decision of a fast, regular stream, not 56. Nothing is left out: the rows come back bit for bit. The hash does not depend
on how the rows were cut into blocks.

The exposures of walks belong to the verdicts. They stand in an array of their own, which neither a block nor the hash has where all are
0, as with fixed patterns.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import DamagedFileError, PansError
from pans.base.files import open_regular, skim_blocks
from pans.decide import DECISION_DTYPE
from pans.decide import RUN_DTYPE as RUN_DTYPE
from pans.decide import VERDICT_DTYPE as VERDICT_DTYPE
from pans.decide import VERDICT_FIELDS as VERDICT_FIELDS
from pans.protocol.wire import read_only

from .format import LIMITS, LONG_VERDICT, Kind

BLOCK_ROWS = 1 << 14  # of one block of ours: 1.2 MB when nothing repeats
ROWS_MAX = 1 << 18  # of one block that is read, so that a small file cannot ask for much memory
EXPOSURES_DTYPE = DECISION_DTYPE["exposures"]
# The same layouts for the kernel, which compares probabilities by their bits.
_ROW_BITS, _VERDICT_BITS = (
    np.dtype(
        [("probability_bits", "<u4") if name == "probability" else (name, dtype[name]) for name in dtype.names or ()]
    )
    for dtype in (DECISION_DTYPE, VERDICT_DTYPE)
)
_HEAD = struct.Struct("<III")  # runs, verdicts, decisions
_SLOTS = 1 << 17  # of the kernel's table of verdicts: two for each


class _Parts(NamedTuple):
    """What a block is made of; `exposures` (verdicts,) are those of their walks, 0 where the patterns are fixed."""

    runs: NDArray[np.void]
    verdicts: NDArray[np.void]
    exposures: NDArray[np.uint32]
    codes: NDArray[np.uint16]


class LogEncoder:
    """Rows in, blocks and their hash out; all memory is allocated here, before arming."""

    def __init__(self) -> None:
        from . import log_kernels as kernels  # numba: only who writes or replays decisions needs it

        self._encode = kernels.encode_rows
        self._hash = _LogHash()
        self._state = np.zeros(kernels.N_STATE, np.uint64)
        self._keys = np.empty((LONG_VERDICT, 3), np.uint64)
        self._slots = np.full(_SLOTS, LONG_VERDICT, np.uint16)
        self._runs: NDArray[np.void] = np.empty(BLOCK_ROWS, RUN_DTYPE)
        self._verdicts: NDArray[np.void] = np.empty(BLOCK_ROWS, VERDICT_DTYPE)
        self._exposures = np.empty(BLOCK_ROWS, EXPOSURES_DTYPE)
        self._codes = np.empty(BLOCK_ROWS, np.uint16)
        # what a kernel continues, and what it fills
        known, verdicts = (self._state, self._keys, self._slots), self._verdicts.view(_VERDICT_BITS)
        self._arrays = *known, self._runs, verdicts, self._exposures, self._codes
        self._take(np.zeros(0, DECISION_DTYPE))  # compiles the kernel, or loads it

    def block(self, rows: NDArray[np.void]) -> bytes:
        """Take the next rows, DECISION_DTYPE (n,), n at most BLOCK_ROWS, and return the payload that holds them."""
        return _payload(self._take(rows))

    def blocks(self, rows: NDArray[np.void]) -> Iterator[bytes]:
        """Take the next rows, any number of them, and yield the payloads that hold them."""
        for first in range(0, len(rows), BLOCK_ROWS):
            yield self.block(rows[first : first + BLOCK_ROWS])

    def update(self, rows: NDArray[np.void]) -> None:
        """Take the next rows, DECISION_DTYPE (n,), for their hash alone."""
        for start in range(0, len(rows), BLOCK_ROWS):
            self._take(rows[start : start + BLOCK_ROWS])

    def hexdigest(self) -> str:
        """Return the SHA-256 (hex) of all rows so far."""
        return self._hash.hexdigest()

    def _take(self, rows: NDArray[np.void]) -> _Parts:
        """Return the parts of the block that holds `rows`, and add them to the hash."""
        bits = read_only(np.ascontiguousarray(rows, DECISION_DTYPE).view(_ROW_BITS))
        n_runs, n_verdicts = self._encode(bits, *self._arrays)
        known = self._verdicts[:n_verdicts], self._exposures[:n_verdicts]
        parts = _Parts(self._runs[:n_runs], *known, self._codes[: len(rows)])
        self._hash.update(parts)
        return parts


def _payload(parts: _Parts) -> bytes:
    """Return what a block holds."""
    runs, verdicts, exposures, codes = parts
    head = _HEAD.pack(len(runs), len(verdicts), len(codes))
    return b"".join((head, runs.data, verdicts.data, codes.data, exposures.data if exposures.any() else b""))


class LogReader:
    """DECISIONS blocks of one recording, in their order."""

    def __init__(self) -> None:
        self._known: NDArray[np.void] = np.empty(LONG_VERDICT, VERDICT_DTYPE)
        self._known_exposures = np.empty(LONG_VERDICT, EXPOSURES_DTYPE)
        self._n_known = 0
        self._hash = _LogHash()

    def rows(self, payload: bytes, where: str) -> NDArray[np.void]:
        """Return the rows of the next block, DECISION_DTYPE (n,); DamagedFileError when its parts do not fit together."""
        parts = _parts(payload, where)
        runs, verdicts, exposures, codes = parts
        long = codes == LONG_VERDICT
        n_new = len(verdicts) - int(long.sum())
        n_known = self._n_known + n_new
        if n_new < 0 or n_known > LONG_VERDICT or (codes[~long] >= n_known).any():
            raise DamagedFileError(f"{where}: its {len(verdicts)} verdicts do not fit its decisions")
        self._known[self._n_known : n_known] = verdicts[:n_new]
        self._known_exposures[self._n_known : n_known] = exposures[:n_new]
        self._n_known = n_known
        self._hash.update(parts)
        numbers = np.where(long, 0, codes)
        found, walked = self._known[numbers], self._known_exposures[numbers]
        found[long], walked[long] = verdicts[n_new:], exposures[n_new:]
        return _expand(runs, found, walked)

    def hexdigest(self) -> str:
        """Return the SHA-256 (hex) of all rows so far."""
        return self._hash.hexdigest()


def skim_decisions(recordings: Sequence[Path], most_bytes: int) -> Iterator[NDArray[np.void]]:
    """Yield the decisions of these files, DECISION_DTYPE (n,), of each as far as it can be read; none of more than `most_bytes` together.

    Their decision logs alone are read. The blocks are not checked against the rest of their file.
    """
    if sum(path.stat().st_size for path in recordings) > most_bytes:
        return
    for path in recordings:
        log = LogReader()
        with suppress(PansError, OSError, ValueError), open_regular(path) as file:
            for payload in skim_blocks(file, Kind.DECISIONS, LIMITS):
                yield log.rows(payload, str(path))


class _LogHash:
    """SHA-256 over the hashes of verdicts, codes and whole runs, and of exposures where there are any.

    A run that continues in the next block is hashed when it ends.
    """

    def __init__(self) -> None:
        self._verdicts, self._codes, self._runs = hashlib.sha256(), hashlib.sha256(), hashlib.sha256()
        self._exposures, self._walks = hashlib.sha256(), False
        self._open: NDArray[np.void] = np.zeros(0, RUN_DTYPE)  # the last run, which may continue

    def update(self, parts: _Parts) -> None:
        runs, verdicts, exposures, codes = parts
        if not len(runs):
            return
        self._verdicts.update(verdicts.data)
        self._exposures.update(exposures.data)
        self._walks = self._walks or bool(exposures.any())
        self._codes.update(codes.data)
        start = 0
        if runs["continues"][0] and len(self._open):
            start = 1
            self._open["count"] += runs["count"][0]
            for name in ("tick_step", "exposure_step", "shot_step"):
                self._open[name] = runs[name][0]
        if start < len(runs):
            self._runs.update(self._open.tobytes())
            self._runs.update(runs[start:-1].tobytes())
            self._open = runs[-1:].copy()

    def hexdigest(self) -> str:
        runs = self._runs.copy()
        runs.update(self._open.tobytes())
        walked = self._exposures.digest() if self._walks else b""
        return hashlib.sha256(self._verdicts.digest() + self._codes.digest() + runs.digest() + walked).hexdigest()


def _parts(payload: bytes, where: str) -> _Parts:
    """The parts of one block, checked as far as they stand alone."""
    if len(payload) < _HEAD.size:
        raise DamagedFileError(f"{where} has {len(payload)} bytes, allowed: {_HEAD.size} or more")
    n_runs, n_verdicts, n_rows = _HEAD.unpack_from(payload)
    verdicts_at = _HEAD.size + n_runs * RUN_DTYPE.itemsize
    codes_at = verdicts_at + n_verdicts * VERDICT_DTYPE.itemsize
    wanted = codes_at + 2 * n_rows
    walked = len(payload) == wanted + EXPOSURES_DTYPE.itemsize * n_verdicts
    if (len(payload) != wanted and not walked) or n_rows > ROWS_MAX:
        what = f"{n_runs} runs, {n_verdicts} verdicts and {n_rows} decisions"
        raise DamagedFileError(
            f"{where} has {len(payload)} bytes for {what}, allowed: {wanted}, and {ROWS_MAX} decisions at most"
        )
    runs = np.frombuffer(payload, RUN_DTYPE, n_runs, _HEAD.size)
    counts, later = runs["count"].astype(np.int64), runs["continues"][1:]
    if int(counts.sum()) != n_rows or not counts.all() or later.any() or int(runs["continues"].max(initial=0)) > 1:
        raise DamagedFileError(f"{where}: its runs do not add up to its {n_rows} decisions")
    return _Parts(
        runs,
        np.frombuffer(payload, VERDICT_DTYPE, n_verdicts, verdicts_at),
        np.frombuffer(payload, EXPOSURES_DTYPE, n_verdicts, wanted)
        if walked
        else np.zeros(n_verdicts, EXPOSURES_DTYPE),
        np.frombuffer(payload, "<u2", n_rows, codes_at),
    )


def _expand(runs: NDArray[np.void], verdicts: NDArray[Any], exposures: NDArray[np.uint32]) -> NDArray[np.void]:
    """Rows from runs, a verdict and exposures each. What goes beyond a field counts on from 0 there, as the sums in the kernel do."""
    counts = runs["count"].astype(np.int64)
    n_rows = len(verdicts)
    run = np.repeat(np.arange(len(counts)), counts)
    within = (np.arange(n_rows) - np.repeat(np.cumsum(counts) - counts, counts)).astype(np.uint64)
    rows: NDArray[np.void] = np.zeros(n_rows, DECISION_DTYPE)
    firsts = runs[run]
    rows["index"] = firsts["index"] + within
    for name, step in (("tick", "tick_step"), ("exposure_index", "exposure_step"), ("shot", "shot_step")):
        rows[name] = firsts[name].astype(np.uint64) + within * firsts[step].astype(np.uint64)
    rows["object"], rows["truth"] = firsts["object"], firsts["truth"]
    for name in VERDICT_FIELDS:
        rows[name] = verdicts[name]
    rows["exposures"] = exposures
    return rows
