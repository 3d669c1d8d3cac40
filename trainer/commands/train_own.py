"""What `pans train` adds for a user's own images: what is chosen from them, what is warned of, and what comes next."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import say, warn

from .evaluate import direct_imaging

if TYPE_CHECKING:
    from pans.runtime.instrument.profile import Profile
    from pans.trainer.choose.recipe import Recipe
    from pans.trainer.tasks.registry import Task

AUTOMATON = "automaton"
AUTOMATON_PROFILE = "ideal"
SIZES = ("exposures", "states")  # which a training that starts from an automaton has from it
CHANGES = ("copies", "shift_px", "offset_px")  # a user who asks for one of these has chosen how images are varied
BUDGET_OFF = 0.05  # relative: more is said at the end
RUN_DECISIONS = 1000


def is_own(args: argparse.Namespace) -> bool:
    """Return whether the task is a folder or a file of the user's, and choices are wanted."""
    from pans.trainer.tasks.registry import task_names

    return args.task not in task_names() and not args.as_is


def set_encoder(args: argparse.Namespace, of_fixed: tuple[str, ...]) -> None:
    """Set `args.encoder` for own images, unless an option asks for one, or for what only fixed patterns have."""
    if args.encoder is not None or any(getattr(args, name) not in (None, False) for name in of_fixed):
        return
    from pans.runtime.instrument.profile import load_profile
    from pans.trainer.choose.recipe import choose_encoder

    encoder, why = choose_encoder(load_profile(args.profile or AUTOMATON_PROFILE))
    args.encoder = encoder if encoder == AUTOMATON else None
    say(why)


def as_given(args: argparse.Namespace, task: Task) -> Task:
    """Return the task as it is, and warn of the classes of a user's own images."""
    if args.as_is:
        from pans.trainer.choose.recipe import class_warnings

        for text in class_warnings(task):
            warn(text)
    return task


def choose(args: argparse.Namespace, task: Task, profile: Profile) -> tuple[Task, dict[str, Any]]:
    """Choose what the options leave open, say what and why, and warn; return the task with its varied copies, and facts of the choice."""
    from pans.trainer.choose.recipe import Choice, choose_training, choose_variation, warnings_of
    from pans.trainer.tasks.changes import Variation, enlarged

    given = any(getattr(args, name) for name in CHANGES)
    say(f"{task.name}: {len(task.train)} images to train on, {len(task.test)} held out, {len(task.classes)} classes")
    choice = (
        Choice(Variation(), 0.0, 0.0) if given or task.target == "image" else choose_variation(task, args.seed or 0)
    )
    recipe = choose_training(task, choice.variation, args.encoder or "active")
    for text in warnings_of(task, profile, recipe, args.clicks):
        warn(text)
    say("chosen from the images (--as-is chooses nothing):")
    for reason in [*(recipe.reasons if args.start is None else recipe.reasons[:1]), *_fill(args, recipe)]:
        say(f"  {reason}")
    bigger = enlarged(task, choice.variation, recipe.objects, recipe.kept, args.seed or 0)
    changes = {name: value for name, value in asdict(choice.variation).items() if value}
    facts = {"training_objects": len(bigger.train), "variation": changes}
    return bigger, facts | {"left_out_loss": [round(choice.loss_before, 4), round(choice.loss, 4)]}


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
    words = []
    # fixed patterns would have to meet both budgets, an automaton need not use both up
    if args.encoder not in (None, "active"):
        args.photons = recipe.photons
        words.append(f"{recipe.photons:g} photons")
    if args.encoder in (None, "active", AUTOMATON):
        args.illumination = recipe.illumination
        words.append(f"an illumination of {recipe.illumination:g}, at which a camera detects {recipe.photons:g}")
    return [f"at most {' and '.join(words)}: a first guess (--photons, --illumination for another budget)"]


def finish(
    args: argparse.Namespace, task: Task, profile: Profile, figures: Mapping[str, Any]
) -> tuple[dict[str, Any], str]:
    """Warn of a missed budget, compare with direct imaging, name the next commands; return keys of the answer, and words.

    `task` holds the changed copies too: direct imaging knows what the sensor was trained on.
    """
    if args.encoder != AUTOMATON:  # whose own words tell it
        warn_of_budget(args, figures["clicks_mean"], figures["photons_mean"], figures["illumination"])
    direct, words = direct_imaging(task, figures, args.seed or 0)
    return direct, "\n".join([*words, next_commands(args, profile.name)])


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
        ["pans", "data", "scene", args.task, "-o", str(scene)],
        ["pans", "run", str(out), "--device", device, "--decisions", str(RUN_DECISIONS), "--out", str(folder)],
        ["pans", "report", str(folder / "run.pansrec"), "-o", str(out.with_name(f"{out.stem}-report.html"))],
    )
    return "\n".join(["next:", *(f"  {shlex.join(line)}" for line in lines)])
