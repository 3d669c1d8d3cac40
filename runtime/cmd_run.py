"""`pans run` and `pans demo`: from a bundle and a device URL to decisions, a recording and a summary.

Owns the commands' arguments, the files they leave and their exit codes; the run itself is loop.py's. `demo` is `run` with the
shipped bundle, the shipped scene and the simulated instrument at real pace.
"""

from __future__ import annotations

import argparse
import importlib.resources
import shlex
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from .cli import EXIT_ALERT, EXIT_DEVICE, EXIT_FINE, EXIT_INTERRUPTED, EXIT_TIMING, Command, emit, say
from .continuous import Continuous, add_continuous_options, continuous_of
from .errors import UsageError
from .flow_settings import FlowSettings
from .link import open_link
from .profile import Profile, load_profile
from .run_dark import DarkRun
from .run_dark import add_options as add_dark_options
from .run_flow import add_options, settings_of
from .run_words import closing_words, recording_header, what_was_run
from .stopping import ASKED_TO_STOP, INTERRUPTED, Stop, stop_signals

if TYPE_CHECKING:
    pass

T = TypeVar("T")
BACKENDS = (
    "auto",
    "table",
    "count-table",
    "sparse",
    "onnx",
    "int8",
    "int8-onnx",
    "float64",
)  # decide.BACKENDS, unloaded
DEMO_BUNDLE = "fashion10.pans"
DEMO_PROFILE = "oled-qcmos"
DEMO_SCENE = "fashion200"
DEMO_OBJECTS = 200
DEMO_TRIALS = 5


@dataclass(frozen=True, slots=True)
class Job:
    """What one call of the command is to do, resolved."""

    bundle_path: Path
    device: str
    profile: Profile
    out: Path
    shots: int
    trials: int
    decisions: int
    seconds: float
    deadline_us: float
    order: str
    dark_slots: int
    backend: str
    realtime: bool
    record: Path | None
    reconnect_s: float
    trace: Path | None
    command: str
    flow: FlowSettings | None
    act: str
    continuous: Continuous


def _configure_common(parser: argparse.ArgumentParser, trials: int) -> None:
    parser.add_argument("--shots", type=int, default=1, metavar="K", help="shots per decision (default 1)")
    parser.add_argument(
        "--trials", type=int, default=trials, metavar="N", help=f"decisions per object (default {trials})"
    )
    parser.add_argument("--seconds", type=float, default=0.0, help="stop after this time")
    parser.add_argument("--deadline-us", type=float, default=0.0, help="decision deadline (default: the profile's)")
    parser.add_argument(
        "--order", default="auto", choices=("auto", "pattern-major", "shot-major"), help="pattern order"
    )
    parser.add_argument("--dark-slots", type=int, default=1, help="dark displays per cycle (default 1)")
    parser.add_argument("--backend", default="auto", choices=BACKENDS, help="decision back end")
    parser.add_argument("--no-realtime", action="store_true", help="do not ask for SCHED_FIFO and locked memory")
    parser.add_argument("--out", type=Path, help="folder for the recording and the summary")
    parser.add_argument(
        "--reconnect-s", type=float, default=10.0, help="how long to look for a lost device (default 10, 0: not at all)"
    )
    parser.add_argument(
        "--trace", type=Path, metavar="FILE", help="write all bytes of both directions as hex, with times"
    )


def _configure_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", type=Path, help="a trained bundle (.pans)")
    parser.add_argument(
        "--device", required=True, help="device URL, for example serial:/dev/ttyACM0 or sim:ideal?pace=fast"
    )
    parser.add_argument("--profile", help="hardware profile: a shipped name or a TOML file (default: the sim: URL's)")
    parser.add_argument("--record", type=Path, help="recording to write (default: run.pansrec in --out)")
    parser.add_argument("--decisions", type=int, default=0, help="stop after this many decisions")
    _configure_common(parser, trials=1)
    add_options(parser)
    add_dark_options(parser)
    add_continuous_options(parser)


