"""The compiled way of a flow's messages: decoded FRAMES and MARK bodies into the ring, up to the first block of which something comes.

Owns the ordinary case: messages in order, nothing lost, blocks that fit the plan. Whatever else comes it leaves untouched and stops there:
`FlowCore` then takes that one by itself, and both continue the same state. Never allocates.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pans.runtime.core.plan import Plan
from pans.runtime.wire import walk as stream
from pans.runtime.wire.bare import load4, load8
from pans.runtime.wire.inner import inner, outer
from pans.runtime.wire.schema import NO_OBJECT

from . import columns
from .kernels import EMPTY_FRAMES, NEXT, put_frames, scan

# a mark, int64 (N_MARK,); its photons stand beside it in an array of their own
M_SEQ, M_OBJECT, M_TRUTH, M_EXPOSURE, M_TICK, M_HALF, N_MARK = range(7)

_U = np.uint64
_NO_OBJECT = np.uint64(NO_OBJECT)


def facts_of(plan: Plan, n_classes: int, dark_cycle: int) -> npt.NDArray[np.int64]:
    """Return the facts of a stream of `plan` that has not begun, int64 (columns.N_FACTS,); dark_cycle 0: no frame is dark."""
    facts = np.zeros(columns.N_FACTS, np.int64)
    facts[columns.EXPOSURE_TICKS], facts[columns.PERIOD_TICKS] = plan.exposure_ticks, plan.slot_period_ticks
    facts[columns.CYCLE_TICKS], facts[columns.MAX_BLOCK] = plan.cycle_ticks, plan.block_exposures
    facts[columns.N_CLASSES], facts[columns.DARK_CYCLE] = n_classes, dark_cycle
    facts[columns.WATCH_AT] = 1 << 62
    return facts


@outer
def walk(messages, place, facts, slot_offsets, flow, mask, marks, heard):  # type: ignore[no-untyped-def]
    """Take messages from `place` on; return how many, 0 when that one is not ordinary.

    messages Messages, facts int64 (columns.N_FACTS,), slot_offsets int64 (slots of a cycle,) in ticks, flow FlowArrays, mask
    uint64 of the channels, heard StreamTracker's. `marks` NewMarks are filled; when they are full the call ends. Without limits every
    block ends it, else it ends behind the first block with passages (facts[PASSAGES] of them) and when facts[WATCH_AT] empty frames have
    been seen.
    """
    buffer, spans = messages
    words, counts, limits, state = flow.words, flow.counts, flow.limits, flow.state
    facts[stream.MESSAGES] = facts[stream.EXPOSURES] = facts[columns.MARKS] = facts[columns.PASSAGES] = 0
    at = place
    while at < spans.shape[0]:
        start, stop = _U(spans[at, 0]), _U(spans[at, 1])
        payload = start + _U(stream.BODY_HEADER)
        if not stream.is_plain(buffer, start):
            break
        if buffer[start] == stream.MARK:
            if facts[columns.MARKS] == marks.photons.size or not mark_fits(buffer, payload, stop, facts):
                break
            _take_mark(buffer, payload, marks, facts[columns.MARKS])
            facts[columns.MARKS] += 1
            stream.go_on(facts, 0)
            stream.hear(buffer, start, stop, heard, facts)
            at += 1
            continue
        if buffer[start] != stream.FRAMES:
            break
        first = facts[stream.NEXT_EXPOSURE]
        count = take_frames(buffer, payload, stop, facts, slot_offsets, flow, mask)
        if count == 0:
            break
        stream.hear(buffer, start, stop, heard, facts)
        at += 1
        if not limits.size:
            break
        facts[columns.PASSAGES] = scan(first + count, words, counts, limits, state, flow.empty_channels, flow.out)
        if facts[columns.PASSAGES] or state[NEXT] < first + count or state[EMPTY_FRAMES] >= facts[columns.WATCH_AT]:
            break
    return at - place


@inner
def mark_fits(buffer, payload, stop, facts):  # type: ignore[no-untyped-def]
    """Whether the MARK from `payload` to `stop` is whole, the next message, and says what can be."""
    return stream.is_next_mark(buffer, payload, stop, facts) and stream.mark_fits(
        buffer, payload, facts, facts[columns.N_CLASSES]
    )


@inner
def take_frames(buffer, payload, stop, facts, slot_offsets, flow, mask):  # type: ignore[no-untyped-def]
    """Put the frames from `payload` to `stop` into the ring and return how many; 0, and nothing done, where they are not ordinary."""
    first = facts[stream.NEXT_EXPOSURE]
    count, width = stream.next_block(buffer, payload, stop, facts)
    if count == 0 or count > facts[columns.MAX_BLOCK] or 8 * width < flow.dark_channels.size:
        return 0
    if flow.state[NEXT] != first:  # the block before was left out: it did not fit the plan
        return 0
    tick, period = stream.block_times(buffer, payload)
    if period != facts[columns.PERIOD_TICKS] or load4(buffer, payload + _U(32)) != _NO_OBJECT:
        return 0
    cycle = first // slot_offsets.size
    planned = (
        facts[columns.START_TICK] + cycle * facts[columns.CYCLE_TICKS] + slot_offsets[first - cycle * slot_offsets.size]
    )
    if tick < planned - period:
        return 0
    frames_at = np.int64(payload) + stream.BLOCK_HEADER
    frames = buffer[frames_at : frames_at + count * width].reshape(count, width)
    put_frames(frames, first, flow.words, flow.counts, facts[columns.DARK_CYCLE], flow.state, flow.dark_channels, mask)
    stream.go_on(facts, count)
    _note_end(tick, count, facts, slot_offsets)
    return count


@inner
def _take_mark(buffer, payload, marks, number):  # type: ignore[no-untyped-def]
    row = marks.rows[number]
    row[M_SEQ], row[M_OBJECT] = np.int64(load4(buffer, payload)), np.int64(load4(buffer, payload + _U(4)))
    row[M_TRUTH], row[M_HALF] = stream.mark_truth(buffer, payload), np.int64(load4(buffer, payload + _U(8)) >> _U(16))
    row[M_EXPOSURE], row[M_TICK] = np.int64(load8(buffer, payload + _U(12))), np.int64(load8(buffer, payload + _U(20)))
    stream.mark_photons(buffer, payload, marks.photons, number)


@inner
def _note_end(tick, count, facts, slot_offsets):  # type: ignore[no-untyped-def]
    """Note when the block's last exposure ended, and by how much that is not the plan's time."""
    last = facts[stream.NEXT_EXPOSURE] - 1
    facts[columns.END_TICK] = tick + (count - 1) * facts[columns.PERIOD_TICKS] + facts[columns.EXPOSURE_TICKS]
    cycle = last // slot_offsets.size
    planned = (
        facts[columns.START_TICK] + cycle * facts[columns.CYCLE_TICKS] + slot_offsets[last - cycle * slot_offsets.size]
    )
    facts[columns.JITTER_TICKS] = max(
        facts[columns.JITTER_TICKS], abs(facts[columns.END_TICK] - planned - facts[columns.EXPOSURE_TICKS])
    )
