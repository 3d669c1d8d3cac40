"""`pans run` and `pans demo`: from a bundle and a device URL to decisions, a recording and a summary.

Owns the commands' arguments, the files they leave and their exit codes; the run itself is loop.py's. `demo` is `run` with the
shipped bundle, the shipped scene and the simulated instrument at real pace.
"""

from __future__ import annotations

import argparse
import gc
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pans.runtime import SHIPPED
from pans.runtime.cli import EXIT_FINE, Command, add_force, emit
from pans.runtime.decide.names import backend_names
from pans.runtime.errors import UsageError, as_usage_error
from pans.runtime.instrument.profile import load_profile
from pans.runtime.link.base import checked_scheme
from pans.runtime.live.config import AUTO, TURNS
from pans.runtime.operate.option_file import add_option_file, prepare_options, write_options
from pans.runtime.run_folder import RUNS
from pans.runtime.timing.cpu import check_core

from .carry_out import carry_out
from .job import Job
from .options import (
    RANGES,
    add_continuous_options,
    add_dark_options,
    add_flow_options,
    add_serve_options,
    add_walk_options,
    continuous_of,
    dark_of,
    flow_of,
    serve_of,
)
from .run_files import input_files

DEMO_BUNDLE = "fashion-adaptive.pans"
DEMO_PROFILE = "dmd-spad"
DEMO_SCENE = "fashion200"
DEMO_OBJECTS = 200
DEMO_TRIALS = 5
DEMO_DEADLINE_US = 16_667.0  # one picture of a 60 Hz screen: the demo runs on any computer, however busy


def _configure_common(parser: argparse.ArgumentParser, trials: int) -> None:
    parser.add_argument(
        "--shots", type=RANGES["shots"].option, default=1, metavar="K", help="shots per decision (default 1)"
    )
    parser.add_argument(
        "--trials",
        type=RANGES["trials"].option,
        default=trials,
        metavar="N",
        help=f"decisions per object (default {trials})",
    )
    parser.add_argument("--seconds", type=RANGES["seconds"].option, default=0.0, help="stop after this time")
    parser.add_argument(
        "--deadline-us",
        type=RANGES["deadline_us"].option,
        default=0.0,
        help="decision deadline (default: the profile's; of the demo 16667)",
    )
    parser.add_argument(
        "--order", default="auto", choices=("auto", "pattern-major", "shot-major"), help="pattern order"
    )
    parser.add_argument(
        "--dark-slots", type=RANGES["dark_slots"].option, default=1, help="dark displays per cycle (default 1)"
    )
    add_walk_options(parser)
    parser.add_argument("--backend", default="auto", choices=backend_names(), help="decision back end")
    parser.add_argument("--no-realtime", action="store_true", help="do not ask for SCHED_FIFO and locked memory")
    parser.add_argument(
        "--turn",
        default=AUTO,
        choices=TURNS,
        help="the loop's turn: one compiled call, or Python's, which decides the same (default: compiled where it can be)",
    )
    parser.add_argument("--core", type=int, metavar="N", help="pin to core N and busy-wait; uses 100 %% of that core")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for the recording and the summary (default: a new one in {RUNS})",
    )
    add_force(parser)
    parser.add_argument(
        "--reconnect-s",
        type=RANGES["reconnect_s"].option,
        default=10.0,
        help="how long to look for a lost device (default 10, 0: not at all)",
    )
    add_serve_options(parser)
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
    parser.add_argument(
        "--decisions", type=RANGES["decisions"].option, default=0, help="stop after this many decisions"
    )
    parser.add_argument(
        "--dose-cap",
        type=RANGES["dose_cap"].option,
        metavar="N",
        help="no object receives more than N photoelectrons of illumination: walks end in time, fixed patterns must all fit",
    )
    _configure_common(parser, trials=1)
    add_flow_options(parser)
    add_dark_options(parser)
    add_continuous_options(parser)
    add_option_file(parser)


