"""Golden bytes written by hand from docs/reference/protocol.md, and the framing's hard cases.

Both ends share these modules, so a round trip proves little alone: the golden frames below were assembled from the specification with
COBS groups and CRC-32 worked out independently of the code under test.
"""

from __future__ import annotations

import contextlib
import re
import struct
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tree import ROOT

from pans.protocol.wire import FrameDecoder, MessageType
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import (
    Arm,
    Gate,
    MaskChunk,
    PatternChunk,
    PlanChunk,
    ReadCounts,
    Show,
    pack_command,
    unpack_command,
    unpack_states,
)

SESSION = 0x11223344
PROTOCOL = (ROOT / "docs" / "reference" / "protocol.md").read_text()


def frame_by_hand(message_type: int, payload: bytes, seed: int = wire.SCHEMA, session: int = SESSION) -> bytes:
    """The specification's section 1 in its plainest form: byte by byte, no shared code."""
    body = bytes([message_type, 0, 0, 0]) + session.to_bytes(4, "little") + payload
    crc = seed ^ 0xFFFFFFFF
    for byte in body:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB88320 if crc & 1 else 0)
    body += (crc ^ 0xFFFFFFFF).to_bytes(4, "little")
    out, group = bytearray(), bytearray()
    for byte in body:
        if byte == 0:
            out += bytes([len(group) + 1]) + group
            group.clear()
            continue
        group.append(byte)
        if len(group) == 254:
            out += b"\xff" + group
            group.clear()
    return bytes(out + bytes([len(group) + 1]) + group) + b"\0"


UNPACK = {
    kind: partial(unpack_command, kind) for kind in (PatternChunk, PlanChunk, MaskChunk, Arm, Gate, Show, ReadCounts)
}


def one(data: bytes) -> wire.Frame:
    decoder = FrameDecoder()
    (frame,) = decoder.feed(data)
    assert decoder.counters.bytes_discarded == 0
    return frame


def test_hello_is_the_worked_example() -> None:
    (text,) = re.findall(r"^`((?:[0-9A-F]{2} )+00)`\.$", PROTOCOL, re.MULTILINE)
    assert wire.encode_hello(SESSION) == bytes.fromhex(text)
    assert wire.encode_hello(SESSION) == frame_by_hand(0x01, wire.SCHEMA.to_bytes(4, "little") + b"\x01\0\0\0", seed=0)


def test_exposed_is_the_worked_example() -> None:
    (text,) = re.findall(r"^(02 85 [0-9A-F ]+ 00)$", PROTOCOL, re.MULTILINE)
    exposed = wire.Exposed(1000, 970, -450, 1203, 4660)
    payload = struct.pack("<IiiQQ", *exposed)
    assert wire.encode_exposed(exposed, SESSION) == bytes.fromhex(text) == frame_by_hand(0x85, payload)
    assert wire.decode_exposed(payload) == exposed


