"""`pans train`: train patterns and head, or an automaton, through a profile, and export a bundle. All accuracies here are SIMULATED.

What both kinds of training share is here; `trainings.py` holds a class for each, with the same methods. Heavy
packages are imported when the command runs, not before.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.app.command import Command, add_new_bundle
from pans.base.console import emit, say
from pans.base.errors import EXIT_FINE, EXIT_INTERRUPTED, UsageError, as_usage_error
from pans.base.files import Reading, check_outputs
from pans.base.numbers import Range
from pans_trainer.options import (
    ENCODERS,
    SEED,
    AutomatonOptions,
    Options,
    add_unset_options,
    check_optics,
    flag_of,
    option_names,
)

from .arguments import (
    HISTORY_FILES,
    add_data_dir,
    add_reading,
    add_threads,
    displayed_progress,
    interruptible,
    needing,
    reading_from,
    torch_with,
    warn_of_laws,
)
from .evaluate import warn_of_majority
from .train_own import AUTOMATON, Finished, as_given, choose, finish, is_own, set_encoder, sheets_of

if TYPE_CHECKING:
    from .trainings import AutomatonTraining, FixedTraining

SHARED = tuple(name for name in option_names(Options) if name in option_names(AutomatonOptions))
ONLY_AUTOMATA = (*(name for name in option_names(AutomatonOptions) if name not in SHARED), "teacher", "start")
ONLY_FIXED = (*(name for name in option_names(Options) if name not in SHARED), "order", "unconstrained")


def _configure(parser: argparse.ArgumentParser) -> None:
    words = "a name (`pans data list`), a .npz file, or a folder of class folders"
    parser.add_argument("task", metavar="TASK", help=words)
    parser.add_argument("--profile", metavar="P", help="default: oled-qcmos; of an automaton ideal")
    words = "how light meets the object (default: what the task's is); automaton: each pattern follows from the clicks before it"
    parser.add_argument("--encoder", choices=(*ENCODERS, AUTOMATON), help=words)
    add_unset_options(parser, Options)
    words = "a passive encoder may give more light than it gets, as the paper's does"
    parser.add_argument("--unconstrained", action="store_true", help=words)
    words = "display the patterns in the order that tells most first, per pattern or per light that it sends"
    parser.add_argument("--order", choices=("information", "dose"), help=words)
    automata = parser.add_argument_group("of an automaton")
    add_unset_options(automata, AutomatonOptions, omit=SHARED)
    words = "the network's answers are read from there; where nothing is, they are made and kept there"
    automata.add_argument("--teacher", type=Path, metavar="FILE.npz", help=words)
    words = "train on the patterns and states of that one, instead of growing new ones"
    automata.add_argument("--start", type=Path, metavar="OLD.pans", help=words)
    words = "of a drawn task's images (default 0)"
    parser.add_argument("--data-seed", type=SEED.option, default=0, metavar="N", help=words)
    parser.add_argument("--history", type=Path, metavar="DIR", help="write and draw how the training went (extra plot)")
    words = "where to compute (default cpu); changes the random numbers"
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help=words)
    add_threads(parser)
    parser.add_argument("--resume", action="store_true", help="continue from OUT.pans.checkpoint")
    parser.add_argument("--name", metavar="NAME", help="the bundle's name (default: that of the output file)")
    add_data_dir(parser)
    own = parser.add_argument_group("of your own images")
    words = "train for the shares that the classes have in the folder (default: every class counts the same)"
    own.add_argument("--keep-shares", action="store_true", help=words)
    words = "judge so many sensors of the recipe, each on images it has not seen (default 1; 5 where a class has few images)"
    own.add_argument("--folds", type=Range(1, 5, whole=True).option, metavar="N", help=words)
    add_reading(parser)
    words = "of your own images: choose nothing from them, take the options and defaults as they are"
    parser.add_argument("--as-is", action="store_true", help=words)
    add_new_bundle(parser)


def _train(args: argparse.Namespace) -> int:
    started = time.perf_counter()
    checkpoint = args.out.with_name(args.out.name + ".checkpoint")
    own = is_own(args)
    if own:
        set_encoder(args, ONLY_FIXED)
    automaton = args.encoder == AUTOMATON
    _refuse_foreign(args, automaton, own)
    _check_files(args, checkpoint, own)
    torch_with(args.threads)
    from pans.instrument.profile import load_profile
    from pans_trainer.device import computing_on
    from pans_trainer.tasks.registry import load_task
    from pans_trainer.train.gradient.checkpoint import timed

    from .trainings import AutomatonTraining, FixedTraining

    profile = load_profile(args.profile or ("ideal" if automaton else "oled-qcmos"))
    reading = replace(reading_from(args), side=args.resize or 0) if args.as_is else reading_from(args)
    task = load_task(args.task, args.data_dir, data_seed=args.data_seed, reading=reading)
    chosen = choose(args, task, profile) if own else None
    varied, facts = (as_given(args, task), {}) if chosen is None else (chosen.task, chosen.facts)
    if args.history is not None:
        with needing("--history", "plot"):
            import matplotlib  # noqa: F401 - asked for before the training, not after it
    training: AutomatonTraining | FixedTraining
    if automaton:
        prices = {} if chosen is None else chosen.prices()
        training = AutomatonTraining(args, task, varied, profile, prices)
    else:
        training = FixedTraining(args, task, varied, profile)
    try:
        with (
            as_usage_error(),
            displayed_progress(training.quantity) as show,
            computing_on(args.device),
            timed(checkpoint, resume=args.resume) as watch,
        ):
            training.run(show, checkpoint)
    except KeyboardInterrupt:
        resumes = f"the last whole step is in {checkpoint}\n  continue with the same command and --resume"
        say(f"interrupted; {resumes if checkpoint.exists() else 'nothing was kept'}")
        return EXIT_INTERRUPTED
    with as_usage_error(), computing_on(args.device if automaton else "cpu"):
        digest, answer, lines = training.export(_provenance(args, reading, watch.seconds()) | facts)
    warn_of_laws(training.bundle, profile, one_by_one=not automaton)
    checkpoint.unlink(missing_ok=True)
    if args.history is not None:
        for path in training.write_history(args.history, args.force):
            say(f"wrote {path}")
    warn_of_majority(answer.get("by_class"), answer["photons_mean"])
    seconds = watch.seconds()
    payload = {"bundle": str(args.out), "sha256": digest, **answer, "seconds": seconds, "simulated": True}
    if chosen is not None and task.target == "class":
        options = training.options if isinstance(training, AutomatonTraining) else None
        done = Finished(training.bundle, digest, options, started, training.budget_words)
        try:
            more, lines = finish(args, task, chosen, profile, done)
        except KeyboardInterrupt:
            words = f"interrupted: the camera's figures are missing; pans evaluate {args.out} computes them"
            more, lines = {"interrupted": True}, [*lines, words]
        payload |= more
    emit(args, payload, "\n".join([f"{args.out}  {digest[:12]}  trained in {seconds:.0f} s", *lines]))
    return EXIT_INTERRUPTED if payload.get("interrupted") else EXIT_FINE


def _refuse_foreign(args: argparse.Namespace, automaton: bool, own: bool) -> None:
    """Refuse options of the other kind of training, and those that contradict each other."""
    given = [flag_of(name) for name in (ONLY_FIXED if automaton else ONLY_AUTOMATA) if _is_given(args, name)]
    if given and automaton:
        raise UsageError(f"{', '.join(given)}: not of an automaton", remedy="leave it out, or choose another --encoder")
    if given:
        raise UsageError(f"{given[0]} belongs to an automaton", remedy="add --encoder automaton, or leave it out")
    if not automaton and args.features is None and not own:
        raise UsageError("--features is missing: the number of patterns", remedy="--features 10, say")
    for one, other in (("alpha", "photons"), ("conserving", "unconstrained")):
        if _is_given(args, one) and _is_given(args, other):
            raise UsageError(f"{flag_of(one)} and {flag_of(other)} exclude each other", remedy="leave one of them out")
    if args.optics is not None:
        check_optics(args.optics)


def _is_given(args: argparse.Namespace, name: str) -> bool:
    return getattr(args, name) not in (None, False)


def _check_files(args: argparse.Namespace, checkpoint: Path, own: bool) -> None:
    """Refuse, before anything is loaded, what cannot be written in the end; a checkpoint is hours of work too."""
    inputs = [args.task, *([args.profile] if args.profile else [])]
    if checkpoint.exists() and not (args.resume or args.force):
        what = f"{checkpoint}: is here, of a training that was interrupted"
        raise UsageError(what, remedy="continue it by --resume, or replace it with --force")
    check_outputs([args.out], inputs=inputs, force=args.force)
    if own:  # what a training that was interrupted has written already
        check_outputs(sheets_of(args), inputs=inputs, force=args.force or args.resume)
    check_outputs([checkpoint], inputs=[*inputs, args.out], force=True)
    if args.history is not None:
        outputs = [args.history / name for name in HISTORY_FILES]
        check_outputs(outputs, inputs=inputs, force=args.force, makes_folders=True)


def _provenance(args: argparse.Namespace, reading: Reading, seconds: float) -> dict[str, Any]:
    """What a bundle says of the command that made it."""
    from pans_trainer.tasks.registry import path_from, task_names

    return {
        "task_argument": args.task if args.task in task_names() else Path(args.task).name,
        "data_path": path_from(args.out, args.task),
        "data_seed": args.data_seed,
        "training_seconds": round(seconds, 1),
        **({"reading": asdict(reading)} if Path(args.task).is_dir() else {}),
    }


TRAIN = Command(
    "train patterns and head through a profile, and export a bundle",
    _configure,
    interruptible(_train),
    examples=(
        "pans train parts --features 6 --profile my-lab.toml -o parts.pans",
        "pans train fashion-mnist --features 10 --photons 8 -o fashion.pans",
    ),
)
