"""`pans calibrate` on an instrument whose messages contradict each other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pans.firmware_sim.checks.mutation import Mutation, by
from pans.firmware_sim.trials.fields import Evidence, MutatedLink
from pans.runtime.cli import EXIT_TIMING, main
from pans.runtime.commands import carry_out
from pans.runtime.instrument.calibration import find_warnings, load_calibration, now_utc
from pans.runtime.link import base
from pans.runtime.live import reconnect, second_device

URL = "sim:ideal?scene=uniform&pace=fast&seed=1"


def test_contradictions_are_a_fault_and_stand_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = base.open_link
    for module in (carry_out, reconnect, second_device):  # imported before: else they would keep the false one for good
        assert module.open_link is opened
    lie = Mutation("CLICKS", "object_index", *by(17), most=3)
    monkeypatch.setattr(base, "open_link", lambda url: MutatedLink(opened(url), (lie,), Evidence(1 << 40, 2, 10**6)))
    out = tmp_path / "c.json"
    assert main(["calibrate", "--device", URL, "--seconds", "0.5", "-o", str(out), "--json"]) == EXIT_TIMING
    assert json.loads(capsys.readouterr().out)["contradictions"] == {"object": 6}  # in each of the two stages
    (doubt,) = find_warnings(load_calibration(out), now_utc())
    assert "contradicted each other" in doubt
