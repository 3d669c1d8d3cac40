"""Frames made ahead: the messages of plain loops and the bytes of the reference encoders, whatever happens meanwhile."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from moving_scenes import CELLS, FLOW, PICTURES, TAPE, light_and_clicks, program, started, view_of

from pans.instrument.profile import load_profile
from pans.protocol.wire import SLOT_DTYPE, DeviceState, Opcode
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import PARALLEL, Arm, Gate, PatternChunk, PlanChunk, pack_command
from pans_sim.device import frame_writer, parallel
from pans_sim.device.instrument import Instrument
from pans_sim.device.parallel import FrameRun, Stretch
from pans_sim.device.sequential import Measurement
from pans_sim.device.stream_buffer import StreamBuffer
from pans_sim.device.view import View
from pans_sim.scene.marks import MARK_PHOTONS, Stamp
from pans_sim.scene.moving import Cells, Change
from pans_sim.scene.program import Program
from pans_sim.scene.scene_file import open_scene

RNG = np.random.default_rng(5)
SESSION = 7
PROFILE = replace(FLOW, detector=replace(FLOW.detector, crosstalk_probability=0.1, afterpulse_probability=0.1))
CHANGES = (Change("dark", 0.0, 1.0, -1, 90.0), Change("drift", 0.0, 1.0, -1, -50.0))


class OneByOne(StreamBuffer):
    """Every message for itself, through the encoders of pans.protocol.wire."""

    def put_due(self, run: Measurement | FrameRun, tick: int, session: int) -> list[bytes | memoryview]:
        return self.put_each(run, tick, session)


# -- messages ------------------------------------------------------------------------------------------------------------


def plain_messages(view: View, plan: Program, cycles: int, start: int) -> list[Any]:
    """The stream in plain loops: clicks by the detector's reference, every mark before the first block that ends after it."""
    light, source = light_and_clicks(view, plan, cycles, 100)
    rows = light.take_marks(cycles * plan.cycle_ticks)
    photons = rows[:, MARK_PHOTONS].copy().view(np.float64).astype(np.float32).tolist()
    marks = [
        wire.Mark(0, number, truth, exposure, tick + start, light, half)
        for (number, truth, exposure, tick, half, _), light in zip(rows.tolist(), photons)
    ]
    light, source = light_and_clicks(view, plan, cycles, 100)
    messages: list[Any] = []
    before = np.zeros(3, np.uint8)
    for cycle in range(cycles):
        for first, count in plan.blocks:
            begins = start + cycle * plan.cycle_ticks + plan.offsets[first : first + count]
            while marks and marks[0].tick < begins[-1] + plan.exposure_ticks:
                messages.append(marks.pop(0))
            exposure = cycle * plan.n_slots + first
            clicks = source.clicks(exposure, count, before)
            before = clicks[-1]
            words = np.packbits(clicks, axis=1, bitorder="little")
            number = wire.NO_OBJECT if view.scene.moves else cycle // plan.cycles_per_object
            messages.append(wire.FrameBlock(0, 0, int(begins[0]), exposure, plan.slot_period_ticks, number, words))
    return messages


def comparable(message: Any) -> Any:
    return (*message[:6], message.words.tobytes()) if isinstance(message, wire.FrameBlock) else message


