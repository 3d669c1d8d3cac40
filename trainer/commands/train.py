"""`pans train`: train patterns and head through a profile, and export a bundle.

Owns the arguments and how the answer looks; the work is done by the packages train, export and evaluate. Heavy packages are imported
when the command runs, not before. All accuracies here are SIMULATED through the profile.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, Command, add_force, emit, say
from pans.runtime.errors import UsageError
from pans.runtime.outputs import check_outputs
from pans.trainer.options import (
    BUDGETS,
    DEFAULT_ALPHA,
    ENCODERS,
    ESTIMATOR_NAMES,
    EXACT_FEATURES_MAX,
    HEADS,
    PICTURE_HEADS,
    Options,
    check_options,
    check_order,
    plain_options,
)

from .arguments import (
    add_data_dir,
    add_order_and_bleach,
    add_threads,
    needing,
    stated_tolerance,
    torch_with,
    usage_errors,
)
from .course import shown_course
from .evaluate import passive_light, words_of
from .train_own import Chosen, choose, finish, is_own, set_encoder

if TYPE_CHECKING:
    from pans.runtime.instrument.profile import Profile
    from pans.trainer.export.writer import Exported
    from pans.trainer.tasks.registry import Task
    from pans.trainer.train.history import History
    from pans.trainer.train.loop import EpochReport, Trained

DEFAULT_PROFILE = "oled-qcmos"
AUTOMATON = "automaton"
# options that are numbers, with the defaults of Options: name, metavar, help
NUMBERS = (
    ("input_photons", "N", "mean photoelectrons that reach a passive encoder in one exposure"),
    ("clicks", "C", "clicks per decision to aim for, beside either"),
    ("epochs", "E", "passes over the training objects (default 60)"),
    ("restarts", "R", "trainings; the best on validation stays"),
    ("starts", "S", "runs of the first stage per restart; the best goes on"),
    ("warm", "W", "part of the epochs in the first stage"),
    ("polish", "P", "last part of the epochs, trained for decisions (default 0)"),
    (
        "spread",
        "W",
        "weight in the loss of how concentrated the light of a pattern is, for optics that are not perfect (default 0)",
    ),
    ("similarity", "S", "of pictures: share of 1 - SSIM in the loss, the rest being the squared error (default 0)"),
    ("mix", "M", "share of the loss of 2 to K shots, for patterns too (default 0)"),
    ("shots", "K", "fit the head to 1 to K shots (default 1)"),
    ("shift_px", "X", "move training images by up to X along the rows (default 0)"),
    ("offset_px", "Y", "and by up to Y across them (default 0)"),
    ("strength", "F", "of an automaton: of the distortions, times the usual (default 0.3)"),
    ("rate", "R", "of an automaton: learning rate of its last stage (default 0.01)"),
    ("decide", "F", "of an automaton: part of the last loss that counts wrong decisions (default 0.7)"),
    ("exposure_price", "P", "of an automaton: nats per exposure; walks then end early where that pays (default 0)"),
    (
        "soft",
        "W",
        "of an automaton: weight of a network's answers in the targets (default: 0.5 for fashion-mnist, else 0)",
    ),
    (
        "copies",
        "N",
        "add N distorted copies of every training image: turned, stretched, bent a little (default 0; of an automaton for mnist 20)",
    ),
    ("seed", "N", "of everything random (default 0)"),
    ("hidden", "H", "hidden units of the head (default 512)"),
    ("batch", "B", "objects per step (default 512; of an automaton 250)"),
    ("slope", "S", "slope annealing: light at the start times S"),
    ("clamp", "L", "clamp photoelectrons early in training"),
    ("dark", "R", "dark photoelectrons per exposure in training, instead of the profile's"),
)
OF_AUTOMATA = (
    *("exposures", "states", "patterns", "grey", "strength", "decide", "outcomes", "exposure_price", "soft", "teacher"),
    *("start", "rate", "reroutes"),
)
AS_GIVEN = (
    *("features", "photons", "budget", "complex_field", "optics", "bleach"),
    *(name for name, _, _ in NUMBERS if name not in OF_AUTOMATA),
)


def _configure_train(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "task", metavar="TASK", help="a name (`pans data list`), a .npz file, or a folder of class folders"
    )
    parser.add_argument("--features", type=int, metavar="D", help="number of patterns (not of an automaton)")
    parser.add_argument("--profile", metavar="P", help=f"default: {DEFAULT_PROFILE}; of an automaton ideal")
    parser.add_argument(
        "--encoder",
        choices=(*ENCODERS, AUTOMATON),
        help="how light meets the object (default: what the task's is); automaton: each pattern follows from the clicks before it",
    )
    _add_of_automata(parser)
    _add_of_fixed(parser)
    defaults = {field.name: field.default for field in fields(Options)}
    for name, metavar, words in NUMBERS:
        flag, default = "--" + name.replace("_", "-"), defaults.get(name)
        kind = float if default is None else type(default)
        parser.add_argument(flag, type=kind, metavar=metavar, help=words)
    parser.add_argument(
        "--optics",
        metavar="SPEC",
        help="train through optics drawn within this tolerance, like shift=1:rotate=2:psf=0.5..0.8:black=0.002",
    )
    parser.add_argument("--data-seed", type=int, default=0, metavar="N", help="of a drawn task's images (default 0)")
    parser.add_argument("--history", type=Path, metavar="DIR", help="write and draw how the training went (extra plot)")
    parser.add_argument(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="where to compute (default cpu); changes the random numbers",
    )
    add_threads(parser)
    parser.add_argument("--resume", action="store_true", help="go on from OUT.pans.checkpoint")
    parser.add_argument("--name", metavar="NAME", help="the bundle's name (default: that of the output file)")
    add_data_dir(parser)
    parser.add_argument(
        "--as-is",
        action="store_true",
        help="of your own images: choose nothing from them, take the options and defaults as they are",
    )
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.pans", help="the bundle to write")
    add_force(parser)


def _add_of_automata(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--exposures", type=int, metavar="T", help="of an automaton: exposures per decision (default: by the budget)"
    )
    parser.add_argument(
        "--states", type=int, metavar="S", help="of an automaton: most states per exposure (default: by the budget)"
    )
    parser.add_argument(
        "--patterns",
        type=int,
        metavar="P",
        help="of an automaton: most different patterns, which states share (default: the projector's memory)",
    )
    parser.add_argument(
        "--outcomes",
        type=int,
        metavar="K",
        help="of an automaton: outcomes of an exposure; 3: no photon, one, two or more, on a detector that counts (default 2)",
    )
    parser.add_argument(
        "--grey", action="store_true", help="of an automaton: patterns in all levels, not one bit and a brightness"
    )
    parser.add_argument(
        "--teacher",
        type=Path,
        metavar="FILE.npz",
        help="of an automaton: the network's answers are read from there; where nothing is, they are made and kept there",
    )
    parser.add_argument(
        "--reroutes", type=int, metavar="R", help="of an automaton: sweeps that move edges to better states (default 2)"
    )
    parser.add_argument(
        "--start",
        type=Path,
        metavar="OLD.pans",
        help="of an automaton: train on the patterns and states of that one, instead of growing new ones",
    )


def _add_of_fixed(parser: argparse.ArgumentParser) -> None:
    """Optics, estimator and head; the budget of light, which automata have too."""
    parser.add_argument("--complex-field", action="store_true", help="a coherent encoder's W is complex, not real")
    made = parser.add_mutually_exclusive_group()
    made.add_argument(
        "--conserving", action="store_true", help="a passive encoder gives no more light than it gets (default)"
    )
    made.add_argument(
        "--unconstrained",
        action="store_true",
        help="a passive encoder may give more light than it gets, as the paper's does",
    )
    parser.add_argument(
        "--estimator", choices=ESTIMATOR_NAMES, help="default: exact up to 12 patterns, else local; of pictures ste"
    )
    parser.add_argument(
        "--head", choices=HEADS, help="digital back end (default mlp; picture where the task asks for it)"
    )
    add_order_and_bleach(parser)
    light = parser.add_mutually_exclusive_group()
    light.add_argument(
        "--alpha", type=float, metavar="A", help="weight of the illumination in the loss (default 0.0003)"
    )
    light.add_argument("--photons", type=float, metavar="B", help="photoelectrons per decision to aim for")
    parser.add_argument(
        "--budget",
        choices=tuple(BUDGETS),
        help="how strictly --photons and --clicks hold during training (default firm)",
    )


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
    from pans.trainer.train.loop import train

    profile = load_profile(args.profile or DEFAULT_PROFILE)
    task = load_task(args.task, args.data_dir, data_seed=args.data_seed)
    chosen = choose(args, task, profile) if own else Chosen(task, {})
    options = _options(args, task, profile)
    check_order(args.order, options)
    check_options(options, profile)
    started = time.perf_counter()
    history = _history(args, options, checkpoint, chosen.task)
    try:
        with usage_errors(), _progress(options) as show, computing_on(args.device):

            def report(epoch: EpochReport) -> None:
                show(epoch)
                if history is not None:
                    history.take(epoch)

            trained = train(chosen.task, profile, options, checkpoint=checkpoint, resume=args.resume, report=report)
    except KeyboardInterrupt:
        say(f"interrupted; the last whole epoch is in {checkpoint}\n  go on: the same command with --resume")
        return EXIT_INTERRUPTED
    exported = _export(args, task, profile, trained, time.perf_counter() - started, chosen.facts)
    answer, words = _figures(exported, trained, task, profile)
    checkpoint.unlink(missing_ok=True)
    if history is not None:
        shown = trained.quantised.patterns() if trained.quantised else None
        for path in history.write(args.history, shown, task.image_shape, force=args.force):
            say(f"wrote {path}")
    seconds = time.perf_counter() - started
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
        from .course import HISTORY_FILES

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
    best = "exact" if args.features <= EXACT_FEATURES_MAX else "local"
    estimator = args.estimator or ("ste" if is_picture else best)
    alpha = args.alpha if args.alpha is not None or args.photons is not None else DEFAULT_ALPHA
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
    from pans.trainer.tasks.registry import task_names
    from pans.trainer.tasks.remembered import path_from

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
    _configure_train,
    _train,
    examples=(
        "pans train parts --features 6 --profile my-lab.toml -o parts.pans",
        "pans train fashion-mnist --features 10 --photons 8 -o fashion.pans",
    ),
)
