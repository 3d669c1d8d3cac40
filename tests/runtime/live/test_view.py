"""The live view: a panel where the deadline leaves time to draw it, else plain lines, each now and then."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from pans.runtime.core.decision import Decision, Output
from pans.runtime.live import view as live
from pans.runtime.live.view import PANEL_DEADLINE_US, live_view
from pans.runtime.timing.ledger import LatencyHistogram


def a_run(decisions: int) -> Any:
    total = LatencyHistogram()
    for latency_us in range(decisions):
        total.add(latency_us * 1000)
    tracker = SimpleNamespace(counters=SimpleNamespace(lost_exposures=3))
    return SimpleNamespace(
        tally=SimpleNamespace(accuracy=0.75, decisions=decisions, clicks=6 * decisions),
        timing=SimpleNamespace(total=total, late=2),
        core=SimpleNamespace(tracker=tracker),
    )


def test_lines_come_now_and_then_and_are_not_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now_s[0])
    with live_view("a bundle on an instrument", ("a", "b"), 500, True, 1e9) as watch:  # no terminal here
        for _ in range(20):
            watch(a_run(100), Output([], [], None))
            now_s[0] += 1.0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert lines[0] == (
        "SIMULATED · a bundle on an instrument: 100 of 500 decisions · accuracy 75.0% · 6.00 clicks each · p99 0.10 ms · late 2 · lost 3"
    )


@pytest.mark.parametrize(("deadline_us", "panel"), [(PANEL_DEADLINE_US, True), (PANEL_DEADLINE_US - 1, False)])
def test_a_panel_is_drawn_only_where_there_is_time(
    deadline_us: float, panel: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes the output for a terminal
    monkeypatch.setenv("TERM", "xterm")
    decision = Decision(*[0] * len(Decision._fields))
    with live_view("a bundle", ("a", "b"), 0, False, deadline_us) as watch:
        watch(a_run(7), Output([decision], [], None))
    assert ("a bundle" in capsys.readouterr().err) is panel
