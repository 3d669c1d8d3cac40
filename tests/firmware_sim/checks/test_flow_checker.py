"""Flows under faults, in short (`pans trials fault-grid` has them at length), and faults of the host that the checker must find."""

from __future__ import annotations

from typing import Any

import pytest

from pans.firmware_sim.checks.flow_truth import Passages
from pans.firmware_sim.checks.flowing import KINDS, small_flow
from pans.firmware_sim.trials.fault_grid import MODES, run_case, turn_of
from pans.runtime.core.decision import DecisionFlag
from pans.runtime.flow.cells import CellCore
from pans.runtime.flow.core import FlowCore
from pans.runtime.flow.tape import TapeCore
from pans.runtime.live.gates import GateQueue
from pans.runtime.turn.system import offered

SEED = {kind: MODES.index(kind) for kind in KINDS}


@pytest.mark.parametrize(
    ("kind", "turn"),
    [("cells", "compiled"), ("cells-dark", "python"), ("tape", "python"), ("tape-tracked", "compiled")],
)
def test_whole_runs_under_all_faults(kind: str, turn: str) -> None:
    result = run_case("all", SEED[kind], 1_400, None, *turn_of(0, turn))
    assert result.violations == []
    assert (result.ended, result.mode) == ("completed", kind)
    assert result.turn == (turn if not offered() else "python")
    assert result.checked["decisions"] > 60
    assert result.checked["decisions_flagged"] > 2
    assert result.checked["gates_executed"] > 2


def found(kind: str, text: str, case: str = "loss") -> bool:
    return any(text in violation for violation in run_case(case, SEED[kind], 1_200).violations)


def test_the_checker_s_passages_are_whole() -> None:
    """Two cells by hand: one alone, one behind an exposure that never came."""
    passages = Passages(small_flow("cells").core(0).limits)
    clicks = [0] * 10 + [2] * 9 + [0] * 6 + [1, None, 1, 1, 1, 1] + [0] * 8
    ended = [one for one in map(passages.put, clicks) if one is not None]
    assert [(one.first, one.last, one.clicks, one.broken) for one in ended] == [(8, 18, 18, False), (27, 30, 4, True)]
    assert ended[0].centre == pytest.approx(14.0, abs=0.05)
    assert not passages.is_open


def test_a_cell_that_is_decided_beside_its_centre_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = CellCore._best_window
    monkeypatch.setattr(CellCore, "_best_window", lambda self, centre: original(self, centre) + 4)
    assert found("cells", "centred was")


def test_a_cell_that_is_left_out_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = CellCore._passed

    def forgetful(self: CellCore, row: list[int], origin_tick: int, rows: Any) -> None:
        if row[0] % 7:
            original(self, row, origin_tick, rows)

    monkeypatch.setattr(CellCore, "_passed", forgetful)
    assert found("cells", "what passed was")


def test_a_window_beside_a_gap_that_is_decided_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = FlowCore._row

    def bold(self: FlowCore, passage: Any, first: int, end_tick: int, why: DecisionFlag, out: Any) -> None:
        original(self, passage, first, end_tick, why & ~DecisionFlag.GAP, out)

    monkeypatch.setattr(FlowCore, "_row", bold)
    assert found("cells", "due <DecisionFlag.GAP")


def test_a_bar_that_is_read_twice_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = TapeCore._window_of
    monkeypatch.setattr(TapeCore, "_window_of", lambda self, middle: original(self, middle) + (middle >> 40) % 2 * 3)
    assert found("tape", "away from where it is aligned", "none")


def test_a_pulse_that_is_sent_and_said_to_be_late_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = GateQueue._do

    def lying(self: GateQueue, action: Any, session: Any, clock: Any) -> None:
        original(self, action, session, clock)
        self._expire(action, "not at all")

    monkeypatch.setattr(GateQueue, "_do", lying)
    assert found("cells", "reported as expired", "none")
