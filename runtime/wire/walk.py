"""What compiled walks through a stream ask of decoded CLICKS, FRAMES and MARK messages: what they hold, and whether they come next.

Owns the offsets of these messages (docs/reference/protocol.md) and the account of the stream's place for kernels; never allocates and
keeps no state of its own. A walk takes messages that are in order and without loss and leaves all others to `StreamTracker`.
"""

from __future__ import annotations

import numpy as np

from .bare import as_float32, load4, load8
from .inner import inner
from .kernels import crc32_span
from .schema import BLOCK_HEADER_BYTES, HEADER, SCHEMA, STRUCTS, MessageType
from .tracker import MAX_GAP_EXPOSURES, RECEIVE_WINDOW

# Where the stream stands, the first columns of a walk's state, int64: as StreamTracker knows it, the exposure at which the plan ends,
# and what the walk has taken.
NEXT_SEQ, NEXT_EXPOSURE, DROPS, END_EXPOSURE, MESSAGES, EXPOSURES, N_PLACE = range(7)
CLICKS, FRAMES, MARK = int(MessageType.CLICKS), int(MessageType.FRAMES), int(MessageType.MARK)
BODY_HEADER, BLOCK_HEADER, MARK_BYTES = HEADER.size, BLOCK_HEADER_BYTES, STRUCTS["MARK"].size
LARGEST = np.uint64(1 << 62)  # ticks and exposure numbers beyond are left to Python's integers
_INFINITE = np.uint64(0x7F800000)  # float32's bits: numbers from 0 on lie below, NaN above once the sign is taken away
_MAGNITUDE = np.uint64(0x7FFFFFFF)
_U = np.uint64
_SCHEMA, _WINDOW = np.int64(SCHEMA), RECEIVE_WINDOW


@inner
def next_block(buffer, payload, stop, place):  # type: ignore[no-untyped-def]
    """Frames and bytes per frame of the FRAMES payload from `payload` to `stop`.

    (0, 0) when it is not as long as it says, does not follow `place` without loss, or goes beyond the plan.
    """
    if stop - payload <= _U(BLOCK_HEADER):
        return 0, 0
    shape = load4(buffer, payload + _U(28))
    count, width = np.int64(shape & _U(0xFFFF)), np.int64(shape >> _U(16))
    if np.int64(stop - payload) != BLOCK_HEADER + count * width or not _follows(buffer, payload, count, place):
        return 0, 0
    return count, width


@inner
def next_clicks(buffer, payload, stop, place):  # type: ignore[no-untyped-def]
    """Exposures of the CLICKS payload from `payload` to `stop`; 0 where `next_block` would say so."""
    if stop - payload <= _U(BLOCK_HEADER):
        return 0
    count = np.int64(load4(buffer, payload + _U(28)) & _U(0xFFFF))
    length = BLOCK_HEADER + 2 * count + (count + 7) // 8
    if np.int64(stop - payload) != length or not _follows(buffer, payload, count, place):
        return 0
    return count


@inner
def unpack_clicks(buffer, payload, count, stamps, bits):  # type: ignore[no-untyped-def]
    """Put the patterns shown and the clicks of a CLICKS payload of `count` exposures into uint16 and uint8 (count or more,)."""
    at = payload + _U(BLOCK_HEADER)
    first_byte = at + _U(2 * count)
    for i in range(count):
        stamps[i] = np.uint16(buffer[at + _U(2 * i)]) | np.uint16(buffer[at + _U(2 * i + 1)]) << np.uint16(8)
        bits[i] = buffer[first_byte + _U(i >> 3)] >> np.uint8(i & 7) & np.uint8(1)


@inner
def _follows(buffer, payload, count, place):  # type: ignore[no-untyped-def]
    """Whether a block of `count` exposures is the next one, without loss, within the plan and the range of its fields."""
    return not (
        load4(buffer, payload) != _U(place[NEXT_SEQ])
        or load4(buffer, payload + _U(4)) != _U(place[DROPS])
        or load8(buffer, payload + _U(8)) >= LARGEST
        or load8(buffer, payload + _U(16)) != _U(place[NEXT_EXPOSURE])
        or load4(buffer, payload + _U(24)) == _U(0)
        or place[NEXT_EXPOSURE] + count > place[END_EXPOSURE]
    )


@inner
def is_next_mark(buffer, payload, stop, place):  # type: ignore[no-untyped-def]
    """Whether the payload from `payload` to `stop` is a whole MARK, follows `place` without loss and holds what the dictionary allows.

    Its truth is compared with -1 alone here: how many classes there are, the caller knows.
    """
    if stop - payload != _U(MARK_BYTES) or load4(buffer, payload) != _U(place[NEXT_SEQ]):
        return False
    photons = load4(buffer, payload + _U(28))
    return (
        (photons < _INFINITE or photons & _MAGNITUDE > _INFINITE)
        and mark_truth(buffer, payload) >= -1
        and load8(buffer, payload + _U(12)) < LARGEST
        and load8(buffer, payload + _U(20)) < LARGEST
    )


@inner
def mark_fits(buffer, payload, place, n_classes):  # type: ignore[no-untyped-def]
    """Whether a MARK's truth is one of `n_classes` or unknown, and its exposure near the stream's place, as core/plausible.py asks."""
    away = np.int64(load8(buffer, payload + _U(12))) - place[NEXT_EXPOSURE]
    near = -MAX_GAP_EXPOSURES <= away <= MAX_GAP_EXPOSURES
    return near and -1 <= mark_truth(buffer, payload) < n_classes


@inner
def go_on(place, count):  # type: ignore[no-untyped-def]
    """Account for the next message, with `count` exposures."""
    place[NEXT_SEQ] = (place[NEXT_SEQ] + 1) & 0xFFFFFFFF
    place[MESSAGES] += 1
    place[NEXT_EXPOSURE] += count
    place[EXPOSURES] += count


@inner
def is_plain(buffer, start):  # type: ignore[no-untyped-def]
    """Whether flags and reserved bits of the body at `start` are 0, so that its CRC-32 is that of its content (frame.content_crc)."""
    return load4(buffer, start) <= _U(0xFF)


@inner
def note_heard(heard, place, crc):  # type: ignore[no-untyped-def]
    """Remember the CRC-32 of the message that `go_on` has accounted for last; `heard` is StreamTracker's."""
    number = (place[NEXT_SEQ] - 1) & 0xFFFFFFFF
    row = heard[number % _WINDOW]
    row[0], row[1] = number, np.int64(crc)


@inner
def hear(buffer, start, stop, heard, place):  # type: ignore[no-untyped-def]
    """As `note_heard`, of the body from `start` to `stop`, behind which its CRC need not stand (in a recording)."""
    note_heard(heard, place, crc32_span(buffer, start, stop, _SCHEMA))


@inner
def block_times(buffer, payload):  # type: ignore[no-untyped-def]
    """The tick at which a block's first exposure began, and the ticks from one to the next; int64."""
    return np.int64(load8(buffer, payload + _U(8))), np.int64(load4(buffer, payload + _U(24)))


@inner
def mark_photons(buffer, payload, photons, place):  # type: ignore[no-untyped-def]
    """Put a MARK's photons into `photons` float32 at `place`, bit for bit."""
    photons[place] = as_float32(load4(buffer, payload + _U(28)))


@inner
def mark_truth(buffer, payload):  # type: ignore[no-untyped-def]
    """A MARK's truth, int64; -1: unknown."""
    return np.int64(np.int16(np.uint16(load4(buffer, payload + _U(8)) & _U(0xFFFF))))
