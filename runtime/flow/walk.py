"""The compiled way of a flow's messages: decoded FRAMES and MARK bodies into the ring, up to the first block of which something comes.

Owns the ordinary case: messages in order, nothing lost, blocks that fit the plan. Whatever else comes it leaves untouched and stops there:
`FlowCore` then takes that one by itself, and both continue the same state. Never allocates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pans.runtime.wire import walk as stream
from pans.runtime.wire.bare import load4, load8
from pans.runtime.wire.inner import inner, outer
from pans.runtime.wire.schema import NO_OBJECT

from .kernels import EMPTY_FRAMES, NEXT, put_frames, scan

# facts, int64 (N_FACTS,): where the stream stands (stream.N_PLACE columns), ...
# ... what a block must be like, and when it should end, ...
START_TICK, EXPOSURE_TICKS, PERIOD_TICKS, MAX_BLOCK, CYCLE_TICKS, DARK_CYCLE, WATCH_AT, N_CLASSES = range(
    stream.N_PLACE, stream.N_PLACE + 8
)
# ... and what came of the call
MARKS, PASSAGES, END_TICK, JITTER_TICKS, N_FACTS = range(N_CLASSES + 1, N_CLASSES + 6)
# a mark, int64 (N_MARK,); its photons stand beside it in an array of their own
M_SEQ, M_OBJECT, M_TRUTH, M_EXPOSURE, M_TICK, M_HALF, N_MARK = range(7)

_U = np.uint64
_NO_OBJECT = np.uint64(NO_OBJECT)


class FlowArrays(NamedTuple):
    """The ring and what follows it, see kernels.py; `limits` is empty where no passages are looked for. `out` are the passages."""

    words: npt.NDArray[np.uint64]
    counts: npt.NDArray[np.int16]
    limits: npt.NDArray[np.int64]
    state: npt.NDArray[np.int64]
    dark_channels: npt.NDArray[np.int64]
    empty_channels: npt.NDArray[np.int64]
    out: npt.NDArray[np.int64]


class NewMarks(NamedTuple):
    """Marks that a call has met: int64 (m, N_MARK), and their photons, float32 (m,)."""

    rows: npt.NDArray[np.int64]
    photons: npt.NDArray[np.float32]


@outer
def walk(buffer, spans, place, facts, slot_offsets, flow, mask, marks):  # type: ignore[no-untyped-def]
    """Take messages from `place` on; return how many, 0 when that one is not ordinary.

    buffer uint8, spans int64 (n, 2), facts int64 (N_FACTS,), slot_offsets int64 (slots of a cycle,) in ticks, flow FlowArrays, mask
    uint64 of the channels. `marks` NewMarks are filled; when they are full the call ends. Without limits every block ends it, else it
    ends behind the first block with passages (facts[PASSAGES] of them) and when facts[WATCH_AT] empty frames have been seen.
    """
    words, counts, limits, state = flow.words, flow.counts, flow.limits, flow.state
    dark_channels = flow.dark_channels
    facts[stream.MESSAGES] = facts[stream.EXPOSURES] = facts[MARKS] = facts[PASSAGES] = 0
    at = place
    while at < spans.shape[0]:
        start, stop = _U(spans[at, 0]), _U(spans[at, 1])
        payload = start + _U(stream.BODY_HEADER)
        if buffer[start] == stream.MARK:
            if not stream.is_next_mark(buffer, payload, stop, facts) or facts[MARKS] == marks.photons.size:
                break
            if not stream.mark_fits(buffer, payload, facts, facts[N_CLASSES]):
                break
            _take_mark(buffer, payload, marks, facts[MARKS])
            facts[MARKS] += 1
            stream.go_on(facts, 0)
            at += 1
            continue
        if buffer[start] != stream.FRAMES:
            break
        first = facts[stream.NEXT_EXPOSURE]
        count, width = stream.next_block(buffer, payload, stop, facts)
        if count == 0 or count > facts[MAX_BLOCK] or 8 * width < dark_channels.size:
            break
        tick, period = stream.block_times(buffer, payload)
        if period != facts[PERIOD_TICKS] or load4(buffer, payload + _U(32)) != _NO_OBJECT:
            break
        cycle = first // slot_offsets.size
        planned = facts[START_TICK] + cycle * facts[CYCLE_TICKS] + slot_offsets[first - cycle * slot_offsets.size]
        if tick < planned - period:
            break
        frames_at = np.int64(payload) + stream.BLOCK_HEADER
        frames = buffer[frames_at : frames_at + count * width].reshape(count, width)
        put_frames(frames, first, words, counts, facts[DARK_CYCLE], state, dark_channels, mask)
        stream.go_on(facts, count)
        _note_end(tick, count, facts, slot_offsets)
        at += 1
        if not limits.size:
            break
        facts[PASSAGES] = scan(first + count, words, counts, limits, state, flow.empty_channels, flow.out)
        if facts[PASSAGES] or state[NEXT] < first + count or state[EMPTY_FRAMES] >= facts[WATCH_AT]:
            break
    return at - place


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
    facts[END_TICK] = tick + (count - 1) * facts[PERIOD_TICKS] + facts[EXPOSURE_TICKS]
    cycle = last // slot_offsets.size
    planned = facts[START_TICK] + cycle * facts[CYCLE_TICKS] + slot_offsets[last - cycle * slot_offsets.size]
    facts[JITTER_TICKS] = max(facts[JITTER_TICKS], abs(facts[END_TICK] - planned - facts[EXPOSURE_TICKS]))
