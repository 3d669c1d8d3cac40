"""Causes that are really made, and what the timing verdict calls them: the confusion matrix of `pans.runtime.timing`.

Owns the choice of causes, the processes that make them and the comparison; host and instrument are the ordinary ones at real pace, one
core each. Linux, with the right to SCHED_FIFO. It fails when fewer than 95 % are named rightly. How each cause is made:

    link        the fault `stall`: no byte passes in either direction, then a flood
    device      the fault `late`: the device keeps its stream messages, and answers everything else at once
    host        in turns: a spinning process of higher priority on the host's core; SIGSTOP and SIGCONT to the host
    gc          gc.collect() over a big heap in the loop's thread
    disk        the recording goes through a pipe to a process that writes the file; that process is stopped, so that a write blocks
    inference   in turns: the back end computes (holding the interpreter), or sleeps (as one that waits for other hardware)
"""

from __future__ import annotations

import json
import os
import random
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pans.firmware_sim.options import option
from pans.firmware_sim.probes.processes import Child, has_real_time, sleep_until
from pans.firmware_sim.probes.scheduling_probe import SchedulingProbe
from pans.runtime.errors import UsageError
from pans.runtime.record import read_recording

from . import Report, Trial, figures_text
from .cause_processes import HOST_CORE, INSTRUMENT_CORE, Injection

KINDS = ("link", "device", "host", "gc", "disk", "inference")
NAMED_RIGHTLY = 0.95
SPACING_S = (0.9, 1.2)
LENGTH_MS = (25, 70)  # well above the deadline of 10 ms, well below the spacing
DISK_HOLD_MS = 560  # the loop writes every 500 ms: this one blocks for at least 60 ms
SETTLE_S = 1.5  # before the first cause: the clock model has its probes by then
NEAR_NS = 60_000_000  # an injection and what the machine does so shortly before or after it are one incident
ORCHESTRATOR_PRIORITY = 70  # above the hog
PROBE_PRIORITY, PROBE_EVERY_US, PROBE_LATE_US = 12, 4_000, 6_000  # the host's loop has 10


def make_script(injections: int, seed: int) -> list[Injection]:
    """Return the causes in a random order, as many of each kind, one about every second."""
    dice = random.Random(seed)
    kinds = [KINDS[number % len(KINDS)] for number in range(injections)]
    dice.shuffle(kinds)
    script, at_s, seen = [], SETTLE_S, Counter[str]()
    for kind in kinds:
        length_ms = DISK_HOLD_MS if kind == "disk" else dice.uniform(*LENGTH_MS)
        script.append(Injection(kind, round(at_s * 1e9), round(length_ms * 1e6), seen[kind]))
        seen[kind] += 1
        at_s += dice.uniform(*SPACING_S) + (DISK_HOLD_MS / 1000 if kind == "disk" else 0.0)
    return script


def compare(
    script: Iterable[Injection], start_ns: int, verdicts: list[dict[str, Any]], away: list[tuple[int, int]]
) -> list[dict[str, Any]]:
    """Return, for each injection, the verdict whose late work overlaps it most ("nothing" if none does).

    `away` holds the times in which a scheduling probe, a process of higher priority than the host's, did not get one of the two cores:
    an injection that one of them touches is `disturbed`, since two causes were at work. The hog's own times are no disturbance.
    """
    compared = []
    for injection in script:
        begin = start_ns + injection.at_ns
        end = begin + injection.length_ns

        def overlap(verdict: dict[str, Any], begin: int = begin, end: int = end) -> int:
            return min(end, int(verdict["end_ns"])) - max(begin, int(verdict["begin_ns"]))

        hogged = injection.kind == "host" and injection.variant % 2 == 0
        disturbed = not hogged and any(since < end + NEAR_NS and until > begin - NEAR_NS for since, until in away)
        best = max(verdicts, key=overlap, default=None)
        found = best if best is not None and overlap(best) > 0 else {"cause": "nothing", "sure": False, "why": ""}
        compared.append(
            {
                "kind": injection.kind,
                "variant": injection.variant % 2,
                "length_ms": injection.length_ns / 1e6,
                "named": found["cause"],
                "disturbed": disturbed,
                "sure": found["sure"],
                "why": found["why"],
            }
        )
    return compared


# ---- the orchestrator: the parent of all processes ----


