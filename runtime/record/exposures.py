"""The exposures of a recording, in the order of the device's clock: what was shown when, and what clicked.

Recorded messages come in, arrays of many exposures go out, for exports and reports. Repeated and damaged messages are left out as in the
run itself (`StreamTracker`); what was lost is simply not there. Memory does not depend on the length of the recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.core.plan import Plan
from pans.runtime.wire.framing import Messages
from pans.runtime.wire.messages import DARK_PATTERN, MessageType
from pans.runtime.wire.schema import (
    BLOCK_DTYPE,
    BLOCK_HEADER_BYTES,
    HEADER,
    MARK_DTYPE,
    MAX_GAP_EXPOSURES,
    MAX_PHOTON_NUMBER,
    RECEIVE_WINDOW,
)
from pans.runtime.wire.session import STREAM_TYPES
from pans.runtime.wire.tracker import SEQUENCE, StreamTracker

from .recording import Recording

EXPOSURES_AT_ONCE, BYTES_AT_ONCE = 1 << 16, 1 << 18
_TYPES = np.array(sorted(STREAM_TYPES), np.uint8)
_LARGEST = 1 << 62  # ticks and numbers beyond are judged one by one, in Python's integers
I64 = NDArray[np.int64]


class Exposures(NamedTuple):
    """Exposures of consecutive messages of one stream, one element each, and what the marks among these messages tell."""

    stream: int  # 0 until the device was lost for the first time
    truths: dict[int, int]  # true class of each object with a mark here; -1: unknown
    message_tick: I64  # (n,): begin of the first exposure of the message
    object: I64
    number: I64  # in its stream
    start_tick: I64  # begin of the exposure
    pattern: NDArray[
        np.uint16
    ]  # (n,): the pattern shown, DARK_PATTERN in the dark; 0 where all shine at once. Of a walk with several
    # channels that of channel 0, those of the others follow it
    clicks: NDArray[np.bool_]  # (n, channels)
    state: NDArray[
        np.uint16
    ]  # (n,): of the automaton, as the device stamped it, DARK_PATTERN in the dark; the pattern where there is none
    photons: NDArray[np.uint8]  # (n, channels): the numbers of a detector that counts, else 1 for a click


class _Heads(NamedTuple):
    """The heads of stream messages, one element each; block fields of a mark are 0."""

    spans: I64
    fields: NDArray[np.void]  # BLOCK_DTYPE
    marks: NDArray[np.void]  # MARK_DTYPE, of marks alone
    is_mark: NDArray[np.bool_]
    marks_before: I64  # (n + 1,)
    follows: NDArray[np.bool_]  # whether the tracker takes it if it has taken the one before, and the block before


def iter_exposures(recording: Recording, plan: Plan) -> Iterator[Exposures]:
    """Yield the exposures of `recording` in the order of its messages, at most about EXPOSURES_AT_ONCE at a time."""
    tracker, session, stream = StreamTracker(), None, -1
    for messages in _joined(recording.iter_messages()):
        heads, place = _heads(messages), 0
        ends = np.append(np.flatnonzero(~heads.follows), len(heads.spans))
        while place < len(heads.spans):
            frame = Messages(messages.buffer, heads.spans).frame(place)
            if frame.session != session:
                session, stream = frame.session, stream + 1
                tracker.restart()
            message, _ = tracker.accept(frame)
            if message is None:
                place += 1
                continue
            stop = int(ends[np.searchsorted(ends, place, "right")])
            stop = _follow(tracker, heads, place, stop)
            for first, last in _pieces(heads.fields["count"][place:stop]):
                yield _exposures(messages, heads, slice(place + first, place + last), stream, plan)
            place = stop


def _joined(some: Iterator[Messages]) -> Iterator[Messages]:
    """Yield the messages of several blocks together: a run at real pace writes a block for a few messages."""
    held: list[Messages] = []
    size = 0
    for messages in some:
        held.append(Messages(messages.buffer, messages.spans.copy()))  # each block has bytes of its own
        size += int(messages.spans[-1, 1])
        if size >= BYTES_AT_ONCE:
            yield _together(held)
            held, size = [], 0
    if held:
        yield _together(held)


def _together(held: list[Messages]) -> Messages:
    if len(held) == 1:
        return held[0]
    begins = np.cumsum([0, *(len(one.buffer) for one in held[:-1])])
    spans = [one.spans + begin for one, begin in zip(held, begins.tolist())]
    return Messages(np.concatenate([one.buffer for one in held]), np.concatenate(spans))


def _follow(tracker: StreamTracker, heads: _Heads, place: int, stop: int) -> int:
    """Let `tracker`, which has taken the message at `place`, take those behind it, to `stop` at most; return where that ends."""
    blocks = place + 1 + np.flatnonzero(~heads.is_mark[place + 1 : stop])
    if heads.is_mark[place] and len(blocks):
        ahead = int(heads.fields["exposure_index"][blocks[0]]) - tracker.next_exposure
        if not 0 <= ahead <= MAX_GAP_EXPOSURES:  # `follows` compares it with a block that the tracker may have refused
            stop, blocks = int(blocks[0]), blocks[:0]
    if stop > place + 1:
        last = heads.fields[blocks[-1]] if len(blocks) else None
        next_exposure = tracker.next_exposure if last is None else int(last["exposure_index"]) + int(last["count"])
        position = (int(heads.fields["seq"][stop - 1]) + 1) % SEQUENCE, next_exposure
        tracker.advance(position, stop - place - 1, int(heads.fields["count"][place + 1 : stop].sum(dtype=np.int64)))
    return stop


def _pieces(counts: NDArray[np.uint16]) -> Iterator[tuple[int, int]]:
    """Cut messages with so many exposures each into pieces of about EXPOSURES_AT_ONCE."""
    which = np.cumsum(counts, dtype=np.int64) // EXPOSURES_AT_ONCE
    cuts = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist(), len(counts)]
    yield from pairwise(cuts)


def _heads(messages: Messages) -> _Heads:
    """Read the heads of the stream messages among `messages`, and which of them are ordinary."""
    buffer, spans = messages
    for place in np.flatnonzero(spans[:, 1] - spans[:, 0] < HEADER.size)[:1].tolist():
        messages.frame(place)  # says what is wrong
    spans = spans[np.isin(buffer[spans[:, 0]], _TYPES)]
    fields, length = _gathered(buffer, spans, BLOCK_DTYPE), spans[:, 1] - spans[:, 0] - HEADER.size
    is_mark = fields["type"] == MessageType.MARK
    marks = _gathered(buffer, spans[is_mark], MARK_DTYPE)
    fields["tick"][is_mark], fields["exposure_index"][is_mark] = marks["tick"], marks["exposure_index"]
    for name in ("drops", "period_ticks", "count", "width"):
        fields[name][is_mark] = 0
    fields["width"][fields["type"] == MessageType.CLICKS] = 0
    whole = is_mark & (length == MARK_DTYPE.itemsize - HEADER.size)
    whole[is_mark] &= (marks["truth"] >= -1) & ~((marks["photons"] < 0) | np.isinf(marks["photons"]))
    whole |= _whole_blocks(buffer, spans, fields, length)
    whole &= (fields["tick"] < _LARGEST) & (fields["exposure_index"] < _LARGEST)
    marks_before = np.append(0, np.cumsum(is_mark))
    return _Heads(spans, fields, marks, is_mark, marks_before, _follows(fields, is_mark, whole))


def _gathered(buffer: NDArray[np.uint8], spans: I64, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Return what stands at the beginning of each span as rows of `dtype`; of a short one, whatever follows it."""
    places = np.minimum(spans[:, :1] + np.arange(dtype.itemsize), max(len(buffer) - 1, 0))
    return buffer[places].view(dtype)[:, 0] if len(spans) else np.zeros(0, dtype)