def _configure_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulated detector (default 1)")
    parser.add_argument(
        "--pace", default="real", choices=("real", "fast"), help="real time in a process of its own, or virtual"
    )
    parser.add_argument("--profile", default=DEMO_PROFILE, help=f"hardware profile (default {DEMO_PROFILE})")
    _configure_common(parser, trials=DEMO_TRIALS)


def _run(args: argparse.Namespace) -> int:
    profile = args.profile or profile_of(args.device)
    out = args.out or (args.record.parent if args.record else Path("pans-run"))
    return _execute(args, _job(args, args.bundle, args.device, profile, out, args.decisions, args.record))


def _demo(args: argparse.Namespace) -> int:
    device = f"sim:{args.profile}?scene={DEMO_SCENE}&seed={args.seed}&pace={args.pace}"
    bundle = Path(str(importlib.resources.files("pans.runtime") / "shipped" / DEMO_BUNDLE))
    decisions = 0 if args.seconds else DEMO_OBJECTS * args.trials
    return _execute(args, _job(args, bundle, device, args.profile, args.out or Path("pans-demo"), decisions, None))


def _job(
    args: argparse.Namespace, bundle: Path, device: str, profile: str, out: Path, decisions: int, record: Path | None
) -> Job:
    for name in ("shots", "trials"):
        if getattr(args, name) < 1:
            raise UsageError(f"--{name} must be at least 1, found {getattr(args, name)}")
    if min(args.seconds, decisions, args.deadline_us, args.dark_slots, args.reconnect_s) < 0:
        raise UsageError("--seconds, --decisions, --deadline-us, --dark-slots and --reconnect-s must not be negative")
    loaded, flow = load_profile(profile), settings_of(args)
    if flow is not None and (decisions or args.trials != 1):
        raise UsageError(
            "a flow has as many decisions as objects pass", remedy="--seconds, in place of --decisions and --trials"
        )
    return Job(
        bundle_path=bundle,
        device=device,
        profile=loaded,
        out=out,
        shots=args.shots,
        trials=args.trials,
        decisions=decisions,
        seconds=args.seconds,
        deadline_us=args.deadline_us or loaded.timing.decision_deadline_us,
        order=args.order,
        dark_slots=args.dark_slots,
        backend=args.backend,
        realtime=not args.no_realtime,
        record=record,
        reconnect_s=args.reconnect_s,
        trace=args.trace,
        command=shlex.join(["pans", *sys.argv[1:]]),
        flow=flow,
        act=getattr(args, "act", "device"),
        continuous=continuous_of(args),
    )


def profile_of(device: str) -> str:
    """A `sim:PROFILE?...` URL names its profile; a real instrument's must be given."""
    if device.startswith("sim:"):
        return device[4:].partition("?")[0]
    raise UsageError(f"no profile for {device}", remedy="give the instrument's hardware profile with --profile")


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


def _execute(args: argparse.Namespace, job: Job) -> int:
    with stop_signals(continuous=not (job.seconds or job.decisions)) as stop:
        return _carry_out(args, job, stop)


