"""What has arrived is decided and recorded to the last message, also when the link breaks while acting on the first."""

from types import SimpleNamespace

import numpy as np
import pytest
from live_status import small_status

from pans.base.errors import LinkError
from pans.decide import DECISION_DTYPE, Action, Output
from pans.live.receiver import Batch, Pulse, Taken, has_host_clock, why_fed
from pans.live.stream import stop, take
from pans.protocol.wire import DeviceState, Frame, FrameDecoder, StateReason
from pans.protocol.wire.messages import Status, encode_status

NO_ROWS = np.zeros(0, DECISION_DTYPE)


def test_a_link_that_breaks_under_a_pulse_loses_nothing_that_has_arrived(monkeypatch: pytest.MonkeyPatch) -> None:
    run, shown = small_status(), list[Output]()
    run.show = lambda run, output: shown.append(output)

    def broken(data: bytes) -> None:
        raise LinkError("the port is gone")

    monkeypatch.setattr(run.session.link, "write", broken)
    ahead = run.session.known_clock().to_tick(run.now_ns() + 10**9)
    for at_ns in range(3):
        action = Action(at_ns, ahead, ahead, 1, 0)
        taken = Taken(Frame(0x90, 0, 1, b""), Output([], [], None, (), (action,)), (at_ns, at_ns, at_ns))
        assert take(run, Batch(None, NO_ROWS, pulses=[Pulse(action, 0, 0)], odd=taken))
    assert len(shown) == run.accounts.gates.counters.asked == 3
    with pytest.raises(LinkError, match="the port is gone"):
        run.session.raise_broken()
    run.session.raise_broken()  # raised once
    run.session.close()


def test_a_status_that_waited_is_held_against_its_own_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    """A host that was held up finds many at once, and its session knows the last of them before the first is judged."""
    run, came = small_status(), list[tuple[int | None, int]]()
    monkeypatch.setattr(run.accounts.lateness.evidence, "stamped", lambda at: came.append((at.left_ns, at.arrival_ns)))
    clock, now_ns = run.session.known_clock(), run.now_ns()
    ticks = [clock.to_tick(now_ns + later_ns) for later_ns in (0, 10**6, 2 * 10**6)]
    waited = [Status(DeviceState.RUNNING, StateReason.NONE, 1000, 0, tick, 0) for tick in ticks]
    frames = FrameDecoder().feed(b"".join(encode_status(status, 7) for status in waited))
    at_once = now_ns + 10**6 + 10**5  # the third is of a time to come
    for frame in frames:
        take(run, Batch(None, NO_ROWS, odd=Taken(frame, Output([], [], None), (at_once, at_once, at_once))))
    assert came == [(clock.to_host_ns(tick)[0], at_once) for tick in ticks]
    assert sum(run.accounts.contradictions.values()) == 1
    run.session.close()


def test_a_session_that_was_never_armed_is_only_pumped() -> None:
    """A run that is ended while it reconnects: the receiver may hold the link before, whose descriptor may be another file's by now."""
    run = small_status()
    stop(run)
    assert run.stopped
    assert run.session.is_dark
    run.session.close()


def test_who_reads_the_link() -> None:
    """The kernel reads a descriptor whose times are the host's; Python reads all else and hands the bytes on."""
    virtual = SimpleNamespace(virtual=True, now_ns=lambda: 7)
    assert "virtual time" in why_fed(virtual)  # type: ignore[arg-type]
    other = SimpleNamespace(virtual=False, fileno=lambda: 0, now_ns=lambda: 7)
    assert "clock of its own" in why_fed(other)  # type: ignore[arg-type]
    assert not has_host_clock(other)  # type: ignore[arg-type]
