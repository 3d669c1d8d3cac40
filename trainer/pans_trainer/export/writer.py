"""From a trained model to a bundle, and the check that the bundle decides as the model does.

`export` writes the file, reads it back and raises when a score or a decision of the file differs from the torch model.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pans.base import __version__
from pans.base.errors import PansError, as_usage_error
from pans.base.files import whole_file
from pans.bundle.backends import make_decider
from pans.bundle.heads import quantise_head, read_layers
from pans.bundle.sensor import (
    GOLDEN_TOLERANCE,
    Analyser,
    BackEnd,
    Bundle,
    Shown,
    load_bundle,
    make_bundle,
    word_means,
    write_bundle,
)
from pans.instrument.optics import tolerance_of
from pans.instrument.profile import Profile
from pans_trainer.device import CHOICE
from pans_trainer.evaluate.held_out import HeldOut
from pans_trainer.evaluate.optics import OverOptics, drawn_tables, over_optics
from pans_trainer.model.encoders import ActiveIllumination
from pans_trainer.model.heads import Decoders, Heads
from pans_trainer.options import Conditions
from pans_trainer.tasks.public_sets import PUBLIC_SETS
from pans_trainer.tasks.registry import Task
from pans_trainer.train.gradient.data import encoder_input, full_scale_photoelectrons
from pans_trainer.train.gradient.loop import Trained

from .onnx_heads import DEAD_VARIANCE, head_onnx, int8_onnx
from .ordering import information_order, order_facts, reordered

JUDGED_OBJECTS = 2000
DRAWN_TABLES = 16
ALL_WORDS_MAX = 1 << 12  # a bundle holds a table up to here too
RANDOM_WORDS = 10_000  # beyond it
COMPARED_OBJECTS = 200

F64 = NDArray[np.float64]


Ordering = Callable[[Bundle], tuple[list[int], Mapping[str, Any]]]  # patterns in order, and facts of it


def with_tolerance(bundle: Bundle, task: Task, profile: Profile, optics: str | None, dark: float | None) -> Bundle:
    """Return `bundle` with the fact `tolerates`, where it was trained through `optics`; else as it is.

    `within` is over tables drawn uniformly, `edge` over the corners of shift and rotation at the widest blur and lightest black.
    """
    if optics is None or bundle.picture_shape is not None:
        return bundle
    tolerance = tolerance_of(optics)
    held_out = HeldOut(task, task.test.first(JUDGED_OBJECTS), profile)
    conditions = Conditions(dark=dark)
    tables = {
        "middle": [tolerance.middle],
        "within": drawn_tables(tolerance, DRAWN_TABLES, 0),
        "edge": tolerance.edges(),
    }
    found = {name: _rounded(over_optics(bundle, held_out, which, conditions)) for name, which in tables.items()}
    fact = {"optics": optics, "words": tolerance.words(), "simulated": True, **found}
    return replace(bundle, provenance={**bundle.provenance, "tolerates": fact})


def _rounded(found: OverOptics) -> dict[str, Any]:
    digits = {"accuracy_mean": 5, "accuracy_std_optics": 5, "accuracy_se_objects": 5, "accuracy_worst": 5}
    digits |= {"clicks_mean": 4, "photons_mean": 4, "illumination": 3}
    rounded = {name.removesuffix("_mean"): round(getattr(found, name), places) for name, places in digits.items()}
    return rounded | {"objects": found.objects, "tables": found.tables}


@dataclass(frozen=True, slots=True)
class Exported:
    """The written bundle and how far its back ends are from the torch model."""

    bundle: Bundle
    sha256: str
    words_compared: int
    score_difference: float  # the largest, over max(1, |score|)
    dead_patterns: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Description:
    """What a bundle says of itself; the names are those of `make_bundle`."""

    name: str
    task: str
    classes: tuple[str, ...]
    image_shape: tuple[int, int]
    provenance: Mapping[str, Any]
    outcomes: int = 2  # of an exposure, as `BackEnd` has it


def export(
    path: Path,
    head: Heads,
    click_mean: F64,
    optics: Shown | Analyser,
    about: Description,
    check: Callable[[Bundle], None] = lambda _: None,
    *,
    force: bool = False,
    finish: Callable[[Bundle], Bundle] = lambda bundle: bundle,
    ordering: Ordering | None = None,
) -> Exported:
    """Write the bundle to `path`, read it back and compare its back ends with `head`; PansError if they differ.

    UsageError if `path` exists, unless `force`. A wrong bundle never stands there.

    A head that returns pictures decides among no classes. `check` may refuse what was read, by PansError; `finish` may add facts to
    the bundle before it is written; `ordering` says in which order its patterns are shown, where not as they were trained.
    """
    graph, dead = head_onnx(head, click_mean)
    picture_shape = head.image_shape if isinstance(head, Decoders) else None
    layers = None if picture_shape else read_layers(graph, len(click_mean), len(about.classes))
    with as_usage_error():
        int8 = None if layers is None else quantise_head(layers)
    bundle = make_bundle(
        name=about.name,
        task=about.task,
        classes=() if picture_shape else about.classes,
        picture_shape=picture_shape,
        image_shape=about.image_shape,
        optics=optics,
        back_end=BackEnd(graph, None, int8, None if int8 is None else int8_onnx(int8), about.outcomes),
        provenance={**about.provenance, "trained_with": programs()},
    )
    places = list(range(bundle.n_features))
    with as_usage_error():
        if ordering is not None:
            places, facts = ordering(bundle)
            bundle = reordered(bundle, places, facts)
    with whole_file(path, force=force) as unchecked:
        write_bundle(finish(bundle), unchecked)
        bundle, digest = load_bundle(unchecked)
        words, difference = compare(bundle, head, click_mean, places)
        check(bundle)
    return Exported(bundle, digest, words, difference, tuple(places.index(old) for old in dead))


def origin(task: Task, profile: Profile) -> dict[str, Any]:
    """Return what a bundle says of the data and the instrument that it was trained with."""
    public = PUBLIC_SETS.get(task.name)
    return {
        **({} if public is None else {"data_licence": public.licence}),
        "data_sha256": task.sha256,
        "data_split": task.split,
        "task_light": task.light,
        "task_optics": task.optics,
        "task_source": task.source,
        "profile": profile.name,
        "profile_sha256": profile.sha256,
    }


def programs() -> str:
    """Return the programs that trained a bundle, with their versions, and what this processor computes products with."""
    computed = "" if CHOICE is None else f", {CHOICE.words()}"
    return f"pans-runtime {__version__}, torch {torch.__version__}{computed}"


def export_trained(
    path: Path,
    trained: Trained,
    task: Task,
    profile: Profile,
    *,
    name: str,
    provenance: Mapping[str, Any],
    force: bool = False,
    order: str | None = None,
) -> Exported:
    """Write what `train` returned to `path`; UsageError if it exists, unless `force`.

    `provenance` is added to what the task, profile and training say of themselves. With an `order` of `ordering.WAYS` the patterns are
    shown so, as the training objects tell.
    """
    quantised = trained.quantised
    optics: Shown | Analyser
    if quantised is None:
        optics = analyser_of(trained, task, profile)
    else:
        optics = Shown(profile.projector.levels, quantised.pattern_levels, quantised.photons_per_level)
    facts = origin(task, profile) | {"validation_losses": list(trained.validation_losses), **provenance}
    about = Description(name, task.name, task.classes, task.image_shape, facts, trained.options.outcomes)

    def ordering(bundle: Bundle) -> tuple[list[int], Mapping[str, Any]]:
        found = information_order(bundle, profile, task.train, by=order or "")
        return list(found.patterns), order_facts(found, bundle)

    return export(
        path,
        trained.head,
        trained.click_mean.numpy(),
        optics,
        about,
        lambda bundle: compare_optics(bundle, trained, task, profile),
        force=force,
        finish=lambda bundle: with_tolerance(bundle, task, profile, trained.options.optics, trained.options.dark),
        ordering=None if order is None else ordering,
    )


def analyser_of(trained: Trained, task: Task, profile: Profile) -> Analyser:
    """Return the passive optics that `train` returned, for the exposure that it assumed."""
    encoder, options = trained.encoder, trained.options
    assert not isinstance(encoder, ActiveIllumination), "it shows patterns, and has no optics of its own"
    matrix = encoder.matrix().detach().numpy()
    matrix.flags.writeable = False
    scale = full_scale_photoelectrons(task, options)
    return Analyser(options.encoder, matrix, task.light, task.optics, scale, profile.exposure.min_us)


def compare_optics(bundle: Bundle, trained: Trained, task: Task, profile: Profile) -> None:
    """Hold the light of a passive bundle against the torch encoder on held-out objects; PansError where it differs by 1e-5."""
    if bundle.analyser is None:
        return
    objects = task.test.first(COMPARED_OBJECTS)
    shown = encoder_input(task, objects, profile, trained.options)
    with torch.no_grad():
        encoder = copy.deepcopy(trained.encoder).double()
        wide = shown.to(torch.complex128 if shown.is_complex() else torch.float64)
        wanted = encoder(wide).numpy()
    difference = np.abs(bundle.analyser.photoelectrons(objects.images) - wanted) / np.maximum(1.0, wanted)
    if not difference.max() <= GOLDEN_TOLERANCE:
        raise PansError(
            f"the optics of {bundle.name} bring other light than the trained encoder: off by {difference.max():.3g} of "
            f"max(1, photoelectrons), allowed {GOLDEN_TOLERANCE:g}",
            remedy="report this with the bundle: the export is wrong",
        )


def compare(bundle: Bundle, head: Heads, click_mean: F64, places: Sequence[int] | None = None) -> tuple[int, float]:
    """Hold every back end of `bundle` against the torch head: all words where there are at most 4096, else 10 000 random ones.

    Pattern i of the bundle is pattern `places[i]` of the head (None: i). Returns the number of words and the largest score difference
    over max(1, |score|). PansError where it exceeds 1e-5 or a decision differs whose margin is clear of that (pictures have only
    scores, their pixels).
    """
    largest = bundle.largest
    if bundle.outcomes**bundle.n_features <= ALL_WORDS_MAX:
        means = word_means(np.arange(bundle.outcomes**bundle.n_features), bundle.n_features, bundle.outcomes)
    else:
        drawn = np.random.default_rng(0).integers(0, bundle.outcomes, (RANDOM_WORDS, bundle.n_features))
        means = drawn.astype(np.float32) / np.float32(largest)
    as_trained = np.empty_like(means)
    as_trained[:, list(places or range(bundle.n_features))] = means
    wanted = reference_scores(head, click_mean, as_trained)
    scale = np.maximum(1.0, np.abs(wanted))
    ranked = np.sort(wanted, axis=1)
    clear = ranked[:, -1] - ranked[:, -2] > 2 * GOLDEN_TOLERANCE * scale.max(axis=1)
    worst = 0.0
    for backend in ("onnx", "table") if bundle.table is not None else ("onnx",):
        decider = make_decider(bundle, backend=backend)
        found = decider.scores_batch(np.rint(means * largest).astype(np.int64), 1).astype(np.float64)
        difference = float((np.abs(found - wanted) / scale).max())
        clear &= bundle.picture_shape is None
        changed = int((clear & (found.argmax(axis=1) != wanted.argmax(axis=1))).sum())
        if not difference <= GOLDEN_TOLERANCE or changed:
            raise PansError(
                f"the {backend} back end of {bundle.name} differs from the trained model: scores by {difference:.3g} of "
                f"max(1, |score|), allowed {GOLDEN_TOLERANCE:g}; {changed} of {len(means)} decisions, allowed 0",
                remedy="report this with the bundle: the export is wrong",
            )
        worst = max(worst, difference)
    return len(means), worst


def reference_scores(head: Heads, click_mean: F64, means: NDArray[np.float32]) -> F64:
    """Scores of the trained head as it stands, not folded, in float64; dead patterns at their constant value."""
    variance = click_mean * (1 - click_mean)
    clicks = means.astype(np.float64)
    dead = variance < DEAD_VARIANCE
    clicks[:, dead] = click_mean[dead]
    with torch.no_grad():
        wide = copy.deepcopy(head).double()
        wide.norm.running_mean.copy_(torch.from_numpy(click_mean))
        return np.asarray(wide.eval()(torch.from_numpy(clicks)).numpy())
