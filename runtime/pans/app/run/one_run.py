"""One run from its options to its files: check, prepare, open, run, report. `run_once` is the page to read.

What is prepared (bundle, plan, core, header) is made while the port opens. The loop is live/loop.py's.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pans.base.console import check_options, emit, html_card, option_fields, refuse_without, say, state, warn
from pans.base.errors import (
    EXIT_ALERT,
    EXIT_DEVICE,
    EXIT_FINE,
    EXIT_INTERRUPTED,
    EXIT_TIMING,
    DamagedFileError,
    PansError,
    UsageError,
)
from pans.base.files import RUNS
from pans.base.machine import check_core, lacking
from pans.base.numbers import Shown, shown
from pans.decide.flow import FlowSettings, read_flow, with_gate
from pans.instrument.calibration_file import MAX_AGE_H
from pans.instrument.profile import Profile, load_profile
from pans.live.options import FLOW, RunOptions
from pans.live.stop import DISK_NEARLY_FULL, INTERRUPTED, RECORDING_DELETED, REFUSED, Stop, stop_signals
from pans.protocol.links import open_link

from .files import check_run_files, claimed, gone_if_refused, part_limits, recording_header, what_was_run

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pans.bundle.automaton import DoseCap
    from pans.bundle.sensor import Bundle
    from pans.calibrate.registration import InUse
    from pans.decide import Follower, Output
    from pans.live.loop import FlowRun, Observers, RunResult, Status
    from pans.live.watch import MetricsServer, OscSender, Watchdog
    from pans.protocol.links import Link
    from pans.record.recorder import Recorder
    from pans.report.live_view import Monitor
    from pans.report.summary import Summary

ROUNDING = 1e-9  # of a dose cap: a sum of light is known to so many digits


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a run: its summary, truth against decision (classes, classes), and the files that it left."""

    summary: Summary
    confusion: NDArray[np.int64]
    recording: Path | None
    report: Path | None

    def __repr__(self) -> str:
        told = f"{self.summary.decisions} decisions, recording {self.recording}, report {self.report}"
        return f"<Run: {self.summary.verdict}, {told}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the figures of the summary, and the files."""
        found = self.summary.as_json()
        rows = {
            "clicks are": "SIMULATED" if found.get("simulated") else "",
            "verdict": self.summary.verdict,
            **{one.key: one.value(found) for one in shown(Shown.CARD)},
            "recording": self.recording,
        }
        return html_card("Run", rows)


class _Around(NamedTuple):
    """What lives around a run: who ends it, who displays it, and what is closed when its outcome is known."""

    stop: Stop
    watchdog: Watchdog | None
    monitor: Monitor
    metrics: MetricsServer | None
    osc: OscSender | None
    besides: Observers | None
    ending: ExitStack


def run_and_report(args: argparse.Namespace, options: RunOptions) -> int:
    """Run, print how it went and return the exit code."""
    from pans.report.summary import closing_words

    def report(done: Outcome) -> None:
        files = {"recording": str(done.recording), "report": str(done.report)}
        payload = {**done.summary.as_json(), **files, "shots": options.shots, "seed": getattr(args, "seed", None)}
        emit(args, payload, closing_words(done.summary, **files))

    options = replace(options, started_ns=process_start_ns())
    return _exit_code(run_once(options, ends_process=True, report=report).summary)


def run_once(
    options: RunOptions,
    profile: Profile | None = None,
    *,
    ends_process: bool = False,
    report: Callable[[Outcome], None] = lambda done: None,
    besides: Observers | None = None,
) -> Outcome:
    """Run and leave the files; `profile` takes the place of the one that `options` name.

    With `ends_process` a run that hangs when a signal asks for its end takes the process with it (live/watch/watchdog.py). `report` gets
    the outcome once the files are whole and before the link is closed, which may wait for a device or a child process. `besides` observe
    the run, too, as those who only look; their `stop` ends it from another thread.
    """
    check_together(options)
    profile = profile or load_profile(options.profile or "")
    if options.deadline_us:  # it sizes the blocks, too
        profile = replace(profile, timing=replace(profile.timing, decision_deadline_us=options.deadline_us))
    options = replace(
        options,
        deadline_us=profile.timing.decision_deadline_us,
        started_ns=options.started_ns or time.perf_counter_ns(),
    )
    check_run_files(options)
    continuous, watchdog = not (options.seconds or options.decisions), None
    asked = None if besides is None else besides.stop
    with stop_signals(continuous=continuous, stop=asked) as stop, ExitStack() as watched:
        if ends_process:
            from pans.live.watch import Watchdog

            watchdog = watched.enter_context(Watchdog(continuous=continuous))
        try:
            # ports first: a busy one is refused before anything is compiled or opened
            with ExitStack() as listened, ExitStack() as ending:
                metrics, osc = _listeners_of(options, listened)
                with _monitor_of(options) as monitor:
                    around = _Around(stop, watchdog, monitor, metrics, osc, besides, ending)
                    done = _prepare_and_run(options, profile, around)
                report(done)
                return done
        except PansError:
            raise
        except Exception as error:
            if stop.raised:  # a library that was being loaded makes an ImportError of the interrupt
                raise KeyboardInterrupt(stop.word) from error
            raise


