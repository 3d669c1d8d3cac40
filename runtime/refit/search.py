"""The search of `pans tune`: step by step, each accepted only where the same objects say so beyond chance.

Owns the order of the candidates, the test, the budget and the journal of trials. A journal that is given again is followed without
measuring, up to its end: that is how a search is resumed. Patterns and devices are behind `measure`.

For each parameter in turn a step up and a step down are tried. A step is accepted if the mean of the paired differences of log loss over
the objects is above `CLEARLY` standard errors; it is tried again in the same direction next. Steps that look better, too little for that,
are tried together at the end of the round: a table is seldom off in one way alone. They are better by `PERHAPS` standard errors, or at
all and clearly better than the opposite step. A round without a step halves all steps. Each round but the first begins with what has been
reached, once more, so that a lucky trial does not stand for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.errors import DamagedFileError, PlanError

from .evidence import F64
from .moves import FIRST_STEP, LAST_STEP, STILL, Move

CLEARLY = 2.33  # standard errors: one step in a hundred that changes nothing is accepted
PERHAPS = 1.0
HELD_OUT_EVERY = 5  # objects: of each five, one is kept for the comparison at the end


@dataclass(frozen=True, slots=True)
class Cost:
    """What trials have taken: photons (clicks where the instrument does not tell photons), seconds of the instrument."""

    photons: float = 0.0
    seconds: float = 0.0

    def plus(self, other: Cost) -> Cost:
        """Return the sum."""
        return Cost(self.photons + other.photons, self.seconds + other.seconds)


@dataclass(frozen=True, slots=True)
class Budget:
    """The most that all trials together may take; infinite by default."""

    photons: float = math.inf
    seconds: float = math.inf

    def allows(self, spent: Cost, more: Cost, times: int) -> bool:
        """Whether `times` trials that cost as `more` did fit beside what is `spent`."""
        return (
            spent.photons + times * more.photons <= self.photons
            and spent.seconds + times * more.seconds <= self.seconds
        )


@dataclass(frozen=True, slots=True)
class Step:
    """One trial of the journal: the move, what it cost, each object's loss (None: unknown), and whether the device could show it."""

    move: Move
    cost: Cost
    loss: tuple[float | None, ...]
    possible: bool = True

    def as_json(self) -> dict[str, Any]:
        """Return it for the checkpoint."""
        return {
            "move": asdict(self.move),
            "cost": asdict(self.cost),
            "loss": list(self.loss),
            "possible": self.possible,
        }

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Step:
        """Invert `as_json`; DamagedFileError if it is not of that form."""
        try:
            move = Move(**{name: float(value) for name, value in facts["move"].items()})
            cost = Cost(**{name: float(value) for name, value in facts["cost"].items()})
            loss = tuple(None if value is None else float(value) for value in facts["loss"])
            return cls(move, cost, loss, bool(facts["possible"]))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DamagedFileError(f"a trial of the checkpoint cannot be read: {error}") from error


Measure = Callable[[Move, int], tuple[F64, Cost]]
Keep = Callable[[list[Step]], None]


class OutOfBudget(Exception):
    """The next trial, and the comparison at the end, would take more than is allowed."""


