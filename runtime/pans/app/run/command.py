"""`pans run` and `pans demo`: from a bundle and a device URL to decisions, a recording and a summary.

`demo` is `run` with the shipped bundle, the shipped scene and the simulated instrument. The options are fields of `RunOptions`
(live/options.py); one_run.py prepares, runs and reports.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace

from pans.app.command import Command
from pans.app.option_file import add_option_file, prepare_options, write_options
from pans.base import SHIPPED
from pans.base.console import add_options, emit, options_from
from pans.base.errors import EXIT_FINE, UsageError
from pans.base.files import RUNS
from pans.base.numbers import Range
from pans.instrument.profile import load_profile
from pans.live.options import DARK, DAYS, FLOW, RunOptions
from pans.protocol.links import checked_scheme

DEMO_BUNDLE = "fashion-adaptive.pans"
DEMO_SCENE = "fashion200"
DEMO_OBJECTS = 200
# 16667 us are one picture of a 60 Hz screen: the demo runs on any computer, however busy
DEMO_DEFAULTS = {"profile": "dmd-spad", "trials": 5, "deadline_us": 16_667.0}
NOT_OF_DEMO = ("bundle", "device", "record", "decisions", "dose_cap", FLOW, DARK, DAYS)
SEED = Range(0, (1 << 63) - 1, whole=True)


def _configure_run(parser: argparse.ArgumentParser) -> None:
    add_options(parser, RunOptions)
    add_option_file(parser)


def _configure_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=SEED.option, default=1, help="seed of the simulated detector (default 1)")
    pace = "real time in a process of its own, or virtual"
    parser.add_argument("--pace", default="real", choices=("real", "fast"), help=pace)
    add_options(parser, RunOptions, defaults=DEMO_DEFAULTS, omit=NOT_OF_DEMO)


def _run(args: argparse.Namespace) -> int:
    from pans.bundle.sensor import bundle_path

    from .files import input_files
    from .one_run import run_and_report
    from .prepare import check_together

    profile = args.profile or profile_of(args.device)
    options = _options(args, files_read=() if args.config is None else (args.config,), warns_uncalibrated=True)
    options = replace(options, bundle=bundle_path(args.bundle), profile=profile)
    if args.write_config is None:
        return run_and_report(args, options)
    check_together(options)
    load_profile(profile)
    path = write_options(args, input_files(options))
    emit(args, {"config": str(path)}, f"{path}\nnext: pans run --config {shlex.quote(str(path))}")
    return EXIT_FINE


def _demo(args: argparse.Namespace) -> int:
    from .one_run import run_and_report

    device = f"sim:{args.profile}?scene={DEMO_SCENE}&seed={args.seed}&pace={args.pace}"
    decisions = 0 if args.seconds else DEMO_OBJECTS * args.trials
    shipped = {"bundle": SHIPPED / DEMO_BUNDLE, "device": device, "decisions": decisions}
    return run_and_report(args, _options(args, **shipped, may_be_busy=True))


def _options(args: argparse.Namespace, **others: object) -> RunOptions:
    out_root = None if args.out or getattr(args, "record", None) else RUNS
    return options_from(args, RunOptions, out_root=out_root, command=shlex.join(["pans", *sys.argv[1:]]), **others)


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
    examples=("pans demo", "pans demo --pace fast --seconds 2 --json"),
)
