"""The benchmark of the turn: what it times decides as the plain core does, in C too, and over real ports; never a speed."""

from __future__ import annotations

from pathlib import Path

import pytest

from pans.runtime.bench import turn as bench
from pans.runtime.bench.flow_turn import flow_row
from pans.runtime.bench.link import link_rows
from pans.runtime.bench.rows import BenchOptions
from pans.runtime.bench.turn_c import DEVICE, built
from pans.runtime.bench.walks import made_automaton
from pans.runtime.bundle.model import load_bundle
from pans.runtime.turn.system import offered

pytestmark = pytest.mark.skipif(bool(offered()), reason="no compiled turn here")


def test_what_is_timed_decides_as_the_plain_core_and_as_the_loop_in_c(tmp_path: Path) -> None:
    shipped, _ = load_bundle(BenchOptions().first_bundle)
    for row in (bench._block_row(made_automaton(), tmp_path, True), bench._frame_row(shipped, tmp_path, True)):
        assert row["changed_percent"] == 0.0, row["name"]
        assert "c" in row or row["c_changed_percent"] == 0.0, row["name"]


@pytest.mark.parametrize("kind", ["pty", "TCP", "pyusb"])
def test_round_trips_are_decided_as_by_the_plain_core(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = built(DEVICE, "device", tmp_path)
    if isinstance(device, str):
        pytest.skip(device)
    monkeypatch.setattr(bench, "ROUNDS", 1)
    plan, decider = bench._walk_plan(made_automaton())
    row = bench._trip_row(bench._Trips(kind, plan, decider, device, 300))
    assert (row["changed_percent"], row["command_bytes"]) == (0.0, 38)
    assert row["calls"] >= 270


def test_the_flow_that_is_timed_is_decided_as_by_the_plain_core() -> None:
    shipped, _ = load_bundle(BenchOptions().first_bundle)
    row = flow_row(shipped, True)
    assert row["changed_percent"] == 0.0
    assert row["decisions"] == 100  # one every 500 of 400 blocks' frames


def test_round_trips_of_a_live_run_over_pyusb() -> None:
    rows = {row["name"]: row for row in link_rows(["usb"], samples=100)}
    for turn in ("", ", compiled"):
        came, decided = (rows[f"usb: command to {what}{turn}"] for what in ("click block", "decision"))
        assert 0 < came["p50_us"] < decided["p50_us"]
        assert (came["samples"], came["other_end"]) == (100, decided["other_end"])
