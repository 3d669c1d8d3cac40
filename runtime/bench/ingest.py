"""`pans bench ingest`: wire bytes to click words, and the whole way to recorded decisions, beside a copy of the same bytes.

Owns the made-up streams (seeded, of known content) and the rows. The whole way has everything switched on: CRC, loss accounting, dark-count
monitoring, the decision log with its hash and checksums on disk. `--frames N` runs it long enough to show that a steady state
allocates nothing.
"""

from __future__ import annotations

import gc
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.core.plan import NO_SHOT, Plan
from pans.runtime.core.window import DARK_CLICKS, DARK_EXPOSURES
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.instrument.channel_health import DarkMonitor
from pans.runtime.record import Recorder
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.watch import resources_used
from pans.runtime.wire.bulk import BulkDecoder
from pans.runtime.wire.framing import FrameDecoder
from pans.runtime.wire.messages import DARK_PATTERN, FrameBlock, Mark, encode_frames, encode_mark

from .rows import BenchOptions, Row, copy_ns, cpu_time
from .walks import made_automaton, stream_rows

SESSION = 0x5EED
PAYLOAD_BYTES = 16_384
STREAM_BYTES = 1 << 22
READ_BYTES = 1 << 18  # what a link hands over at once
BLOCK_FRAMES = 4096
VISIT_FRAMES = 8190  # of light, after DARK_FRAMES dark ones
DARK_FRAMES = 2
DARK_CLICK, CLICK = 0.01, 0.4
ZEROS = (0.0, 0.5, 0.9, 0.97, 0.999, 1.0)
MIB = 1 << 20


def bench_ingest(options: BenchOptions) -> list[Row]:
    """Return the rows of decoding at several densities of zeros, of sequential streams, then of the whole way for several windows."""
    rows: list[Row] = [_decode_row(zeros) for zeros in ZEROS] + [_plain_row(), _crc_row(), _copy_row()]
    bundle, _ = load_bundle(options.first_bundle)
    rows += stream_rows(bundle, options.quick)
    if bundle.automaton is not None:
        return rows  # the rest is of parallel measurements
    rows += [] if options.bundles else stream_rows(made_automaton(), options.quick)
    for shots, backend in ((1, "table"), (2, "auto"), (5, "auto"), (10, "auto"), (20, "auto")):
        if backend == "table" and bundle.table is None:
            backend = "auto"
        rows.append(_whole_row(bundle, shots, backend, options.quick))
    if options.frames:
        rows.append(_steady_row(bundle, options.frames))
    return rows


