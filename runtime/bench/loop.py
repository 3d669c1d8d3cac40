"""`pans bench loop`: the whole live loop against the simulated instrument in real time, idle or under load.

Owns the runs and their rows; the loop, the contract and the blame are loop.py's and timing.py's. Slots of 1 ms and of 100 us, with
real-time privileges asked for and without; the load is two busy processes. What was granted stands in the row: a refusal is a finding too.
So does what the system says of the same time: how long the host's and the instrument's threads waited for a core, and what a hypervisor
took away. Every row is told on stderr as soon as it is there: forty minutes must not be lost with the last of them.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.cli import say
from pans.runtime.core.decision import Output
from pans.runtime.core.plan import build_plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.instrument.profile import Profile, load_profile, parse_profile
from pans.runtime.link.base import open_link
from pans.runtime.live import LiveRun, Observers, Recovery, RunConfig, run_live
from pans.runtime.record import Recorder

from .rows import BenchOptions, Row, table_text
from .walks import made_automaton

SLOTS_US = (1000.0, 100.0)
DEADLINE_US = 10_000.0
BUSY_PROCESSES = 2
BUSY = "while True: sum(range(10000))"
SAMPLE_EVERY_S = 0.5
RECOVER_S = 30.0
NO_TURNS: Mapping[str, float] = {}


def bench_loop(options: BenchOptions) -> list[Row]:
    """Return one row for each slot length, with and without asking for real-time privileges, then for an automaton, driven by the device
    and by the host; each takes `seconds`. A bundle of an automaton has the latter alone.
    """
    bundle, _ = load_bundle(options.first_bundle)
    walks = made_automaton() if bundle.automaton is None else bundle
    runs = [_Asked(bundle, slot, realtime) for slot in SLOTS_US for realtime in (True, False)]
    runs = runs if bundle.automaton is None else []
    runs += [_Asked(walks, SLOTS_US[0], True, drive) for drive in ("device", "host")]
    rows = []
    with _busy(BUSY_PROCESSES if options.load else 0):
        for asked in runs:
            rows.append(_run(asked, options.seconds, options.load))
            say(table_text(rows[-1:]))
    return rows


class _Asked(NamedTuple):
    """What one run is to be: exposures of `slot_us`, and who drives an automaton."""

    bundle: Bundle
    slot_us: float
    realtime: bool
    drive: str = "auto"


def _run(asked: _Asked, seconds: float, load: bool) -> Row:
    bundle, slot_us, realtime, drive = asked
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        profile = slot_profile(bundle, slot_us, path)
        plan = build_plan(profile, bundle, drive=drive)
        core = Core(plan, make_decider(bundle), 1, 0)
        others = _children()
        link = open_link(f"sim:{path}?scene=fashion200&seed=1&pace=real")
        config = RunConfig(seconds=seconds, deadline_us=DEADLINE_US, lease_ms=1000, realtime=realtime)
        started, load_before = time.process_time(), os.getloadavg()[0]
        waits = _Waits(_children() - others)
        with Recorder(Path(folder) / "loop.pansrec", {"simulated": True}) as recorder:
            recovery = Recovery.of(
                link, link.name, RECOVER_S
            )  # starved for a whole lease, the host finds its instrument dark
            result = run_live(link, profile, bundle, plan, core, config, recorder, recovery, Observers(waits.watch))
            recorder.close({})
        cpu_s = time.process_time() - started
    latency = result.timing.total.summary()
    wanted = "real time asked for" if realtime else "ordinary"
    walks: Row = {}
    if drive == "host":
        turns = {f"turn_{name}_us": round(value, 1) for name, value in result.turn_us.items()}
        budget_us = round((plan.slot_period_ticks - plan.exposure_ticks) * plan.tick_us, 1)
        walks = {**turns, "turn_budget_us": budget_us, "late_slots": result.late_slots}
    slots_hz = 1e6 / (plan.slot_period_ticks * plan.tick_us)
    driven = "" if plan.automaton is None else f", an automaton driven by the {drive}"
    granted = {name: value for name, value in result.realtime.items() if name in ("sched_fifo", "mlockall")}
    return {
        "name": f"SIMULATED loop, {slots_hz:.0f} slots/s, {wanted}{driven}{', under load' if load else ''}",
        **{f"{name}_us": round(value, 1) for name, value in latency.items()},
        "deadline_us": DEADLINE_US,
        "decisions": result.tally.decisions,
        **walks,
        "late": result.timing.late,
        "blame": dict(result.timing.blame),
        "late_cause": dict(result.late_cause),
        "lost": result.stream["lost_exposures"],
        "reconnects": result.reconnects,
        "seconds": round(result.seconds, 1),
        "cpu_s": round(cpu_s, 2),
        **waits.figures(),
        "load_1min": [round(load_before, 2), round(os.getloadavg()[0], 2)],
        "granted": granted or "not asked for",
        "ended": result.ended,
    }


class _Waits:
    """How long threads were ready to run and had no core, and the time that a hypervisor took from all cores, from /proc.

    It counts from the run's first block on. A thread's account ends with it, so that it is read while the run is under way; the last
    reading is at most SAMPLE_EVERY_S old.
    """

    def __init__(self, instrument: set[int]) -> None:
        self._instrument = instrument
        self._due_s = 0.0
        self._threads: dict[str, dict[str, int]] = {"host": {}, "instrument": {}}
        self._at_start: dict[str, int] = {}
        self._steal: int | None = None

    def watch(self, _run: LiveRun, _output: Output) -> None:
        """Read the accounts when it is time to: what run_live calls after a block, when there is slack."""
        if not self._at_start:
            self._sample()
            self._at_start = {thread: ns for threads in self._threads.values() for thread, ns in threads.items()}
            self._steal = _steal_ticks()
        elif time.monotonic() >= self._due_s:
            self._sample()

    def _sample(self) -> None:
        for name, processes in (("host", {os.getpid()}), ("instrument", self._instrument)):
            for process in processes:
                self._threads[name].update(_waited_ns(process))
        self._due_s = time.monotonic() + SAMPLE_EVERY_S

    def figures(self) -> Row:
        """Milliseconds of waiting since the first block; a word where the system does not tell."""
        row: Row = {}
        for name, threads in self._threads.items():
            waited_ns = sum(value - self._at_start.get(thread, 0) for thread, value in threads.items())
            row[f"{name}_waited_for_core_ms"] = round(waited_ns / 1e6, 1) if threads else "not told by this system"
        steal, before = _steal_ticks(), self._steal
        row["steal_ms"] = "not told by this system"
        if steal is not None and before is not None:
            row["steal_ms"] = round((steal - before) * 1000 / os.sysconf("SC_CLK_TCK"), 1)
        return row


def _waited_ns(process: int) -> dict[str, int]:
    """Run-queue delay in ns of each thread of a process: the second figure of its schedstat."""
    found = {}
    for task in Path(f"/proc/{process}/task").glob("*"):
        try:
            found[task.name] = int((task / "schedstat").read_text().split()[1])
        except (OSError, ValueError, IndexError):
            continue  # it has ended, or this system keeps no such account
    return found


def _steal_ticks() -> int | None:
    try:
        return int(Path("/proc/stat").read_text().split(maxsplit=10)[8])
    except (OSError, ValueError, IndexError):
        return None


def _children() -> set[int]:
    """Process ids of this process's children; empty where there is no /proc."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended meanwhile
        if int(fields[1]) == os.getpid():
            found.add(int(entry.name))
    return found


def slot_profile(bundle: Bundle, slot_us: float, path: Path, turns_us: Mapping[str, float] = NO_TURNS) -> Profile:
    """Return the ideal profile with the bundle's levels and with light that makes one exposure last `slot_us`; written to `path`.

    `turns_us` are keys of [timing]: how long the host or the device has for its turn between two exposures.
    """
    peak_hz = bundle.photons_per_level * (bundle.levels - 1) / (slot_us * 1e-6)
    text = load_profile("ideal").text
    lines = "".join(f"{name} = {turn_us!r}\n" for name, turn_us in turns_us.items())
    if "host_turn_us" in turns_us:
        text = text.replace("host_turn_us = 1000.0\n", "", 1)
    changes = (("10_000.0\n", f"{peak_hz!r}\n"), ("levels = 65_536", f"levels = {bundle.levels}"))
    for old, new in (*changes, ("[timing]\n", f"[timing]\n{lines}")):
        text = text.replace(old, new, 1)
    path.write_text(text)
    return parse_profile(text, str(path))


@contextmanager
def _busy(processes: int) -> Iterator[None]:
    children = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(processes)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()
