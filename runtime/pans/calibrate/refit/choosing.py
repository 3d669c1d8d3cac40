"""Evidence in; the old back end or a correction of it out: chosen by held-out log loss, judged on objects that the choice did not see.

A kind of correction is chosen inside the objects that it is fitted on (folds); what is reported is the whole procedure, choice included,
on outer folds. The old one stays unless the best kind is better by `CLEARLY` standard errors of the difference per object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.numbers import Z_95

from .evidence import F64, I64, Correction, Evidence, Prior, best_kappa, eigentasks, fit, log_softmax, shrunk

FOLDS = 5
CLEARLY = 3.0  # standard errors by which the best kind must beat the old one: at two, 6 of 100 draws without any change took one
PARAMETERS_MAX = 1500  # of a correction: Newton's method inverts a matrix of their square
PER_CLASS_MIN = 10  # objects: two for each fold
CURVE = (0.125, 0.25, 0.5, 1.0)  # shares of the objects at which the learning curve is measured
OLD = "old"
_SEED = 20251122  # of the folds: the same recordings give the same bundle

Chosen = NDArray[np.bool_]


class Kind(NamedTuple):
    """A kind of correction: blocks of the log-linear one, then perhaps row by row towards what was seen.

    With `tasks` the clicks are taken as their first so many eigentasks; `alone`, in place of the old scores.
    """

    blocks: tuple[str, ...]
    rows: bool = False
    tasks: int = 0
    alone: bool = False

    @property
    def name(self) -> str:
        """As reports call it."""
        if self.tasks:
            return f"{self.tasks} eigentasks" + (" alone" if self.alone else "")
        return "+".join((*self.blocks, *(("rows",) if self.rows else ())))


KINDS = (
    Kind(("bias",)),
    Kind(("bias", "scores")),
    Kind(("bias", "clicks")),
    Kind(("bias", "scores", "clicks")),
    Kind(("bias",), rows=True),
    Kind(("bias", "scores"), rows=True),
    Kind(("bias", "scores", "clicks"), rows=True),
)


@dataclass(frozen=True, slots=True, eq=False)
class Refitted:
    """What was chosen: `scores` (rows, classes) of the evidence's rows, corrected; `correction` is None where the old one stays."""

    name: str
    scores: F64
    correction: Correction | None
    trials: Mapping[str, Estimate]  # of each kind: gain in log loss per object


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean over objects and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, values: F64) -> Estimate:
        """Return the mean of `values` (objects,)."""
        spread = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
        return cls(float(values.mean()), spread / float(np.sqrt(len(values))))

    def as_json(self) -> dict[str, float | None]:
        """Return it with its 95 % interval; None for what is not known."""
        value, half = self.value, Z_95 * self.error
        figures = {"value": value, "low": value - half, "high": value + half, "error": self.error}
        return {name: figure if math.isfinite(figure) else None for name, figure in figures.items()}


def compared(old: tuple[F64, F64], new: tuple[F64, F64]) -> dict[str, Estimate]:
    """Return the estimates of accuracy and log loss, old, new and gain, of the losses and right decisions (objects,) of both."""
    (old_loss, old_right), (new_loss, new_right) = old, new
    columns = {"accuracy_old": old_right, "accuracy_new": new_right, "accuracy_gain": new_right - old_right}
    columns |= {"log_loss_old": old_loss, "log_loss_new": new_loss, "log_loss_gain": old_loss - new_loss}
    return {name: Estimate.of(values) for name, values in columns.items()}


class Judged(NamedTuple):
    """Held-out figures of old and new, and the learning curve: at `sizes` objects the accuracies `curve`."""

    figures: dict[str, Estimate]  # as of `compared`
    sizes: tuple[int, ...]
    curve: tuple[Estimate, ...]
    more_gain: Estimate  # in accuracy, from twice as many objects, by the upper half of the curve
    chosen: tuple[str, ...]  # in each outer fold


def kinds_for(evidence: Evidence, *, rows: bool) -> tuple[Kind, ...]:
    """Return the kinds that this evidence can be fitted with; `rows` says whether each row may have a posterior of its own."""
    n_clicks = evidence.clicks.shape[1]
    known = eigentasks(evidence) is not None
    numbers = {min(1 << power, n_clicks) for power in range(1, n_clicks.bit_length() + 1)} if known else set()
    found = []
    for kind in (
        *KINDS,
        *(Kind(("bias", "clicks"), False, n, alone) for alone in (False, True) for n in sorted(numbers)),
    ):
        features = {"bias": 1, "scores": evidence.n_classes, "clicks": kind.tasks or n_clicks}
        fits = evidence.n_classes * sum(features[block] for block in kind.blocks) <= PARAMETERS_MAX
        if fits and (rows or not kind.rows) and (n_clicks or "clicks" not in kind.blocks):
            found.append(kind)
    return tuple(found)


