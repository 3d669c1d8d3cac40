"""The C core against the simulator's own instrument: the same bytes at the same ticks, and the same answers, blocks and clicks."""

from __future__ import annotations

import random
import struct

import pytest
from c_device import MODES, NONCE, Pair, needs_compiler, strange_frames

from pans.protocol.wire import MessageType, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Gate, Show, pack_command

pytestmark = needs_compiler


def stream(pair: Pair) -> int:
    return sum(frame.type in (MessageType.CLICKS, MessageType.FRAMES) for frame in pair.heard[0])


@pytest.mark.parametrize("mode", MODES)
def test_a_run_is_the_same_on_both(mode: str) -> None:
    pair = Pair(mode)
    pair.open()
    pair.arm(cycles=40)
    hz = pair.profile.clock.tick_hz
    for number in range(50):
        pair.after(hz // 271 + number, wire.encode_ping(number, number, NONCE) if number % 7 == 0 else b"")
    pair.after(3 * hz)
    assert stream(pair) >= 100
    assert pair.differences() == []


@pytest.mark.parametrize("mode", ["device-driven", "sequential"])
def test_a_second_run_draws_other_clicks_and_the_same_on_both(mode: str) -> None:
    pair = Pair(mode)
    pair.open()
    for _ in range(2):
        pair.arm(cycles=30)
        pair.after(pair.profile.clock.tick_hz)
    blocks = [frame.payload[16:] for frame in pair.heard[1] if frame.type == MessageType.CLICKS]
    half = len(blocks) // 2
    assert blocks[:half] != blocks[half:]
    assert pair.differences() == []


def test_what_the_host_names_is_the_same_on_both() -> None:
    pair = Pair("host-driven")
    pair.open()
    pair.arm(cycles=30)
    dice = random.Random(5)
    for exposure in range(0, 110):
        show = Show(exposure, dice.randrange(6), dice.randrange(5), dice.randrange(6), dice.choice((1, 2, 4, 3)))
        pair.command(Opcode.SHOW, pack_command(show), ticks=dice.choice((10, 60, 200)))
    pair.after(pair.profile.clock.tick_hz)
    shown = {
        stamp for f in pair.heard[1] if f.type == MessageType.CLICKS for stamp in wire.decode_clicks(f.payload).patterns
    }
    assert len(shown) > 3
    assert pair.differences() == []


def clicks_of_short_light(dead: float) -> list[bytes]:
    """The C core's clicks in 200 exposures that are lit for a part, of detectors with a dead time; the simulator's are the same."""
    pair = Pair("host-driven", dead=dead)
    pair.open()
    for _ in range(5):
        pair.arm(cycles=15)
        for exposure in range(60):
            pair.command(Opcode.SHOW, pack_command(Show(exposure, 1, exposure % 4, 3, 4)), ticks=1)
        pair.after(pair.profile.clock.tick_hz)
    assert pair.differences() == []
    blocks = [wire.decode_clicks(frame.payload) for frame in pair.heard[1] if frame.type == MessageType.CLICKS]
    assert sum(int((block.patterns == 1).sum()) for block in blocks) > 150
    return [block.bits.tobytes() for block in blocks]


def test_dead_time_and_light_for_a_part_of_an_exposure_are_the_same_on_both() -> None:
    assert clicks_of_short_light(0.0) != clicks_of_short_light(0.9)


@pytest.mark.parametrize("mode", ["sequential", "parallel"])
def test_a_shut_window_holds_back_and_drops_alike(mode: str) -> None:
    pair = Pair(mode, buffer=9)
    pair.open()
    pair.arm(cycles=200, window=20)
    for limit in (20, 25, 25, 60, 1 << 20):
        pair.after(4000, wire.encode_grant(wire.Grant(limit, 0), NONCE))
    pair.after(3 * pair.profile.clock.tick_hz)
    last = [wire.decode_status(frame.payload) for frame in pair.heard[1] if frame.type == MessageType.STATUS][-1]
    assert 0 < last.drops < last.next_exposure
    if mode == "parallel":  # where a mark goes first or second decides whether it is dropped
        assert pair.differences() == []


def test_the_lease_stop_and_gates_are_alike() -> None:
    pair = Pair("sequential")
    pair.open()
    hz = pair.profile.clock.tick_hz
    pair.arm(cycles=0, lease_ms=50)
    for tick, ticks, channel in ((100, 5, 0), (6000, 100, 7), (0, 5, 0), (9000, 0, 1), (9000, 5, 8)):
        pair.command(Opcode.GATE, pack_command(Gate(pair.tick + tick, ticks, channel)))
    pair.after(hz // 50, wire.encode_grant(wire.Grant(1 << 20, 30), NONCE))
    pair.after(hz)  # SAFE
    pair.arm(cycles=1)
    pair.command(Opcode.RESET, b"")
    pair.arm(cycles=5)
    pair.after(7777)
    pair.command(Opcode.STOP, b"x")
    pair.command(Opcode.STOP, b"")
    states = {wire.decode_status(f.payload).state for f in pair.heard[1] if f.type == MessageType.STATUS}
    assert states == {0, 1, 2, 3}
    assert pair.differences() == []


@pytest.mark.parametrize("seed", range(8))
def test_strange_frames_are_answered_alike(seed: int) -> None:
    pair = Pair("device-driven" if seed % 2 else "sequential")
    pair.open(upload=seed % 3 > 0)
    for frame in strange_frames(seed, pair, 300):
        pair.after(seed % 5, frame)
        acks = [f.payload for f in pair.heard[0] if f.type == MessageType.ACK]
        pair.last_id = struct.unpack_from("<I", acks[-1])[0] if acks else 0
    assert len(pair.heard[1]) > 50
    assert pair.differences() == []
