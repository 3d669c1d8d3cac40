"""Pulses: on time or not at all; nothing waits in a stalled queue beyond its time; every fate is counted and told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from pans.runtime.core.decision import Action
from pans.runtime.errors import UsageError
from pans.runtime.instrument.profile import load_profile
from pans.runtime.live.gates import MAX_WAITING, GateQueue, open_actuator
from pans.runtime.live.journal import Journal
from pans.runtime.timing.clock import ClockModel
from pans.runtime.wire import messages as wire
from pans.runtime.wire.messages import Ack, AckStatus, FrameDecoder
from pans.runtime.wire.session import HostSession

MS = 1_000_000
PROFILE = load_profile("flow-snspd")
TICK_HZ = 1_000_000  # one tick per microsecond, device time = host time


def clock() -> ClockModel:
    model = ClockModel(TICK_HZ)
    for n in range(8):
        model.add_probe(n * MS, n * 1000, n * 1000, n * MS)
    return model


class Bench:
    """A queue, a session that has shaken hands, and the answers of a device."""

    def __init__(self) -> None:
        self.journal, self.clock = Journal(None), clock()
        self.queue = GateQueue(None, self.journal)
        self.failed: list[int] = []
        self.queue.failed = self.failed.append
        self.session = HostSession(9)
        self.session.start(0)
        welcome = wire.encode_welcome({"epoch": 1}, 9)
        self.session.on_frame(FrameDecoder().feed(welcome)[0], 0)
        self.session.take_output()

    def turn(self, now_us: int) -> list[int]:
        """One turn at `now_us`; return the ids of the commands that left."""
        self.queue.turn(self.session, self.clock, now_us * 1000)
        self.session.poll(now_us * 1000)
        frames = FrameDecoder().feed(self.session.take_output())
        return [wire.decode_command(frame.payload).command_id for frame in frames]

    def answer(self, last: int, refused: int = 0, text: str = "") -> None:
        ack = Ack(last, refused, AckStatus.TOO_LATE if refused else AckStatus.DONE, text, 0)
        self.session.on_frame(FrameDecoder().feed(wire.encode_ack(ack, 9))[0], 10 * MS)

    def kinds(self) -> list[str]:
        return [event["kind"] for event in self.journal.events]


def pulse(number: int, tick: int) -> Action:
    return Action(number, tick, 50, 0)


def test_a_pulse_is_sent_at_once_and_counts_when_it_was_accepted() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 20_000)])
    assert bench.turn(10_000) == [1]
    assert bench.queue.counters.done == 0
    bench.answer(1)
    bench.turn(10_100)
    assert bench.queue.summary() == {"asked": 1, "done": 1, "refused": 0, "expired": 0}


def test_decisions_are_on_record_before_the_first_pulse_leaves() -> None:
    bench, told = Bench(), list[str]()
    submit = bench.session.submit
    recorder: Any = SimpleNamespace(flush_decisions=lambda: told.append("flushed"))
    bench.queue = GateQueue(recorder, bench.journal)
    bench.session.submit = lambda *words, **more: told.append("sent") or submit(*words, **more)  # type: ignore[method-assign,func-returns-value]
    bench.queue.take([pulse(0, 50_000), pulse(1, 51_000)])
    assert len(bench.turn(10_000)) == 2
    assert told == ["flushed", "sent", "sent"]
    assert bench.turn(11_000) == []
    assert told == ["flushed", "sent", "sent"]


def test_what_is_known_to_be_late_is_never_sent() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 9_000), pulse(5, 20_000)])
    assert bench.turn(10_000) == [1]
    assert bench.failed == [4]
    assert bench.journal.events == [
        {
            "kind": "gate_expired",
            "decision": 4,
            "tick": 9_000,
            "text": "its time passed 1000 us before it could be sent",
        }
    ]


def test_a_refusal_is_told_with_its_decision() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 20_000), pulse(5, 20_010)])
    bench.turn(10_000)
    bench.answer(2, refused=1, text="gate tick has passed")
    bench.turn(10_100)
    assert bench.queue.summary() == {"asked": 2, "done": 1, "refused": 1, "expired": 0}
    assert bench.failed == [4]
    assert bench.journal.events[0]["text"] == "gate tick has passed"


def test_pulses_behind_a_stalled_window_expire_and_are_not_sent_afterwards() -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 20_000 + n) for n in range(20)])
    assert bench.turn(10_000) == [1, 2, 3, 4, 5, 6]
    assert bench.turn(15_000) == []
    bench.answer(6)
    assert bench.turn(30_000) == []
    assert bench.queue.summary() == {"asked": 20, "done": 6, "refused": 0, "expired": 14}
    assert bench.failed == list(range(6, 20))


def test_the_queue_is_bounded() -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 1 << 40) for n in range(MAX_WAITING + 5)])
    assert bench.failed == list(range(5))


def test_another_session_answers_no_pulse_of_the_last_one() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 20_000)])
    bench.turn(10_000)
    bench.session = HostSession(10)
    bench.turn(10_100)
    assert bench.queue.summary() == {"asked": 1, "done": 0, "refused": 1, "expired": 0}


def test_the_end_of_a_run_leaves_nothing_unknown() -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 20_000) for n in range(8)])
    bench.turn(10_000)
    bench.answer(3)
    bench.queue.finish(bench.session)
    assert bench.queue.summary() == {"asked": 8, "done": 3, "refused": 3, "expired": 2}
    assert bench.failed == [3, 4, 5, 6, 7]


def test_an_actuator_of_ones_own_gets_host_times() -> None:
    fired: list[tuple[Any, ...]] = []

    class Sorter:
        def fire(self, at_ns: int, duration_us: float, channel: int) -> str:
            fired.append((at_ns, duration_us, channel))
            return "busy" if channel else ""

        def close(self) -> None:
            pass

    bench = Bench()
    bench.queue.actuator = Sorter()
    bench.queue.take([pulse(4, 20_000), Action(5, 21_000, 50, 1)])
    assert bench.turn(10_000) == []
    assert [(round(at / 1000), duration, channel) for at, duration, channel in fired] == [
        (20_000, 50.0, 0),
        (21_000, 50.0, 1),
    ]
    assert bench.queue.summary() == {"asked": 2, "done": 1, "refused": 1, "expired": 0}
    assert bench.failed == [5]
    assert bench.kinds() == ["fired", "fired", "gate_refused"]


def test_unknown_actuators_are_refused_by_name() -> None:
    assert open_actuator("device", PROFILE) is None
    with pytest.raises(UsageError, match="no actuator 'sorter', known: device"):
        open_actuator("sorter:COM3", PROFILE)
