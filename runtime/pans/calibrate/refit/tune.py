"""Patterns and a device in; patterns that decide its labelled objects better, and a report, out: the search of `pans tune`.

Each trial shows all patterns, changed by one `Move`, to every object through the ordinary driver, and scores the log loss of the bundle's
own posterior. A step of one parameter is accepted if the mean paired difference of log loss is above `CLEARLY` standard errors; lesser
gains are tried together at the end of a round, which a new trial of what has been reached begins. A round without a step halves all steps.
A search is resumed by following the journal of its trials without measuring.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.console import say
from pans.base.errors import DamagedFileError, LinkError, PlanError, UsageError
from pans.base.files import parse_json_object, read_file, write_file
from pans.bundle.backends import Decider, make_decider
from pans.bundle.sensor import Bundle, bundle_bytes, check_bundle, frozen, parse_bundle
from pans.decide.plan import build_plan
from pans.decide.still import Core
from pans.instrument.optics import Imaging, seen
from pans.instrument.profile import Profile
from pans.live.loop import Job, Observers, Session, run_live
from pans.live.options import RunOptions
from pans.live.stop import Stop
from pans.protocol.links import open_link
from pans.record.replay import ClickLog

from .choosing import Estimate, compared
from .evidence import F64, log_softmax

CLEARLY = 2.33  # standard errors: one step in a hundred that changes nothing is accepted
PERHAPS = 1.0
HELD_OUT_EVERY = 5  # objects: of each five, one is kept for the comparison at the end
TUNED_MIN, HELD_MIN = 80, 20
FORMAT = "pans-tune 1"
CHECKPOINT_MAX_BYTES = 1 << 28


# ---- how patterns may be changed ----


class Move(NamedTuple):
    """How all patterns differ from the trained ones; nothing by default. `brightness` is of the light, by a longer exposure.

    The last four bend the grid smoothly, each by so many pixels at the edge of the patterns: with x and y from -1 to 1, stretch moves by
    (x, -y), shear by (y, x), the keystones by (x y, 0) and (0, x y).
    """

    right_px: float = 0.0
    down_px: float = 0.0
    rotation_deg: float = 0.0
    scale: float = 1.0
    brightness: float = 1.0
    stretch_px: float = 0.0
    shear_px: float = 0.0
    keystone_right_px: float = 0.0
    keystone_down_px: float = 0.0

    def by(self, name: str, step: float) -> Move:
        """Return the move with `name` changed by `step`; a factor is multiplied by 1 + step, or divided by 1 - step."""
        value = getattr(self, name)
        if name in ("scale", "brightness"):
            return self._replace(**{name: value * (1 + step) if step > 0 else value / (1 - step)})
        return self._replace(**{name: value + step})

    def words(self) -> str:
        """Return what differs, in words."""
        said = [f"{name} {value:.3g}" for name, value in self._asdict().items() if value != getattr(STILL, name)]
        return ", ".join(said) or "nothing"


BENDS = ("stretch_px", "shear_px", "keystone_right_px", "keystone_down_px")
STILL = Move()
# The first step is what an adjusted table is off by; the last one costs less than a thousand objects can tell.
FIRST_STEP = dict.fromkeys(BENDS, 1.0)
FIRST_STEP |= {"right_px": 1.0, "down_px": 1.0, "rotation_deg": 2.0, "scale": 0.04, "brightness": 0.2}
LAST_STEP = {name: step / (2 if name in BENDS else 4) for name, step in FIRST_STEP.items()}


def moved(bundle: Bundle, move: Move) -> Bundle:
    """Return `bundle` with its patterns changed, on the projector's levels; golden vectors and back end as they are."""
    levels = bundle.pattern_levels
    if move._replace(brightness=1.0) != STILL:
        imaging = Imaging(move.right_px, move.down_px, move.rotation_deg, move.scale)
        wide = _bent(seen(imaging, levels.astype(np.float64), bundle.image_shape), move, bundle.image_shape)
        if bundle.levels == 2:  # the brightest pixels of each pattern, as many as keep its light
            rank = np.argsort(np.argsort(-wide, axis=1, kind="stable"), axis=1, kind="stable")
            levels = ((rank < np.rint(wide.sum(axis=1, keepdims=True))) & (wide > 0)).astype(np.uint16)
        else:
            levels = np.rint(wide).clip(0, bundle.levels - 1).astype(np.uint16)
    return replace(
        bundle,
        pattern_levels=frozen(levels),
        photons_per_level=bundle.photons_per_level * move.brightness,
        expected=None if move != STILL else bundle.expected,
    )


