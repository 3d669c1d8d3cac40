"""One `pans run`, carried out: what is prepared while the port opens, who observes it, the files it leaves, the exit code.

Owns the order of these; arguments are run.py's, the run itself is live/loop.py's. `run_job` returns what came of it.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from pans.runtime.cli import EXIT_ALERT, EXIT_DEVICE, EXIT_FINE, EXIT_INTERRUPTED, EXIT_TIMING, emit, say, warn
from pans.runtime.cli.talk import is_quiet
from pans.runtime.errors import DamagedFileError, PansError
from pans.runtime.html_card import html_card
from pans.runtime.link.base import open_link
from pans.runtime.live.continuous import (
    DISK_NEARLY_FULL,
    INTERRUPTED,
    RECORDING_DELETED,
    REFUSED,
    Stop,
    stop_signals,
)
from pans.runtime.operate.first_start import compiled_beside, load_ahead

from .job import Job, recording_header, stops_of, what_was_run
from .run_files import check_run_files, claimed, gone_if_refused

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pans.runtime.bundle.model import Bundle
    from pans.runtime.core.plan import Plan
    from pans.runtime.decide.verdict import Decider
    from pans.runtime.link.base import Link
    from pans.runtime.live import LiveCore, LiveRun, Recovery, RunConfig, RunResult
    from pans.runtime.live.dark_run import DarkRun
    from pans.runtime.live.flow_run import FlowRun
    from pans.runtime.monitor import Monitor
    from pans.runtime.record import AnyRecorder
    from pans.runtime.registration.use import InUse
    from pans.runtime.report.summary import Summary
    from pans.runtime.watch import Watchdog
    from pans.runtime.watch.metrics import MetricsServer

T = TypeVar("T")


class _Background(Generic[T]):
    """Runs one call in a thread, so that a port can open while the compiled kernels load."""

    def __init__(self, call: Callable[[], T]) -> None:
        self._call = call
        self._value: list[T] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        try:
            self._value.append(self._call())
        except BaseException as error:  # raised again by `result`, in the thread that waits for it
            self._error = error

    def result(self) -> T:
        """Wait for the call; return its value or raise its error."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._value[0]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a job: its summary, truth against decision (classes, classes), and the files that it left."""

    summary: Summary
    confusion: NDArray[np.int64]
    recording: Path | None
    report: Path | None

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the figures of the summary, and the files."""
        found = self.summary.as_json()
        names = ("verdict", "faults", "ended", "decisions", "accuracy", "clicks_mean", "photons_mean", "illumination")
        latency = found.get("latency_us") or {}
        rows = {
            "clicks are": "SIMULATED" if found.get("simulated") else "",
            **{name: found.get(name) for name in (*names, "late", "lost")},
            "latency p99 (us)": latency.get("p99"),
            "recording": self.recording,
        }
        return html_card("Run", rows)


def carry_out(args: argparse.Namespace, job: Job) -> int:
    """Run the job, say how it went and return the exit code."""
    from pans.runtime.report.words import closing_words

    def tell(done: Outcome) -> None:
        files = {"recording": str(done.recording), "report": str(done.report)}
        payload = {**done.summary.as_json(), **files, "shots": job.shots, "seed": job.seed}
        emit(args, payload, closing_words(done.summary, **files))

    return _exit_code(run_job(job, process_start_ns(), ends_process=True, tell=tell).summary)


def run_job(
    job: Job,
    started_ns: int = 0,
    *,
    ends_process: bool = False,
    tell: Callable[[Outcome], None] = lambda done: None,
) -> Outcome:
    """Run the job and leave its files; `started_ns` (time.perf_counter_ns) is when it was asked for, 0: now.

    With `ends_process` a run that hangs when a signal asks for its end takes the process with it (watch/watchdog.py). `tell` gets the
    outcome once the files are whole and before the link is closed, which may wait for a device or a child process.
    """
    check_run_files(job)
    continuous, watchdog = not (job.seconds or job.decisions), None
    with stop_signals(continuous=continuous) as stop, ExitStack() as watched:
        if ends_process:
            from pans.runtime.watch import Watchdog

            watchdog = watched.enter_context(Watchdog(continuous=continuous))
        try:
            # ports first: a busy one is refused before anything is compiled or opened
            with _metrics_of(job) as metrics, ExitStack() as ending:
                with _monitor_of(job) as monitor, compiled_beside() as compiled:
                    beside = _Beside(stop, watchdog, monitor, compiled, metrics, ending)
                    done = _run_job(job, started_ns or time.perf_counter_ns(), beside)
                tell(done)
                return done
        except PansError:
            raise
        except Exception as error:
            if stop.raised:  # a library that was being loaded makes an ImportError of the interrupt
                raise KeyboardInterrupt(stop.word) from error
            raise


class _Beside(NamedTuple):
    """What is there beside a run: how it may be ended from outside, asked to or by force, and who shows it."""

    stop: Stop
    watchdog: Watchdog | None
    monitor: Monitor
    compiled: Callable[[], None]  # waits until the largest kernels are
    metrics: MetricsServer | None
    ending: ExitStack  # what is closed when the outcome has been told


@contextmanager
def _metrics_of(job: Job) -> Iterator[MetricsServer | None]:
    if not job.continuous.metrics:
        yield None
        return
    from pans.runtime.watch.metrics import MetricsServer

    with closing(MetricsServer(job.continuous.metrics)) as server:
        yield server


def _monitor_of(job: Job) -> Monitor:
    from pans.runtime.monitor import Monitor

    return Monitor(panel=job.shows and not is_quiet() and sys.stderr.isatty(), address=job.serve, lines=job.shows)


@dataclass(frozen=True, slots=True)
class _Prepared:
    """All that a run needs beside its link, made while the port opens."""

    bundle: Bundle  # with the patterns that are shown
    bundle_sha256: str
    decider: Decider
    dark: DarkRun
    plan: Plan
    core: LiveCore
    flow_run: FlowRun | None
    config: RunConfig
    header: dict[str, Any]
    expected_decisions: int
    registration: InUse | None = None
    law_warnings: Sequence[str] = ()


def _prepare(job: Job, started_ns: int) -> _Prepared:
    from pans.runtime.bundle.model import load_bundle
    from pans.runtime.core.plan import build_plan, detector_warnings
    from pans.runtime.core.plan_codec import drive_words
    from pans.runtime.core.still import Core
    from pans.runtime.decide.backends import make_decider
    from pans.runtime.flow.make import plan_flow
    from pans.runtime.instrument.calibration import now_utc
    from pans.runtime.live import RunConfig
    from pans.runtime.live.dark_run import DarkRun
    from pans.runtime.live.flow_run import FlowRun
    from pans.runtime.live.gates import open_actuator
    from pans.runtime.registration.use import in_use

    bundle, bundle_sha256 = load_bundle(job.bundle_path)
    decider = make_decider(bundle, shots=job.shots, backend=job.backend, **stops_of(job, bundle))
    placed = in_use(job.dark.registration, bundle, job.profile, now_utc(), job.dark.max_age_h)
    if placed is not None:
        say(f"pans: {placed.words()}")
        bundle = placed.shown
    dark = DarkRun.of(job.dark, placed.profile if placed and not job.dark.calibration else job.profile)
    n_objects, flow_run, seconds = -(-job.decisions // job.trials), None, job.seconds
    core: LiveCore
    if job.flow is not None:
        plan, flow_core, n_cycles = plan_flow(dark.profile, bundle, decider, job.flow, job.shots, job.seconds)
        flow_core.guard = dark.guard(plan, bundle, job.shots, flow=True)
        core, flow_run, seconds = flow_core, FlowRun(flow_core, open_actuator(job.act, job.act_profile)), 0.0
    else:
        plan = build_plan(
            dark.profile,
            bundle,
            shots_per_object=job.shots * job.trials,
            dark_slots_per_cycle=job.dark_slots,
            order=job.order,
            drive=job.drive,
            automaton=getattr(decider, "automaton", None),
        )
        if plan.automaton is not None:
            say(f"pans: {drive_words(dark.profile, bundle, plan)}")
        n_cycles = n_objects * plan.cycles_per_object
        core = Core(plan, decider, job.shots, n_cycles, dark.guard(plan, bundle, job.shots))
    lease_ms = job.profile.timing.lease_ms
    config = RunConfig(
        job.shots, n_cycles, seconds, job.deadline_us, lease_ms, job.realtime, started_ns, job.core, job.turn
    )
    header = recording_header(job, bundle_sha256, decider, n_objects, plan)
    header["config"]["dark"] = dark.header()
    header["config"] |= {} if placed is None else {"registration": placed.header()}
    if flow_run is not None:
        header["config"]["flow"] = flow_run.header()
    decisions = n_objects * job.trials
    doubts = detector_warnings(dark.profile, bundle, plan.exposure_us)
    return _Prepared(
        bundle, bundle_sha256, decider, dark, plan, core, flow_run, config, header, decisions, placed, doubts
    )


def _run_job(job: Job, started_ns: int, beside: _Beside) -> Outcome:
    opening = _Background(lambda: open_link(job.device))
    if beside.monitor.url:
        say(f"pans: live page at {beside.monitor.url}")
    try:
        ready = _prepare(job, started_ns)
        load_ahead()
    except BaseException as error:
        besides = _closed_quietly(opening)
        if besides and isinstance(error, PansError):
            error.message += f"\nbesides, the device could not be opened: {besides}"
        raise
    for warning in [*ready.dark.warnings, *ready.law_warnings]:
        warn(warning)
    link = opening.result()
    beside.ending.callback(link.close)
    with claimed(job) as job:
        if job.trace is not None:
            link = _traced(job, link, job.trace, beside)
        return _recorded(job, ready, link, beside)


def _traced(job: Job, link: Link, path: Path, beside: _Beside) -> Link:
    """Return `link` with a trace; one that could not be written to its end is told, and ends nothing."""
    from pans.runtime.link.trace import TracedLink

    traced = TracedLink(link, path, job.device, force=job.force)

    def close() -> None:
        traced.close()
        if traced.trouble:
            say(f"pans: {path}: the trace is not whole: {traced.trouble}")

    beside.ending.callback(close)
    return traced


def _recorded(job: Job, ready: _Prepared, link: Link, beside: _Beside) -> Outcome:
    from pans.runtime.live import Recovery
    from pans.runtime.live.continuous import open_recorder

    recovery = Recovery.of(link, job.device, job.reconnect_s) if job.reconnect_s else None
    if job.recording is None:
        result = _watched(job, ready, link, None, recovery, beside)
        return _conclude(job, ready, result, _summary(job, ready, result))
    limits, header = job.continuous.limits, ready.header | {"simulated": link.simulated}
    with ExitStack() as opened:
        opened.enter_context(gone_if_refused(job))
        # the file is not held by a name: it may have 64 MiB, and the run begins here
        recorder = opened.enter_context(
            open_recorder(job.recording, header, _same_bundle(job, ready), limits, force=job.force)
        )
        result = _watched(job, ready, link, recorder, recovery, beside)
        summary = _summary(job, ready, result)
        if (kept := recorder.keep_deleted()) is not None:
            job = replace(job, out=kept.parent, record=kept, continuous=replace(job.continuous, limits=None))
            fault = f"{RECORDING_DELETED}: what could be kept of it is now {kept}"
            warn(fault)
            summary = replace(summary, verdict="FAIL", faults=[*summary.faults, fault])
        summary = replace(summary, decisions_sha256=recorder.close(summary.as_json()))
    return _conclude(job, ready, result, summary)


def _same_bundle(job: Job, ready: _Prepared) -> bytes:
    """Return the bundle's file once more, for the recording; DamagedFileError if it is no longer the one that decides."""
    from pans.runtime.container import read_file

    data = read_file(job.bundle_path)
    if hashlib.sha256(data).hexdigest() != ready.bundle_sha256:
        raise DamagedFileError(f"{job.bundle_path}: changed while the run began", remedy="run it again")
    return data


