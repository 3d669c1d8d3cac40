"""`pans train`: train patterns and head through a profile, and export a bundle.

Owns what the arguments mean and how the answer looks; the work is done by the packages train, export and evaluate. Heavy packages are
imported when the command runs, not before. All accuracies here are SIMULATED through the profile.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, emit, say
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs
from pans.trainer.options import (
    DEFAULT_ALPHA,
    EXACT_WORDS_MAX,
    PICTURE_HEADS,
    Options,
    check_options,
    check_order,
    plain_options,
)

from .arguments import interruptible, needing, shown_course, stated_tolerance, torch_with, usage_errors, warn_of_laws
from .evaluate import passive_light, warn_of_majority, words_of
from .train_arguments import AS_GIVEN, AUTOMATON, DEFAULT_PROFILE, OF_AUTOMATA, configure_train
from .train_own import as_given, choose, finish, is_own, set_encoder

if TYPE_CHECKING:
    from pans.runtime.instrument.profile import Profile
    from pans.trainer.export.writer import Exported
    from pans.trainer.tasks.registry import Task
    from pans.trainer.train.history import History
    from pans.trainer.train.loop import EpochReport, Trained


def _train(args: argparse.Namespace) -> int:
    from .train_automaton import FOREIGN, train_automaton_command

    checkpoint = args.out.with_name(args.out.name + ".checkpoint")
    own = is_own(args)
    if own:
        set_encoder(args, FOREIGN)
    if args.encoder == AUTOMATON:
        check_files(args, checkpoint)
        return train_automaton_command(args, checkpoint, own)
    if args.features is None and not own:
        raise UsageError("--features is missing: the number of patterns", remedy="--features 10, say")
    for name in OF_AUTOMATA:
        if getattr(args, name) not in (None, False):
            raise UsageError(
                f"--{name.replace('_', '-')} belongs to an automaton", remedy="add --encoder automaton, or leave it out"
            )
    check_files(args, checkpoint)
    torch_with(args.threads)
    from pans.runtime.instrument.profile import load_profile
    from pans.trainer.device import computing_on
    from pans.trainer.tasks.registry import load_task
    from pans.trainer.train.checkpoint import timed
    from pans.trainer.train.loop import train

    profile = load_profile(args.profile or DEFAULT_PROFILE)
    task = load_task(args.task, args.data_dir, data_seed=args.data_seed)
    chosen = choose(args, task, profile) if own else as_given(args, task)
    options = _options(args, task, profile)
    check_order(args.order, options)
    check_options(options, profile)
    history = _history(args, options, checkpoint, chosen.task)
    try:
        with (
            usage_errors(),
            _progress(options) as show,
            computing_on(args.device),
            timed(checkpoint, resume=args.resume) as watch,
        ):

            def report(epoch: EpochReport) -> None:
                show(epoch)
                if history is not None:
                    history.take(epoch)

            trained = train(chosen.task, profile, options, checkpoint=checkpoint, resume=args.resume, report=report)
    except KeyboardInterrupt:
        say(f"interrupted; the last whole epoch is in {checkpoint}\n  go on: the same command with --resume")
        return EXIT_INTERRUPTED
    exported = _export(args, task, profile, trained, watch.seconds(), chosen.facts)
    warn_of_laws(exported.bundle, profile, one_by_one=True)
    answer, words = _figures(exported, trained, task, profile)
    checkpoint.unlink(missing_ok=True)
    if history is not None:
        shown = trained.quantised.patterns() if trained.quantised else None
        for path in history.write(args.history, shown, task.image_shape, force=args.force):
            say(f"wrote {path}")
    warn_of_majority(answer.get("by_class"), answer["photons_mean"])
    seconds = watch.seconds()
    payload = {"bundle": str(args.out), **answer, "seconds": seconds, "simulated": True}
    if own and task.target == "class":
        after = finish(args, task, profile, answer)
        payload, words = payload | after.payload, f"{words}\n{after.words}"
    emit(args, payload, f"{args.out}  {exported.sha256[:12]}  trained in {seconds:.0f} s\n{words}")
    return EXIT_FINE


def check_files(args: argparse.Namespace, checkpoint: Path) -> None:
    """Refuse, before anything is loaded, what cannot be written in the end; a checkpoint is hours of work too."""
    inputs = [args.task, *([args.profile] if args.profile else [])]
    if checkpoint.exists() and not (args.resume or args.force):
        raise UsageError(
            f"{checkpoint}: is here, of a training that was interrupted",
            remedy="go on with it by --resume, or replace it with --force",
        )
    check_outputs([args.out], inputs=inputs, force=args.force)
    check_outputs([checkpoint], inputs=[*inputs, args.out], force=True)
    if args.history is not None:
        from .arguments import HISTORY_FILES

        outputs = [args.history / name for name in HISTORY_FILES]
        check_outputs(outputs, inputs=inputs, force=args.force, makes_folders=True)


def _figures(exported: Exported, trained: Trained, task: Task, profile: Profile) -> tuple[dict[str, Any], str]:
    """What the written bundle decides on the held-out objects, and how well it agrees with the model: for scripts, and in words."""
    from pans.trainer.evaluate.held_out import HeldOut, as_trained, measure, trials_needed

    bundle, told = exported.bundle, as_trained(exported.bundle)
    trials, every = trials_needed(bundle), HeldOut(task, task.test, profile)
    measured = measure(bundle, every, trials=trials, conditions=told)
    of_first = measure(bundle, HeldOut(task, task.test.first(200), profile), trials=trials, conditions=told)
    light = passive_light(bundle, every)
    figures = {
        "sha256": exported.sha256,
        **asdict(measured),
        "first_200": asdict(of_first),
        "top_photoelectrons": bundle.photons_per_level * max(0, bundle.levels - 1),
        "quantisation_error_bound": trained.quantised.error_bound if trained.quantised else None,
        "score_difference": exported.score_difference,
        "words_compared": exported.words_compared,
        "dead_patterns": exported.dead_patterns,
        "validation_losses": trained.validation_losses,
        **light,
    }
    return figures, words_of(measured, light)


def _history(args: argparse.Namespace, options: Options, checkpoint: Path, task: Task) -> History | None:
    """What keeps the course of the training, if it is wanted; matplotlib is asked for before the training, not after it."""
    if args.history is None:
        return None
    with needing("--history", "plot"):
        import matplotlib  # noqa: F401
    from pans.trainer.train.history import History

    return History(checkpoint, options, task.sha256)


def _options(args: argparse.Namespace, task: Task, profile: Profile) -> Options:
    """What the arguments mean for this task: its physics chooses the encoder, its question the head."""
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
    best = "exact" if min(args.outcomes or 2, 16) ** args.features <= EXACT_WORDS_MAX else "local"
    estimator = args.estimator or ("ste" if is_picture else best)
    budgets = (args.photons, args.illumination)
    alpha = args.alpha if args.alpha is not None or any(one is not None for one in budgets) else DEFAULT_ALPHA
    given: dict[str, Any] = {"optics": stated_tolerance(profile) if encoder == "active" else None}
    given |= {name: value for name in AS_GIVEN if (value := getattr(args, name)) is not None}
    if encoder != "active":
        given["conserving"] = not args.unconstrained
    elif args.unconstrained:
        raise UsageError("--unconstrained belongs to a passive encoder", remedy="leave it out")
    return Options(alpha=alpha, estimator=estimator, encoder=encoder, head=head, **given)


def _export(
    args: argparse.Namespace, task: Task, profile: Profile, trained: Trained, seconds: float, chosen: dict[str, Any]
) -> Exported:
    from pans.trainer.export.writer import export_trained
    from pans.trainer.tasks.registry import path_from, task_names

    provenance = {
        "task_argument": args.task if args.task in task_names() else Path(args.task).name,
        "data_path": path_from(args.out, args.task),
        "data_seed": args.data_seed,
        "options": plain_options(trained.options) | {"threads": args.threads, "device": args.device},
        "training_seconds": round(seconds, 1),
        **chosen,
    }
    name = args.name or args.out.stem
    return export_trained(
        args.out, trained, task, profile, name=name, provenance=provenance, force=args.force, order=args.order
    )


@contextmanager
def _progress(options: Options) -> Iterator[Callable[[EpochReport], None]]:
    """A bar and the loss so far on a terminal, else a line per tenth of the epochs; both on stderr."""
    step, steps = max(1, options.epochs // 10), options.epochs * options.restarts
    with shown_course("loss") as show:

        def told(epoch: EpochReport) -> None:
            done = epoch.restart * options.epochs + epoch.epoch
            show(_epoch_line(epoch, options), epoch.loss, done, steps, epoch.epoch % step == 0)

        yield told


def _epoch_line(epoch: EpochReport, options: Options) -> str:
    return (
        f"restart {epoch.restart + 1}/{options.restarts} epoch {epoch.epoch}/{options.epochs} {epoch.stage}: "
        f"loss {epoch.loss:.3f}, {epoch.clicks:.2f} clicks, {epoch.photons:.1f} photons, {epoch.illumination:.0f} illumination"
    )


TRAIN = Command(
    "train patterns and head through a profile, and export a bundle",
    configure_train,
    interruptible(_train),
    examples=(
        "pans train parts --features 6 --profile my-lab.toml -o parts.pans",
        "pans train fashion-mnist --features 10 --photons 8 -o fashion.pans",
    ),
)
