"""The commands of the trainer: `pans train`, `pans evaluate`, `pans data`.

Owns their arguments and how their answers look; the work is in train.py, export.py, evaluate.py and tasks.py. Heavy
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
from pans.runtime.errors import PansError, UsageError

from .options import ESTIMATOR_NAMES

if TYPE_CHECKING:
    from pans.runtime.bundle import Bundle
    from pans.runtime.profile import Profile

    from .evaluate import Measured
    from .options import Options
    from .tasks import Objects, Task
    from .train import EpochReport, Trained

DEFAULT_PROFILE = "oled-qcmos"
NEEDS_TORCH = "pip install 'pans-runtime[train]'"


# ---- train ----


def _configure_train(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="TASK", help="fashion-mnist, mnist, a .npz file, or a folder of class folders")
    parser.add_argument("--features", type=int, required=True, metavar="D", help="number of patterns")
    parser.add_argument("--profile", default=DEFAULT_PROFILE, metavar="P", help=f"default: {DEFAULT_PROFILE}")
    parser.add_argument("--encoder", choices=("active",), default="active", help="how light meets the object")
    parser.add_argument("--estimator", choices=ESTIMATOR_NAMES, help="default: exact up to 12 patterns, else local")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument(
        "--alpha", type=float, metavar="A", help="weight of the illumination in the loss (default 0.0003)"
    )
    budget.add_argument("--photons", type=float, metavar="B", help="photoelectrons per decision to aim for")
    parser.add_argument("--clicks", type=float, metavar="C", help="clicks per decision to aim for, beside either")
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
        "--mix",
        type=float,
        default=0.0,
        metavar="M",
        help="share of the loss of 2 to K shots, for patterns too (default 0)",
    )
    parser.add_argument("--shots", type=int, default=1, metavar="K", help="fit the head to 1 to K shots (default 1)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random (default 0)")
    parser.add_argument("--hidden", type=int, default=512, metavar="H", help="hidden units of the head (default 512)")
    parser.add_argument("--head", choices=("mlp", "conv"), default="mlp", help="digital back end (default mlp)")
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
    parser.add_argument("--resume", action="store_true", help="go on from OUT.pans.checkpoint")
    parser.add_argument("--name", metavar="NAME", help="the bundle's name (default: that of the output file)")
    _data_dir(parser)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.pans", help="the bundle to write")


def _train(args: argparse.Namespace) -> int:
    torch = _torch()
    from pans.runtime.profile import load_profile

    from .options import check_options
    from .tasks import load_task
    from .train import train

    if not 1 <= args.threads <= 1024:
        raise UsageError(f"--threads is {args.threads}, allowed: 1 to 1024")
    profile = load_profile(args.profile)
    options = _options(args)
    check_options(options, profile)
    if not args.out.parent.is_dir():
        raise UsageError(f"{args.out.parent} is not a folder", remedy="make it first")
    task = load_task(args.task, args.data_dir)
    torch.set_num_threads(args.threads)
    started = time.perf_counter()
    checkpoint = args.out.with_name(args.out.name + ".checkpoint")
    try:
        with _progress(options) as report:
            trained = train(task, profile, options, checkpoint=checkpoint, resume=args.resume, report=report)
    except KeyboardInterrupt:
        say(f"interrupted; the last whole epoch is in {checkpoint}\n  go on: the same command with --resume")
        return EXIT_INTERRUPTED
    exported, measured = _export_and_measure(args, task, profile, trained, time.perf_counter() - started)
    checkpoint.unlink(missing_ok=True)
    seconds = time.perf_counter() - started
    payload = {
        "bundle": str(args.out),
        "sha256": exported.sha256,
        **_figures(measured),
        "first_200": _figures(_measure(exported.bundle, profile, _first(task.test, 200), 1, None, 0, fall_back=True)),
        "top_photoelectrons": exported.bundle.photons_per_level * (exported.bundle.levels - 1),
        "quantisation_error_bound": trained.quantised.error_bound if trained.quantised else None,
        "score_difference": exported.score_difference,
        "words_compared": exported.words_compared,
        "dead_patterns": exported.dead_patterns,
        "validation_losses": trained.validation_losses,
        "seconds": seconds,
        "simulated": True,
    }
    emit(args, payload, f"{args.out}  {exported.sha256[:12]}  trained in {seconds:.0f} s\n{_lines(measured)}")
    return EXIT_FINE


def _options(args: argparse.Namespace) -> Options:
    from .options import DEFAULT_ALPHA, EXACT_FEATURES_MAX, Options

    estimator = args.estimator or ("exact" if args.features <= EXACT_FEATURES_MAX else "local")
    alpha = args.alpha if args.alpha is not None or args.photons is not None else DEFAULT_ALPHA
    same = "features photons clicks epochs restarts starts warm polish mix shots seed head hidden batch slope clamp dark budget"
    return Options(alpha=alpha, estimator=estimator, **{name: getattr(args, name) for name in same.split()})


def _export_and_measure(
    args: argparse.Namespace, task: Task, profile: Profile, trained: Trained, seconds: float
) -> tuple[Any, Measured]:
    from .export import export_trained
    from .public_sets import PUBLIC_SETS

    known = asdict(trained.options) | {"threads": args.threads}
    provenance = {
        "task_argument": args.task if args.task in PUBLIC_SETS else Path(args.task).name,
        "options": {key: str(value) if value == math.inf else value for key, value in known.items()},
        "training_seconds": round(seconds, 1),
    }
    exported = export_trained(args.out, trained, task, profile, name=args.name or args.out.stem, provenance=provenance)
    return exported, _measure(exported.bundle, profile, task.test, 1, None, 0, fall_back=True)


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


# ---- evaluate ----


def _configure_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bundle", metavar="BUNDLE", help="a .pans file")
    parser.add_argument("--task", metavar="T", help="as of `pans train` (default: what the bundle was trained on)")
    parser.add_argument("--profile", metavar="P", help="default: what the bundle was trained for")
    parser.add_argument("--shots", type=int, default=1, metavar="K", help="exposures of every pattern (default 1)")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--trials", type=int, metavar="N", help="sampled decisions per object (default 30)")
    way.add_argument("--exact", action="store_true", help="enumerate all click words: no trials, no sampling error")
    parser.add_argument("--objects", type=int, metavar="N", help="only the first N held-out objects (default: all)")
    parser.add_argument(
        "--dark", type=float, metavar="R", help="dark photoelectrons per exposure, instead of the profile's"
    )
    parser.add_argument("--eta", type=float, default=1.0, metavar="E", help="all light times E (default 1)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the trials (default 0)")
    _data_dir(parser)


def _evaluate(args: argparse.Namespace) -> int:
    from pans.runtime.bundle import load_bundle
    from pans.runtime.profile import load_profile

    from .tasks import load_task

    if args.objects is not None and args.objects < 1:
        raise UsageError(f"--objects is {args.objects}, allowed: 1 or more")
    if args.shots < 1 or args.seed < 0:
        raise UsageError(f"--shots is {args.shots}, --seed is {args.seed}, allowed: from 1, from 0")
    bundle, digest = load_bundle(args.bundle)
    profile = load_profile(args.profile or str(bundle.provenance.get("profile", DEFAULT_PROFILE)))
    task = load_task(args.task or str(bundle.provenance.get("task_argument", bundle.task)), args.data_dir)
    if task.classes != bundle.classes:
        raise UsageError(
            f"{args.bundle} decides among {len(bundle.classes)} classes ({', '.join(bundle.classes[:3])}, ...), the task "
            f"{task.name} has {len(task.classes)} ({', '.join(task.classes[:3])}, ...)"
        )
    whole = task.split_here and bundle.provenance.get("data_sha256") != task.sha256
    objects = task.everything() if whole else task.test
    trials = None if args.exact else args.trials if args.trials is not None else 30
    started = time.perf_counter()
    measured = _measure(
        bundle, profile, _first(objects, args.objects), args.shots, trials, args.seed, eta=args.eta, dark=args.dark
    )
    payload = {
        **_figures(measured),
        "task": task.name,
        "profile": profile.name,
        "sha256": digest,
        "seconds": time.perf_counter() - started,
        "simulated": True,
    }
    emit(args, payload, _lines(measured))
    return EXIT_FINE


def _measure(
    bundle: Bundle,
    profile: Profile,
    objects: Objects,
    shots: int,
    trials: int | None,
    seed: int,
    *,
    eta: float = 1.0,
    dark: float | None = None,
    fall_back: bool = False,
) -> Measured:
    """Exact without `trials`; with `fall_back`, 30 trials where there is too much to enumerate."""
    from .evaluate import EXACT_OUTCOMES_MAX, evaluate_exactly, evaluate_sampled, light_of

    light = light_of(bundle, profile, objects.images, eta=eta, dark=dark)
    if trials is None and fall_back and (shots + 1) ** bundle.n_features > EXACT_OUTCOMES_MAX:
        trials = 30
    if trials is None:
        return evaluate_exactly(bundle, light, objects.labels, shots=shots)
    return evaluate_sampled(bundle, light, objects.labels, shots=shots, trials=trials, seed=seed)


def _figures(measured: Measured) -> dict[str, Any]:
    return asdict(measured)


def _lines(measured: Measured) -> str:
    how = f"{measured.trials} trials" if measured.trials else "exact expectation"
    return (
        f"SIMULATED accuracy {100 * measured.accuracy_mean:.2f} %  ({measured.objects} objects, {how}, K = {measured.shots})\n"
        f"  spread over trials      {100 * measured.accuracy_std:.2f} points\n"
        f"  error from the objects  {100 * measured.accuracy_se_objects:.2f} points\n"
        f"  clicks {measured.clicks_mean:.3f}   photons {measured.photons_mean:.2f}   illumination {measured.illumination:.1f}"
    )


# ---- data ----


def _configure_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("list", "fetch"), help="what is there, or fetch what is not")
    parser.add_argument("names", nargs="*", metavar="NAME", help="fashion-mnist, mnist (default: all)")
    _data_dir(parser)


def _data(args: argparse.Namespace) -> int:
    from .public_sets import PUBLIC_SETS, check_pinned, data_folder, fetch

    unknown = [name for name in args.names if name not in PUBLIC_SETS]
    if unknown:
        raise UsageError(f"no data set {unknown[0]!r}, allowed: {', '.join(PUBLIC_SETS)}")
    folder = data_folder(args.data_dir)
    rows = []
    for name in args.names or PUBLIC_SETS:
        for pinned in PUBLIC_SETS[name].files:
            path = folder / PUBLIC_SETS[name].folder / pinned.name
            if args.action == "fetch" and fetch(PUBLIC_SETS[name].source + pinned.name, path, pinned):
                say(f"fetched {path}")
            try:
                check_pinned(path, pinned)
                state = "ok"
            except PansError as error:
                state = "missing" if isinstance(error, UsageError) else "altered"
            rows.append(
                {"set": name, "file": pinned.name, "bytes": pinned.n_bytes, "sha256": pinned.sha256, "state": state}
            )
    text = "\n".join(f"{row['state']:<8} {row['set']:<14} {row['file']:<28} {row['bytes']:>10}" for row in rows)
    emit(args, {"folder": str(folder), "rows": rows}, f"{text}\nin {folder}")
    return EXIT_FINE


# ---- shared ----


def _data_dir(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


def _first(objects: Objects, count: int | None) -> Objects:
    return objects if count is None else type(objects)(objects.images[:count], objects.labels[:count])


def _torch() -> Any:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise UsageError("training needs the package torch, which is not installed", remedy=NEEDS_TORCH) from error
    return torch


TRAIN = Command("train patterns and head through a profile, and export a bundle", _configure_train, _train)
EVALUATE = Command("accuracy of a bundle against photons, sampled or exact", _configure_evaluate, _evaluate)
DATA = Command("list or fetch the public data sets", _configure_data, _data)