def _watched(
    job: Job,
    ready: _Prepared,
    link: Link,
    recorder: AnyRecorder | None,
    recovery: Recovery | None,
    beside: _Beside,
) -> RunResult:
    """Run, with all observers: the dark counts' guard, the live view, metrics and the state file."""
    from pans.runtime.core.decision import Output
    from pans.runtime.live import Observers
    from pans.runtime.live.loop import running
    from pans.runtime.watch import Attendants

    dark, monitor = ready.dark, beside.monitor
    monitor.begin(ready.bundle, recorder, _facts(job, ready, link))
    with Attendants(job.continuous, recorder, beside.watchdog, beside.stop, beside.metrics) as seen:

        def prepared(run: LiveRun) -> None:
            dark.check_device(run)
            if ready.registration is not None:
                ready.registration.check_device(dark.serial_of(run))
            _name_scene(run, job.device)
            seen.prepared(run)
            monitor.prepared(run)
            if ready.flow_run is not None:
                ready.flow_run.prepared(run)

        def look(run: LiveRun, output: Output) -> None:
            dark.look(run, output)
            seen.tell(run)
            monitor.watch(run, output)

        observers = Observers(look, prepared, beside.stop, acts=False, uploaded=beside.compiled)
        what = dark.profile, ready.bundle, ready.plan, ready.core, ready.config
        return beside.ending.enter_context(running(link, *what, recorder, recovery, observers))


