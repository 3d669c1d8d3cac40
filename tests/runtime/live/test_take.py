"""What has arrived is decided and recorded to the last message, also when the link breaks while acting on the first."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pans.runtime.core.decision import Action, Output
from pans.runtime.errors import LinkError
from pans.runtime.link.connection import Arrived
from pans.runtime.live import LiveRun
from pans.runtime.wire.frame import Messages
from pans.runtime.wire.messages import DeviceState, FrameDecoder, StateReason, Status, encode_status


def test_a_link_that_breaks_under_a_pulse_loses_nothing_that_has_arrived(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def step_messages(messages: Messages, place: int) -> tuple[int, Output]:
        seen.append(place)
        return 1, Output([], [], None, (), (Action(place, 5, 1, 0),))

    def act(self: LiveRun, now_ns: int) -> None:
        raise LinkError("the port is gone")

    run = LiveRun.__new__(LiveRun)
    run.core = SimpleNamespace(step_messages=step_messages)  # type: ignore[assignment]
    run.lateness = SimpleNamespace(stepped=lambda begin, end: None)  # type: ignore[assignment]
    run.connection = SimpleNamespace(link=SimpleNamespace(now_ns=lambda: 7))  # type: ignore[assignment]
    run.recorder, run._broken, run.taken_here, run.armed = None, None, 0, run.connection
    monkeypatch.setattr(LiveRun, "_act", act)
    monkeypatch.setattr(LiveRun, "_account", lambda self, output, times_ns, kept: None)
    messages = Messages(np.zeros(8, np.uint8), np.zeros((3, 2), np.int64))
    with pytest.raises(LinkError, match="the port is gone"):
        run.take([Arrived(1, messages)])
    assert seen == [0, 1, 2]
    assert run.take([]) == []  # told once


def test_a_status_that_waited_is_held_against_its_own_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    """A host that was held up finds many at once, and its session knows the last of them before the first is judged."""
    waited = [Status(DeviceState.RUNNING, StateReason.NONE, 1000, 0, tick, 0) for tick in (100, 200, 300)]
    checked: list[tuple[int, int]] = []
    came: list[tuple[int, int]] = []
    decoder = FrameDecoder()
    frames = decoder.feed(b"".join(encode_status(status, 7) for status in waited))
    run = LiveRun.__new__(LiveRun)
    run.core = SimpleNamespace(step=lambda frame: Output([], [], None))  # type: ignore[assignment]
    run.lateness = SimpleNamespace(  # type: ignore[assignment]
        stepped=lambda begin, end: None, status_came=lambda link, status, at_ns: came.append((status.tick, at_ns))
    )
    session = SimpleNamespace(status=waited[-1])
    run.connection = SimpleNamespace(link=SimpleNamespace(now_ns=lambda: 7), session=session)  # type: ignore[assignment]
    run.recorder, run._broken, run.taken_here, run.armed = None, None, 0, run.connection
    monkeypatch.setattr(LiveRun, "_account", lambda self, output, times_ns, kept: None)
    monkeypatch.setattr(LiveRun, "check_tick", lambda self, tick, at_ns: checked.append((tick, at_ns)))
    run.take([Arrived(at_ns, frame) for at_ns, frame in zip((1, 2, 3), frames)])
    assert checked == came == [(100, 1), (200, 2), (300, 3)]
