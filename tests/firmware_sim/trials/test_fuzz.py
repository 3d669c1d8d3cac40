"""Strange input at every interface, in short; `pans fuzz` throws a hundred million bytes. Planted bugs must be found."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from pans.firmware_sim.device.gates import GatePulse, Gates
from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.scene.still import load_scene
from pans.firmware_sim.trials.fuzz import fuzz
from pans.runtime.cli import main
from pans.runtime.instrument.profile import load_profile
from pans.runtime.turn.system import offered
from pans.runtime.wire import messages as wire
from pans.runtime.wire.commands import Arm, Gate, PatternChunk, PlanChunk, pack_arm, pack_gate, pack_pattern, pack_plan
from pans.runtime.wire.messages import FrameDecoder, MessageType, Opcode

U32 = st.integers(0, 2**32 - 1)
U64 = st.integers(0, 2**64 - 1)
NONCE = 7


def test_a_short_run_finds_nothing_and_comes_far() -> None:
    counts, failure = fuzz(2, 300_000, 8_000)
    assert failure == ""
    assert counts.bytes == 300_000
    assert counts.frames == 8_000
    assert counts.commands_executed > 100
    assert counts.commands_refused > 100
    assert counts.blocks_accepted > 100
    assert counts.counts_accepted > 10
    assert counts.walks_accepted > 10
    assert counts.flow_accepted > 10
    assert counts.decisions > 100
    assert counts.frames_decoded > 100
    if not offered():
        assert counts.compiled_frames > 1500
        assert counts.compiled_bytes > 100_000


def test_the_command_reports_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fuzz", "--bytes", "20000", "--frames", "400", "--parts", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["failed_seed"] is None


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=400), max_size=8))
def test_the_decoder_accounts_for_every_byte(pieces: list[bytes]) -> None:
    decoder = FrameDecoder()
    good = wire.encode_ping(1, 2, NONCE)
    for piece in pieces:
        decoder.feed(piece)
    decoder.feed(b"\0")
    frames = decoder.feed(good)
    assert [frame.type for frame in frames][-1:] == [MessageType.PING]  # always resynchronises
    assert decoder.counters.bytes_in == sum(map(len, pieces)) + 1 + len(good)


class AnyHost(RuleBasedStateMachine):
    """A host that sends anything in any order; hypothesis looks for the shortest conversation that breaks an invariant."""

    def __init__(self) -> None:
        super().__init__()
        self.device = Instrument(load_profile("ideal"), load_scene("uniform"), buffer_messages=4)
        self.lit_at_most_until = 0
        self.send(wire.encode_hello(NONCE))

    def send(self, data: bytes) -> None:
        self.device.step(self.device.tick, data)

    def command(self, opcode: int, body: bytes = b"") -> None:
        self.send(wire.encode_command(self.device._ack.last_id + 1, opcode, body, NONCE))

    @rule(n=st.integers(0, 3_000_000))
    def wait(self, n: int) -> None:
        self.device.step(self.device.tick + n, b"")

    @rule(limit=U32, lease_ms=U32)
    def grant(self, limit: int, lease_ms: int) -> None:
        self.send(wire.encode_grant(wire.Grant(limit, lease_ms), NONCE))

    @rule()
    def upload(self) -> None:
        self.command(Opcode.LOAD_PATTERN, pack_pattern(PatternChunk(0, 0, 1, np.array([9], np.uint16))))
        slots = np.zeros(2, wire.SLOT_DTYPE)
        slots["offset_ticks"] = [0, 100]
        self.command(Opcode.LOAD_PLAN, pack_plan(PlanChunk(0, 1, 2, 0, 80, 100, 200, 2, 1, slots)))

    @rule(index=st.integers(0, 65535), n=U32, first=U32)
    def odd_pattern(self, index: int, n: int, first: int) -> None:
        self.command(Opcode.LOAD_PATTERN, pack_pattern(PatternChunk(index, first, n, np.array([1], np.uint16))))

    @rule(ahead=st.integers(1, 100), cycles=st.integers(0, 5), lease_ms=st.integers(1, 2000))
    def arm(self, ahead: int, cycles: int, lease_ms: int) -> None:
        self.command(Opcode.ARM, pack_arm(Arm(self.device.tick + ahead, cycles, lease_ms)))

    @rule(start=U64, cycles=U64, lease_ms=U32)
    def odd_arm(self, start: int, cycles: int, lease_ms: int) -> None:
        self.command(Opcode.ARM, pack_arm(Arm(start, cycles, lease_ms)))

    @rule(ahead=st.integers(0, 5000), duration=U32, channel=st.integers(0, 9))
    def gate(self, ahead: int, duration: int, channel: int) -> None:
        self.command(Opcode.GATE, pack_gate(Gate(self.device.tick + ahead, duration, channel)))

    @rule(opcode=st.sampled_from([Opcode.STOP, Opcode.RESET]))
    def plain(self, opcode: Opcode) -> None:
        self.command(opcode)

    @rule(kind=st.integers(0, 255), payload=st.binary(max_size=80), session=st.sampled_from([NONCE, NONCE + 1, 0]))
    def anything(self, kind: int, payload: bytes, session: int) -> None:
        self.send(wire.encode_frame(kind, payload, session))
        if self.device.session != NONCE:
            self.send(wire.encode_hello(NONCE))

    @invariant()
    def light_needs_a_lease(self) -> None:
        if self.device.projector_lit:
            assert self.device._lease_tick is not None
            assert self.device._lease_tick > self.device.tick
        else:
            assert self.device._run is None or self.device.tick < self.device._run.start_tick

    @invariant()
    def memory_is_bounded(self) -> None:
        assert len(self.device.stream._held) <= 4
        assert self.device.decoder.held_bytes <= wire.MAX_FRAME_BYTES


AnyHost.TestCase.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)
TestAnyHost = AnyHost.TestCase


# -- planted bugs --------------------------------------------------------------------------------------------------------


def first_failure(n_bytes: int, n_frames: int) -> str:
    """What the first of eight seeds finds; "" if none does: one may not come as far as the bug."""
    return next((failure for seed in range(1, 9) if (failure := fuzz(seed, n_bytes, n_frames)[1])), "")


def test_a_decoder_without_a_limit_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def greedy(self: FrameDecoder, piece: bytes) -> None:
        self._buffer += piece

    monkeypatch.setattr(FrameDecoder, "_append", greedy)
    failure = first_failure(3_000_000, 0)
    assert "LimitBroken" in failure
    assert "bytes, allowed" in failure or "and, compiled" in failure  # the compiled one keeps its limit


def test_a_missing_length_check_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def trusting(payload: bytes) -> wire.ClickBlock:
        seq, drops, tick, first, period, count, _, index = wire.fields("CLICKS", payload, exact=False)
        patterns = np.frombuffer(payload, "<u2", count, wire.BLOCK_HEADER_BYTES)
        bits = np.unpackbits(np.frombuffer(payload, np.uint8, -1, wire.BLOCK_HEADER_BYTES + 2 * count), count=count)
        return wire.ClickBlock(seq, drops, tick, first, period, index, patterns, bits)

    monkeypatch.setattr(wire, "decode_clicks", trusting)
    failure = first_failure(0, 20_000)
    assert (
        "ValueError" in failure or "tallies" in failure
    )  # an array too short, or one message more than the compiled steps take


def test_pulses_without_a_limit_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    original = Gates.__init__

    def unlimited(self: Gates) -> None:
        original(self)
        self.pulses: Any = [GatePulse(0, 1, 0)] * 5000

    monkeypatch.setattr(Gates, "__init__", unlimited)
    failure = first_failure(0, 4_000)
    assert "remembers more" in failure