class Search:
    """A search that goes on from its journal; `best` is what has been reached, at any time."""

    def __init__(self, names: tuple[str, ...], n_objects: int, budget: Budget, measure: Measure, keep: Keep) -> None:
        self.names, self.budget = names, budget
        self.best, self.accepted, self.ended = STILL, 0, ""
        self.steps: dict[str, float] = {name: FIRST_STEP[name] for name in names}
        self.journal: list[Step] = []
        self.held_out = held_out_of(n_objects)
        self._measure, self._keep = measure, keep
        self._n, self._followed, self._times = n_objects, 0, 0
        self._here: F64 = np.full(n_objects, np.nan)
        self._errors: list[float] = []  # of the differences between trials

    @property
    def spent(self) -> Cost:
        """What all trials have taken."""
        total = Cost()
        for step in self.journal:
            total = total.plus(step.cost)
        return total

    @property
    def resolution(self) -> float:
        """The least gain in log loss that these objects can tell from chance in one trial; nan before two trials."""
        return CLEARLY * float(np.median(self._errors)) if self._errors else math.nan

    def run(self) -> None:
        """Search until the steps are too small to tell, or the budget is spent (`ended` says which)."""
        try:
            self._reach(STILL, self._try(STILL))
            while self._round() or self._halve():
                self._times += 1
                self._here = self._here + (self._try(self.best) - self._here) / self._times
            self.ended = "the smallest steps change nothing more"
        except OutOfBudget:
            self.ended = "the budget is spent"

    def _reach(self, move: Move, loss: F64) -> None:
        self.best, self._here, self._times = move, loss, 1

    def _halve(self) -> bool:
        """Halve all steps; False where they are the last ones already."""
        if all(self.steps[name] / 2 < LAST_STEP[name] - 1e-12 for name in self.names):
            return False
        self.steps = {name: max(step / 2, LAST_STEP[name]) for name, step in self.steps.items()}
        return True

    def _round(self) -> bool:
        """Try each parameter once, up and down, then what was promising together; return whether a step was accepted."""
        accepted, promising = self.accepted, dict[str, float]()
        for name in self.names:
            moved, step = self._both_ways(name)
            if not moved and step:
                promising[name] = step
        if promising:
            self._accepts(promising)
        return self.accepted > accepted

    def _both_ways(self, name: str) -> tuple[bool, float]:
        """Try a step up and a step down; return whether one was accepted, else the one that is promising, 0 for none."""
        gains, losses = [], []
        for step in (self.steps[name], -self.steps[name]):
            gain, loss = self._accepts({name: step})
            if gain > CLEARLY:
                while self._accepts({name: step})[0] > CLEARLY:
                    pass
                return True, 0.0
            gains.append(gain)
            losses.append(loss)
        better = int(gains[1] > gains[0])
        step = (self.steps[name], -self.steps[name])[better]
        against = _in_errors(*paired(losses[1 - better], losses[better], ~self.held_out))
        return False, step if gains[better] > PERHAPS or (gains[better] > 0 and against > CLEARLY) else 0.0

    def _accepts(self, steps: Mapping[str, float]) -> tuple[float, F64]:
        """Try `steps` from the best move, and go there if that is clearly better; return by how many standard errors, and the losses."""
        candidate = self.best
        for name, step in steps.items():
            candidate = candidate.by(name, step)
        loss = self._try(candidate)
        gain, error = paired(self._here, loss, ~self.held_out)
        if math.isfinite(error):
            self._errors.append(error)
        clear = _in_errors(gain, error)
        if clear > CLEARLY:
            self._reach(candidate, loss)
            self.accepted += 1
        return clear, loss

    def _try(self, move: Move) -> F64:
        """Return each object's loss under `move`: from the journal as far as it goes, then measured."""
        place = self._followed
        self._followed += 1
        if place < len(self.journal):
            step = self.journal[place]
            if step.move != move or len(step.loss) != self._n:
                raise DamagedFileError(f"trial {place} of the checkpoint is {step.move.words()}, here {move.words()}")
            return _losses(step, self._n)
        if self.journal:
            dearest = max((step.cost for step in self.journal), key=lambda cost: (cost.photons, cost.seconds))
            if not self.budget.allows(self.spent, dearest, 3):  # this one, and two for the comparison at the end
                raise OutOfBudget
        try:
            loss, cost = self._measure(move, place)
            kept = tuple(float(value) if math.isfinite(value) else None for value in loss)
            step = Step(move, cost, kept)
        except PlanError:
            if move == STILL:
                raise
            step = Step(move, Cost(), (None,) * self._n, possible=False)
        self.journal.append(step)
        self._keep(self.journal)
        return _losses(step, self._n)


def held_out_of(n_objects: int) -> NDArray[np.bool_]:
    """Return which objects are kept for the comparison at the end, (objects,)."""
    return np.asarray(np.arange(n_objects) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1)


def paired(old: F64, new: F64, chosen: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the mean of `old` - `new` over the chosen objects that both know, and its standard error; (0, inf) below two of them."""
    both = chosen & np.isfinite(old) & np.isfinite(new)
    difference = (old - new)[both]
    if len(difference) < 2:
        return 0.0, math.inf
    return float(difference.mean()), float(difference.std(ddof=1) / math.sqrt(len(difference)))


def _in_errors(gain: float, error: float) -> float:
    """Return a gain in standard errors; infinite where there is no error at all."""
    return gain / error if error > 0 else math.copysign(math.inf, gain) if gain else 0.0


def _losses(step: Step, n: int) -> F64:
    if not step.possible:
        return np.full(n, np.nan)
    return np.array([np.nan if value is None else value for value in step.loss])