def _carry_out(args: argparse.Namespace, job: Job, stop: Stop) -> int:
    started_ns = process_start_ns()
    opening = _Background(lambda: open_link(job.device))
    try:
        from .actuate import open_actuator
        from .bundle import load_bundle
        from .container import read_file
        from .continuous import Attendants, open_recorder
        from .core import Core, Output
        from .decide import make_decider
        from .live import live_view
        from .loop import LiveCore, LiveRun, Onlookers, RunConfig, run_live
        from .plan import build_plan
        from .recovery import Recovery
        from .report import summarise, write_markdown
        from .run_flow import FlowRun, core_of
        from .trace import TracedLink

        bundle, bundle_sha256 = load_bundle(job.bundle_path)
        decider = make_decider(bundle, shots=job.shots, backend=job.backend)
        honest = DarkRun.of(args, job.profile)
        n_objects, passing = -(-job.decisions // job.trials), None
        core: LiveCore
        if job.flow is not None:
            plan, flow_core, n_cycles = core_of(honest.profile, bundle, decider, job.flow, job.shots, job.seconds)
            flow_core.guard = honest.guard(plan, bundle, job.shots, flow=True)
            core, passing = flow_core, FlowRun(flow_core, open_actuator(job.act))
        else:
            plan = build_plan(
                honest.profile,
                bundle,
                shots_per_object=job.shots * job.trials,
                dark_slots_per_cycle=job.dark_slots,
                order=job.order,
            )
            n_cycles = n_objects * plan.cycles_per_object
            core = Core(plan, decider, job.shots, n_cycles, honest.guard(plan, bundle, job.shots))
        config = RunConfig(
            job.shots,
            n_cycles,
            0.0 if passing is not None else job.seconds,
            job.deadline_us,
            job.profile.timing.lease_ms,
            job.realtime,
            started_ns,
        )
        job.out.mkdir(parents=True, exist_ok=True)
        recording = job.record or job.out / "run.pansrec"
        expected = n_objects * job.trials
        header = recording_header(job, bundle_sha256, decider, n_objects)
        header["config"]["dark"] = honest.header()
        if passing is not None:
            header["config"]["flow"] = passing.header()
    except BaseException:
        _close_quietly(opening)
        raise
    for warning in honest.warnings:
        say(f"pans: {warning}")
    link = opening.result()
    if job.trace is not None:
        link = TracedLink(link, job.trace, job.device)
    recovery = Recovery.of(link, job.device, job.reconnect_s) if job.reconnect_s else None
    with open_recorder(recording, header, read_file(job.bundle_path), job.continuous.limits) as recorder:
        title, seen = f"{bundle.name} on {job.profile.name}", Attendants(job.continuous, recorder)
        with seen, live_view(title, bundle.classes, expected, link.simulated) as watch:

            def prepared(run: LiveRun) -> None:
                honest.check_device(run)
                seen.prepared(run)
                if passing is not None:
                    passing.prepared(run)

            def look(run: LiveRun, output: Output) -> None:
                honest.look(run, output)
                watch(run, output)

            onlookers = Onlookers(look, prepared, stop)
            result = run_live(link, honest.profile, bundle, plan, core, config, recorder, recovery, onlookers)
        frames = job.shots * (1 if job.flow is None else job.flow.pool)
        summary = summarise(
            result,
            illumination=bundle.illumination() * frames,
            expected_decisions=expected,
            flow=None if passing is None else passing.summary(),
        )
        honest.add_to(summary)
        if passing is not None:
            result.tally.confusion += passing.core.matcher.confusion
        result.decisions_sha256 = summary["decisions_sha256"] = recorder.close(summary)
    page = job.out / "summary.md"
    facts = what_was_run(job, bundle.name, bundle_sha256, decider.name, recording, summary)
    write_markdown(page, summary, facts, result.tally, bundle.classes)
    payload = {
        **summary,
        "recording": str(recording),
        "report": str(page),
        "shots": job.shots,
        "seed": getattr(args, "seed", None),
    }
    emit(args, payload, closing_words(payload))
    return _exit_code(summary)


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


def _close_quietly(opening: _Background[Any]) -> None:
    try:
        opening.result().close()
    except Exception as error:
        say(f"pans: besides, the device could not be opened: {error}")


def _exit_code(summary: dict[str, Any]) -> int:
    if summary["ended"] == ASKED_TO_STOP:
        return EXIT_FINE  # what went wrong on the way stands in the summary
    if summary["ended"] == INTERRUPTED:
        return EXIT_INTERRUPTED
    if summary["link_lost"]:
        return EXIT_DEVICE
    if summary["late"] or summary["lost"]:
        return EXIT_TIMING
    return EXIT_FINE if summary["verdict"] == "PASS" else EXIT_ALERT


RUN = Command("decide on a device's clicks with a trained bundle, live", _configure_run, _run)
DEMO = Command(
    "the main job with nothing but the package: a simulated instrument, real images, timed decisions",
    _configure_demo,
    _demo,
)
