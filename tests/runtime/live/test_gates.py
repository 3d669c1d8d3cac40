"""Pulses: on time or not at all, every fate counted and told; also from a second instrument, whose clock is another."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from links import served

from pans.firmware_sim.device.clock import DeviceClock
from pans.firmware_sim.ports.serve import SimOptions, build_instrument
from pans.runtime.core.decision import Action
from pans.runtime.errors import DeviceError, UsageError
from pans.runtime.instrument.profile import load_profile
from pans.runtime.link.base import open_link
from pans.runtime.link.connection import Connection
from pans.runtime.live.gates import MAX_WAITING, GateQueue, SecondInstrument, idle_plan, open_actuator
from pans.runtime.live.journal import Journal
from pans.runtime.timing.clock import ClockModel
from pans.runtime.wire import messages as wire
from pans.runtime.wire.messages import Ack, AckStatus, DeviceState, FrameDecoder
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
    return Action(number, tick - 1000, tick, 50, 0)


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
    bench.queue.take([pulse(4, 20_000), Action(5, 20_000, 21_000, 50, 1)])
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
    with pytest.raises(UsageError, match="real time"):
        open_actuator("sim:ideal?pace=fast", PROFILE)


PATIENCE_S = 10.0
PULSER = load_profile("ideal")
TCP = "tcp:127.0.0.1:0"


class Served:
    """An instrument that runs in a thread, reached through a real port."""

    def __init__(
        self, stack: ExitStack, profile: str, listen: str = TCP, offset: int = 0, drift_ppm: float = 0.0
    ) -> None:
        options = SimOptions(profile, "uniform", offset=offset, drift_ppm=drift_ppm)
        self.device: Any
        self.clock: DeviceClock
        self.device, self.clock = build_instrument(options, time.perf_counter_ns())
        self._running = stack.enter_context(ExitStack())
        self.port = self._running.enter_context(served(self.device, self.clock, listen))

    @property
    def url(self) -> str:
        """As `--act` takes it."""
        return self.port.url.replace("serial:socket://", "tcp:")

    def vanish(self) -> None:
        self._running.close()
        self.port.close()


@pytest.fixture
def serve_one() -> Iterator[Callable[..., Served]]:
    with ExitStack() as stack:
        yield partial(Served, stack)


def connected(served: Served) -> SecondInstrument:
    second = open_actuator(served.url, PULSER)
    assert isinstance(second, SecondInstrument)
    second.connect()
    return second


class Lab:
    """A first instrument whose clock is known, and a queue that pulses on the second."""

    def __init__(self, first: Served, second: SecondInstrument) -> None:
        self.connection = Connection(open_link(first.port.url))
        self.connection.handshake()
        self.clock: ClockModel = self.connection.synchronise()
        self.journal = Journal(None)
        self.queue = GateQueue(None, self.journal)
        self.failed: list[int] = []
        self.queue.failed = self.failed.append
        self.queue.second = second

    def turns(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        stop_ns = time.perf_counter_ns() + round(seconds * 1e9)
        while time.perf_counter_ns() < stop_ns and not until():
            self.connection.pump(0.001)
            self.queue.turn(self.connection.session, self.clock, time.perf_counter_ns())

    def events(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.journal.events if event["kind"] == kind]

    def close(self) -> None:
        self.queue.finish(self.connection.session)
        self.connection.close()
        self.queue.second.close()


LISTEN = [TCP, *(["pty"] if hasattr(os, "openpty") else [])]


@pytest.mark.parametrize("listen", LISTEN)
def test_pulses_come_when_they_were_asked_for_within_both_uncertainties(
    listen: str, serve_one: Callable[..., Served]
) -> None:
    """Both clocks start elsewhere and run 100 ppm apart; where the pulses really are is taken from the simulators' own clocks."""
    first, other = serve_one("flow-snspd", TCP, 10**12, 50.0), serve_one("ideal", listen, 77, -50.0)
    second = connected(other)
    lab = Lab(first, second)
    asked = []
    for number in range(10):
        tick = lab.clock.to_tick(time.perf_counter_ns() + 400 * MS)
        asked.append(tick)
        lab.queue.take([Action(number, tick, tick, 2000, 3)])
        lab.turns(0.02)
    lab.turns(PATIENCE_S, lambda: lab.queue.counters.done == 10)
    late = lab.clock.to_tick(time.perf_counter_ns() - 5 * MS)
    lab.queue.take([Action(10, late, late, 2000, 3)])  # it is known to be late: never sent
    lab.turns(0.01)
    assert lab.queue.summary() == {"asked": 11, "done": 10, "refused": 0, "expired": 1}
    lab.close()
    pulses = list(other.device.gates.pulses)
    assert [pulse.channel for pulse in pulses] == [3] * 10
    assert not first.device.gates.pulses
    rows = lab.events("gate_sent")
    assert [row["decision"] for row in rows] == list(range(10))
    for tick, pulse, row in zip(asked, pulses, rows):
        off_ns = other.clock.host_ns_at(pulse.tick) - first.clock.host_ns_at(tick)
        assert abs(off_ns) <= row["uncertainty_us"] * 1000
        assert (pulse.end_tick - pulse.tick) / PULSER.clock.tick_hz == pytest.approx(20e-6, rel=0.05)
    facts, kept = second.facts(), second.connection.known_clock().history()
    quickest = np.sort(kept["round_trip_ns"][-10:])  # of those while it ran: none had to wait for the next look
    assert quickest[2] < 15 * MS
    assert facts["worst_uncertainty_us"] == max(row["uncertainty_us"] for row in rows) < 50_000
    assert facts["drift_ppm"] is not None
    assert other.device.state == DeviceState.IDLE  # told to stop
    assert other.device.gates.refused == 0


