"""Flows for tests: a plan, a decider by channel, cells as frames, cores that are ready, streams of messages."""

from dataclasses import replace
from typing import Any

import numpy as np

from pans.bundle.backends.verdict import Decider, Verdict
from pans.decide.decision import Output, joined
from pans.decide.flow.core import FlowCore
from pans.decide.flow.make import make_flow_core
from pans.decide.flow.settings import FlowSettings
from pans.decide.plan.plan import NO_SHOT, Plan
from pans.protocol.wire import DARK_PATTERN, NO_OBJECT, Frame, FrameDecoder
from pans.protocol.wire import messages as wire
from pans.protocol.wire.messages import FrameBlock, Mark

N_FEATURES = 10
PERIOD_TICKS = 200  # 2 us at 100 MHz
SESSION = 7


def plan_of(block: int, dark: bool = False) -> Plan:
    pattern = np.zeros(block, np.uint16)
    if dark:
        pattern[-1] = DARK_PATTERN
    return Plan(
        mode="parallel",
        n_patterns=N_FEATURES,
        slot_offset_ticks=np.arange(block, dtype=np.int64) * PERIOD_TICKS,
        slot_pattern=pattern,
        slot_shot=np.where(pattern == DARK_PATTERN, NO_SHOT, np.arange(block)).astype(np.uint16),
        exposure_ticks=PERIOD_TICKS,
        slot_period_ticks=PERIOD_TICKS,
        cycle_ticks=block * PERIOD_TICKS,
        shots_per_cycle=block - dark,
        cycles_per_object=1,
        block_exposures=block,
        exposure_us=2.0,
    )


class LowestChannel(Decider):
    """The class is the lowest channel that clicked, 3 if none of 0..2 did; sure when it clicked in every shot."""

    name, n_features, n_classes = "lowest", N_FEATURES, 4

    def __init__(self) -> None:
        self.asked = 0

    def decide(self, counts: np.ndarray, shots: int) -> Verdict:
        self.asked += 1
        lit = np.flatnonzero(counts[:3])
        return Verdict(int(lit[0]) if len(lit) else 3, 0.9 if len(lit) else 0.4)

    def scores_batch(self, counts: np.ndarray, shots: int) -> np.ndarray:
        return np.array(
            [[3.0 * (label == self.decide(row, shots).label) for label in range(4)] for row in counts], np.float32
        )


CLASSES = ("a", "b", "c", "null")
SETTINGS = FlowSettings("cells", fields_per_s=10_000.0, onset_frames=6)


def make(
    block: int = 20,
    dark: bool = False,
    n_cycles: int = 0,
    shots: int = 1,
    decider: Decider | None = None,
    **changes: object,
) -> FlowCore:
    flow = replace(SETTINGS, **changes)  # type: ignore[arg-type]
    core = make_flow_core(
        plan_of(block, dark),
        decider or LowestChannel(),
        flow,
        CLASSES,
        shots=shots,
        dark_probability=1e-4,
        n_cycles=n_cycles,  # type: ignore[arg-type]
    )
    core.warm_up()
    core.begin(1000, n_cycles)
    return core


def frame(data: bytes) -> Frame:
    return FrameDecoder().feed(data)[0]


def feed(
    core: FlowCore, words: np.ndarray, block: int = 20, drop: tuple[int, ...] = (), marks: tuple[Mark, ...] = ()
) -> Output:
    """Step through `words` uint16 (n,) in blocks, leaving out the blocks numbered `drop`; marks come when they are due."""
    output, seq, waiting = Output([], [], None), 0, sorted(marks, key=lambda mark: mark.exposure_index)
    for number, first in enumerate(range(0, len(words), block)):
        part = words[first : first + block]
        while waiting and waiting[0].exposure_index < first + len(part):
            output = joined(output, core.step(frame(wire.encode_mark(waiting.pop(0)._replace(seq=seq), SESSION))))
            seq += 1
        rows = np.ascontiguousarray(part.astype("<u2")).view(np.uint8).reshape(-1, 2)
        message = FrameBlock(seq, 0, 1000 + first * PERIOD_TICKS, first, PERIOD_TICKS, NO_OBJECT, rows)
        seq += 1
        if number not in drop:
            output = joined(output, core.step(frame(wire.encode_frames(message, SESSION))))
    return output