@pytest.mark.parametrize("changes", [(), CHANGES], ids=["steady", "changing"])
@pytest.mark.parametrize("what", [CELLS, TAPE, PICTURES], ids=["cells", "tape", "still"])
def test_stretches_hold_the_messages_of_plain_loops(
    what: Any, changes: tuple[Change, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    if changes:
        monkeypatch.setattr(parallel, "STRETCH_EXPOSURES", 37)
    view = view_of(what, changes, profile=PROFILE)
    cut = replace(program(16, dark=(3,), gap=777), blocks=((0, 9), (9, 1), (10, 6)), cycles_per_object=3)
    for plan, cycles in ((cut, 400), (program(1), 1200)):
        run = started(view, plan, cycles, 100)
        found = []
        while (due := run.next_tick) is not None:
            stretch = run.stretch()
            assert stretch is not None
            assert stretch.due_by(due - 1) == 0
            assert stretch.due_by(due) >= 1
            found.append(comparable(run.emit()))
        assert found == [comparable(message) for message in plain_messages(view, plan, cycles, 1000)]
        assert sum(isinstance(message, wire.Mark) for message in found) > 100
        assert run.cut(10**9) is None
        assert not run.draw_ahead()


def test_a_run_that_is_broken_off_ends_within_a_block() -> None:
    plan, view = replace(program(16), blocks=((0, 10), (10, 6))), view_of(profile=PROFILE)
    for tick in (0, 1000, 1199, 1200, 1449, 1450, 9999, 77_777):
        run = started(view, plan)
        whole = []
        while run.next_tick is not None and run.next_tick <= tick:
            whole.append(run.emit())
        sent = sum(len(message.words) for message in whole if isinstance(message, wire.FrameBlock))
        rest = run.cut(tick)
        assert sent + (len(rest.words) if rest else 0) == run.ended_by(tick)
        assert run.next_tick is None
        if rest is not None:
            uncut = started(view, plan)
            blocks = [
                m for m in (uncut.emit() for _ in range(400) if uncut.next_tick) if isinstance(m, wire.FrameBlock)
            ]
            whole_block = next(block for block in blocks if block.exposure_index == rest.exposure_index)
            assert whole_block.words[: len(rest.words)].tobytes() == rest.words.tobytes()
            assert whole_block[:6] == rest[:6]


# -- bytes ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lit", [0.0, 0.05, 1.0])
def test_the_compiled_writer_is_the_reference(lit: float) -> None:
    stamp = Stamp(0xFFFFFFFE, 0xFFFFFFFF, 0xABCDEF01)
    for size in (1, 2, 4, 56):
        counts = [1, 40, 0, 209, 210, 254, 0, 300]
        n = sum(counts)
        words = np.where(RNG.random((n, size)) < lit, RNG.integers(1, 256, (n, size)), 0).astype(np.uint8)
        messages = np.zeros((len(counts), frame_writer.N_COLUMNS), np.int64)
        first, wanted = 0, []
        for k, count in enumerate(counts):
            sequence, tick, exposure = (stamp.sequence + k) & 0xFFFFFFFF, 2**40 + k, 2**33 + k
            if count:
                messages[k] = tick, count, tick, exposure, wire.NO_OBJECT, first, 0, 0
                block = wire.FrameBlock(
                    sequence, stamp.drops, tick, exposure, 250, wire.NO_OBJECT, words[first : first + count]
                )
                wanted.append(wire.encode_frames(block, stamp.session))
                first += count
            else:
                photons = float(RNG.exponential(1e3 * lit))
                bits = int(np.float32(photons).view(np.uint32))
                messages[k] = tick, 0, tick, exposure, k, -1, 65535, bits
                wanted.append(
                    wire.encode_mark(wire.Mark(sequence, k, -1, exposure, tick, photons, 65535), stamp.session)
                )
        stretch = Stretch(messages, words, 250)
        assert bytes(stretch.take(3, *stamp)) == b"".join(wanted[:3])
        assert bytes(stretch.take(5, 1, *stamp[1:])) == b"".join(wanted[3:])


# -- the whole device ------------------------------------------------------------------------------------------------------


def story(device: Any, seed: int, ahead: Callable[[], int]) -> tuple[bytes, list[int]]:
    """All bytes of two runs under random grants, leases, gates, probes, STOP; the choices depend on `seed` alone."""
    dice, out, tick, limit, number = random.Random(seed), [], 2000, 0, 100
    closed = seed % 3 > 0

    def step(data: bytes) -> None:
        out.append(bytes(device.step(tick, data)))
        for _ in range(ahead()):
            device.draw_ahead()

    def command(opcode: Opcode, body: bytes) -> None:
        nonlocal number
        number += 1
        step(wire.encode_command(number, opcode, body, SESSION))

    for run in range(2):
        command(Opcode.STOP, b"")
        command(Opcode.RESET, b"")
        command(Opcode.ARM, pack_command(Arm(tick + 500, 900 if run else 0, 5)))
        for _ in range(80):
            tick += dice.choice([1, 50, 777, 5000, 30_000, 200_000])
            what = dice.random()
            if what < 0.2:
                step(wire.encode_ping(tick & 0xFFFF, 5, SESSION))
            elif what < 0.6:
                limit = limit + dice.randrange(60) if closed else 1 << 30
                step(wire.encode_grant(wire.Grant(limit, 5), SESSION))
            elif what < 0.7:
                command(Opcode.GATE, pack_command(Gate(tick + dice.choice([-5, 0, 1, 9999]), 10, 1)))
            else:
                step(b"")
        tick += dice.choice([1, 2_000_000])  # beyond the lease, or not
    step(wire.encode_grant(wire.Grant(1 << 30, 0), SESSION))
    return b"".join(out), [tick, limit]


def instrument(name: str, capacity: int, one_by_one: bool, changes: tuple[Change, ...] = ()) -> Instrument:
    """An instrument with ten patterns and a plan of blocks of 40 frames; command 100 was the last one."""
    profile, scene, rng = load_profile("flow-snspd"), open_scene(name), np.random.default_rng(1)
    device = Instrument(profile, scene, seed=1)
    device.step(0, wire.encode_hello(SESSION))
    n_pixels = scene.what.objects.n_pixels if isinstance(scene.what, Cells) else 80
    rows = rng.integers(1, 30, (10, n_pixels)) * (rng.random((10, n_pixels)) < max(0.02, 5 / n_pixels))
    chunks = [PatternChunk(index, 0, n_pixels, row.astype(np.uint16)) for index, row in enumerate(rows)]
    ticks, slots = round(5e-6 * profile.clock.tick_hz), np.zeros(40, SLOT_DTYPE)
    slots["offset_ticks"] = np.arange(40) * ticks
    plan = PlanChunk(PARALLEL, 10, 40, 0, ticks, ticks, ticks * 40, 40, 1, slots)
    bodies = [(Opcode.LOAD_PATTERN, pack_command(chunk)) for chunk in chunks] + [(Opcode.LOAD_PLAN, pack_command(plan))]
    for number, (opcode, body) in enumerate(bodies, start=1):
        device.step(0, wire.encode_command(number, opcode, body, SESSION))
    device.view = replace(device.view, scene=replace(device.view.scene, changes=changes))
    device.stream = (OneByOne if one_by_one else StreamBuffer)(capacity)
    for number in range(device._ack.last_id + 1, 101):
        device.step(0, wire.encode_command(number, Opcode.STOP, b"", SESSION))
    assert device.state is DeviceState.IDLE
    return device


@pytest.mark.parametrize(("name", "capacity"), [("clothes-in-flow", 256), ("clothes-in-flow", 4), ("bar-tape", 7)])
def test_made_ahead_or_one_by_one_the_stream_is_the_same(name: str, capacity: int) -> None:
    dropped = refused = 0
    for seed in range(6):
        changes = CHANGES if seed % 2 else ()
        plain = instrument(name, capacity, True, changes)
        wanted = story(plain, seed, lambda: 0)
        dice = random.Random(seed + 1)
        for ahead in (lambda: 0, lambda: dice.randrange(4)):  # noqa: B023
            device = instrument(name, capacity, False, changes)
            assert story(device, seed, ahead) == wanted
            assert device.stream.dropped_exposures == plain.stream.dropped_exposures
            assert device.stream.dropped_messages == plain.stream.dropped_messages
        dropped += plain.stream.dropped_messages
        refused += plain.gates.refused
        assert len(wanted[0]) > 5000
    assert (dropped > 5) == (capacity < 256)
    assert refused > 10