def test_what_the_second_instrument_refuses_is_counted_and_told(serve_one: Callable[..., Served]) -> None:
    first, other = serve_one("flow-snspd"), serve_one("ideal")
    lab = Lab(first, connected(other))
    tick = lab.clock.to_tick(time.perf_counter_ns() + 200 * MS)
    lab.queue.take([Action(1, tick, tick, 100, 99), Action(2, tick, tick, 100, 0)])  # there is no output 99
    lab.turns(PATIENCE_S, lambda: lab.queue.counters.done == 1)
    assert lab.queue.summary() == {"asked": 2, "done": 1, "refused": 1, "expired": 0}
    assert lab.failed == [1]
    assert "channels are 0..7" in lab.events("gate_refused")[0]["text"]
    lab.close()


def test_a_second_instrument_that_is_gone_does_not_end_the_run(serve_one: Callable[..., Served]) -> None:
    first, other = serve_one("flow-snspd"), serve_one("ideal")
    lab = Lab(first, connected(other))
    other.vanish()
    lab.turns(PATIENCE_S, lambda: bool(lab.events("actuator_lost")))
    later = lab.clock.to_tick(time.perf_counter_ns() + 500 * MS)
    lab.queue.take([Action(5, later, later, 100, 0)])
    lab.turns(0.01)
    assert lab.queue.summary() == {"asked": 1, "done": 0, "refused": 1, "expired": 0}
    assert lab.failed == [5]
    assert "the second instrument was lost" in lab.events("gate_refused")[0]["text"]
    lab.close()


def test_a_lease_that_ran_out_is_taken_again(serve_one: Callable[..., Served], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pans.runtime.live.gates.LEASE_MS", 100)
    other = serve_one("ideal")
    second = connected(other)
    until = time.perf_counter_ns() + round(PATIENCE_S * 1e9)
    while other.device.state is not DeviceState.SAFE and time.perf_counter_ns() < until:
        time.sleep(0.01)  # the host is away
    assert other.device.state is DeviceState.SAFE
    while other.device.state is not DeviceState.RUNNING and time.perf_counter_ns() < until:
        second.exchange(time.perf_counter_ns(), waits=True)
    assert other.device.state is DeviceState.RUNNING
    second.finish()
    second.close()


def test_another_instrument_than_the_profile_says_is_refused(serve_one: Callable[..., Served]) -> None:
    other = serve_one("ideal")
    second = open_actuator(other.url, load_profile("flow-snspd"))
    assert isinstance(second, SecondInstrument)
    with pytest.raises(DeviceError, match="flow-snspd says parallel"):
        second.connect()
    second.close()


@pytest.mark.parametrize("name", ["ideal", "oled-qcmos", "dmd-spad", "wdm-snspd", "flow-snspd"])
def test_every_profile_carries_the_idle_plan(name: str) -> None:
    profile = load_profile(name)
    plan = idle_plan(profile)
    assert plan.dark_slots_per_cycle == plan.slots_per_cycle == 1
    assert plan.cycle_us >= 1e6 - 1
    assert profile.exposure.min_us * 0.99 <= plan.exposure_us <= profile.exposure.max_us * 1.01
