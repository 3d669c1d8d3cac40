"""A calibration is held against what the run measures: the dark counts of the run may contradict it, and that is a fault."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from small_files import small_calibration

from pans.firmware_sim.testing import small_setup
from pans.runtime.core.decision import Decision
from pans.runtime.instrument.calibration import load_calibration
from pans.runtime.instrument.channel_health import DarkReport
from pans.runtime.live.dark_run import DarkRun


@pytest.mark.parametrize(
    ("clicks", "contradicts"), [(0, False), (10, False), (40, False), (70, False), (120, True), (10_000, True)]
)
def test_dark_counts_beyond_the_calibration_are_a_fault(clicks: int, contradicts: bool, tmp_path: Path) -> None:
    small_calibration(tmp_path)  # 0 to 0.004 clicks per exposure of 100 us
    profile, bundle, plan = small_setup()
    dark = DarkRun(profile, load_calibration(tmp_path / "calibration.json"), "warn", [])
    assert dark.guard(plan, bundle, 1) is not None
    report = DarkReport(10_000, clicks, clicks / 10_000, 0.0, 1.0, 0.001, "")
    faults = dark.figures(report).faults
    assert bool(faults) == contradicts
    assert all("the calibration contradicts the dark counts" in fault for fault in faults)
    assert DarkRun(profile, None, "warn", []).figures(report).faults == []


@pytest.mark.parametrize("present", [[], ["a burst"]])
def test_a_state_of_the_detector_is_no_change_of_light(present: list[str]) -> None:
    dark: Any = DarkRun(small_setup()[0], None, "warn", [])
    dark.light = MagicMock()
    dark.light.take.return_value = []
    run, output = MagicMock(), MagicMock(decisions=[Decision(0, 0, 0, 0, 0, 4, 1, 1, 0, 0.9, 0)])
    run.core.guard.health.present = present
    dark.look(run, output)
    assert dark.light.take.called == (not present)
