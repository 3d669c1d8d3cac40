"""Rules of section 1 (frames) and of reserved fields: what a receiver must accept or drop, and still answer."""

from __future__ import annotations

import random
import struct
import zlib

from pans.protocol.wire import HEADER, MESSAGES, AckStatus, DeviceState, MessageType, Opcode, cobs_encode, encode_frame
from pans.protocol.wire import messages as wire
from pans_sim.conform.bench import QUIET_S, Bench
from pans_sim.conform.registry import need, rule

GOLDEN = bytes.fromhex("020101010A44332211C4AF642E010101058FAF0A2A00")
GOLDEN_SESSION = 0x11223344
UNKNOWN_OPCODE = 0xEE
LONGEST_BYTES = 12_332  # of a payload that a host may have to send: LOAD_PLAN of 1024 slots
SHORT_RUN = 4  # cycles


@rule(
    "1.1",
    "The worked example, HELLO of session 0x11223344, is answered with WELCOME of that session, schema and version.",
)
def golden_hello(bench: Bench) -> None:
    bench.session = GOLDEN_SESSION
    bench.send(b"\0" + GOLDEN)
    welcome = bench.wait(MessageType.WELCOME, what="to the worked example")
    need(welcome.schema == wire.SCHEMA, f"WELCOME says schema {welcome.schema:#010x}, expected {wire.SCHEMA:#010x}")
    need(welcome.protocol == wire.PROTOCOL_VERSION, f"WELCOME says protocol {welcome.protocol}")


@rule("1.2", "Every frame but HELLO and WELCOME has a CRC that starts from the schema hash.")
def seeded_crc(bench: Bench) -> None:
    bench.ping()
    body = HEADER.pack(MessageType.PING, 0, bench.session) + b"\1" * 12
    bench.send(_framed(body, start=0))
    bench.silent(MessageType.PONG, "to a PING whose CRC starts from 0")


@rule("1.3", "A frame that fails its CRC is dropped, and the next one is taken.")
def damaged_crc(bench: Bench) -> None:
    frame = bytearray(wire.encode_ping(99, 0x0101010101010101, bench.session))
    frame[-3] ^= 0x55
    frame[-3] = frame[-3] or 1
    bench.send(bytes(frame))
    bench.silent(MessageType.PONG, "to a PING with a damaged byte")
    bench.ping()


@rule("1.4", "After any garbage and a delimiter the next frame is taken.")
def garbage(bench: Bench) -> None:
    dice = random.Random(1)
    for size in (1, 3, 300, 5000):
        bench.send(dice.randbytes(size) + b"\0")
        bench.ping()


