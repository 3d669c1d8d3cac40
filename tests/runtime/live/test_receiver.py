"""What has arrived is decided and recorded to the last message, also when the link breaks while acting on the first."""

from types import SimpleNamespace
from typing import Any

import pytest

from pans.base.errors import LinkError
from pans.decide.decision import Action, Output
from pans.live.loop import LiveRun
from pans.live.receiver import Receiver, has_host_clock, why_fed
from pans.protocol.wire import DeviceState, Frame, FrameDecoder, StateReason
from pans.protocol.wire.messages import Status, encode_status


def bare_run(step: Any, monkeypatch: pytest.MonkeyPatch) -> tuple[LiveRun, list[tuple[int, int]]]:
    """A run of which only `take_frame` works; and what was noted of STATUS messages: ticks and arrivals."""
    came: list[tuple[int, int]] = []
    run = LiveRun.__new__(LiveRun)
    run.core = SimpleNamespace(step=step)  # type: ignore[assignment]
    evidence = SimpleNamespace(worked=lambda *times: None, stamped=lambda at: came.append((at.left_ns, at.arrival_ns)))
    run.lateness = SimpleNamespace(evidence=evidence)  # type: ignore[assignment]
    clock = SimpleNamespace(to_host_ns=lambda tick: (tick, 0))
    run.connection = SimpleNamespace(link=SimpleNamespace(now_ns=lambda: 7), known_clock=lambda: clock)  # type: ignore[assignment]
    run.recorder, run._broken, run.taken_here, run.armed = None, None, 0, run.connection
    monkeypatch.setattr(LiveRun, "_account", lambda self, output, times_ns: None)
    return run, came


def test_a_link_that_breaks_under_a_pulse_loses_nothing_that_has_arrived(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Frame] = []

    def step(frame: Frame, standing: object) -> Output:
        seen.append(frame)
        return Output([], [], None, (), (Action(1, 4, 5, 1, 0),))

    def act(self: LiveRun, now_ns: int) -> None:
        raise LinkError("the port is gone")

    run, _ = bare_run(step, monkeypatch)
    monkeypatch.setattr(LiveRun, "_act", act)
    outputs: list[Output] = []
    for at_ns in range(3):
        taken = run.take_frame(at_ns, Frame(0x90, 0, 1, b""))
        assert taken is not None
        run.book_frame(taken, outputs)
    assert len(seen) == len(outputs) == 3
    with pytest.raises(LinkError, match="the port is gone"):
        run.raise_broken()
    run.raise_broken()  # raised once


def test_a_status_that_waited_is_held_against_its_own_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    """A host that was held up finds many at once, and its session knows the last of them before the first is judged."""
    waited = [Status(DeviceState.RUNNING, StateReason.NONE, 1000, 0, tick, 0) for tick in (100, 200, 300)]
    checked: list[tuple[int, int]] = []
    frames = FrameDecoder().feed(b"".join(encode_status(status, 7) for status in waited))
    run, came = bare_run(lambda frame, standing: Output([], [], None), monkeypatch)
    monkeypatch.setattr(LiveRun, "check_tick", lambda self, tick, at_ns: checked.append((tick, at_ns)))
    for at_ns, frame in zip((1, 2, 3), frames):
        taken = run.take_frame(at_ns, frame)
        assert taken is not None
        run.book_frame(taken, [])
    assert checked == came == [(100, 1), (200, 2), (300, 3)]


def test_a_connection_that_was_never_armed_is_only_pumped() -> None:
    """A run that is ended while it reconnects: the receiver still holds the link before, whose descriptor may be another file's by now."""
    asked: list[float] = []
    connection = SimpleNamespace(pump=lambda poll_s: asked.append(poll_s) or [])
    receiver = Receiver(SimpleNamespace(connection=connection), SimpleNamespace(moving=False), prompt=False)  # type: ignore[arg-type]
    receiver.last(0.5)
    assert asked == [0.5]


def test_who_reads_the_link() -> None:
    """The kernel reads a descriptor whose times are the host's; Python reads all else and hands the bytes on."""
    virtual = SimpleNamespace(virtual=True, now_ns=lambda: 7)
    assert "virtual time" in why_fed(virtual)  # type: ignore[arg-type]
    other = SimpleNamespace(virtual=False, fileno=lambda: 0, now_ns=lambda: 7)
    assert "clock of its own" in why_fed(other)  # type: ignore[arg-type]
    assert not has_host_clock(other)  # type: ignore[arg-type]
