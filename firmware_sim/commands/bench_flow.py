"""The rows of `pans bench sim` about scenes that move: what the whole device costs per block and per frame. SIMULATED, all of it.

Owns the rows; runs an `Instrument` as a shell would, event by event in virtual time, from ARM to bytes on the wire. What a pipe or port
costs is not in them. Patterns are random, as dark as trained ones are.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pans.firmware_sim.device.instrument import Instrument
from pans.firmware_sim.device.parallel import FrameRun
from pans.firmware_sim.scene.moving import Cells
from pans.firmware_sim.scene.scene_file import open_scene
from pans.runtime.bench.rows import Row
from pans.runtime.instrument.profile import load_profile
from pans.runtime.wire import messages as wire
from pans.runtime.wire.commands import PARALLEL, Arm, PatternChunk, PlanChunk, pack_arm, pack_pattern, pack_plan
from pans.runtime.wire.messages import SLOT_DTYPE, Opcode

PROFILE, SESSION, START_TICK = "flow-snspd", 7, 1000
LIT_SHARE, TOP_LEVEL = 0.02, 30
CHUNK_PIXELS = 4096
REPEATS = 4
# scene, patterns, exposure in microseconds, frames of a block
CASES = (
    ("cells-in-flow", 10, 5.0, 80),
    ("cells-in-flow", 10, 20.0, 10),
    ("cells-in-flow", 32, 5.0, 80),
    ("clothes-in-flow", 10, 5.0, 80),
    ("bar-tape", 10, 5.0, 80),
)


def flow_rows(quick: bool) -> list[Row]:
    """Return one row for each case: microseconds of CPU time per block, and the cores that real pace would take.

    `us_per_block`: blocks due one by one, drawing included; `in_bulk`: all blocks of a stretch due at once, nothing made before;
    `made_ahead`: blocks due at once that were made while the device was idle, as after a pause of the machine.
    """
    return [_row(*case, 0.1 if quick else 0.5) for case in CASES]


def _row(name: str, n_patterns: int, exposure_us: float, block_frames: int, seconds: float) -> Row:
    device = _armed(name, n_patterns, exposure_us, block_frames)
    ticks = round(seconds * device.profile.clock.tick_hz)
    one_by_one, in_bulk, made_ahead = [], [], []
    for _ in range(REPEATS + 1):  # the first one warms up
        one_by_one.append(_timed(device, lambda: _one_by_one(device, device.tick + ticks)))
        device.step(_last_made(device), b"")
        in_bulk.append(_timed(device, lambda: [device.step(device.tick + ticks, b"")]))
        while device.draw_ahead():
            pass
        made_ahead.append(_timed(device, lambda: [device.step(_last_made(device), b"")]))
    spent_us, blocks, marks = min(one_by_one[1:], key=lambda stretch: stretch[0] / len(stretch[1]))
    n_frames = sum(len(block.words) for block in blocks)
    return {
        "name": f"SIMULATED device, {name}, {n_patterns} patterns, frames of {exposure_us:g} us, {block_frames} a block",
        "us_per_block": round(spent_us / len(blocks), 2),
        "us_per_block_in_bulk": round(_least(in_bulk), 2),
        "us_per_block_made_ahead": round(_least(made_ahead), 2),
        "us_per_frame": round(spent_us / n_frames, 3),
        "cores_at_real_pace": round(spent_us / 1e6 / seconds, 3),
        "blocks": len(blocks),
        "marks": marks,
        "clicks_per_frame": round(sum(int(np.unpackbits(block.words).sum()) for block in blocks) / n_frames, 4),
    }


def _one_by_one(device: Instrument, end: int) -> list[bytes]:
    """As a shell does it: step to what is due, send, make a piece of what is to come."""
    sent = []
    while (due := device.next_event_tick()) is not None and due < end:
        sent.append(device.step(due, b""))
        device.draw_ahead()
    return sent


def _last_made(device: Instrument) -> int:
    """The tick of the last message that is made: what a device is to send at once after a pause."""
    run = device._run
    assert isinstance(run, FrameRun)
    return run.made_until


def _timed(device: Instrument, work: Callable[[], list[bytes]]) -> tuple[float, list[wire.FrameBlock], int]:
    """Microseconds of CPU time that `work` took, and the blocks and the number of marks that it sent."""
    decoder = wire.FrameDecoder()
    decoder.use_kernels()
    began = time.thread_time_ns()
    sent = work()
    spent_us = (time.thread_time_ns() - began) / 1e3
    frames = [frame for data in sent for frame in decoder.feed(data)]
    blocks = [wire.decode_frames(frame.payload) for frame in frames if frame.type == wire.MessageType.FRAMES]
    return spent_us, blocks, sum(frame.type == wire.MessageType.MARK for frame in frames)


def _least(stretches: list[tuple[float, list[wire.FrameBlock], int]]) -> float:
    return min(spent_us / len(blocks) for spent_us, blocks, _ in stretches[1:])


def _armed(name: str, n_patterns: int, exposure_us: float, block_frames: int) -> Instrument:
    """An instrument before the scene, with patterns and plan uploaded and the run armed."""
    profile, scene = load_profile(PROFILE), open_scene(name)
    device = Instrument(profile, scene, seed=1)
    device.step(0, wire.encode_hello(SESSION))
    n_pixels = scene.what.objects.n_pixels if isinstance(scene.what, Cells) else 80
    bodies = []
    for index, row in enumerate(_patterns(n_patterns, n_pixels)):
        for first in range(0, n_pixels, CHUNK_PIXELS):
            chunk = PatternChunk(index, first, n_pixels, row[first : first + CHUNK_PIXELS])
            bodies.append((Opcode.LOAD_PATTERN, pack_pattern(chunk)))
    ticks = round(exposure_us * profile.clock.tick_hz / 1e6)
    slots = np.zeros(block_frames, SLOT_DTYPE)
    slots["offset_ticks"] = np.arange(block_frames) * ticks
    head = (PARALLEL, n_patterns, block_frames, 0, ticks, ticks, ticks * block_frames, block_frames, 1)
    bodies.append((Opcode.LOAD_PLAN, pack_plan(PlanChunk(*head, slots))))
    bodies.append((Opcode.ARM, pack_arm(Arm(START_TICK, 0, 3_600_000))))
    for number, (opcode, body) in enumerate(bodies, start=1):
        device.step(0, wire.encode_command(number, opcode, body, SESSION))
    assert device.state is wire.DeviceState.ARMED
    device.step(0, wire.encode_grant(wire.Grant(1 << 30, 0), SESSION))
    return device


def _patterns(n_patterns: int, n_pixels: int) -> NDArray[np.uint16]:
    rng = np.random.default_rng(1)
    lit = rng.random((n_patterns, n_pixels)) < max(LIT_SHARE, 5 / n_pixels)
    return np.where(lit, rng.integers(1, TOP_LEVEL, lit.shape), 0).astype(np.uint16)
