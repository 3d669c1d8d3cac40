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
from pans.firmware_sim.checks.reconciliation import ObservedLink, reconcile
from pans.firmware_sim.checks.twin import TapedLink, differences
from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.options import option
from pans.firmware_sim.ports.faults import NAMES, parse_faults
from pans.firmware_sim.ports.faulty import FaultyDevice
from pans.firmware_sim.ports.virtual import START_NS, VirtualLink
from pans.firmware_sim.scene.still import scene_from_arrays
from pans.firmware_sim.testing import small_setup
from pans.runtime.cli import say
from pans.runtime.core.decision import Output
from pans.runtime.core.plan import Plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.errors import LinkError
from pans.runtime.live import LiveRun, Observers, Recovery, RunConfig, RunResult, run_live
from pans.runtime.live.config import AUTO, COMPILED, PYTHON
from pans.runtime.record import Recorder, Recording, read_recording
from pans.runtime.turn.system import offered
from pans.runtime.wire.commands import Gate

from . import Report, Trial, figures_text

SHOTS = 1
MODES = ("sequential", "parallel", "device-driven", "host-driven", "device-driven-counts", "host-driven-counts")
GATE_EVERY = 32  # decisions
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
MEMORY_SLACK_KB = 16_384
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


def run_case(
    case: str, seed: int, frames: int, faults_text: str | None = None, turn: str = PYTHON, reads_again: bool = False
) -> GridResult:
    """Run one case for about `frames` stream messages and return what the checkers found; `faults_text` overrides its faults.

    `turn` is the loop's; with `reads_again` the compiled turn reads the same bytes from a socket and must give the same.
    """
    mode = MODES[seed % len(MODES)]
    profile, bundle, plan = small_setup(mode)
    checker = Checker(plan, SHOTS)
    clock = DeviceClock(profile.clock.tick_hz)
    images = np.random.default_rng(2).integers(0, 256, (6, 2, 2)).astype(np.uint8)
    scene = scene_from_arrays("grid", images, np.arange(6) % 3, ("a", "b", "c"))

    def switch_on(epoch: int, tick: int) -> WatchedInstrument:
        return WatchedInstrument(profile, scene, seed=seed, power_on_tick=tick, epoch=epoch).watch(checker)

    faults = parse_faults(case_faults(case) if faults_text is None else faults_text)
    device = FaultyDevice(switch_on, clock, faults, seed, clock.tick_at(START_NS))
    reads_again = reads_again and plan.largest == 1  # photon numbers have no compiled turn
    link = (TapedLink if reads_again else ObservedLink)(VirtualLink(device, clock, f"grid:{case}"))
    host = GridHost(checker, plan, frames)
    per_visit = 1 + len(plan_blocks(plan)) * plan.cycles_per_object
    config = RunConfig(
        shots=SHOTS, n_cycles=max(1, frames // per_visit) * plan.cycles_per_object, deadline_us=1e9, turn=turn
    )
    started = time.perf_counter()
    backend = "table" if bundle.automaton is None else "automaton"
    decider = make_decider(bundle, shots=SHOTS, backend=backend)
    core = Core(plan, decider, SHOTS, config.n_cycles)
    recovery = Recovery.of(link, "", 30.0)

    def start(run: LiveRun) -> None:
        if isinstance(link, TapedLink):
            link.listen(run)
        host.start(run)

    observers = Observers(host.watch, start)
    header = {"config": _recorded(plan, profile.clock.tick_hz, backend)}

    def live(recorder: Recorder) -> RunResult:
        return run_live(link, profile, bundle, plan, core, config, recorder, recovery, observers)

    def disagreements(result: RunResult, recording: Recording) -> Iterator[str]:
        yield from reconcile(link, checker.books, result, recording, bundle)
        if isinstance(link, TapedLink):
            yield from differences(link.tape, plan, decider, SHOTS, core, recording.decisions())

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


def _recorded(plan: Plan, tick_hz: int, backend: str) -> dict[str, Any]:
    """What a replay needs to know of the run."""
    told = {"shots": SHOTS, "tick_hz": tick_hz, "backend": backend, "drive": plan.drive, "confidence": 0.0}
    return told | ({"photon_number_max": plan.largest} if plan.largest > 1 else {})


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


class GridHost:
    """What the grid does besides the ordinary run: it asks for gates, some of them too late, and watches memory."""

    def __init__(self, checker: Checker, plan: Plan, frames: int) -> None:
        self.checker = checker
        self.memory_growth_kb = 0
        self._plan = plan
        self._decisions = 0
        self._seen = 0
        self._frames = frames
        self._early_kb = 0
        self._run: LiveRun | None = None

    @property
    def began(self) -> bool:
        """Whether the run has come to where it arms the device."""
        return self._run is not None

    def start(self, run: LiveRun) -> None:
        """Listen to the run."""
        self._run = run
        self.checker.attach(run)
        note = run.journal.note

        def tapped(kind: str, **facts: Any) -> None:
            self.checker.on_event(run.connection.session.nonce, {"kind": kind, **facts})
            note(kind, **facts)

        run.journal.note = tapped  # type: ignore[method-assign]

    def watch(self, run: LiveRun, output: Output) -> None:
        """After each block: now and then a gate, and a look at the memory."""
        self._seen += 1
        if not self._early_kb and self._seen > self._frames // 5:
            self._early_kb = resident_kb()
        for _ in output.decisions:
            self._decisions += 1
            if (
                self._decisions % GATE_EVERY == 0
                and output.block_end_tick is not None
                and run.connection.session.has_room
            ):
                # every other gate is so near that it often comes too late; the duration makes each one unique
                lead = 50 if self._decisions % (2 * GATE_EVERY) else 100_000
                gate = Gate(output.block_end_tick + lead, 1 + self._decisions, 0)
                self.checker.submitted(run.connection.session.nonce, run.next_command_id, gate)
                run.gate(*gate)

    def finish(self, ended: str) -> None:
        """After the run: commands that were all acknowledged have one outcome each."""
        assert self._run is not None
        session = self._run.connection.session
        if session.settled and not self._run.link_lost:
            self._run.journal.refusals(self._run.connection)
            self.checker.settled(session.nonce, 1 << 32)
        if ended not in ("completed", "the link was lost within the last object"):
            self.checker.fail(f"the run did not complete: {ended}")
        self.memory_growth_kb = resident_kb() - self._early_kb if self._early_kb else 0
        if self.memory_growth_kb > MEMORY_SLACK_KB:
            self.checker.fail(f"the process grew by {self.memory_growth_kb} kB over the run")


def resident_kb() -> int:
    """Return the resident memory of this process in kB; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024
    except (OSError, ValueError):
        return 0


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
