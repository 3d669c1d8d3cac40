"""Ten seconds of wake-ups under different conditions, in short turns one after another: what each condition brings on this computer, now.

Owns which conditions are compared, their order and what is kept; the loops are wakeups.py's, the conditions are conditions.py's. All turns
alternate in ROUNDS rounds, so that whatever else the machine does hits every condition. Nothing stays changed. It must not run beside a
live run: it takes a core for tenths of a second at the run's own priority.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .conditions import GRANTED, bound, fifo, shallow_idle, timer_slack
from .cpu import busy_core, usable_cores
from .first_touch import first_touch
from .ledger import FIFO_PRIORITY
from .machine import Machine, steal_ms
from .wakeups import Sender, clock_gaps, figures, sleeps, work_times

SECONDS = 10.0
ROUNDS = 4
MOST_CORES = 8
PAUSE_S = 0.001  # as between two blocks at 1000 decisions per second
CORE_SHARE, WORK_SHARE = 0.08, 0.06  # of the time: to look at the cores, and at work after a pause
Told = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Arm:
    """Conditions that hold together; `kinds` of wake-ups that are measured under them."""

    name: str
    fifo: bool = False
    bound: bool = False
    awake: bool = False
    shallow: bool = False
    slack_ns: int = 0
    kinds: tuple[str, ...] = ("sleep", "pipe")


@dataclass(slots=True)
class Turns:
    """What came of an arm: what was answered to its requests, and by kind the times of each round in ns."""

    asked: dict[str, Any] = field(default_factory=dict)
    late_ns: dict[str, list[list[int]]] = field(default_factory=dict)

    def all_of(self, kind: str) -> list[int]:
        """Return the times of all rounds."""
        return [late for one in self.late_ns.get(kind, []) for late in one]

    def by_round(self, kind: str, q: float) -> list[float]:
        """Return quantile `q` of each round in microseconds."""
        return [float(np.quantile(one, q)) / 1000 for one in self.late_ns.get(kind, []) if one]


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """All that was measured: `cores` with their figures, the pair that is suggested, `arms` by name, first touches, work after a pause."""

    cores: list[dict[str, Any]]
    host: int | None
    device: int | None
    fifo: str  # granted, or why not
    arms: dict[str, Turns]
    first_touch: dict[str, dict[str, Any]]
    work: dict[str, dict[str, float]]
    steal_ms: float | None
    load_1min: tuple[float, float]
    seconds: float

    @property
    def free(self) -> str:
        """The best arm in which the thread is not bound."""
        return "SCHED_FIFO" if self.fifo == GRANTED else "ordinary"

    @property
    def base(self) -> str:
        """The arm that those with a core kept awake are to be compared with."""
        return "bound, SCHED_FIFO" if self.fifo == GRANTED else "bound"


def arms_of(granted: bool) -> tuple[Arm, ...]:
    """Return the arms to compare; without SCHED_FIFO those that need it are left out."""
    all_kinds = ("sleep", "pipe", "terminal")
    with_priority: tuple[Arm, ...] = ()
    if granted:
        with_priority = (Arm("SCHED_FIFO", fifo=True, kinds=all_kinds), Arm("bound, SCHED_FIFO", fifo=True, bound=True))
    return (
        Arm("ordinary", kinds=("sleep", "pipe") if granted else all_kinds),
        Arm("bound", bound=True),
        *with_priority,
        Arm("kept awake", fifo=granted, bound=True, awake=True),
        Arm("shallow idle states", fifo=granted, bound=True, shallow=True),
        Arm("exact timers", slack_ns=1, kinds=("sleep",)),
    )


def rehearse(machine: Machine, seconds: float = SECONDS, tell: Told = lambda share: None) -> Rehearsal:
    """Measure for about `seconds`, and `tell` the share that is done."""
    began, load, stolen = time.perf_counter(), _load(), steal_ms()
    with _no_collections():
        with fifo(FIFO_PRIORITY) as granted:
            pass
        cores = look_at_cores(seconds * CORE_SHARE, granted == GRANTED)
        host, device = pair_of(cores, machine)
        tell(CORE_SHARE)
        arms = arms_of(granted == GRANTED)
        turns = {arm.name: Turns() for arm in arms}
        turn_s = seconds * (1 - CORE_SHARE - WORK_SHARE) / (ROUNDS * sum(len(arm.kinds) for arm in arms))
        with ExitStack() as stack:
            senders = {kind: stack.enter_context(closing(Sender(kind))) for kind in ("pipe", "terminal")}
            for sender in senders.values():
                sender.bind(device)
            for number in range(ROUNDS):
                for place, arm in enumerate(arms):
                    _one_turn(arm, turns[arm.name], turn_s, senders, host)
                    share = (number + (place + 1) / len(arms)) / ROUNDS
                    tell(CORE_SHARE + (1 - CORE_SHARE - WORK_SHARE) * share)
        touched = {"as it comes": first_touch(lock=False), "locked": first_touch(lock=True)}
        work = _work(seconds * WORK_SHARE / 3, host)
    tell(1.0)
    now = steal_ms()
    return Rehearsal(
        cores=cores,
        host=host,
        device=device,
        fifo=granted,
        arms=turns,
        first_touch=touched,
        work=work,
        steal_ms=None if now is None or stolen is None else now - stolen,
        load_1min=(load, _load()),
        seconds=time.perf_counter() - began,
    )


def _one_turn(arm: Arm, turns: Turns, turn_s: float, senders: Mapping[str, Sender], host: int | None) -> None:
    with ExitStack() as stack:
        asked: dict[str, Any] = {}
        if arm.bound and host is None:
            turns.asked = {"core": "refused: this system does not bind threads to cores"}
            return
        if arm.awake:
            asked |= stack.enter_context(busy_core(host))  # binds, too
        elif arm.bound:
            assert host is not None
            asked["core"] = stack.enter_context(bound(host))
        if arm.fifo:
            asked["sched_fifo"] = stack.enter_context(fifo(FIFO_PRIORITY))
        if arm.shallow:
            asked["cpu_dma_latency"] = stack.enter_context(shallow_idle())
        if arm.slack_ns:
            asked["timer_slack"] = stack.enter_context(timer_slack(arm.slack_ns))
        turns.asked = asked
        if any(str(answer).startswith("refused") for answer in asked.values()):
            return
        for kind in arm.kinds:
            late = sleeps(turn_s) if kind == "sleep" else senders[kind].wakes(turn_s)
            turns.late_ns.setdefault(kind, []).append(late)


def look_at_cores(seconds: float, granted: bool) -> list[dict[str, Any]]:
    """Return for each core {core, sleep, away_ms_per_s, largest_away_us}, and with SCHED_FIFO the latter as `fifo_...`.

    `away` is for how long a thread that never waits did not run: as an ordinary one, since others had the core, too; at real-time priority
    for interrupts and the hypervisor alone.
    """
    cores = usable_cores()[:MOST_CORES] if hasattr(os, "sched_getaffinity") else []
    found = []
    for core in cores:
        each_s = seconds / len(cores) / 3
        with bound(core):
            row: dict[str, Any] = {"core": core, "sleep": figures(sleeps(each_s)), **_away("", each_s)}
            if granted:
                with fifo(FIFO_PRIORITY):
                    row |= _away("fifo_", each_s)
        found.append(row)
    return found


def _away(prefix: str, seconds: float) -> dict[str, float]:
    gaps = clock_gaps(seconds)
    return {
        f"{prefix}away_ms_per_s": sum(gaps) / 1e6 / seconds,
        f"{prefix}largest_away_us": max(gaps, default=0) / 1000,
    }


def pair_of(cores: Sequence[dict[str, Any]], machine: Machine) -> tuple[int | None, int | None]:
    """Return a core for the host's loop and one for a device on the same computer, None where there are not enough.

    Isolated cores go first, then those on which something else ran for the shortest time, then those on which sleeps ended soonest. The
    device gets no sibling of the host's core while there is another: two threads of one core slow each other down.
    """

    def cost(row: dict[str, Any]) -> tuple[bool, float, float]:
        return row["core"] not in machine.isolated, row["away_ms_per_s"], row["sleep"].get("p99_us", 0.0)

    order = [row["core"] for row in sorted(cores, key=cost)]
    if not order:
        return None, None
    host = order[0]
    shared = next((group for group in machine.siblings if host in group), frozenset({host}))
    others = sorted(order[1:], key=lambda core: core in shared)
    return host, others[0] if others else None


def _work(seconds: float, host: int | None) -> dict[str, dict[str, float]]:
    """The same calculation at once, after a pause, and after a pause in which the core was kept awake."""
    with ExitStack() as stack:
        if host is not None:
            stack.enter_context(bound(host))
        found = {
            "without a pause": figures(work_times(seconds, 0.0)),
            "after a pause": figures(work_times(seconds, PAUSE_S)),
        }
    with busy_core(host):
        found["after a pause, kept awake"] = figures(work_times(seconds, PAUSE_S))
    return found


@contextmanager
def _no_collections() -> Iterator[None]:
    on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def _load() -> float:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