def _block(zeros: float, seq: int, rng: np.random.Generator) -> bytes:
    words = rng.integers(1, 256, (PAYLOAD_BYTES // 8, 8), dtype=np.uint8)
    words[rng.random(words.shape) < zeros] = 0
    return encode_frames(FrameBlock(seq, 0, 1000 * seq, seq * len(words), 10, 0, words), SESSION)


def _wire(zeros: float) -> tuple[bytes, int]:
    """A stream of about STREAM_BYTES whose payload bytes are 0 with probability `zeros`, and how many frames it has."""
    rng = np.random.default_rng(round(1000 * zeros))
    blocks = [_block(zeros, seq, rng) for seq in range(STREAM_BYTES // PAYLOAD_BYTES)]
    return b"".join(blocks), len(blocks)


def _decode_row(zeros: float) -> Row:
    data, n_frames = _wire(zeros)
    source = np.frombuffer(data, np.uint8)

    def decode() -> None:
        decoder = BulkDecoder()
        found = sum(
            len(spans)
            for start in range(0, len(source), READ_BYTES)
            for spans in decoder.bodies(source[start : start + READ_BYTES])
        )
        if found != n_frames or decoder.counters.bytes_discarded:
            raise RuntimeError(f"{found} of {n_frames} frames decoded: the benchmark is wrong")

    spent = cpu_time(decode)
    rate, copy = len(data) / spent.least_s, len(data) / copy_ns(len(data)) * 1e9
    return {
        "name": f"decode, {zeros:.1%} zero bytes, CRC checked",
        "MB_s": round(rate / 1e6),
        "MB_s_median": round(len(data) / spent.median_s / 1e6),
        "copy_MB_s": round(copy / 1e6),
        "of_copy_rate": round(rate / copy, 3),
        "runs": spent.runs,
        "lost_or_wrong": 0,
    }


def _plain_row() -> Row:
    data = _wire(0.9)[0][: STREAM_BYTES // 16]
    return {
        "name": "decode in plain Python, 90.0% zero bytes",
        "MB_s": round(len(data) / cpu_time(lambda: FrameDecoder().feed(data), 3).least_s / 1e6),
    }


def _crc_row() -> Row:
    data = _wire(0.0)[0]
    return {
        "name": "zlib.crc32 of the same bytes",
        "MB_s": round(len(data) / cpu_time(lambda: zlib.crc32(data)).least_s / 1e6),
    }


def _copy_row() -> Row:
    n_bytes = 1 << 26
    return {"name": "memory copy of 64 MiB", "MB_s": round(n_bytes / copy_ns(n_bytes) * 1e3)}


# -- the whole way ---------------------------------------------------------------------------------------------------------


def parallel_plan(n_patterns: int, shots: int) -> Plan:
    """Visits of DARK_FRAMES dark frames and about VISIT_FRAMES of light, a whole number of windows."""
    frames = VISIT_FRAMES // shots * shots
    pattern = np.concatenate([np.full(DARK_FRAMES, DARK_PATTERN), np.zeros(frames)]).astype(np.uint16)
    shot = np.concatenate([np.full(DARK_FRAMES, NO_SHOT), np.arange(frames)]).astype(np.uint16)
    return Plan(
        "parallel",
        n_patterns,
        np.arange(len(pattern)) * 100,
        pattern,
        shot,
        90,
        100,
        100 * len(pattern),
        frames,
        1,
        BLOCK_FRAMES,
        9.0,
    )


def visits(plan: Plan, first_visit: int, n_visits: int, first_seq: int) -> Iterator[bytes]:
    """Frames on the wire of consecutive visits, each with its mark; clicks with fixed probabilities, seeded."""
    rng = np.random.default_rng(first_visit)
    word_bytes = 1 if plan.n_patterns <= 8 else 2 if plan.n_patterns <= 16 else 8 * -(-plan.n_patterns // 64)
    seq, slots = first_seq, plan.slots_per_cycle
    for visit in range(first_visit, first_visit + n_visits):
        yield encode_mark(
            Mark(seq & 0xFFFFFFFF, visit & 0xFFFFFFF, visit % 10, visit * slots, visit * plan.cycle_ticks, 3.0), SESSION
        )
        clicks = (
            rng.random((slots, plan.n_patterns))
            < np.where(plan.slot_pattern == DARK_PATTERN, DARK_CLICK, CLICK)[:, None]
        )
        words = np.zeros((slots, word_bytes), np.uint8)
        packed = np.packbits(clicks, axis=1, bitorder="little")
        words[:, : packed.shape[1]] = packed
        for first in range(0, slots, BLOCK_FRAMES):
            seq += 1
            exposure = visit * slots + first
            part = words[first : first + BLOCK_FRAMES]
            yield encode_frames(
                FrameBlock(seq & 0xFFFFFFFF, 0, 100 * exposure, exposure, 100, visit & 0xFFFFFFF, part), SESSION
            )
        seq += 1


def _whole_row(bundle: Bundle, shots: int, backend: str, quick: bool) -> Row:
    plan = parallel_plan(bundle.n_features, shots)
    decider = make_decider(bundle, shots=shots, backend=backend)
    n_visits = 40 if quick else 240
    data = np.frombuffer(b"".join(visits(plan, 0, n_visits, 0)), np.uint8)
    frames = n_visits * plan.slots_per_cycle
    decided = n_visits * (plan.shots_per_cycle // shots)
    row: Row = {"name": f"wire to recorded decisions, d_f = {bundle.n_features}, K = {shots}, {decider.name}"}
    with tempfile.TemporaryDirectory() as folder:
        recorded = cpu_time(
            lambda: _run(plan, decider, shots, data, frames, decided, Path(folder) / "bench.pansrec"), 5
        )
    bare = cpu_time(lambda: _run(plan, decider, shots, data, frames, decided, None), 5)
    rate = frames / recorded.least_s
    row |= {
        "rate": round(rate),
        "rate_median": round(frames / recorded.median_s),
        "rate_not_recorded": round(frames / bare.least_s),
    }
    return row | {
        "decisions_s": round(decided / recorded.least_s),
        "wire_MB_s": round(len(data) / recorded.least_s / 1e6),
        "frames": frames,
        "lost": 0,
    }


def _run(
    plan: Plan, decider: Decider, shots: int, data: NDArray[np.uint8], frames: int, decided: int, path: Path | None
) -> None:
    core = StreamCore(plan, decider, shots, 0, SESSION)
    monitor = DarkMonitor(DARK_CLICK)
    recorder = None if path is None else Recorder(path, {"simulated": True}, overwrite=True)
    rows = 0
    for start in range(0, len(data), READ_BYTES):
        for batch in core.feed(data[start : start + READ_BYTES]):
            rows += len(batch.rows)
            if recorder is not None:
                recorder.add_decisions(batch.rows)
        tallies = core.core.windows.tallies
        monitor.report(int(tallies[DARK_EXPOSURES]), int(tallies[DARK_CLICKS]))
    if recorder is not None:
        recorder.close({"decisions": rows})
    counters = core.core.tracker.counters
    if (rows, counters.exposures, counters.lost_exposures) != (decided, frames, 0):
        raise RuntimeError(f"{rows} of {decided} decisions, {counters}: the benchmark is wrong")


def _steady_row(bundle: Bundle, wanted: int) -> Row:
    """Run the whole way over `wanted` frames: memory and collections before and after, the counters at the end."""
    shots = 1 if bundle.table is not None else 10
    plan = parallel_plan(bundle.n_features, shots)
    decider = make_decider(bundle, shots=shots)
    core = StreamCore(plan, decider, shots, 0, SESSION)
    piece_visits = 64
    slots, messages = plan.slots_per_cycle, 1 + -(-plan.slots_per_cycle // BLOCK_FRAMES)
    chunk = _Renumbered(b"".join(visits(plan, 0, piece_visits, 0)), plan)
    rows = labels = done = collections = 0
    memory: list[int] = []
    spent_s = 0.0
    gc.collect()
    while done < wanted:
        gc.disable()  # making the stream allocates; only the way through it is looked at
        data = chunk.at(done // slots, done // slots * messages)
        gc.enable()
        before, start_s = _collections(), time.thread_time()
        for batch in core.feed(data):
            rows += len(batch.rows)
            labels += int(batch.rows["label"].sum(dtype=np.int64))
        spent_s += time.thread_time() - start_s
        collections += _collections() - before
        done += piece_visits * slots
        memory.append(resources_used()["rss_bytes"])
    counters = core.core.tracker.counters
    settled = memory[min(len(memory) - 1, 8) :]
    return {
        "name": f"steady state over {done:.3g} frames, K = {shots}, {decider.name}",
        "rate": round(done / spent_s),
        "resident_MiB_after_start": round(settled[0] / MIB, 2),
        "resident_MiB_largest": round(max(settled) / MIB, 2),
        "resident_growth_kB": (settled[-1] - settled[0]) // 1024,
        "collections": collections,
        "decisions": rows,
        "label_sum": labels,
        "exposures": counters.exposures,
        "lost": counters.lost_exposures,
        "gaps": counters.gaps,
    }


class _Renumbered:
    """One stretch of stream that is sent again and again with later numbers, so that 10^9 frames need no 10^9 frames of memory."""

    def __init__(self, data: bytes, plan: Plan) -> None:
        self._frames = FrameDecoder().feed(data)
        self._plan = plan

    def at(self, visit: int, seq: int) -> bytes:
        """The stretch as it would be sent from `visit` on, with sequence numbers from `seq` on."""
        from pans.runtime.wire.messages import decode_frames, decode_mark

        slots, ticks = self._plan.slots_per_cycle, self._plan.cycle_ticks
        sent = []
        for frame in self._frames:
            if frame.type == 0x92:
                mark = decode_mark(frame.payload)
                moved = (mark.seq + seq) & 0xFFFFFFFF
                number = (mark.object_index + visit) & 0xFFFFFFF
                sent.append(
                    encode_mark(
                        mark._replace(
                            seq=moved, object_index=number, exposure_index=mark.exposure_index + visit * slots
                        ),
                        SESSION,
                    )
                )
            else:
                block = decode_frames(frame.payload)
                moved, number = (block.seq + seq) & 0xFFFFFFFF, (block.object_index + visit) & 0xFFFFFFF
                block = block._replace(
                    tick=block.tick + visit * ticks, exposure_index=block.exposure_index + visit * slots
                )
                sent.append(encode_frames(block._replace(seq=moved, object_index=number), SESSION))
        return b"".join(sent)


def _collections() -> int:
    return sum(generation["collections"] for generation in gc.get_stats())
