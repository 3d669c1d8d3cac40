"""The exposures of a recording, in the order of the device's clock: what was shown when, and what clicked.

Recorded messages come in, arrays of many exposures go out, for exports and reports. Repeated and damaged messages are left out as in the
run itself (`StreamTracker`); what was lost is simply not there. Memory does not depend on the length of the recording. A later part of
a run begins at the place in the stream that it says.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.bundle.automaton import Automaton
from pans.decide.plan import Plan
from pans.protocol.session import STREAM_TYPES
from pans.protocol.tracker import StreamTracker
from pans.protocol.wire import DARK_PATTERN, ClickBlock, FrameBlock, Mark, unpack_body

from .parts import JoinedRecording, place_of
from .recording import Recording
from .sent_plan import first_session

EXPOSURES_AT_ONCE = 1 << 16
I64 = NDArray[np.int64]


class Exposures(NamedTuple):
    """Exposures of consecutive messages of one stream, one element each, and what the marks among these messages tell."""

    stream: int  # 0 until the device was lost for the first time
    truths: dict[int, int]  # true class of each object with a mark here; -1: unknown
    message_tick: I64  # (n,): begin of the first exposure of the message
    object: I64
    number: I64  # in its stream
    start_tick: I64  # begin of the exposure
    # (n,): the pattern shown, DARK_PATTERN in the dark; 0 where all shine at once. Of a walk with several channels that of channel 0, those
    # of the others follow it
    pattern: NDArray[np.uint16]
    clicks: NDArray[np.bool_]  # (n, channels)
    # (n,): of the automaton, as the device stamped it, DARK_PATTERN in the dark; the pattern where there is none
    state: NDArray[np.uint16]
    photons: NDArray[np.uint8]  # (n, channels): the numbers of a detector that counts, else 1 for a click


def iter_exposures(recording: Recording, plan: Plan) -> Iterator[Exposures]:
    """Yield the exposures of `recording` in the order of its messages, at most about EXPOSURES_AT_ONCE at a time."""
    tracker, session, stream = StreamTracker(), None, -1
    for part in recording.parts if isinstance(recording, JoinedRecording) else (recording,):
        held, truths, n = list[ClickBlock | FrameBlock](), dict[int, int](), 0
        if (place := place_of(part)) is not None:
            tracker.resume(place.tracker)
            before, session = session, first_session(part)
            stream += session != before
            truths = {mark.object_index: mark.truth for mark in place.marks}
        for _, body in part.messages():
            frame = unpack_body(body)
            if frame.type not in STREAM_TYPES:
                continue
            begins = frame.session != session
            if begins:
                tracker.restart()
            message, _ = tracker.accept(frame)
            # arrays are made of blocks of one stream and form
            differs = held and isinstance(message, ClickBlock | FrameBlock) and _form(message) != _form(held[0])
            if begins or differs or max(n, len(truths)) >= EXPOSURES_AT_ONCE:
                if held:
                    yield _exposures(held, truths, stream, plan)
                held, truths, n = [], {}, 0
            session, stream = frame.session, stream + begins
            if isinstance(message, Mark):
                truths[message.object_index] = message.truth
            elif message is not None:
                held.append(message)
                n += len(message[6])
        if held:
            yield _exposures(held, truths, stream, plan)


def _form(block: ClickBlock | FrameBlock) -> tuple[int, ...]:
    """Return what tells clicks, photon numbers and frames of different widths apart."""
    return block.words.shape[1:] if isinstance(block, FrameBlock) else (-block.largest,)


def _exposures(blocks: Sequence[ClickBlock | FrameBlock], truths: dict[int, int], stream: int, plan: Plan) -> Exposures:
    """Return the exposures of blocks of one form."""
    counts = np.array([len(block[6]) for block in blocks])
    heads = np.array(
        [(block.tick, block.exposure_index, block.period_ticks, block.object_index) for block in blocks], np.int64
    )
    begin, first, period, objects = np.repeat(heads, counts, axis=0).T
    within = np.arange(len(begin)) - np.repeat(np.cumsum(counts) - counts, counts)
    number = first + within
    if isinstance(blocks[0], FrameBlock):
        words = np.concatenate([block[6] for block in blocks])
        pattern = state = plan.slot_pattern[number % plan.slots_per_cycle]
        photons = np.unpackbits(words, axis=1, bitorder="little")[:, : plan.n_patterns]
    else:
        state = np.concatenate([block[6] for block in blocks])
        photons = np.concatenate([block.bits for block in blocks if isinstance(block, ClickBlock)])[:, None]
        if plan.channels_at_once > 1:
            photons = np.asarray(photons >> np.arange(plan.channels_at_once) & 1, np.uint8)
        pattern = state if plan.automaton is None else _patterns_of(state, plan.automaton)
    ticks = begin + within * period
    return Exposures(stream, truths, begin, objects, number, ticks, pattern, photons.astype(bool), state, photons)


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
    lit_streams: NDArray[np.int64]  # the streams with an exposure in the light: each of them began a decision


def click_list(recording: Recording, plan: Plan) -> ClickList:
    """Return the clicks of `recording` as arrays."""
    found = [np.zeros((8, 0), np.int64)]
    exposures, first_tick, last_tick, lit = 0, 0, 0, set[int]()
    for item in iter_exposures(recording, plan):
        if not len(item.start_tick):
            continue
        row, channels = np.nonzero(item.clicks)
        dark = is_dark(item.pattern[row])
        shown = item.pattern[row] + np.where(dark | (plan.channels_at_once == 1), 0, channels)
        columns = item.start_tick[row], item.number[row], item.object[row], channels, shown, item.state[row]
        found.append(np.array([*columns, np.full(len(row), item.stream), item.photons[row, channels]], np.int64))
        first_tick = first_tick if exposures else int(item.start_tick[0])
        last_tick = int(item.start_tick[-1]) + plan.exposure_ticks
        exposures += len(item.clicks)
        if not is_dark(plan.slot_pattern[item.number % plan.slots_per_cycle]).all():
            lit.add(item.stream)
    start, number, thing, channel, pattern, state, stream, photons = np.concatenate(found, axis=1)
    seven = start, number, thing, channel, pattern, state, stream
    return ClickList(*seven, exposures, first_tick, last_tick, photons, np.array(sorted(lit), np.int64))


def first_tick(recording: Recording, plan: Plan) -> int:
    """Return the begin of the first recorded exposure, 0 where there is none."""
    return next((int(item.start_tick[0]) for item in iter_exposures(recording, plan) if len(item.start_tick)), 0)


def is_dark(pattern: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return where no light was shown."""
    return np.asarray(pattern == DARK_PATTERN)
