"""`pans baseline direct|compressive|e2e`: the alternatives to PANS, at equal photons.

Owns the arguments, the walk over photon levels and how the answer looks; the work is in the baseline_*.py modules. Every row
holds clicks, photons and illumination, the spread over trials and the error from having few objects, for all test objects
and for the first 200 (those of the paper's tables). All figures are SIMULATED.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, emit, say
from pans.runtime.errors import UsageError

if TYPE_CHECKING:
    from pans.trainer.baselines.common import Decide, Measurement, Report
    from pans.trainer.tasks.registry import Task

    At = Callable[[float], tuple[Decide, dict[str, Any]]]  # photons per object -> the decision, and facts about it

DEFAULT_PHOTONS = (5.0, 10.0, 17.0, 30.0, 100.0, 300.0)
DEFAULT_METHOD = {"direct": "bayes", "compressive": "mlp", "e2e": "qat"}
METHODS = {
    "direct": ("bayes", "cnn", "clean-cnn"),
    "compressive": ("mlp", "clean-mlp", "bayes"),
    "e2e": ("qat", "plain"),
}
FIRST = 200
NEEDS_TORCH = "pip install 'pans-runtime[train]'"


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
    parser.add_argument("--features", type=int, default=32, metavar="D", help="patterns, unless direct (default 32)")
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
    parser.add_argument("--epochs", type=int, metavar="E", help="of a network (default: 5 CNN, 10 MLP, 15 end-to-end)")
    parser.add_argument("--objects", type=int, metavar="N", help="only the first N test objects (default: all)")
    parser.add_argument("--train-objects", type=int, metavar="N", help="only the first N training objects")
    parser.add_argument("--trials", type=int, metavar="N", help="readouts per object (default: bayes 2, others 10)")
    parser.add_argument(
        "--information",
        action="store_true",
        help="of bayes, on a counting detector: bits that the readouts know of the label, and Fisher's ratio",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default 0)")
    parser.add_argument(
        "--threads", type=int, default=1, metavar="T", help="of torch (default 1); changes the rounding"
    )
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


def _run(args: argparse.Namespace) -> int:
    from pans.trainer.tasks.registry import load_task

    _check(args)
    if not (args.paradigm == "direct" and args.method == "bayes"):
        _torch().set_num_threads(args.threads)
    task = _shortened(load_task(args.task, args.data_dir), args.train_objects, args.objects)
    rows: list[dict[str, Any]] = []
    code = EXIT_FINE
    try:
        with _progress() as report:
            for row in rows_of(task, args, report):
                say(_line(row))
                rows.append(row)
    except KeyboardInterrupt:
        say("interrupted; the photon levels above are whole")
        code = EXIT_INTERRUPTED
    if rows:
        shared = {"task": task.name, "paradigm": args.paradigm, "method": args.method, "seed": args.seed}
        payload = rows[0] | shared | {"rows": rows, "interrupted": code != EXIT_FINE, "simulated": True}
        emit(args, payload, _table(task, args, rows))
    return code


def rows_of_words(words: Sequence[str], task: Task, report: Report) -> Iterator[dict[str, Any]]:
    """Yield what `pans baseline WORDS` measures on `task`, which stands for the one that they name."""
    parser = argparse.ArgumentParser(prog="pans baseline")
    _configure(parser)
    args = parser.parse_args(words)
    _check(args)
    yield from rows_of(_shortened(task, args.train_objects, args.objects), args, report)


def _check(args: argparse.Namespace) -> None:
    args.method = args.method or DEFAULT_METHOD[args.paradigm]
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
    if not 0 <= args.dark < math.inf:
        raise UsageError(f"--dark is {args.dark:g}, allowed: finite and at least 0")


def _shortened(task: Task, n_train: int | None, n_test: int | None) -> Task:
    def first(objects: Any, n: int | None) -> Any:
        return type(objects)(objects.images[:n], objects.labels[:n])

    return replace(task, train=first(task.train, n_train), test=first(task.test, n_test))


def rows_of(task: Task, args: argparse.Namespace, report: Report) -> Iterator[dict[str, Any]]:
    """Yield one row of figures per photon level, in the order of `args.photons`."""
    from pans.trainer.baselines.common import run_trials

    measurement, at = _paradigm(task, args, report)
    trials = args.trials or (2 if args.method == "bayes" else 10)
    for photons in args.photons:
        started = time.perf_counter()
        decide, extra = at(photons)
        done = run_trials(measurement, photons, args.detector, decide, trials=trials, seed=args.seed, dark=args.dark)
        yield {
            **asdict(done.measured()),
            "first_200": asdict(done.measured(FIRST)),
            "photons_asked": photons,
            "detector": args.detector,
            "brightness": args.brightness,
            "dark": args.dark,
            "features": measurement.train.shape[1],
            "train_objects": len(task.train),
            **extra,
            "seconds": time.perf_counter() - started,
        }


def _paradigm(task: Task, args: argparse.Namespace, report: Report) -> tuple[Measurement, At]:
    """The measurement, and what gives the decision at a photon level, with facts about it."""
    if args.paradigm == "e2e":
        return _end_to_end(task, args, report)
    from pans.trainer.baselines.bayes import bayes
    from pans.trainer.baselines.common import measure

    patterns, facts = None, {}
    if args.paradigm == "compressive":
        from pans.trainer.baselines.compressive import patterns as fixed_patterns

        patterns = fixed_patterns(args.patterns, args.features, task.image_shape, args.seed)
        facts = {"patterns": args.patterns}
    measurement = measure(task, patterns, args.brightness)
    if args.method != "bayes":
        return measurement, _network(measurement, args, facts, report)

    def exact(photons: float) -> tuple[Decide, dict[str, Any]]:
        decide, floor = bayes(
            measurement, photons, args.detector, seed=args.seed, dark=args.dark, floor=args.floor, report=report
        )
        known = _information(measurement, photons, floor, args) if args.information else {}
        return decide, facts | {"floor": floor} | known

    return measurement, exact


def _information(measurement: Measurement, photons: float, floor: float, args: argparse.Namespace) -> dict[str, Any]:
    """One more readout of every test object, judged by the posterior; and what its statistics alone say."""
    import numpy as np

    from pans.trainer.baselines.bayes import log_joint
    from pans.trainer.baselines.common import detect
    from pans.trainer.evaluate.information import fisher, posterior_information

    light = measurement.photoelectrons(measurement.test, photons)
    readouts = detect(light, args.detector, np.random.default_rng([args.seed, 4]), args.dark)
    joint = log_joint(measurement, readouts, photons, args.detector, floor=floor, dark=args.dark)
    mean = light.astype(np.float64) + args.dark  # of Poisson counts, and their variance too
    return {
        "information": asdict(posterior_information(joint, measurement.test_labels)),
        "fisher": asdict(fisher(mean, mean, measurement.test_labels)),
    }


def _network(measurement: Measurement, args: argparse.Namespace, facts: dict[str, Any], report: Report) -> At:
    from pans.trainer.baselines.compressive import aware_mlp, clean_mlp
    from pans.trainer.baselines.direct import aware_cnn, clean_cnn

    shared: dict[str, Any] = {"seed": args.seed, "report": report}
    if args.epochs:
        shared["epochs"] = args.epochs
    if args.method == "clean-cnn":
        of_frame = clean_cnn(measurement, **shared)
        return lambda _photons: (of_frame, facts)
    if args.method == "clean-mlp":
        of_level = clean_mlp(measurement, **shared)
        return lambda photons: (of_level(photons, args.detector), facts)
    aware = aware_cnn if args.method == "cnn" else aware_mlp
    return lambda photons: (aware(measurement, photons, args.detector, dark=args.dark, **shared), facts)


def _end_to_end(task: Task, args: argparse.Namespace, report: Report) -> tuple[Measurement, At]:
    from pans.trainer.baselines.e2e import EPOCHS, measured_by, train_conventionally

    bits = args.bits if args.method == "qat" else None
    model = train_conventionally(
        task, args.features, seed=args.seed, bits=bits, epochs=args.epochs or EPOCHS, report=report
    )
    measurement, of_level = measured_by(model, task, args.brightness)
    return measurement, lambda photons: (of_level(photons, args.detector), {"bits": bits})


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


def _torch() -> Any:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise UsageError(
            "a trained baseline needs the package torch, which is not installed", remedy=NEEDS_TORCH
        ) from error
    return torch


BASELINE = Command(
    "direct imaging, compressive sensing and conventional end-to-end, at equal photons", _configure, _run
)
