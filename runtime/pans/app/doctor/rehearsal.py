"""How late a thread wakes under one real-time condition after another, on this computer, now; and which core is the quietest.

All conditions alternate in ROUNDS rounds, so that whatever else the machine does hits every condition. Nothing stays changed. It must not
run alongside a live run: it takes a core for tenths of a second at the run's own priority. Loops are Python's: about a microsecond.
"""

from __future__ import annotations

import gc
import os
import random
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pans.base.machine import (
    FIFO_PRIORITY,
    GRANTED,
    bound,
    busy_core,
    cores_of,
    first_line,
    isolated_cores,
    load_average,
    scheduled,
    shallow_idle,
    steal_ms,
    usable_cores,
)
from pans.live.timing import quantiles_us

SECONDS, ROUNDS, MOST_CORES = 10.0, 4, 8
CORE_SHARE = 0.1  # of the time: to look at the cores
PAUSE_S = (0.0002, 0.0006)  # random: nothing on the machine has this period
SPIN_GAP_NS = 20_000  # a reading of the clock takes 0.1 us: what is longer was spent elsewhere
CONDITIONS: dict[str, Callable[[int], Any]] = {  # of the core; busy_core binds, too
    "kept_awake": busy_core,
    "core": bound,
    "sched_fifo": lambda core: scheduled("SCHED_FIFO", FIFO_PRIORITY),
    "cpu_dma_latency": lambda core: shallow_idle(),
}
ARMS = {  # conditions that hold together
    "ordinary": (),
    "bound": ("core",),
    "SCHED_FIFO": ("sched_fifo",),
    "bound, SCHED_FIFO": ("core", "sched_fifo"),
    "kept awake": ("kept_awake", "sched_fifo"),
    "shallow idle states": ("core", "sched_fifo", "cpu_dma_latency"),
}


@dataclass(slots=True)
class Turns:
    """What came of an arm: the answers to its requests, and by how much each sleep of each round was too long, ns."""

    asked: dict[str, Any] = field(default_factory=dict)
    rounds_ns: list[list[int]] = field(default_factory=list)

    def figures(self) -> dict[str, float | None]:
        """Return {samples, p50_us, p99_us, p999_us, max_us} of all rounds."""
        return figures([late for one in self.rounds_ns for late in one])


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """All that was measured: `cores` with their figures, the pair that is suggested, and `arms` by name."""

    cores: list[dict[str, Any]]
    host: int | None
    device: int | None
    fifo: bool  # granted
    arms: dict[str, Turns]
    steal_ms: float | None
    load_1min: tuple[float, float]
    seconds: float


def rehearse(seconds: float = SECONDS, report: Callable[[float], None] = lambda share: None) -> Rehearsal:
    """Measure for about `seconds`, and `report` the share that is done; arms that need SCHED_FIFO alone are left out without it."""
    began, load, stolen, collecting = time.perf_counter(), load_average(), steal_ms(), gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        with scheduled("SCHED_FIFO", FIFO_PRIORITY) as answer:
            granted = answer == GRANTED
        cores = look_at_cores(seconds * CORE_SHARE, granted)
        host, device = pair_of(cores, isolated_cores(), core_siblings())
        report(CORE_SHARE)
        arms = {name: wanted for name, wanted in ARMS.items() if granted or "SCHED_FIFO" not in name}
        turns, steps = {name: Turns() for name in arms}, ROUNDS * len(arms)
        for step, name in enumerate([*arms] * ROUNDS, 1):
            wanted = [one for one in arms[name] if granted or one != "sched_fifo"]
            _one_turn(wanted, turns[name], seconds * (1 - CORE_SHARE) / steps, host)
            report(CORE_SHARE + (1 - CORE_SHARE) * step / steps)
    finally:
        if collecting:
            gc.enable()
    now = steal_ms()
    steal = None if now is None or stolen is None else now - stolen
    return Rehearsal(cores, host, device, granted, turns, steal, (load, load_average()), time.perf_counter() - began)


