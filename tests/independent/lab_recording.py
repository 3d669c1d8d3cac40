"""Recordings, read as a lab would from docs/reference/formats.md alone: the chain of blocks, messages, commands, the decision log."""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lab_bundle import MIB, demand, strict_json
from numpy.typing import NDArray

HEADER, BUNDLE, MESSAGES, COMMANDS, CLOCK, DECISIONS, TIMINGS, EVENTS, END, ANSWERS = range(1, 11)
LIMITS = {kind: 2 * MIB for kind in range(1, 11)} | {HEADER: 4 * MIB, BUNDLE: 64 * MIB}
VERDICT = [("clicks", "<u4"), ("label", "<u2"), ("flags", "<u4"), ("probability", "<f4"), ("counts_crc", "<u4")]
PLACE = [("index", "<u8"), ("tick", "<u8"), ("exposure_index", "<u8"), ("object", "<u4"), ("shot", "<u4")]
ROW = np.dtype([*PLACE, *VERDICT[:2], ("truth", "<i2"), *VERDICT[2:], ("exposures", "<u4")])
RUN = np.dtype(
    [
        *PLACE,
        *(("count", "<u4"), ("tick_step", "<u4"), ("exposure_step", "<u4"), ("shot_step", "<u4")),
        *(("truth", "<i2"), ("continues", "<u2")),
    ]
)
ENTRIES = {MESSAGES: "messages", ANSWERS: "answers", COMMANDS: "commands"}
NO_NUMBER = 0xFFFF
STEPS = {"tick": "tick_step", "exposure_index": "exposure_step", "shot": "shot_step"}