def cell(length: int, channel: int) -> np.ndarray:
    """A cell's frames: the outer thirds show channels 4 and 5, the middle one `channel` beside them."""
    words = np.full(length, 0b110000, np.uint16)
    words[length // 3 : length - length // 3] |= np.uint16(1 << channel)
    return words


def scene(*cells: tuple[int, int, int], n: int = 1000) -> np.ndarray:
    """Frames with cells given as (first exposure, length, channel)."""
    words = np.zeros(n, np.uint16)
    for first, length, channel in cells:
        words[first : first + length] |= cell(length, channel)[: n - first]
    return words


def mark(number: int, centre: int, truth: int, half: int = 40) -> Mark:
    return Mark(0, number, truth, centre, 1000 + centre * PERIOD_TICKS, 6.0, half)


NOTHING = Output([], [], None)


def stream(words: np.ndarray, block: int, marks: int = 8) -> list[bytes]:
    """The messages of `words` uint16 (n,), a mark at every 120th exposure."""
    messages, seq = [], 0
    waiting = [mark(number, 60 + 120 * number, number % 4, 30) for number in range(marks)]
    for first in range(0, len(words), block):
        part = np.ascontiguousarray(words[first : first + block].astype("<u2")).view(np.uint8).reshape(-1, 2)
        while waiting and waiting[0].exposure_index < first + len(part):
            messages.append(wire.encode_mark(waiting.pop(0)._replace(seq=seq), SESSION))
            seq += 1
        tick = 1000 + first * PERIOD_TICKS
        messages.append(wire.encode_frames(FrameBlock(seq, 0, tick, first, PERIOD_TICKS, NO_OBJECT, part), SESSION))
        seq += 1
    return messages


def strange(kind: str, message: bytes) -> list[bytes]:
    """What a bad day makes of one message."""
    frame = FrameDecoder().feed(message)[0]
    if kind == "lost":
        return []
    if kind == "twice":
        return [message, message]
    if kind == "another session":
        return [wire.encode_frame(frame.type, frame.payload, SESSION + 1), message]
    if kind == "short":
        return [wire.encode_frame(frame.type, frame.payload[:-1], SESSION)]
    if kind == "drops":  # the device has dropped something
        return [wire.encode_frame(frame.type, frame.payload[:4] + b"\5\0\0\0" + frame.payload[8:], SESSION)]
    if kind == "marked again":  # a mark becomes one of the first passage
        of = b"\0" * 4 if frame.type == wire.MessageType.MARK else frame.payload[4:8]
        return [wire.encode_frame(frame.type, frame.payload[:4] + of + frame.payload[8:], SESSION)]
    assert kind == "period"
    return [wire.encode_frame(frame.type, frame.payload[:24] + b"\7\0\0\0" + frame.payload[28:], SESSION)]


def by_one(core: FlowCore, data: bytes) -> Output:
    output = NOTHING
    for frame in FrameDecoder().feed(data):
        if frame.session == SESSION:
            output = joined(output, core.step(frame))
    return joined(output, core.end())


def state_of(core: FlowCore) -> dict[str, Any]:
    return {
        "counters": core.tracker.counters,
        "position": core.tracker.position,
        "marks": core.marks.latest(),
        "last_tick": core.last_tick,
        "jitter": core.jitter_ticks,
        "tallies": core.tallies.tolist(),
        "empty": (core.empty_frames, core.empty_channels.tolist()),
        "matched": core.matcher.figures(1),
        "n": (core.n_decisions, core.n_abstained, core.n_passages),
    }
