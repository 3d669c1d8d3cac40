"""The fault grid: whole runs in virtual time under every fault, judged by the checkers (checkers.py).

Owns the choice of runs and their report; the host in them is the real one (`run_live`). Each fault runs alone and all together, with
each seed; seeds measure in MODES in turn. A failure prints the command that repeats it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pans.firmware_sim.checks.checkers import Checker, WatchedInstrument
from pans.firmware_sim.checks.flow_checker import FlowChecker
from pans.firmware_sim.checks.flow_stream import FlowStream
from pans.firmware_sim.checks.flowing import KINDS, small_flow
from pans.firmware_sim.checks.grid_host import GridHost
from pans.firmware_sim.checks.reconciliation import ObservedLink, reconcile
from pans.firmware_sim.checks.slow_reads import SlowReads
from pans.firmware_sim.checks.twin import Streamed, TapedLink, differences
from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.options import option
from pans.firmware_sim.ports.faults import NAMES, parse_faults
from pans.firmware_sim.ports.faulty import FaultyDevice
from pans.firmware_sim.ports.virtual import START_NS
from pans.firmware_sim.scene.moving import SceneFile
from pans.firmware_sim.scene.still import Scene, scene_from_arrays
from pans.firmware_sim.testing import small_setup
from pans.runtime.bundle.model import Bundle
from pans.runtime.cli import say
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import LinkError
from pans.runtime.flow.core import FlowCore
from pans.runtime.instrument.profile import Profile
from pans.runtime.live import LiveRun, Observers, Recovery, RunOptions, RunResult, run_live
from pans.runtime.live.config import AUTO, COMPILED, PYTHON
from pans.runtime.live.flow_run import FlowRun
from pans.runtime.record import Recorder, Recording, read_recording
from pans.runtime.turn.streaming import StreamCore
from pans.runtime.turn.system import offered

from . import Report, Trial, figures_text

SHOTS = 1
STILL = (
    "sequential", "parallel", "device-driven", "host-driven", "device-driven-counts", "host-driven-counts",
    "device-driven-detectors", "host-driven-detectors",
)  # fmt: skip
MODES = (*STILL, *KINDS)  # objects that stand still, and those in flow
SLOW_READS = 0.75  # of all, bring what came within a while; not of a host that names each state next: it would be late
CASES = ("none", *NAMES, "host_stop", "all")
# Slow faults come more often here than usually: a run lasts some five seconds of virtual time.
GRID_TIMES = {
    "stall": "600ms/1500ms",
    "disconnect": "200ms/1500ms",
    "pause": "300ms/1s",
    "clock_step": "2ms/300ms",
    "reset": "0ms/2s",
}
HOST_STOP = "pause:1300ms/1301ms"  # longer than the lease of a second, so that the device goes dark
GRID_ALL = (
    "loss:0.003,flip:0.003,duplicate:0.003,truncate:0.003,reorder:0.003,drip:0.003,stall:600ms/2s,"
    "disconnect:200ms/2s,pause:300ms/2s,clock_step:2ms/1s,reset:0ms/4s"
)
BOTH = "both"
NEVER_ARMED = "the device was lost before it was armed"  # which ends a run: there is nothing to go on with yet


@dataclass(frozen=True, slots=True)
class Settings:
    """How much of the grid to run."""

    frames: int = option(10_000_000, "stream messages in all (default ten million)")
    seeds: int = option(20, "seeds per case (default 20)")
    seed: int | None = option(None, "this seed only", type=int)
    jobs: int = option(os.cpu_count() or 1, "processes (default: one per core)")
    faults: str = option(",".join(CASES), f"cases, of {', '.join(CASES)}")
    turn: str = option(BOTH, f"the loop's turn: {COMPILED}, {PYTHON} (what it read is read again, compiled) or {BOTH}")


@dataclass(frozen=True, slots=True)
class GridResult:
    """What one run of the grid gave; `memory_kb` is the growth of the process over the last three quarters of the run."""

    case: str
    seed: int
    mode: str
    turn: str
    frames: int
    ended: str
    reconnects: int
    abstained: int
    memory_kb: int
    seconds: float
    virtual_s: float
    checked: dict[str, int]
    faults: dict[str, int]
    violations: list[str]


def case_faults(case: str) -> str:
    """Return the fault text of a case of the grid."""
    if case == "none":
        return ""
    if case == "host_stop":
        return HOST_STOP
    return GRID_ALL if case == "all" else f"{case}:{GRID_TIMES[case]}" if case in GRID_TIMES else case


@dataclass(frozen=True, slots=True)
class Case:
    """What one run is made of: the instrument and what it looks at, the host's plan, core and checker."""

    profile: Profile
    scene: Scene | SceneFile
    bundle: Bundle
    plan: Plan
    core: Core | FlowCore
    checker: Checker
    n_cycles: int
    streamed: Callable[[], Streamed]  # a second core, behind the compiled turn

    @classmethod
    def of(cls, mode: str, frames: int) -> Case:
        """Return a case of one of MODES that gives about `frames` stream messages."""
        if mode in KINDS:
            flow = small_flow(mode)
            n_cycles = max(1, frames // len(plan_blocks(flow.plan)))
            core = flow.core(n_cycles)
            checker = FlowChecker(flow)
            return cls(
                flow.profile, flow.scene, flow.bundle, flow.plan, core, checker, n_cycles,
                lambda: FlowStream(flow.core(0), flow.plan, 0),
            )  # fmt: skip
        profile, bundle, plan = small_setup(mode)
        images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
        scene = scene_from_arrays("grid", images, np.arange(6) % 3, ("a", "b", "c"))
        per_visit = 1 + len(plan_blocks(plan)) * plan.cycles_per_object
        n_cycles = max(1, frames // per_visit) * plan.cycles_per_object
        decider = make_decider(bundle, shots=SHOTS, backend=_backend(bundle))
        return cls(
            profile, scene, bundle, plan, Core(plan, decider, SHOTS, n_cycles), Checker(plan, SHOTS), n_cycles,
            lambda: StreamCore(plan, decider, SHOTS, 0, 0),
        )  # fmt: skip


def run_case(
    case: str, seed: int, frames: int, faults_text: str | None = None, turn: str = PYTHON, reads_again: bool = False
) -> GridResult:
    """Run one case for about `frames` stream messages and return what the checkers found; `faults_text` overrides its faults.

    `turn` is the loop's; with `reads_again` the compiled turn reads the same bytes from a socket and must give the same.
    """
    started, mode = time.perf_counter(), MODES[seed % len(MODES)]
    one = Case.of(mode, frames)
    plan, core, checker = one.plan, one.core, one.checker
    clock = DeviceClock(one.profile.clock.tick_hz)

    def switch_on(epoch: int, tick: int) -> WatchedInstrument:
        return WatchedInstrument(one.profile, one.scene, seed=seed, power_on_tick=tick, epoch=epoch).watch(checker)

    faults = parse_faults(case_faults(case) if faults_text is None else faults_text)
    device = FaultyDevice(switch_on, clock, faults, seed, clock.tick_at(START_NS))
    reads_again = reads_again and plan.largest == 1  # COUNTS have no compiled turn
    slow = 0.0 if plan.drive == "host" else SLOW_READS
    link = (TapedLink if reads_again else ObservedLink)(SlowReads(device, clock, f"grid:{case}", seed, slow))
    flow = FlowRun(core, None) if isinstance(core, FlowCore) else None
    host = GridHost(checker, frames, flow)
    config = RunOptions(shots=SHOTS, n_cycles=one.n_cycles, deadline_us=1e9, turn=turn)
    recovery = Recovery.of(link, "", 30.0)

    def start(run: LiveRun) -> None:
        if isinstance(link, TapedLink):
            link.listen(run)
        host.start(run)

    header = {"config": _recorded(one, {} if flow is None else {"flow": flow.header()})}

    def live(recorder: Recorder) -> RunResult:
        observers = Observers(host.watch, start)
        return run_live(link, one.profile, one.bundle, plan, core, config, recorder, recovery, observers)

    def disagreements(result: RunResult, recording: Recording) -> Iterator[str]:
        yield from reconcile(link, checker.books, result, recording, one.bundle)
        if isinstance(link, TapedLink):
            yield from differences(link.tape, one.streamed(), core, recording.decisions())

    result = judged(
        live,
        header,
        host,
        disagreements,
        may_be_lost=lambda: bool(device.counters.disconnects + device.counters.resets),
    )
    return GridResult(
        case=case,
        seed=seed,
        mode=mode,
        turn="" if result is None else result.turn.taken,
        frames=checker.counts.frames_emitted,
        ended=NEVER_ARMED if result is None else result.ended,
        reconnects=0 if result is None else result.reconnects,
        abstained=0 if result is None else result.tally.abstained,
        memory_kb=host.memory_growth_kb,
        seconds=time.perf_counter() - started,
        virtual_s=(link.now_ns() - START_NS) / 1e9,
        checked=asdict(checker.counts),
        faults={name: count for name, count in asdict(device.counters).items() if count},
        violations=checker.violations,
    )


def _backend(bundle: Bundle) -> str:
    return "table" if bundle.automaton is None else "automaton"


def _recorded(one: Case, more: dict[str, Any]) -> dict[str, Any]:
    """What a replay needs to know of the run."""
    plan, tick_hz = one.plan, one.profile.clock.tick_hz
    told: dict[str, Any] = {
        "shots": SHOTS,
        "tick_hz": tick_hz,
        "backend": _backend(one.bundle),
        "drive": plan.drive,
        "confidence": 0.0,
    }
    if plan.channels_at_once > 1:
        told |= {"channels_at_once": plan.channels_at_once}
    elif plan.largest > 1:
        told |= {"photon_number_max": plan.largest}
    return told | more


def judged(
    live: Callable[[Recorder], RunResult],
    header: Mapping[str, Any],
    host: GridHost,
    disagreements: Callable[[RunResult, Recording], Iterator[str]],
    *,
    may_be_lost: Callable[[], bool],
) -> RunResult | None:
    """Record what `live` does and let the host's checker judge it; None for a device that was lost before it was armed."""
    checker = host.checker
    with TemporaryDirectory() as folder:
        path = Path(folder) / "grid.pansrec"
        try:
            with Recorder(path, header) as recorder:
                result = live(recorder)
                recorder.close({})
        except LinkError as error:
            if host.began or not may_be_lost():
                raise
            if checker.counts.frames_emitted:
                checker.fail(f"frames before ARM, of a device that was lost: {error}")
            return None
        checker.close()
        host.finish(result.ended)
        for disagreement in disagreements(result, read_recording(path)):
            checker.fail(disagreement)
    return result


def plan_blocks(plan: Plan) -> list[int]:
    """Return the first slot of each click block of a cycle: at most `block_exposures`, equally spaced."""
    firsts, count = [0], 1
    for slot in range(1, plan.slots_per_cycle):
        spaced = plan.slot_offset_ticks[slot] - plan.slot_offset_ticks[slot - 1] == plan.slot_period_ticks
        count += 1
        if count > plan.block_exposures or not spaced:
            firsts.append(slot)
            count = 1
    return firsts


def turn_of(seed: int, turn: str) -> tuple[str, bool]:
    """Return the loop's turn of a seed, and whether the bytes are read again: "both" takes the turns in turn."""
    if turn == BOTH:
        turn = COMPILED if seed // len(MODES) % 2 else PYTHON
    # in virtual time the host drives in Python's turn
    return (AUTO if turn == COMPILED else turn), turn == PYTHON and not offered()


def run_grid(cases: Sequence[str], seeds: int, frames: int, jobs: int, turn: str = BOTH) -> list[GridResult]:
    """Run every case with every seed, about `frames` messages in all, on `jobs` processes; report each failure on stderr."""
    work = [(case, seed) for seed in range(seeds) for case in cases]
    each = -(-frames // len(work))
    turns = [turn_of(seed, turn) for _, seed in work]
    results = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for result in pool.map(run_case, *zip(*work), [each] * len(work), [None] * len(work), *zip(*turns)):
            results.append(result)
            if result.violations:
                again = f"pans trials fault-grid --faults {result.case} --seed {result.seed} --frames {each}"
                say(f"FAILED {result.case} seed {result.seed}: {result.violations[0]}\n  again: {again}")
    return results


def case_row(case: str, runs: Sequence[GridResult]) -> dict[str, Any]:
    """Add up the runs of one case."""

    def total(key: str) -> int:
        return sum(run.checked[key] for run in runs)

    return {
        "name": case,
        "runs": len(runs),
        "frames": sum(run.frames for run in runs),
        "delivered": total("blocks_delivered"),
        "reported_lost": total("blocks_lost") + total("blocks_lost_open_end"),
        "decisions": total("decisions"),
        "flagged": total("decisions_flagged"),
        "gates_executed": total("gates_executed"),
        "gates_refused": total("gates_refused"),
        "reconnects": sum(run.reconnects for run in runs),
        "memory_kb_max": max(run.memory_kb for run in runs),
        "virtual_s": round(sum(run.virtual_s for run in runs)),
        "violations": sum(len(run.violations) for run in runs),
    }


def run(settings: Settings) -> Report:
    """Run the grid, or one seed of it in this process."""
    started = time.perf_counter()
    cases = settings.faults.split(",")
    if settings.seed is not None:
        turn = turn_of(settings.seed, settings.turn)
        results = [run_case(case, settings.seed, settings.frames, None, *turn) for case in cases]
    else:
        results = run_grid(cases, settings.seeds, settings.frames, settings.jobs, settings.turn)
    rows = [case_row(case, [one for one in results if one.case == case]) for case in dict.fromkeys(cases)]
    failures = [result for result in results if result.violations]
    total, seconds = sum(result.frames for result in results), time.perf_counter() - started
    figures = {"frames": total, "seconds": seconds, "rows": rows, "failures": [asdict(one) for one in failures]}
    return Report(figures, not failures, figures_text(figures))


TRIAL = Trial(Settings, run)