def _configure_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seed", type=RANGES["seed"].option, default=1, help="seed of the simulated detector (default 1)"
    )
    parser.add_argument(
        "--pace", default="real", choices=("real", "fast"), help="real time in a process of its own, or virtual"
    )
    parser.add_argument("--profile", default=DEMO_PROFILE, help=f"hardware profile (default {DEMO_PROFILE})")
    _configure_common(parser, trials=DEMO_TRIALS)
    parser.set_defaults(deadline_us=DEMO_DEADLINE_US)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Leave out the search for garbage while all that a run needs is loaded, a sixth of that time; the run's end switches it on again."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@_uncollected()
def _run(args: argparse.Namespace) -> int:
    from pans.runtime.bundle.model import bundle_path

    profile = args.profile or profile_of(args.device)
    job = _job(args, bundle_path(args.bundle), args.device, profile, args.decisions, args.record)
    if args.write_config is None:
        return carry_out(args, job)
    path = write_options(args, input_files(job))
    emit(args, {"config": str(path)}, f"{path}\nnext: pans run --config {shlex.quote(str(path))}")
    return EXIT_FINE


@_uncollected()
def _demo(args: argparse.Namespace) -> int:
    device = f"sim:{args.profile}?scene={DEMO_SCENE}&seed={args.seed}&pace={args.pace}"
    decisions = 0 if args.seconds else DEMO_OBJECTS * args.trials
    return carry_out(args, _job(args, SHIPPED / DEMO_BUNDLE, device, args.profile, decisions, None))


def _job(args: argparse.Namespace, bundle: Path, device: str, profile: str, decisions: int, record: Path | None) -> Job:
    with as_usage_error():
        for name, allowed in RANGES.items():
            if getattr(args, name, None) is not None:
                allowed.checked(getattr(args, name), f"--{name.replace('_', '-')}")
    check_core(args.core)
    loaded, flow = load_profile(profile), flow_of(args)
    if flow is not None and (decisions or args.trials != 1):
        raise UsageError(
            "a flow has as many decisions as objects pass", remedy="--seconds, in place of --decisions and --trials"
        )
    return Job(
        bundle_path=bundle,
        device=device,
        profile=loaded,
        out=args.out,
        out_root=None if args.out or record else RUNS,
        run_name=bundle.stem,
        force=args.force,
        inputs=tuple(
            Path(name)
            for name in (profile, *(getattr(args, other, None) for other in ("flow", "act_profile", "config")))
            if name
        ),
        shots=args.shots,
        trials=args.trials,
        decisions=decisions,
        seconds=args.seconds,
        deadline_us=args.deadline_us or loaded.timing.decision_deadline_us,
        order=args.order,
        dark_slots=args.dark_slots,
        backend=args.backend,
        drive=args.drive,
        confidence=args.confidence,
        dose_cap=getattr(args, "dose_cap", None) or 0.0,
        realtime=not args.no_realtime,
        core=args.core,
        turn=args.turn,
        record=record,
        reconnect_s=args.reconnect_s,
        trace=args.trace,
        command=shlex.join(["pans", *sys.argv[1:]]),
        flow=flow,
        act=getattr(args, "act", "device"),
        act_profile=load_profile(args.act_profile) if getattr(args, "act_profile", None) else loaded,
        dark=dark_of(args),
        continuous=continuous_of(args),
        seed=getattr(args, "seed", None),
        serve=serve_of(args),
    )


def profile_of(device: str) -> str:
    """A `sim:PROFILE?...` URL names its profile; a real instrument's must be given."""
    if device.startswith("sim:"):
        return device[4:].partition("?")[0]
    checked_scheme(device)
    raise UsageError(f"no profile for {device}", remedy="give the instrument's hardware profile with --profile")


RUN = Command(
    "decide on a device's clicks with a trained bundle, live",
    _configure_run,
    _run,
    prepare=prepare_options,
    examples=(
        "pans run parts.pans --device serial:/dev/ttyACM0 --profile my-lab.toml --seconds 60",
        "pans run fashion10 --device sim:oled-qcmos?pace=fast --decisions 200",
    ),
)
DEMO = Command(
    "the main job with nothing but the package: a simulated instrument, real images, timed decisions",
    _configure_demo,
    _demo,
    examples=(
        "pans demo",
        "pans demo --pace fast --seconds 2 --json",
    ),
)
