"""`pans evaluate`: what a bundle decides on held-out objects, against photons.

Owns the arguments and how the answer looks; the figures come from evaluate.py. All of them are SIMULATED through a profile. A bundle
that gives back pictures is judged by SSIM and mean squared error.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, Command, emit
from pans.runtime.errors import UsageError

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle
    from pans.runtime.instrument.profile import Profile
    from pans.trainer.evaluate.accuracy import Measured, MeasuredPictures
    from pans.trainer.tasks.registry import Objects

DEFAULT_PROFILE = "oled-qcmos"
DEFAULT_TRIALS = 30
PICTURE_TRIALS = 3  # a picture is hundreds of numbers


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
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="draw confusion, a map of the clicks, patterns (extra plot)"
    )
    parser.add_argument(
        "--data-seed", type=int, metavar="N", help="of a drawn task (default: that of the bundle's training)"
    )
    add_data_dir(parser)


def _evaluate(args: argparse.Namespace) -> int:
    from pans.runtime.bundle.model import load_bundle
    from pans.runtime.instrument.profile import load_profile
    from pans.trainer.tasks.registry import load_task

    if args.objects is not None and args.objects < 1:
        raise UsageError(f"--objects is {args.objects}, allowed: 1 or more")
    if args.shots < 1 or args.seed < 0:
        raise UsageError(f"--shots is {args.shots}, --seed is {args.seed}, allowed: from 1, from 0")
    bundle, digest = load_bundle(args.bundle)
    profile = load_profile(args.profile or str(bundle.provenance.get("profile", DEFAULT_PROFILE)))
    task_name = args.task or str(bundle.provenance.get("task_argument", bundle.task))
    data_seed = int(bundle.provenance.get("data_seed", 0)) if args.data_seed is None else args.data_seed
    task = load_task(task_name, args.data_dir, data_seed=data_seed)
    if bundle.picture_shape not in (None, task.image_shape):
        raise UsageError(
            f"{args.bundle} gives back pictures of {bundle.picture_shape}, the task has {task.image_shape}"
        )
    if bundle.picture_shape is None and task.classes != bundle.classes:
        raise UsageError(
            f"{args.bundle} decides among {len(bundle.classes)} classes ({', '.join(bundle.classes[:3])}, ...), the task "
            f"{task.name} has {len(task.classes)} ({', '.join(task.classes[:3])}, ...)"
        )
    whole = task.split_here and bundle.provenance.get("data_sha256") != task.sha256
    objects = task.everything() if whole else task.test
    default = DEFAULT_TRIALS if bundle.picture_shape is None else PICTURE_TRIALS
    trials = None if args.exact else args.trials if args.trials is not None else default
    started = time.perf_counter()
    measured = measure(
        bundle, profile, first(objects, args.objects), args.shots, trials, args.seed, eta=args.eta, dark=args.dark
    )
    payload = {
        **figures(measured),
        "task": task.name,
        "profile": profile.name,
        "sha256": digest,
        "seconds": time.perf_counter() - started,
        "simulated": True,
    }
    if args.pictures:
        payload["pictures"] = _draw(args, bundle, profile, first(objects, args.objects))
    emit(args, payload, lines(measured))
    return EXIT_FINE


def _draw(args: argparse.Namespace, bundle: Bundle, profile: Profile, objects: Objects) -> list[str]:
    from pans.trainer.evaluate.accuracy import light_of

    try:
        from pans.trainer.evaluate.pictures import write_pictures

        light = light_of(bundle, profile, objects.images, eta=args.eta, dark=args.dark)
        written = write_pictures(args.pictures, bundle, light, objects, shots=args.shots, seed=args.seed)
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--pictures needs the package {error.name}, which is not installed",
            remedy="pip install 'pans-runtime[plot]'",
        ) from error
    return [str(path) for path in written]


def measure(
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
) -> Measured | MeasuredPictures:
    """Exact without `trials`; with `fall_back`, 30 trials where there is too much to enumerate, one of pictures."""
    from pans.trainer.evaluate.accuracy import (
        EXACT_OUTCOMES_MAX,
        evaluate_exactly,
        evaluate_pictures,
        evaluate_sampled,
        light_of,
    )

    light = light_of(bundle, profile, objects.images, eta=eta, dark=dark)
    if bundle.picture_shape is not None:
        if trials is None and not fall_back:
            raise UsageError("--exact: pictures are compared by trials", remedy="use --trials")
        return evaluate_pictures(bundle, light, objects.images, shots=shots, trials=trials or 1, seed=seed)
    if trials is None and fall_back and (shots + 1) ** bundle.n_features > EXACT_OUTCOMES_MAX:
        trials = DEFAULT_TRIALS
    if trials is None:
        return evaluate_exactly(bundle, light, objects.labels, shots=shots)
    return evaluate_sampled(bundle, light, objects.labels, shots=shots, trials=trials, seed=seed)


def figures(measured: Measured | MeasuredPictures) -> dict[str, Any]:
    """Return the figures as JSON can hold them."""
    return asdict(measured)


def lines(measured: Measured | MeasuredPictures) -> str:
    """Return the figures in words."""
    from pans.trainer.evaluate.accuracy import MeasuredPictures

    light = f"  clicks {measured.clicks_mean:.3f}   photons {measured.photons_mean:.2f}   illumination {measured.illumination:.1f}"
    if isinstance(measured, MeasuredPictures):
        return (
            f"SIMULATED SSIM {measured.ssim_mean:.4f}, mean squared error {measured.mse_mean:.4f}  "
            f"({measured.objects} objects, {measured.trials} trials, K = {measured.shots})\n"
            f"  spread over trials      {measured.ssim_std:.4f}\n  error from the objects  {measured.ssim_se_objects:.4f}\n{light}"
        )
    how = f"{measured.trials} trials" if measured.trials else "exact expectation"
    return (
        f"SIMULATED accuracy {100 * measured.accuracy_mean:.2f} %  ({measured.objects} objects, {how}, K = {measured.shots})\n"
        f"  spread over trials      {100 * measured.accuracy_std:.2f} points\n"
        f"  error from the objects  {100 * measured.accuracy_se_objects:.2f} points\n{light}"
    )


def first(objects: Objects, count: int | None) -> Objects:
    """Return the first `count` objects, or all of them."""
    return objects if count is None else type(objects)(objects.images[:count], objects.labels[:count])


def add_data_dir(parser: argparse.ArgumentParser) -> None:
    """Add --data-dir to a command that may need a public set."""
    parser.add_argument("--data-dir", metavar="DIR", help="folder of the public sets (default: $PANS_DATA)")


EVALUATE = Command("accuracy of a bundle against photons, sampled or exact", _configure_evaluate, _evaluate)
