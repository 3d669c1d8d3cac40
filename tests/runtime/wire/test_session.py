"""The host's session against a scripted device: times and bytes are arguments, nothing waits."""

from __future__ import annotations

import itertools

import pytest

from pans.runtime.errors import DeviceError, LinkError
from pans.runtime.wire import messages as wire
from pans.runtime.wire import session as session_module
from pans.runtime.wire.messages import Ack, FrameDecoder, MessageType, Opcode
from pans.runtime.wire.session import HostSession

MS = 1_000_000
NONCE = 77


def sent(session: HostSession) -> list[wire.Frame]:
    return FrameDecoder().feed(session.take_output())


def deliver(session: HostSession, data: bytes, now_ns: int = 0) -> list[bool]:
    return [session.on_frame(frame, now_ns) for frame in FrameDecoder().feed(data)]


def opened() -> HostSession:
    session = HostSession(NONCE)
    session.start(0)
    session.take_output()
    deliver(session, wire.encode_welcome({"tick_hz": 1}, NONCE))
    return session


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


def test_another_schema_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    session = HostSession(NONCE)
    session.start(0)
    real = wire.SCHEMA
    monkeypatch.setattr(wire, "SCHEMA", 0xBAD)
    foreign = wire.encode_welcome({}, NONCE)
    monkeypatch.setattr(wire, "SCHEMA", real)
    with pytest.raises(DeviceError, match="0x00000bad"):
        deliver(session, foreign)


def test_frames_of_another_session_are_counted_and_dropped() -> None:
    session = opened()
    assert deliver(session, wire.encode_status(wire.Status(0, 0, 0, 0, 0, 0), NONCE + 1)) == [False]
    assert session.status is None
    assert session.counters.wrong_session == 1


def test_commands_go_out_in_order_and_at_most_eight_wait() -> None:
    session = opened()
    for _ in range(12):
        session.submit(Opcode.STOP)
    session.poll(0)
    assert ids(sent(session)) == [1, 2, 3, 4, 5, 6, 7, 8]
    deliver(session, wire.encode_ack(Ack(3, 0, 0, ""), NONCE))
    session.poll(1 * MS)
    assert ids(sent(session)) == [9, 10, 11]
    assert session.in_flight
    deliver(session, wire.encode_ack(Ack(11, 0, 0, ""), NONCE))
    session.poll(2 * MS)
    assert ids(sent(session)) == [12]
    deliver(session, wire.encode_ack(Ack(12, 0, 0, ""), NONCE))
    assert session.in_flight == 0


def test_unacknowledged_commands_repeat_at_a_slowing_pace_and_then_give_up() -> None:
    session = opened()
    session.submit(Opcode.STOP)
    session.submit(Opcode.RESET)
    repeats = []
    with pytest.raises(LinkError, match="command 1 was not acknowledged within 10000 ms"):
        for now_ms in range(0, 20_000, 10):
            session.poll(now_ms * MS)
            frames = ids(sent(session))
            if frames:
                assert frames == [1, 2]
                repeats.append(now_ms)
    gaps = [later - earlier for earlier, later in itertools.pairwise(repeats)]
    assert gaps[:4] == [250, 500, 1000, 2000]
    assert max(gaps) == 2000
    assert session.counters.retransmissions == 2 * (len(repeats) - 1)


def test_an_acknowledgement_restarts_the_clock_of_the_next_command() -> None:
    session = opened()
    session.submit(Opcode.STOP)
    session.submit(Opcode.STOP)
    session.poll(0)
    session.take_output()
    deliver(session, wire.encode_ack(Ack(1, 0, 0, ""), NONCE), 9_000 * MS)
    session.poll(9_200 * MS)
    assert sent(session) == []
    session.poll(9_250 * MS)
    assert ids(sent(session)) == [2]


def test_an_acknowledgement_of_a_command_that_was_never_sent_is_counted_and_ignored() -> None:
    session = opened()
    for _ in range(10):
        session.submit(Opcode.STOP)
    session.poll(0)  # 9 and 10 wait for room
    session.take_output()
    for last_id in (9, 10, 11):
        deliver(session, wire.encode_ack(Ack(last_id, 0, 0, ""), NONCE))
    assert (session.counters.implausible, session.in_flight, session.answered) == (3, 10, 0)
    deliver(session, wire.encode_ack(Ack(8, 0, 0, ""), NONCE))
    assert (session.counters.implausible, session.in_flight, session.answered) == (3, 2, 8)