def _bent(wide: F64, move: Move, shape: tuple[int, int]) -> F64:
    """The patterns (n, pixels) moved by the four bends, between pixels by bilinear interpolation; nothing comes from outside."""
    rows, columns = shape
    down, right = np.mgrid[0:rows, 0:columns].astype(np.float64)
    y, x = 2 * down / max(1, rows - 1) - 1, 2 * right / max(1, columns - 1) - 1
    right = right - (move.stretch_px * x + move.shear_px * y + move.keystone_right_px * x * y)
    down = down - (-move.stretch_px * y + move.shear_px * x + move.keystone_down_px * x * y)
    padded = np.pad(wide.reshape(-1, rows, columns), ((0, 0), (1, 1), (1, 1)))
    right, down = (right + 1).clip(0, columns + 1), (down + 1).clip(0, rows + 1)
    column, row = np.minimum(right.astype(int), columns), np.minimum(down.astype(int), rows)
    along, below = right - column, down - row
    upper = padded[:, row, column] * (1 - along) + padded[:, row, column + 1] * along
    lower = padded[:, row + 1, column] * (1 - along) + padded[:, row + 1, column + 1] * along
    return np.asarray(upper * (1 - below) + lower * below).reshape(len(wide), -1)


# ---- which change is tried next ----


class Cost(NamedTuple):
    """What trials have taken, or may take: photons (clicks where the instrument does not count photons), seconds of the instrument."""

    photons: float = 0.0
    seconds: float = 0.0

    def plus(self, other: Cost, times: int = 1) -> Cost:
        """Return the sum with `other`, taken so many times."""
        return Cost(self.photons + times * other.photons, self.seconds + times * other.seconds)

    def within(self, budget: Cost) -> bool:
        """Whether it does not exceed `budget`."""
        return self.photons <= budget.photons and self.seconds <= budget.seconds


