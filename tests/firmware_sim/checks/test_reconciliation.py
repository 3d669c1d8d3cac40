"""The books of a run must agree, and each comparison must be able to fail: every test but the first breaks one of them on purpose."""

from __future__ import annotations

import zlib
from typing import Any

import pytest

from pans.firmware_sim.checks import reconciliation
from pans.firmware_sim.device.stream_buffer import StreamBuffer
from pans.firmware_sim.trials.fault_grid import run_case
from pans.runtime.record import Recorder
from pans.runtime.wire import FrameDecoder, Status, StreamTracker
from pans.runtime.wire import messages as wire


@pytest.mark.parametrize("seed", [0, 3])
def test_the_books_agree_when_the_host_stands_still_beyond_the_lease(seed: int) -> None:
    result = run_case("host_stop", seed, 14_000)
    assert result.violations == [], result.violations
    assert result.faults["pauses"] > 0


def violations(case: str = "loss") -> str:
    return "; ".join(run_case(case, 0, 3_000).violations)


def test_a_message_that_is_not_recorded_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Recorder._add_bytes

    def forgetful(self: Recorder, buffer: Any, host_ns: int, data: bytes) -> None:
        if zlib.crc32(data) % 100 or buffer is not self._messages:
            original(self, buffer, host_ns, data)

    monkeypatch.setattr(Recorder, "_add_bytes", forgetful)
    monkeypatch.setattr(Recorder, "add_messages", slow_add_messages)
    assert "messages arrived" in violations()


def slow_add_messages(self: Recorder, host_ns: int, messages: Any, first: int, count: int) -> None:
    for place in range(first, first + count):
        self.add_message(host_ns, wire.pack_body(messages.frame(place)))


def test_a_frame_that_is_not_counted_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconciliation, "FrameDecoder", type("Deaf", (FrameDecoder,), {"_decode": deaf_decode}))
    assert "on the wire were" in violations()


def deaf_decode(self: FrameDecoder, raw: bytes) -> Any:
    frame = _decode(self, raw)
    self._counters.frames -= frame is not None and frame.type == wire.MessageType.PONG
    return frame


_decode = FrameDecoder._decode


def test_a_closing_status_that_claims_other_numbers_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = wire.encode_status

    def boastful(status: Status, session: int) -> bytes:
        return original(status._replace(drops=status.drops + 7), session)

    monkeypatch.setattr(wire, "encode_status", boastful)
    assert "STATUS claims (exposures, drops)" in violations("none")


def test_drops_that_the_host_does_not_know_of_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    grant = StreamBuffer.grant
    monkeypatch.setattr(StreamBuffer, "grant", lambda self, limit: grant(self, self.sequence + 40))  # a narrow window
    monkeypatch.setattr("pans.firmware_sim.device.instrument.BUFFER_MESSAGES", 4)
    original = StreamTracker._gap_before

    def silent(self: StreamTracker, exposure_index: int, drops: int, **end: bool) -> Any:
        return original(self, exposure_index, 0, **end)

    assert violations("none") == ""
    monkeypatch.setattr(StreamTracker, "_gap_before", silent)
    assert "the device dropped" in violations("none")