def _one_turn(wanted: Sequence[str], turns: Turns, seconds: float, host: int | None) -> None:
    if host is None and {"core", "kept_awake"} & set(wanted):
        turns.asked = {"core": "refused: this system does not bind threads to cores"}
        return
    with ExitStack() as stack:
        turns.asked = {}
        for name in wanted:
            answer = stack.enter_context(CONDITIONS[name](host or 0))
            turns.asked |= answer if isinstance(answer, dict) else {name: answer}
        if not any(str(answer).startswith("refused") for answer in turns.asked.values()):
            turns.rounds_ns.append(sleeps(seconds))


def sleeps(seconds: float) -> list[int]:
    """Sleep for random times until `seconds` are over; return by how many ns each sleep was too long."""
    clock, dice, late = time.perf_counter_ns, random.Random(2), []
    until = clock() + round(seconds * 1e9)
    while clock() < until:
        pause_s = dice.uniform(*PAUSE_S)
        due = clock() + round(pause_s * 1e9)
        time.sleep(pause_s)
        late.append(clock() - due)
    return late


def clock_gaps(seconds: float) -> list[int]:
    """Read the clock for `seconds`; return the gaps, ns, in which this thread did not run, beyond SPIN_GAP_NS."""
    clock = time.perf_counter_ns
    last, gaps = clock(), list[int]()
    until = last + round(seconds * 1e9)
    while last < until:
        now = clock()
        if now - last > SPIN_GAP_NS:
            gaps.append(now - last)
        last = now
    return gaps


def figures(late_ns: Sequence[int]) -> dict[str, float | None]:
    """Return {samples, p50_us, p99_us, p999_us, max_us} of times in ns; no quantile of nothing, None of too few."""
    if not len(late_ns):
        return {"samples": 0}
    return {"samples": len(late_ns), **quantiles_us(np.array(late_ns)), "max_us": max(late_ns) / 1000}


def look_at_cores(seconds: float, granted: bool) -> list[dict[str, Any]]:
    """Return for each core {core, sleep, away_ms_per_s, largest_away_us}, and with SCHED_FIFO the latter as `fifo_...`.

    `away` is for how long a thread that never waits did not run: as an ordinary one, since others had the core, too; at real-time priority
    for interrupts and the hypervisor alone.
    """
    cores, found = usable_cores()[:MOST_CORES] if hasattr(os, "sched_getaffinity") else [], []
    for core in cores:
        each_s = seconds / len(cores) / 3
        with bound(core):
            row: dict[str, Any] = {"core": core, "sleep": figures(sleeps(each_s)), **_away("", each_s)}
            if granted:
                with scheduled("SCHED_FIFO", FIFO_PRIORITY):
                    row |= _away("fifo_", each_s)
        found.append(row)
    return found


def _away(prefix: str, seconds: float) -> dict[str, float]:
    gaps = clock_gaps(seconds)
    largest_us = max(gaps, default=0) / 1000
    return {f"{prefix}away_ms_per_s": sum(gaps) / 1e6 / seconds, f"{prefix}largest_away_us": largest_us}


def core_siblings(root: Path = Path("/")) -> list[frozenset[int]]:
    """Return the groups of cores that share one physical core."""
    paths = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/topology/thread_siblings_list")
    return sorted({cores_of(text) for path in paths if (text := first_line(path))}, key=sorted)


def pair_of(
    cores: Sequence[dict[str, Any]], isolated: Collection[int], siblings: Sequence[frozenset[int]]
) -> tuple[int | None, int | None]:
    """Return a core for the host's loop and one for a device on the same computer, None where there are not enough.

    Isolated cores go first, then those on which something else ran for the shortest time, then those on which sleeps ended soonest. The
    device gets no sibling of the host's core while there is another: two threads of one core slow each other down.
    """

    def cost(row: dict[str, Any]) -> tuple[bool, float, float]:
        return row["core"] not in isolated, row["away_ms_per_s"], row["sleep"].get("p99_us") or 0.0

    order = [row["core"] for row in sorted(cores, key=cost)]
    if not order:
        return None, None
    host = order[0]
    shared = next((group for group in siblings if host in group), frozenset({host}))
    others = sorted(order[1:], key=lambda core: core in shared)
    return host, others[0] if others else None
