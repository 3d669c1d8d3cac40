"""`pans train --encoder automaton`: from the arguments to `AutomatonOptions`, and from the automaton to an answer.

All accuracies here are exact expectations, SIMULATED through the profile.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import Profile
from pans.trainer.adaptive.budget import check_automaton_options, for_task, started_from
from pans.trainer.adaptive.train import TrainedAutomaton, train_automaton
from pans.trainer.adaptive.tune import Progress
from pans.trainer.device import keep_freed_memory
from pans.trainer.evaluate.held_out import trained_bleaching
from pans.trainer.evaluate.walks import MeasuredWalks
from pans.trainer.export.automaton import export_automaton
from pans.trainer.options import AutomatonOptions, flag_of, option_names, stated_tolerance
from pans.trainer.tasks.registry import Task
from pans.trainer.train.history import write_course

from .arguments import Show
from .evaluate import words_of

BUDGET_TOLERANCE = 0.01  # of the light or the clicks that were asked for


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
    words = f"budget missed by {off:+.1%}: {name} {spent[name]:.3g} on all held-out objects, asked for {wanted:g}; "
    return off, [f"{words}to come closer, train with {again}"] if abs(off) > BUDGET_TOLERANCE else []
