"""Calibration and dark counts of one run: the guard that its options ask for, what the recording and the summary say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.base.errors import UsageError
from pans.base.numbers import binomial_tail
from pans.bundle.sensor import Bundle
from pans.decide import DECISION_DTYPE, Decision, DecisionFlag, Output, RowDecisions
from pans.decide.dark import DarkGuard, DarkReport, LightWatch, StateWatch, recorded_guard
from pans.decide.plan import Plan
from pans.decide.still import Core
from pans.instrument.calibration_file import Calibration, find_warnings, load_calibration, now_utc
from pans.instrument.click_law import click_law, click_probability
from pans.instrument.detector import afterpulses_of
from pans.instrument.profile import Profile

from .options import RunOptions
from .status import Status

# hours between false alarms about the dark counts, in the mean; as many about dead channels in the light
FALSE_ALARM_H = 240.0
LEAST_ARL = 1e4  # dark exposures
FEW_CLICKS = 10
# Distinct objects whose mean clicks are compared with those of a whole test set. Of fashion-adaptive they differ by 2.9 % (standard
# error) from it, and what is found differs by 10 % at least: 3 in 10 000 such samples.
MANY_OBJECTS = 200
LEAST_LIT = 500  # exposures with light, of which none or all click by chance only where nearly none or all do
CONTRADICTION_CHANCE = 1e-9  # of dark counts as far off the end of the calibration's 95 % interval, in one run
NOT_MEASURED = DecisionFlag.GAP | DecisionFlag.WRONG_PATTERN | DecisionFlag.INCOMPLETE


@dataclass(frozen=True, slots=True)
class DarkFigures:
    """What the summary says of the calibration and of the light during the run, and the faults that follow."""

    calibration: dict[str, Any] | None
    warnings: list[str]
    light: dict[str, Any] | None
    faults: list[str]
    changes: list[str]  # of the light that are warnings


class DarkRun:
    """Calibration and policy of one run."""

    def __init__(self, profile: Profile, calibration: Calibration | None, policy: str, warnings: list[str]) -> None:
        self.calibration, self.policy, self.warnings = calibration, policy, warnings
        self.profile = profile if calibration is None else calibration.applied_to(profile)
        self._header: dict[str, Any] = {}
        self.light = LightWatch()
        self.states: StateWatch | None = None  # of an automaton
        self._few_objects = False  # which come again and again

    @staticmethod
    def of(options: RunOptions, profile: Profile) -> DarkRun:
        """Read what `options` ask for; ConfigError for a calibration of another profile."""
        calibration = None if options.calibration is None else load_calibration(options.calibration)
        if calibration is not None:
            calibration.check_made_for(profile, None)
        warnings = []
        if options.warns_uncalibrated:
            warnings = find_warnings(calibration, now_utc(), options.calibration_max_age_h)
        return DarkRun(profile, calibration, options.on_dark, warnings)

    def guard(self, plan: Plan, bundle: Bundle, shots: int, flow: bool = False) -> DarkGuard | None:
        """Return the guard of a core; None where the plan has nothing dark in it and nothing was asked for.

        A `flow` without dark slots is watched in the frames in which no object was found.
        """
        if not plan.dark_slots_per_cycle and not flow:
            if self.policy == "warn":
                return None
            raise UsageError(
                f"--on-dark {self.policy}: the plan has no dark slots", remedy="use --dark-slots 1 or more"
            )
        channels, said = plan.n_channels, float(click_probability(click_law(self.profile, plan.exposure_us), 0.0))
        if self.calibration is None:
            expected = low = high = np.full(channels, said)
        else:
            expected, low, high = self.calibration.dark_probability(self.profile, plan.exposure_us, channels)
            hardly = self.calibration.dark_clicks(channels) < FEW_CLICKS  # measured: the profile's, as far as possible
            expected = np.where(hardly, np.clip(said, low, high), expected)
        afterpulses = afterpulses_of(self.profile, plan.exposure_us)
        brightest = float(bundle.pattern_levels.sum(axis=1, dtype=np.uint64).max()) * bundle.photons_per_level
        per_hour = (plan.dark_slots_per_cycle or plan.slots_per_cycle) * 3.6e9 / plan.cycle_us
        self._header = {
            "policy": self.policy,
            "arl_dark_exposures": max(LEAST_ARL, FALSE_ALARM_H * per_hour),
            "expected": expected.tolist(),
            "low": low.tolist(),
            "high": high.tolist(),
            "afterpulses": afterpulses.exposures_seen(float(np.min(expected))),
            "after_clicks": afterpulses.chance_after_clicks(float(np.max(high)), brightest) if afterpulses else None,
            "lit": {
                "arl_exposures": max(LEAST_ARL, 2 * FALSE_ALARM_H * plan.slots_per_cycle * 3.6e9 / plan.cycle_us),
                "arl_objects": max(LEAST_ARL, 2 * FALSE_ALARM_H * 3600 * plan.objects_hz),
            },
        }
        return recorded_guard(self._header, plan, bundle, shots)

    def expect(self, plan: Plan, bundle: Bundle, trials: int = 1) -> None:
        """Before arming: take the clicks that `bundle` states, where they hold for this run, and watch the states of an automaton."""
        if plan.automaton is not None:
            self.states = StateWatch.of_pace(plan.automaton.n_states, 1e6 / plan.cycle_us, trials)
        stated = bundle.expected_on(self.profile.name, plan.automaton)
        self.light.stated = None if stated is None else float(stated["clicks"])
        if stated is not None and self.states is not None and "first_state_clicked" in stated:
            self.states.stated = self._within_calibration(float(stated["first_state_clicked"]))

    def _within_calibration(self, share: float) -> tuple[float, float]:
        """Return the least and largest share of exposures that click, stated as `share`, with the light that the calibration allows.

        Of f times the light 1 - (1 - share)^f is as far off as it can be, whatever the objects: E(x^f) is on one side of E(x)^f.
        """
        if self.calibration is None:
            return share, share
        low, high = self.calibration.values["peak_photoelectrons_hz_ci"]
        light = self.profile.projector.peak_photoelectrons_hz
        ends = low / light, math.inf if high is None else high / light
        return 1 - (1 - share) ** min(ends[0], 1.0), 1 - (1 - share) ** max(ends[1], 1.0)

    def header(self) -> dict[str, Any]:
        """What the recording says, and a replay needs."""
        one = self.calibration
        calibration = None if one is None else {"sha256": one.sha256, "values": dict(one.values)}
        return {"guard": self._header, "calibration": calibration, "warnings": self.warnings}

    def check_device(self, run: Status) -> None:
        """Before arming: is this the device that was calibrated? ConfigError if not."""
        if self.calibration is not None:
            self.calibration.check_made_for(self.profile, self.serial_of(run))
        objects = run.session.facts.get("objects")
        self._few_objects = isinstance(objects, int) and objects < MANY_OBJECTS
        if self.states is not None and isinstance(objects, int) and objects > 0:
            self.states.objects = objects
        for warning in self.warnings:
            run.accounts.journal.note("calibration_warning", words=warning)

    @staticmethod
    def serial_of(run: Status) -> str | None:
        """The serial number that the device told, if any."""
        serial = run.session.facts.get("serial")
        return None if serial is None else str(serial)

    def look(self, run: Status, output: Output) -> None:
        """After a block: compare the clicks of its decisions, and of the states of an automaton, with those of the run's beginning.

        Not while the detector is in a state that changes them: that is named already, and is no change of light.
        """
        guard = run.core.guard
        counts = guard is None or not guard.present
        found = self.light.take(_measured_clicks(output.decisions)) if counts else []
        if self.states is not None and isinstance(run.core, Core):
            walks = run.core.windows.walks
            if self.states.is_due(int(walks.shown[0])):
                found = found + self.states.take(walks.shown, walks.clicked, counts=counts)
        for one in found:
            run.accounts.journal.note("light_changed", **one)

    def figures(
        self, dark: DarkReport | None = None, clicks: int = 0, lit: int = 0, *, saturates: bool = True
    ) -> DarkFigures:
        """Return calibration, its warnings and the light for a run's summary; data that contradict what is stated are faults.

        `dark` is what the run's dark exposures gave; `clicks` came in `lit` exposures with light, one each at most if it `saturates`.
        With a calibration each change of the light is one. Without, a change within the run is a warning, as other objects change the
        clicks too, and what differs from the bundle's statement is a fault unless there are fewer than MANY_OBJECTS.
        """
        one = self.calibration
        facts = None if one is None else {"path": one.path, "sha256": one.sha256, "made_utc": one.values["made_utc"]}
        watched = [*self.light.found, *([] if self.states is None else self.states.found)]
        watched = sorted(watched, key=lambda found: int(found["decision"]))
        hard = [found for found in watched if one is not None or (found.get("stated") and not self._is_of_few(found))]
        faults = [str(found["words"]) for found in hard]
        changes = [str(found["words"]) for found in watched if found not in hard]
        if lit >= LEAST_LIT and (not clicks or (saturates and clicks == lit)):
            often = "every one" if clicks else "none"
            changes.append(
                f"the detector clicked in {often} of {lit} exposures with light: saturated, disconnected or without light; "
                "no object can be told from another"
            )
        if one is not None and dark is not None:
            faults += self._contradictions(dark)
        states = {} if self.states is None else {"states": self.states.report()}
        return DarkFigures(facts, self.warnings, self.light.report() | states, faults, changes)

    def _is_of_few(self, found: dict[str, Any]) -> bool:
        """Whether fewer than MANY_OBJECTS different objects were seen when it was found."""
        return self._few_objects or found.get("objects", MANY_OBJECTS) < MANY_OBJECTS

    def _contradictions(self, dark: DarkReport) -> list[str]:
        """Compare the run's dark clicks, of all channels, with the ends of the calibration's interval: one sentence, or none.

        With afterpulses the clicks are not independent, and the watch alone judges them.
        """
        if not self._header or self._header["afterpulses"]:
            return []
        low, high = (float(np.mean(self._header[end])) for end in ("low", "high"))
        clicks, exposures = dark.clicks, dark.exposures
        above = binomial_tail(clicks, exposures, high)
        below = binomial_tail(exposures - clicks, exposures, 1 - low)
        if min(above, below) >= CONTRADICTION_CHANCE:
            return []
        said = f"{low:.3g} to {high:.3g} per exposure"
        return [
            f"the calibration contradicts the dark counts: it says {said}, this run had {clicks} clicks in {exposures}"
        ]


def _measured_clicks(decisions: Sequence[Decision]) -> NDArray[np.integer]:
    """Return the clicks of the decisions that were measured as planned."""
    rows = decisions.rows if isinstance(decisions, RowDecisions) else np.array(decisions, DECISION_DTYPE)
    clicks, flags = rows["clicks"], rows["flags"]
    return np.asarray(clicks[flags & np.uint32(NOT_MEASURED) == 0] if flags.any() else clicks)
