"""Framing: the decoder against a plain one, the same frames and counts, whatever arrives and however it is cut."""

from __future__ import annotations

import random
import zlib
from collections.abc import Iterator
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from inner_kernels import called

from pans.protocol.wire import kernels as wire_kernels
from pans.protocol.wire.framing import (
    CHUNK_BYTES,
    DecoderCounters,
    Frame,
    FrameDecoder,
    cobs_encode,
    encode_frame,
    unpack_body,
)
from pans.protocol.wire.schema import MAX_FRAME_BYTES, MAX_PAYLOAD_BYTES, SCHEMA


def cobs_decoded(data: bytes) -> bytes | None:
    """Undo COBS group by group; None of what is no COBS string."""
    out, position = bytearray(), 0
    while position < len(data):
        end = position + data[position]
        if data[position] == 0 or end > len(data):
            return None
        out += data[position + 1 : end]
        if data[position] != 0xFF and end < len(data):
            out.append(0)
        position = end
    return bytes(out)


class PlainDecoder:
    """The decoder of the protocol document, a piece at a time."""

    def __init__(self) -> None:
        self.counters, self._held, self._skipping = DecoderCounters(), b"", False

    def feed(self, data: bytes) -> list[Frame]:
        counters, frames = self.counters, list[Frame]()
        counters.bytes_in += len(data)
        *ended, rest = data.split(b"\0")
        for number, piece in enumerate([*ended, rest]):
            self._held += piece
            if self._skipping or len(self._held) > MAX_FRAME_BYTES:
                counters.oversized_frames += not self._skipping
                counters.bytes_discarded += len(self._held)
                self._held, self._skipping = b"", True
            if number < len(ended):
                frames += self._decoded(self._held) if self._held else []
                self._held, self._skipping = b"", False
        return frames

    def _decoded(self, raw: bytes) -> list[Frame]:
        counters, body = self.counters, cobs_decoded(raw)
        if body is None:
            counters.cobs_errors += 1
        elif len(body) < 12:
            counters.short_frames += 1
        elif zlib.crc32(body[:-4], 0 if body[0] in (0x01, 0x81) else SCHEMA) != int.from_bytes(body[-4:], "little"):
            counters.crc_errors += 1
        else:
            counters.frames += 1
            return [unpack_body(body[:-4])]
        counters.bytes_discarded += len(raw) + 1
        return []


def compare(pieces: list[bytes]) -> list[Frame]:
    """Feed both decoders; every call must give the same frames and leave the same counts."""
    plain, decoder = PlainDecoder(), FrameDecoder()
    frames: list[Frame] = []
    for piece in pieces:
        expected = plain.feed(piece)
        assert decoder.feed(piece) == expected
        assert asdict(decoder.counters) == asdict(plain.counters)
        frames += expected
    return frames


@pytest.mark.parametrize("size", [0, 1, 253, 254, 255, 507, 508, 509, 70_000])
@pytest.mark.parametrize("fill", [b"\0", b"\1", b"\xff"])
def test_cobs_at_its_group_boundaries(size: int, fill: bytes) -> None:
    for data in (fill * size, fill * size + b"\0", b"\0" + fill * size, fill * size + b"\x07"):
        encoded = cobs_encode(data)
        assert 0 not in encoded
        assert len(encoded) <= len(data) + 1 + len(data) // 254 + 1
        assert cobs_decoded(encoded) == data


def cut(data: bytes, rng: random.Random, n_cuts: int) -> Iterator[bytes]:
    at = sorted(rng.randrange(len(data) + 1) for _ in range(n_cuts))
    for start, stop in zip([0, *at], [*at, len(data)]):
        yield data[start:stop]


payloads = st.one_of(
    st.binary(max_size=600),
    st.builds(lambda n, b: bytes([b]) * n, st.integers(0, 1100), st.sampled_from([0, 1, 2, 255])),
    st.lists(st.sampled_from([b"\0", b"\0" * 31, b"\1", b"x" * 253, b"y" * 254, b"z" * 255, b"\xff" * 8])).map(
        b"".join
    ),
)


