"""`pans doctor --warm`: all kernels of a run compiled into the cache, in as many processes as there are cores.

Owns the jobs and their order; what a kernel is, the packages know. Jobs of the first wave compile the large kernels; then the ordinary
commands run once in simulation, which compiles whatever they need besides. A job runs in a process of its own: `python -m
pans.runtime.operate.warm JOB`. Times are those of this machine and its load.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import say
from pans.runtime.errors import PansError

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle
    from pans.runtime.core.still import Core

WALKING, STILL = "fashion-adaptive", "fashion10"
WALKING_PROFILE, STILL_PROFILE, PARALLEL_PROFILE = "dmd-spad", "oled-qcmos", "flow-snspd"
PATIENCE_S = 600.0
LOOK_EVERY_S = 0.05
TOLD_CHARACTERS = 300


@dataclass(frozen=True, slots=True)
class Job:
    """A process that compiles: a name, its words behind `python`, and the exit codes with which it has done its work."""

    name: str
    words: tuple[str, ...]
    fine: tuple[int, ...] = (0,)


# ---- the jobs of the first wave, each in a process of its own ----


def compile_core() -> None:
    """The steps of sequential streams, fixed patterns and walks alike, and their compiled turn."""
    from pans.runtime.bundle.model import load_bundle

    bundle, _ = load_bundle(WALKING)
    _compile_turn(_compile_steps(bundle, WALKING_PROFILE, _Leaves(bundle)))


def compile_still() -> None:
    """The back ends of fixed patterns, the compiled turn of parallel frames, and the steps of Python's turn."""
    from pans.runtime.bundle.model import load_bundle
    from pans.runtime.decide.backends import make_decider

    bundle, _ = load_bundle(STILL)
    _compile_steps(bundle, STILL_PROFILE, make_decider(bundle)).warm_up_steps()
    bundle = _four_patterns()
    _compile_turn(_compile_steps(bundle, PARALLEL_PROFILE, make_decider(bundle)))
    compile_numbered()


def compile_numbered() -> None:
    """What is done with decisions that frames of parallel channels give one by one."""
    import numpy as np

    from pans.runtime.core.decision import DECISION_DTYPE, RUN_DTYPE, VERDICT_DTYPE, NumberedDecisions
    from pans.runtime.core.stream_arrays import MarkArrays
    from pans.runtime.core.stream_kernels import write_rows
    from pans.runtime.live.tally import RunTally
    from pans.runtime.record.log import LogEncoder

    rows, numbers = np.zeros(0, DECISION_DTYPE), np.zeros(0, np.uint32)
    decided = np.zeros(1, VERDICT_DTYPE), numbers, np.zeros(0, RUN_DTYPE)
    none = NumberedDecisions(*decided, lambda first, stop: rows)
    write_rows(*decided, 0, 0, rows)
    LogEncoder().prepare(none)
    marks = MarkArrays(np.zeros(2, np.int64), np.zeros(2, np.int16), np.zeros(2, np.float32))
    RunTally(2, 1).warm_up(marks, 1, none)


class _Leaves:
    """What compiled steps ask of the back end of an automaton, whose own kernels another process compiles."""

    name = "automaton"

    def __init__(self, bundle: Bundle) -> None:
        from pans.runtime.decide.automaton import leaf_verdicts, walked_within

        assert bundle.automaton is not None
        self.automaton = walked_within(bundle, bundle.automaton, 0.0, None)
        self.n_features, self.n_classes = self.automaton.n_bits, self.automaton.n_classes
        self.labels, self.probabilities = leaf_verdicts(self.automaton, 0.0)


def _compile_steps(bundle: Bundle, profile: str, decider: Any) -> Core:
    from pans.runtime.core.plan import build_plan
    from pans.runtime.core.still import Core
    from pans.runtime.instrument.profile import load_profile

    plan = build_plan(load_profile(profile), bundle, automaton=getattr(decider, "automaton", None))
    core = Core(plan, decider, 1, 0)
    core.warm_up()
    return core


def _compile_turn(core: Core) -> None:
    from pans.runtime.turn import Turn
    from pans.runtime.wire.bulk import BulkDecoder

    steps = core.bulk_steps(1)
    if steps is not None:
        Turn(steps, BulkDecoder()).warm_up()


