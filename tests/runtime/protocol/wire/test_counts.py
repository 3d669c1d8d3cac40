"""Photon numbers on the wire: golden bytes of the document, bounds, and what a device announces."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tree import ROOT

from pans.protocol.tracker import StreamTracker
from pans.protocol.wire import FrameDecoder, MalformedMessage, MessageType, Opcode, unpack_body
from pans.protocol.wire.commands import (
    ReadCounts,
    StateChunk,
    announced_channels,
    announced_counts,
    count_announcement,
    cut_states,
    pack_command,
    state_dtype,
    unpack_command,
    unpack_states,
)
from pans.protocol.wire.messages import ClickBlock, decode_counts, encode_clicks

PROTOCOL = (ROOT / "docs" / "reference" / "protocol.md").read_text(encoding="utf-8")
SECTION = PROTOCOL.partition("## 13. Photon numbers")[2]
BLOCK = ClickBlock(
    0, 0, 1000, 0, 100, 0, np.array([0, 2, 0xFFFF], np.uint16), np.array([0, 2, 1], np.uint8), 2
)  # the document's


def by_hand(numbers: list[int], largest: int, stamps: list[int]) -> bytes:
    """The payload as the document's table has it."""
    head = struct.pack("<IIQQIHHI", 7, 1, 5000, 40, 100, len(numbers), largest, 3)
    return head + struct.pack(f"<{len(stamps)}H", *stamps) + bytes(numbers)


def test_the_worked_example_of_the_document() -> None:
    golden = bytes.fromhex(re.search(r"^(02 93 01[0-9A-F ]+)$", SECTION, re.MULTILINE)[1])  # type: ignore[index]
    assert encode_clicks(BLOCK, 0x11223344) == golden
    (frame,) = FrameDecoder().feed(golden)
    assert (frame.type, frame.session) == (MessageType.COUNTS, 0x11223344)
    found = decode_counts(frame.payload)
    assert (found.patterns.tolist(), found.bits.tolist(), found.largest) == ([0, 2, 0xFFFF], [0, 2, 1], 2)
    assert found[:6] == BLOCK[:6]


@given(
    st.integers(2, 15).flatmap(
        lambda largest: st.tuples(
            st.just(largest), st.lists(st.tuples(st.integers(0, largest), st.integers(0, 65535)), min_size=1)
        )
    )
)
def test_what_is_packed_by_hand_is_decoded(drawn: tuple[int, list[tuple[int, int]]]) -> None:
    largest, pairs = drawn
    numbers, stamps = [number for number, _ in pairs], [stamp for _, stamp in pairs]
    found = decode_counts(by_hand(numbers, largest, stamps))
    assert (found.seq, found.drops, found.tick, found.exposure_index, found.period_ticks) == (7, 1, 5000, 40, 100)
    assert (found.object_index, found.largest) == (3, largest)
    assert (found.bits.tolist(), found.patterns.tolist()) == (numbers, stamps)
    assert (found.bits.dtype, found.patterns.dtype) == (np.uint8, np.uint16)
    assert found.bits.flags.writeable
    (frame,) = FrameDecoder().feed(encode_clicks(found, 5))
    assert frame.payload == by_hand(numbers, largest, stamps)


@pytest.mark.parametrize(
    "payload",
    [
        by_hand([0, 3], 2, [0, 0]),  # above the block's largest
        by_hand([0, 255], 15, [0, 0]),
        by_hand([0, 1], 1, [0, 0]),  # clicks are CLICKS
        by_hand([0, 1], 16, [0, 0]),
        by_hand([], 2, []),
        by_hand([0, 1], 2, [0, 0])[:-1],
        by_hand([0, 1], 2, [0, 0]) + b"\0",
        by_hand([0, 1], 2, [0, 0])[:20],
        b"",
    ],
)
def test_what_cannot_be_meant_is_malformed_and_counted(payload: bytes) -> None:
    with pytest.raises(MalformedMessage):
        decode_counts(payload)
    tracker = StreamTracker()
    assert tracker.accept(unpack_body(struct.pack("<BBHI", 0x93, 0, 0, 1) + payload)) == (None, None)
    assert tracker.counters.malformed == 1


