"""Bytes and frames that no host or instrument sends (`pans fuzz`), at the decoder, the instrument and the host's session and core.

Owns how much is sent and what is reported; the input and its limits are fuzzer.py's, files resealed/'s, sessions fields.py's. A crash, a
hang or a broken limit ends the run with the seed that repeats it.
"""

from __future__ import annotations

import tempfile
import time
import traceback
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

from pans.firmware_sim.checks.streams import StreamCounts, compare_streams
from pans.firmware_sim.options import option
from pans.firmware_sim.resealed import fuzz_files
from pans.runtime.cli import say
from pans.runtime.errors import UsageError
from pans.runtime.ranges import Range
from pans.runtime.turn.system import offered

from . import Report, Trial, figures_text
from .fields import MAX_GROWTH_MIB, MAX_MIB, resident_mib, sessions, sessions_beside
from .fuzzer import FuzzCounts, Fuzzer

BATCH_BYTES = 1 << 16
BATCH_FRAMES = 200


def fuzz(seed: int, n_bytes: int, n_frames: int) -> tuple[FuzzCounts, str]:
    """Send that much; return the counts and "" or what went wrong, with a traceback."""
    fuzzer = Fuzzer(seed)
    counts = fuzzer.counts
    try:
        while counts.bytes < n_bytes or counts.frames < n_frames:
            if counts.bytes < n_bytes:
                fuzzer.random_bytes(min(BATCH_BYTES, n_bytes - counts.bytes))
            if counts.frames < n_frames:
                fuzzer.structured_frames(BATCH_FRAMES)
    except Exception:
        return counts, traceback.format_exc()
    fuzzer.count_device()
    return counts, ""


@dataclass(frozen=True, slots=True)
class Settings:
    """How much to send, divided over how many seeds."""

    bytes: int = option(
        100_000_000, type=Range(0, 10**15, whole=True).option, help="random bytes (default 100 million)"
    )
    frames: int = option(
        1_000_000, type=Range(0, 10**12, whole=True).option, help="structured frames (default one million)"
    )
    files: int = option(
        0,
        type=Range(0, 10**9, whole=True).option,
        help="instead of those: changed files with right checksums, verified and used",
    )
    fields: int = option(
        0,
        type=Range(0, 10**9, whole=True).option,
        help="instead of those: whole sessions in which a field says something else",
    )
    streams: int = option(
        0,
        type=Range(0, 10**10, whole=True).option,
        help="instead of those: random streams with faults, by the plain core and by the compiled turn",
    )
    over: str = option(
        "virtual",
        "of --fields: virtual time, tcp in real time, or c: the reference firmware in virtual time",
        choices=("virtual", "tcp", "c"),
    )
    jobs: int = option(
        1,
        type=Range(1, 256, whole=True).option,
        help="processes that run sessions of --fields side by side (default 1)",
    )
    seed: int = option(1, type=Range(0, (1 << 63) - 1, whole=True).option, help="the first seed (default 1)")
    parts: int = option(
        20, type=Range(1, 10**6, whole=True).option, help="seeds that the work is divided over (default 20)"
    )


def run(settings: Settings) -> Report:
    """Send it, seed by seed, until something is found."""
    if settings.files:
        return _run_files(settings)
    if settings.fields:
        return _run_sessions(settings)
    if settings.streams:
        return _run_streams(settings)
    started = time.perf_counter()
    total: dict[str, float] = {}
    parts = settings.parts
    for seed in range(settings.seed, settings.seed + parts):
        counts, failure = fuzz(seed, -(-settings.bytes // parts), -(-settings.frames // parts))
        for name, value in asdict(counts).items():
            total[name] = max(total.get(name, 0), value) if name == "slowest_call_s" else total.get(name, 0) + value
        if failure:
            say(failure)
            say(f"pans fuzz: seed {seed} failed after {counts.bytes} bytes and {counts.frames} frames")
            return Report({**total, "failed_seed": seed}, False, "")
    figures = {**total, "failed_seed": None, "seconds": time.perf_counter() - started}
    return Report(figures, True, figures_text(figures))


def _run_streams(settings: Settings) -> Report:
    if missing := offered():
        raise UsageError(f"--streams compares the compiled turn with the plain core: {missing}")
    started, total = time.perf_counter(), StreamCounts()
    for seed in range(settings.seed, settings.seed + settings.parts):
        counts, failure = compare_streams(seed, -(-settings.streams // settings.parts))
        total = StreamCounts(*map(sum, zip(astuple(total), astuple(counts))))
        if failure:
            say(failure)
            return Report({**asdict(total), "failed_seed": seed}, False, "")
    figures = {**asdict(total), "failed_seed": None, "seconds": time.perf_counter() - started}
    return Report(figures, True, figures_text(figures))


def _run_files(settings: Settings) -> Report:
    started, figures = time.perf_counter(), {"files": 0, "files_accepted": 0, "slowest_answer_s": 0.0}
    for seed in range(settings.seed, settings.seed + settings.parts):
        with tempfile.TemporaryDirectory() as folder:
            counts, failure = fuzz_files(seed, -(-settings.files // settings.parts), Path(folder))
        figures["files"] += counts.files
        figures["files_accepted"] += counts.accepted.total()
        figures["slowest_answer_s"] = max(figures["slowest_answer_s"], counts.slowest_answer_s)
        if failure:
            say(failure)
            return Report({**figures, "failed_seed": seed}, False, "")
    told = {**figures, "failed_seed": None, "seconds": time.perf_counter() - started}
    return Report(told, True, figures_text(told))


def _run_sessions(settings: Settings) -> Report:
    started, before_mib = time.perf_counter(), resident_mib()
    if settings.jobs > 1:
        ended, wrong, memory_mib = sessions_beside(settings.seed, settings.fields, settings.over, settings.jobs)
        fits = memory_mib < MAX_MIB
    else:
        ended, wrong = sessions(settings.seed, settings.fields, settings.over)
        memory_mib = resident_mib()
        fits = memory_mib - before_mib < MAX_GROWTH_MIB  # what the process held already is not the sessions'
    for one in wrong:
        say(one)
    figures: dict[str, Any] = {"sessions": ended.total(), **{f"sessions_{how}": n for how, n in sorted(ended.items())}}
    figures |= {"memory_mib": memory_mib, "seconds": time.perf_counter() - started}
    failed = next((int(one.split()[1].rstrip(",")) for one in wrong), None)
    passed = not wrong and fits
    return Report({**figures, "failed_seed": failed}, passed, figures_text({**figures, "failed_seed": failed}))


TRIAL = Trial(Settings, run)