@settings(max_examples=150, deadline=None)
@given(
    frames=st.lists(st.tuples(st.sampled_from([0x01, 0x81, 0x90, 0x91, 0x00]), payloads), max_size=6),
    damage=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=4),
    noise=st.binary(max_size=40),
    seed=st.integers(0, 2**32),
)
def test_any_stream_cut_anywhere(
    frames: list[tuple[int, bytes]], damage: list[tuple[int, int]], noise: bytes, seed: int
) -> None:
    data = bytearray(b"".join(encode_frame(kind, payload, 7) for kind, payload in frames))
    for position, value in damage:
        if data:
            data[position % len(data)] = value
    rng = random.Random(seed)
    at = rng.randrange(len(data) + 1)
    data[at:at] = noise
    found = compare(list(cut(bytes(data), rng, rng.randrange(5))))
    if not damage and not noise:
        assert [(frame.type, frame.payload) for frame in found] == frames


@pytest.mark.uncompiled
@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400).map(lambda data: data.replace(b"\0", b"\1\2")))
def test_code_bytes_that_lead_anywhere(raw: bytes) -> None:
    """Any bytes as one frame: most are no COBS string, or have a wrong CRC."""
    compare([raw + b"\0", b"\0", raw])


@pytest.mark.uncompiled
def test_one_byte_at_a_time() -> None:
    data = b"".join(encode_frame(0x91, bytes(n) + b"ab", 3) for n in range(0, 600, 97)) + b"\0\0junk\0"
    assert len(compare([data[i : i + 1] for i in range(len(data))])) == 7


def test_frames_around_the_limits() -> None:
    longest = encode_frame(0x91, bytes(range(1, 256)) * 257 + b"\1", 3)
    assert len(longest) > MAX_PAYLOAD_BYTES
    at_limit, beyond = b"\1" * MAX_FRAME_BYTES, b"\1" * (MAX_FRAME_BYTES + 1)
    whole = longest + at_limit + b"\0" + beyond + b"\0" + longest + beyond
    rng = random.Random(5)
    for n_cuts in (0, 1, 40):
        frames = compare([*cut(whole, rng, n_cuts), b"\3", b"\0" + longest])
        assert [len(frame.payload) for frame in frames] == [MAX_PAYLOAD_BYTES] * 3
    assert (
        compare([cobs_encode(bytes(range(1, n + 1))) + b"\0" for n in (10, 11, 12, 13)]) == []
    )  # short, or a wrong CRC


def test_a_stream_longer_than_the_buffer() -> None:
    rng = np.random.default_rng(3)
    data = b"".join(
        encode_frame(0x91, rng.binomial(255, p, 5000).astype(np.uint8).tobytes(), 3)
        for p in np.geomspace(1e-4, 0.5, 200)
    )
    assert len(data) > 3 * CHUNK_BYTES
    assert len(compare([data])) == 200


crc32_span, find_zero = called(wire_kernels.crc32_span), called(wire_kernels.find_zero)


@pytest.mark.uncompiled
@pytest.mark.parametrize("size", [0, 1, 7, 15, 16, 17, 1000])
def test_crc_is_that_of_zlib(size: int) -> None:
    data = np.random.default_rng(size).integers(0, 256, size + 5, dtype=np.uint8)
    for seed in (0, SCHEMA, 0xFFFFFFFF):
        with np.errstate(over="ignore"):
            found = int(crc32_span(data, 2, size + 2, seed))
        assert found == zlib.crc32(data[2 : size + 2].tobytes(), seed)


@pytest.mark.uncompiled
def test_find_zero_sees_every_zero_and_nothing_else() -> None:
    for position in range(20):
        data = np.full(20, 0x80, np.uint8)
        data[::3], data[1::3] = 0x01, 0xFF
        data[position] = 0
        assert find_zero(data, np.uint64(0), np.uint64(20)) == position
        assert find_zero(data, np.uint64(position + 1), np.uint64(20)) == 20


@pytest.mark.uncompiled
def test_full_groups_may_end_with_or_without_an_empty_one() -> None:
    body = b"x" * 250
    crc = zlib.crc32(b"\x91\0\0\0" + body, SCHEMA).to_bytes(4, "little")
    plain = cobs_encode(b"\x91\0\0\0" + body + crc)
    compare([plain + b"\0", plain + b"\1\0", plain.removesuffix(b"\1") + b"\0"])
