"""`pans bench loop`: the whole live loop against the simulated instrument in real time, idle or under load.

Slots of 1 ms and of 100 us, with real-time privileges asked for and without; the load is two busy processes. What was granted stands in the
row: a refusal is a finding too. So does the time that a hypervisor took away. Every row is printed as soon as it is there.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pans.base.console import say
from pans.base.machine import steal_ms
from pans.bundle.backends import make_decider
from pans.bundle.sensor import Bundle, load_bundle
from pans.decide.plan import build_plan
from pans.decide.still import Core
from pans.instrument.profile import Profile, load_profile, parse_profile
from pans.live.loop import Job, Recovery, run_live
from pans.live.options import RunOptions
from pans.protocol.links import open_link
from pans.record.recorder import Recorder

from .rows import BenchOptions, Row, table_text
from .streams import made_automaton

SLOTS_US = (1000.0, 100.0)
DEADLINE_US = 10_000.0
BUSY_PROCESSES = 2
RECOVER_S = 30.0
UNKNOWN = "not told by this system"


def bench_loop(options: BenchOptions) -> list[Row]:
    """Return one row for each slot length, with and without asking for real-time privileges, then for an automaton, driven by the device
    and by the host; each takes `seconds`. A bundle of an automaton has the latter alone.
    """
    bundle, _ = load_bundle(options.first_bundle)
    walking = made_automaton() if bundle.automaton is None else bundle
    runs = [(bundle, slot, realtime, "auto") for slot in SLOTS_US for realtime in (True, False)]
    runs = runs if bundle.automaton is None else []
    runs += [(walking, SLOTS_US[0], True, drive) for drive in ("device", "host")]
    rows = []
    with _busy(BUSY_PROCESSES if options.load else 0):
        for run in runs:
            rows.append(_row(*run, options))
            say(table_text(rows[-1:]))
    return rows


def _row(bundle: Bundle, slot_us: float, realtime: bool, drive: str, options: BenchOptions) -> Row:
    """Run with exposures of `slot_us`, an automaton driven by `drive`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        profile = slot_profile(bundle, slot_us, path)
        plan = build_plan(profile, bundle, drive=drive)
        core = Core(plan, make_decider(bundle), 1, 0)
        link = open_link(f"sim:{path}?scene=fashion200&seed=1&pace=real&realtime={realtime:d}")
        config = RunOptions(
            seconds=options.seconds, deadline_us=DEADLINE_US, lease_ms=1000, realtime_simulated=realtime
        )
        started, load_before, steal_before = time.process_time(), os.getloadavg()[0], steal_ms()
        with Recorder(Path(folder) / "loop.pansrec", {"simulated": True}) as recorder:
            # starved for a whole lease, the host finds its instrument dark
            recovery = Recovery.of(link, link.name, RECOVER_S)
            result = run_live(link, Job(profile, bundle, plan, config), core, recorder, recovery)
            recorder.close({})
        cpu_s, steal = time.process_time() - started, steal_ms()
    turns: Row = {}
    if drive == "host":
        turns = {f"turn_{name}_us": value and round(value, 1) for name, value in result.turn_us.items()}
        budget_us = (plan.slot_period_ticks - plan.exposure_ticks) * plan.tick_us
        turns |= {"turn_budget_us": round(budget_us, 1), "late_slots": result.late_slots}
    wanted = "real time asked for" if realtime else "ordinary"
    driven = "" if plan.automaton is None else f", an automaton driven by the {drive}"
    slots_hz = 1e6 / (plan.slot_period_ticks * plan.tick_us)
    granted = {name: value for name, value in result.realtime.items() if name in ("sched_fifo", "mlockall")}
    return {
        "name": f"SIMULATED loop, {slots_hz:.0f} slots/s, {wanted}{driven}{', under load' if options.load else ''}",
        **{f"{name}_us": value and round(value, 1) for name, value in result.timing.total.summary().items()},
        "deadline_us": DEADLINE_US,
        "decisions": result.tally.decisions,
        **turns,
        "late": result.timing.late,
        "blame": dict(result.timing.blame),
        "late_cause": dict(result.late_cause),
        "lost": result.stream["lost_exposures"],
        "reconnects": result.reconnects,
        "seconds": round(result.seconds, 1),
        "cpu_s": round(cpu_s, 2),
        "steal_ms": UNKNOWN if steal is None or steal_before is None else round(steal - steal_before, 1),
        "load_1min": [round(load_before, 2), round(os.getloadavg()[0], 2)],
        "granted": granted or "not asked for",
        "ended": result.ended,
    }


def slot_profile(bundle: Bundle, slot_us: float, path: Path) -> Profile:
    """Return the ideal profile with the bundle's levels and with light that makes one exposure last `slot_us`; written to `path`."""
    peak_hz = bundle.photons_per_level * (bundle.levels - 1) / (slot_us * 1e-6)
    text = load_profile("ideal").text.replace("10_000.0\n", f"{peak_hz!r}\n", 1)
    text = text.replace("levels = 65_536", f"levels = {bundle.levels}", 1)
    path.write_text(text)
    return parse_profile(text, str(path))


@contextmanager
def _busy(processes: int) -> Iterator[None]:
    busy = "while True: sum(range(10000))"
    children = [subprocess.Popen([sys.executable, "-c", busy]) for _ in range(processes)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()
