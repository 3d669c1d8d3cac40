"""Random streams by the plain core and by the compiled turn; `pans fuzz --streams` compares a million. Planted faults are found."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pans.firmware_sim.checks.streams import MODES, StreamCounts, compare_streams
from pans.runtime.cli import main
from pans.runtime.core.window import DecisionWindows
from pans.runtime.flow.cells import CellCore
from pans.runtime.turn.system import offered
from pans.runtime.wire.messages import Frame
from pans.runtime.wire.tracker import StreamTracker

pytestmark = pytest.mark.skipif(bool(offered()), reason="no compiled turn here")


def found(count: int = 200) -> tuple[StreamCounts, str]:
    return compare_streams(3, count)


def test_both_agree_and_the_streams_come_far() -> None:
    counts, wrong = found()
    assert wrong == ""
    assert counts.streams == 200
    assert counts.decisions > 300
    assert 100 < counts.faults < counts.messages / 4
    assert 50 < counts.decisions_flagged < counts.decisions
    assert counts.compiled_messages > 500


def test_the_command_reports_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fuzz", "--streams", "16", "--parts", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["streams"], told["failed_seed"]) == (16, None)


def test_a_window_that_forgets_what_it_lacks_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = DecisionWindows._settle

    def blind(self: DecisionWindows, relative_end: int) -> Any:
        return [window._replace(missing=0) for window in original(self, relative_end)]

    monkeypatch.setattr(DecisionWindows, "_settle", blind)
    assert "Python's" in found(400)[1]


def test_a_message_that_is_not_counted_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = StreamTracker.accept

    def forgetful(self: StreamTracker, frame: Frame) -> Any:
        answer = original(self, frame)
        self.counters.messages -= frame.payload[-1] == 7
        return answer

    monkeypatch.setattr(StreamTracker, "accept", forgetful)
    assert "stream counters" in found(400)[1]


def test_cells_that_are_decided_beside_their_centre_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = CellCore._best_window
    monkeypatch.setattr(CellCore, "_best_window", lambda self, centre: original(self, centre) + 1)
    counts, wrong = found(400)
    assert MODES[(counts.streams - 1) % len(MODES)].startswith("cells")
    assert "decision" in wrong
