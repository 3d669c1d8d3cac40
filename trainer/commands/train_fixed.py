"""`pans train` for fixed patterns and passive optics: from the arguments to `Options`, and from the model to an answer. SIMULATED."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import Bundle
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import Profile
from pans.trainer.evaluate.held_out import HeldOut, as_trained, measure, trials_needed
from pans.trainer.export.writer import export_trained
from pans.trainer.options import (
    DEFAULT_ALPHA,
    EXACT_WORDS_MAX,
    PICTURE_HEADS,
    Options,
    check_options,
    check_order,
    option_names,
    plain_options,
    stated_tolerance,
)
from pans.trainer.tasks.registry import Task, physical_encoder
from pans.trainer.train.history import History
from pans.trainer.train.loop import EpochReport, Trained, train

from .arguments import Show
from .evaluate import passive_light, words_of


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
        self.history: History | None = None

    def run(self, show: Show, checkpoint: Path) -> None:
        """Train; KeyboardInterrupt passes through, with the checkpoint on disk."""
        options = self.options
        self.history = None if self.args.history is None else History(checkpoint, options, self.varied.sha256)
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
