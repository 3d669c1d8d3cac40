"""What `pans train` adds for a user's own images: what is chosen from them, what is warned of, and what comes next."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.base.console import say, warn
from pans.base.files import write_file

from .arguments import displayed_parts

if TYPE_CHECKING:
    from pans.bundle.sensor import Bundle
    from pans.instrument.profile import Profile
    from pans_trainer.options import AutomatonOptions
    from pans_trainer.own_images.own import Prepared
    from pans_trainer.own_images.recipe import Recipe
    from pans_trainer.own_images.results import SensorResults
    from pans_trainer.tasks.registry import Task

AUTOMATON = "automaton"
AUTOMATON_PROFILE = "ideal"
SIZES = ("exposures", "states")  # which a training that starts from an automaton has from it
CHANGES = ("copies", "shift_px", "offset_px")  # a user who asks for one of these has chosen how images are varied
BUDGET_OFF = 0.05  # relative: more is said at the end
RUN_DECISIONS = 1000
CLEAR_SE = 2.0  # standard errors that tell a sensor from a camera


@dataclass(frozen=True, slots=True)
class Finished:
    """A training that is over: its bundle, its options where it was an automaton's, when it began (perf_counter), and its words."""

    bundle: Bundle
    sha256: str
    options: AutomatonOptions | None
    started: float
    words: Sequence[str] = ()  # of a budget that was missed


def is_own(args: argparse.Namespace) -> bool:
    """Return whether the task is a folder or a file of the user's, and choices are wanted."""
    from pans_trainer.tasks.registry import task_names

    return args.task not in task_names() and not args.as_is


def set_encoder(args: argparse.Namespace, of_fixed: tuple[str, ...]) -> None:
    """Set `args.encoder` for own images, unless an option asks for one, or for what only fixed patterns have."""
    if args.encoder is not None or any(getattr(args, name) not in (None, False) for name in of_fixed):
        return
    from pans.instrument.profile import load_profile
    from pans_trainer.own_images.recipe import choose_encoder

    encoder, why = choose_encoder(load_profile(args.profile or AUTOMATON_PROFILE))
    args.encoder = encoder if encoder == AUTOMATON else None
    say(why)


def as_given(args: argparse.Namespace, task: Task) -> Task:
    """Return the task as it is, and warn of the classes of a user's own images."""
    if args.as_is:
        from pans_trainer.own_images.recipe import class_warnings

        for text in class_warnings(task):
            warn(text)
    return task


def choose(args: argparse.Namespace, task: Task, profile: Profile) -> Prepared:
    """Choose what the options leave open, say what was read and chosen, and why, and warn."""
    from pans_trainer.own_images.own import prepared
    from pans_trainer.own_images.recipe import warnings_of

    for line in [f"{task.name}:", *task.account.lines()] if task.account else ():
        say(line)
    say(f"{task.name}: {len(task.train)} images to train on, {len(task.test)} held out, {len(task.classes)} classes")
    vary = not any(getattr(args, name) for name in CHANGES)
    encoder = args.encoder or "active"
    chosen = prepared(task, encoder, seed=args.seed or 0, equal=not args.keep_shares, vary=vary)
    recipe = chosen.recipe
    for text in warnings_of(task, profile, recipe, args.clicks):
        warn(text)
    say("chosen from the images (--as-is chooses nothing):")
    for reason in [*(recipe.reasons if args.start is None else recipe.reasons[:1]), *_fill(args, recipe)]:
        say(f"  {reason}")
    return chosen


def sheets_of(args: argparse.Namespace) -> list[Path]:
    """Return the pictures beside the bundle: what the sensor sees, and what it confuses."""
    return [args.out.with_name(f"{args.out.stem}-{name}.png") for name in ("seen", "confused")]


def _fill(args: argparse.Namespace, recipe: Recipe) -> list[str]:
    """Set the options that were left open; return what was set, in words."""
    names = (
        ("exposures", "states", "batch", "epochs") if recipe.encoder == AUTOMATON else ("features", "batch", "epochs")
    )
    for name in names:
        if getattr(args, name) is None and (args.start is None or name not in SIZES):
            setattr(args, name, getattr(recipe, name))
    for name in ("copies", "soft"):  # not those of a public set whose name the folder bears
        if recipe.encoder == AUTOMATON and getattr(args, name) is None:
            setattr(args, name, 0)
    if any(getattr(args, name, None) is not None for name in ("photons", "clicks", "alpha", "illumination")):
        return []
    from pans_trainer.own_images.recipe import PHOTONS

    words = []
    # fixed patterns would have to meet both budgets, an automaton need not use both up
    if args.encoder not in (None, "active"):
        args.photons = recipe.photons
        words.append(f"{recipe.photons:g} photons")
    if args.encoder in (None, "active", AUTOMATON):
        args.illumination = recipe.illumination
        words.append(f"an illumination of {recipe.illumination:g}, at which a camera detects {recipe.photons:g}")
    why = (
        "the least that tells a camera enough of left-out images"
        if recipe.photons < PHOTONS[-1]
        else "as much as is tried"
    )
    return [f"at most {' and '.join(words)}: {why} (--photons, --illumination for another budget)"]


