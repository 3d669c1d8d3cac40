"""The instrument as a state machine: golden conversations, limits, and what must never happen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instrument_bench import IDEAL, NONCE, POWER_ON, Bench, greeted, of_type, plan, slots_at

from pans.instrument.click_law import click_law, click_probability, object_transmission
from pans.instrument.profile import load_profile
from pans.protocol.wire import DARK_PATTERN, AckStatus, DeviceState, MessageType, Opcode, StateReason
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm, Gate, PatternChunk, pack_command
from pans_sim.device.gates import GATE_CHANNELS, MAX_PENDING_GATES, GatePulse
from pans_sim.device.upload import word_bytes
from pans_sim.scene.still import scene_from_arrays

FULL = 65535


# -- golden conversations ----------------------------------------------------------------------------------------------


def test_handshake() -> None:
    bench = Bench()
    welcome, status = bench.hello()
    assert (welcome.schema, welcome.protocol) == (wire.SCHEMA, 1)
    expected = {
        "epoch": 1, "tick_hz": 1_000_000, "tick": POWER_ON, "mode": "sequential", "channels": 1, "levels": 65536,
        "pattern_memory": 65535, "buffer_messages": 256, "simulated": True, "profile": "ideal",
    }  # fmt: skip
    assert {key: welcome.facts[key] for key in expected} == expected
    assert {"firmware", "serial", "pattern_pixels", "slot_memory"} <= set(welcome.facts)
    assert status == wire.Status(DeviceState.IDLE, StateReason.POWER_ON, 0, 0, POWER_ON, 0)


def test_a_whole_run_tick_by_tick() -> None:
    bench = Bench().ready(np.array([[0, 0], [FULL, FULL]], np.uint16))
    bench.got.clear()
    bench.arm(start=2000, cycles=2).granted()
    bench.run_to(3000)
    photons = 2 * 10_000.0 * 80e-6
    story = [(tick, message) for tick, message in bench.got if not isinstance(message, wire.ClickBlock | wire.Ack)]
    assert story == [
        (1000, wire.Status(DeviceState.ARMED, StateReason.NONE, 100, 0, 1000, 0)),
        (2000, wire.Status(DeviceState.RUNNING, StateReason.NONE, 99, 0, 2000, 1)),
        (2000, wire.Mark(0, 0, -1, 0, 2000, np.float32(photons))),
        (2300, wire.Mark(2, 1, -1, 3, 2300, np.float32(photons))),
        (2600, wire.Exposed(6, 0, 0, 0, 0)),
        (2600, wire.Status(DeviceState.IDLE, StateReason.COMPLETED, 0, 0, 2600, 6)),
    ]
    blocks = [(tick, message) for tick, message in bench.got if isinstance(message, wire.ClickBlock)]
    assert [(tick, block[:6], block.patterns.tolist()) for tick, block in blocks] == [
        (2280, (1, 0, 2000, 0, 100, 0), [0, 1, DARK_PATTERN]),
        (2580, (3, 0, 2300, 3, 100, 1), [0, 1, DARK_PATTERN]),
    ]
    assert all(not block.bits[[0, 2]].any() for _, block in blocks)  # no light, no dark counts: no clicks
    assert bench.device.next_event_tick() == 1_002_600  # the next STATUS


def test_an_object_lasts_its_cycles() -> None:
    scene = scene_from_arrays("three", np.zeros((3, 2, 2), np.uint8), np.array([5, 6, 7]), tuple("abcdefgh"))
    bench = Bench(scene=scene).ready(cycles_per_object=2).arm(cycles=9).granted()
    marks = of_type(bench.run_to(10_000), wire.Mark)
    assert [(mark.object_index, mark.truth, mark.exposure_index, mark.tick) for mark in marks] == [
        (0, 5, 0, 2000), (1, 6, 6, 2600), (2, 7, 12, 3200), (3, 5, 18, 3800), (4, 6, 24, 4400),
    ]  # fmt: skip


def test_blocks_end_at_their_length_at_a_gap_and_at_the_cycle() -> None:
    slots = slots_at([0, 1, 0, 1, 0, 1])
    slots["offset_ticks"][4:] += 50
    bench = Bench().ready()
    bench.done(Opcode.LOAD_PLAN, pack_command(plan(2, [0] * 6, slots=slots, cycle_ticks=650, block_exposures=3)))
    bench.arm(cycles=1).granted()
    blocks = of_type(bench.run_to(4000), wire.ClickBlock)
    assert [(block.exposure_index, block.tick, len(block.bits)) for block in blocks] == [
        (0, 2000, 3), (3, 2300, 1), (4, 2450, 2),
    ]  # fmt: skip


# -- clicks ------------------------------------------------------------------------------------------------------------


def test_mean_clicks_follow_the_click_law() -> None:
    """More than 1e5 exposures through the whole instrument, on the paper's profile with its modulator and read noise."""
    profile = load_profile("oled-qcmos")
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (4, 3, 3), dtype=np.uint8)
    levels = rng.integers(0, 124, (3, 9)).astype(np.uint16)
    exposure, period = 20_000, 166_667  # ticks of 0.1 us
    order = [0, DARK_PATTERN, 1, 2]
    slots = slots_at(order, period)
    bench = Bench(profile, scene_from_arrays("noise", images, None, ()), seed=77)
    bench.hello()
    bench.upload(levels, order, slots=slots, exposure_ticks=exposure, slot_period_ticks=period, cycle_ticks=4 * period)
    n_cycles = 28_000
    bench.arm(start=2000, cycles=n_cycles, lease_ms=3_600_000)
    counts, n = np.zeros((4, 4)), n_cycles // 4
    end = 2000 + n_cycles * 4 * period
    while bench.device.tick < end:
        bench.grant((1 << 20) + 2 * bench.device.tick // period, 3_600_000)
        for block in of_type(bench.run_to(min(end, bench.device.tick + 10**9)), wire.ClickBlock):
            slot = block.exposure_index % 4
            counts[block.object_index % 4, slot : slot + len(block.bits)] += block.bits
        bench.got.clear()
    peak = profile.projector.peak_photoelectrons_hz * 2000e-6
    lam = object_transmission(profile, images).reshape(4, 9) @ (levels * peak / 123).T
    p = click_probability(click_law(profile, 2000.0), np.insert(lam, 1, 0.0, axis=1))
    z = (counts / n - p) / np.sqrt(p * (1 - p) / n)
    lit = [0, 2, 3]
    assert np.abs(z[:, lit]).max() < 5
    assert abs(counts[:, lit].sum() - n * p[:, lit].sum()) < 5 * np.sqrt(n * (p * (1 - p))[:, lit].sum())
    assert abs(counts[:, 1].sum() - 4 * n * p[0, 1]) < 5 * np.sqrt(4 * n * p[0, 1]) + 1


@pytest.mark.parametrize(
    ("channels", "expected"), [(1, 1), (8, 1), (9, 2), (16, 2), (17, 4), (32, 4), (33, 8), (64, 8), (65, 16), (400, 56)]
)
def test_word_bytes(channels: int, expected: int) -> None:
    assert word_bytes(channels) == expected


# -- chunks and time steps ---------------------------------------------------------------------------------------------


def conversation(bench: Bench) -> bytes:
    """All that a host would send before its run, as one string."""
    patterns = np.full((2, 4), 9000, np.uint16)
    bodies = [(Opcode.LOAD_PATTERN, pack_command(PatternChunk(i, 0, 4, row))) for i, row in enumerate(patterns)]
    bodies.append((Opcode.LOAD_PLAN, pack_command(plan(2, [0, 1, DARK_PATTERN]))))
    bodies.append((Opcode.ARM, pack_command(Arm(2000, 20, 50))))
    commands = [wire.encode_command(number, *body, NONCE) for number, body in enumerate(bodies, start=1)]
    ping, grant = wire.encode_ping(1, 5, NONCE), wire.encode_grant(wire.Grant(1000, 0), NONCE)
    return wire.encode_hello(NONCE) + ping + b"".join(commands) + b"\x07garbage\0" + grant


def test_one_byte_at_a_time_changes_nothing() -> None:
    whole, single = Bench(), Bench()
    data = conversation(whole)
    expected = whole.device.step(1500, data)
    found = b"".join(single.device.step(1500, data[i : i + 1]) for i in range(len(data)))
    assert found == expected
    assert whole.device.step(20_000, b"") == single.device.step(20_000, b"")


@given(cuts=st.lists(st.integers(1501, 20_000), max_size=40))
@settings(max_examples=30, deadline=None)
def test_the_size_of_time_steps_changes_nothing(cuts: list[int]) -> None:
    whole, cut = Bench(), Bench()
    data = conversation(whole)
    assert whole.device.step(1500, data) == cut.device.step(1500, data)
    expected = whole.device.step(20_000, b"")
    assert b"".join(cut.device.step(tick, b"") for tick in [*sorted(cuts), 20_000]) == expected


# -- commands ----------------------------------------------------------------------------------------------------------


def test_pattern_memory_is_limited_in_bytes() -> None:
    bench = greeted()
    levels = np.array([1, 2], np.uint16)
    bodies = [pack_command(PatternChunk(index, 0, 1 << 22, levels)) for index in range(33)]
    acks = [bench.command(Opcode.LOAD_PATTERN, body) for body in bodies]
    assert [ack.refused_id == ack.last_id for ack in acks] == [False] * 32 + [True]


def test_patterns_may_not_change_faster_than_the_projector() -> None:
    profile = replace(IDEAL, projector=replace(IDEAL.projector, pattern_rate_max_hz=5000.0))
    bench = Bench(profile).ready(shown=[0, 0, 1, 1])  # each shown for two exposures: 200 us
    status, said = bench.refused(Opcode.LOAD_PLAN, pack_command(plan(2, [0, 0, 1, 0])))
    assert status == AckStatus.OUT_OF_RANGE
    assert "patterns change after 100 ticks" in said


def test_a_plan_in_two_chunks() -> None:
    bench = Bench().ready()
    whole = plan(2, [0, 1, 0, 1])
    bench.done(Opcode.LOAD_PLAN, pack_command(whole._replace(slots=whole.slots[:3])))
    assert bench.refused(Opcode.ARM, pack_command(Arm(2000, 1, 100)))[0] == AckStatus.WRONG_STATE
    other = whole._replace(first_slot=3, slots=whole.slots[3:])
    assert "does not continue" in bench.refused(Opcode.LOAD_PLAN, pack_command(other._replace(exposure_ticks=90)))[1]
    bench.done(Opcode.LOAD_PLAN, pack_command(other))
    bench.arm(cycles=1).granted()
    assert len(of_type(bench.run_to(3000), wire.ClickBlock)[0].bits) == 4


@given(st.binary(max_size=200), st.sampled_from([*Opcode, 0, 200]))
@settings(max_examples=200, deadline=None)
def test_no_command_body_brings_the_device_down(body: bytes, opcode: int) -> None:
    bench = greeted()
    assert bench.command(opcode, body).last_id == 1


@given(st.binary(max_size=400), st.sampled_from(list(MessageType)))
@settings(max_examples=200, deadline=None)
def test_no_frame_brings_the_device_down(payload: bytes, kind: int) -> None:
    bench = Bench().ready()
    bench.device.step(1500, wire.encode_frame(kind, payload, NONCE) + payload + b"\0")
    assert of_type(bench.send(wire.encode_ping(1, 1, bench.device.session)), wire.Pong) or not bench.device.session


# -- fail-safe ---------------------------------------------------------------------------------------------------------


def test_an_expired_lease_latches_the_device_dark() -> None:
    bench = Bench().ready().arm(start=2000, cycles=0, lease_ms=10)
    bench.grant(lease_ms=0)  # no renewal
    bench.done(Opcode.GATE, pack_command(Gate(10_500, 5000, 2)))
    bench.run_to(10_900)
    assert bench.device.projector_lit
    assert bench.gate_open(2)
    messages = bench.run_to(11_000)  # 10 ms after ARM
    status = of_type(messages, wire.Status)[-1]
    assert (status.state, status.reason, status.tick) == (DeviceState.SAFE, StateReason.LEASE_EXPIRED, 11_000)
    assert not bench.device.projector_lit
    assert not bench.gate_open(2)
    assert of_type(bench.run_to(500_000), wire.ClickBlock) == []
    bench.grant(lease_ms=1000)
    assert bench.device.state is DeviceState.SAFE
    assert bench.refused(Opcode.ARM, pack_command(Arm(600_000, 1, 9)))[0] == AckStatus.WRONG_STATE
    bench.hello()
    assert bench.device.state is DeviceState.SAFE  # it outlives the session
    bench.done(Opcode.RESET)
    assert bench.device.state is DeviceState.IDLE


# -- gates -------------------------------------------------------------------------------------------------------------


def test_a_gate_opens_at_its_tick_for_its_time() -> None:
    bench = Bench().ready().arm(cycles=0)
    bench.done(Opcode.GATE, pack_command(Gate(3000, 50, 1)))
    assert list(bench.device.gates.pulses) == [GatePulse(3000, 3050, 1)]
    states = []
    for tick in (2999, 3000, 3049, 3050):
        bench.run_to(tick)
        states.append(bench.gate_open(1))
    assert states == [False, True, True, False]
    assert not bench.gate_open(0)


def test_a_late_gate_is_not_executed() -> None:
    bench = Bench().ready()
    assert bench.refused(Opcode.GATE, pack_command(Gate(3000, 50, 1)))[0] == AckStatus.WRONG_STATE
    bench.arm(cycles=0)
    bench.run_to(3000)
    assert bench.refused(Opcode.GATE, pack_command(Gate(3000, 50, 1)))[0] == AckStatus.TOO_LATE
    assert bench.refused(Opcode.GATE, pack_command(Gate(4000, 50, GATE_CHANNELS)))[0] == AckStatus.OUT_OF_RANGE
    assert bench.refused(Opcode.GATE, pack_command(Gate(4000, 0, 1)))[0] == AckStatus.OUT_OF_RANGE
    assert (list(bench.device.gates.pulses), bench.device.gates.refused) == ([], 3)


def test_stop_closes_gates_and_cancels_those_to_come() -> None:
    bench = Bench().ready().arm(cycles=0)
    bench.done(Opcode.GATE, pack_command(Gate(3000, 5000, 1)))
    bench.done(Opcode.GATE, pack_command(Gate(9000, 50, 2)))
    bench.run_to(4000)
    bench.done(Opcode.STOP)
    assert list(bench.device.gates.pulses) == [GatePulse(3000, 4000, 1)]


def test_pending_gates_are_limited() -> None:
    bench = Bench().ready().arm(cycles=0)
    for number in range(MAX_PENDING_GATES):
        bench.done(Opcode.GATE, pack_command(Gate(5000 + number, 1, 0)))
    assert "pending" in bench.refused(Opcode.GATE, pack_command(Gate(9000, 1, 0)))[1]
    bench.run_to(5000)
    bench.done(Opcode.GATE, pack_command(Gate(9000, 1, 0)))
    assert "pending" in bench.refused(Opcode.GATE, pack_command(Gate(9000, 1, 0)))[1]
    assert bench.device.gates.refused == 2


# -- receive window ----------------------------------------------------------------------------------------------------


def test_a_grant_just_before_arm_counts() -> None:
    bench = Bench().ready()
    bench.grant(limit=2)
    bench.arm(cycles=3)
    stream = [message for message in bench.run_to(5000) if not isinstance(message, wire.Status | wire.Exposed)]
    assert [message.seq for message in stream] == [0, 1]


def test_a_full_buffer_drops_whole_blocks_and_says_so() -> None:
    bench = Bench(buffer_messages=4).ready().arm(cycles=10)
    bench.run_to(2000 + 5 * 300 - 1)  # five marks and blocks: four messages are held, three blocks and marks dropped
    kept = bench.grant(limit=100)
    assert [message.seq for message in kept] == [0, 1, 2, 3]
    following = [message for message in bench.run_to(9000) if not isinstance(message, wire.Status | wire.Exposed)]
    assert following[0].seq == 4  # a dropped message takes no number
    first_block = of_type(following, wire.ClickBlock)[0]
    assert first_block.exposure_index == 15
    assert first_block.drops == 9
    assert bench.device.stream.dropped_messages == 6
    assert of_type([message for _, message in bench.got], wire.Status)[-1].drops == 9


def test_the_window_compares_modulo_2_to_the_32() -> None:
    bench = Bench().ready().arm(cycles=0)
    bench.device.stream.sequence = 0xFFFFFFFE
    bench.grant(limit=0xFFFFFFFF)
    assert [message.seq for message in bench.run_to(2599) if hasattr(message, "seq")] == [0xFFFFFFFE]
    assert [message.seq for message in bench.grant(limit=1)] == [0xFFFFFFFF, 0]
