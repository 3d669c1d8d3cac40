"""One run from its options to its files: check, prepare, open, run, report. `run_once` is the page to read.

What is prepared (prepare.py: bundle, plan, core, header) is made while the port opens. The loop is live/loop.py's.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.base.console import emit, html_card, say, state, warn
from pans.base.errors import (
    EXIT_ALERT,
    EXIT_DEVICE,
    EXIT_FINE,
    EXIT_INTERRUPTED,
    EXIT_TIMING,
    DamagedFileError,
    PansError,
)
from pans.base.machine import lacking
from pans.base.numbers import Shown, shown
from pans.instrument.profile import Profile, load_profile
from pans.live.options import RunOptions
from pans.live.stop import DISK_NEARLY_FULL, INTERRUPTED, RECORDING_DELETED, REFUSED, Stop, stop_signals
from pans.protocol.links import open_link

from .files import check_run_files, claimed, gone_if_refused, part_limits, what_was_run
from .prepare import Prepared, check_together, prepare

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pans.decide import Output
    from pans.live.loop import Observers, RunResult, Status
    from pans.live.watch import MetricsServer, OscSender, Watchdog, Watchers
    from pans.protocol.links import Link
    from pans.record.recorder import Recorder
    from pans.report.live_view import Monitor
    from pans.report.summary import Summary


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
    options, profile = _checked(options, profile)
    with (
        _asked_to_end(options, besides, ends_process=ends_process) as (stop, watchdog),
        ExitStack() as listening,  # ports first: a busy one is refused before anything is compiled or opened
        ExitStack() as ending,  # the link, when the outcome has been told
    ):
        metrics, osc = _listeners_of(options, listening)
        with _monitor_of(options) as monitor:
            opening = _in_background(lambda: open_link(options.device))
            if monitor.url:
                say(f"pans: live page at {monitor.url}")
            prepared = _prepared_meanwhile(options, profile, opening)
            from pans.live.loop import Recovery, running  # loaded by now, while the port opened
            from pans.live.watch import Watchers

            link = opening.result()
            ending.callback(link.close)
            with claimed(options) as options, ExitStack() as files:
                if options.trace is not None:
                    link = _traced(options, link, options.trace, ending)
                recorder = _recorder_of(options, prepared, link, files)
                monitor.begin(_facts_of(options, prepared, link), stop)
                with Watchers(options, recorder, watchdog, stop, metrics) as seen:
                    observers = _observers(options, prepared, seen, monitor, osc, besides, stop)
                    recovery = Recovery.of(link, options.device, options.reconnect_s) if options.reconnect_s else None
                    job, core = prepared.job, prepared.core
                    result = ending.enter_context(running(link, job, core, recorder, recovery, observers))
                    monitor.close_notes()
                    options, summary = _summary(options, prepared, result, recorder)
                    seen.conclude(summary.verdict, summary.faults)
                if recorder is not None:
                    summary = replace(summary, decisions_sha256=recorder.close(summary.as_json()))
            done = _outcome(options, prepared, result, summary)
        report(done)
        return done


def _checked(options: RunOptions, profile: Profile | None) -> tuple[RunOptions, Profile]:
    """Return options that make sense together, and the profile, with the deadline that holds."""
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
    return options, profile


@contextmanager
def _asked_to_end(
    options: RunOptions, besides: Observers | None, *, ends_process: bool
) -> Iterator[tuple[Stop, Watchdog | None]]:
    """Who ends the run: a signal, somebody else's thread, or the watchdog, which takes the process with it."""
    continuous, watchdog = not (options.seconds or options.decisions), None
    with (
        stop_signals(continuous=continuous, stop=None if besides is None else besides.stop) as stop,
        ExitStack() as watched,
    ):
        if ends_process:
            from pans.live.watch import Watchdog

            watchdog = watched.enter_context(Watchdog(continuous=continuous))
        try:
            yield stop, watchdog
        except PansError:
            raise
        except Exception as error:
            if stop.raised:  # a library that was being loaded makes an ImportError of the interrupt
                raise KeyboardInterrupt(stop.word) from error
            raise


def _prepared_meanwhile(options: RunOptions, profile: Profile, opening: Future[Link]) -> Prepared:
    """Prepare the run while its port opens; an error closes the port."""
    try:
        prepared = prepare(options, profile)
        _load_ahead()
    except BaseException as error:
        try:
            opening.result().close()
        except Exception as besides:
            if isinstance(error, PansError):
                error.message += f"\nbesides, the device could not be opened: {besides}"
        raise
    return prepared


def _recorder_of(options: RunOptions, prepared: Prepared, link: Link, opened: ExitStack) -> Recorder | None:
    """Return what records, if `options` ask for it; they name the folder that the run was given."""
    from pans.record.recorder import Recorder

    if options.recording is None:
        return None
    opened.enter_context(gone_if_refused(options))
    header = prepared.header | {"simulated": link.simulated, "virtual_time": link.virtual}
    # the bundle's bytes are not held by a name: they may have 64 MiB, and the run begins here
    return opened.enter_context(
        Recorder(
            options.recording,
            header,
            bundle=_same_bundle(options.bundle, prepared.header["bundle_sha256"]),
            overwrite=options.force,
            limits=part_limits(options),
        )
    )


