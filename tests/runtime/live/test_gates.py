"""Pulses: on time or not at all, every fate counted and told; also from a second instrument, whose clock is another."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from links import Stepped, served

from pans.base.errors import DeviceError, LinkError, UsageError
from pans.decide.decision import Action
from pans.instrument.profile import load_profile
from pans.live.gates import MAX_WAITING, GateQueue, SecondInstrument, idle_plan, open_actuator
from pans.live.journal import Journal
from pans.live.session import Session
from pans.protocol.clock import ClockModel
from pans.protocol.links.base import open_link
from pans.protocol.session import COMMAND_WINDOW, HostSession
from pans.protocol.wire import AckStatus, DeviceState, FrameDecoder, MessageType, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm, Gate, pack_command
from pans.protocol.wire.messages import Ack
from pans_sim.device.clock import DeviceClock
from pans_sim.ports.serve import SimOptions, build_instrument, open_sim

MS = 1_000_000
PROFILE = load_profile("flow-snspd")
TICK_HZ = 1_000_000  # one tick per microsecond, device time = host time


def clock(tick_hz: int = TICK_HZ) -> ClockModel:
    model = ClockModel(tick_hz)
    for n in range(8):
        tick = n * tick_hz // 1000
        model.add_probe(n * MS, tick, tick, n * MS)
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


@pytest.mark.parametrize("ticks_per_us", [1, 10])
def test_what_is_known_to_be_late_is_never_sent(ticks_per_us: int) -> None:
    bench = Bench()
    bench.clock = clock(ticks_per_us * TICK_HZ)
    bench.queue.take([pulse(4, 9_000 * ticks_per_us), pulse(5, 20_000 * ticks_per_us)])
    assert bench.turn(10_000) == [1]
    assert bench.failed == [4]
    assert bench.journal.events == [
        {
            "kind": "gate_expired",
            "decision": 4,
            "tick": 9_000 * ticks_per_us,
            "text": "its time passed 1000 us before it could be sent",
        }
    ]


def test_a_pulse_at_the_present_tick_is_late_and_one_at_the_next_is_not() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 10_000), pulse(5, 10_001)])
    assert bench.turn(10_000) == [1]
    assert bench.failed == [4]


def test_a_turn_says_whether_there_is_something_to_send() -> None:
    bench = Bench()
    turn = partial(bench.queue.turn, bench.session, bench.clock)
    assert not turn(10 * MS)
    bench.queue.take([pulse(4, 9_000)])
    assert not turn(10 * MS)
    bench.queue.take([pulse(5, 20_000)])
    assert turn(10 * MS)
    assert not turn(10 * MS)


def test_two_commands_of_the_window_are_left_for_what_is_no_pulse() -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 20_000) for n in range(20)])
    assert len(bench.turn(10_000)) == COMMAND_WINDOW - 2
    bench.session.submit(Opcode.RESET)
    assert len(bench.turn(10_000)) == 1
    bench.answer(2)
    assert len(bench.turn(10_000)) == 1


def test_a_pulse_carries_its_tick_length_and_output() -> None:
    bench = Bench()
    bench.queue.take([Action(4, 10_000, 20_000, 70, 3)])
    bench.queue.turn(bench.session, bench.clock, 10 * MS)
    bench.session.poll(10 * MS)
    (frame,) = FrameDecoder().feed(bench.session.take_output())
    command = wire.decode_command(frame.payload)
    assert (command.opcode, command.body) == (Opcode.GATE, pack_command(Gate(20_000, 70, 3)))


def test_a_refusal_of_something_else_is_noted_and_counts_as_no_pulse() -> None:
    bench = Bench()
    bench.session.submit(Opcode.SHOW, may_be_refused=True)
    bench.queue.take([pulse(4, 20_000)])
    assert bench.turn(10_000) == [1, 2]
    bench.answer(2, refused=1, text="no such state")
    bench.turn(10_100)
    assert (bench.queue.counters.done, bench.queue.counters.refused) == (1, 0)
    assert bench.kinds() == ["show_refused"]


def test_a_refusal_is_told_with_its_decision() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 20_000), pulse(5, 20_010)])
    bench.turn(10_000)
    bench.answer(2, refused=1, text="gate tick has passed")
    bench.turn(10_100)
    assert bench.queue.summary() == {"asked": 2, "done": 1, "refused": 1, "expired": 0}
    assert bench.failed == [4]
    assert [event["text"] for event in bench.journal.events] == ["gate tick has passed"]


def test_pulses_behind_a_stalled_window_expire_and_are_not_sent_afterwards() -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 20_000 + n) for n in range(20)])
    assert bench.turn(10_000) == [1, 2, 3, 4, 5, 6]
    assert bench.turn(15_000) == []
    bench.answer(6)
    assert bench.turn(30_000) == []
    assert bench.queue.summary() == {"asked": 20, "done": 6, "refused": 0, "expired": 14}
    assert bench.failed == list(range(6, 20))


@pytest.mark.parametrize("more", [0, 1, 5])
def test_the_queue_is_bounded_and_the_oldest_expire(more: int) -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 1 << 40) for n in range(MAX_WAITING + more)])
    assert bench.failed == list(range(more))
    assert (bench.queue.counters.asked, bench.queue.counters.expired) == (MAX_WAITING + more, more)


def test_another_session_answers_no_pulse_of_the_last_one() -> None:
    bench = Bench()
    bench.queue.take([pulse(4, 20_000)])
    bench.turn(10_000)
    bench.session = HostSession(10)
    bench.turn(10_100)
    assert bench.queue.summary() == {"asked": 1, "done": 0, "refused": 1, "expired": 0}
    assert [event["text"] for event in bench.journal.events] == ["the link was lost before the device answered"]


def test_the_end_of_a_run_leaves_nothing_unknown() -> None:
    bench = Bench()
    bench.queue.take([pulse(n, 20_000) for n in range(8)])
    bench.turn(10_000)
    bench.answer(3)
    bench.queue.finish(bench.session)
    assert bench.queue.summary() == {"asked": 8, "done": 3, "refused": 3, "expired": 2}
    assert bench.failed == [3, 4, 5, 6, 7]
    assert bench.kinds() == 3 * ["gate_refused"] + 2 * ["gate_expired"]


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


def test_an_actuator_is_not_held_back_by_the_devices_command_window_nor_by_its_ticks() -> None:
    fired: list[tuple[Any, ...]] = []
    bench = Bench()
    bench.clock = clock(10 * TICK_HZ)
    bench.queue.actuator = SimpleNamespace(fire=lambda *words: fired.append(words) or "", close=lambda: None)  # type: ignore[func-returns-value]
    for _ in range(COMMAND_WINDOW):
        bench.session.submit(Opcode.RESET)
    bench.queue.take([pulse(n, 200_000) for n in range(20)])
    bench.turn(10_000)
    assert len(fired) == 20
    assert fired[0][0] / MS == pytest.approx(20.0, abs=0.01)
    assert fired[0][1:] == (5.0, 0)
    assert bench.queue.counters.done == 20
    assert bench.journal.events[0]["tick"] == 200_000


def test_unknown_actuators_are_refused_by_name() -> None:
    assert open_actuator("device", PROFILE) is None
    with pytest.raises(UsageError, match="no actuator 'sorter', known: device"):
        open_actuator("sorter:COM3", PROFILE)
    with pytest.raises(UsageError, match="real time"):
        open_actuator("sim:ideal?pace=fast", PROFILE)


PATIENCE_S = 10.0
PULSER = load_profile("ideal")


class Steps:
    """A second instrument in virtual time: nothing waits, and what is sent is read with its time."""

    def __init__(self, **options: int) -> None:
        words = "".join(f"&{name}={value}" for name, value in options.items())
        self.link = Stepped(open_sim(f"sim:ideal?scene=uniform&pace=fast{words}"))
        self.device: Any = self.link.link.device
        self.link.virtual = False
        self.second = SecondInstrument("sim:ideal", self.link, PULSER)
        self.link.virtual = True  # no thread reads

    def armed(self) -> "Steps":
        """After `connect`, and running."""
        self.second.connect()
        self.link.let_pass(0.2)
        self.link.written.clear()
        return self

    def exchange(self, steps: int, step_s: float = 0.001, *, waits: bool = False) -> None:
        for _ in range(steps):
            self.second.exchange(self.link.now_ns(), waits=waits)
            self.link.let_pass(step_s)

    def sent(self, kind: MessageType) -> list[tuple[int, Any]]:
        """When, in ms, what of a kind was sent."""
        return [
            (at_ns // MS, frame.payload)
            for at_ns, data in self.link.written
            for frame in FrameDecoder().feed(data)
            if frame.type == kind
        ]

    def commands(self) -> list[Opcode]:
        return [Opcode(wire.decode_command(body).opcode) for _, body in self.sent(MessageType.COMMAND)]


def gaps(times: list[int]) -> set[int]:
    return set(np.diff(times).tolist())


def test_a_second_instrument_is_probed_kept_and_read_at_its_own_pace() -> None:
    steps = Steps().armed()
    steps.exchange(2000)
    assert gaps([at for at, _ in steps.sent(MessageType.PING)]) == {89}
    grants = steps.sent(MessageType.GRANT)
    assert {wire.fields("GRANT", body) for _, body in grants} == {(0, 2000)}
    assert all(480 <= gap <= 520 for gap in gaps([at for at, _ in grants]))
    assert len(grants) == 4
    assert steps.device.state is DeviceState.RUNNING
    steps.link.read_ns.clear()
    steps.exchange(100)
    assert gaps([at // MS for at in steps.link.read_ns]) == {20}
    steps.link.read_ns.clear()
    steps.link.let_pass(0.02)
    steps.exchange(50, waits=True)
    assert gaps([at // MS for at in steps.link.read_ns]) == {1}


def test_a_pulse_of_a_second_instrument_leaves_at_once_with_its_own_tick() -> None:
    steps = Steps(drift_ppm=80).armed()
    steps.exchange(300)
    clock = steps.second.session.known_clock()
    for length_us, ticks in ((1000.0, round(1000 * clock.tick_hz / 1e6)), (1e-6, 1)):
        now_ns = steps.link.now_ns()
        at_ns = now_ns + 50 * MS
        steps.link.written.clear()
        command_id, tick, uncertainty_ns = steps.second.submit(at_ns, length_us, 3)
        ((sent_ms, body),) = steps.sent(MessageType.COMMAND)
        command = wire.decode_command(body)
        assert (sent_ms, command.command_id) == (now_ns // MS, command_id)
        assert command.body == pack_command(Gate(tick, ticks, 3))
        assert (tick, uncertainty_ns) == (clock.to_tick(at_ns), clock.to_host_ns(tick)[1])
        reads = len(steps.link.read_ns)
        steps.exchange(1)
        assert len(steps.link.read_ns) > reads, "its answer is looked for at once"


def test_a_late_pulse_of_a_second_instrument_is_refused_and_the_session_goes_on() -> None:
    steps = Steps().armed()
    command_id, *_ = steps.second.submit(steps.link.now_ns() - MS, 10.0, 0)
    steps.exchange(50)
    session = steps.second.session.host
    assert [(refusal.command_id, refusal.status) for refusal in session.refusals] == [(command_id, AckStatus.TOO_LATE)]
    assert steps.device.state is DeviceState.RUNNING


@pytest.mark.parametrize("stopped", [False, True])
def test_a_second_instrument_that_went_dark_is_armed_again_once(stopped: bool) -> None:
    steps = Steps().armed()
    if stopped:
        steps.second.session.host.submit(Opcode.STOP)
    else:
        steps.link.let_pass(3.0)
        assert steps.device.state is DeviceState.SAFE
    steps.link.let_pass(1.0)
    steps.link.written.clear()
    steps.exchange(1500)
    assert steps.device.state is DeviceState.RUNNING
    commands = steps.commands()
    assert [command for command in commands if command != Opcode.STOP] == [Opcode.RESET, Opcode.ARM]
    arm = wire.decode_command(steps.sent(MessageType.COMMAND)[-1][1])
    assert arm.body[8:] == pack_command(Arm(0, 0, 2000))[8:]  # behind the start's tick


def without_status(data: bytes) -> bytes:
    frames = [part + b"\0" for part in data.split(b"\0")[:-1]]
    return b"".join(one for one in frames if FrameDecoder().feed(one)[0].type != MessageType.STATUS)


@pytest.mark.parametrize(("hears", "arms_at_s"), [(True, [0, 1, 2]), (False, [0])])
def test_a_second_instrument_is_armed_again_once_a_second_and_not_while_it_has_not_answered(
    hears: bool, arms_at_s: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No STATUS comes any more, so that it seems to be SAFE for ever."""
    steps = Steps().armed()
    steps.link.let_pass(3.5)
    steps.second.session.pump(0.0)
    read = steps.link.read
    monkeypatch.setattr(steps.link, "read", lambda timeout_s: without_status(read(timeout_s)))
    if not hears:
        monkeypatch.setattr(steps.link.link, "write", lambda data: None)
    steps.link.written.clear()
    begun_ms = steps.link.now_ns() // MS
    steps.exchange(2500)
    arms: dict[int, int] = {}
    for at_ms, body in steps.sent(MessageType.COMMAND):
        command = wire.decode_command(body)
        if command.opcode == Opcode.ARM:
            arms.setdefault(command.command_id, at_ms - begun_ms)
    assert [round(at_ms / 1000) for at_ms in arms.values()] == arms_at_s


