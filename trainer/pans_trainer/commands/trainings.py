"""The two trainings of `pans train`, a class each with the same methods: from the arguments to options, and from the model to an answer.

`FixedTraining` is of fixed patterns and passive optics, `AutomatonTraining` of an automaton. All accuracies here are SIMULATED.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pans.base.errors import UsageError
from pans.bundle.sensor import Bundle, load_bundle
from pans.instrument.profile import Profile
from pans_trainer.device import keep_freed_memory
from pans_trainer.evaluate.held_out import HeldOut, as_trained, measure, trained_bleaching, trials_needed
from pans_trainer.evaluate.walks import MeasuredWalks
from pans_trainer.export.automaton import export_automaton
from pans_trainer.export.writer import export_trained
from pans_trainer.options import (
    DEFAULT_ALPHA,
    EXACT_WORDS_MAX,
    PICTURE_HEADS,
    AutomatonOptions,
    Options,
    check_options,
    check_order,
    flag_of,
    option_names,
    plain_options,
    stated_tolerance,
)
from pans_trainer.tasks.registry import Task, physical_encoder
from pans_trainer.train.automaton.budget import check_automaton_options, for_task, started_from
from pans_trainer.train.automaton.train import TrainedAutomaton, train_automaton
from pans_trainer.train.automaton.tune import Progress
from pans_trainer.train.gradient.exact_search import search
from pans_trainer.train.gradient.history import History, write_course
from pans_trainer.train.gradient.loop import EpochReport, Trained, train

from .arguments import Show
from .evaluate import passive_light, words_of

BUDGET_TOLERANCE = 0.01  # of the light or the clicks that were asked for


class FixedTraining:
    """A training of fixed patterns or of passive optics; see train.py."""

    quantity = "loss"
    budget_words: Sequence[str] = ()
    bundle: Bundle
    trained: Trained

    def __init__(self, args: argparse.Namespace, task: Task, varied: Task, profile: Profile) -> None:
        self.args, self.task, self.varied, self.profile = args, task, varied, profile
        self.options = fixed_options(args, task, profile)
        check_order(args.order, self.options)
        check_options(self.options, profile)
        given = {"--resume": args.resume, "--history": args.history, "--device cuda": args.device == "cuda"}
        if self.options.search and any(given.values()):
            what = (
                f"{next(flag for flag, value in given.items() if value)}: a search has no epochs to continue or to draw"
            )
            raise UsageError(f"{what}, and computes on the processor", remedy="leave it out, or leave --search out")
        self.history: History | None = None

    def run(self, show: Show, checkpoint: Path) -> None:
        """Train; KeyboardInterrupt passes through, with the checkpoint on disk."""
        options = self.options
        self.history = None if self.args.history is None else History(options.epochs)
        step, steps = max(1, options.epochs // 10), options.epochs * options.restarts

        def report(epoch: EpochReport) -> None:
            done = epoch.restart * options.epochs + epoch.epoch
            words = (
                f"restart {epoch.restart + 1}/{options.restarts} epoch {epoch.epoch}/{options.epochs} {epoch.stage}: "
                f"loss {epoch.loss:.3f}, {epoch.clicks:.2f} clicks, {epoch.photons:.1f} photons, "
                f"{epoch.illumination:.0f} illumination"
            )
            show(words, epoch.loss, done, steps, epoch.epoch % step == 0)
            if self.history is not None:
                self.history.add(epoch)

        if options.search:
            self.trained = search(self.varied, self.profile, options)
            return
        resume = self.args.resume
        self.trained = train(self.varied, self.profile, options, checkpoint=checkpoint, resume=resume, report=report)

    def export(self, provenance: dict[str, Any]) -> tuple[str, dict[str, Any], list[str]]:
        """Write the bundle; return its SHA-256, the answer as JSON and in lines."""
        args, trained, task, profile = self.args, self.trained, self.task, self.profile
        name, own = args.name or args.out.stem, {"threads": args.threads, "device": args.device}
        facts = provenance | {"options": plain_options(trained.options) | own}
        exported = export_trained(
            args.out, trained, task, profile, name=name, provenance=facts, force=args.force, order=args.order
        )
        bundle = self.bundle = exported.bundle
        conditions, trials, every = as_trained(bundle), trials_needed(bundle), HeldOut(task, task.test, profile)
        measured = measure(bundle, every, trials=trials, conditions=conditions)
        of_first = measure(bundle, HeldOut(task, task.test.first(200), profile), trials=trials, conditions=conditions)
        light = passive_light(bundle, every)
        figures = {
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
        return exported.sha256, figures, [words_of(measured, light)]

    def write_history(self, folder: Path, force: bool) -> list[Path]:
        """Write how the training went; return the files."""
        assert self.history is not None
        last = self.trained.quantised.patterns() if self.trained.quantised else None
        return self.history.write(folder, last, self.task.image_shape, force=force)


def fixed_options(args: argparse.Namespace, task: Task, profile: Profile) -> Options:
    """Return what the arguments mean for this task: its physics chooses the encoder, its question the head."""
    encoder, is_picture = args.encoder or physical_encoder(task), task.target == "image"
    head = args.head or ("picture" if is_picture else "mlp")
    if (head in PICTURE_HEADS) != is_picture:
        what = f"--head {head}: the task {task.name} asks for {'a picture' if is_picture else 'a class'}"
        raise UsageError(what, remedy="leave --head out")
    if encoder == "active" and task.optics != "none":
        raise UsageError(f"--encoder active: {task.name} lies behind a fibre", remedy="use --encoder coherent")
    if encoder == "active" and args.unconstrained:
        raise UsageError("--unconstrained belongs to a passive encoder", remedy="leave it out")
    given: dict[str, Any] = {"optics": stated_tolerance(profile) if encoder == "active" else None}
    given |= {name: value for name in option_names(Options) if (value := getattr(args, name)) is not None}
    given |= {"encoder": encoder, "head": head}
    given["conserving"] = encoder != "active" and not args.unconstrained
    best = "exact" if min(args.outcomes or 2, 16) ** args.features <= EXACT_WORDS_MAX else "local"
    given.setdefault("estimator", "ste" if is_picture else best)
    if args.photons is None and args.illumination is None:
        given.setdefault("alpha", DEFAULT_ALPHA)
    return Options(**given)


class AutomatonTraining:
    """A training of an automaton; see train.py."""

    quantity = "accuracy %"
    budget_words: Sequence[str] = ()  # of a budget that was missed
    bundle: Bundle
    trained: TrainedAutomaton

    def __init__(
        self, args: argparse.Namespace, task: Task, varied: Task, profile: Profile, prices: Mapping[str, float]
    ) -> None:
        self.args, self.task, self.varied, self.profile = args, task, varied, profile
        given: dict[str, Any] = {"optics": stated_tolerance(profile)}
        given |= {name: value for name in option_names(AutomatonOptions) if (value := getattr(args, name)) is not None}
        self.options = AutomatonOptions(**given | dict(prices))
        self.start: Bundle | None = None
        if args.start is not None:
            self.start, digest = load_bundle(args.start)
            self.options = started_from(self.options, self.start, digest, task, profile)
        check_automaton_options(self.options, task, profile)
        if args.teacher is not None and not for_task(self.options, task.name).soft:
            raise UsageError("--teacher: no soft targets are wanted", remedy="add --soft 0.5, say, or leave it out")
        self.reports: list[Progress] = []
        keep_freed_memory()

    def run(self, show: Show, checkpoint: Path) -> None:
        """Train; KeyboardInterrupt passes through, with the checkpoint on disk."""

        def report(step: Progress) -> None:
            self.reports.append(step)
            words = f"network for soft targets, epoch {step.done}/{step.steps}: loss {step.loss:.3f}"
            if step.stage != "network":
                words = (
                    f"{step.stage} {step.done}/{step.steps}: loss {step.loss:.3f}, accuracy {100 * step.accuracy:.1f} %, "
                    f"{step.clicks:.2f} clicks, {step.photons:.2f} photons, illumination {step.illumination:.1f}"
                )
            show(words, 100 * step.accuracy, step.done, step.steps, step.stage != "grow" or step.done % 8 == 0)

        self.trained = train_automaton(
            self.varied,
            self.profile,
            self.options,
            checkpoint=checkpoint,
            resume=self.args.resume,
            report=report,
            held_back=self.varied.kept,
            teacher=self.args.teacher,
            start=self.start,
        )

    def export(self, provenance: dict[str, Any]) -> tuple[str, dict[str, Any], list[str]]:
        """Write the bundle; return its SHA-256, the answer as JSON and in lines."""
        args, trained = self.args, self.trained
        name, own = args.name or args.out.stem, {"threads": args.threads, "device": args.device}
        facts = provenance | {"options": asdict(trained.options) | own}
        exported = export_automaton(
            args.out, trained, self.task, self.profile, name=name, provenance=facts, force=args.force
        )
        bundle = self.bundle = exported.bundle
        automaton, measured = bundle.automaton, exported.measured
        assert automaton is not None
        bleaching = trained_bleaching(bundle)
        off, missed = budget_off(trained.options, measured, bundle.illumination())
        answer = {
            **asdict(measured),
            "first_200": asdict(exported.first_200),
            "held_back": asdict(trained.held_back),
            "states": automaton.n_states,
            "patterns": bundle.n_patterns,
            "exposures": automaton.n_slots,
            "price": trained.prices[0],
            "sent_price": trained.prices[1],
            "budget_off": off,
            "bleaching": bleaching.spelled() or None,
        }
        lines = [
            f"{automaton.n_states} states, {bundle.n_patterns} patterns, at most {automaton.n_slots} exposures",
            words_of(measured, {"first_200": answer["first_200"]}),
            *([f"  {bleaching.words()}"] if bleaching.spelled() else []),
            *missed,
        ]
        self.budget_words = missed
        return exported.sha256, answer, lines

    def write_history(self, folder: Path, force: bool) -> list[Path]:
        """Write how the training went; return the files."""
        return write_course(folder, self.reports, force=force)


def budget_off(options: AutomatonOptions, found: MeasuredWalks, dose: float) -> tuple[float, list[str]]:
    """Return by which part of the budget the held-out objects get more light or clicks (negative for less), and a line where it is missed.

    `dose` is what the walk sends that sends most.

    The price was found on training objects, and dwell times have steps. Of two budgets it is the one of which more was spent: the other
    need not be used up.
    """
    spent = {"photons": found.photons_mean, "clicks": found.clicks_mean, "illumination": found.illumination}
    spent["dose_cap"] = dose
    off, name, wanted = max(
        (got / wanted - 1, name, wanted)
        for name, got in spent.items()
        if (wanted := getattr(options, name)) is not None
    )
    again = f"{flag_of(name)} {wanted / (1 + off):.4g}" if off > -1 else f"a larger {flag_of(name)}"
    words = f"{abs(off):.1%} {'above' if off > 0 else 'below'} the budget: {name} {spent[name]:.3g} of {wanted:g} on all held-out "
    return off, [f"{words}objects; to come closer, train with {again}"] if abs(off) > BUDGET_TOLERANCE else []