def choose(evidence: Evidence, kinds: tuple[Kind, ...], objects: Chosen | None = None) -> Refitted:
    """Return the best of `kinds`, fitted to the `objects` (all unless given), or the old scores where none is clearly better."""
    chosen = np.ones(evidence.n_objects, bool) if objects is None else objects
    old, _ = evidence.losses(evidence.scores)
    fold = evidence.folds(FOLDS, chosen, np.random.default_rng(_SEED))
    tasks = eigentasks(evidence, chosen) if any(kind.tasks for kind in kinds) else None
    tried = [kind for kind in kinds if not kind.tasks or tasks is not None]
    gains = {kind: Estimate.of((old - _held_out_loss(evidence, kind, fold, tasks))[chosen]) for kind in tried}
    trials = {kind.name: gain for kind, gain in gains.items()}
    best = max(gains, key=lambda kind: gains[kind].value, default=None)
    if best is None or not gains[best].value > CLEARLY * gains[best].error:
        return Refitted(OLD, evidence.scores, None, trials)
    return fitted(evidence, best, chosen, trials)


def fitted(evidence: Evidence, kind: Kind, chosen: Chosen, trials: Mapping[str, Estimate] = {}) -> Refitted:
    """Return the correction of this kind, fitted to the objects `chosen` (objects,)."""
    counts = evidence.counts(chosen)
    correction, _ = _fit(evidence, kind, counts, eigentasks(evidence, chosen) if kind.tasks else None)
    return Refitted(kind.name, _with_rows(evidence, kind, correction, counts), correction, trials)


def _fit(
    evidence: Evidence, kind: Kind, counts: F64, tasks: F64 | None, prior: Prior | None = None
) -> tuple[Correction, Prior]:
    """Fit to `counts`; a head on eigentasks is given back as one on clicks, `alone` as one that takes the old scores away."""
    scores, clicks = evidence.scores, evidence.clicks
    if not kind.tasks:
        return fit(kind.blocks, scores, clicks, counts, prior)
    assert tasks is not None  # kinds of tasks are tried where there are some
    readout = tasks[:, : kind.tasks]
    found, prior = fit(kind.blocks, np.zeros_like(scores) if kind.alone else scores, clicks @ readout, counts, prior)
    gain = readout @ found.gain
    if not kind.alone:
        return replace(found, gain=gain), prior
    gain = np.concatenate([-np.eye(evidence.n_classes), gain])
    return replace(found, blocks=("bias", "scores", "clicks"), gain=gain), prior


def _with_rows(evidence: Evidence, kind: Kind, correction: Correction, counts: F64) -> F64:
    scores = correction.apply(evidence.scores, evidence.clicks)
    if not kind.rows:
        return scores
    believed = np.exp(log_softmax(scores))
    return np.log(shrunk(believed, counts, best_kappa(believed, counts)))


def _held_out_loss(evidence: Evidence, kind: Kind, fold: I64, tasks: F64 | None) -> F64:
    """Return the log loss of each object, fitted without its fold; nan outside the folds.

    The prior's width is that of all folds, and so are the eigentasks, which know no labels.
    """
    prior: Prior | None = _fit(evidence, kind, evidence.counts(fold >= 0), tasks)[1]
    found = np.full(evidence.n_objects, np.nan)
    for held in range(FOLDS):
        others = evidence.counts((fold >= 0) & (fold != held))
        correction, _ = _fit(evidence, kind, others, tasks, prior)
        found[fold == held] = evidence.losses(_with_rows(evidence, kind, correction, others))[0][fold == held]
    return found


def judge(evidence: Evidence, kinds: tuple[Kind, ...]) -> Judged:
    """Return held-out figures of the procedure `choose`: each outer fold is judged by what was chosen and fitted on the others."""
    n = evidence.n_objects
    outer = evidence.folds(FOLDS, np.ones(n, bool), np.random.default_rng(_SEED + 1))
    old = evidence.losses(evidence.scores)
    loss, right = np.empty((2, len(CURVE), n))
    chosen = []
    for held in range(FOLDS):
        here = outer == held
        order = _in_turn(evidence, ~here, np.random.default_rng(_SEED + 2 + held))
        for step, share in enumerate(CURVE):
            part = np.zeros(n, bool)
            part[order[: max(1, round(share * len(order)))]] = True
            found = None
            # with less than one object of each class and fold the old back end stands for a fit in the curve
            if min(count for count, known in zip(evidence.per_class(part), evidence.per_class()) if known) >= 2:
                found = choose(evidence, kinds, part)
                chosen += [found.name] if share == 1.0 else []
            after, hit = old if found is None else evidence.losses(found.scores)
            loss[step, here], right[step, here] = after[here], hit[here]
    sizes = tuple(round(share * n * (FOLDS - 1) / FOLDS) for share in CURVE)
    # the loss of a fitted model falls as its parameters over the objects: a straight line in 1 / objects
    inverse = 1 / np.array(sizes[1:], np.float64)
    inverse -= inverse.mean()
    more_gain = Estimate.of(-(inverse @ right[1:] / (inverse**2).sum()) / (2 * n))
    curve = tuple(Estimate.of(values) for values in right)
    return Judged(compared(old, (loss[-1], right[-1])), sizes, curve, more_gain, tuple(chosen))


def _in_turn(evidence: Evidence, chosen: Chosen, rng: np.random.Generator) -> I64:
    """Return the chosen objects in an order of which every beginning has the classes in about the same shares."""
    objects = rng.permutation(np.flatnonzero(chosen))
    place = np.empty(len(objects))
    for label in range(evidence.n_classes):
        of_class = np.flatnonzero(evidence.classes[objects] == label)
        place[of_class] = (np.arange(len(of_class)) + 0.5) / max(1, len(of_class))
    return objects[np.argsort(place, kind="stable")]
