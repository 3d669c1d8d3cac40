"""The trainer's main command: `pans train` (`pans evaluate` is in cmd_evaluate.py, `pans data` in cmd_data.py).

Owns their arguments and how their answers look; the work is in train.py, export.py and tasks.py. Heavy
packages are imported when a command runs, not before. All accuracies here are SIMULATED through the profile.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, emit, say
from pans.runtime.errors import UsageError
from pans.trainer.options import ENCODERS, ESTIMATOR_NAMES, HEADS

from .evaluate import DEFAULT_PROFILE, add_data_dir, figures, first, lines, measure

if TYPE_CHECKING:
    from pans.runtime.instrument.profile import Profile
    from pans.trainer.evaluate.accuracy import Measured, MeasuredPictures
    from pans.trainer.options import Options
    from pans.trainer.tasks.registry import Task
    from pans.trainer.train.history import History
    from pans.trainer.train.loop import EpochReport, Trained

NEEDS_TORCH = "pip install 'pans-runtime[train]'"


# ---- train ----


def _configure_train(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "task", metavar="TASK", help="a name (`pans data list`), a .npz file, or a folder of class folders"
    )
    parser.add_argument("--features", type=int, required=True, metavar="D", help="number of patterns")
    parser.add_argument("--profile", default=DEFAULT_PROFILE, metavar="P", help=f"default: {DEFAULT_PROFILE}")
    parser.add_argument("--encoder", choices=ENCODERS, help="how light meets the object (default: what the task's is)")
    parser.add_argument("--complex-field", action="store_true", help="a coherent encoder's W is complex, not real")
    parser.add_argument("--conserving", action="store_true", help="a passive encoder gives no more light than it gets")
    parser.add_argument(
        "--input-photons",
        type=float,
        metavar="N",
        help="mean photoelectrons that reach a passive encoder in one exposure",
    )
    parser.add_argument(
        "--estimator", choices=ESTIMATOR_NAMES, help="default: exact up to 12 patterns, else local; of pictures ste"
    )
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument(
        "--alpha", type=float, metavar="A", help="weight of the illumination in the loss (default 0.0003)"
    )
    budget.add_argument("--photons", type=float, metavar="B", help="photoelectrons per decision to aim for")
    parser.add_argument("--clicks", type=float, metavar="C", help="clicks per decision to aim for, beside either")
    _configure_schedule(parser)
    _configure_details(parser)
    parser.add_argument("--data-seed", type=int, default=0, metavar="N", help="of a drawn task's images (default 0)")
    parser.add_argument("--history", type=Path, metavar="DIR", help="write and draw how the training went (extra plot)")
    parser.add_argument(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="where to compute (default cpu); changes the random numbers",
    )
    parser.add_argument("--resume", action="store_true", help="go on from OUT.pans.checkpoint")
    parser.add_argument("--name", metavar="NAME", help="the bundle's name (default: that of the output file)")
    add_data_dir(parser)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.pans", help="the bundle to write")


def _configure_schedule(parser: argparse.ArgumentParser) -> None:
    """Options of how long and in which stages to train, and within which budget."""
    parser.add_argument(
        "--epochs", type=int, default=60, metavar="E", help="passes over the training objects (default 60)"
    )
    parser.add_argument(
        "--budget",
        choices=("firm", "gentle"),
        default="firm",
        help="how strictly --photons and --clicks hold during training (default firm)",
    )
    parser.add_argument("--restarts", type=int, default=1, metavar="R", help="trainings; the best on validation stays")
    parser.add_argument(
        "--starts", type=int, default=1, metavar="S", help="runs of the first stage per restart; the best goes on"
    )
    parser.add_argument("--warm", type=float, default=0.3, metavar="W", help="part of the epochs in the first stage")
    parser.add_argument(
        "--polish",
        type=float,
        default=0.0,
        metavar="P",
        help="last part of the epochs, trained for decisions (default 0)",
    )
    parser.add_argument(
        "--similarity",
        type=float,
        default=0.0,
        metavar="S",
        help="of pictures: share of 1 - SSIM in the loss, the rest being the squared error (default 0)",
    )
    parser.add_argument(
        "--mix",
        type=float,
        default=0.0,
        metavar="M",
        help="share of the loss of 2 to K shots, for patterns too (default 0)",
    )


def _configure_details(parser: argparse.ArgumentParser) -> None:
    """Options of the head, the detection in training and the machine."""
    parser.add_argument("--shots", type=int, default=1, metavar="K", help="fit the head to 1 to K shots (default 1)")
    parser.add_argument(
        "--shift-px",
        type=int,
        default=0,
        metavar="X",
        help="move training images by up to X along the rows (default 0)",
    )
    parser.add_argument("--offset-px", type=int, default=0, metavar="Y", help="and by up to Y across them (default 0)")
    parser.add_argument(
        "--copies",
        type=int,
        default=0,
        metavar="N",
        help="add N distorted copies of every training image: turned, stretched, bent a little (default 0)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default 0)")
    parser.add_argument("--hidden", type=int, default=512, metavar="H", help="hidden units of the head (default 512)")
    parser.add_argument(
        "--head", choices=HEADS, help="digital back end (default mlp; picture where the task asks for it)"
    )
    parser.add_argument("--batch", type=int, default=512, metavar="B", help="objects per step (default 512)")
    parser.add_argument(
        "--slope", type=float, default=1.0, metavar="S", help="slope annealing: light at the start times S"
    )
    parser.add_argument(
        "--clamp", type=float, default=math.inf, metavar="L", help="clamp photoelectrons early in training"
    )
    parser.add_argument(
        "--threads", type=int, default=1, metavar="T", help="of torch (default 1); changes the rounding"
    )
    parser.add_argument(
        "--dark", type=float, metavar="R", help="dark photoelectrons per exposure in training, instead of the profile's"
    )


def _train(args: argparse.Namespace) -> int:
    torch = _torch()
    from pans.runtime.instrument.profile import load_profile
    from pans.trainer.device import computing_on
    from pans.trainer.options import check_options
    from pans.trainer.tasks.registry import load_task
    from pans.trainer.train.loop import train

    if not 1 <= args.threads <= 1024:
        raise UsageError(f"--threads is {args.threads}, allowed: 1 to 1024")
    profile = load_profile(args.profile)
    if not args.out.parent.is_dir():
        raise UsageError(f"{args.out.parent} is not a folder", remedy="make it first")
    task = load_task(args.task, args.data_dir, data_seed=args.data_seed)
    options = _options(args, task)
    check_options(options, profile)
    torch.set_num_threads(args.threads)
    started = time.perf_counter()
    checkpoint = args.out.with_name(args.out.name + ".checkpoint")
    history = _history(args, options, checkpoint, task)
    try:
        with _progress(options) as show, computing_on(args.device):

            def report(epoch: EpochReport) -> None:
                show(epoch)
                if history is not None:
                    history.take(epoch)

            trained = train(task, profile, options, checkpoint=checkpoint, resume=args.resume, report=report)
    except KeyboardInterrupt:
        say(f"interrupted; the last whole epoch is in {checkpoint}\n  go on: the same command with --resume")
        return EXIT_INTERRUPTED
    exported, measured = _export_and_measure(args, task, profile, trained, time.perf_counter() - started)
    checkpoint.unlink(missing_ok=True)
    if history is not None:
        shown = trained.quantised.patterns() if trained.quantised else None
        for path in history.write(args.history, shown, task.image_shape):
            say(f"wrote {path}")
    seconds = time.perf_counter() - started
    payload = {
        "bundle": str(args.out),
        "sha256": exported.sha256,
        **figures(measured),
        "first_200": figures(measure(exported.bundle, profile, first(task.test, 200), 1, None, 0, fall_back=True)),
        "top_photoelectrons": exported.bundle.photons_per_level * max(0, exported.bundle.levels - 1),
        "quantisation_error_bound": trained.quantised.error_bound if trained.quantised else None,
        "score_difference": exported.score_difference,
        "words_compared": exported.words_compared,
        "dead_patterns": exported.dead_patterns,
        "validation_losses": trained.validation_losses,
        "seconds": seconds,
        "simulated": True,
    }
    emit(args, payload, f"{args.out}  {exported.sha256[:12]}  trained in {seconds:.0f} s\n{lines(measured)}")
    return EXIT_FINE


def _history(args: argparse.Namespace, options: Options, checkpoint: Path, task: Task) -> History | None:
    """What keeps the course of the training, if it is wanted; matplotlib is asked for before the training, not after it."""
    if args.history is None:
        return None
    try:
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as error:
        raise UsageError(
            "--history needs the package matplotlib, which is not installed", remedy="pip install 'pans-runtime[plot]'"
        ) from error
    from pans.trainer.train.history import History

    return History(checkpoint, options, task.sha256)


def _options(args: argparse.Namespace, task: Task) -> Options:
    """What the arguments mean for this task: its physics chooses the encoder, its question the head."""
    from pans.trainer.options import DEFAULT_ALPHA, EXACT_FEATURES_MAX, PICTURE_HEADS, Options
    from pans.trainer.tasks.registry import physical_encoder

    encoder = args.encoder or physical_encoder(task)
    is_picture = task.target == "image"
    head = args.head or ("picture" if is_picture else "mlp")
    if (head in PICTURE_HEADS) != is_picture:
        raise UsageError(
            f"--head {head}: the task {task.name} asks for {'a picture' if is_picture else 'a class'}",
            remedy="leave --head out",
        )
    if encoder == "active" and task.optics != "none":
        raise UsageError(f"--encoder active: {task.name} lies behind a fibre", remedy="use --encoder coherent")
    best = "exact" if args.features <= EXACT_FEATURES_MAX else "local"
    estimator = args.estimator or ("ste" if is_picture else best)
    alpha = args.alpha if args.alpha is not None or args.photons is not None else DEFAULT_ALPHA
    same = (
        "features photons clicks epochs restarts starts warm polish mix shots seed hidden batch slope clamp dark budget"
    )
    same += " similarity complex_field conserving input_photons shift_px offset_px copies"
    return Options(
        alpha=alpha,
        estimator=estimator,
        encoder=encoder,
        head=head,
        **{name: getattr(args, name) for name in same.split()},
    )


def _export_and_measure(
    args: argparse.Namespace, task: Task, profile: Profile, trained: Trained, seconds: float
) -> tuple[Any, Measured | MeasuredPictures]:
    from pans.trainer.export.writer import export_trained
    from pans.trainer.tasks.registry import task_names

    known = asdict(trained.options) | {"threads": args.threads, "device": args.device}
    provenance = {
        "task_argument": args.task if args.task in task_names() else Path(args.task).name,
        "data_seed": args.data_seed,
        "options": {key: str(value) if value == math.inf else value for key, value in known.items()},
        "training_seconds": round(seconds, 1),
    }
    exported = export_trained(args.out, trained, task, profile, name=args.name or args.out.stem, provenance=provenance)
    return exported, measure(exported.bundle, profile, task.test, 1, None, 0, fall_back=True)


@contextmanager
def _progress(options: Options) -> Iterator[Callable[[EpochReport], None]]:
    """A bar on a terminal, else a line per tenth of the epochs; both on stderr."""
    if not sys.stderr.isatty():
        step = max(1, options.epochs // 10)
        yield lambda epoch: say(_epoch_line(epoch, options)) if epoch.epoch % step == 0 else None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("training", total=options.epochs * options.restarts)

        def show(epoch: EpochReport) -> None:
            done = epoch.restart * options.epochs + epoch.epoch
            said = f"{epoch.stage}: loss {epoch.loss:.3f}, {epoch.clicks:.1f} clicks, {epoch.photons:.0f} photons"
            bar.update(task, completed=done, description=said)

        yield show


def _epoch_line(epoch: EpochReport, options: Options) -> str:
    return (
        f"restart {epoch.restart + 1}/{options.restarts} epoch {epoch.epoch}/{options.epochs} {epoch.stage}: "
        f"loss {epoch.loss:.3f}, {epoch.clicks:.2f} clicks, {epoch.photons:.1f} photons, {epoch.illumination:.0f} illumination"
    )


# ---- shared ----


def _torch() -> Any:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise UsageError("training needs the package torch, which is not installed", remedy=NEEDS_TORCH) from error
    return torch


TRAIN = Command("train patterns and head through a profile, and export a bundle", _configure_train, _train)
