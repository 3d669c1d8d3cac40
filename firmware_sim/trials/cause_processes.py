"""The processes of causes.py: an instrument with a script of faults, a host that disturbs itself, and a hog that takes its core.

Owns the script's form and what each process does when it is time; never compares. Each runs as a `Child` with its role as the first
word, says one JSON object when it is ready and reads the start time (time.perf_counter_ns, common to all processes) from its input.
"""

from __future__ import annotations

import gc
import json
import os
import select
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from pans.firmware_sim.ports.faulty import FaultyDevice, Schedule
from pans.firmware_sim.ports.serve import SimOptions, build_instrument
from pans.firmware_sim.ports.shell import open_port, serve
from pans.firmware_sim.probes.processes import say, sleep_until
from pans.firmware_sim.testing import N_PATTERNS, small_bundle
from pans.runtime.bundle.model import Bundle, bundle_bytes
from pans.runtime.core.decision import Output
from pans.runtime.core.plan import Plan, build_plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.instrument.profile import Profile, load_profile
from pans.runtime.link.base import open_link
from pans.runtime.live import LiveRun, Observers, RunOptions, run_live
from pans.runtime.record import Recorder

HOST_CORE, INSTRUMENT_CORE = 0, 1
HOG_PRIORITY = 60  # above all that runs here but the process that keeps the script
EXPOSURE_US = 250.0
DEADLINE_US = 10_000.0
HEAP_OBJECTS = 1_500_000  # a collection over them takes tens of milliseconds, as long as the other causes
PIPE_BYTES = 4096  # one page, the least that Linux gives
AFTER_S = 1.0
DISK_PRIORITY = 15  # the host's loop has 10
NEVER = 1 << 62


class Injection(NamedTuple):
    """One cause: begins `at_ns` after the start and lasts `length_ns`; `variant` counts within its kind."""

    kind: str
    at_ns: int
    length_ns: int
    variant: int


def setup() -> tuple[Profile, Bundle, Plan]:
    """Return an instrument, a bundle and a plan that give a block and a decision every millisecond."""
    profile = load_profile("ideal")
    bundle = small_bundle(profile, EXPOSURE_US)
    return profile, bundle, replace(build_plan(profile, bundle, dark_slots_per_cycle=0), block_exposures=N_PATTERNS)


def read_script(path: str) -> list[Injection]:
    """Return the script that causes.py has written."""
    return [Injection(*entry) for entry in json.loads(Path(path).read_text())]


def _spin(length_ns: int) -> None:
    until = time.perf_counter_ns() + length_ns
    while time.perf_counter_ns() < until:
        pass


def _ready(**facts: Any) -> int:
    say(**facts)
    return int(sys.stdin.readline())


# ---- the instrument ----


class Scripted(Schedule):
    """When something happens: at given ticks, each for its own time."""

    def __init__(self, spans: list[tuple[int, int]]) -> None:
        self._spans = deque(spans)
        self.length_ticks = 0

    @property
    def next_tick(self) -> int:  # type: ignore[override]
        return self._spans[0][0] if self._spans else NEVER

    def begin(self) -> tuple[int, int]:
        """Return (begin, end) of what is due."""
        return self._spans.popleft()


def instrument(script_path: str, listen: str, seed: str) -> None:
    """Serve a simulated instrument behind a link whose faults follow the script."""
    os.sched_setaffinity(0, {INSTRUMENT_CORE})
    options = SimOptions("ideal", scene="uniform", seed=int(seed), faults="stall:1ms/1000s,late:1ms/1000s")
    device, clock = build_instrument(options, time.perf_counter_ns())
    assert isinstance(device, FaultyDevice)
    device._schedules.clear()
    port = open_port(listen)
    say(url=port.url)
    started: list[bool] = []

    def stopped() -> bool:
        if not select.select([sys.stdin], [], [], 0)[0]:
            return False
        line = sys.stdin.readline()
        if line and not started:
            started.append(True)
            start_ns = int(line)
            for fault, kind in (("stall", "link"), ("late", "device")):
                device._schedules[fault] = Scripted(
                    [
                        (clock.tick_at(start_ns + one.at_ns), clock.tick_at(start_ns + one.at_ns + one.length_ns))
                        for one in read_script(script_path)
                        if one.kind == kind
                    ]
                )
        return not line

    serve(device, clock, port, stopped)
    port.close()