def _facts(job: Job, ready: _Prepared, link: Link) -> dict[str, Any]:
    """What a live view is told before the run."""
    from pans.runtime.monitor.snapshot import begin_facts

    bundle = ready.bundle
    return begin_facts(
        bundle,
        title=f"{bundle.name} on {job.profile.name}",
        simulated=link.simulated,
        expected=ready.expected_decisions,
        deadline_us=ready.config.deadline_us,
        trials=job.trials,
        illumination=bundle.illumination() * job.shots * (1 if job.flow is None else job.flow.pool),
    )


def _name_scene(run: LiveRun, device: str) -> None:
    from pans.runtime.link.scene_fit import scene_words

    welcome = run.connection.session.welcome
    if welcome is not None and (words := scene_words(welcome.facts, device)):
        say(f"pans: {words}")


def _summary(job: Job, ready: _Prepared, result: RunResult) -> Summary:
    from pans.runtime.report.summary import summarise, walk_figures

    frames = job.shots * (1 if job.flow is None else job.flow.pool)
    walks = walk_figures(result, ready.plan, ready.bundle, job.profile.name, job.confidence)
    shown = None if walks is None else walks.illumination_mean
    return summarise(
        result,
        illumination=ready.bundle.illumination() * frames if shown is None else shown,
        expected_decisions=ready.expected_decisions,
        flow=None if ready.flow_run is None else ready.flow_run.figures(),
        dark=ready.dark.figures(result.dark),
        walks=walks,
        registration=None if ready.registration is None else ready.registration.facts(),
    )


