"""`pans baseline direct|compressive|e2e|fsi|hadamard`: the alternatives to PANS, at equal photons.

Owns the arguments and how the answer looks; the rows come from the package baselines. All figures are SIMULATED.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, emit, say
from pans.runtime.errors import UsageError
from pans.trainer.baselines.options import METHODS, BaselineOptions

from .arguments import add_data_dir, add_threads, torch_with, usage_errors

if TYPE_CHECKING:
    from pans.trainer.baselines.common import Report
    from pans.trainer.tasks.registry import Task

DARK_MAX = 1e9  # as many as light; beyond, Poisson numbers cannot be drawn
DEFAULT_PHOTONS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0)


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("paradigm", choices=tuple(METHODS), help="how the object is measured")
    parser.add_argument("--task", required=True, metavar="T", help="as of `pans train`")
    parser.add_argument(
        "--photons",
        type=float,
        nargs="+",
        default=list(DEFAULT_PHOTONS),
        metavar="N",
        help="photoelectrons per decision, averaged over the test objects (default: 5 10 17 30 100 300)",
    )
    parser.add_argument("--method", metavar="M", help="; ".join(f"{k}: {', '.join(v)}" for k, v in METHODS.items()))
    parser.add_argument(
        "--features", type=int, default=32, metavar="D", help="patterns, masks or pairs, unless direct (default 32)"
    )
    parser.add_argument("--patterns", choices=("binary", "hadamard"), default="binary", help="of compressive sensing")
    parser.add_argument(
        "--detector", choices=("counting", "binary"), default="counting", help="Poisson counts, or one click at most"
    )
    parser.add_argument(
        "--brightness",
        choices=("source", "object"),
        default="source",
        help="one source for all objects (default), or every object gives N photons",
    )
    parser.add_argument("--floor", type=float, metavar="F", help="of bayes: least transmission (default: chosen)")
    parser.add_argument("--dark", type=float, default=0.0, metavar="R", help="dark photoelectrons per readout")
    parser.add_argument("--bits", type=int, default=4, metavar="B", help="of qat: bits of a detected value (default 4)")
    parser.add_argument(
        "--epochs",
        type=int,
        metavar="E",
        help="of a network (default: 5 CNN, 10 MLP and pairs, 15 end-to-end and masks)",
    )
    parser.add_argument("--objects", type=int, metavar="N", help="only the first N test objects (default: all)")
    parser.add_argument("--train-objects", type=int, metavar="N", help="only the first N training objects")
    parser.add_argument(
        "--trials", type=int, metavar="N", help="readouts per object (default: bayes 2, stopping 1, others 10)"
    )
    parser.add_argument(
        "--information",
        action="store_true",
        help="of bayes, on a counting detector: bits that the readouts know of the label, and Fisher's ratio",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default 0)")
    add_threads(parser)
    add_data_dir(parser)


def _run(args: argparse.Namespace) -> int:
    from pans.trainer.baselines.rows import baseline_rows
    from pans.trainer.tasks.registry import load_task

    _check(args)
    if not (args.paradigm == "direct" and args.method in ("bayes", "stopping")):
        torch_with(args.threads, "a trained baseline")
    whole = load_task(args.task, args.data_dir)
    task = replace(whole, train=whole.train.first(args.train_objects), test=whole.test.first(args.objects))
    rows: list[dict[str, Any]] = []
    code = EXIT_FINE
    try:
        with usage_errors(), _progress() as report:
            for row in baseline_rows(task, _options(args), args.photons, report):
                say(_line(row))
                rows.append(row)
    except KeyboardInterrupt:
        say("interrupted; the photon levels above are whole")
        code = EXIT_INTERRUPTED
    if rows:
        shared = {"task": task.name, "paradigm": args.paradigm, "method": args.method, "seed": args.seed}
        payload = rows[0] | shared | {"rows": rows, "interrupted": code != EXIT_FINE, "simulated": True}
        emit(args, payload, _table(task, args, rows))
    elif code == EXIT_FINE:
        raise UsageError(
            f"--photons {args.photons}: none can be reached by stopping", remedy="ask for fewer, from 1 on"
        )
    return code


def _check(args: argparse.Namespace) -> None:
    args.method = args.method or METHODS[args.paradigm][0]
    if args.method not in METHODS[args.paradigm]:
        raise UsageError(
            f"--method is {args.method!r}, allowed with {args.paradigm}: {', '.join(METHODS[args.paradigm])}"
        )
    limits = {"features": (1, 4096), "bits": (1, 16), "epochs": (1, 10_000), "objects": (1, 1 << 30)}
    limits |= {"train_objects": (10, 1 << 30), "trials": (1, 100_000), "seed": (0, 2**63 - 1), "threads": (1, 1024)}
    for name, (low, high) in limits.items():
        value = getattr(args, name)
        if value is not None and not low <= value <= high:
            raise UsageError(f"--{name.replace('_', '-')} is {value}, allowed: {low} to {high}")
    for value in args.photons:
        if not 0 < value <= 1e9:
            raise UsageError(f"--photons is {value:g}, allowed: above 0, at most 1e9")
    if args.floor is not None and not 0 < args.floor < 1:
        raise UsageError(f"--floor is {args.floor:g}, allowed: above 0, below 1")
    if args.information and (args.method != "bayes" or args.detector != "counting" or args.brightness != "source"):
        raise UsageError(
            "--information is allowed with --method bayes, --detector counting and --brightness source only"
        )
    if not 0 <= args.dark <= DARK_MAX:
        raise UsageError(f"--dark is {args.dark:g}, allowed: 0 to {DARK_MAX:g}")


def _options(args: argparse.Namespace) -> BaselineOptions:
    return BaselineOptions(**{field.name: getattr(args, field.name) for field in fields(BaselineOptions)})


def _line(row: dict[str, Any]) -> str:
    return (
        f"{row['photons_asked']:>9g} photons: {100 * row['accuracy_mean']:6.2f} %  "
        f"(first {row['first_200']['objects']}: {100 * row['first_200']['accuracy_mean']:6.2f} %)  {row['seconds']:.0f} s"
    )


def _table(task: Task, args: argparse.Namespace, rows: list[dict[str, Any]]) -> str:
    head = (
        f"SIMULATED {args.paradigm}, {args.method}, {args.detector} detector, {task.name}: {rows[0]['objects']} objects, "
        f"{rows[0]['trials']} trials, {rows[0]['train_objects']} training objects\n"
        "   photons    clicks  illumination  accuracy %  spread(trials)  error(objects)  first 200 %"
    )
    lines = []
    for row in rows:
        spread = f"{100 * row['accuracy_std']:.2f}" if row["trials"] > 1 else "one trial"
        lines.append(
            f"{row['photons_mean']:10.2f}{row['clicks_mean']:10.2f}{row['illumination']:14.1f}"
            f"{100 * row['accuracy_mean']:12.2f}{spread:>16}{100 * row['accuracy_se_objects']:16.2f}"
            f"{100 * row['first_200']['accuracy_mean']:13.2f}"
        )
    return "\n".join([head, *lines])


@contextmanager
def _progress() -> Iterator[Report]:
    """A bar on a terminal, else a line per quarter of each piece of work; both on stderr."""
    if not sys.stderr.isatty():
        yield _lines_of_progress()
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        line = bar.add_task("measuring", total=1.0)
        yield lambda what, done: bar.update(line, completed=done, description=what)


def _lines_of_progress() -> Report:
    last = [0.0]

    def show(what: str, done: float) -> None:
        quarter = math.floor(4 * done) / 4
        if quarter > last[0] and not what.startswith("posterior"):
            say(f"  {100 * quarter:.0f} %  {what}")
        last[0] = quarter

    return show


BASELINE = Command(
    "direct imaging, compressive sensing, conventional end-to-end, trained masks and Hadamard pairs, at equal photons",
    _configure,
    _run,
    examples=("pans baseline direct --task parts --photons 5 17 100",),
)
