"""The first run on a machine: another process compiles the largest kernels while this one does everything else.

Owns the question whether they are compiled, the stamp that answers it, and the other process; what is compiled is warm.py's. A stamp in
the cache of kernels holds what they were made from: the sources, the versions, the processor. Where no stamp can be written, nothing is
done, and each process compiles for itself.
"""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from pans.runtime.errors import PansError

from .warm import JOBS, PATIENCE_S, Job, cache_folder, compile_settling, start

LARGEST = "core"  # the job of the other process
LATER = ("live.loop", "monitor.snapshot", "record.parted_recorder", "watch.watchers")
BESIDE = "link"  # what this process compiles meanwhile
# whose sources kernels are made from: SOURCES of wire/inner.py, which needs numba
PACKAGES = ("core", "decide", "flow", "instrument", "record", "timing", "turn", "wire")


@contextmanager
def compiled_beside() -> Iterator[Callable[[], None]]:
    """Begin to compile beside this process, if that has not been done; yield what waits until it is done."""
    process = _begin()
    if process is None:
        yield lambda: None
        return

    def wait() -> None:
        with suppress(OSError, PansError):  # it writes a file that nobody needs
            JOBS[BESIDE]()
        with suppress(subprocess.TimeoutExpired):  # then this process compiles, as it would have without the other
            process.communicate(timeout=PATIENCE_S)
            if process.returncode == 0:
                note_compiled()

    try:
        yield wait
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def _begin() -> subprocess.Popen[str] | None:
    """Start the other process; None where it is not needed or not possible."""
    with suppress(OSError):
        stamp = _stamp()
        if stamp is not None and not stamp.exists():
            return start(Job(LARGEST, ("-m", "pans.runtime.operate.warm", LARGEST)))
    return None


def load_ahead() -> None:
    """Load what a run needs besides, while its port opens: nothing of it has to be loaded between there and ARM."""
    from pans.runtime.record.recorder import load_kernels
    from pans.runtime.wire.bulk import BulkDecoder

    load_kernels()
    BulkDecoder().warm_up()
    compile_settling()
    for name in LATER:
        import_module(f"pans.runtime.{name}")


def note_compiled() -> None:
    """Remember that the largest kernels are in the cache."""
    stamp = _stamp()
    if stamp is not None:
        with suppress(OSError):
            for old in stamp.parent.glob(stamp.name.rpartition("-")[0] + "-*"):
                old.unlink()
            stamp.touch()


def _stamp() -> Path | None:
    """Return the stamp's path, None where nothing can be kept."""
    folder = cache_folder() if os.environ.get("NUMBA_CACHE_DIR") else cache_folder() / "__pycache__"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            return None
        digest = hashlib.sha256(f"{sys.version}{version('numba')}{_processor()}{platform.machine()}".encode())
        for package in PACKAGES:
            for path in sorted((Path(__file__).parents[1] / package).glob("*.py")):
                facts = path.stat()
                digest.update(f"{path.name}{facts.st_size}{facts.st_mtime_ns}".encode())
    except OSError:
        return None
    return folder / f"pans-compiled-{digest.hexdigest()[:16]}"


def _processor() -> str:
    """Return the processor's name, "" where it cannot be read; platform.processor() starts a process for it."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as facts:
        return next((line for line in facts if line.startswith("model name")), "")
    return ""