@pytest.mark.parametrize(("at_ms", "length_ms"), [(300, 100), (-50, 0)])
def test_a_second_instrument_stops_after_its_last_pulse(at_ms: int, length_ms: int) -> None:
    steps = Steps().armed()
    steps.exchange(300)
    begun_ns = steps.link.now_ns()
    steps.second.submit(begun_ns + at_ms * MS, length_ms * 1000.0, 1)
    if at_ms > 0:
        steps.second.submit(begun_ns + 20 * MS, 1000.0, 1)
    steps.second.finish()
    lasted_ms = (steps.link.now_ns() - begun_ns) // MS
    assert max(at_ms + length_ms, 0) <= lasted_ms < max(at_ms + length_ms, 0) + 30
    assert steps.device.state is DeviceState.IDLE
    ends = [pulse.end_tick - pulse.tick for pulse in steps.device.gates.pulses]
    assert max(ends, default=0) == length_ms * PULSER.clock.tick_hz // 1000
    assert steps.commands()[-1] == Opcode.STOP


def test_a_pulse_too_far_ahead_or_without_an_answer_does_not_hold_up_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    far = Steps().armed()
    begun_ns = far.link.now_ns()
    far.second.submit(begun_ns + 5000 * MS, 10.0, 0)
    far.second.finish()
    assert 1000 <= (far.link.now_ns() - begun_ns) // MS < 1050
    assert far.device.state is DeviceState.IDLE
    deaf = Steps().armed()
    begun_ns = deaf.link.now_ns()
    monkeypatch.setattr(deaf.link, "write", lambda data: None)
    deaf.second.submit(begun_ns + 10 * MS, 10.0, 0)
    deaf.second.finish()
    assert 2000 <= (deaf.link.now_ns() - begun_ns) // MS < 2050