def test_stop_follows_the_commands_that_the_device_may_lack() -> None:
    session = opened()
    for _ in range(11):
        session.submit(Opcode.RESET)
    session.poll(0)
    session.take_output()
    deliver(session, wire.encode_ack(Ack(2, 0, 0, ""), NONCE))
    frames = FrameDecoder().feed(session.stop_frames())
    assert ids(frames) == list(range(3, 13))  # unacknowledged, then waiting, then STOP
    assert [wire.decode_command(frame.payload).opcode for frame in frames] == 9 * [Opcode.RESET] + [Opcode.STOP]
    assert ids(FrameDecoder().feed(session.stop_frames(next_id=20)))[-1] == 20
    assert (session.next_id, session.in_flight, session.take_output()) == (12, 9, b"")


def test_a_refusal_is_raised_once_with_the_devices_words() -> None:
    session = opened()
    session.submit(Opcode.LOAD_PLAN)
    session.poll(0)
    with pytest.raises(DeviceError, match=r"command 1 \(OUT_OF_RANGE\): slot 9"):
        deliver(session, wire.encode_ack(Ack(1, 1, wire.AckStatus.OUT_OF_RANGE, "slot 9"), NONCE))
    assert deliver(session, wire.encode_ack(Ack(1, 1, wire.AckStatus.OUT_OF_RANGE, "slot 9"), NONCE)) == [False]


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


def test_an_answer_with_another_echo_is_no_probe() -> None:
    session = opened()
    session.probe(2)
    deliver(session, wire.encode_pong(wire.Pong(1, 3, 3, 4), NONCE), 55)
    assert (session.counters.implausible, len(session.pongs)) == (1, 0)
    deliver(session, wire.encode_pong(wire.Pong(1, 2, 3, 4), NONCE), 56)
    assert len(session.pongs) == 1


def test_a_lost_command_is_repeated_at_once_but_not_for_every_answer() -> None:
    session = opened()
    for _ in range(3):
        session.submit(Opcode.STOP)
    session.poll(0)
    assert ids(sent(session)) == [1, 2, 3]
    nothing_done = wire.encode_ack(Ack(0, 0, 0, ""), NONCE)
    for now_ns, repeated in ((MS, [1, 2, 3]), (2 * MS, []), (MS + session_module.FAST_RETRY_NS, [1, 2, 3])):
        deliver(session, nothing_done, now_ns)
        assert ids(sent(session)) == repeated, now_ns


def test_a_probe_counts_once() -> None:
    session = opened()
    session.probe(2)
    answer = wire.encode_pong(wire.Pong(1, 2, 3, 4), NONCE)
    deliver(session, answer, 55)
    deliver(session, answer, 60_000)
    deliver(session, wire.encode_pong(wire.Pong(9, 2, 3, 4), NONCE), 70_000)
    assert [arrival_ns for _, arrival_ns in session.pongs] == [55]
    assert session.counters.stale_probes == 2


def test_a_command_that_may_be_refused_is_reported_and_the_session_goes_on() -> None:
    session = opened()
    first = session.submit(Opcode.GATE, b"", may_be_refused=True)
    second = session.submit(Opcode.GATE, b"", may_be_refused=True)
    session.poll(0)
    deliver(session, wire.encode_ack(Ack(2, 2, wire.AckStatus.TOO_LATE, "gone", 0b11), NONCE))
    assert [refusal.command_id for refusal in session.refusals] == [first, second]
    assert [refusal.status for refusal in session.refusals] == [session_module.UNKNOWN_STATUS, wire.AckStatus.TOO_LATE]
    assert session.in_flight == 0


def test_a_device_that_restarts_within_the_session_is_told() -> None:
    session = opened()
    deliver(session, wire.encode_welcome({"tick_hz": 1}, NONCE))
    assert session.counters.repeated_welcomes == 1
    with pytest.raises(LinkError, match="restarted"):
        deliver(session, wire.encode_welcome({"tick_hz": 1, "epoch": 2}, NONCE))


def test_a_full_queue_of_commands_is_refused_not_dropped() -> None:
    session = opened()
    for _ in range(session_module.MAX_WAITING):
        session.submit(Opcode.STOP)
    assert not session.has_room
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
