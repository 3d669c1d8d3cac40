"""The wire in compiled code: COBS and CRC-32 on one buffer in place, and what CLICKS, FRAMES and MARK messages hold.

Kernels take arrays and allocate nothing. `unstuff_frames` gives the frames and counts that the protocol document asks for
(tests/runtime/protocol/wire/test_framing.py has a plain decoder). The kernel of the live loop takes messages that are in order and
without loss, and leaves all others to `StreamTracker`. Both go on from one record: `place` is its row, `place.next_seq` and so on
(protocol/tracker.py, decide/core_state.py).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pans.base.machine import as_float32, copy_span, inner, load2, load4, load8, outer

from .schema import (
    BLOCK_DTYPE,
    BLOCK_HEADER_BYTES,
    HEADER,
    MARK_DTYPE,
    MAX_GAP_EXPOSURES,
    RECEIVE_WINDOW,
    SCHEMA,
    STRUCTS,
    MessageType,
    payload_offsets,
)

CLICKS, FRAMES, MARK = int(MessageType.CLICKS), int(MessageType.FRAMES), int(MessageType.MARK)
BODY_HEADER, BLOCK_HEADER, MARK_BYTES = HEADER.size, BLOCK_HEADER_BYTES, STRUCTS["MARK"].size
# Where the fields stand in a payload. CLICKS, FRAMES and MARK begin with the sequence number.
SEQ_AT, DROPS_AT, TICK_AT, FIRST_AT, PERIOD_AT, COUNT_AT, WIDTH_AT, OBJECT_AT = payload_offsets(
    BLOCK_DTYPE, "seq", "drops", "tick", "exposure_index", "period_ticks", "count", "width", "object_index"
)
MARK_OBJECT_AT, TRUTH_AT, HALF_AT, MARK_FIRST_AT, MARK_TICK_AT, PHOTONS_AT = payload_offsets(
    MARK_DTYPE, "object_index", "truth", "half_exposures", "exposure_index", "tick", "photons"
)
(SESSION_AT,) = payload_offsets(BLOCK_DTYPE, "session", begin=0)  # in the body
LARGEST = np.uint64(1 << 62)  # ticks and exposure numbers beyond are left to Python's integers
_INFINITE = np.uint64(0x7F800000)  # float32's bits: numbers from 0 on lie below, NaN above once the sign is taken away
_MAGNITUDE = np.uint64(0x7FFFFFFF)
_SCHEMA, _WINDOW = np.int64(SCHEMA), RECEIVE_WINDOW
# columns of a decoder's tally: those of DecoderCounters, then what is under way
GOOD_FRAMES, BYTES_IN, CRC_ERRORS, COBS_ERRORS, SHORT_FRAMES, OVERSIZED, DISCARDED = range(7)
SKIPPING, CONSUMED, HELD, N_TALLIES = range(7, 11)
SMALLEST_BODY = 12  # header and CRC
_U = np.uint64
_ONE, _EIGHT, _SIXTEEN, _BYTE = _U(1), _U(8), _U(16), _U(0xFF)
_ONES, _HIGHS = _U(0x0101010101010101), _U(0x8080808080808080)
_LOW32 = _U(0xFFFFFFFF)
_LONG_RUN = 12  # zeros in a row before it pays to look at eight at once: shorter runs are told apart by no branch


def _crc_tables() -> npt.NDArray[np.uint32]:
    """Tables of the reflected CRC-32 polynomial: row k is the effect of a byte that k further bytes follow."""
    table = np.zeros((16, 256), np.uint32)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB88320 if crc & 1 else 0)
        table[0, byte] = crc
    for k in range(1, 16):
        table[k] = table[0][table[k - 1] & 0xFF] ^ (table[k - 1] >> 8)
    return table


CRC_TABLES = _crc_tables()


@inner
def crc32_span(data, start, stop, seed):  # type: ignore[no-untyped-def]
    """CRC-32 of data[start:stop], uint8, continued from `seed`, as zlib.crc32 gives it; a uint64 below 2^32.

    Sixteen bytes a step through sixteen tables ("slicing", Kounavis and Berry 2005): no instruction beyond plain integers.
    """
    table = CRC_TABLES
    crc = _U(seed) ^ _LOW32
    i, end = _U(start), _U(stop)
    while i + _SIXTEEN <= end:
        x, y, crc = load8(data, i) ^ crc, load8(data, i + _EIGHT), _U(0)
        for k in range(8):
            crc ^= _U(table[15 - k, x >> _U(8 * k) & _BYTE] ^ table[7 - k, y >> _U(8 * k) & _BYTE])
        i += _SIXTEEN
    while i < end:
        crc = _U(table[0, (crc ^ _U(data[i])) & _BYTE]) ^ (crc >> _EIGHT)
        i += _ONE
    return crc ^ _LOW32


@inner
def find_zero(data, start, stop):  # type: ignore[no-untyped-def]
    """First position in start..stop-1 whose byte is 0, or `stop`; all uint64. Eight bytes a step."""
    i = start
    while i + _EIGHT <= stop:
        v = load8(data, i)
        # A byte is 0 exactly where adding 0x7F to its low bits and or-ing it gives no high bit: nothing borrows or overflows.
        if (((v & ~_HIGHS) + ~_HIGHS) | v) & _HIGHS != _HIGHS:
            break
        i += _EIGHT
    while i < stop and data[i] != 0:
        i += _ONE
    return i


@inner
def unstuff(data, start, stop):  # type: ignore[no-untyped-def]
    """Undo COBS on data[start:stop] in place: the body stands at start+1..; return its end, or 0 if it is no COBS string.

    The span holds no zero. A code byte is where the zero of the group before it belongs, so that up to the first full group (255)
    nothing moves at all. There the walk from code to code has no branch that depends on the data, except that a long run
    of code 1, the zeros of sparse clicks, goes on eight at a time.
    """
    pos = start
    code = _U(data[pos])
    run = 0
    while code != _BYTE:
        end = pos + code
        if end >= stop:
            return stop if end == stop else _U(0)
        following = _U(data[end])
        data[end] = 0
        run = (run + 1) * (following == _ONE)
        pos = end
        code = following
        if run > _LONG_RUN:
            while pos + _EIGHT < stop and load8(data, pos + _ONE) == _ONES:
                for k in range(8):
                    data[pos + _ONE + _U(k)] = 0
                pos += _EIGHT
            run = 0
    return _unstuff_moving(data, pos, stop, code)


@inner
def _unstuff_moving(data, pos, stop, code):  # type: ignore[no-untyped-def]
    """The rest of `unstuff` from the group at `pos` on, whose code has been read: data moves down by one per full group."""
    out = pos + _ONE
    while True:
        end = pos + code
        if end > stop:
            return _U(0)
        if out == pos + _ONE:
            out = end
        else:
            copy_span(data, pos + _ONE, end, data, out)
            out += end - pos - _ONE
        pos = end
        if pos >= stop:
            return out
        following = _U(data[pos])
        if code != _BYTE:
            data[out] = 0
            out += _ONE
        code = following
        while code == _ONE and pos + _EIGHT < stop and load8(data, pos + _ONE) == _ONES:
            for k in range(8):
                data[out + _U(k)] = 0
            pos += _EIGHT
            out += _EIGHT


@outer
def unstuff_frames(data, used, limit, schema, bodies, tally):  # type: ignore[no-untyped-def]
    """Decode every frame that ends within data[:used], in place; return how many bodies are good.

    data uint8 (capacity,), limit: longest raw frame in bytes, schema: the CRC's seed, bodies int64 (used // 14 + 1, 2): start and stop
    of each header + payload, tally int64 (N_TALLIES,): counts are added to, SKIPPING (within an oversized frame) is kept, and
    CONSUMED is set to the bytes that are done with: the rest is to be put before the next data.
    """
    n_bodies = 0
    start, n_used = _U(0), _U(used)
    while True:
        stop = find_zero(data, start, n_used)
        length = np.int64(stop) - np.int64(start)
        if tally[SKIPPING]:
            tally[DISCARDED] += length
        elif length > limit:
            tally[OVERSIZED] += 1
            tally[DISCARDED] += length
            tally[SKIPPING] = 1
        if stop >= n_used:
            break
        if tally[SKIPPING]:
            tally[SKIPPING] = 0
        elif length > 0:
            end = unstuff(data, start, stop)
            first = start + _ONE
            if end == _U(0):
                tally[COBS_ERRORS] += 1
                tally[DISCARDED] += length + 1
            elif np.int64(end) - np.int64(first) < SMALLEST_BODY:
                tally[SHORT_FRAMES] += 1
                tally[DISCARDED] += length + 1
            else:
                kind = data[first]
                seed = 0 if kind == 0x01 or kind == 0x81 else schema  # HELLO and WELCOME: schema.UNSEEDED
                if crc32_span(data, first, end - _U(4), seed) == load4(data, end - _U(4)):
                    tally[GOOD_FRAMES] += 1
                    bodies[n_bodies, 0] = np.int64(first)
                    bodies[n_bodies, 1] = np.int64(end) - 4
                    n_bodies += 1
                else:
                    tally[CRC_ERRORS] += 1
                    tally[DISCARDED] += length + 1
        start = stop + _ONE
    tally[CONSUMED] = used if tally[SKIPPING] else np.int64(start)
    return n_bodies


@outer
def take_in(data, buffer, limit, schema, bodies, tally):  # type: ignore[no-untyped-def]
    """Put `data` (bytes) behind what waits in `buffer`, decode as `unstuff_frames` does, and return how many bodies are good.

    HELD bytes from CONSUMED on have no delimiter yet. They are moved to the front only here, before the next data, so that the bodies
    stay where they are until then.
    """
    waiting, held = tally[CONSUMED], tally[HELD]
    if waiting:
        copy_span(buffer, _U(waiting), _U(waiting + held), buffer, _U(0))
    for i in range(len(data)):
        buffer[held + i] = data[i]
    used = held + len(data)
    n_bodies = unstuff_frames(buffer, used, limit, schema, bodies, tally)
    tally[HELD] = used - tally[CONSUMED]
    tally[BYTES_IN] += len(data)
    return n_bodies


@inner
def next_block(buffer, payload, stop, place):  # type: ignore[no-untyped-def]
    """Frames and bytes per frame of the FRAMES payload from `payload` to `stop`.

    (0, 0) when it is not as long as it says, does not follow `place` without loss, or goes beyond the plan.
    """
    if stop - payload <= _U(BLOCK_HEADER):
        return 0, 0
    count, width = block_count(buffer, payload), np.int64(load2(buffer, payload + WIDTH_AT))
    if np.int64(stop - payload) != BLOCK_HEADER + count * width or not _follows(buffer, payload, count, place):
        return 0, 0
    return count, width


@inner
def next_clicks(buffer, payload, stop, place):  # type: ignore[no-untyped-def]
    """Exposures of the CLICKS payload from `payload` to `stop`; 0 where `next_block` would say so."""
    if stop - payload <= _U(BLOCK_HEADER):
        return 0
    count = block_count(buffer, payload)
    length = BLOCK_HEADER + 2 * count + (count + 7) // 8
    if np.int64(stop - payload) != length or not _follows(buffer, payload, count, place):
        return 0
    return count


@inner
def block_count(buffer, payload):  # type: ignore[no-untyped-def]
    """Exposures of a block, int64."""
    return np.int64(load2(buffer, payload + COUNT_AT))


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
        load4(buffer, payload + SEQ_AT) != _U(place.next_seq)
        or load4(buffer, payload + DROPS_AT) != _U(place.drops)
        or load8(buffer, payload + TICK_AT) >= LARGEST
        or load8(buffer, payload + FIRST_AT) != _U(place.next_exposure)
        or load4(buffer, payload + PERIOD_AT) == _U(0)
        or place.next_exposure > place.end_exposure - count
    )


@inner
def is_next_mark(buffer, payload, stop, place):  # type: ignore[no-untyped-def]
    """Whether the payload from `payload` to `stop` is a whole MARK, follows `place` without loss and holds what the dictionary allows.

    Its truth is compared with -1 alone here: how many classes there are, the caller knows.
    """
    if stop - payload != _U(MARK_BYTES) or load4(buffer, payload + SEQ_AT) != _U(place.next_seq):
        return False
    photons = load4(buffer, payload + PHOTONS_AT)
    return (
        (photons < _INFINITE or photons & _MAGNITUDE > _INFINITE)
        and mark_truth(buffer, payload) >= -1
        and load8(buffer, payload + MARK_FIRST_AT) < LARGEST
        and load8(buffer, payload + MARK_TICK_AT) < LARGEST
    )


@inner
def mark_fits(buffer, payload, place, n_classes):  # type: ignore[no-untyped-def]
    """Whether a MARK's truth is one of `n_classes` or unknown, and its exposure near the stream's place, as decide/follower.py asks."""
    away = np.int64(load8(buffer, payload + MARK_FIRST_AT)) - place.next_exposure
    near = -MAX_GAP_EXPOSURES <= away <= MAX_GAP_EXPOSURES
    return near and -1 <= mark_truth(buffer, payload) < n_classes


@inner
def go_on(place, count):  # type: ignore[no-untyped-def]
    """Account for the next message, with `count` exposures."""
    place.next_seq = (place.next_seq + 1) & 0xFFFFFFFF
    place.messages += 1
    place.next_exposure += count
    place.exposures += count
    if count:
        place.lost_before = 0  # what was lost before these exposures held none


@inner
def is_plain(buffer, start):  # type: ignore[no-untyped-def]
    """Whether flags and reserved bits of the body at `start` are 0, so that its CRC-32 is that of its content (framing.content_crc)."""
    return load4(buffer, start) <= _U(0xFF)


@inner
def hear(buffer, start, stop, heard, place):  # type: ignore[no-untyped-def]
    """Remember the CRC-32 of the message from `start` to `stop` that `go_on` has accounted for last; `heard` is StreamTracker's.

    The CRC need not stand behind the body: it does not in a recording.
    """
    number = (place.next_seq - 1) & 0xFFFFFFFF
    row = heard[number % _WINDOW]
    row[0], row[1] = number, np.int64(crc32_span(buffer, start, stop, _SCHEMA))


@inner
def block_times(buffer, payload):  # type: ignore[no-untyped-def]
    """The tick at which a block's first exposure began, and the ticks from one to the next; int64."""
    return np.int64(load8(buffer, payload + TICK_AT)), np.int64(load4(buffer, payload + PERIOD_AT))


@inner
def mark_photons(buffer, payload, photons, place):  # type: ignore[no-untyped-def]
    """Put a MARK's photons into `photons` float32 at `place`, bit for bit."""
    photons[place] = as_float32(load4(buffer, payload + PHOTONS_AT))


@inner
def mark_truth(buffer, payload):  # type: ignore[no-untyped-def]
    """A MARK's truth, int64; -1: unknown."""
    return np.int64(np.int16(np.uint16(load2(buffer, payload + TRUTH_AT))))
