"""One trial of `pans tune`: patterns are uploaded through the ordinary driver, the labelled objects pass, and each one's loss is scored.

Owns the run of a trial and what it cost in light and time; never chooses a pattern. The score is the log loss of the bundle's own
posterior: its table's, its head's or its automaton's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle import Bundle
from pans.runtime.core.decision import Output
from pans.runtime.core.plan import Plan, build_plan
from pans.runtime.core.still import Core
from pans.runtime.decide.backends import make_decider
from pans.runtime.decide.verdict import Decider
from pans.runtime.errors import LinkError, UsageError
from pans.runtime.instrument.profile import Profile
from pans.runtime.link.base import open_link
from pans.runtime.live import LiveRun, Observers, RunOptions, RunResult, run_live
from pans.runtime.live.config import PYTHON
from pans.runtime.live.continuous import Stop
from pans.runtime.record.replaying import ClickLog

from .evidence import F64, log_softmax

_SEED = re.compile(r"([?&]seed=)(\d+)")


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What one pass of the objects brought; `loss` and `right` are nan where an object had no trustworthy decision or no label."""

    loss: F64  # (objects,)
    right: F64  # (objects,)
    clicks: float  # mean per decision
    photons: float  # mean per decision, nan where the instrument does not know
    illumination: float  # mean per decision
    decisions: int
    exposures: int
    seconds: float  # of the instrument
    simulated: bool


@dataclass(slots=True)
class Bench:
    """The device, as trials need it; `labels` are truths by object, where they do not come from its marks."""

    device: str
    profile: Profile
    bundle: Bundle
    n_objects: int  # 0: as many as a simulated scene says
    labels: Mapping[int, int | None] | None
    stop: Stop
    drive: str = "auto"
    decider: Decider = field(init=False)

    def __post_init__(self) -> None:
        self.decider = make_decider(self.bundle)

    def run(self, bundle: Bundle, number: int) -> Trial:
        """Show `bundle`'s patterns, which the old back end decides on, to every object once; `number` of the trial seeds a simulation.

        PlanError where the device cannot show them, LinkError where it is lost, KeyboardInterrupt when the run was asked to stop.
        """
        link = open_link(seeded(self.device, number))
        try:
            plan = build_plan(self.profile, bundle, drive=self.drive)
            log = ClickLog()
            n_cycles = self.n_objects * plan.cycles_per_object
            core = Core(plan, log.over(self.decider), 1, n_cycles)

            def look(_: LiveRun, output: Output) -> None:
                log.note(output.decisions)

            timing = self.profile.timing
            config = RunOptions(
                n_cycles=n_cycles,
                deadline_us=timing.decision_deadline_us,
                lease_ms=timing.lease_ms,
                realtime=False,
                turn=PYTHON,
            )
            watching = Observers(look, stop=self.stop, acts=False)
            result = run_live(link, self.profile, bundle, plan, core, config, None, None, watching)
        finally:
            link.close()
        if self.stop.word:
            raise KeyboardInterrupt(self.stop.word)
        if result.link_lost:
            raise LinkError(f"{self.device}: lost during trial {number}: {result.ended}")
        return self._scored(log, plan, result, bundle)

    def _scored(self, log: ClickLog, plan: Plan, result: RunResult, bundle: Bundle) -> Trial:
        if len(log.counts) != len(log.decisions) or not log.counts:
            raise LinkError(f"{self.device}: no decision in a trial ({result.ended})")
        logs = log_softmax(self.decider.scores_batch(np.stack(log.counts), 1).astype(np.float64))
        loss, right = np.full(self.n_objects, np.nan), np.full(self.n_objects, np.nan)
        for row, decision in zip(logs, log.decisions, strict=True):
            truth = decision.truth if self.labels is None else self.labels.get(decision.object)
            if truth is not None and 0 <= truth < len(row) and decision.object < self.n_objects:
                loss[decision.object], right[decision.object] = -row[truth], float(decision.label == truth)
        figures = result.tally.figures()
        decisions = max(1, figures.decisions)
        light = bundle.illumination()
        if plan.automaton is not None:
            light = float(result.states_shown @ bundle.light_of(plan.automaton)) / decisions
        return Trial(
            loss,
            right,
            figures.clicks_mean or 0.0,
            math.nan if figures.photons_mean is None else figures.photons_mean,
            light,
            figures.decisions,
            figures.decisions * plan.slots_per_cycle,
            result.seconds,
            bool(result.device.get("simulated")),
        )


def scene_size(device: str) -> int:
    """Return how many objects the scene of a simulated instrument has, 0 where the device does not say."""
    from pans.runtime.link.connection import Connection

    link = open_link(device)
    connection: Any = None
    try:
        connection = Connection(link)
        objects = connection.handshake().facts.get("objects", 0)
        return objects if isinstance(objects, int) and objects > 0 else 0
    finally:
        if connection is not None:
            connection.detach()
        link.close()


def seeded(device: str, number: int) -> str:
    """Return the URL with its seed counted up by `number`: a simulated detector must not repeat its noise from trial to trial.

    >>> seeded("sim:ideal?seed=3&pace=fast", 2)
    'sim:ideal?seed=5&pace=fast'
    >>> seeded("sim:ideal", 2)
    'sim:ideal?seed=2'
    """
    if not device.startswith("sim:"):
        return device
    if _SEED.search(device):
        return _SEED.sub(lambda found: f"{found[1]}{int(found[2]) + number}", device)
    return f"{device}{'&' if '?' in device else '?'}seed={number}"


def demand_labelled(trial: Trial, held_out: NDArray[np.bool_]) -> None:
    """Raise UsageError unless enough objects have a label, of those to tune on and of those held out."""
    known = np.isfinite(trial.loss)
    tuned, kept = int((known & ~held_out).sum()), int((known & held_out).sum())
    if tuned < TUNED_MIN or kept < HELD_MIN:
        raise UsageError(
            f"{tuned} labelled objects to tune on and {kept} held out, allowed: {TUNED_MIN} and {HELD_MIN} or more",
            remedy="label more objects with --labels, or let more pass with --objects",
        )


TUNED_MIN, HELD_MIN = 80, 20
