"""What the guard of the dark counts sees of frames that compiled turns have taken: many blocks in one call.

Owns the order in which the guard sees a block (its silence, its dark frames, its object), compiled; what a block tells is Python's
(core/dark_guard.py). The findings are those of `Core.watch_frames` on each block.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from pans.runtime.core.still import Core
from pans.runtime.instrument.channel_health import Finding
from pans.runtime.instrument.cusum import take_words
from pans.runtime.instrument.dead_channels import DeadArrays, note_object, note_seen
from pans.runtime.wire import walk as stream
from pans.runtime.wire.bare import bare, load4, load8
from pans.runtime.wire.frame import read_only
from pans.runtime.wire.inner import inner, outer
from pans.runtime.wire.messages import FrameBlock, decode_frames
from pans.runtime.wire.schema import HEADER, NO_OBJECT

from . import rings as ring
from .rings import I64, U8

# place, int64 (N_PLACE,): the dark exposures before, the object under way, whether it is, objects before it; alarms of the last block
DARK, OBJECT, IS_OPEN, OBJECTS, ALARMS, N_PLACE = range(6)
ALL_SEEN, SILENT, ALARMED, PASSED = range(4)  # why a call ended: nothing is left, or what a block told
_EIGHT = 8  # bytes at once
MOST_FRAMES = 1 << 16  # of one block: its count is a u16
_NO_OBJECT = NO_OBJECT
_U = np.uint64


class FrameWatch:
    """The guard of `core`, of parallel frames, behind compiled turns; all memory is allocated here, before arming."""

    def __init__(self, core: Core) -> None:
        guard = core.guard
        assert guard is not None
        self._core, self._guard = core, guard
        n = guard.watch.n_channels
        self._dark: U8 = np.full((MOST_FRAMES if guard.dark_slot.any() else 0, -(-n // 8)), 0, np.uint8)
        self._seen: I64 = np.zeros((2, -(-n // 8)), np.int64)
        self._place: I64 = np.zeros(N_PLACE, np.int64)
        self._maps = slots_until_dark(guard.dark_slot), np.append(0, np.cumsum(core.windows.lit, dtype=np.int64))
        none: I64 = np.zeros(0, np.int64)
        dead = [none] * 6 + [np.zeros((0, 0), np.int64)] + [none] * 3
        self._dead = DeadArrays(*dead) if guard.lit is None else guard.lit.arrays

    def take(self, kept: U8, messages: I64) -> list[Finding]:
        """Take the FRAMES among `messages` (rings.py's spans (n, 4)) in `kept`; return the findings."""
        guard, core, events, at = self._guard, self._core, list[Finding](), 0
        while at < len(messages):
            if guard.health.present:  # each block may end what lasts
                events += self._one(kept, messages[at])
                at += 1
                continue
            at, why = self._go_on(kept, messages, at)
            if why == ALL_SEEN:
                break
            block = _block_of(kept, messages[at])
            events += guard.news()
            if why == SILENT:
                guard.look_for_dead()
                events += guard.take_rest(block)
            if why == ALARMED:
                alarms = guard.found(guard.watch.went_on(int(self._place[DARK]), int(self._place[ALARMS])))
                events += guard.news() + alarms
            if why == PASSED:
                guard.look_for_dead()
            else:
                core.watch_object(block)
            at += 1
        return events + guard.news()

    def warm_up(self) -> None:
        """Compile or load the kernel, before arming; nothing is counted."""
        self._go_on(np.zeros(8, np.uint8), np.zeros((0, 4), np.int64), 0)

    def _go_on(self, kept: U8, messages: I64, first: int) -> tuple[int, int]:
        guard, place = self._guard, self._place
        place[DARK] = guard.watch.exposures
        if guard.lit is not None:
            place[OBJECT : OBJECTS + 1] = guard.lit.place
        maps = (*self._maps, self._core.windows.lit)
        at, why = watch_frames(
            kept,
            messages,
            first,
            maps,
            (self._dark, read_only(self._dark), self._seen),
            guard.watch.arrays,
            self._dead,
            place,
        )
        if guard.lit is not None:
            number, is_open, objects = place[OBJECT : OBJECTS + 1].tolist()
            guard.lit.went_on((number, bool(is_open), objects), due=why in (SILENT, PASSED))
        if why != ALARMED:
            guard.watch.went_on(int(place[DARK]), 0)
        return int(at), int(why)

    def _one(self, kept: U8, span: npt.NDArray[Any]) -> list[Finding]:
        return self._core.watch_frames(_block_of(kept, span)) if span[ring.WHAT] == stream.FRAMES else []


def slots_until_dark(dark_slot: npt.NDArray[np.bool_]) -> I64:
    """Return how many slots of a cycle lie before the next dark one, from each on, int64 (slots,); more than any block has without one."""
    slots, dark = np.arange(len(dark_slot)), np.flatnonzero(dark_slot)
    if not len(dark):
        return np.full(len(slots), MOST_FRAMES, np.int64)
    following = np.append(dark, dark[0] + len(slots))
    return following[np.searchsorted(following, slots)] - slots


def _block_of(kept: U8, span: npt.NDArray[Any]) -> FrameBlock:
    return decode_frames(kept[int(span[ring.BEGIN]) + HEADER.size : int(span[ring.END])].tobytes())


@outer
def watch_frames(kept, messages, first, maps, scratch, watch, dead, place):  # type: ignore[no-untyped-def]
    """Let the tests see the FRAMES among `messages` from `first` on, until one tells something; return its place and why.

    SILENT: a channel's silence has passed its limit; the block's dark frames and its object have not been seen. ALARMED: place[ALARMS]
    alarms came of its dark frames; its object has not been seen. PASSED: with its object another one has passed, and channels are due.
    maps: `slots_until_dark` int64 (slots of a cycle,), of a visit how many exposures are lit before each int64 (visit + 1,) and which ones
    bool (visit,); scratch: uint8 (n, bytes) dark frames, the same read-only, and int64 (2, bytes); watch: ChannelWatch.arrays, dead:
    DeadArrays (of length 0 without such a test), place int64 (N_PLACE,).
    """
    kept, messages, place, maps, scratch = bare(kept), bare(messages), bare(place), bare(maps), bare(scratch)
    watch, dead = bare(watch), bare(dead)
    dark, words, seen = scratch
    tests_lit, n_bytes = dead.silent.size > 0, seen.shape[1]
    for at in range(first, messages.shape[0]):
        if messages[at, ring.WHAT] != stream.FRAMES:
            continue
        payload = _U(messages[at, ring.BEGIN] + stream.BODY_HEADER)
        count = np.int64(load4(kept, payload + _U(28)) & _U(0xFFFF))
        n_dark = _look(kept, payload, count, maps, dark, seen)
        if tests_lit:
            passed = False
            for byte in range(n_bytes):
                passed |= note_seen(seen[0, byte], byte, count, dead.silent, dead.clicking, dead.limits)
            if passed:
                return at, SILENT
        if n_dark:
            place[ALARMS] = take_words(words[:n_dark], place[DARK], *watch)
            place[DARK] += n_dark
            if place[ALARMS]:
                return at, ALARMED
        if tests_lit and seen[1, 0] >= 0 and _note_object(load4(kept, payload + _U(32)), seen, dead, place):
            return at, PASSED
    return messages.shape[0], ALL_SEEN


@inner
def _look(kept, payload, count, maps, dark, seen):  # type: ignore[no-untyped-def]
    """Gather a block's dark frames and return how many; which channels clicked in any frame and in lit ones, -1 where none was lit."""
    until_dark, lit_before, lit = maps
    n_bytes, width = seen.shape[1], load4(kept, payload + _U(28)) >> _U(16)
    exposure = np.int64(load8(kept, payload + _U(16)))
    here, n_dark, start = exposure % lit.size, 0, payload + _U(stream.BLOCK_HEADER)
    n_lit = lit_before[here + count] - lit_before[here]
    if n_lit == count:
        _all_seen(kept, start, count * np.int64(width), np.int64(width), seen)
    for byte in range(n_bytes if n_lit < count else 0):
        at, all_seen, lit_seen = start + _U(byte), np.int64(0), np.int64(0)
        for i in range(count):
            word = np.int64(kept[at])
            all_seen |= word
            lit_seen |= word if lit[here + i] else np.int64(0)
            at += width
        seen[0, byte], seen[1, byte] = all_seen, lit_seen
    i = until_dark[exposure % until_dark.size]
    while i < count and dark.shape[0]:
        for byte in range(n_bytes):
            dark[n_dark, byte] = kept[start + _U(i) * width + _U(byte)]
        i, n_dark = i + 1 + until_dark[(exposure + i + 1) % until_dark.size], n_dark + 1
    if not n_lit:
        seen[1, 0] = -1
    return n_dark


@inner
def _all_seen(kept, start, size, width, seen):  # type: ignore[no-untyped-def]
    """Which channels clicked in any of a block's frames, all of them lit: `size` bytes from `start` on, `width` each."""
    stop, at = start + _U(size), start
    for byte in range(seen.shape[1]):
        seen[0, byte] = 0
    if _EIGHT % width == 0:  # eight bytes hold whole frames
        gathered = _U(0)
        while at + _U(_EIGHT) <= stop:
            gathered |= load8(kept, at)
            at += _U(_EIGHT)
        for byte in range(_EIGHT):
            if byte % width < seen.shape[1]:
                seen[0, byte % width] |= np.int64(gathered >> _U(8 * byte) & _U(0xFF))
    while at < stop:
        for byte in range(seen.shape[1]):
            seen[0, byte] |= np.int64(kept[at + _U(byte)])
        at += _U(width)
    for byte in range(seen.shape[1]):
        seen[1, byte] = seen[0, byte]


@inner
def _note_object(number, seen, dead, place):  # type: ignore[no-untyped-def]
    """As DeadChannelTest.take_object; return whether the object before it has gone and channels are due to be looked at."""
    due = False
    which = np.int64(-1) if number == _U(_NO_OBJECT) else np.int64(number)
    if place[IS_OPEN] and (which < 0 or which != place[OBJECT]):
        due = note_object(dead.row, dead.clicked, dead.quiet, dead.then, dead.compared, dead.first, dead.due)
        place[OBJECTS] += 1
        for channel in range(dead.row.size):
            dead.row[channel] = 0
    place[OBJECT], place[IS_OPEN] = which, 1
    for channel in range(dead.row.size):
        if (seen[1, channel >> 3] >> (channel & 7)) & 1:
            dead.row[channel] = 1
    return due