def _conclude(job: Job, ready: _Prepared, result: RunResult, summary: Summary) -> Outcome:
    """Write the page and return what came of the run."""
    from pans.runtime.report.summary_page import write_markdown

    confusion, page, bundle = result.tally.confusion, job.page, ready.bundle
    if ready.flow_run is not None:
        confusion = confusion + ready.flow_run.core.matcher.confusion
    if page is not None:
        facts = what_was_run(job, bundle.name, ready.bundle_sha256, ready.decider.name, summary)
        write_markdown(page, summary, facts, confusion, bundle.classes, force=job.force)
    return Outcome(summary, confusion, job.left_recording, page)


def process_start_ns() -> int:
    """Return when this process started on the scale of time.perf_counter_ns (Linux), or now where that is not known."""
    now_ns = time.perf_counter_ns()
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        ticks_hz = 100  # USER_HZ: fixed at 100 in the ABI of Linux
        age_s = float(Path("/proc/uptime").read_text().split()[0]) - int(fields[19]) / ticks_hz
        return now_ns - round(max(age_s, 0.0) * 1e9)
    except (OSError, ValueError, IndexError):
        return now_ns


def _closed_quietly(opening: _Background[Any]) -> str:
    """Close the link that is being opened; return why it could not be, "" where it could."""
    try:
        opening.result().close()
    except Exception as error:
        return str(error)
    return ""


def _exit_code(summary: Summary) -> int:
    if summary.ended == INTERRUPTED:
        return EXIT_INTERRUPTED
    if summary.ended in (DISK_NEARLY_FULL, RECORDING_DELETED):
        return EXIT_ALERT
    if summary.link_lost or summary.ended.startswith(REFUSED):
        return EXIT_DEVICE
    if summary.late or summary.lost or summary.stream["lost_messages"] or summary.contradictions:
        return EXIT_TIMING
    return EXIT_FINE if summary.verdict == "PASS" else EXIT_ALERT
