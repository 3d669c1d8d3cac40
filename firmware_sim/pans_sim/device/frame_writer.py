"""Frame blocks and marks as bytes on the wire, many at a time: a parallel instrument sends thousands of them a second.

Two compiled kernels; the bytes are those of `wire.encode_frames` and `wire.encode_mark`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.base.machine import inner, outer
from pans.protocol.wire import BLOCK_HEADER_BYTES, HEADER, NO_OBJECT, SCHEMA, MessageType, crc32_span
from pans_sim.scene.marks import (
    MARK_EXPOSURE,
    MARK_HALF,
    MARK_OBJECT,
    MARK_PHOTONS,
    MARK_TICK,
    MARK_TRUTH,
    Stamp,
    no_marks,
)

I64 = NDArray[np.int64]

# Columns of a message; those of a block and those of a mark differ from FIRST_WORD on, and a mark has no exposures.
DUE, EXPOSURES, TICK, EXPOSURE, OBJECT, FIRST_WORD, N_COLUMNS = 0, 1, 2, 3, 4, 5, 8
TRUTH, HALF, PHOTONS = 5, 6, 7  # photons: the bits of the float32
FIRST_SLOT, COUNT, BEGIN, END, N_BLOCK_COLUMNS = range(5)
MARK_BYTES = 32
OVERHEAD_BYTES = HEADER.size + max(BLOCK_HEADER_BYTES, MARK_BYTES) + 4  # of a message, before COBS
_FRAMES, _MARK, _HEADER_BYTES = int(MessageType.FRAMES), int(MessageType.MARK), HEADER.size
_U = np.uint64
_U32 = 0xFFFFFFFF


class BlockPlan(NamedTuple):
    """The blocks of one cycle, int64 (blocks, N_BLOCK_COLUMNS): first slot, exposures, ticks of begin and end; and how cycles follow.

    cycles_per_object 0: no object is known, since they pass by on their own.
    """

    blocks: I64
    n_slots: int
    cycle_ticks: int
    cycles_per_object: int


def encoded_bytes(n_messages: int, n_word_bytes: int) -> int:
    """Return how many bytes `n_messages` with all these bytes of words take at most, delimiters included."""
    body = n_messages * OVERHEAD_BYTES + n_word_bytes
    return body + body // 254 + 3 * n_messages


def warm_up() -> None:
    """Compile or load the kernels."""
    messages, words = np.zeros((2, N_COLUMNS), np.int64), np.zeros((1, 1), np.uint8)
    lay_out(BlockPlan(np.ones((1, N_BLOCK_COLUMNS), np.int64), 1, 1, 1), 0, 0, no_marks(), 0, messages)
    body, out = np.zeros(100, np.uint8), np.zeros(300, np.uint8)
    write_messages(messages, words, 1, Stamp(0, 0, 1), SCHEMA, body, out, np.zeros(3, np.int64))


@outer
def lay_out(plan, cycle, block, marks, start_tick, messages):  # type: ignore[no-untyped-def]
    """Fill messages int64 (n, N_COLUMNS) with blocks from `block` of `cycle` on and all `marks` (marks.py) among them, in order.

    A block is due at its end, a mark at its tick or, of what passes by, with the block that holds its tick; a block that ends at
    that tick goes first.
    """
    taken = word = 0
    photons = marks.view(np.float64)
    for at in range(messages.shape[0]):
        message, facts = messages[at], plan.blocks[block]
        cycle_tick = start_tick + cycle * plan.cycle_ticks
        end = cycle_tick + facts[END]
        if taken < marks.shape[0] and start_tick + marks[taken, MARK_TICK] < end:
            mark = marks[taken]
            message[TICK] = start_tick + mark[MARK_TICK]
            # an object that passes is marked before the block in which it stands: one reading less for the host
            message[DUE] = message[TICK] if plan.cycles_per_object else end
            message[EXPOSURES] = 0
            message[EXPOSURE], message[OBJECT] = mark[MARK_EXPOSURE], mark[MARK_OBJECT]
            message[TRUTH], message[HALF] = mark[MARK_TRUTH], mark[MARK_HALF]
            message[PHOTONS] = np.int64(np.float32(photons[taken, MARK_PHOTONS]).view(np.uint32))
            taken += 1
            continue
        message[DUE], message[EXPOSURES] = end, facts[COUNT]
        message[TICK], message[EXPOSURE] = cycle_tick + facts[BEGIN], cycle * plan.n_slots + facts[FIRST_SLOT]
        message[OBJECT] = NO_OBJECT
        if plan.cycles_per_object:
            message[OBJECT] = cycle // plan.cycles_per_object % NO_OBJECT
        message[FIRST_WORD], message[HALF], message[PHOTONS] = word, 0, 0
        word += facts[COUNT]
        block += 1
        if block == plan.blocks.shape[0]:
            block = 0
            cycle += 1


@outer
def write_messages(messages, words, period_ticks, stamp, schema, body, out, ends):  # type: ignore[no-untyped-def]
    """Encode `messages` with their frames in words uint8 (exposures, bytes): frames to `out`, message k at ends[k]..ends[k + 1].

    body uint8: room for one message before COBS; out uint8: `encoded_bytes` of all; ends int64 (messages + 1,).
    """
    ends[0] = 0
    for k in range(messages.shape[0]):
        message = messages[k]
        sequence = (stamp.sequence + k) & _U32
        used = _block(body, message, words, sequence, stamp.drops, period_ticks)
        _put(body, 4, stamp.session, 4)
        _put(body, used, crc32_span(body, 0, used, schema), 4)
        ends[k + 1] = _stuff(body, used + 4, out, ends[k])


@inner
def _block(body, message, words, sequence, drops, period_ticks):  # type: ignore[no-untyped-def]
    """Write a block or mark to `body`, but for the session and the CRC; return where it ends."""
    count = message[EXPOSURES]
    _put(body, 0, _FRAMES if count else _MARK, 4)
    _put(body, 8, sequence, 4)
    if count == 0:
        _put(body, 12, message[OBJECT], 4)
        _put(body, 16, message[TRUTH], 2)
        _put(body, 18, message[HALF], 2)
        _put(body, 20, message[EXPOSURE], 8)
        _put(body, 28, message[TICK], 8)
        _put(body, 36, message[PHOTONS], 4)
        return _HEADER_BYTES + MARK_BYTES
    _put(body, 12, drops, 4)
    _put(body, 16, message[TICK], 8)
    _put(body, 24, message[EXPOSURE], 8)
    _put(body, 32, period_ticks, 4)
    _put(body, 36, count, 2)
    _put(body, 38, words.shape[1], 2)
    _put(body, 40, message[OBJECT], 4)
    at = _HEADER_BYTES + BLOCK_HEADER_BYTES
    first = message[FIRST_WORD]
    for t in range(first, first + count):
        for p in range(words.shape[1]):
            body[at] = words[t, p]
            at += 1
    return at


@inner
def _put(body, at, value, n_bytes):  # type: ignore[no-untyped-def]
    """Write a whole number, two's complement, least byte first."""
    bits = _U(value)
    for k in range(n_bytes):
        body[at + k] = (bits >> _U(8 * k)) & _U(0xFF)


@inner
def _stuff(body, n_bytes, out, start):  # type: ignore[no-untyped-def]
    """Write the COBS string of body[:n_bytes] and a delimiter to out[start:]; return where they end.

    No branch depends on the data but that of a full group: the place of the code is moved on, or not, for every byte.
    """
    code_at, at = start, start + 1
    for i in range(n_bytes):
        byte = body[i]
        out[at] = byte
        out[code_at] = at - code_at
        code_at = at if byte == 0 else code_at
        at += 1
        if at - code_at == 255:
            out[code_at] = 255
            code_at = at
            at += 1
    out[code_at] = at - code_at
    out[at] = 0
    return at + 1