@rule("1.5", "A frame that is cut off leaves nothing behind: a new frame begins after the next delimiter.")
def cut_off(bench: Bench) -> None:
    whole = wire.encode_command(1, UNKNOWN_OPCODE, bytes(40), bench.session)
    for size in (1, 5, len(whole) // 2, len(whole) - 2):
        bench.send(whole[:size] + b"\0")
        bench.ping()


@rule("1.6", "A frame longer than the limit is dropped, and the next one is taken.")
def too_long(bench: Bench) -> None:
    bench.send(b"\xff" * 70_000 + b"\0")
    bench.ping()


@rule("1.7", "Empty frames mean nothing.")
def empty_frames(bench: Bench) -> None:
    bench.send(bytes(1000))
    bench.ping()


@rule("1.8", "A frame may come in pieces, and several at once.")
def pieces(bench: Bench) -> None:
    for byte in wire.encode_ping(501, 7, bench.session):
        bench.send(bytes([byte]))
    bench.wait(MessageType.PONG, lambda pong: pong.probe_id == 501, what="to a PING sent byte by byte")
    bench.send(b"".join(wire.encode_ping(number, 7, bench.session) for number in (502, 503)))
    bench.listen(QUIET_S)
    answered = {one.message.probe_id for one in bench.inbox if one.kind == MessageType.PONG}
    need({502, 503} <= answered, f"of two PINGs in one piece {len(answered)} were answered")


@rule("1.9", "An empty last group after a group of 254 may be sent or left out.")
def last_group(bench: Bench) -> None:
    body = _ends_in_a_full_group(bench.session, bench.last_id + 1)
    coded = cobs_encode(body)
    longer = coded if coded.endswith(b"\1") else coded + b"\1"
    for form in (longer[:-1], longer):
        bench.inbox.clear()
        bench.send(form + b"\0")
        ack = bench.wait(MessageType.ACK, what="to a frame that ends in a group of 254")
        need(ack.last_id == bench.last_id + 1, "a frame that ends in a group of 254 was not taken")
    bench.last_id += 1


@rule("1.10", "Flags and reserved fields are ignored.")
def flags(bench: Bench) -> None:
    head = bytes((MessageType.PING, 0xFF, 0xFF, 0xFF)) + bench.session.to_bytes(4, "little")
    body = head + bytes([77, 0, 0, 0]) + b"\2" * 8
    bench.send(_framed(body, wire.SCHEMA))
    bench.wait(MessageType.PONG, lambda pong: pong.probe_id == 77, what="to a PING with flags")


@rule("1.11", "A message of an unknown type is dropped.")
def unknown_type(bench: Bench) -> None:
    bench.send(encode_frame(0x7E, b"\1\2\3", bench.session) + encode_frame(0xFE, b"", bench.session))
    bench.ping()


@rule("1.12", "A message whose payload has another length than its layout is dropped.")
def wrong_length(bench: Bench) -> None:
    for kind, size in (
        (MessageType.PING, 11),
        (MessageType.PING, 13),
        (MessageType.GRANT, 7),
        (MessageType.COMMAND, 7),
    ):
        bench.send(encode_frame(kind, b"\1" * size, bench.session))
    bench.listen(0.1)
    need(not bench.inbox or all(one.kind == MessageType.STATUS for one in bench.inbox), "one of them was answered")
    bench.ping()
    bench.upload(bench.layout())
    bench.arm(0, ahead_s=0.05)
    bench.send(encode_frame(MessageType.GRANT, b"\1" * 9, bench.session))  # would open the window
    bench.until_state(DeviceState.RUNNING)
    bench.listen(0.1)
    need(not bench.stream(), "a GRANT of 9 bytes was taken")
    bench.done(Opcode.STOP)


@rule("1.13", "Reserved fields are sent as 0.")
def reserved_fields(bench: Bench) -> None:
    bench.bodies.clear()
    bench.open()
    bench.ping()
    bench.refused(AckStatus.UNKNOWN_OPCODE, UNKNOWN_OPCODE, b"", "an unknown opcode")
    bench.run(bench.layout(), SHORT_RUN)
    for body in bench.bodies:
        name = MessageType(body[0]).name
        for place in (*_reserved("HEADER", 0), *_reserved(name, HEADER.size)):
            need(body[place] == 0, f"byte {place} of {name}, which is reserved, is {body[place]:#04x}")


@rule("1.14", "A payload of 12 332 bytes, the longest that any host may have to send, is taken.")
def longest(bench: Bench) -> None:
    body = bytes(LONGEST_BYTES - wire.STRUCTS["COMMAND"].size)
    bench.refused(AckStatus.UNKNOWN_OPCODE, UNKNOWN_OPCODE, body, "an unknown opcode with a long body")


def _reserved(name: str, at: int) -> list[int]:
    """Places of the reserved bytes of a layout that begins at `at`."""
    found: list[int] = []
    for field in MESSAGES.get(name, ()):
        size = struct.calcsize(f"<{field.code}")
        found += range(at, at + size) if field.name == "reserved" else ()
        at += size
    return found


def _framed(body: bytes, start: int) -> bytes:
    return cobs_encode(body + zlib.crc32(body, start).to_bytes(4, "little")) + b"\0"


def _ends_in_a_full_group(session: int, number: int) -> bytes:
    """A command of an unknown opcode whose last 254 bytes, CRC included, hold no zero."""
    head = HEADER.pack(MessageType.COMMAND, 0, session)
    head += wire.STRUCTS["COMMAND"].pack(number, UNKNOWN_OPCODE)
    for filler in range(1, 256):
        body = head + bytes([filler]) * 250
        crc = zlib.crc32(body, wire.SCHEMA).to_bytes(4, "little")
        if 0 not in crc:
            return body + crc
    raise AssertionError("no filler without a zero in its CRC")