def _facts_of(options: RunOptions, prepared: Prepared, link: Link) -> dict[str, Any]:
    """Return what the live view is told before the run."""
    bundle, profile = prepared.bundle, prepared.profile
    return {
        "kind": "begin",
        "classes": list(bundle.classes),
        "encoder": bundle.encoder,
        "title": f"{bundle.name} on {profile.name}",
        "simulated": link.simulated,
        "expected": prepared.expected_decisions,
        "deadline_us": options.deadline_us,
        "late_allowed": options.late_allowed,
        "exposure_tolerance_us": profile.exposure_tolerance_us(prepared.job.plan.exposure_us),
        "trials": options.trials,
        "illumination": prepared.illumination,
        "clicks_stated": prepared.dark.light.stated,
    }


def _observers(
    options: RunOptions,
    prepared: Prepared,
    seen: Watchers,
    monitor: Monitor,
    osc: OscSender | None,
    besides: Observers | None,
    stop: Stop,
) -> Observers:
    """Join who observes the run: the guards of dark counts and light, state file, live view, neighbours."""
    from pans.decide.kernel import BATCH_NS
    from pans.live.loop import Observers, scene_words

    def before_arming(run: Status) -> None:
        prepared.dark.check_device(run)
        if prepared.registration is not None:
            serial = prepared.dark.serial_of(run)
            prepared.registration.registered.check_made_for(prepared.profile, serial)
        if words := scene_words(run.session.facts, options.device):
            say(f"pans: {words}")
        if not run.session.link.virtual and (missing := lacking()):
            say(f"pans: {sys.platform} has no {', no '.join(missing)}; decisions that are late are counted")
        seen.prepared(run)
        monitor.prepared(run, prepared.bundle, seen.look)
        if besides is not None and besides.prepared is not None:
            besides.prepared(run)
        if prepared.flow_run is not None:
            prepared.flow_run.prepared(run)

    def look(run: Status, output: Output) -> None:
        prepared.dark.look(run, output)
        seen.note_news(run)
        monitor.watch(run, output)
        if osc is not None:
            osc.watch(run, output)
        if besides is not None and besides.watch is not None:
            besides.watch(run, output)

    # a neighbour that hears of each decision hears of it at once
    at_once = osc is not None or (besides is not None and besides.watch is not None)
    return Observers(look, before_arming, stop, acts=False, gather_ns=0 if at_once else BATCH_NS)


def _summary(
    options: RunOptions, prepared: Prepared, result: RunResult, recorder: Recorder | None
) -> tuple[RunOptions, Summary]:
    """Return the summary; and the options with what is left of a recording that was deleted during the run."""
    from pans.report.summary import summarise, walk_figures

    plan, tally, of_flow = prepared.job.plan, result.tally, prepared.flow_run
    walks = walk_figures(result, plan, prepared.bundle, prepared.profile.name, options.confidence)
    shown = None if walks is None else walks.illumination_mean
    clicks = lit = 0  # exposures with light that may each have given a click; unknown of objects that pass by
    if of_flow is None:
        fixed = tally.decisions * tally.shots * plan.n_patterns if plan.automaton is None else 0
        clicks, lit = tally.of["decisions"].clicks, fixed or tally.exposures * plan.channels_at_once
    summary = summarise(
        result,
        illumination=prepared.illumination if shown is None else shown,
        expected_decisions=prepared.expected_decisions,
        flow=None if of_flow is None else of_flow.figures(),
        dark=prepared.dark.figures(result.dark, clicks, lit, saturates=plan.largest == 1),
        walks=walks,
        registration=None if prepared.registration is None else prepared.registration.facts(),
        late_allowed=options.late_allowed,
        may_be_busy=options.may_be_busy,
    )
    if recorder is None or (kept := recorder.keep_deleted()) is None:
        return options, summary
    fault = f"{RECORDING_DELETED}: what could be kept of it is now {kept}"
    warn(fault)
    options = replace(options, out=kept.parent, record=kept, rotate_mb=None)
    return options, replace(summary, verdict="FAIL", faults=[*summary.faults, fault])


def _outcome(options: RunOptions, prepared: Prepared, result: RunResult, summary: Summary) -> Outcome:
    """Write the page and return what came of the run."""
    from pans.report.summary import write_markdown

    confusion, page, bundle = result.tally.confusion, options.page, prepared.bundle
    if prepared.flow_run is not None:
        confusion = confusion + prepared.flow_run.core.matcher.confusion
    if page is not None:
        facts = what_was_run(options, prepared.profile, bundle.name, prepared.header, summary)
        write_markdown(page, summary, facts, confusion, bundle.classes, force=options.force)
    return Outcome(summary, confusion, options.recording, page)


def _same_bundle(path: Path, sha256: str) -> bytes:
    """Return the bundle's file once more, for the recording; DamagedFileError if it is no longer the one that decides."""
    from pans.base.files import read_file

    data = read_file(path)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise DamagedFileError(f"{path}: changed while the run began", remedy="run it again")
    return data


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


def _traced(options: RunOptions, link: Link, path: Path, ending: ExitStack) -> Link:
    """Return `link` with a trace; one that could not be written to its end is reported, and ends nothing."""
    from pans.protocol.links import TracedLink

    traced = TracedLink(link, path, options.device, force=options.force)

    def close() -> None:
        traced.close()
        if traced.trouble:
            say(f"pans: {path}: the trace is not whole: {traced.trouble}")

    ending.callback(close)
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
