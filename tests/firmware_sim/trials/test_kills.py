"""Hosts that are killed; the long runs are `pans trials kills`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from pans.firmware_sim.trials import kills
from pans.runtime.live import LiveRun
from pans.runtime.record import Recorder

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL and forkserver are not there")


def test_the_light_goes_off_within_a_lease_of_the_hosts_death() -> None:
    result = kills.lease_kills(2)
    assert result["broken"] == []
    assert result["dark_in_time"] == 2


def test_a_killed_recorder_leaves_whole_blocks_and_all_that_was_acted_upon(tmp_path: Path) -> None:
    result = kills.recorder_kills(6, tmp_path, longest_s=0.3)
    assert result["broken"] == []
    assert result["with_actions"] >= 5
    assert result["decisions_median"] > 10


def test_the_judge_sees_a_decision_that_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that is not flushed before acting: what the pipe heard of is not on record."""

    class Enough(Exception):
        pass

    acted: list[int] = []
    for name in ("flush", "flush_decisions"):
        monkeypatch.setattr(Recorder, name, lambda self: None)
    monkeypatch.setattr(kills.os, "write", lambda pipe, data: acted.append(kills.ACTED.unpack(data)[0]))
    original = LiveRun.gate

    def gate(self: LiveRun, tick: int, duration_ticks: int, channel: int) -> int:
        if len(acted) > 10:
            raise Enough
        return original(self, tick, duration_ticks, channel)

    monkeypatch.setattr(LiveRun, "gate", gate)
    path = tmp_path / "unflushed.pansrec"
    with pytest.raises(Enough):
        kills.recording_host(str(path), 0, 1)
    problem, count, _ = kills.judge_recording(path, acted[-1])
    assert "was acted upon, on record are 0" in problem
    assert count == 0
