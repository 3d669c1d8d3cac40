"""`pans bench loop`: the whole live loop against the simulated instrument in real time, idle or under load.

Owns the runs and their rows; the loop, the contract and the blame are loop.py's and timing.py's. Slots of 1 ms and of 100 us, with
real-time privileges asked for and without; the load is two busy processes. What was granted stands in the row: a refusal is a finding too.
"""

from __future__ import annotations

import importlib.resources
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .bench import BenchOptions, Row
from .bundle import Bundle, load_bundle
from .decide import make_decider
from .link import open_link
from .loop import RunConfig, run_live
from .plan import build_plan
from .profile import Profile, load_profile, parse_profile
from .record import Recorder

SLOTS_US = (1000.0, 100.0)
DEADLINE_US = 10_000.0
BUSY_PROCESSES = 2
BUSY = "while True: sum(range(10000))"


def bench_loop(options: BenchOptions) -> list[Row]:
    """Return one row for each slot length, with and without asking for real-time privileges; `seconds` are divided among them."""
    path = (
        options.bundles[0]
        if options.bundles
        else Path(str(importlib.resources.files("pans.runtime") / "shipped" / "fashion10.pans"))
    )
    bundle, _ = load_bundle(path)
    runs = [(slot, realtime) for slot in SLOTS_US for realtime in (True, False)]
    rows = []
    with _busy(BUSY_PROCESSES if options.load else 0):
        for slot_us, realtime in runs:
            rows.append(_run(bundle, slot_us, realtime, options.seconds / len(runs), options.load))
    return rows


def _run(bundle: Bundle, slot_us: float, realtime: bool, seconds: float, load: bool) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        profile = _profile(bundle, slot_us, path)
        plan = build_plan(profile, bundle)
        decider = make_decider(bundle)
        link = open_link(f"sim:{path}?scene=fashion200&seed=1&pace=real")
        config = RunConfig(seconds=seconds, deadline_us=DEADLINE_US, lease_ms=1000, realtime=realtime)
        started = time.process_time()
        with Recorder(Path(folder) / "loop.pansrec", {"simulated": True}) as recorder:
            result = run_live(link, profile, bundle, plan, decider, config, recorder)
            recorder.close({})
        cpu_s = time.process_time() - started
    latency = result.timing.total.summary()
    asked = "real time asked for" if realtime else "ordinary"
    granted = {name: value for name, value in result.realtime.items() if name in ("sched_fifo", "mlockall")}
    return {
        "name": f"SIMULATED loop, {1e6 / slot_us:.0f} slots/s, {asked}{', under load' if load else ''}",
        **{f"{name}_us": round(value, 1) for name, value in latency.items()},
        "deadline_us": DEADLINE_US,
        "decisions": result.tally.decisions,
        "late": result.timing.late,
        "blame": dict(result.timing.blame),
        "lost": result.stream["lost_exposures"],
        "seconds": round(result.seconds, 1),
        "cpu_s": round(cpu_s, 2),
        "granted": granted or "not asked for",
        "ended": result.ended,
    }


def _profile(bundle: Bundle, slot_us: float, path: Path) -> Profile:
    """The ideal profile with the bundle's levels, and with light that makes one exposure last a slot; written to `path`."""
    peak_hz = bundle.photons_per_level * (bundle.levels - 1) / (slot_us * 1e-6)
    text = load_profile("ideal").text
    for old, new in (("10_000.0\n", f"{peak_hz!r}\n"), ("levels = 65_536", f"levels = {bundle.levels}")):
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
