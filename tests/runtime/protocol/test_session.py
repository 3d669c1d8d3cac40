"""The host's session against a scripted device: times and bytes are arguments, nothing waits."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from pans.base.errors import DeviceError, LinkError
from pans.protocol import session as session_module
from pans.protocol.session import HostSession
from pans.protocol.wire import FrameDecoder, MessageType, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.messages import Ack

MS = 1_000_000
NONCE = 77


def sent(session: HostSession) -> list[wire.Frame]:
    return FrameDecoder().feed(session.take_output())


def deliver(session: HostSession, data: bytes, now_ns: int = 0) -> list[bool]:
    return [session.on_frame(frame, now_ns) for frame in FrameDecoder().feed(data)]


def opened(commands: int = 0, opcode: Opcode = Opcode.STOP, **options: bool) -> HostSession:
    """A session in which so many commands have been sent, or wait for room."""
    session = HostSession(NONCE)
    session.start(0)
    session.take_output()
    deliver(session, wire.encode_welcome({"tick_hz": 1}, NONCE))
    for _ in range(commands):
        session.submit(opcode, **options)
    session.poll(0)
    return session


def acknowledge(session: HostSession, last_id: int, *refusal: Any, now_ns: int = 0) -> list[bool]:
    return deliver(session, wire.encode_ack(Ack(last_id, *(refusal or (0, 0, ""))), NONCE), now_ns)


def ids(frames: list[wire.Frame]) -> list[int]:
    return [wire.decode_command(frame.payload).command_id for frame in frames if frame.type == MessageType.COMMAND]


def test_hello_repeats_until_welcome_and_then_stops() -> None:
    session = HostSession(NONCE)
    session.start(0)
    assert [frame.type for frame in sent(session)] == [MessageType.HELLO]
    session.poll(199 * MS)
    assert sent(session) == []
    session.poll(200 * MS)
    assert [frame.type for frame in sent(session)] == [MessageType.HELLO]
    deliver(session, wire.encode_welcome({"tick_hz": 5}, NONCE))
    assert session.welcome is not None
    assert session.welcome.facts["tick_hz"] == 5
    session.poll(10_000 * MS)
    assert sent(session) == []


def test_a_welcome_that_cannot_be_read_is_named_when_no_other_comes() -> None:
    session, broken = HostSession(NONCE), wire.encode_welcome({"tick_hz": 1}, NONCE)
    (frame,) = FrameDecoder().feed(broken)
    twice = b"\x82" + 2 * b"\xa7tick_hz\x01"  # the key stands twice
    session.start(0)
    session.on_frame(frame._replace(payload=frame.payload[:8] + twice), 0)
    session.poll(4900 * MS)  # the next one may be right
    with pytest.raises(DeviceError, match=r"WELCOME cannot be read: .*a key stands twice"):
        session.poll(5200 * MS)


def test_a_silent_device_ends_the_handshake_loudly() -> None:
    session = HostSession(NONCE)
    session.start(0)
    with pytest.raises(LinkError, match="no WELCOME within 5000 ms"):
        for step in range(100):
            session.poll(step * 100 * MS)


@pytest.mark.parametrize(
    ("name", "value", "words"), [("SCHEMA", 0xBAD, "0x00000bad"), ("PROTOCOL_VERSION", 9, "protocol 9")]
)
def test_another_schema_or_protocol_is_named(name: str, value: int, words: str) -> None:
    session = HostSession(NONCE)
    session.start(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wire, name, value)
        foreign = wire.encode_welcome({}, NONCE)
    with pytest.raises(DeviceError, match=words):
        deliver(session, foreign)


def test_frames_of_another_session_are_counted_and_dropped() -> None:
    session = opened()
    assert deliver(session, wire.encode_status(wire.Status(0, 0, 0, 0, 0, 0), NONCE + 1)) == [False]
    assert session.status is None
    assert session.counters.wrong_session == 1


def test_commands_go_out_in_order_and_at_most_eight_wait() -> None:
    session = opened(12)
    assert ids(sent(session)) == [1, 2, 3, 4, 5, 6, 7, 8]
    for last_id, then in ((3, [9, 10, 11]), (11, [12]), (12, [])):
        assert session.in_flight
        acknowledge(session, last_id)
        session.poll(MS)
        assert ids(sent(session)) == then
    assert session.in_flight == 0


def test_unacknowledged_commands_repeat_at_a_slowing_pace_and_then_give_up() -> None:
    session = opened(2)
    repeats = []
    with pytest.raises(LinkError, match="command 1 was not acknowledged within 10000 ms"):
        for now_ms in range(0, 20_000, 10):
            session.poll(now_ms * MS)
            if frames := ids(sent(session)):
                assert frames == [1, 2]
                repeats.append(now_ms)
    gaps = [later - earlier for earlier, later in itertools.pairwise(repeats)]
    assert gaps[:4] == [250, 500, 1000, 2000]
    assert max(gaps) == 2000
    assert session.counters.retransmissions == 2 * (len(repeats) - 1)


def test_an_acknowledgement_restarts_the_clock_of_the_next_command() -> None:
    session = opened(2)
    session.take_output()
    acknowledge(session, 1, now_ns=9_000 * MS)
    for now_ms, repeated in ((9_200, []), (9_250, [2])):
        session.poll(now_ms * MS)
        assert ids(sent(session)) == repeated


def test_an_acknowledgement_of_a_command_that_was_never_sent_is_counted_and_ignored() -> None:
    session = opened(10)  # 9 and 10 wait for room
    for last_id in (9, 10, 11):
        acknowledge(session, last_id)
    assert (session.counters.implausible, session.in_flight, session.answered) == (3, 10, 0)
    acknowledge(session, 8)
    assert (session.counters.implausible, session.in_flight, session.answered) == (3, 2, 8)


def test_stop_follows_the_commands_that_the_device_may_lack() -> None:
    session = opened(11, Opcode.RESET)
    session.take_output()
    acknowledge(session, 2)
    frames = FrameDecoder().feed(session.stop_frames())
    assert ids(frames) == list(range(3, 13))  # unacknowledged, then waiting, then STOP
    assert [wire.decode_command(frame.payload).opcode for frame in frames] == 9 * [Opcode.RESET] + [Opcode.STOP]
    assert ids(FrameDecoder().feed(session.stop_frames(next_id=20)))[-1] == 20
    assert (session.next_id, session.in_flight, session.take_output()) == (12, 9, b"")


def test_a_refusal_is_raised_once_with_the_devices_words() -> None:
    session = opened(1, Opcode.LOAD_PLAN)
    with pytest.raises(DeviceError, match=r"command 1 \(OUT_OF_RANGE\): slot 9"):
        acknowledge(session, 1, 1, wire.AckStatus.OUT_OF_RANGE, "slot 9")
    assert acknowledge(session, 1, 1, wire.AckStatus.OUT_OF_RANGE, "slot 9") == [False]


def test_a_command_that_may_be_refused_is_reported_and_the_session_goes_on() -> None:
    session = opened(2, Opcode.GATE, may_be_refused=True)
    acknowledge(session, 2, 2, wire.AckStatus.TOO_LATE, "gone", 0b11)
    found = [(refusal.command_id, refusal.status) for refusal in session.refusals]
    assert found == [(1, session_module.UNKNOWN_STATUS), (2, wire.AckStatus.TOO_LATE)]
    assert session.in_flight == 0


def test_an_arm_that_came_too_late_may_be_sent_again() -> None:
    session = opened(1, Opcode.ARM)
    with pytest.raises(session_module.ArmTooLate, match="gone"):
        acknowledge(session, 1, 1, wire.AckStatus.TOO_LATE, "gone")


@pytest.mark.parametrize(("oldest", "waits"), [(2, [2, 3]), (3, [3]), (4, [])])
def test_commands_that_a_kernel_sent_wait_as_its_own_do(oldest: int, waits: list[int]) -> None:
    session = opened(2, Opcode.GATE, may_be_refused=True)
    session.take_output()
    frame = wire.encode_command(3, Opcode.SHOW, b"", NONCE)
    session.continue_from(oldest, 5 * MS, [(3, frame)], Opcode.SHOW)
    assert session.window == (4, oldest, 5 * MS, False)
    for now_ms, repeated in ((254, []), (255, waits)):
        session.poll(now_ms * MS)
        assert ids(sent(session)) == repeated
    if 3 in waits:
        acknowledge(session, 3, 3, wire.AckStatus.TOO_LATE, "gone")
        assert session.refusals[-1].opcode == Opcode.SHOW


def test_a_lost_command_is_repeated_at_once_but_not_for_every_answer() -> None:
    session = opened(3)
    session.take_output()
    for now_ns, repeated in ((MS, [1, 2, 3]), (2 * MS, []), (MS + session_module.FAST_RETRY_NS, [1, 2, 3])):
        acknowledge(session, 0, now_ns=now_ns)
        assert ids(sent(session)) == repeated, now_ns


def test_a_backlog_of_old_answers_repeats_the_commands_once() -> None:
    """Each ACK comes 300 times, spread over seconds, and is read at once: the output must not grow with their number."""
    session = opened(8)
    sent(session)
    for number in range(300):
        acknowledge(session, 0, now_ns=number * 20 * MS)
    assert ids(sent(session)) == list(range(1, 9))
    acknowledge(session, 0, now_ns=300 * 20 * MS)
    assert ids(sent(session)) == list(range(1, 9))
    assert session.counters.retransmissions == 16


def test_stream_and_status_frames_are_handed_on_the_rest_is_digested() -> None:
    session = opened()
    assert deliver(session, wire.encode_mark(wire.Mark(0, 0, 0, 0, 0, 0.0), NONCE)) == [True]
    assert deliver(session, wire.encode_status(wire.Status(1, 0, 5, 0, 9, 0), NONCE)) == [True]
    assert session.status is not None
    assert session.status.tick == 9
    session.probe(2)
    assert deliver(session, wire.encode_pong(wire.Pong(1, 2, 3, 4), NONCE), 55) == [False]
    assert session.pongs.popleft() == (wire.Pong(1, 2, 3, 4), 55)


def test_malformed_and_unknown_messages_are_counted() -> None:
    session = opened()
    assert deliver(session, wire.encode_frame(MessageType.ACK, b"short", NONCE)) == [False]
    assert deliver(session, wire.encode_frame(0x42, b"", NONCE)) == [False]
    assert (session.counters.malformed, session.counters.unknown_type) == (1, 1)


def test_a_probe_counts_once_and_by_its_own_echo() -> None:
    session = opened()
    session.probe(2)
    for pong, now_ns in (((1, 3), 54), ((1, 2), 55), ((1, 2), 60_000), ((9, 2), 70_000)):
        deliver(session, wire.encode_pong(wire.Pong(*pong, 3, 4), NONCE), now_ns)
    assert [arrival_ns for _, arrival_ns in session.pongs] == [55]
    assert (session.counters.implausible, session.counters.stale_probes) == (1, 2)


def test_a_session_knows_of_a_probe_that_has_not_left() -> None:
    session = opened()
    session.grant(10, 1000)
    assert not session.has_probe
    session.probe(2)
    assert session.has_probe
    session.take_output()
    assert not session.has_probe


def test_of_64_probes_without_an_answer_the_oldest_is_given_up() -> None:
    session = opened()
    for number in range(1, session_module.MAX_PROBES + 2):
        session.probe(number)
    for number in (1, 2, session_module.MAX_PROBES + 1):
        deliver(session, wire.encode_pong(wire.Pong(number, number, 3, 4), NONCE))
    assert [pong.probe_id for pong, _ in session.pongs] == [2, session_module.MAX_PROBES + 1]
    assert session.counters.stale_probes == 1


def test_a_device_is_heard_by_frames_of_this_session_alone() -> None:
    session = opened()
    for nonce, now_ns in ((NONCE, 5), (NONCE + 1, 7)):
        deliver(session, wire.encode_status(wire.Status(0, 0, 0, 0, 0, 0), nonce), now_ns)
    assert session.heard_ns == 5


def test_a_device_that_restarts_within_the_session_is_told() -> None:
    session = opened()
    deliver(session, wire.encode_welcome({"tick_hz": 1}, NONCE))
    assert session.counters.repeated_welcomes == 1
    with pytest.raises(LinkError, match="restarted"):
        deliver(session, wire.encode_welcome({"tick_hz": 1, "epoch": 2}, NONCE))


def test_a_full_queue_of_commands_is_refused_not_dropped() -> None:
    session = opened(session_module.COMMAND_WINDOW)
    while session.has_room:
        session.submit(Opcode.STOP)
    assert session.in_flight == session_module.COMMAND_WINDOW + session_module.MAX_WAITING
    with pytest.raises(LinkError, match="256 commands wait"):
        session.submit(Opcode.STOP)


def test_grant_wraps_with_the_sequence() -> None:
    session = opened()
    session.grant((1 << 32) + 5, 1000)
    (frame,) = sent(session)
    assert wire.fields("GRANT", frame.payload) == (5, 1000)


@pytest.mark.parametrize("nonce", [0, -1, 1 << 32])
def test_impossible_nonces(nonce: int) -> None:
    with pytest.raises(ValueError, match="nonce"):
        HostSession(nonce)