# ---- the host ----


class PipedFile:
    """Stands for the recording's file: bytes go through a small pipe to a process that writes them, and block when it does not."""

    def __init__(self, file: Any) -> None:
        import fcntl

        self._file = file
        reader, self._writer = os.pipe()
        fcntl.fcntl(self._writer, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self.process = subprocess.Popen(["cat"], stdin=reader, stdout=file.fileno())
        os.close(reader)
        # A disk needs no processor: whoever stands in for one must not wait for it.
        os.sched_setaffinity(self.process.pid, {HOST_CORE, INSTRUMENT_CORE})
        os.sched_setscheduler(self.process.pid, os.SCHED_FIFO, os.sched_param(DISK_PRIORITY))
        self.closed = False

    def write(self, data: bytes | memoryview) -> int:
        return os.write(self._writer, data)

    def fileno(self) -> int:
        return int(self._file.fileno())

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            os.close(self._writer)
            self.process.wait()
            self._file.close()


class Disturber:
    """Makes garbage collections and slow decisions in the loop's thread when the script says so."""

    def __init__(self, decider: Any, script: list[Injection]) -> None:
        self._decider = decider
        self._heap: list[list[int]] = []
        self._due = {kind: deque(one for one in script if one.kind == kind) for kind in ("gc", "inference")}
        self.start_ns = NEVER
        self.n_features, self.n_classes, self.name = decider.n_features, decider.n_classes, decider.name

    def prepared(self, run: LiveRun) -> None:
        """Make the heap once the collector is frozen, so that it is not."""
        self._heap = [[number] for number in range(HEAP_OBJECTS)]

    def decide(self, counts: Any, shots: int) -> Any:
        """Decide as the back end does; first compute or sleep if it is time."""
        due = self._take("inference")
        if due is not None and due.variant % 2:
            time.sleep(due.length_ns * 1e-9)
        elif due is not None:
            _spin(due.length_ns)
        return self._decider.decide(counts, shots)

    def watch(self, run: LiveRun, output: Output) -> None:
        """Collect everything, the big heap too, if it is time."""
        if self._take("gc") is not None:
            gc.collect()

    def _take(self, kind: str) -> Injection | None:
        due = self._due[kind]
        if due and time.perf_counter_ns() >= self.start_ns + due[0].at_ns:
            return due.popleft()
        return None


def host(url: str, script_path: str, recording: str) -> None:
    """Run the live loop on `url` until the script is over; say what became of it."""
    os.sched_setaffinity(0, {HOST_CORE})
    script = read_script(script_path)
    profile, bundle, plan = setup()
    disturber = Disturber(make_decider(bundle, backend="table"), script)
    core = Core(plan, disturber, 1, 0)  # type: ignore[arg-type]
    with Recorder(recording, {"simulated": True}, bundle=bundle_bytes(bundle)) as recorder:
        piped = PipedFile(recorder.open_file._file)
        recorder.open_file._file = piped

        def prepared(run: LiveRun) -> None:
            disturber.prepared(run)
            disturber.start_ns = _ready(pid=os.getpid(), disk_pid=piped.process.pid)

        seconds = script[-1].at_ns * 1e-9 + AFTER_S + 0.5
        config = RunOptions(seconds=seconds, deadline_us=DEADLINE_US, lease_ms=5000)
        result = run_live(
            open_link(url), profile, bundle, plan, core, config, recorder, observers=Observers(disturber.watch, prepared)
        )  # fmt: skip
        recorder.close({})
    say(
        decisions=result.tally.decisions,
        late=result.timing.late,
        late_cause=result.late_cause,
        lost=result.stream["lost_exposures"],
        ended=result.ended,
        granted=result.realtime,
    )


# ---- the hog ----


def hog(script_path: str) -> None:
    """Take the host's core for the time of every other `host` cause."""
    os.sched_setaffinity(0, {HOST_CORE})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(HOG_PRIORITY))
    spans = [one for one in read_script(script_path) if one.kind == "host" and one.variant % 2 == 0]
    start_ns = _ready()
    for one in spans:
        sleep_until(start_ns + one.at_ns)
        _spin(one.length_ns)


if __name__ == "__main__":
    roles: dict[str, Callable[..., None]] = {"instrument": instrument, "host": host, "hog": hog}
    roles[sys.argv[1]](*sys.argv[2:])