def check_together(options: RunOptions) -> None:
    """Raise UsageError for options that are out of range, or make no sense together."""
    check_options(options)
    check_core(options.core)
    if options.flow is None:
        of_flow = {one.name: one.default for one, _ in option_fields(options) if one.metadata["group"] == FLOW}
        refuse_without(options, "--flow", of_flow)
    elif flow_of(options) is not None and (options.decisions or options.trials != 1):
        remedy = "--seconds, in place of --decisions and --trials"
        raise UsageError("a flow has as many decisions as objects pass", remedy=remedy)
    if options.calibration is None and options.registration is None:
        refuse_without(options, "--calibration or --registration", {"calibration_max_age_h": MAX_AGE_H})
    if options.keep_mb and not options.rotate_mb:
        raise UsageError("--keep-mb deletes parts, and there are none", remedy="say how large with --rotate-mb")
    if options.keep_runs_mb:
        if options.out_root is None or not options.keep_mb:
            remedy = "leave --out and --record out, and bound each run with --rotate-mb and --keep-mb"
            raise UsageError(f"--keep-runs-mb deletes earlier runs in {RUNS} that are in parts", remedy=remedy)
        if options.keep_runs_mb < 2 * options.keep_mb:
            what = f"--keep-runs-mb {options.keep_runs_mb:g} is below twice --keep-mb {options.keep_mb:g}"
            raise UsageError(what, remedy="leave room for this run and the one before")
    if options.rotate_mb and options.on_dark != "warn":
        raise UsageError(
            f"--rotate-mb with --on-dark {options.on_dark}: what the guard has learnt is not in a part, which could not be replayed",
            remedy="record without parts, or use --on-dark warn",
        )
    part_limits(options)
    _check_address(options.serve, options.serve_public, "--serve")
    if options.serve_control and (options.serve_public or not options.serve):
        what = "has no effect without --serve" if not options.serve else "and --serve-public: there is no password"
        remedy = (
            "add --serve HOST:PORT, or leave it out" if not options.serve else "use a tunnel (docs/how-to/live-view.md)"
        )
        raise UsageError(f"--serve-control {what}", remedy=remedy)
    _check_address(options.metrics, options.metrics_public, "--metrics")


def _check_address(address: str, public: bool, option: str) -> None:
    """Check where a page is served; one that others can reach is said aloud."""
    if not address:
        if public:
            raise UsageError(f"{option}-public has no effect without {option}", remedy=f"add {option}, or leave it out")
        return
    from pans.live.watch import check_address, is_public

    check_address(address, public=public, option=option)
    if is_public(address):
        warn(f"other machines can read the figures at {address}; there is no password")


def flow_of(options: RunOptions) -> FlowSettings | None:
    """Return the settings of the flow that is asked for; None without one."""
    if options.flow is None:
        return None
    classes = tuple(name for part in options.gate_class for name in part.split(",") if name)
    settings = with_gate(read_flow(options.flow), classes, options.gate_delay_us)
    return settings if options.pool is None else replace(settings, pool=options.pool)


def dose_of(options: RunOptions, bundle: Bundle, profile: Profile) -> DoseCap | None:
    """Return what each walk of an automaton may bring, so that no object receives more than the dose cap; None of fixed patterns.

    UsageError where the cap cannot be kept: for fixed patterns that bring more, passive bundles, objects in flow, and patterns that a
    registration changes.
    """
    if not options.dose_cap:
        return None
    if bundle.analyser is not None or options.flow is not None or options.registration is not None:
        raise UsageError(
            "--dose-cap is for patterns that are displayed to one object after another as the bundle states them: not for passive "
            "optics, --flow or --registration",
            remedy="leave --dose-cap out, or the other one",
        )
    if bundle.automaton is not None:
        from pans.bundle.automaton import STATES_MAX, DoseCap

        states = min(profile.projector.automaton_states or STATES_MAX, STATES_MAX)
        return DoseCap(options.dose_cap / options.trials, states)
    light = bundle.illumination() * options.shots * options.trials
    if light > options.dose_cap * (1 + ROUNDING):
        raise UsageError(
            f"{bundle.name} sends {light:.6g} photoelectrons of illumination to an object ({bundle.n_features} patterns, "
            f"{options.shots} shots, {options.trials} trials), --dose-cap allows {options.dose_cap:.6g}",
            remedy="pans order BUNDLE --by dose --dose-cap N makes a bundle of as many patterns as stay below; or fewer shots or trials",
        )
    return None