def compile_link() -> None:
    """Decoding, the decision log, the watch over dark counts, the sums of a run, the core that is kept awake."""
    import numpy as np

    from pans.runtime.instrument.cusum import ChannelWatch
    from pans.runtime.instrument.dead_channels import DeadChannelTest
    from pans.runtime.record import Recorder
    from pans.runtime.timing.cpu import busy_core, usable_cores
    from pans.runtime.wire.bulk import BulkDecoder

    BulkDecoder().warm_up()
    rates = np.full(1, 0.01)
    ChannelWatch(1, rates).warm_up()
    DeadChannelTest(rates, 1e9, 1e9).warm_up()
    compile_settling()
    with tempfile.TemporaryDirectory() as folder, Recorder(Path(folder) / "warm.pansrec", {}) as recorder:
        recorder.close({})
    if hasattr(os, "sched_getaffinity"):
        with busy_core(usable_cores()[0]):
            pass


def compile_settling() -> None:
    """What is done with what a call of the compiled turn has brought."""
    import numpy as np

    from pans.runtime.core.stream_arrays import MarkArrays
    from pans.runtime.live.tally import RunTally
    from pans.runtime.record.format import TIMING_RUN_DTYPE
    from pans.runtime.timing.ledger import TimingLedger
    from pans.runtime.turn import rings, settling
    from pans.runtime.turn.kernels import unpack_blocks

    whole, real = np.zeros(2, np.int64), np.zeros(2)
    RunTally(2, 1).warm_up(MarkArrays(whole, np.zeros(2, np.int16), np.zeros(2, np.float32)), 1)
    histograms = tuple(histogram.numbers for histogram in TimingLedger(1).histograms)
    judged, marked = np.zeros(settling.N_JUDGED, np.int64), np.zeros((1, settling.N_MARKED), np.int64)
    lines = (whole, real), (whole, real)
    blocks, runs = np.zeros((0, rings.N_STEP), np.int64), np.zeros(1, TIMING_RUN_DTYPE)
    settling.judge_blocks(blocks, 0, *lines, 1, histograms, judged, runs, marked)
    unpack_blocks(np.zeros(8, np.uint8), np.zeros((0, 4), np.int64), np.zeros(1, np.uint16), np.zeros(1, np.uint8))


def compile_flow() -> None:
    """The steps of objects in flow."""

    from pans.runtime.decide.backends import make_decider
    from pans.runtime.flow.make import plan_flow
    from pans.runtime.flow.settings import read_flow
    from pans.runtime.flow.steps import FlowSteps
    from pans.runtime.instrument.profile import load_profile
    from pans.runtime.turn.engine import Turn
    from pans.runtime.wire.bulk import BulkDecoder

    profile, bundle = load_profile(PARALLEL_PROFILE), _four_patterns()
    decider = make_decider(bundle)
    for kind in ("cells", "tape"):
        plan, core, _ = plan_flow(profile, bundle, decider, read_flow(kind), 1, 1.0)
        core.warm_up()
        Turn(FlowSteps(core, plan), BulkDecoder()).warm_up()


def _four_patterns() -> Bundle:
    """A small bundle for parallel channels, decided by a table."""
    import numpy as np

    from pans.runtime.bundle.model import BackEnd, Shown, make_bundle
    from pans.runtime.instrument.profile import load_profile

    profile = load_profile(PARALLEL_PROFILE)
    levels = np.zeros((4, 64), np.uint16)
    levels[:, 0] = profile.projector.levels - 1
    top = profile.projector.peak_photoelectrons_hz * profile.exposure.min_us * 2e-6 / (profile.projector.levels - 1)
    return make_bundle(
        name="warm",
        task="warm",
        classes=("a", "b"),
        image_shape=(8, 8),
        optics=Shown(profile.projector.levels, levels, top),
        back_end=BackEnd(table=np.zeros((16, 2), np.float32)),
        provenance={},
    )


JOBS: Mapping[str, Callable[[], None]] = {
    "core": compile_core,
    "link": compile_link,
    "flow": compile_flow,
    "still": compile_still,  # when the steps are compiled
}