def run_all(script: list[Injection], listen: str, folder: Path, seed: int) -> tuple[int, dict[str, Any], Path]:
    """Make every cause of `script`; return the start time, what the host says of its run, and its recording."""
    plan_file, recording = folder / "script.json", folder / "causes.pansrec"
    plan_file.write_text(json.dumps(script))
    children, probes = (
        [Child(f"{__package__}.cause_processes", "instrument", plan_file, listen, seed)],
        list[SchedulingProbe](),
    )
    try:
        url = children[0].said()["url"]
        children.append(Child(f"{__package__}.cause_processes", "host", url, plan_file, recording))
        children.append(Child(f"{__package__}.cause_processes", "hog", plan_file))
        for core in (HOST_CORE, INSTRUMENT_CORE):
            probes.append(SchedulingProbe(core, PROBE_PRIORITY, PROBE_EVERY_US, PROBE_LATE_US))
        host = children[1].said()
        children[2].said()
        start_ns = time.perf_counter_ns() + 500_000_000
        for child in children:
            child.tell(start_ns)
        _stop_and_go(script, start_ns, {"host": int(host["pid"]), "disk": int(host["disk_pid"])})
        words = children[1].said()
        away = [(gap.begin_ns, gap.end_ns) for probe in probes for gap in probe.end().gaps]
        return start_ns, words | {"away": away}, recording
    finally:
        for probe in probes:
            probe.kill()
        for child in reversed(children):
            child.end()


def _stop_and_go(script: list[Injection], start_ns: int, pids: dict[str, int]) -> None:
    """Stop what is to be stopped, from outside, and let it go on again."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(ORCHESTRATOR_PRIORITY))
    try:
        for injection in script:
            if injection.kind == "disk" or (injection.kind == "host" and injection.variant % 2):
                sleep_until(start_ns + injection.at_ns)
                os.kill(pids[injection.kind], signal.SIGSTOP)
                sleep_until(start_ns + injection.at_ns + injection.length_ns)
                os.kill(pids[injection.kind], signal.SIGCONT)
    finally:
        for pid in pids.values():
            os.kill(pid, signal.SIGCONT)
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


# ---- what came of it ----


def report(compared: list[dict[str, Any]], others: Counter[str], host: dict[str, Any]) -> dict[str, Any]:
    """Return the confusion matrix (a row for each cause that was made, a column for each that was named) and its sums."""
    disturbed = [entry for entry in compared if entry["disturbed"]]
    compared = [entry for entry in compared if not entry["disturbed"]]
    named = sorted({entry["named"] for entry in compared} - set(KINDS))
    matrix = {
        kind: {name: sum(1 for entry in compared if (entry["kind"], entry["named"]) == (kind, name)) for name in (*KINDS, *named)}
        for kind in KINDS
    }  # fmt: skip
    right = sum(entry["kind"] == entry["named"] for entry in compared)
    return {
        "simulated": True,
        "injections": len(compared),
        "right": right,
        "share": right / len(compared) if compared else 0.0,
        "sure": sum(entry["sure"] for entry in compared),
        "sure_and_wrong": sum(entry["sure"] and entry["kind"] != entry["named"] for entry in compared),
        "matrix": matrix,
        "disturbed": len(disturbed),
        "disturbed_right": sum(entry["kind"] == entry["named"] for entry in disturbed),
        "disturbed_named": dict(Counter(entry["named"] for entry in disturbed)),
        "not_injected": dict(others),
        "wrong": [entry for entry in compared if entry["kind"] != entry["named"]],
        "host": host,
    }


@dataclass(frozen=True, slots=True)
class Settings:
    """How many causes, in which order, over which port."""

    injections: int = option(200, "how many causes (default 200)")
    seed: int = option(1, "of the order, the moments and the lengths (default 1)")
    listen: str = option("pty", "the instrument's port: pty (default) or tcp:127.0.0.1:0")


def run(settings: Settings) -> Report:
    """Make causes and compare."""
    if not has_real_time():
        raise UsageError("this needs Linux and two cores: a core each for host and instrument")
    script = make_script(settings.injections, settings.seed)
    with tempfile.TemporaryDirectory() as folder:
        start_ns, host, recording = run_all(script, settings.listen, Path(folder), settings.seed)
        events = [event for event in read_recording(recording).events() if event["kind"] == "blame"]
    verdicts = [event for event in events if event["what"] == "late"]
    compared = compare(script, start_ns, verdicts, host.pop("away"))
    spans = [(start_ns + one.at_ns, start_ns + one.at_ns + one.length_ns) for one in script]
    others = Counter(
        str(verdict["cause"])
        for verdict in verdicts
        if not any(verdict["begin_ns"] < end and verdict["end_ns"] > begin for begin, end in spans)
    )
    result = report(compared, others, host)
    return Report(result, result["share"] >= NAMED_RIGHTLY, figures_text(result))


TRIAL = Trial(Settings, run)