class Step(NamedTuple):
    """One trial of the journal: the move, what it cost, and each object's loss (None: unknown; of all where the device cannot show it)."""

    move: Move
    cost: Cost
    loss: tuple[float | None, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it for the checkpoint."""
        return {"move": self.move._asdict(), "cost": self.cost._asdict(), "loss": self.loss}

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Step:
        """Invert `as_json`; DamagedFileError if it is not of that form."""
        try:
            move = Move(**{name: float(value) for name, value in facts["move"].items()})
            cost = Cost(**{name: float(value) for name, value in facts["cost"].items()})
            return cls(move, cost, tuple(None if value is None else float(value) for value in facts["loss"]))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DamagedFileError(f"a trial of the checkpoint cannot be read: {error}") from error


class OutOfBudget(Exception):
    """The next trial, and the comparison at the end, would take more than is allowed."""


@dataclass(slots=True)
class Search:
    """A search that continues from its journal; `best` is what has been reached, at any time."""

    names: tuple[str, ...]
    n_objects: int
    budget: Cost
    measure: Callable[[Move, int], tuple[F64, Cost]]  # the move and the number of the trial
    keep: Callable[[list[Step]], None]  # called with the journal after each trial
    journal: list[Step] = field(default_factory=list)
    best: Move = STILL
    accepted: int = 0
    ended: str = ""
    steps: dict[str, float] = field(init=False)
    held_out: NDArray[np.bool_] = field(init=False)
    _followed: int = 0  # trials so far
    _here: F64 = field(init=False)  # mean losses at `best`
    _errors: list[float] = field(default_factory=list)  # of the differences between trials

    def __post_init__(self) -> None:
        self.steps = {name: FIRST_STEP[name] for name in self.names}
        self.held_out = held_out_of(self.n_objects)

    @property
    def spent(self) -> Cost:
        """What all trials have taken."""
        return Cost(sum(step.cost.photons for step in self.journal), sum(step.cost.seconds for step in self.journal))

    @property
    def resolution(self) -> float:
        """The least gain in log loss that these objects can tell from chance in one trial; nan before two trials."""
        return CLEARLY * float(np.median(self._errors)) if self._errors else math.nan

    def run(self) -> None:
        """Search until the steps are too small to tell, or the budget is spent (`ended` says which)."""
        times = 1  # trials of the best move
        try:
            self._here = self._try(STILL)
            while (accepted := self._round()) or self._halve():
                times = 2 if accepted else times + 1
                self._here = self._here + (self._try(self.best) - self._here) / times
            self.ended = "the smallest steps change nothing more"
        except OutOfBudget:
            self.ended = "the budget is spent"

    def _halve(self) -> bool:
        """Halve all steps; False where they are the last ones already."""
        before = self.steps
        self.steps = {name: max(step / 2, LAST_STEP[name]) for name, step in before.items()}
        return self.steps != before

    def _round(self) -> bool:
        """Try each parameter once, up and down, then what was promising together; return whether a step was accepted."""
        accepted, promising = self.accepted, dict[str, float]()
        for name in self.names:
            tried = []
            for step in (self.steps[name], -self.steps[name]):
                gain, loss = self._accepts({name: step})
                if gain > CLEARLY:
                    while self._accepts({name: step})[0] > CLEARLY:
                        pass
                    break
                tried.append((gain, step, loss))
            else:
                (_, _, other), (gain, step, loss) = tried if tried[1][0] > tried[0][0] else tried[::-1]
                against = _in_errors(*paired(other, loss, ~self.held_out))
                if gain > PERHAPS or (gain > 0 and against > CLEARLY):
                    promising[name] = step
        if promising:
            self._accepts(promising)
        return self.accepted > accepted

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
            self.best, self._here = candidate, loss
            self.accepted += 1
        return clear, loss

    def _try(self, move: Move) -> F64:
        """Return each object's loss under `move`, nan where it is not known: from the journal as far as it goes, then measured."""
        place = self._followed
        self._followed += 1
        if place < len(self.journal):
            step = self.journal[place]
            if step.move != move or len(step.loss) != self.n_objects:
                raise DamagedFileError(f"trial {place} of the checkpoint is {step.move.words()}, here {move.words()}")
            return np.array(step.loss, np.float64)
        if self.journal:
            dearest = max(step.cost for step in self.journal)
            if not self.spent.plus(dearest, 3).within(self.budget):  # this one, and two for the comparison at the end
                raise OutOfBudget
        try:
            loss, cost = self.measure(move, place)
        except PlanError:
            if move == STILL:
                raise
            loss, cost = np.full(self.n_objects, np.nan), Cost()
        self.journal.append(Step(move, cost, tuple(float(one) if math.isfinite(one) else None for one in loss)))
        self.keep(self.journal)
        return loss


def held_out_of(n_objects: int) -> NDArray[np.bool_]:
    """Return which objects are kept for the comparison at the end, (objects,)."""
    return np.asarray(np.arange(n_objects) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1)


def paired(old: F64, new: F64, chosen: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the mean of `old` - `new` over the chosen objects that both know, and its standard error; (0, inf) below two of them."""
    difference = (old - new)[chosen & np.isfinite(old) & np.isfinite(new)]
    if len(difference) < 2:
        return 0.0, math.inf
    found = Estimate.of(difference)
    return found.value, found.error


def _in_errors(gain: float, error: float) -> float:
    """Return a gain in standard errors; infinite where there is no error at all."""
    return gain / error if error > 0 else math.copysign(math.inf, gain) if gain else 0.0


# ---- trials on the device ----


class Trial(NamedTuple):
    """What one pass of the objects brought; `loss` and `right` are nan where an object had no trustworthy decision or no label."""

    loss: F64  # (objects,)
    right: F64  # (objects,)
    light: dict[str, float | None]  # means per decision: clicks, photons (None: unknown), illumination
    cost: Cost  # clicks stand for photons where the instrument does not know them
    simulated: bool


def scene_size(device: str) -> int:
    """Return how many objects the scene of a simulated instrument has, 0 where the device does not say."""
    with closing(open_link(device)) as link:
        session = Session(link)
        try:
            objects = session.handshake().facts.get("objects", 0)
        finally:
            session.detach()
    return objects if isinstance(objects, int) and objects > 0 else 0


def seeded(device: str, number: int) -> str:
    """Return the URL with its seed counted up by `number`: a simulated detector must not repeat its noise from trial to trial.

    >>> seeded("sim:ideal?seed=3&pace=fast", 2)
    'sim:ideal?seed=5&pace=fast'
    >>> seeded("sim:ideal", 2)
    'sim:ideal?seed=2'
    """
    if not device.startswith("sim:"):
        return device
    found, n = re.subn(r"([?&]seed=)(\d+)", lambda seed: f"{seed[1]}{int(seed[2]) + number}", device)
    return found if n else f"{device}{'&' if '?' in device else '?'}seed={number}"


@dataclass(slots=True)
class Tuning:
    """One tuning on one device; `facts` are those that a checkpoint must share to be continued from."""

    device: str
    profile: Profile
    bundle: Bundle
    n_objects: int
    labels: Mapping[int, int | None] | None  # truths by object, where they do not come from the device's marks
    drive: str
    stop: Stop
    names: tuple[str, ...]
    budget: Cost
    checkpoint: Path
    facts: dict[str, Any]
    simulated: bool = False
    decider: Decider = field(init=False)

    def __post_init__(self) -> None:
        self.decider = make_decider(self.bundle)

    def run(self, *, resume: bool) -> tuple[Bundle, dict[str, Any]]:
        """Search and compare; return the bundle to write and the report. An interrupt ends the search only (`interrupted`)."""
        search = Search(self.names, self.n_objects, self.budget, self._measure, self._keep)
        if resume:
            search.journal = self._read()
            say(f"pans: {len(search.journal)} trials from {self.checkpoint}")
        interrupted, comparison = False, None
        try:
            search.run()
            comparison = self._compared(search)
        except KeyboardInterrupt:
            interrupted = True
        best = search.best
        if comparison is not None and comparison["all_objects"]["log_loss_gain"]["value"] <= 0:
            best = STILL
        spent = search.spent if comparison is None else search.spent.plus(Cost(**comparison["cost"]))
        report = {
            "changed": best != STILL,
            "move": best._asdict(),
            "steps": search.steps,
            "accepted": search.accepted,
            "test": f"paired difference of log loss above {CLEARLY} standard errors",
            "resolution": search.resolution if math.isfinite(search.resolution) else None,
            "trials": len(search.journal),
            "ended": "interrupted" if interrupted else search.ended,
            "interrupted": interrupted,
            "objects": self.n_objects,
            "comparison": comparison,
            "spent": {"photons_or_clicks": spent.photons, "instrument_minutes": spent.seconds / 60},
            "simulated": self.simulated,
        }
        return self._tuned(best, report), report

    def _tuned(self, best: Move, report: Mapping[str, Any]) -> Bundle:
        old = self.bundle
        facts = {**report, "from_bundle_sha256": self.facts["bundle_sha256"], "device": self.device}
        if best != STILL and old.expected is not None:
            facts["expected_of_the_old_patterns"] = dict(old.expected)
        made = replace(moved(old, best), provenance={**old.provenance, "tune": facts})
        check_bundle(made)
        return parse_bundle(bundle_bytes(made), "the tuned bundle")

    def _trial(self, bundle: Bundle, number: int) -> Trial:
        """Show `bundle`'s patterns, which the old back end decides on, to every object once; `number` of the trial seeds a simulation.

        PlanError where the device cannot show them, LinkError where it is lost, KeyboardInterrupt when the run was asked to stop.
        """
        timing, log = self.profile.timing, ClickLog()
        with closing(open_link(seeded(self.device, number))) as link:
            plan = build_plan(self.profile, bundle, drive=self.drive)
            n_cycles = self.n_objects * plan.cycles_per_object
            core = Core(plan, log.over(self.decider), 1, n_cycles)
            config = RunOptions(
                n_cycles=n_cycles, deadline_us=timing.decision_deadline_us, lease_ms=timing.lease_ms, realtime=False
            )
            watching = Observers(lambda _, output: log.note(output.decisions), stop=self.stop, acts=False)
            result = run_live(link, Job(self.profile, bundle, plan, config), core, observers=watching)
        self.stop.obey()
        if result.link_lost or len(log.counts) != len(log.decisions) or not log.counts:
            what = "lost during" if result.link_lost else "no decision in"
            raise LinkError(f"{self.device}: {what} trial {number}: {result.ended}")
        logs = log_softmax(self.decider.scores_batch(np.stack(log.counts), 1).astype(np.float64))
        loss, right = np.full((2, self.n_objects), np.nan)
        for row, decision in zip(logs, log.decisions, strict=True):
            truth = decision.truth if self.labels is None else self.labels.get(decision.object)
            if truth is not None and 0 <= truth < len(row) and decision.object < self.n_objects:
                loss[decision.object], right[decision.object] = -row[truth], float(decision.label == truth)
        figures = result.tally.figures()
        clicks, photons, light = figures.clicks_mean or 0.0, figures.photons_mean, bundle.illumination()
        if plan.automaton is not None:
            light = float(result.states_shown @ bundle.light_of(plan.automaton)) / max(1, figures.decisions)
        means = {"clicks_mean": clicks, "photons_mean": photons, "illumination": light}
        cost = Cost((clicks if photons is None else photons) * figures.decisions, result.seconds)
        return Trial(loss, right, means, cost, bool(result.device.get("simulated")))

    def _measure(self, move: Move, number: int) -> tuple[F64, Cost]:
        trial, held_out = self._trial(moved(self.bundle, move), number), held_out_of(self.n_objects)
        self.simulated = trial.simulated
        known = np.isfinite(trial.loss)
        tuned, kept = int((known & ~held_out).sum()), int((known & held_out).sum())
        if tuned < TUNED_MIN or kept < HELD_MIN:
            raise UsageError(
                f"{tuned} labelled objects to tune on and {kept} held out, allowed: {TUNED_MIN} and {HELD_MIN} or more",
                remedy="label more objects with --labels, or let more pass with --objects",
            )
        mean, right = float(np.nanmean(trial.loss[~held_out])), 100 * np.nanmean(trial.right)
        say(f"pans: trial {number}: {move.words()}: log loss {mean:.4f}, accuracy {right:.1f} %")
        return trial.loss, trial.cost

    def _keep(self, journal: list[Step]) -> None:
        payload = {"format": FORMAT, **self.facts, "trials": [step.as_json() for step in journal]}
        write_file(self.checkpoint, json.dumps(payload).encode(), force=True)

    def _read(self) -> list[Step]:
        """Return the trials of the checkpoint; UsageError where it is of another tuning."""
        where = str(self.checkpoint)
        found = parse_json_object(read_file(self.checkpoint, CHECKPOINT_MAX_BYTES), where)
        if found.get("format") != FORMAT or not isinstance(found.get("trials"), list):
            raise DamagedFileError(f"{where}: no checkpoint of pans tune ({FORMAT})")
        for name, value in self.facts.items():
            if found.get(name) != value:
                raise UsageError(
                    f"{where}: its {name} is {ascii(found.get(name))[:60]}, here {ascii(value)[:60]}",
                    remedy="resume with the options of the first call; budgets alone may differ",
                )
        return [Step.of(row) for row in found["trials"]]

    def _compared(self, search: Search) -> dict[str, Any] | None:
        """Measure old and new once more, on fresh clicks; None where nothing has changed."""
        if search.best == STILL:
            return None
        number = len(search.journal)
        old = self._trial(self.bundle, number)
        new = self._trial(moved(self.bundle, search.best), number + 1)
        held = search.held_out
        return {
            "held_out": _comparison(old, new, held),
            "all_objects": _comparison(old, new, np.ones_like(held)),
            "old": old.light,
            "new": new.light,
            "cost": old.cost.plus(new.cost)._asdict(),
        }


def _comparison(old: Trial, new: Trial, chosen: NDArray[np.bool_]) -> dict[str, Any]:
    both = chosen & np.isfinite(old.loss) & np.isfinite(new.loss)
    figures = compared((old.loss[both], old.right[both]), (new.loss[both], new.right[both]))
    return {"objects": int(both.sum()), **{name: found.as_json() for name, found in figures.items()}}