GOLDEN = [
    (wire.encode_ping(7, 0x0102030405060708, SESSION), 0x02, "07000000 0807060504030201"),
    (wire.encode_pong(wire.Pong(7, 1, 2, 3), SESSION), 0x82, "07000000 0100000000000000 0200000000000000 0300000000000000"),
    (wire.encode_command(3, wire.Opcode.STOP, b"", SESSION), 0x03, "03000000 04 00 0000"),
    (wire.encode_ack(wire.Ack(5, 4, 3, "no", 2), SESSION), 0x83, "05000000 04000000 02000000 0300 0200 6e6f"),
    (wire.encode_grant(wire.Grant(4096, 1000), SESSION), 0x04, "00100000 e8030000"),
    (
        wire.encode_status(wire.Status(2, 0, 900, 1, 5, 6), SESSION),
        0x84,
        "02 00 0000 84030000 01000000 0500000000000000 0600000000000000",
    ),
    (
        wire.encode_exposed(wire.Exposed(7, 0x0102, -2, 5, 6), SESSION),
        0x85,
        "07000000 02010000 feffffff 0500000000000000 0600000000000000",
    ),
    (
        wire.encode_clicks(
            wire.ClickBlock(1, 2, 3, 4, 5, 9, np.array([0, 1, 0xFFFF], np.uint16), np.array([1, 0, 1], np.uint8)), SESSION
        ),
        0x90,
        "01000000 02000000 0300000000000000 0400000000000000 05000000 0300 0000 09000000 0000 0100 ffff 05",
    ),
    (
        wire.encode_frames(wire.FrameBlock(1, 0, 3, 4, 5, 9, np.array([[1, 2], [3, 0]], np.uint8)), SESSION),
        0x91,
        "01000000 00000000 0300000000000000 0400000000000000 05000000 0200 0200 09000000 01020300",
    ),
    (
        wire.encode_mark(wire.Mark(1, 2, -1, 3, 4, 1.5), SESSION),
        0x92,
        "01000000 02000000 ffff 0000 0300000000000000 0400000000000000 0000c03f",
    ),
    (
        wire.encode_mark(wire.Mark(1, 2, 3, 3, 4, 1.5, 0x0102), SESSION),
        0x92,
        "01000000 02000000 0300 0201 0300000000000000 0400000000000000 0000c03f",
    ),
    (
        wire.encode_command(1, wire.Opcode.LOAD_PATTERN, pack_command(PatternChunk(2, 0, 3, np.array([1, 0, 123], np.uint16))), SESSION),
        0x03,
        "01000000 01 00 0000 0200 0000 00000000 03000000 0100 0000 7b00",
    ),
    (
        wire.encode_command(2, wire.Opcode.ARM, pack_command(Arm(1 << 33, 7, 1000)), SESSION),
        0x03,
        "02000000 03 00 0000 0000000002000000 0700000000000000 e8030000 00000000",
    ),
    (
        wire.encode_command(3, wire.Opcode.GATE, pack_command(Gate(9, 8, 1)), SESSION),
        0x03,
        "03000000 06 00 0000 0900000000000000 08000000 0100 0000",
    ),
    (
        wire.encode_command(
            4,
            wire.Opcode.LOAD_PLAN,
            pack_command(PlanChunk(0, 1, 2, 0, 30, 33, 99, 1, 5, np.array([(0, 0xFFFF, 0xFFFF), (50, 0, 0)], wire.SLOT_DTYPE))),
            SESSION,
        ),
        0x03,
        "04000000 02 00 0000 00 00 0100 02000000 00000000 1e000000 21000000 6300000000000000 0100 0000 05000000"
        "0000000000000000 ffff ffff 3200000000000000 0000 0000",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("encoded", "message_type", "payload"), GOLDEN)
def test_golden_frames(encoded: bytes, message_type: int, payload: str) -> None:
    assert encoded == frame_by_hand(message_type, bytes.fromhex(payload))
    frame = one(encoded)
    assert (frame.type, frame.session, frame.payload) == (message_type, SESSION, bytes.fromhex(payload))


def test_messages_survive_the_round_trip() -> None:
    patterns, bits = np.arange(300, dtype=np.uint16) % 11, (np.arange(300) % 3 == 0).astype(np.uint8)
    sent = wire.ClickBlock(2**32 - 1, 2, 2**63 - 1, 2**40, 5, 9, patterns, bits)
    block = wire.decode_clicks(one(wire.encode_clicks(sent, SESSION)).payload)
    assert block[:6] == sent[:6]
    assert np.array_equal(block[6:8], sent[6:8])
    for mark in (wire.Mark(1, 2, 9, 3, 4, 1.5), wire.Mark(1, 2, -1, 3, 4, 1.5, 0xFFFF)):
        assert wire.decode_mark(one(wire.encode_mark(mark, 1)).payload) == mark
    status = wire.Status(3, 3, 0, 7, 8, 9)
    assert wire.decode_status(one(wire.encode_status(status, 1)).payload) == status
    rows = np.array([[0x5, 0x1], [0x2, 0x0]], np.uint8)
    slots, levels = np.array([(10, 1, 0), (20, 0, 1)], wire.SLOT_DTYPE), np.arange(50, dtype=np.uint16)
    for command in (
        PlanChunk(1, 2, 5, 3, 1, 2, 3, 4, 5, slots),
        PatternChunk(0, 10, 60, levels),
        MaskChunk(7, 0, 9, 9, rows),
        *(Arm(1, 2, 3), Gate(1, 2, 3), Show(1, 2, 3, 4, 5), ReadCounts(3, 2)),
    ):
        back = unpack_command(type(command), pack_command(command))
        assert type(back) is type(command)
        assert all(np.array_equal(*pair) for pair in zip(back, command, strict=True))


def test_welcome_carries_facts_and_names_another_schema() -> None:
    welcome = wire.decode_welcome(one(wire.encode_welcome({"firmware": "x", "tick_hz": 10}, SESSION)).payload)
    assert welcome == wire.Welcome(wire.SCHEMA, 1, {"firmware": "x", "tick_hz": 10})
    stranger = struct.pack("<IHH", 0xDEADBEEF, 2, 0) + b"whatever version 2 sends"
    assert wire.decode_welcome(stranger) == wire.Welcome(0xDEADBEEF, 2, {})


def test_every_flipped_bit_is_detected_and_costs_one_frame() -> None:
    before, victim, after = (GOLDEN[place][0] for place in (0, 6, 1))
    for bit in range(8 * len(victim)):
        damaged = bytearray(victim)
        damaged[bit // 8] ^= 1 << bit % 8
        frames = FrameDecoder().feed(before + bytes(damaged) + after)
        # a flipped delimiter also costs the frame behind it, and no frame is ever invented
        assert frames in ([one(before)], [one(before), one(after)])


def test_a_payload_that_is_too_large_is_not_sent() -> None:
    with pytest.raises(wire.MalformedMessage, match="65536"):
        wire.encode_frame(MessageType.FRAMES, bytes(wire.MAX_PAYLOAD_BYTES + 1), 1)


@pytest.mark.parametrize(
    ("decode", "payload"),
    [
        (wire.decode_clicks, b""),
        (wire.decode_clicks, struct.pack("<IIQQIHHI", 0, 0, 0, 0, 0, 0, 0, 0)),
        (wire.decode_clicks, struct.pack("<IIQQIHHI", 0, 0, 0, 0, 0, 60000, 0, 0)),
        (wire.decode_frames, struct.pack("<IIQQIHHI", 0, 0, 0, 0, 0, 1, 0, 0)),
        (wire.decode_frames, struct.pack("<IIQQIHHI", 0, 0, 0, 0, 0, 65535, 65535, 0)),
        (wire.decode_mark, b"\0" * 31),
        (partial(wire.fields, "PING"), b"\0" * 13),
        (wire.decode_ack, struct.pack("<IIHH", 0, 0, 0, 9) + b"short"),
        (wire.decode_welcome, struct.pack("<IHH", wire.SCHEMA, 1, 0) + b"\xdf\xff\xff\xff\xff"),
        (wire.decode_welcome, struct.pack("<IHH", wire.SCHEMA, 1, 0) + b"\x91\x01"),
        (wire.decode_welcome, struct.pack("<IHH", wire.SCHEMA, 1, 0) + b"\xc0" * 5000),
        (UNPACK[PlanChunk], b"\0" * 36),
        (UNPACK[PlanChunk], b"\0" * 37),
        (UNPACK[PatternChunk], b"\0" * 12),
        (UNPACK[PatternChunk], struct.pack("<HHII", 0, 0, 2, 2) + b"\0\0"),
        (UNPACK[MaskChunk], struct.pack("<HHIII", 0, 2, 0, 16, 8) + b"\0\0"),  # pieces of two patterns
        (UNPACK[MaskChunk], struct.pack("<HHIII", 0, 1, 0, 16, 16) + b"\0"),
        (UNPACK[Arm], b"\0" * 23),
    ],
)
def test_impossible_payloads_are_refused(decode: object, payload: bytes) -> None:
    with pytest.raises(wire.MalformedMessage):
        decode(payload)  # type: ignore[operator]


@given(st.binary(max_size=200))
def test_no_decoder_raises_anything_else(payload: bytes) -> None:
    decoders = [partial(wire.fields, "PING"), wire.decode_command, *wire.DECODERS.values()]
    decoders += [
        *UNPACK.values(),
        *(partial(unpack_states, wire.Opcode[f"LOAD_{name}"]) for name in ("STATES", "COUNT_STATES")),
    ]
    for decode in decoders:
        for candidate in (payload, struct.pack("<IHH", wire.SCHEMA, 1, 0) + payload):
            with contextlib.suppress(wire.MalformedMessage):
                decode(candidate)
