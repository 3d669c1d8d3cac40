"""`pans bench ingest`: wire bytes to click words, and the whole way to recorded decisions, beside a copy of the same bytes.

The whole way has CRC, loss accounting, dark-count monitoring, the decision log with its hash, and checksums on disk.
"""

from __future__ import annotations

import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.errors import UsageError
from pans.bundle.backends import Decider, make_decider
from pans.bundle.sensor import Bundle, bundle_bytes, load_bundle
from pans.decide.dark import dark_report
from pans.decide.kernel import StreamCore
from pans.decide.plan import Plan
from pans.decide.still import DARK_CLICKS, DARK_EXPOSURES
from pans.protocol.wire import Arm, FrameBlock, FrameDecoder, encode_frames, pack_body
from pans.record.reading import read_recording
from pans.record.recorder import Recorder, repeated_setup
from pans.record.replay import replay

from . import streams
from .rows import BenchOptions, Row, copy_ns, cpu_time
from .streams import Rows

PAYLOAD_BYTES = 16_384
STREAM_BYTES = 1 << 22
ZEROS = (0.0, 0.5, 0.9, 0.97, 0.999, 1.0)
WINDOWS = (1, 2, 5, 10, 20)


def bench_ingest(options: BenchOptions) -> list[Row]:
    """Return the rows of decoding at several densities of zeros, of sequential streams, then of the whole way for several windows."""
    rows = [_decode_row(zeros) for zeros in ZEROS]
    dense, sparse = wire_stream(0.0)[0], wire_stream(0.9)[0][: STREAM_BYTES // 16]
    plain = _rate_mb(len(sparse), cpu_time(lambda: FrameDecoder().feed(sparse), 3).least_s)
    rows += [
        {"name": "decode in plain Python, 90.0% zero bytes", "MB_s": plain},
        {"name": "zlib.crc32 of the same bytes", "MB_s": _rate_mb(len(dense), cpu_time(lambda: zlib.crc32(dense)).least_s)},
        {"name": "memory copy of 64 MiB", "MB_s": _rate_mb(1 << 26, copy_ns(1 << 26) / 1e9)},
    ]  # fmt: skip
    bundle, _ = load_bundle(options.first_bundle)
    rows += stream_rows(bundle, options.quick)
    if bundle.automaton is not None:
        return rows  # the rest is of parallel measurements
    rows += [] if options.bundles else stream_rows(streams.made_automaton(), options.quick)
    for shots in WINDOWS:
        backend = "table" if shots == 1 and bundle.table is not None else "auto"
        rows.append(_whole_row(bundle, shots, backend, options.quick))
    return rows


def wire_stream(zeros: float) -> tuple[bytes, int]:
    """Return a stream of about STREAM_BYTES whose payload bytes are 0 with probability `zeros`, and how many frames it has."""
    rng = np.random.default_rng(round(1000 * zeros))
    blocks = []
    for seq in range(STREAM_BYTES // PAYLOAD_BYTES):
        words = rng.integers(1, 256, (PAYLOAD_BYTES // 8, 8), dtype=np.uint8)
        words[rng.random(words.shape) < zeros] = 0
        blocks.append(encode_frames(FrameBlock(seq, 0, 1000 * seq, seq * len(words), 10, 0, words), streams.SESSION))
    return b"".join(blocks), len(blocks)


def _decode_row(zeros: float) -> Row:
    data, n_frames = wire_stream(zeros)
    reads = streams.reads_of(data)

    def decode() -> None:
        decoder = FrameDecoder()
        found = sum(len(spans) for read in reads for spans in decoder.bodies(read))
        if found != n_frames or decoder.counters.bytes_discarded:
            raise RuntimeError(f"{found} of {n_frames} frames decoded: the benchmark is wrong")

    spent, copied_s = cpu_time(decode), copy_ns(len(data)) / 1e9
    return {
        "name": f"decode, {zeros:.1%} zero bytes, CRC checked",
        "MB_s": _rate_mb(len(data), spent.least_s),
        "MB_s_median": _rate_mb(len(data), spent.median_s),
        "copy_MB_s": _rate_mb(len(data), copied_s),
        "of_copy_rate": round(copied_s / spent.least_s, 3),
        "runs": spent.runs,
        "lost_or_wrong": 0,
    }


def _rate_mb(n_bytes: int, seconds: float) -> int:
    return round(n_bytes / seconds / 1e6)


def stream_rows(bundle: Bundle, quick: bool) -> list[Row]:
    """Return rows of `bundle`'s sequential stream: compiled steps, and the replay of a recording."""
    try:
        decider = make_decider(bundle, backend="auto" if bundle.table is None else "table")
    except UsageError as error:
        return [{"name": f"sequential, {bundle.name}", "skipped": str(error)}]
    plan = streams.sequential_plan(bundle, decider)
    n_visits = 1_000 if quick else 20_000
    frames = list(streams.visits(plan, n_visits))
    wanted, exposures = streams.decided_one_by_one(plan, decider, frames), n_visits * plan.slots_per_cycle
    core, reads = StreamCore(plan, decider, 1, 0, streams.SESSION), streams.reads_of(b"".join(frames))
    found = list[Rows]()
    streams.decided_in_stream(core, reads, found)
    spent = cpu_time(lambda: streams.decided_in_stream(core, reads), 5)
    bulk = _rates(spent, exposures, len(wanted)) | {"changed_percent": streams.percent_changed(found, wanted)}
    name = f"sequential, {bundle.name}, {decider.name}"
    replayed = _replay_row(bundle, plan, decider, frames, wanted)
    return [{"name": f"wire to decisions, {name}", **bulk}, {"name": f"replay, {name}", **replayed}]


def _rates(spent: Any, exposures: int, decisions: int) -> Row:
    return {
        "rate": round(exposures / spent.least_s),
        "rate_median": round(exposures / spent.median_s),
        "ns_per_exposure": round(spent.least_s / exposures * 1e9, 3),
        "decisions_s": round(decisions / spent.least_s),
        "exposures": exposures,
        "runs": spent.runs,
    }


def _replay_row(bundle: Bundle, plan: Plan, decider: Decider, frames: list[bytes], wanted: Rows) -> Row:
    """`pans replay` of a recording of the stream, whose decisions were made one by one."""
    drive = {} if plan.automaton is None else {"drive": plan.drive, "confidence": 0.0}
    config = {"shots": 1, "tick_hz": streams.TICK_HZ, "backend": decider.name, **drive}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.pansrec"
        with Recorder(path, {"simulated": True, "config": config}, bundle=bundle_bytes(bundle)) as recorder:
            for command in repeated_setup(plan, Arm(0, 0, 1000), streams.SESSION):
                recorder.add_command(0, command)
            decoder = FrameDecoder()
            for data in frames:
                recorder.add_message(0, pack_body(decoder.feed(data)[0]))
            recorder.add_decisions(wanted)
            recorder.close({})
        recording = read_recording(path)
        found = replay(recording, bundle)
        spent = cpu_time(lambda: replay(recording, bundle), 5)
        exposures = len(frames) // 2 * plan.slots_per_cycle
        row = _rates(spent, exposures, found.decisions) | {"bytes": recording.size}
    return row | {"changed_percent": 0.0 if found.as_recorded else 100.0}


def _whole_row(bundle: Bundle, shots: int, backend: str, quick: bool) -> Row:
    plan = streams.parallel_plan(bundle.n_features, shots)
    decider = make_decider(bundle, shots=shots, backend=backend)
    n_visits = 40 if quick else 240
    reads = streams.reads_of(b"".join(streams.parallel_visits(plan, n_visits)))
    frames, decided = n_visits * plan.slots_per_cycle, n_visits * (plan.shots_per_cycle // shots)

    def run(path: Path | None) -> None:
        core, rows = StreamCore(plan, decider, shots, 0, streams.SESSION), 0
        recorder = None if path is None else Recorder(path, {"simulated": True}, overwrite=True)
        for data in reads:
            for batch in core.feed(data):
                rows += len(batch.rows)
                if recorder is not None:
                    recorder.add_decisions(batch.rows)
            tallies = core.core.windows.tallies
            dark_report(streams.DARK_CLICK, int(tallies[DARK_EXPOSURES]), int(tallies[DARK_CLICKS]))
        if recorder is not None:
            recorder.close({"decisions": rows})
        counters = core.core.tracker.counters
        if (rows, counters.exposures, counters.lost_exposures) != (decided, frames, 0):
            raise RuntimeError(f"{rows} of {decided} decisions, {counters}: the benchmark is wrong")

    with tempfile.TemporaryDirectory() as folder:
        recorded = cpu_time(lambda: run(Path(folder) / "bench.pansrec"), 5)
    unrecorded = cpu_time(lambda: run(None), 5)
    return {
        "name": f"wire to recorded decisions, d_f = {bundle.n_features}, K = {shots}, {decider.name}",
        "rate": round(frames / recorded.least_s),
        "rate_median": round(frames / recorded.median_s),
        "rate_not_recorded": round(frames / unrecorded.least_s),
        "decisions_s": round(decided / recorded.least_s),
        "wire_MB_s": _rate_mb(sum(map(len, reads)), recorded.least_s),
        "frames": frames,
        "lost": 0,
    }