@dataclass
class Recording:
    """What one recording holds."""

    header: dict[str, Any] = field(default_factory=dict)
    bundle: bytes = b""
    messages: list[tuple[int, bytes]] = field(default_factory=list)  # arrival in ns, header and payload
    answers: list[tuple[int, bytes]] = field(default_factory=list)  # arrival in ns, header and payload
    commands: list[tuple[int, bytes]] = field(default_factory=list)  # sent in ns, bytes on the wire
    clock: list[tuple[int, int, int]] = field(default_factory=list)
    timings: list[tuple[int, ...]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    end: dict[str, Any] = field(default_factory=dict)
    log: DecisionLog = field(default_factory=lambda: DecisionLog())

    @property
    def rows(self) -> NDArray[np.void]:
        """All decisions, ROW (n,)."""
        return np.array(self.log.rows, ROW)


def read_recording(data: bytes) -> Recording:
    """Return a whole recording, every byte checked; Damaged otherwise (a file that was cut counts as damaged here)."""
    recording = Recording()
    for blocks, (kind, payload) in enumerate(iter_blocks(data)):
        demand((kind == HEADER) == (blocks == 0), "HEADER is block 0 and no other")
        _take(recording, kind, payload)
        if kind == END:
            found = {"blocks": blocks, "decisions": len(recording.log.rows), "decisions_sha256": recording.log.sha256()}
            for name, value in found.items():
                demand(recording.end[name] == value, f"END says {name} = {recording.end[name]}, found {value}")
    demand(bool(recording.end), "no END")
    if recording.bundle:
        demand(hashlib.sha256(recording.bundle).hexdigest() == recording.header["bundle_sha256"], "the bundle inside")
    return recording


def iter_blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (kind, payload) of every block, with the chain of checksums checked."""
    magic, version, chain = struct.unpack_from("<8sII", data)
    demand(magic == b"PANSRECD" and zlib.crc32(data[:12]) == chain, "no recording")
    demand(version == 1, f"version {version}")
    at, index, kind = 16, 0, 0
    while at < len(data):
        demand(kind != END, "bytes behind END")
        demand(at + 20 <= len(data), "cut within a block")
        length, number, kind, zeros, crc = struct.unpack_from("<IIB3sI", data, at)
        demand(zlib.crc32(data[at : at + 12], chain) == crc, f"the head of block {index}")
        demand(number == index and zeros == b"\0\0\0" and kind in LIMITS and length <= LIMITS[kind], f"block {index}")
        payload, tail = data[at + 16 : at + 16 + length], data[at + 16 + length : at + 20 + length]
        demand(len(tail) == 4, "cut within a block")
        chain = zlib.crc32(payload, crc)
        demand(int.from_bytes(tail, "little") == chain, f"the payload of block {index}")
        yield kind, payload
        at, index = at + 20 + length, index + 1


def _take(recording: Recording, kind: int, payload: bytes) -> None:
    if kind == HEADER:
        recording.header = strict_json(payload)
    elif kind == BUNDLE:
        demand(not recording.bundle, "a second bundle")
        recording.bundle = payload
    elif kind in ENTRIES:
        getattr(recording, ENTRIES[kind]).extend(_entries(payload))
    elif kind == CLOCK:
        recording.clock += struct.iter_unpack("<qQq", payload)
    elif kind == TIMINGS:
        for first, *times, count in struct.iter_unpack("<QqqqqI", payload):
            demand(count > 0, "a run of no decisions")
            recording.timings += [(first + k, *times) for k in range(count)]
    elif kind == EVENTS:
        recording.events += [strict_json(line) for line in payload.splitlines()]
    elif kind == DECISIONS:
        recording.log.take(payload)
    else:
        recording.end = strict_json(payload)


def _entries(payload: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(payload):
        demand(at + 12 <= len(payload), "an entry reaches beyond its block")
        host_ns, length = struct.unpack_from("<qI", payload, at)
        demand(length <= MIB and at + 12 + length <= len(payload), "an entry reaches beyond its block")
        yield host_ns, payload[at + 12 : at + 12 + length]
        at += 12 + length


class DecisionLog:
    """The compact form of decisions -> rows, and the hash of the log."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, ...]] = []
        self._known: list[Any] = []
        self._hashes = [hashlib.sha256() for _ in range(4)]  # verdicts, codes, whole runs, exposures
        self._walks = False  # whether any exposures were above 0
        self._open: NDArray[np.void] | None = None  # the last run, which may go on

    def take(self, payload: bytes) -> None:
        """Add the decisions of one block."""
        n_runs, n_verdicts, n_rows = struct.unpack_from("<III", payload)
        codes_at = 12 + 52 * n_runs + 18 * n_verdicts
        end = codes_at + 2 * n_rows
        demand(n_rows <= 1 << 18 and len(payload) in (end, end + 4 * n_verdicts), "sizes of a block of decisions")
        exposures = (
            list(struct.unpack_from(f"<{n_verdicts}I", payload, end)) if len(payload) > end else [0] * n_verdicts
        )
        runs = np.frombuffer(payload, RUN, n_runs, 12)
        verdicts = np.frombuffer(payload, np.dtype(VERDICT), n_verdicts, 12 + 52 * n_runs)
        codes = np.frombuffer(payload, "<u2", n_rows, codes_at)
        demand(int(runs["count"].sum(dtype=np.int64)) == n_rows and bool(runs["count"].all()), "runs of a block")
        demand(not runs["continues"][1:].any() and runs["continues"].max(initial=0) <= 1, "continued runs")
        following = zip(verdicts.tolist(), exposures)
        places = (place for run in runs for place in _places(run))
        for code, (place, truth) in zip(codes.tolist(), places):
            demand(code == NO_NUMBER or code <= len(self._known), "a code without its verdict")
            if code in (NO_NUMBER, len(self._known)):
                verdict = next(following, None)
                demand(verdict is not None, "too few verdicts")
                assert verdict is not None
                if code != NO_NUMBER:
                    self._known.append(verdict)
            else:
                verdict = self._known[code]
            (clicks, label, flags, probability, counts_crc), walked = verdict
            self.rows.append((*place, clicks, label, truth, flags, probability, counts_crc, walked))
        demand(next(following, None) is None, "too many verdicts")
        self._hash(runs, verdicts.tobytes(), codes.tobytes())
        self._hashes[3].update(struct.pack(f"<{n_verdicts}I", *exposures))
        self._walks = self._walks or any(exposures)

    def _hash(self, runs: NDArray[np.void], verdicts: bytes, codes: bytes) -> None:
        self._hashes[0].update(verdicts)
        self._hashes[1].update(codes)
        for run in runs:
            if run["continues"]:
                demand(self._open is not None, "the first run goes on from none")
                assert self._open is not None
                self._open["count"] += run["count"]
                for step in STEPS.values():
                    self._open[step] = run[step]
                continue
            if self._open is not None:
                self._hashes[2].update(self._open.tobytes())
            self._open = run.copy()

    def sha256(self) -> str:
        """Return the hash of the log so far, in hex."""
        runs = self._hashes[2].copy()
        if self._open is not None:
            runs.update(self._open.tobytes())
        digests = [self._hashes[0].digest(), self._hashes[1].digest(), runs.digest()]
        digests += [self._hashes[3].digest()] if self._walks else []
        return hashlib.sha256(b"".join(digests)).hexdigest()


def _places(run: Any) -> Iterator[tuple[tuple[int, ...], int]]:
    """The place of every decision of a run, and its truth; sums wrap as their fields do."""
    first = {name: int(run[name]) for name, _ in PLACE}
    steps = {"index": 1, "object": 0} | {name: int(run[step]) for name, step in STEPS.items()}
    bits = {name: 64 if dtype == "<u8" else 32 for name, dtype in PLACE}
    for n in range(int(run["count"])):
        yield tuple((value + n * steps[name]) % (1 << bits[name]) for name, value in first.items()), int(run["truth"])