def test_what_a_second_instrument_is_before_and_after_it_is_connected() -> None:
    steps = Steps()
    assert steps.second.facts() == {"url": "sim:ideal"}
    with pytest.raises(LinkError, match="sim:ideal: the second instrument is not connected"):
        _ = steps.second.session
    steps.armed()
    steps.second.worst_uncertainty_ns = 2500
    facts, fit = steps.second.facts(), steps.second.session.known_clock().fit
    assert fit is not None
    assert (facts["simulated"], facts["drift_ppm"]) == (True, fit.drift_ppm)
    assert (facts["uncertainty_us"], facts["worst_uncertainty_us"]) == (fit.uncertainty_ns / 1000, 2.5)
    assert facts["serial"] == steps.second.session.host.welcome.facts.get("serial")  # type: ignore[union-attr]


@pytest.mark.parametrize("connected", [False, True])
def test_a_second_instrument_that_is_closed_closes_its_link(connected: bool) -> None:
    steps = Steps()
    if connected:
        steps.armed()
    steps.second.close()
    with pytest.raises(LinkError, match="closed"):
        steps.link.link.read(0.0)


def test_a_link_in_virtual_time_is_closed_when_it_is_refused() -> None:
    link = open_sim("sim:ideal?scene=uniform&pace=fast")
    with pytest.raises(UsageError, match="real time"):
        SecondInstrument("sim:ideal", link, PULSER)
    with pytest.raises(LinkError, match="closed"):
        link.read(0.0)


