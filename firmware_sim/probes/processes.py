"""The processes of a trial: how they are started, spoken to and ended, and what the system tells about them.

Owns child processes and the readings of /proc; never knows what a child does. A child is a module of ours that is started with
`-m`, says one JSON object per line and may be told one line at a time. Commands of the package are started by `start_command`.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

PATIENCE_S = 30.0  # longer than any child needs on a loaded machine
KERNEL_PARENT = 2  # the pid of kthreadd, whose children are threads of the kernel


def one_thread() -> dict[str, str]:
    """Return this process's environment with one BLAS thread: whoever shares a core with what is measured must not start more."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def start_command(words: list[str], errors: Path, core: int | None = None) -> subprocess.Popen[str]:
    """Start the command `pans words...`, on a core of its own if one is named; its stderr goes to the file `errors`."""
    pinned = "" if core is None else f"import os; os.sched_setaffinity(0, {{{core}}}); "
    command = f"{pinned}import sys; from pans.runtime.cli import main; sys.exit(main(sys.argv[1:]))"
    with errors.open("wb") as file:
        return subprocess.Popen(
            [sys.executable, "-c", command, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=file,
            env=one_thread(),
            text=True,
        )


class Child:
    """A module in a process of its own, named with its package, from construction to `end` or `kill`."""

    def __init__(self, module: str, *words: object) -> None:
        self.name = " ".join(map(str, (module, *words[:1])))
        command = [sys.executable, "-m", module, *map(str, words)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=one_thread(), text=True
        )

    def said(self) -> dict[str, Any]:
        """Return the next line of the child, an object; RuntimeError if it has ended."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name} ended with {self.process.wait(PATIENCE_S)}")
        return dict(json.loads(line))

    def tell(self, word: object) -> None:
        """Send the child one line."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{word}\n")
        self.process.stdin.flush()

    def end(self) -> None:
        """Close its standard input and wait; it is killed if it does not end. Idempotent."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.kill()

    def kill(self) -> None:
        """End it at once, if it is still there."""
        self.process.kill()
        self.process.wait()


def say(**facts: Any) -> None:
    """From within a child: say one JSON object to the process that started it."""
    print(json.dumps(facts), flush=True)


def leave_on_sigterm() -> None:
    """From within a child: SIGTERM raises SystemExit."""
    signal.signal(signal.SIGTERM, _leave)


def _leave(signum: int, frame: object) -> NoReturn:
    raise SystemExit(0)


def wait_until(condition: Callable[[], bool], patience_s: float = PATIENCE_S, every_s: float = 0.001) -> None:
    """Wait until `condition()`; RuntimeError after `patience_s`."""
    deadline = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f"nothing happened for {patience_s} s")
        time.sleep(every_s)


def sleep_until(at_ns: int) -> None:
    """Sleep until a time of time.perf_counter_ns, which is common to all processes."""
    time.sleep(max(0.0, (at_ns - time.perf_counter_ns()) * 1e-9))


def tail(path: Path) -> str:
    """Return the end of a file that a process has written its errors to."""
    return path.read_text(errors="replace")[-500:].strip()


# ---- what the system tells ----


def has_real_time(n_cores: int = 2) -> bool:
    """Whether this is Linux with SCHED_FIFO and at least `n_cores` cores for this process."""
    return hasattr(os, "sched_setscheduler") and len(os.sched_getaffinity(0)) >= n_cores


def processor_s(pid: int) -> float:
    """Return the processor time that a process has taken, in seconds; OSError when it has ended."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def stolen_s(cores: list[int]) -> dict[int, float]:
    """Return for how long the hypervisor ran something else on each of `cores` since the start, by its own count."""
    lines = [line.split() for line in Path("/proc/stat").read_text().splitlines() if line.startswith("cpu")]
    ticks = {line[0]: int(line[8]) for line in lines}
    return {core: ticks[f"cpu{core}"] / os.sysconf("SC_CLK_TCK") for core in cores}


def real_time_programs(known: set[int], parents: frozenset[int] = frozenset()) -> set[str]:
    """Return the programs of real-time priority now: "name (priority)".

    Left out are the pids `known`, the children of `parents`, and threads of the kernel.
    """
    found = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = path.read_text().partition("(")[2].rpartition(")")
        except OSError:  # it has just ended
            continue
        fields = rest.split()
        parent, priority = int(fields[1]), int(fields[37])
        if priority and parent not in (0, KERNEL_PARENT, *parents) and int(path.parent.name) not in known:
            found.add(f"{name} ({priority})")
    return found
