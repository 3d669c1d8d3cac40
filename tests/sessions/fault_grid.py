"""Whole runs under faults in virtual time, judged afterwards from outside.

`run_case` lets the real host (`run_live`) run against a simulated instrument behind a bad link. Three parties keep books that share
no code: the instrument logs what it emits and executes, `ObservedLink` decodes what passes on the wire, the host records. `run_judge.py`
compares them when the run is over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from live_status import ask_for_gate
from run_books import DeviceLog, LoggedInstrument, ObservedLink, SlowReads
from run_judge import Judge

from pans.base.errors import LinkError
from pans.bundle.backends.choose import make_decider
from pans.decide.decision import Output
from pans.decide.plan.plan import Plan
from pans.decide.still.core import Core
from pans.live.loop import Job, Observers, Recovery, RunResult, Status, run_live
from pans.live.options import RunOptions
from pans.record.recorder import Recorder
from pans_sim.device.clock import DeviceClock
from pans_sim.ports.faults import NAMES, parse_faults
from pans_sim.ports.faulty import FaultyDevice
from pans_sim.ports.virtual import START_NS
from pans_sim.scene.still import scene_from_arrays
from pans_sim.testing import small_setup

SHOTS = 1
MODES = (
    "sequential", "parallel", "device-driven", "host-driven", "device-driven-counts", "host-driven-counts",
    "device-driven-detectors", "host-driven-detectors",
)  # fmt: skip
CASES = ("none", *NAMES, "host_stop", "all")
# Slow faults come more often here than usually: a run lasts some five seconds of virtual time.
GRID_TIMES = {
    "stall": "600ms/1500ms",
    "disconnect": "200ms/1500ms",
    "pause": "300ms/1s",
    "clock_step": "2ms/300ms",
    "reset": "0ms/2s",
}
OFTEN = {  # for runs of a few thousand messages
    "stall": "stall:300ms/500ms",
    "disconnect": "disconnect:100ms/400ms",
    "pause": "pause:100ms/200ms",
    "clock_step": "clock_step:2ms/100ms",
    "reset": "reset:0ms/500ms",
    "late": "late:40ms/300ms",
}
HOST_STOP = "pause:1300ms/1301ms"  # longer than the lease of a second, so that the device goes dark
ALL = (
    "loss:0.003,flip:0.003,duplicate:0.003,truncate:0.003,reorder:0.003,drip:0.003,stall:600ms/2s,"
    "disconnect:200ms/2s,pause:300ms/2s,clock_step:2ms/1s,reset:0ms/4s"
)
NEVER_ARMED = "the device was lost before it was armed"  # which ends a run: there is nothing to continue yet
SLOW_READS = 0.75  # of all, bring what came within a while; not of a host that names each state next: it would be late
GATE_EVERY = 32  # decisions
FAR_TICKS, NEAR_TICKS = 4_000_000, 50  # 40 ms at 100 MHz, longer than any read takes; what often comes too late


@dataclass(frozen=True, slots=True)
class GridResult:
    """What one run gave; `violations` has one sentence for each disagreement of the books."""

    case: str
    mode: str
    frames: int
    ended: str
    reconnects: int
    checked: dict[str, int]
    faults: dict[str, int]
    violations: list[str]


@dataclass(frozen=True, slots=True)
class Case:
    """What one run is made of."""

    profile: Any
    scene: Any
    bundle: Any
    plan: Plan
    core: Core
    n_cycles: int

    @classmethod
    def of(cls, mode: str, frames: int) -> Case:
        """Return a case of one of MODES that gives about `frames` stream messages."""
        profile, bundle, plan = small_setup(mode)
        images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
        scene = scene_from_arrays("grid", images, np.arange(6) % 3, ("a", "b", "c"))
        n_cycles = max(1, frames // (1 + _blocks_of(plan) * plan.cycles_per_object)) * plan.cycles_per_object
        decider = make_decider(bundle, shots=SHOTS, backend=_backend(bundle))
        return cls(profile, scene, bundle, plan, Core(plan, decider, SHOTS, n_cycles), n_cycles)

    def recorded(self) -> dict[str, Any]:
        """Return what a replay needs to know of the run."""
        plan, tick_hz = self.plan, self.profile.clock.tick_hz
        facts: dict[str, Any] = {"shots": SHOTS, "tick_hz": tick_hz, "backend": _backend(self.bundle), "dark": {}}
        if plan.automaton is not None:
            facts |= {"drive": plan.drive, "confidence": 0.0}
        if plan.channels_at_once > 1:
            facts["channels_at_once"] = plan.channels_at_once
        elif plan.largest > 1:
            facts["photon_number_max"] = plan.largest
        return facts


def case_faults(case: str) -> str:
    """Return the fault text of one of CASES."""
    if case in ("none", "all", "host_stop"):
        return {"none": "", "all": ALL, "host_stop": HOST_STOP}[case]
    return f"{case}:{GRID_TIMES[case]}" if case in GRID_TIMES else case


class _Host:
    """What the host does beside the ordinary run: it asks for gates, some of them too late."""

    def __init__(self) -> None:
        self.began, self.decisions = False, 0

    def watch(self, run: Status, output: Output) -> None:
        before, self.decisions = self.decisions, self.decisions + len(output.decisions)
        if output.block_end_tick is None:
            return
        for number in range(before // GATE_EVERY + 1, self.decisions // GATE_EVERY + 1):
            # every other gate is so near that it often comes too late; the duration makes each one unique
            if run.session.host.has_room:
                ask_for_gate(run, output.block_end_tick + (NEAR_TICKS if number % 2 else FAR_TICKS), 1 + number, 0)


def run_case(
    case: str, seed: int, frames: int, faults_text: str | None = None, change: Callable[[Any, Any], None] | None = None
) -> GridResult:
    """Run one case for about `frames` stream messages, in the mode of `seed`; return what the judge found.

    `faults_text` overrides the case's faults. `change` is given the device's log and the wire's books before they are judged.
    """
    mode = MODES[seed % len(MODES)]
    one, log, host = Case.of(mode, frames), DeviceLog(), _Host()
    clock = DeviceClock(one.profile.clock.tick_hz)

    def switch_on(epoch: int, tick: int) -> LoggedInstrument:
        return LoggedInstrument(one.profile, one.scene, seed=seed, power_on_tick=tick, epoch=epoch).log_to(log)

    faults = parse_faults(case_faults(case) if faults_text is None else faults_text)
    device = FaultyDevice(switch_on, clock, faults, seed, clock.tick_at(START_NS))
    slow = 0.0 if one.plan.drive == "host" else SLOW_READS
    link = ObservedLink(SlowReads(device, clock, f"grid:{case}", seed, slow))

    def prepared(run: Status) -> None:
        host.began = True

    judge = Judge()
    config = RunOptions(shots=SHOTS, n_cycles=one.n_cycles, deadline_us=1e9, realtime=False)
    result: RunResult | None = None
    with TemporaryDirectory() as folder:
        path = Path(folder) / "grid.pansrec"
        try:
            with Recorder(path, {"config": one.recorded()}) as recorder:
                observers, recovery = Observers(host.watch, prepared), Recovery.of(link, "", 30.0)
                result = run_live(
                    link, Job(one.profile, one.bundle, one.plan, config), one.core, recorder, recovery, observers
                )
                recorder.close({})
        except LinkError:
            if host.began or not device.counters.disconnects + device.counters.resets:
                raise
        else:
            if change is not None:
                change(log, link)
            judge.judge(log, link, result, path, one.bundle)
    return GridResult(
        case=case,
        mode=mode,
        frames=log.messages,
        ended=NEVER_ARMED if result is None else result.ended,
        reconnects=0 if result is None else result.reconnects,
        checked=asdict(judge.counts),
        faults={name: count for name, count in asdict(device.counters).items() if count},
        violations=judge.violations,
    )


def _backend(bundle: Any) -> str:
    return "table" if bundle.automaton is None else "automaton"


def _blocks_of(plan: Plan) -> int:
    """The click blocks of a cycle: each has at most `block_exposures`, equally spaced."""
    blocks, count = 1, 1
    for slot in range(1, plan.slots_per_cycle):
        spaced = plan.slot_offset_ticks[slot] - plan.slot_offset_ticks[slot - 1] == plan.slot_period_ticks
        count += 1
        if count > plan.block_exposures or not spaced:
            blocks, count = blocks + 1, 1
    return blocks