def commands_once(folder: Path) -> list[Job]:
    """Return the ordinary commands of the second wave; their files go to `folder`."""
    device = f"sim:{STILL_PROFILE}?pace=fast&scene=fashion200"
    lines = {
        "demo": ["demo", "--trials", "1", "--seconds", "0.2", "--no-realtime", "--out", str(folder / "demo")],
        "run": ["run", STILL, "--device", device, "--decisions", "3", "--no-realtime", "--out", str(folder / "run")],
    }
    fine = (0, 1, 4)  # a run may be late, and its verdict FAIL, on a machine that compiles
    return [Job(name, ("-m", "pans", *words, "--json"), fine) for name, words in lines.items()]


# ---- carrying out ----


def warm(processes: int = 0) -> dict[str, Any]:
    """Compile everything; return {seconds, processes, folder, kernels, jobs}, `kernels` how many compiled ones are new in the cache.

    `processes` at a time (0: as many as there are cores).
    """
    processes = processes or _cores()
    began, folder = time.perf_counter(), cache_folder()
    known = len(_compiled(folder))
    rows = []
    with tempfile.TemporaryDirectory(prefix="pans-warm-") as scratch:
        first = [Job(name, ("-m", "pans.runtime.operate.warm", name)) for name in JOBS]
        for wave in (first, commands_once(Path(scratch))):
            for row in _carried_out(wave, processes):
                rows.append(row)
                say(
                    f"pans: compiled: {row['name']}, {row['seconds']:.1f} s{'' if row['ok'] else ', FAILED: ' + row['told']}"
                )
    return {
        "seconds": time.perf_counter() - began,
        "processes": processes,
        "folder": str(folder),
        "kernels": len(_compiled(folder)) - known,
        "jobs": rows,
    }


def _carried_out(jobs: Sequence[Job], processes: int) -> Iterator[dict[str, Any]]:
    """Run jobs side by side; yield a row for each as it ends."""
    waiting, running = list(jobs), list[tuple[Job, float, subprocess.Popen[str]]]()
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                job = waiting.pop(0)
                running.append((job, time.perf_counter(), start(job)))
            for one in [one for one in running if one[2].poll() is not None]:
                running.remove(one)
                yield _row(*one)
            late = [job.name for job, began, _ in running if time.perf_counter() - began > PATIENCE_S]
            if late:
                raise PansError(f"{', '.join(late)}: not compiled within {PATIENCE_S:.0f} s")
            time.sleep(LOOK_EVERY_S)
    finally:
        for _, _, process in running:
            process.kill()
            process.communicate()


def start(job: Job) -> subprocess.Popen[str]:
    """Start a job's process; its errors can be read."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, *job.words]
    return subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment
    )


def _row(job: Job, began: float, process: subprocess.Popen[str]) -> dict[str, Any]:
    seconds = time.perf_counter() - began
    _, told = process.communicate()
    ok = process.returncode in job.fine
    words = "" if ok else (told.strip().splitlines() or [f"exit code {process.returncode}"])[-1][:TOLD_CHARACTERS]
    return {"name": job.name, "seconds": seconds, "ok": ok, "told": words}


def cache_folder() -> Path:
    """Return where numba keeps compiled kernels: NUMBA_CACHE_DIR, or the package's own folders. Needs no numba."""
    named = os.environ.get("NUMBA_CACHE_DIR", "")
    return Path(named) if named else Path(__file__).parents[1]


def _compiled(folder: Path) -> list[Path]:
    return list(folder.rglob("*.nbc"))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def words_of(found: Mapping[str, Any]) -> str:
    """Return what was done in words."""
    failed = [f"{row['name']}: {row['told']}" for row in found["jobs"] if not row["ok"]]
    text = (
        f"{found['kernels']} kernels compiled in {found['seconds']:.1f} s by {found['processes']} processes at a time\n"
        f"they are kept in {found['folder']}"
    )
    return "\n".join([text, *(f"FAILED: {one}" for one in failed)])


if __name__ == "__main__":
    began = time.perf_counter()
    JOBS[sys.argv[1]]()
    print(json.dumps({"job": sys.argv[1], "seconds": time.perf_counter() - began}))
