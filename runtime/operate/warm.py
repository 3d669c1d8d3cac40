"""Kernels before their time: `pans doctor --warm` runs the ordinary commands once in virtual time, so that all are compiled into the cache.

`load_ahead` loads what a run needs while its port opens.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

from pans.runtime.cli import say

PATIENCE_S = 600.0
FINE = (0, 1, 4)  # a run may be late, and its verdict FAIL, on a machine that compiles
WORDS_MOST = 300
LATER = ("live.loop", "monitor.snapshot", "watch.watchers")
STILL = "sim:oled-qcmos?pace=fast&scene=fashion200"
COMMANDS: Mapping[str, Sequence[str]] = {
    "demo": ("demo", "--pace", "fast", "--trials", "1", "--seconds", "0.2"),
    "run": ("run", "fashion10", "--device", STILL, "--decisions", "3"),
}


def warm() -> dict[str, Any]:
    """Compile everything; return {seconds, processes, folder, kernels, jobs}, `kernels` how many compiled ones are new in the cache."""
    began_s, folder = time.perf_counter(), cache_folder()
    known, processes = len(compiled_in(folder)), os.cpu_count() or 1
    with tempfile.TemporaryDirectory(prefix="pans-warm-") as scratch, ThreadPoolExecutor(processes) as pool:
        jobs = list(pool.map(lambda name: run_once(name, COMMANDS[name], Path(scratch) / name), COMMANDS))
    return {
        "seconds": time.perf_counter() - began_s,
        "processes": processes,
        "folder": str(folder),
        "kernels": len(compiled_in(folder)) - known,
        "jobs": jobs,
    }


def run_once(name: str, words: Sequence[str], out: Path) -> dict[str, Any]:
    """Run one command in a process of its own, with its files in `out`; return {name, seconds, ok, told}."""
    began_s = time.perf_counter()
    command = [sys.executable, "-m", "pans", *words, "--no-realtime", "--json", "--out", str(out)]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S)
        ok, last = done.returncode in FINE, (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    except subprocess.TimeoutExpired:
        ok, last = False, f"not compiled within {PATIENCE_S:g} s"
    row = {"name": name, "seconds": time.perf_counter() - began_s, "ok": ok, "told": "" if ok else last[:WORDS_MOST]}
    say(f"pans: compiled: {name}, {row['seconds']:.1f} s{'' if ok else ', FAILED: ' + last[:WORDS_MOST]}")
    return row


def load_ahead() -> None:
    """Load what a run needs besides, while its port opens: nothing of it has to be loaded between there and ARM."""
    import numpy as np

    from pans.runtime.kernel.receive import unpack_blocks
    from pans.runtime.record.recorder import load_kernels
    from pans.runtime.wire.framing import FrameDecoder

    load_kernels()
    FrameDecoder().warm_up()
    unpack_blocks(np.zeros(8, np.uint8), np.zeros((0, 4), np.int64), np.zeros(1, np.uint16), np.zeros(1, np.uint8))
    for name in LATER:
        import_module(f"pans.runtime.{name}")


def cache_folder() -> Path:
    """Return where numba keeps compiled kernels: NUMBA_CACHE_DIR, or the package's own folders."""
    named = os.environ.get("NUMBA_CACHE_DIR", "")
    return Path(named) if named else Path(__file__).parents[1]


def compiled_in(folder: Path) -> list[Path]:
    """Return the files of compiled kernels."""
    return list(folder.rglob("*.nbc"))


def words_of(found: Mapping[str, Any]) -> str:
    """Return what was done in words."""
    failed = [f"FAILED: {row['name']}: {row['told']}" for row in found["jobs"] if not row["ok"]]
    text = (
        f"{found['kernels']} kernels compiled in {found['seconds']:.1f} s by {found['processes']} processes at a time"
    )
    return "\n".join([text, f"they are kept in {found['folder']}", *failed])
