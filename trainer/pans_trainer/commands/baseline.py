"""`pans baseline direct|compressive|e2e|fsi|hadamard`: the alternatives to PANS, at equal light. All figures are SIMULATED."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pans.app.command import Command
from pans.base.console import add_options, emit, options_from, say
from pans.base.errors import EXIT_FINE, EXIT_INTERRUPTED, UsageError, as_usage_error
from pans.base.numbers import Range
from pans_trainer.options import LIGHT, METHODS, BaselineOptions

from .arguments import add_data_dir, add_threads, displayed_parts, torch_with

if TYPE_CHECKING:
    from pans_trainer.tasks.registry import Task

DEFAULT_PHOTONS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0)
OBJECTS = Range(1, 1 << 30, whole=True)


def _configure(parser: argparse.ArgumentParser) -> None:
    add_options(parser, BaselineOptions, defaults={"method": None})
    parser.add_argument("--task", required=True, metavar="T", help="as of `pans train`")
    words = "photoelectrons detected per decision, averaged over the test objects (default: 5 10 17 30 100 300)"
    parser.add_argument("--photons", type=LIGHT.option, nargs="+", default=[], metavar="N", help=words)
    words = "photoelectrons sent per decision, instead or besides: what a clear object would give"
    parser.add_argument("--illumination", type=LIGHT.option, nargs="+", default=[], metavar="L", help=words)
    words = "only the first N test objects (default: all)"
    parser.add_argument("--objects", type=OBJECTS.option, metavar="N", help=words)
    words = "only the first N training objects, 10 or more"
    parser.add_argument("--train-objects", type=Range(10, 1 << 30, whole=True).option, metavar="N", help=words)
    add_threads(parser)
    add_data_dir(parser)


def _run(args: argparse.Namespace) -> int:
    from pans_trainer.baselines.common import Light
    from pans_trainer.baselines.rows import baseline_rows
    from pans_trainer.tasks.registry import load_task

    options = _options(args)
    if not args.photons + args.illumination:
        args.photons = list(DEFAULT_PHOTONS)
    levels = [Light(of, amount) for of in ("photons", "illumination") for amount in getattr(args, of)]
    if not (args.paradigm == "direct" and args.method == "bayes"):
        torch_with(args.threads, "a trained baseline")
    whole = load_task(args.task, args.data_dir)
    task = replace(whole, train=whole.train.first(args.train_objects), test=whole.test.first(args.objects))
    rows: list[dict[str, Any]] = []
    code = EXIT_FINE
    try:
        with as_usage_error(), displayed_parts() as report:
            for row in baseline_rows(task, options, levels, report):
                of = "illumination" if row["photons_asked"] is None else "photons"
                first, words = row["first_200"], f"{row[f'{of}_asked']:>9g} {of}: {100 * row['accuracy_mean']:6.2f} %  "
                say(f"{words}(first {first['objects']}: {100 * first['accuracy_mean']:6.2f} %)  {row['seconds']:.0f} s")
                rows.append(row)
    except KeyboardInterrupt:
        say("interrupted; the levels above are whole")
        code = EXIT_INTERRUPTED
    if rows:
        shared = {"task": task.name, "paradigm": args.paradigm, "method": args.method, "seed": args.seed}
        payload = rows[0] | shared | {"rows": rows, "interrupted": code != EXIT_FINE, "simulated": True}
        emit(args, payload, _table(task, args, rows))
    elif code == EXIT_FINE:
        what = f"--photons {args.photons} --illumination {args.illumination}: none can be reached by stopping"
        raise UsageError(what, remedy="ask for fewer photons, from 1 on")
    return code


def _options(args: argparse.Namespace) -> BaselineOptions:
    methods = METHODS[args.paradigm]
    args.method = args.method or methods[0]
    if args.method not in methods:
        raise UsageError(f"--method is {args.method!r}, allowed with {args.paradigm}: {', '.join(methods)}")
    if args.information and (args.method != "bayes" or args.detector != "counting" or args.brightness != "source"):
        what = "--information is allowed with --method bayes, --detector counting and --brightness source only"
        raise UsageError(what)
    return options_from(args, BaselineOptions)


def _table(task: Task, args: argparse.Namespace, rows: list[dict[str, Any]]) -> str:
    head = (
        f"SIMULATED {args.paradigm}, {args.method}, {args.detector} detector, {task.name}: {rows[0]['objects']} objects, "
        f"{rows[0]['trials']} trials, {rows[0]['train_objects']} training objects\n"
        "   photons    clicks  illumination  accuracy %  spread(trials)  error(objects)  first 200 %"
        "         bits   per photon  per unit sent"
    )
    lines = []
    for row in rows:
        known = [row[key] for key in ("bits", "bits_per_photon", "bits_per_illumination")]
        bits = "".join(f"{'-' if one is None else f'{one:.4f}':>13s}" for one in known)
        spread = f"{100 * row['accuracy_std']:.2f}" if row["trials"] > 1 else "one trial"
        lines.append(
            f"{row['photons_mean']:10.2f}{row['clicks_mean']:10.2f}{row['illumination']:14.1f}"
            f"{100 * row['accuracy_mean']:12.2f}{spread:>16}{100 * row['accuracy_se_objects']:16.2f}"
            f"{100 * row['first_200']['accuracy_mean']:13.2f}{bits}"
        )
    return "\n".join([head, *lines])


BASELINE = Command(
    "direct imaging, compressive sensing, conventional end-to-end, trained masks and Hadamard pairs, at equal photons",
    _configure,
    _run,
    examples=("pans baseline direct --task parts --photons 5 17 100",),
)