class _Run:
    """One run: all that it needs but its link, made at once; `recorded` runs it."""

    def __init__(self, options: RunOptions, profile: Profile, around: _Around) -> None:
        from pans.bundle.backends import make_decider
        from pans.bundle.sensor import load_bundle
        from pans.decide.plan import build_plan, detector_warnings, drive_words
        from pans.decide.still import Core
        from pans.instrument.calibration_file import now_utc
        from pans.live.loop import DarkRun, open_actuator

        self.profile, self.around = profile, around
        flow, shots, seconds = flow_of(options), options.shots, options.seconds
        bundle, bundle_sha256 = load_bundle(options.bundle)
        dose = dose_of(options, bundle, profile)
        decider = make_decider(bundle, shots=shots, backend=options.backend, confidence=options.confidence, dose=dose)
        self.registration: InUse | None = None
        if options.registration is not None:
            from pans.calibrate.registration import in_use

            self.registration = in_use(options.registration, bundle, profile, now_utc(), options.calibration_max_age_h)
            say(f"pans: {self.registration.words()}")
            bundle = self.registration.shown
        self.bundle = bundle  # with the patterns that are displayed
        placed = self.registration.profile if self.registration and not options.calibration else profile
        self.dark = DarkRun.of(options, placed)
        n_objects = -(-options.decisions // options.trials)
        self.expected_decisions = n_objects * options.trials
        self.frames = shots if flow is None else shots * flow.pool  # of a decision; a flow adds windows
        self.core: Follower
        self.flow_run: FlowRun | None = None
        if flow is not None:
            from pans.decide.flow import plan_flow
            from pans.live.loop import FlowRun

            self.plan, flow_core, n_cycles = plan_flow(self.dark.profile, bundle, decider, flow, shots, seconds)
            seconds = 0.0  # the end of a flow is in its plan
            flow_core.guard = self.dark.guard(self.plan, bundle, shots, flow=True)
            second = load_profile(options.act_profile) if options.act_profile else profile
            self.core, self.flow_run = flow_core, FlowRun(flow_core, open_actuator(options.act, second))
        else:
            self.plan = build_plan(
                self.dark.profile,
                bundle,
                shots_per_object=shots * options.trials,
                dark_slots_per_cycle=options.dark_slots,
                order=options.order,
                drive=options.drive,
                automaton=decider.automaton,
            )
            if self.plan.automaton is not None:
                say(f"pans: {drive_words(self.dark.profile, bundle, self.plan)}")
            n_cycles = n_objects * self.plan.cycles_per_object
            self.dark.expect(self.plan, bundle, options.trials)
            self.core = Core(self.plan, decider, shots, n_cycles, self.dark.guard(self.plan, bundle, shots))
        self.header = recording_header(options, profile, bundle_sha256, decider, n_objects, self.plan)
        parts = {"dark": self.dark, "registration": self.registration, "flow": self.flow_run}
        self.header["config"] |= {name: part.header() for name, part in parts.items() if part is not None}
        self.options = replace(options, n_cycles=n_cycles, lease_ms=profile.timing.lease_ms, seconds=seconds)
        for warning in (*self.dark.warnings, *detector_warnings(self.dark.profile, bundle, self.plan.exposure_us)):
            warn(warning)

    def recorded(self, options: RunOptions, link: Link) -> Outcome:
        """Run with a recording, if `options` ask for one; they name the folder that the run was given."""
        from pans.record.recorder import Recorder

        recorder: Recorder | None = None
        with ExitStack() as opened:
            if options.recording is not None:
                opened.enter_context(gone_if_refused(options))
                # the bundle's bytes are not held by a name: they may have 64 MiB, and the run begins here
                recorder = opened.enter_context(
                    Recorder(
                        options.recording,
                        self.header | {"simulated": link.simulated, "virtual_time": link.virtual},
                        bundle=_same_bundle(options.bundle, self.header["bundle_sha256"]),
                        overwrite=options.force,
                        limits=part_limits(options),
                    )
                )
            options, result, summary = self._watched(options, link, recorder)
            if recorder is not None:
                summary = replace(summary, decisions_sha256=recorder.close(summary.as_json()))
        return self._conclude(options, result, summary)

    def _watched(
        self, options: RunOptions, link: Link, recorder: Recorder | None
    ) -> tuple[RunOptions, RunResult, Summary]:
        """Run, with all observers: the dark counts' guard, the live view, metrics and the state file, which get the verdict."""
        from pans.decide.kernel import BATCH_NS
        from pans.live.loop import Job, Observers, Recovery, running, scene_words
        from pans.live.watch import Watchers

        around, monitor, besides = self.around, self.around.monitor, self.around.besides
        recovery = Recovery.of(link, options.device, options.reconnect_s) if options.reconnect_s else None
        facts = dict(
            kind="begin",
            classes=list(self.bundle.classes),
            encoder=self.bundle.encoder,
            title=f"{self.bundle.name} on {self.profile.name}",
            simulated=link.simulated,
            expected=self.expected_decisions,
            deadline_us=options.deadline_us,
            late_allowed=options.late_allowed,
            exposure_tolerance_us=self.profile.exposure_tolerance_us(self.plan.exposure_us),
            trials=options.trials,
            illumination=self.bundle.illumination() * self.frames,
            clicks_stated=self.dark.light.stated,
        )
        monitor.begin(facts, around.stop)
        with Watchers(options, recorder, around.watchdog, around.stop, around.metrics) as seen:

            def prepared(run: Status) -> None:
                self.dark.check_device(run)
                if self.registration is not None:
                    self.registration.registered.check_made_for(self.profile, self.dark.serial_of(run))
                if words := scene_words(run.session.facts, options.device):
                    say(f"pans: {words}")
                if not link.virtual and (missing := lacking()):
                    say(f"pans: {sys.platform} has no {', no '.join(missing)}; decisions that are late are counted")
                seen.prepared(run)
                monitor.prepared(run, self.bundle, seen.look)
                if besides is not None and besides.prepared is not None:
                    besides.prepared(run)
                if self.flow_run is not None:
                    self.flow_run.prepared(run)

            def look(run: Status, output: Output) -> None:
                self.dark.look(run, output)
                seen.note_news(run)
                monitor.watch(run, output)
                if around.osc is not None:
                    around.osc.watch(run, output)
                if besides is not None and besides.watch is not None:
                    besides.watch(run, output)

            # a neighbour that hears of each decision hears of it at once
            at_once = around.osc is not None or (besides is not None and besides.watch is not None)
            observers = Observers(look, prepared, around.stop, acts=False, gather_ns=0 if at_once else BATCH_NS)
            job = Job(self.dark.profile, self.bundle, self.plan, self.options)
            result = around.ending.enter_context(running(link, job, self.core, recorder, recovery, observers))
            monitor.close_notes()
            options, summary = self._summary(options, result, recorder)
            seen.conclude(summary.verdict, summary.faults)
        return options, result, summary

    def _summary(self, options: RunOptions, result: RunResult, recorder: Recorder | None) -> tuple[RunOptions, Summary]:
        """Return the summary; and the options with what is left of a recording that was deleted during the run."""
        from pans.report.summary import summarise, walk_figures

        walks = walk_figures(result, self.plan, self.bundle, self.profile.name, options.confidence)
        shown = None if walks is None else walks.illumination_mean
        summary = summarise(
            result,
            illumination=self.bundle.illumination() * self.frames if shown is None else shown,
            expected_decisions=self.expected_decisions,
            flow=None if self.flow_run is None else self.flow_run.figures(),
            dark=self.dark.figures(result.dark, *self._lit(result), saturates=self.plan.largest == 1),
            walks=walks,
            registration=None if self.registration is None else self.registration.facts(),
            late_allowed=options.late_allowed,
            may_be_busy=options.may_be_busy,
        )
        if recorder is None or (kept := recorder.keep_deleted()) is None:
            return options, summary
        fault = f"{RECORDING_DELETED}: what could be kept of it is now {kept}"
        warn(fault)
        options = replace(options, out=kept.parent, record=kept, rotate_mb=None)
        return options, replace(summary, verdict="FAIL", faults=[*summary.faults, fault])

    def _lit(self, result: RunResult) -> tuple[int, int]:
        """Return clicks, and exposures with light that may each have given one; 0 and 0 of objects that pass by."""
        tally = result.tally
        if self.flow_run is not None:
            return 0, 0
        fixed = tally.decisions * tally.shots * self.plan.n_patterns if self.plan.automaton is None else 0
        return tally.of["decisions"].clicks, fixed or tally.exposures * self.plan.channels_at_once

    def _conclude(self, options: RunOptions, result: RunResult, summary: Summary) -> Outcome:
        """Write the page and return what came of the run."""
        from pans.report.summary import write_markdown

        confusion, page = result.tally.confusion, options.page
        if self.flow_run is not None:
            confusion = confusion + self.flow_run.core.matcher.confusion
        if page is not None:
            facts = what_was_run(options, self.profile, self.bundle.name, self.header, summary)
            write_markdown(page, summary, facts, confusion, self.bundle.classes, force=options.force)
        return Outcome(summary, confusion, options.recording, page)


def _same_bundle(path: Path, sha256: str) -> bytes:
    """Return the bundle's file once more, for the recording; DamagedFileError if it is no longer the one that decides."""
    from pans.base.files import read_file

    data = read_file(path)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise DamagedFileError(f"{path}: changed while the run began", remedy="run it again")
    return data


def _prepare_and_run(options: RunOptions, profile: Profile, around: _Around) -> Outcome:
    opening = _in_background(lambda: open_link(options.device))
    if around.monitor.url:
        say(f"pans: live page at {around.monitor.url}")
    try:
        run = _Run(options, profile, around)
        _load_ahead()
    except BaseException as error:
        try:
            opening.result().close()
        except Exception as besides:
            if isinstance(error, PansError):
                error.message += f"\nbesides, the device could not be opened: {besides}"
        raise
    link = opening.result()
    around.ending.callback(link.close)
    with claimed(options) as options:
        if options.trace is not None:
            link = _traced(options, link, options.trace, around)
        return run.recorded(options, link)


def _in_background(call: Callable[[], Link]) -> Future[Link]:
    """Begin `call` in a thread, so that a port can open while the compiled kernels load; the thread does not keep the process."""
    future: Future[Link] = Future()

    def work() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return future


def _load_ahead() -> None:
    """Load what a run needs besides, while its port opens: nothing of it has to be loaded between there and ARM."""
    import numpy as np

    from pans.decide.kernel import unpack_blocks
    from pans.live.loop import run_live as run_live
    from pans.live.watch import Watchers as Watchers
    from pans.protocol.wire import FrameDecoder
    from pans.record.recorder import load_kernels
    from pans.report.live_view import load_drawing

    load_kernels()
    FrameDecoder().feed(b"")
    unpack_blocks(np.zeros(8, np.uint8), np.zeros((0, 4), np.int64), np.zeros(1, np.uint16), np.zeros(1, np.uint8))
    load_drawing()


def _traced(options: RunOptions, link: Link, path: Path, around: _Around) -> Link:
    """Return `link` with a trace; one that could not be written to its end is reported, and ends nothing."""
    from pans.protocol.links import TracedLink

    traced = TracedLink(link, path, options.device, force=options.force)

    def close() -> None:
        traced.close()
        if traced.trouble:
            say(f"pans: {path}: the trace is not whole: {traced.trouble}")

    around.ending.callback(close)
    return traced


def _listeners_of(options: RunOptions, opened: ExitStack) -> tuple[MetricsServer | None, OscSender | None]:
    """Return what serves and sends figures, as far as it is asked for; `opened` closes both."""
    metrics, osc = None, None
    if options.metrics:
        from pans.live.watch import MetricsServer

        metrics = opened.enter_context(closing(MetricsServer(options.metrics)))
    if options.osc:
        from pans.live.watch import OscSender

        osc = opened.enter_context(closing(OscSender(options.osc)))
    return metrics, osc


def _monitor_of(options: RunOptions) -> Monitor:
    from pans.report.live_view import Monitor

    panel = options.display and not state.quiet and sys.stderr.isatty()
    return Monitor(panel=panel, address=options.serve, control=options.serve_control, lines=options.display)


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


def _exit_code(summary: Summary) -> int:
    if summary.ended == INTERRUPTED:
        return EXIT_INTERRUPTED
    if summary.ended in (DISK_NEARLY_FULL, RECORDING_DELETED):
        return EXIT_ALERT
    if summary.link_lost or summary.ended.startswith(REFUSED):
        return EXIT_DEVICE
    off = summary.exposure_timing.get("within") is False
    if summary.too_late or summary.lost or summary.stream["lost_messages"] or summary.contradictions or off:
        return EXIT_TIMING
    return EXIT_FINE if summary.verdict == "PASS" else EXIT_ALERT
