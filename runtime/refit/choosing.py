"""The old back end or a correction of it: chosen by held-out log loss, judged on objects that the choice did not see.

Owns the kinds of correction, the choice among them and the old one, and how much more labels would help. A kind is chosen inside the
objects it is fitted on (folds); what is reported is the whole procedure, choice included, on outer folds. The old one stays unless the
best kind is better by `CLEARLY` standard errors of the difference per object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .eigentasks import Eigentasks, eigentasks
from .evidence import F64, I64, Evidence, best_kappa, log_softmax, shrunk
from .loglinear import Correction, Prior, fit, n_parameters

FOLDS = 5
CLEARLY = 3.0  # standard errors by which the best kind must beat the old one: at two, 6 of 100 draws without any change took one
PARAMETERS_MAX = 1500  # of a correction: Newton's method inverts a matrix of their square
PER_CLASS_MIN = 10  # objects: two for each fold
CURVE = (0.125, 0.25, 0.5, 1.0)  # shares of the objects at which the learning curve is measured
_SEED = 20251122  # of the folds: the same recordings give the same bundle

Chosen = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of correction: blocks of the log-linear one, then perhaps row by row towards what was seen.

    With `tasks` the clicks are taken as their first so many eigentasks; `alone`, as a head of its own in place of the old scores.
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
OLD = "old"


@dataclass(frozen=True, slots=True, eq=False)
class Refitted:
    """What was chosen: `scores` (rows, classes) of the evidence's rows, corrected; `correction` is None where the old one stays.

    `kappa` is infinite where single rows are not drawn towards what was seen.
    """

    name: str
    scores: F64
    correction: Correction | None
    kappa: float
    trials: dict[str, tuple[float, float]]  # of each kind: gain in log loss per object, and its standard error


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


class Judged(NamedTuple):
    """Held-out figures of old and new, and the learning curve: at `sizes` objects the accuracies `curve`."""

    old_accuracy: Estimate
    new_accuracy: Estimate
    accuracy_gain: Estimate
    old_loss: Estimate
    new_loss: Estimate
    loss_gain: Estimate
    sizes: tuple[int, ...]
    curve: tuple[Estimate, ...]
    more_objects: int  # twice as many as there are
    more_gain: Estimate  # in accuracy, from that many, by the curve's course in 1 / objects
    chosen: tuple[str, ...]  # in each outer fold


def kinds_for(evidence: Evidence, *, rows: bool) -> tuple[Kind, ...]:
    """Return the kinds that this evidence can be fitted with; `rows` says whether each row may have a posterior of its own."""
    n_clicks = evidence.clicks.shape[1]
    return tuple(
        kind
        for kind in (*KINDS, *_of_tasks(evidence))
        if (rows or not kind.rows)
        and (n_clicks or "clicks" not in kind.blocks)
        and n_parameters(kind.blocks, evidence.n_classes, kind.tasks or n_clicks) <= PARAMETERS_MAX
    )


def _of_tasks(evidence: Evidence) -> tuple[Kind, ...]:
    """Heads on 2, 4, 8, ... and on all eigentasks, where noise can be told from signal: beside the old scores, and alone."""
    if eigentasks(evidence) is None:
        return ()
    n_clicks = evidence.clicks.shape[1]
    numbers = {min(1 << power, n_clicks) for power in range(1, n_clicks.bit_length() + 1)}
    return tuple(Kind(("bias", "clicks"), False, n, alone) for alone in (False, True) for n in sorted(numbers))


def choose(evidence: Evidence, kinds: tuple[Kind, ...], objects: Chosen | None = None) -> Refitted:
    """Return the best of `kinds`, fitted to the `objects` (all unless given), or the old scores where none is clearly better."""
    chosen = np.ones(evidence.n_objects, bool) if objects is None else objects
    old, _ = evidence.losses(evidence.scores)
    trials: dict[str, tuple[float, float]] = {}
    fold = evidence.folds(FOLDS, chosen, np.random.default_rng(_SEED))
    tasks = eigentasks(evidence, chosen) if any(kind.tasks for kind in kinds) else None
    for kind in kinds:
        if kind.tasks and tasks is None:
            continue  # too few of these objects were shown again
        gain = Estimate.of((old - _held_out_loss(evidence, kind, fold, tasks))[chosen])
        trials[kind.name] = gain.value, gain.error
    tried = (kind for kind in kinds if kind.name in trials)
    best = max(tried, key=lambda kind: trials[kind.name][0], default=None)
    if best is None or not trials[best.name][0] > CLEARLY * trials[best.name][1]:
        return Refitted(OLD, evidence.scores, None, np.inf, trials)
    found = fitted(evidence, best, chosen)
    return Refitted(best.name, found.scores, found.correction, found.kappa, trials)


def fitted(evidence: Evidence, kind: Kind, chosen: Chosen) -> Refitted:
    """Return the correction of this kind, fitted to the objects `chosen` (objects,)."""
    counts = evidence.counts(chosen)
    correction, _ = _fit(evidence, kind, counts, eigentasks(evidence, chosen) if kind.tasks else None)
    return _with_rows(evidence, kind, correction, counts)


def _fit(
    evidence: Evidence, kind: Kind, counts: F64, tasks: Eigentasks | None, prior: Prior | None = None
) -> tuple[Correction, Prior]:
    """Fit to `counts` (rows, classes); a head on eigentasks is given back as one on clicks, alone as one that takes the old scores away."""
    if not kind.tasks:
        return fit(kind.blocks, evidence.scores, evidence.clicks, counts, prior)
    assert tasks is not None, "eigentasks are offered where there are some"
    readout = tasks.readout[:, : kind.tasks]
    beside = np.zeros_like(evidence.scores) if kind.alone else evidence.scores
    found, prior = fit(kind.blocks, beside, evidence.clicks @ readout, counts, prior)
    gain = readout @ found.gain
    if not kind.alone:
        return Correction(found.blocks, gain, found.offset, found.precision), prior
    gain = np.concatenate([-np.eye(evidence.n_classes), gain])
    return Correction(("bias", "scores", "clicks"), gain, found.offset, found.precision), prior


def _with_rows(evidence: Evidence, kind: Kind, correction: Correction, counts: F64) -> Refitted:
    scores, kappa = correction.apply(evidence.scores, evidence.clicks), np.inf
    if kind.rows:
        believed = np.exp(log_softmax(scores))
        kappa = best_kappa(believed, counts)
        scores = np.log(shrunk(believed, counts, kappa))
    return Refitted(kind.name, scores, correction, kappa, {})


def _held_out_loss(evidence: Evidence, kind: Kind, fold: I64, tasks: Eigentasks | None) -> F64:
    """Return the log loss of each object, fitted without its fold; nan outside the folds.

    The prior's width is that of all folds, and so are the eigentasks, which know no labels.
    """
    counts = evidence.counts(fold >= 0)
    _, prior = _fit(evidence, kind, counts, tasks)
    found = np.full(evidence.n_objects, np.nan)
    for held in range(FOLDS):
        others = evidence.counts((fold >= 0) & (fold != held))
        correction, _ = _fit(evidence, kind, others, tasks, prior)
        scores = _with_rows(evidence, kind, correction, others).scores
        found[fold == held] = evidence.losses(scores)[0][fold == held]
    return found


def judge(evidence: Evidence, kinds: tuple[Kind, ...]) -> Judged:
    """Return held-out figures of the procedure `choose`: each outer fold is judged by what was chosen and fitted on the others."""
    n = evidence.n_objects
    everything = np.ones(n, bool)
    outer = evidence.folds(FOLDS, everything, np.random.default_rng(_SEED + 1))
    old_loss, old_right = evidence.losses(evidence.scores)
    loss, right = np.empty(n), np.empty((len(CURVE), n))
    chosen = []
    for held in range(FOLDS):
        here = outer == held
        order = _in_turn(evidence, ~here, np.random.default_rng(_SEED + 2 + held))
        for step, share in enumerate(CURVE):
            part = np.zeros(n, bool)
            part[order[: max(1, round(share * len(order)))]] = True
            found = choose(evidence, kinds, part) if _enough(evidence, part) else None
            after, hit = evidence.losses(evidence.scores if found is None else found.scores)
            right[step, here] = hit[here]
            if share == 1.0 and found is not None:
                loss[here] = after[here]
                chosen.append(found.name)
    sizes = tuple(round(share * n * (FOLDS - 1) / FOLDS) for share in CURVE)
    return Judged(
        Estimate.of(old_right),
        Estimate.of(right[-1]),
        Estimate.of(right[-1] - old_right),
        Estimate.of(old_loss),
        Estimate.of(loss),
        Estimate.of(old_loss - loss),
        sizes,
        tuple(Estimate.of(values) for values in right),
        2 * n,
        Estimate.of(_course(sizes, n, 2 * n) @ right),
        tuple(chosen),
    )


def _in_turn(evidence: Evidence, chosen: Chosen, rng: np.random.Generator) -> I64:
    """Return the chosen objects in an order of which every beginning has the classes in about the same shares."""
    objects = rng.permutation(np.flatnonzero(chosen))
    place = np.empty(len(objects))
    for label in range(evidence.n_classes):
        of_class = np.flatnonzero(evidence.classes[objects] == label)
        place[of_class] = (np.arange(len(of_class)) + 0.5) / max(1, len(of_class))
    return objects[np.argsort(place, kind="stable")]


def _enough(evidence: Evidence, chosen: Chosen) -> bool:
    """Whether a part is fitted at all: one object of each class and fold, or the old back end stands for it in the curve."""
    seen = np.bincount(evidence.classes[chosen], minlength=evidence.n_classes)
    return bool(seen[np.bincount(evidence.classes, minlength=evidence.n_classes) > 0].min() >= 2)


def _course(sizes: tuple[int, ...], now: int, later: int) -> F64:
    """Return what the accuracies at `sizes` are weighted with for the change from `now` to `later` objects, (sizes,).

    The loss of a fitted model falls as its parameters over the objects: a straight line in 1 / objects, through the upper half of the
    sizes, where the curve has left its beginning.
    """
    inverse = 1.0 / np.array(sizes, np.float64)
    upper = np.arange(len(sizes)) >= len(sizes) // 2 - 1
    centred = np.where(upper, inverse - inverse[upper].mean(), 0.0)
    return np.asarray(centred / (centred**2).sum() * (1.0 / later - 1.0 / now))
