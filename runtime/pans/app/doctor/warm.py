"""`pans doctor --warm` runs a command of each kind once in virtual time, so that all kernels of runs are compiled into the cache."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pans.app.commands.batch import run_item
from pans.base.console import say
from pans.bundle.automaton import reachable_automaton
from pans.bundle.sensor import BackEnd, Bundle, Shown, make_bundle, write_bundle

PATIENCE_S = 900.0
FINE = (0, 1, 3, 4)  # a run may be short, early in its alarms or late, and its verdict FAIL, on a machine that compiles
WORDS_MOST = 300
STILL = ("run", "fashion10", "--device", "sim:oled-qcmos?pace=fast&scene=fashion200", "--decisions", "3")
SHORT = ("--seconds", "0.05")
COMMANDS: Mapping[str, Sequence[str]] = {
    "walks": ("demo", "--pace", "fast", "--trials", "1", "--seconds", "0.2"),
    "objects in flow": ("run", "cells.pans", "--device", "sim:wdm-snspd?pace=fast&scene=cells-in-flow", "--flow", "cells", *SHORT),
    "fixed patterns, parallel channels": ("run", "parallel.pans", "--device", "sim:wdm-snspd?pace=fast", "--decisions", "3"),
    "photon numbers": ("run", "numbers.pans", "--device", "sim:dmd-qcmos?pace=fast", "--decisions", "3"),
    "two channels": ("run", "pairs.pans", "--device", "sim:dmd-four-snspd?pace=fast", "--decisions", "3"),
    "tape": ("run", "tape.pans", "--device", "sim:flow-snspd?pace=fast&scene=bar-tape", "--flow", "tape", *SHORT),
    "heads": (*STILL, "--shots", "4"),
    "heads in eight bits": (*STILL, "--backend", "int8"),
    "dark counts": (*STILL, "--dark-slots", "5", "--on-dark", "abstain"),
}  # fmt: skip
AFTERWARDS = {"replay": ("replay", "walks/run.pansrec")}
CELLS = ("membrane", "nucleolus", "mitochondria", "null")  # the classes of cells-in-flow


def warm(report: Callable[[float], None] = lambda share: None) -> dict[str, Any]:
    """Compile everything; return {seconds, processes, folder, kernels, jobs}, `kernels` how many compiled ones are new in the cache.

    `report` is told the share of the jobs that are done.
    """
    from pans.base.machine import kernel_folder, spin

    began_s, folder, processes = time.perf_counter(), kernel_folder(), os.cpu_count() or 1
    known, jobs = len(compiled_in(folder)), list[dict[str, Any]]()
    spin(np.array([1, 0]))  # of a core kept awake
    with tempfile.TemporaryDirectory(prefix="pans-warm-") as scratch, ThreadPoolExecutor(processes) as pool:
        for name, bundle in bundles():
            write_bundle(bundle, Path(scratch) / f"{name}.pans")
        for wave in (COMMANDS, AFTERWARDS):
            for job in pool.map(lambda one: run_once(one[0], one[1], scratch), wave.items()):
                jobs.append(job)
                report(len(jobs) / len({**COMMANDS, **AFTERWARDS}))
    return {
        "seconds": time.perf_counter() - began_s,
        "processes": processes,
        "folder": str(folder),
        "kernels": len(compiled_in(folder)) - known,
        "jobs": jobs,
    }


def bundles() -> Iterator[tuple[str, Bundle]]:
    """Yield (name, bundle) of each kind that is not shipped; what they decide means nothing."""
    ten = tuple(map(str, range(10)))
    table = BackEnd(table=(np.arange(8)[:, None] >> np.arange(10) % 3 & 1).astype(np.float32))
    for name, classes, shape in (("parallel", ten, (28, 28)), ("cells", CELLS, (40, 40)), ("tape", ten, (1, 80))):
        levels = 255 * (np.arange(shape[0] * shape[1]) % 3 == np.arange(3)[:, None])
        back_end = BackEnd(table=np.asarray(table.table)[:, : len(classes)])
        yield name, _made(name, classes, shape, Shown(256, levels, 4 / 255), back_end=back_end)
    for name, outcomes, photons in (("numbers", 3, 0.1), ("pairs", 4, 0.2)):
        leaves = np.full((1 + outcomes, 10), 0.1)
        walk = reachable_automaton([0], [1], 1, 1 + np.arange(outcomes)[None], leaves, counts=name == "numbers")
        lit = np.arange(784) % 9 == np.arange(2 if name == "pairs" else 1)[:, None]
        yield name, _made(name, ten, (28, 28), Shown(2, lit.astype(int), photons), automaton=walk)


def _made(name: str, classes: Sequence[str], shape: tuple[int, int], shown: Shown, **decides: Any) -> Bundle:
    return make_bundle(
        name=name, task="speed", classes=classes, image_shape=shape, optics=shown, provenance={}, **decides
    )


def run_once(name: str, words: Sequence[str], folder: str) -> dict[str, Any]:
    """Run one command in a process of its own, with its files in `folder`; return {name, seconds, ok, told}."""
    files = ("--no-realtime", "--out", name) if words[0] in ("run", "demo") else ()
    found = run_item((*words, *files), folder, PATIENCE_S)
    ok = found["exit"] in FINE and found["error"] is None
    told = "" if ok else str(found["error"])[-WORDS_MOST:]
    say(f"pans: compiled: {name}, {found['seconds']:.1f} s{'' if ok else ', FAILED: ' + told}")
    return {"name": name, "seconds": found["seconds"], "ok": ok, "told": told}


def compiled_in(folder: Path) -> list[Path]:
    """Return the files of compiled kernels."""
    return list(folder.glob("*.nbc"))


def words_of(found: Mapping[str, Any]) -> str:
    """Return what was done in words."""
    failed = [f"FAILED: {row['name']}: {row['told']}" for row in found["jobs"] if not row["ok"]]
    text = (
        f"{found['kernels']} kernels compiled in {found['seconds']:.1f} s by {found['processes']} processes at a time"
    )
    rest = "those of training and benchmarks are compiled when they are first used, in some seconds"
    return "\n".join([text, f"they are kept in {found['folder']}", rest, *failed])
