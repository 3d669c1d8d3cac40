"""`pans doctor --warm` runs the ordinary commands once in virtual time, so that all kernels are compiled into the cache."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pans.runtime.cli import say

from .batch import run_item

PATIENCE_S = 600.0
FINE = (0, 1, 4)  # a run may be late, and its verdict FAIL, on a machine that compiles
WORDS_MOST = 300
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
        jobs = list(pool.map(lambda name: run_once(name, COMMANDS[name], scratch), COMMANDS))
    return {
        "seconds": time.perf_counter() - began_s,
        "processes": processes,
        "folder": str(folder),
        "kernels": len(compiled_in(folder)) - known,
        "jobs": jobs,
    }


def run_once(name: str, words: Sequence[str], folder: str) -> dict[str, Any]:
    """Run one command in a process of its own, with its files in `folder`; return {name, seconds, ok, told}."""
    found = run_item((*words, "--no-realtime", "--out", name), folder, PATIENCE_S)
    ok = found["exit"] in FINE and found["error"] is None
    told = "" if ok else str(found["error"])[-WORDS_MOST:]
    say(f"pans: compiled: {name}, {found['seconds']:.1f} s{'' if ok else ', FAILED: ' + told}")
    return {"name": name, "seconds": found["seconds"], "ok": ok, "told": told}


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
