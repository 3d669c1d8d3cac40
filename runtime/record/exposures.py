"""The exposures of a recording, in the order of the device's clock: what was shown when, and what clicked.

Owns the way from recorded messages to arrays, for exports and reports; never decides and never judges. Repeated and damaged messages are
left out as in the run itself (ingest.py); what was lost is simply not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pans.runtime.bundle.automaton import Automaton
from pans.runtime.core.plan import Plan
from pans.runtime.wire.messages import DARK_PATTERN, ClickBlock, FrameBlock, Mark, unpack_body
from pans.runtime.wire.session import STREAM_TYPES
from pans.runtime.wire.tracker import StreamTracker

from .recording import Recording


class Exposures(NamedTuple):
    """Consecutive exposures of one message."""

    arrival_ns: int
    stream: int  # 0 until the device was lost for the first time
    object: int
    first: int  # number of the first exposure in its stream
    start_tick: NDArray[np.int64]  # (n,): begin of each exposure
    pattern: NDArray[
        np.uint16
    ]  # (n,): the pattern shown, DARK_PATTERN in the dark; 0 where all shine at once. Of a walk with several
    # channels that of channel 0, those of the others follow it
    clicks: NDArray[np.bool_]  # (n, channels)
    state: NDArray[
        np.uint16
    ]  # (n,): of the automaton, as the device stamped it, DARK_PATTERN in the dark; the pattern where there is none
    photons: NDArray[np.uint8]  # (n, channels): the numbers of a detector that counts, else 1 for a click


def iter_exposures(recording: Recording, plan: Plan) -> Iterator[Exposures | Mark]:
    """Yield the exposures and the marks of `recording`, message by message."""
    tracker, session, stream = StreamTracker(), None, -1
    for arrival_ns, body in recording.messages():
        frame = unpack_body(body)
        if frame.type not in STREAM_TYPES:
            continue
        if frame.session != session:
            session, stream = frame.session, stream + 1
            tracker.restart()
        message, _ = tracker.accept(frame)
        if isinstance(message, Mark):
            yield message
        elif message is not None:
            yield _exposures(message, arrival_ns, stream, plan)


def _exposures(block: ClickBlock | FrameBlock, arrival_ns: int, stream: int, plan: Plan) -> Exposures:
    if isinstance(block, ClickBlock):
        photons = block.bits[:, None]
        if plan.channels_at_once > 1:
            photons = np.asarray(photons >> np.arange(plan.channels_at_once) & 1, np.uint8)
        state = block.patterns
        pattern = state if plan.automaton is None else _patterns_of(state, plan.automaton)
    else:
        bits = np.unpackbits(block.words, axis=1, bitorder="little")
        slot = (block.exposure_index + np.arange(len(bits))) % plan.slots_per_cycle
        pattern, photons = plan.slot_pattern[slot], bits[:, : plan.n_patterns]
        state = pattern
    ticks = block.tick + np.arange(len(photons), dtype=np.int64) * block.period_ticks
    where = block.object_index, block.exposure_index, ticks
    return Exposures(arrival_ns, stream, *where, pattern, photons.astype(bool), state, photons)


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
        if isinstance(item, Mark):
            continue
        row, channels = np.nonzero(item.clicks)
        same = np.full(len(row), item.object), np.full(len(row), item.stream)
        of_channel = np.where(item.pattern[row] == DARK_PATTERN, 0, channels if plan.channels_at_once > 1 else 0)
        shown = item.pattern[row] + of_channel, item.state[row]
        for column, values in zip(
            columns,
            (item.start_tick[row], item.first + row, same[0], channels, *shown, same[1], item.photons[row, channels]),
        ):
            column.append(np.asarray(values, np.int64))
        first_tick = first_tick if exposures else int(item.start_tick[0])
        last_tick = int(item.start_tick[-1]) + plan.exposure_ticks
        exposures += len(item.clicks)
    empty = [np.zeros(0, np.int64)]
    start, number, thing, channel, pattern, state, stream, photons = (
        np.concatenate(column or empty) for column in columns
    )
    return ClickList(start, number, thing, channel, pattern, state, stream, exposures, first_tick, last_tick, photons)


def is_dark(pattern: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return where no light was shown."""
    return np.asarray(pattern == DARK_PATTERN)
