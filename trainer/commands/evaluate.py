"""`pans evaluate`: what a bundle decides on held-out objects, against photons.

Owns the arguments and how the answer looks; the figures come from the package evaluate. All of them are SIMULATED through a profile. A
bundle that gives back pictures is judged by SSIM and mean squared error.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, Command, add_force, emit
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs

from .arguments import add_data_dir, needing, usage_errors

if TYPE_CHECKING:
    from pans.runtime.bundle.model import Bundle
    from pans.trainer.evaluate.accuracy import Measured, MeasuredPictures
    from pans.trainer.evaluate.held_out import Conditions, HeldOut


PICTURE_FILES = ("patterns.png", "pictures.png", "confusion.png", "tsne.png")


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
    add_force(parser)
    parser.add_argument(
        "--data-seed", type=int, metavar="N", help="of a drawn task (default: that of the bundle's training)"
    )
    add_data_dir(parser)


def _evaluate(args: argparse.Namespace) -> int:
    from pans.runtime.bundle.model import load_bundle
    from pans.trainer.evaluate.held_out import Conditions, default_trials, held_out_of, measure

    if args.objects is not None and args.objects < 1:
        raise UsageError(f"--objects is {args.objects}, allowed: 1 or more")
    if args.shots < 1 or args.seed < 0:
        raise UsageError(f"--shots is {args.shots}, --seed is {args.seed}, allowed: from 1, from 0")
    if args.pictures is not None:
        outputs = [args.pictures / name for name in PICTURE_FILES]
        check_outputs(outputs, inputs=[args.bundle, args.task, args.profile], force=args.force, makes_folders=True)
    bundle, digest = load_bundle(args.bundle)
    if args.exact and bundle.picture_shape is not None:
        raise UsageError("--exact: pictures are compared by trials", remedy="use --trials")
    conditions = Conditions(args.profile, args.eta, args.dark, args.seed, args.data_seed)
    trials = None if args.exact else default_trials(bundle) if args.trials is None else args.trials
    with usage_errors():
        held_out = held_out_of(bundle, args.task, args.objects, args.data_dir, conditions)
        started = time.perf_counter()
        measured = measure(bundle, held_out, shots=args.shots, trials=trials, conditions=conditions)
    payload = {
        **asdict(measured),
        "task": held_out.task.name,
        "profile": held_out.profile.name,
        "sha256": digest,
        "seconds": time.perf_counter() - started,
        "simulated": True,
    }
    if args.pictures:
        payload["pictures"] = _draw(args, bundle, held_out, conditions)
    emit(args, payload, words_of(measured))
    return EXIT_FINE


def _draw(args: argparse.Namespace, bundle: Bundle, held_out: HeldOut, conditions: Conditions) -> list[str]:
    from pans.trainer.evaluate.accuracy import light_of

    with needing("--pictures", "plot"):
        from pans.trainer.evaluate.pictures import write_pictures

        objects = held_out.objects
        light = light_of(bundle, held_out.profile, objects.images, eta=conditions.eta, dark=conditions.dark)
        written = write_pictures(
            args.pictures, bundle, light, objects, shots=args.shots, seed=args.seed, force=args.force
        )
    return [str(path) for path in written]


def words_of(measured: Measured | MeasuredPictures) -> str:
    """Return the figures in words."""
    figures: dict[str, Any] = asdict(measured)
    light = f"  clicks {measured.clicks_mean:.3f}   photons {measured.photons_mean:.2f}   illumination {measured.illumination:.1f}"
    if "ssim_mean" in figures:
        return (
            f"SIMULATED SSIM {figures['ssim_mean']:.4f}, mean squared error {figures['mse_mean']:.4f}  "
            f"({measured.objects} objects, {measured.trials} trials, K = {measured.shots})\n"
            f"  spread over trials      {figures['ssim_std']:.4f}\n"
            f"  error from the objects  {figures['ssim_se_objects']:.4f}\n{light}"
        )
    how = f"{measured.trials} trials" if measured.trials else "exact expectation"
    return (
        f"SIMULATED accuracy {100 * figures['accuracy_mean']:.2f} %  ({measured.objects} objects, {how}, K = {measured.shots})\n"
        f"  spread over trials      {100 * figures['accuracy_std']:.2f} points\n"
        f"  error from the objects  {100 * figures['accuracy_se_objects']:.2f} points\n{light}"
    )


EVALUATE = Command("accuracy of a bundle against photons, sampled or exact", _configure_evaluate, _evaluate)