def test_the_stream_accounts_for_numbers_as_for_clicks() -> None:
    tracker = StreamTracker()
    for seq, first, drops, gap in ((0, 0, 0, None), (2, 8, 2, (3, 5, 1, 2))):
        block = BLOCK._replace(seq=seq, exposure_index=first, drops=drops)
        assert tracker.accept(*FrameDecoder().feed(encode_clicks(block, 1)))[1] == gap


@pytest.mark.parametrize(
    ("asked", "body"),
    [(ReadCounts(5), b"\5\0\0\0"), (ReadCounts(15, 4), b"\17\0\4\0"), (ReadCounts(3, 2), b"\3\0\2\0")],
)
def test_read_counts_by_hand(asked: ReadCounts, body: bytes) -> None:
    assert pack_command(asked) == body
    assert unpack_command(ReadCounts, body) == asked
    with pytest.raises(MalformedMessage):
        unpack_command(ReadCounts, body[:3])


def test_states_by_hand() -> None:
    rows = np.array([(0, 4, (1, 2, 3)), (7, 1, (2, 3, 4))], state_dtype(3))
    body = pack_command(StateChunk(2, 0, 4, 3, 3, rows))
    by_bytes = struct.pack("<HHIII", 0, 4, 1, 2, 3) + struct.pack("<HHIII", 7, 1, 2, 3, 4)
    assert body == struct.pack("<HHHHI", 2, 0, 4, 3, 3) + by_bytes
    found = unpack_states(Opcode.LOAD_COUNT_STATES, body)
    assert (found[:5], found.opcode) == ((2, 0, 4, 3, 3), Opcode.LOAD_COUNT_STATES)
    assert found.states.tobytes() == rows.tobytes()
    clicks = np.array([(0, 4, (1, 2))], state_dtype(2))
    two = pack_command(StateChunk(2, 1, 4, 2, 3, clicks))
    assert two == struct.pack("<HHHHI", 2, 1, 4, 0, 3) + struct.pack("<HHII", 0, 4, 1, 2)
    assert unpack_states(Opcode.LOAD_STATES, two)[:5] == (2, 1, 4, 2, 3)
    for wrong in (body[:-1], body[:12], body + bytes(16), b"", struct.pack("<HHHHI", 2, 0, 4, 2, 3) + bytes(24)):
        with pytest.raises(MalformedMessage):
            unpack_states(Opcode.LOAD_COUNT_STATES, wrong)


def test_states_are_cut_and_joined() -> None:
    rows = np.zeros(2000, state_dtype(16))
    rows["next"] = np.arange(2000 * 16).reshape(2000, 16)
    chunks = [unpack_states(one.opcode, pack_command(one)) for one in cut_states((2000, 4, 16, 5), rows)]
    assert len(chunks) > 10
    assert [one.first_state for one in chunks] == list(np.cumsum([0, *(len(one.states) for one in chunks[:-1])]))
    assert np.array_equal(np.concatenate([one.states for one in chunks]), rows)


@pytest.mark.parametrize(
    ("facts", "largest", "channels"),
    [
        (count_announcement(15), 15, 1),
        (count_announcement(1, 4), 1, 4),
        (count_announcement(1), 1, 1),
        ({"photon_number_max": 15, "channels_at_once": 4}, 1, 1),  # of an extension of another number nothing is known
        ({"photon_number_max": 15, "channels_at_once": 4, "count_schema": 0xEEF01CE0}, 1, 1),
    ],
)
def test_what_a_device_announces(facts: dict[str, int], largest: int, channels: int) -> None:
    assert (announced_counts(facts), announced_channels(facts)) == (largest, channels)
