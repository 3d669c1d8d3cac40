"""All books of one run held against each other at its end: device, wire, host, recording and replay.

Owns the comparison and the observer on the wire; it changes no byte. `ObservedLink` decodes what passes with a decoder of its own, and
`reconcile` returns one sentence for every disagreement. What must agree, message by message and exposure by exposure:

- wire and host: every frame that arrived was counted, whole or damaged;
- wire and recording: every message of an armed session is on record, once and in order;
- wire and recording: every WELCOME, ACK and PONG is on record, of whatever session, once and in order;
- recording and host: every recorded stream message was taken, or counted as repeated or malformed;
- device and host: every exposure was received or reported lost, and what the device dropped is what the host says it dropped;
- device and wire: the STATUS that closes a stream claims what the device has made;
- recording and replay: the same decisions.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from pans.runtime.bundle import Bundle
from pans.runtime.link.base import Link
from pans.runtime.live import RunResult
from pans.runtime.record import Recording, replay
from pans.runtime.wire import DeviceState, FrameDecoder, MessageType, Opcode, Status, decode_status
from pans.runtime.wire.messages import decode_command, pack_body, unpack_body
from pans.runtime.wire.session import ANSWER_TYPES, STREAM_TYPES

from .books import DeviceBooks

RECORDED = STREAM_TYPES | {MessageType.STATUS}
DECODED = ("frames", "crc_errors", "cobs_errors", "short_frames", "oversized_frames")


@dataclass(slots=True)
class Heard:
    """The messages of one session that a recording must hold: how many, and the SHA-256 of all, each with its length."""

    messages: int = 0
    digest: Any = field(default_factory=hashlib.sha256)
    last_status: Status | None = None

    def take(self, body: bytes) -> None:
        """Count the header and payload of one message."""
        self.messages += 1
        self.digest.update(len(body).to_bytes(4, "little") + body)

    def same(self, other: Heard) -> bool:
        """Whether both hold the same messages in the same order."""
        return self.messages == other.messages and bool(self.digest.digest() == other.digest.digest())


class Opened:
    """What came through the link from one opening of it to the next."""

    def __init__(self) -> None:
        self.from_device, self.from_host = FrameDecoder(), FrameDecoder()
        self.session = 0
        self.armed = False


class ObservedLink:
    """An ordinary Link around another one, with books on what passed; `heard` by session, `answers`, `openings` in their order."""

    def __init__(self, link: Any) -> None:
        self._link = link
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.heard: dict[int, Heard] = {}
        self.answers = Heard()  # WELCOME, ACK and PONG of all openings
        self.openings = [Opened()]

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        data: bytes = self._link.read(timeout_s)
        now = self.openings[-1]
        for frame in now.from_device.feed(data):
            if frame.type in ANSWER_TYPES:
                self.answers.take(pack_body(frame))
            if now.armed and frame.session == now.session and frame.type in RECORDED:
                heard = self.heard[now.session]
                heard.take(pack_body(frame))
                if frame.type == MessageType.STATUS:
                    heard.last_status = decode_status(frame.payload)
        return data

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._link.write(data)
        now = self.openings[-1]
        for frame in now.from_host.feed(data):
            if frame.type == MessageType.HELLO:
                now.session, now.armed = frame.session, False
            elif frame.type == MessageType.COMMAND and decode_command(frame.payload).opcode == Opcode.ARM:
                now.armed = True
                self.heard.setdefault(now.session, Heard())

    def now_ns(self) -> int:
        """See `Link.now_ns`."""
        return int(self._link.now_ns())

    def pause(self, seconds: float) -> None:
        """See `Link`: let time pass."""
        self._link.pause(seconds)

    def reopen(self) -> Link:
        """Come back to the same device, and open new books."""
        self._link = self._link.reopen()
        self.openings.append(Opened())
        return self

    def close(self) -> None:
        """See `Link.close`."""
        self._link.close()


def reconcile(
    wire: ObservedLink, device: dict[int, DeviceBooks], result: RunResult, recording: Recording, bundle: Bundle
) -> list[str]:
    """Return what does not agree, one sentence each; `device` holds the books of every session that was armed."""
    return [
        *_wire_and_host(wire, result),
        *_wire_and_recording(wire, recording),
        *_answers_and_recording(wire, recording),
        *_recording_and_host(recording, result),
        *_device_and_host(device, result),
        *_device_and_wire(device, wire),
        *_recording_and_replay(recording, result, bundle),
    ]


def _wire_and_host(wire: ObservedLink, result: RunResult) -> Iterator[str]:
    """The host counts what every opening brought it, those that broke before they could be armed included."""
    there = _decoded(wire.openings)
    host = {name: result.decoder.get(name, 0) for name in DECODED}
    if host != there:
        yield f"on the wire were {there}, the host counted {host}"


def _decoded(openings: list[Opened]) -> dict[str, int]:
    counters = [one.from_device.counters for one in openings]
    return {name: sum(getattr(counter, name) for counter in counters) for name in DECODED}


def _wire_and_recording(wire: ObservedLink, recording: Recording) -> Iterator[str]:
    recorded: dict[int, Heard] = {}
    for _, body in recording.messages():
        recorded.setdefault(unpack_body(body).session, Heard()).take(body)
    for session in wire.heard.keys() | recorded.keys():
        there, here = wire.heard.get(session, Heard()), recorded.get(session, Heard())
        if not there.same(here):
            yield (
                f"session {session:08x}: {there.messages} messages arrived, {here.messages} are recorded, or other ones"
            )


def _answers_and_recording(wire: ObservedLink, recording: Recording) -> Iterator[str]:
    recorded = Heard()
    for _, body in recording.answers():
        recorded.take(body)
    if not wire.answers.same(recorded):
        yield f"{wire.answers.messages} answers arrived, {recorded.messages} are recorded, or other ones"


def _recording_and_host(recording: Recording, result: RunResult) -> Iterator[str]:
    kinds = Counter(unpack_body(body).type for _, body in recording.messages())
    recorded, stream = sum(kinds[kind] for kind in STREAM_TYPES), result.stream
    counted = stream["messages"] + stream["repeated"] + stream["malformed"]
    if recorded != counted:
        yield f"{recorded} stream messages are recorded, the host counted {counted} taken, repeated or malformed"


def _device_and_host(device: dict[int, DeviceBooks], result: RunResult) -> Iterator[str]:
    stream = result.stream
    known = [books for books in device.values() if books.end_known]
    made, dropped = sum(books.exposures for books in known), sum(books.dropped for books in known)
    host, all_known = stream["exposures"] + stream["lost_exposures"], len(known) == len(device)
    most = [sum(getattr(books, name) for books in device.values()) for name in ("exposures", "dropped")]
    if not made <= host <= most[0] or (all_known and host != made):
        yield f"the device made {made} to {most[0]} exposures, the host received or missed {host}"
    if not dropped <= stream["device_drops"] <= most[1] or (all_known and stream["device_drops"] != dropped):
        yield f"the device dropped {dropped} to {most[1]} exposures, the host says {stream['device_drops']}"


def _device_and_wire(device: dict[int, DeviceBooks], wire: ObservedLink) -> Iterator[str]:
    for session, heard in wire.heard.items():
        status, books = heard.last_status, device.get(session)
        if status is None or books is None or status.state not in (DeviceState.IDLE, DeviceState.SAFE):
            continue
        claimed, made = (status.next_exposure, status.drops), (books.exposures, books.dropped % (1 << 32))
        if claimed != made:
            yield f"session {session:08x}: STATUS claims (exposures, drops) {claimed}, the device made {made}"


def _recording_and_replay(recording: Recording, result: RunResult, bundle: Bundle) -> Iterator[str]:
    if result.tally.decisions != recording.n_decisions:
        yield f"{result.tally.decisions} decisions were made, {recording.n_decisions} are recorded"
    n_decisions, sha256 = replay(recording, bundle)[:2]
    if (n_decisions, sha256) != (recording.n_decisions, recording.decisions_sha256):
        yield f"a replay gives {n_decisions} decisions of {recording.n_decisions}, or other ones"
