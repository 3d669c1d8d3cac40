"""`pans run --dose-cap`: which walk each object is left, and what is refused with the numbers."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from automata import automaton_bundle
from bundles import made_bundle
from commands import Pans

from pans.app.run.prepare import dose_of
from pans.base import SHIPPED
from pans.base.errors import UsageError
from pans.bundle.automaton import STATES_MAX, DoseCap
from pans.bundle.backends.choose import make_decider
from pans.instrument.profile import load_profile
from pans.live.options import RunOptions
from pans.record.reading.sent_plan import automaton_of

IDEAL = load_profile("ideal")
CAPPED = RunOptions(dose_cap=3.0)


def test_no_walk_of_a_run_passes_the_cap_of_its_object() -> None:
    bundle = automaton_bundle()
    dose = dose_of(RunOptions(dose_cap=6.0, trials=2), bundle, IDEAL)
    assert dose.most == 3.0
    decider = make_decider(bundle, dose=dose)
    automaton = decider.automaton  # type: ignore[attr-defined]
    assert automaton.n_states < bundle.automaton.n_states
    light = bundle.light_of(automaton)
    most = 0.0
    for word in itertools.product((0, 1), repeat=automaton.n_slots):
        node, spent = 0, 0.0
        for click in word:
            if node < automaton.n_states:
                spent += light[node]
                node = int(automaton.successors[node, click])
        most = max(most, spent)
    assert 2.0 < most <= 3.0
    config = {"drive": "device", "confidence": 0.0, "walk_dose": {"most": dose.most, "states": dose.states}}
    again = automaton_of(config, bundle)
    np.testing.assert_array_equal(again.successors, automaton.successors)
    np.testing.assert_array_equal(again.posteriors, automaton.posteriors)


def test_the_device_s_memory_for_states_bounds_the_automaton() -> None:
    bundle = automaton_bundle()
    assert dose_of(RunOptions(), bundle, IDEAL) is None
    for held, allowed in ((0, STATES_MAX), (7, 7), (10**6, STATES_MAX)):
        profile = replace(IDEAL, projector=replace(IDEAL.projector, automaton_states=held))
        assert dose_of(CAPPED, bundle, profile) == DoseCap(3.0, allowed)


def test_fixed_patterns_must_fit() -> None:
    bundle = made_bundle(3, 2, table=np.zeros((8, 2)))  # one photoelectron each
    assert dose_of(CAPPED, bundle, IDEAL) is None
    for changed in ({"dose_cap": 2.9}, {"shots": 2}, {"trials": 2}):
        with pytest.raises(UsageError, match=r"(?s)illumination to an object .*--dose-cap allows.*pans order"):
            dose_of(replace(CAPPED, **changed), bundle, IDEAL)
    with pytest.raises(UsageError, match="has no automaton"):
        make_decider(bundle, dose=DoseCap(1.0))
    with pytest.raises(UsageError, match="not for passive optics"):
        dose_of(RunOptions(dose_cap=3.0, registration=Path("there.registration")), automaton_bundle(), IDEAL)
    for most in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="dose cap"):
            DoseCap(most)


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["device", "host"])
def test_a_run_within_a_cap_replays_to_the_same_decisions(drive: str, tmp_path: Path, pans: Pans) -> None:
    device = "sim:dmd-spad?scene=fashion200&pace=fast"
    words = ("--dose-cap", 200, "--drive", drive, "--decisions", 40, "--no-realtime", "--out", tmp_path / "run")
    ran = pans("run", SHIPPED / "fashion-adaptive.pans", "--device", device, *words)
    assert 100 < ran["illumination"] <= 200
    again = pans("replay", tmp_path / "run" / "run.pansrec")
    assert again["identical"]