def finish(
    args: argparse.Namespace, task: Task, chosen: Prepared, profile: Profile, done: Finished
) -> tuple[dict[str, Any], list[str]]:
    """Judge the sensor beside a camera, write what it sees and confuses, name the next commands; return keys of the answer, and lines.

    `chosen` holds the changed copies too: the camera knows what the sensor was trained on.
    """
    from pans_trainer.baselines.rows import equal_light_figures
    from pans_trainer.own_images.own import CAMERAS, about, folds_needed, judged, other_folds
    from pans_trainer.own_images.results import confused_sheet, results_of, seen_sheet

    seen, confused = sheets_of(args)
    write_file(seen, seen_sheet(task), force=args.force or args.resume)
    folds = 1 if done.options is None else args.folds or folds_needed(task)

    def so_far() -> SensorResults:
        seconds, missing = time.perf_counter() - done.started, folds - len(parts)
        return results_of(parts, task.classes, seconds=seconds, bundle=args.out, sha256=done.sha256, missing=missing)

    with displayed_parts() as report:
        parts = [judged(done.bundle, chosen.task, profile, args.seed or 0, report)]
    if done.options is not None and folds > 1:
        first = replace(so_far(), folds_missing=0)
        say("\n".join(first.lines()))
        say(
            f"{args.out} is whole. Its classes are small: {folds - 1} more sensors are trained for the figures alone, which takes "
            f"{about(first.seconds * (folds - 1))}; Ctrl-C ends with the figures so far"
        )
        with displayed_parts() as report:
            equal, first_s = not args.keep_shares, first.seconds
            parts += other_folds(task, profile, done.options, folds, equal=equal, first_s=first_s, report=report)
    results = so_far()
    if args.encoder != AUTOMATON:  # whose own words tell it
        warn_of_budget(args, results.clicks, results.photons, results.illumination)
    warn_of_camera(results)
    lines, picture = [*results.lines(), *done.words, f"  what the sensor sees: {seen}"], confused_sheet(results)
    if picture is not None:
        write_file(confused, picture, force=args.force)
        lines.append(f"  the images behind these pairs: {confused}")
    account = {"read": task.account.as_json()} if task.account else {}
    cameras = {name: equal_light_figures(one) for name, one in zip(CAMERAS, parts[0].cameras) if one is not None}
    found = {"results": results.as_json(), **account, **cameras, "interrupted": len(parts) < folds}
    return found, [*lines, next_commands(args, profile.name)]


def warn_of_camera(results: SensorResults) -> None:
    """Warn where the sensor is not better than a camera with as much light."""
    cameras = {"photons": results.camera_at_equal_photons, "illumination": results.camera_at_equal_illumination}
    for name, camera in cameras.items():
        if camera is not None and camera.balanced_accuracy_gain <= CLEAR_SE * camera.balanced_accuracy_gain_se:
            gain = f"{100 * camera.balanced_accuracy_gain:+.1f} ± {100 * camera.balanced_accuracy_gain_se:.1f} points"
            warn(
                f"the sensor is not better than an ideal camera at equal {name} ({gain} of balanced accuracy). Try "
                "more images of the small classes, more contrast, a darker ground, or less light"
            )


def warn_of_budget(args: argparse.Namespace, clicks: float, photons: float, illumination: float) -> None:
    """Warn where the finished sensor is far from the budget."""
    for name, found in (("clicks", clicks), ("photons", photons), ("illumination", illumination)):
        wanted = getattr(args, name)
        if wanted is not None and abs(found / wanted - 1) > BUDGET_OFF:
            warn(
                f"--{name} {wanted:g} was not met: a decision takes {found:.2f}. Try more --epochs, other --exposures, or another "
                "--profile"
            )


def next_commands(args: argparse.Namespace, profile: str) -> str:
    """Return the commands that run the bundle on its held-out images."""
    out = Path(args.out)
    scene, folder = out.with_suffix(".npz"), out.with_name(f"{out.stem}-run")
    if str(scene) == args.task:
        scene = out.with_name(f"{out.stem}-scene.npz")
    device = f"sim:{profile}?scene={scene}&pace=fast&seed=1"
    lines = (
        ["pans", "data", "scene", args.task, *reading_words(args), "-o", str(scene)],
        ["pans", "run", str(out), "--device", device, "--decisions", str(RUN_DECISIONS), "--out", str(folder)],
        ["pans", "report", str(folder / "run.pansrec"), "-o", str(out.with_name(f"{out.stem}-report.html"))],
    )
    return "\n".join(["next:", *(f"  {shlex.join(line)}" for line in lines)])


def reading_words(args: argparse.Namespace) -> list[str]:
    """Return the options that say how photos were read, for another command."""
    words = [] if args.resize is None else ["--resize", str(args.resize)]
    return [*words, *(["--fit", "pad"] if args.fit == "pad" else []), *(["--skip-bad"] if args.skip_bad else [])]
