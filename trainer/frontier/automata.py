"""Automata for the frontier: trained once, kept as bundles in the cache, measured exactly.

Owns the bundle's place and what is asked of one found there: the recipe must be the present one. Training and export are those of
`pans train --encoder automaton`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pans.runtime.bundle.model import Bundle, load_bundle
from pans.runtime.instrument.profile import load_profile
from pans.trainer.paper.page import Asked, Row, check_cached_bundle
from pans.trainer.paper.tables import FIRST, FIRST_OBJECTS
from pans.trainer.tasks.registry import Task

if TYPE_CHECKING:
    from pans.trainer.adaptive.options import AutomatonOptions

PROFILE = "ideal"
OLDER = {"soft": 0.0, "decide": 0.0}  # options whose default does what bundles from before them did not


def bundle_path(cache: Path, stem: str, seed: int) -> Path:
    """Return where the automaton of a point (`Point.stem`) and seed is kept."""
    return cache / f"{stem}-seed{seed}.pans"


def automaton_row(
    asked: Asked, path: Path, task: Task, budget: Mapping[str, Any], seed: int, start: Path | None = None
) -> Row:
    """Return the figures of the automaton of that budget (see `automaton_recipe`) in `path`, trained now unless it is there.

    With `start` the automaton in that bundle is trained on instead of one that grows.
    """
    from pans.trainer.evaluate.accuracy import row_of
    from pans.trainer.export.automaton import measure_walks

    train_unless_kept(asked, path, task, budget, seed, start)
    bundle, digest = load_bundle(path)
    assert bundle.automaton is not None
    profile = load_profile(PROFILE)
    whole, first = (row_of(measure_walks(bundle, task.test.first(count), profile)) for count in (None, FIRST_OBJECTS))
    facts: Row = {"sha256": digest, "states": bundle.automaton.n_states, "patterns_shown": len(bundle.pattern_levels)}
    seconds = bundle.provenance.get("training_seconds")  # not known of one that was interrupted
    return facts | {"all": whole, FIRST: first, "exposures": whole["exposures_mean"], "training_seconds": seconds}


def train_unless_kept(
    asked: Asked, path: Path, task: Task, budget: Mapping[str, Any], seed: int, start: Path | None = None
) -> None:
    """Train the automaton of that budget into `path`, unless one of the same recipe (and of the same `start`) is there."""
    begun = None if start is None else load_bundle(start)
    options = automaton_recipe(task.name, budget, seed)
    if begun is not None:
        options = _going_on(task, budget, seed, *begun)
    if _trained(path, options) is None:
        _train(asked, path, task, options, None if begun is None else begun[0])


def automaton_recipe(task: str, budget: Mapping[str, Any], seed: int) -> AutomatonOptions:
    """Return the options for a budget (`photons` or `clicks`) and what else is given; defaults of budget and task are spelt out."""
    from pans.trainer.adaptive.options import AutomatonOptions, for_task, with_defaults

    options = AutomatonOptions(seed=seed, **budget)
    exposures, states = with_defaults(options, load_profile(PROFILE))
    return for_task(replace(options, exposures=exposures, states=states), task)


def _going_on(task: Task, budget: Mapping[str, Any], seed: int, start: Bundle, sha256: str) -> AutomatonOptions:
    from pans.trainer.adaptive.options import AutomatonOptions, for_task, started_from

    options = AutomatonOptions(seed=seed, **budget)
    return for_task(started_from(options, start, sha256, task, load_profile(PROFILE)), task.name)


def _trained(path: Path, options: AutomatonOptions) -> Bundle | None:
    """The bundle at `path` if it is an automaton trained by `options` on the profile, else None."""
    if not path.is_file():
        return None
    bundle, _ = load_bundle(path)
    same = made_so(asdict(options), bundle.provenance.get("options")) and bundle.provenance.get("profile") == PROFILE
    return bundle if same and bundle.automaton is not None else None


def made_so(wanted: Mapping[str, Any], found: Any) -> bool:
    """Return whether what `found` was made with is what is `wanted`: an option newer than it was not used in it, or at its default.

    More than that may stand in `found`: `pans train` adds threads and device.
    """
    from pans.trainer.adaptive.options import GREY_EPOCHS, AutomatonOptions

    if not isinstance(found, dict):
        return False
    had, wants = asdict(AutomatonOptions()) | OLDER | found, dict(wanted)
    for options in (had, wants):  # spelt out in older ones
        if "tune_epochs" in options and options["tune_epochs"] is None:
            options["tune_epochs"] = GREY_EPOCHS  # without optics, which `PROFILE` does not state
    begun, found_begun = wants.get("start"), had["start"]
    if isinstance(begun, Mapping):  # the recipe of what it was trained on from
        if not made_so(begun, found_begun):
            return False
        wants["start"] = found_begun
    return wants.items() <= had.items()


def _train(asked: Asked, path: Path, task: Task, options: AutomatonOptions, start: Bundle | None) -> None:
    from pans.trainer.adaptive.train import train_automaton
    from pans.trainer.device import keep_freed_memory
    from pans.trainer.export.automaton import export_automaton

    check_cached_bundle(path)
    keep_freed_memory()
    started, profile, checkpoint = time.process_time(), load_profile(PROFILE), path.with_suffix(".checkpoint")
    teacher = asked.cache / f"frontier-{task.name}-soft-targets.npz"  # of all seeds

    def said(progress: Any) -> None:
        if progress.done % 8 == 0:
            asked.report(f"{path.stem}: {progress.stage}, {progress.done} of {progress.steps}")

    goes_on = checkpoint.is_file()
    trained = train_automaton(
        task, profile, options, checkpoint=checkpoint, resume=goes_on, report=said, teacher=teacher, start=start
    )
    seconds = time.process_time() - started
    provenance: dict[str, Any] = {"command": "pans reproduce frontier", "options": asdict(options)}
    provenance |= {"training_seconds": round(seconds, 1)} if not goes_on else {}
    export_automaton(path, trained, task, profile, name=path.stem, provenance=provenance, force=True)
    checkpoint.unlink(missing_ok=True)