@pytest.mark.parametrize("wrong", [{"mode": "parallel"}, {"tick_hz": 999}])
def test_mode_and_clock_of_a_second_instrument_are_those_of_its_profile(wrong: dict[str, Any]) -> None:
    steps = Steps()
    mode, tick_hz = wrong.get("mode", PULSER.mode), wrong.get("tick_hz", PULSER.clock.tick_hz)
    profile: Any = SimpleNamespace(name="mine", mode=mode, clock=SimpleNamespace(tick_hz=tick_hz))
    steps.second.profile = profile
    with pytest.raises(DeviceError, match=f"mine says {mode} at {tick_hz}"):
        steps.second.connect()


def test_the_worst_uncertainty_of_a_pulse_is_that_of_both_clocks() -> None:
    steps, bench = Steps().armed(), Bench()
    bench.queue.second = steps.second
    bench.clock = clock()
    now_us = steps.link.now_ns() // 1000
    bench.queue.take([pulse(1, now_us + 10_000_000), pulse(2, now_us + 50_000)])
    bench.queue.turn(bench.session, bench.clock, steps.link.now_ns())
    far, near = bench.journal.events
    assert [event["kind"] for event in (far, near)] == 2 * ["gate_sent"]
    for event in (far, near):
        own_ns = steps.second.session.known_clock().to_host_ns(event["second_tick"])[1]
        assert event["uncertainty_us"] == (bench.clock.to_host_ns(event["tick"])[1] + own_ns) / 1000
    assert steps.second.worst_uncertainty_ns == far["uncertainty_us"] * 1000 > near["uncertainty_us"] * 1000


