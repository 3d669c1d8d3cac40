"""`pans train --encoder automaton`: train patterns that follow from the clicks before them, and export a bundle.

Owns which options an automaton takes and how the answer looks; the work is done by the packages adaptive and export. All accuracies here
are exact expectations, SIMULATED through the profile.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.cli import EXIT_FINE, EXIT_INTERRUPTED, emit, say
from pans.runtime.errors import UsageError

from .arguments import needing, shown_course, stated_tolerance, torch_with, usage_errors, warn_of_laws
from .evaluate import class_words, warn_of_majority
from .train_own import After, as_given, choose, finish

if TYPE_CHECKING:
    from pans.runtime.instrument.profile import Profile
    from pans.trainer.adaptive.options import AutomatonOptions
    from pans.trainer.adaptive.train import TrainedAutomaton
    from pans.trainer.adaptive.tune import Progress
    from pans.trainer.export.automaton import ExportedAutomaton, WalkFigures

DEFAULT_PROFILE = "ideal"
BUDGET_TOLERANCE = 0.01  # of the light or the clicks that were asked for
TAKEN = (
    "photons",
    "clicks",
    "exposures",
    "states",
    "patterns",
    "epochs",
    "seed",
    "batch",
    "shift_px",
    "offset_px",
    "copies",
    "strength",
    "decide",
    "outcomes",
    "channels",
    "exposure_price",
    "soft",
    "rate",
    "reroutes",
    "dark",
    "optics",
    "spread",
)
FOREIGN = (
    *(
        "features",
        "order",
        "bleach",
        "estimator",
        "head",
        "alpha",
        "illumination",
        "budget",
        "input_photons",
        "restarts",
        "starts",
        "warm",
    ),
    *(
        "polish",
        "similarity",
        "mix",
        "shots",
        "hidden",
        "slope",
        "clamp",
        "complex_field",
        "conserving",
        "unconstrained",
    ),
)


def train_automaton_command(args: argparse.Namespace, checkpoint: Path, own: bool = False) -> int:
    """Train as `args` say, write the bundle, and report what it decides on the held-out objects."""
    _refuse_foreign(args)
    torch_with(args.threads)
    from pans.runtime.bundle.model import load_bundle
    from pans.runtime.instrument.profile import load_profile
    from pans.trainer.adaptive.options import check_automaton_options, for_task, started_from
    from pans.trainer.adaptive.train import train_automaton
    from pans.trainer.device import computing_on, keep_freed_memory
    from pans.trainer.tasks.registry import load_task
    from pans.trainer.train.checkpoint import timed

    profile = load_profile(args.profile or DEFAULT_PROFILE)
    task = load_task(args.task, args.data_dir, data_seed=args.data_seed)
    chosen = choose(args, task, profile) if own else as_given(args, task)
    options = _options(args, profile)
    start, digest = (None, "") if args.start is None else load_bundle(args.start)
    if start is not None:
        options = started_from(options, start, digest, task, profile)
    check_automaton_options(options, task, profile)
    if args.teacher is not None and not for_task(options, task.name).soft:
        raise UsageError("--teacher: no soft targets are wanted", remedy="add --soft 0.5, say, or leave it out")
    keep_freed_memory()
    course: list[Progress] = []
    if args.history is not None:
        with needing("--history", "plot"):
            import matplotlib  # noqa: F401
    try:
        with (
            usage_errors(),
            _progress() as show,
            computing_on(args.device),
            timed(checkpoint, resume=args.resume) as watch,
        ):

            def take(told: Progress) -> None:
                course.append(told)
                show(told)

            trained = train_automaton(
                chosen.task,
                profile,
                options,
                checkpoint=checkpoint,
                resume=args.resume,
                report=take,
                held_back=chosen.task.kept,
                teacher=args.teacher,
                start=start,
            )
            exported = _export(args, trained, task, profile, watch.seconds(), chosen.facts)
    except KeyboardInterrupt:
        say(f"interrupted; the last whole step is in {checkpoint}\n  go on: the same command with --resume")
        return EXIT_INTERRUPTED
    checkpoint.unlink(missing_ok=True)
    if args.history is not None:
        from pans.trainer.train.history import write_course

        for path in write_course(args.history, course, force=args.force):
            say(f"wrote {path}")
    warn_of_laws(exported.bundle, profile)
    after = finish(args, task, profile, asdict(exported.measured)) if own else After({}, "")
    _answer(args, trained, exported, watch.seconds(), after)
    return EXIT_FINE


def _refuse_foreign(args: argparse.Namespace) -> None:
    given = [name for name in FOREIGN if getattr(args, name) not in (None, False)]
    if given:
        flags = ", ".join("--" + name.replace("_", "-") for name in given)
        raise UsageError(f"{flags}: not of an automaton", remedy="leave it out, or choose another --encoder")


def _options(args: argparse.Namespace, profile: Profile) -> AutomatonOptions:
    from pans.trainer.adaptive.options import AutomatonOptions

    given: dict[str, Any] = {"optics": stated_tolerance(profile)}
    given |= {name: value for name in TAKEN if (value := getattr(args, name)) is not None}
    return AutomatonOptions(grey=args.grey, **given)


def _export(
    args: argparse.Namespace, trained: TrainedAutomaton, task: Any, profile: Any, seconds: float, chosen: dict[str, Any]
) -> ExportedAutomaton:
    from pans.trainer.export.automaton import export_automaton
    from pans.trainer.tasks.registry import path_from, task_names

    provenance = {
        "task_argument": args.task if args.task in task_names() else Path(args.task).name,
        "data_path": path_from(args.out, args.task),
        "data_seed": args.data_seed,
        "options": asdict(trained.options) | {"threads": args.threads, "device": args.device},
        "training_seconds": round(seconds, 1),
        **chosen,
    }
    name = args.name or args.out.stem
    return export_automaton(args.out, trained, task, profile, name=name, provenance=provenance, force=args.force)


def _answer(
    args: argparse.Namespace, trained: TrainedAutomaton, exported: ExportedAutomaton, seconds: float, after: After
) -> None:
    bundle = exported.bundle
    automaton = bundle.automaton
    assert automaton is not None
    payload = {
        "bundle": str(args.out),
        "sha256": exported.sha256,
        **asdict(exported.measured),
        "first_200": asdict(exported.first_200),
        "held_back": asdict(trained.held_back),
        "states": automaton.n_states,
        "patterns": bundle.n_patterns,
        "exposures": automaton.n_slots,
        "price": trained.price,
        "budget_off": budget_off(trained.options, exported.measured),
        "seconds": seconds,
        "simulated": True,
        **after.payload,
    }
    warn_of_majority(payload["by_class"], exported.measured.photons_mean)
    lines = [
        f"{args.out}  {exported.sha256[:12]}  trained in {seconds:.0f} s",
        f"{automaton.n_states} states, {bundle.n_patterns} patterns, at most {automaton.n_slots} exposures",
        _words("all held-out objects", exported.measured),
        *class_words(payload["by_class"]),
        _words("the first 200", exported.first_200),
        *budget_words(trained.options, exported.measured),
    ]
    emit(args, payload, "\n".join([*lines, *([after.words] if after.words else [])]))


def budget_off(options: AutomatonOptions, found: WalkFigures) -> float:
    """Return by which part of the budget the held-out objects get more light or clicks; negative for less."""
    if options.photons is not None:
        return found.photons_mean / options.photons - 1
    assert options.clicks is not None
    return found.clicks_mean / options.clicks - 1


def budget_words(options: AutomatonOptions, found: WalkFigures) -> list[str]:
    """Return a line when the budget is missed: the price was found on training objects, and dwell times have steps."""
    off = budget_off(options, found)
    if abs(off) <= BUDGET_TOLERANCE:
        return []
    name, wanted = ("photons", options.photons) if options.photons is not None else ("clicks", options.clicks)
    assert wanted is not None
    again = f"--{name} {wanted / (1 + off):.4g}" if off > -1 else f"a larger --{name}"
    return [
        f"budget missed by {off:+.1%}: {wanted * (1 + off):.3g} {name} on all held-out objects, asked for {wanted:g}; "
        f"to come closer, train with {again}"
    ]


def _words(which: str, found: WalkFigures) -> str:
    return (
        f"SIMULATED accuracy {100 * found.accuracy_mean:.2f} %  ({which}: {found.objects}, exact expectation, "
        f"error from the objects {100 * found.accuracy_se_objects:.2f} points)\n"
        f"  clicks {found.clicks_mean:.3f}   photons {found.photons_mean:.2f}   illumination {found.illumination:.1f}   "
        f"exposures {found.exposures_mean:.1f}   calibration error {100 * found.expected_calibration_error:.1f} points"
    )


@contextmanager
def _progress() -> Iterator[Callable[[Progress], None]]:
    """A bar and the accuracy so far on a terminal, else a line per epoch and every eighth level; both on stderr."""
    with shown_course("accuracy %") as show:

        def told(step: Progress) -> None:
            show(_line(step), 100 * step.accuracy, step.done, step.steps, step.stage != "grow" or step.done % 8 == 0)

        yield told


def _line(told: Progress) -> str:
    if told.stage == "network":
        return f"network for soft targets, epoch {told.done}/{told.steps}: loss {told.loss:.3f}"
    return (
        f"{told.stage} {told.done}/{told.steps}: loss {told.loss:.3f}, accuracy {100 * told.accuracy:.1f} %, "
        f"{told.clicks:.2f} clicks, {told.photons:.2f} photons"
    )
