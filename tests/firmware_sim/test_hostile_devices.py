"""Devices that contradict their own stream never PASS, and honest ones are never accused; tests/slow has many more sessions."""

from __future__ import annotations

import functools
import random
from pathlib import Path

import pytest
from hostile_devices import LIES, MODES, Lie, lied
from mutated_sessions import Stage

stage = functools.cache(Stage)
NAMES = {  # of a contradiction for each lie; "": none of the messages is a lie by itself, what is missing is a fault
    "EXPOSED left out": "",
    "EXPOSED of fewer": "",
    "EXPOSED of more": "claimed_exposures",
    "EXPOSED names one of before": "exposed",
    "EXPOSED names two too far apart": "exposed",
    "blocks late": "exposed",
    "blocks a slot late": "exposed",
    "blocks early": "exposed",
    "STATUS of fewer": "claimed_exposures",
    "STATUS of more": "claimed_exposures",
    "STATUS of drops": "claimed_drops",
    "STATUS says stopped": "claimed_exposures",
    "STATUS says completed": "",
    "STATUS says fault": "",
    "MARK of another class too": "truth",
    "MARK of no class too": "truth",
    "MARK beyond the classes": "truth",
    "MARK of another object": "mark_object",
    "MARK of another exposure": "mark_object",
    "MARK that moves": "mark_half",
}


@pytest.mark.parametrize("mode", MODES)
def test_an_honest_device_is_not_accused(mode: str, tmp_path: Path) -> None:
    session, _ = lied(stage(mode), None, 1, tmp_path)
    assert session.wrong == []
    assert session.summary is not None, session.error
    assert (session.summary.verdict, session.summary.contradictions) == ("PASS", {})
    timing = session.summary.exposure_timing
    assert (timing["untold"], timing["within"]) == (0, True)


@pytest.mark.parametrize("what", LIES)
def test_a_lie_is_a_fault_with_its_name(what: str, tmp_path: Path) -> None:
    dice = random.Random(what)
    lie = Lie(what, dice.randint(0, 2), 1, dice.randint(0, 1 << 20))
    session, told = lied(stage(dice.choice(MODES)), lie, 1, tmp_path)
    assert session.wrong == []
    assert told == 1
    assert session.summary is not None, session.error
    assert session.summary.verdict == "FAIL"
    assert NAMES[what] in session.summary.contradictions or not NAMES[what]
    if what.startswith("EXPOSED") and not NAMES[what]:
        (fault,) = session.summary.faults
        assert f"{session.summary.exposure_timing['untold']} more" in fault