def test_the_queue_looks_soon_for_the_answer_of_a_second_instrument_and_has_it_at_the_end() -> None:
    steps, bench = Steps().armed(), Bench()
    bench.queue.second = steps.second

    def turns(n: int) -> set[int]:
        steps.link.read_ns.clear()
        for _ in range(n):
            bench.queue.turn(bench.session, bench.clock, steps.link.now_ns())
            steps.link.let_pass(0.001)
        return gaps([at_ns // MS for at_ns in steps.link.read_ns])

    turns(30)
    assert turns(100) == {20}
    write = steps.link.write
    steps.link.write = lambda data: None  # type: ignore[method-assign]
    bench.queue.take([pulse(1, steps.link.now_ns() // 1000 + 1_500_000)])
    turns(2)
    assert turns(50) == {1}
    steps.link.write = write  # type: ignore[method-assign]
    bench.queue.finish(bench.session)
    assert bench.queue.summary() == {"asked": 1, "done": 1, "refused": 0, "expired": 0}


@pytest.mark.parametrize("refuses", [False, True])
def test_a_second_instrument_that_is_lost_is_noted_once_with_what_it_had_not_answered(
    refuses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, bench = Steps().armed(), Bench()
    bench.queue.second = steps.second
    now_ns = steps.link.now_ns()
    bench.queue.take([pulse(1, now_ns // 1000 + 50_000)])
    bench.queue.turn(bench.session, bench.clock, now_ns)
    if refuses:
        monkeypatch.setattr(steps.second, "exchange", Mock(side_effect=DeviceError("it refused ARM")))
    else:
        steps.link.link.close()
    bench.queue.take([pulse(2, now_ns // 1000 + 60_000)])
    for _ in range(3):
        bench.queue.turn(bench.session, bench.clock, now_ns + 30 * MS)
    bench.queue.finish(bench.session)
    assert bench.kinds() == ["gate_sent", "actuator_lost", "gate_refused", "gate_refused"]
    assert all(event["text"].startswith("the second instrument was lost") for event in bench.journal.events[2:])
    assert bench.queue.summary() == {"asked": 2, "done": 0, "refused": 2, "expired": 0}


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
        self.session = Session(open_link(first.port.url))
        self.session.handshake()
        self.clock: ClockModel = self.session.synchronise()
        self.journal = Journal(None)
        self.queue = GateQueue(None, self.journal)
        self.failed: list[int] = []
        self.queue.failed = self.failed.append
        self.queue.second = second

    def turns(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        stop_ns = time.perf_counter_ns() + round(seconds * 1e9)
        while time.perf_counter_ns() < stop_ns and not until():
            self.session.pump(0.001)
            self.queue.turn(self.session.host, self.clock, time.perf_counter_ns())

    def events(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.journal.events if event["kind"] == kind]

    def close(self) -> None:
        self.queue.finish(self.session.host)
        self.session.close()
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
    facts, kept = second.facts(), second.session.known_clock().history()
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
    assert plan.cycle_us == pytest.approx(1e6, abs=1)
    tick_us = 1e6 / profile.clock.tick_hz
    assert plan.exposure_us == pytest.approx(max(profile.exposure.min_us, tick_us), abs=tick_us)


@pytest.mark.parametrize(("min_us", "exposure_us", "cycle_us"), [(1e-9, 1e-1, 1e6), (2e6, 2e6, 2e6)])
def test_the_idle_plan_has_an_exposure_of_at_least_a_tick_and_a_cycle_that_holds_it(
    min_us: float, exposure_us: float, cycle_us: float
) -> None:
    exposure = replace(PULSER.exposure, min_us=min_us, max_us=1e7)
    plan = idle_plan(replace(PULSER, exposure=exposure))
    assert plan.exposure_us == pytest.approx(max(exposure_us, 1e6 / PULSER.clock.tick_hz), rel=0.5)
    assert cycle_us <= plan.cycle_us < 2 * cycle_us