def _whole_blocks(buffer: NDArray[np.uint8], spans: I64, fields: NDArray[np.void], length: I64) -> NDArray[np.bool_]:
    """Which messages are blocks that hold what they say, as the decoders of `wire` judge them."""
    kind, count, width = fields["type"], fields["count"].astype(np.int64), fields["width"].astype(np.int64)
    counts = kind == MessageType.COUNTS
    body = np.select(
        [kind == MessageType.CLICKS, kind == MessageType.FRAMES, counts],
        [2 * count + (count + 7) // 8, count * width, 3 * count],
        -1,
    )
    whole = (body >= 0) & (length == BLOCK_HEADER_BYTES + body) & (count > 0) & (fields["period_ticks"] > 0)
    whole &= (width > 0) | (kind == MessageType.CLICKS)
    whole &= ~counts | ((width >= 2) & (width <= MAX_PHOTON_NUMBER))
    if (read := np.flatnonzero(counts & whole)).size:
        place, within, firsts = _spread(count[read])
        numbers = buffer[spans[read, 0][place] + HEADER.size + BLOCK_HEADER_BYTES + 2 * count[read][place] + within]
        whole[read] = np.maximum.reduceat(numbers, firsts) <= width[read]
    return whole


def _follows(fields: NDArray[np.void], is_mark: NDArray[np.bool_], whole: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which messages are whole and come behind the one before, as a block behind the block before; sequence numbers may wrap."""
    follows = whole.copy()
    follows[:1] = False
    follows[1:] &= whole[:-1] & (fields["session"][1:] == fields["session"][:-1])
    follows[1:] &= fields["seq"][1:] - (fields["seq"][:-1] + np.uint32(1)) < RECEIVE_WINDOW
    blocks = np.flatnonzero(~is_mark)
    now, before = fields[blocks[1:]], fields[blocks[:-1]]
    ahead = now["exposure_index"].astype(np.int64) - before["exposure_index"].astype(np.int64) - before["count"]
    alike = (now["type"] == before["type"]) & (now["width"] == before["width"])
    follows[blocks[1:]] &= alike & (ahead >= 0) & (ahead <= MAX_GAP_EXPOSURES)
    return follows


def _spread(counts: I64) -> tuple[I64, I64, I64]:
    """Return of each exposure its message and its place within it, and where the exposures of each message begin."""
    firsts = np.cumsum(counts) - counts
    message = np.repeat(np.arange(len(counts)), counts)
    return message, np.arange(len(message)) - firsts[message], firsts


def _exposures(messages: Messages, heads: _Heads, where: slice, stream: int, plan: Plan) -> Exposures:
    """Decode the messages at `where`, all of them whole and their blocks of one kind."""
    buffer, fields = messages.buffer, heads.fields[where]
    told = heads.marks[heads.marks_before[where.start] : heads.marks_before[where.stop]]
    truths = dict(zip(told["object_index"].tolist(), told["truth"].tolist()))
    blocks = fields[~heads.is_mark[where]]
    message, within, _ = _spread(blocks["count"].astype(np.int64))
    bodies = heads.spans[where, 0][~heads.is_mark[where]] + (HEADER.size + BLOCK_HEADER_BYTES)
    at, first, count = bodies[message], blocks["exposure_index"].astype(np.int64)[message], blocks["count"][message]
    kind = int(blocks["type"][0]) if len(blocks) else int(MessageType.CLICKS)
    if kind == MessageType.FRAMES:
        width = int(blocks["width"][0])
        words = buffer[(at + within * width)[:, None] + np.arange(width)]
        pattern = state = plan.slot_pattern[(first + within) % plan.slots_per_cycle]
        photons = np.unpackbits(words, axis=1, bitorder="little")[:, : plan.n_patterns]
    else:
        stamps = at + 2 * within
        state = buffer[stamps] | buffer[stamps + 1].astype(np.uint16) << np.uint16(8)
        behind = at + 2 * count.astype(np.int64)
        if kind == MessageType.COUNTS:
            photons = buffer[behind + within][:, None]
        else:
            photons = (buffer[behind + (within >> 3)] >> (within & 7).astype(np.uint8) & np.uint8(1))[:, None]
        if plan.channels_at_once > 1:
            photons = np.asarray(photons >> np.arange(plan.channels_at_once) & 1, np.uint8)
        pattern = state if plan.automaton is None else _patterns_of(state, plan.automaton)
    begin = blocks["tick"].astype(np.int64)[message]
    ticks = begin + within * blocks["period_ticks"].astype(np.int64)[message]
    objects = blocks["object_index"].astype(np.int64)[message]
    return Exposures(
        stream, truths, begin, objects, first + within, ticks, pattern, photons.astype(bool), state, photons
    )


def _patterns_of(state: NDArray[np.uint16], automaton: Automaton) -> NDArray[np.uint16]:
    """The pattern of each stamped state; stamps that are none (dark, or of no state at all) stand as they are."""
    known = state < automaton.n_states
    return np.where(known, automaton.pattern[np.where(known, state, 0)], state)


class ClickList(NamedTuple):
    """All clicks of a recording, one element each, in the order of time; `exposures` counts what could have clicked."""

    start_tick: NDArray[np.int64]
    exposure: NDArray[np.int64]
    object: NDArray[np.int64]
    channel: NDArray[np.int64]  # of the detector
    pattern: NDArray[np.int64]  # shown; DARK_PATTERN: none
    state: NDArray[np.int64]  # of the automaton; the pattern where there is none
    stream: NDArray[np.int64]
    exposures: int
    first_tick: int
    last_tick: int  # end of the last exposure
    photons: NDArray[np.int64]  # of each click: 1, or the number of a detector that counts


def click_list(recording: Recording, plan: Plan) -> ClickList:
    """Return the clicks of `recording` as arrays."""
    columns: list[list[NDArray[np.int64]]] = [[] for _ in range(8)]
    exposures, first_tick, last_tick = 0, 0, 0
    for item in iter_exposures(recording, plan):
        if not len(item.start_tick):
            continue
        row, channels = np.nonzero(item.clicks)
        of_channel = np.where(item.pattern[row] == DARK_PATTERN, 0, channels if plan.channels_at_once > 1 else 0)
        shown = item.pattern[row] + of_channel, item.state[row]
        stream = np.full(len(row), item.stream)
        for column, values in zip(
            columns,
            (
                *(item.start_tick[row], item.number[row], item.object[row], channels, *shown, stream),
                item.photons[row, channels],
            ),
        ):
            column.append(np.asarray(values, np.int64))
        first_tick = first_tick if exposures else int(item.start_tick[0])
        last_tick = int(item.start_tick[-1]) + plan.exposure_ticks
        exposures += len(item.clicks)
    empty = [np.zeros(0, np.int64)]
    start, number, thing, channel, pattern, state, streams, photons = (
        np.concatenate(column or empty) for column in columns
    )
    return ClickList(start, number, thing, channel, pattern, state, streams, exposures, first_tick, last_tick, photons)


def is_dark(pattern: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return where no light was shown."""
    return np.asarray(pattern == DARK_PATTERN)
