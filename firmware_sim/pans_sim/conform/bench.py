"""The host's end of a conformance test: one link, what was sent and heard, and the short way to a session, a command or an armed run.

What a check waits for and does not get is `Broken`.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pans.instrument.profile import Profile
from pans.protocol.links import Link
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import (
    AckStatus,
    Arm,
    DeviceState,
    MalformedMessage,
    MessageType,
    Opcode,
    announced_channels,
    announced_counts,
    pack_command,
    unpack_body,
)
from pans.protocol.wire import messages as wire

from .plans import Layout, layout_for
from .registry import Broken, Silent, need

PATIENCE_S = 2.0  # for an answer: a loaded machine is no broken rule
QUIET_S = 0.3  # in which an answer that must not come would have come
STEP_S = 0.02
LEASE_MS = 4000
KEPT_PIECES = 60  # of a rule's bytes, the first and the last of them
KEPT_BODIES = 400  # messages: more than a short run has
WINDOW = 1 << 20


def _decode_pong(payload: bytes) -> wire.Pong:
    """Decode PONG, also one that left before it came: rule 6.3 judges that."""
    if len(payload) != wire.STRUCTS["PONG"].size:
        raise MalformedMessage(f"PONG has {len(payload)} bytes, expected {wire.STRUCTS['PONG'].size}")
    return wire.Pong(*wire.STRUCTS["PONG"].unpack(payload))


DECODE: Mapping[int, Callable[[bytes], Any]] = {**wire.DECODERS, MessageType.PONG: _decode_pong}


class Piece(NamedTuple):
    """Bytes in one direction: `>` to the device, `<` from it."""

    way: str
    data: bytes


class Heard(NamedTuple):
    """One message of the present session, with the host's time when its last byte was read."""

    kind: int
    message: Any
    host_ns: int


class Bench:
    """A device under test; `pixels` are those of one pattern."""

    def __init__(self, link: Link, profile: Profile, pixels: int) -> None:
        self.link, self.profile, self.pixels = link, profile, pixels
        self.session = self.last_id = 0
        self.facts: Mapping[str, Any] = {}
        self.pieces: list[Piece] = []
        self.inbox: list[Heard] = []
        self._decoder = wire.FrameDecoder()
        self.bodies: deque[bytes] = deque(maxlen=KEPT_BODIES)  # header and payload of the latest messages, as they came
        self._probe = 0

    # -- bytes ---------------------------------------------------------------------------------------------------------

    def send(self, data: bytes) -> None:
        """Write bytes as they are."""
        self._note(">", data)
        self.link.write(data)

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Take what comes for so long, or until something has come."""
        end_ns = self.link.now_ns() + round(seconds * 1e9)
        while not until() and (left_ns := end_ns - self.link.now_ns()) > 0:
            data = self.link.read(min(STEP_S, left_ns * 1e-9))
            if data:
                self._note("<", data)
                for spans in self._decoder.bodies(data):
                    for first, stop in spans.tolist():
                        self._take(self._decoder.buffer[first:stop].tobytes())

    def _take(self, body: bytes) -> None:
        frame = unpack_body(body)
        if frame.session != self.session:
            return
        if frame.flags or frame.type not in DECODE:
            raise Broken(f"a frame of type {frame.type:#04x} with flags {frame.flags:#04x}: no message of version 1")
        try:
            message = DECODE[frame.type](frame.payload)
        except MalformedMessage as error:
            raise Broken(f"{MessageType(frame.type).name} cannot be meant: {error.message}") from None
        if frame.type == MessageType.COUNTS and max(announced_counts(self.facts), announced_channels(self.facts)) < 2:
            raise Broken(
                "COUNTS came from a device that announces neither photon numbers nor several detectors at once"
            )
        if frame.type == MessageType.EXPOSED and "exposed_schema" not in self.facts:
            raise Broken("EXPOSED came from a device that does not announce it")
        self.bodies.append(body)
        self.inbox.append(Heard(frame.type, message, self.link.now_ns()))

    def _note(self, way: str, data: bytes) -> None:
        if self.pieces and self.pieces[-1].way == way and len(self.pieces[-1].data) < 256:
            self.pieces[-1] = Piece(way, self.pieces[-1].data + data)
        else:
            self.pieces.append(Piece(way, data))
        if len(self.pieces) > 2 * KEPT_PIECES:
            del self.pieces[KEPT_PIECES : KEPT_PIECES + KEPT_PIECES // 2]

    @property
    def bytes_heard(self) -> int:
        """Bytes that have come since the link was opened."""
        return self._decoder.counters.bytes_in

    @property
    def damaged(self) -> int:
        """Frames that came whole but with a wrong CRC, since the link was opened."""
        return self._decoder.counters.crc_errors

    # -- messages ------------------------------------------------------------------------------------------------------

    def wait(
        self,
        kind: MessageType,
        which: Callable[[Any], bool] = lambda _: True,
        within_s: float = PATIENCE_S,
        what: str = "",
    ) -> Any:
        """Return the first message of `kind` that is the one, and forget it; Broken when none comes."""

        seen = 0  # of the inbox, which only grows while we wait: a fast stream is looked through once

        def place() -> int | None:
            nonlocal seen
            for k in range(seen, len(self.inbox)):
                if self.inbox[k].kind == kind and which(self.inbox[k].message):
                    return k
            seen = len(self.inbox)
            return None

        self.listen(within_s, lambda: place() is not None)
        at = place()
        if at is None:
            raise Silent(f"no {kind.name}{' ' + what if what else ''} within {within_s:g} s")
        return self.inbox.pop(at).message

    def silent(self, kind: MessageType, why: str) -> None:
        """Broken if a message of `kind` comes within QUIET_S."""
        self.listen(QUIET_S)
        need(not any(heard.kind == kind for heard in self.inbox), f"{kind.name} came {why}")

    def stream(self) -> list[Any]:
        """The stream's messages so far, in order; forgets them."""
        found = [heard.message for heard in self.inbox if heard.kind in STREAM_TYPES]
        self.inbox = [heard for heard in self.inbox if heard.kind not in STREAM_TYPES]
        return found

    # -- a session -----------------------------------------------------------------------------------------------------

    def open(self, *, reset: bool = True) -> None:
        """Begin a new session, and leave SAFE if `reset`."""
        self.session, self.last_id = secrets.randbits(32) | 1, 0
        self.inbox.clear()
        for _ in range(5):
            self.send(wire.encode_hello(self.session))
            try:
                self.facts = self.wait(MessageType.WELCOME, within_s=PATIENCE_S / 2).facts
                break
            except Silent:
                continue
        else:
            raise Silent(f"no WELCOME to five HELLOs in {2.5 * PATIENCE_S:g} s")
        if reset:
            self.done(Opcode.RESET)
        self.listen(0.0)

    def command(self, opcode: int, body: bytes = b"", *, number: int | None = None) -> Any:
        """Send a command, the next one unless `number` says otherwise, and return the ACK that comes after it.

        What was heard of the state before is forgotten: it says nothing about this command.
        """
        if number is None:
            self.last_id += 1
            number = self.last_id
        self.inbox = [heard for heard in self.inbox if heard.kind not in (MessageType.ACK, MessageType.STATUS)]
        self.send(wire.encode_command(number, opcode, body, self.session))
        return self.wait(MessageType.ACK, what=f"of command {number}")

    def done(self, opcode: int, body: bytes = b"") -> None:
        """Send a command that must be carried out."""
        ack = self.command(opcode, body)
        name = Opcode(opcode).name
        need(ack.last_id == self.last_id, f"{name}: ACK says last id {ack.last_id}, expected {self.last_id}")
        need(not ack.refuses(self.last_id), f"{name} was refused with {ack.status}: {ack.text}")

    def refused(self, status: int, opcode: int, body: bytes, what: str) -> None:
        """Send a command that must be refused with `status`."""
        ack = self.command(opcode, body)
        need(ack.last_id == self.last_id, f"{what}: last id {ack.last_id}, expected {self.last_id}")
        need(ack.refused_id == self.last_id, f"{what}: carried out, expected a refusal with {status}")
        need(ack.status == status, f"{what}: refused with {ack.status} ({ack.text}), expected {status}")

    def ping(self, within_s: float = PATIENCE_S) -> Any:
        """Send a probe and return its PONG."""
        self._probe += 1
        number = self._probe
        self.send(wire.encode_ping(number, self.link.now_ns(), self.session))
        return self.wait(MessageType.PONG, lambda pong: pong.probe_id == number, within_s, f"to PING {number}")

    def grant(self, limit: int = WINDOW, lease_ms: int = 0) -> None:
        """Move the receive window, and renew the lease."""
        self.send(wire.encode_grant(wire.Grant(limit, lease_ms), self.session))

    # -- a run ---------------------------------------------------------------------------------------------------------

    def layout(self, **changes: Any) -> Layout:
        """A small plan for this device."""
        return layout_for(self.profile, self.facts, self.pixels, **changes)

    def upload(self, layout: Layout) -> None:
        """Load patterns and plan."""
        for opcode, body in layout.commands():
            self.done(opcode, body)

    def arm(self, cycles: int, *, lease_ms: int = LEASE_MS, ahead_s: float = 0.2) -> int:
        """Arm for a start so far ahead; return the start tick."""
        start = int(self.ping().tx_tick) + round(ahead_s * self.facts["tick_hz"])
        self.done(Opcode.ARM, pack_command(Arm(start, cycles, lease_ms)))
        return start

    def arm_refused(self, what: str) -> None:
        """Ask for a run, which must be refused because of what the device holds, or of its state."""
        start = int(self.ping().tx_tick) + self.facts["tick_hz"]
        self.refused(AckStatus.WRONG_STATE, Opcode.ARM, pack_command(Arm(start, 1, 1000)), what)

    def expose(self, layout: Layout, cycles: int) -> list[Any]:
        """Arm what is loaded and wait for the end; return the stream messages."""
        self.grant()
        self.arm(cycles)
        self.closing(layout, cycles)
        return self.stream()

    def until_state(self, state: DeviceState, within_s: float = PATIENCE_S) -> Any:
        """Return the STATUS that says `state`."""
        return self.wait(MessageType.STATUS, lambda status: status.state == state, within_s, f"that says {state.name}")

    def run(self, layout: Layout, cycles: int, **words: Any) -> tuple[int, list[Any], Any]:
        """Upload, grant, arm and wait for the end; return start tick, stream messages and the closing STATUS."""
        self.upload(layout)
        self.grant()
        start = self.arm(cycles, **words)
        closing = self.closing(layout, cycles)
        self.listen(STEP_S)
        return start, self.stream(), closing

    def start(self, layout: Layout) -> None:
        """Upload, grant and arm without end; return when the device is RUNNING."""
        self.upload(layout)
        self.grant()
        self.arm(0)
        self.until_state(DeviceState.RUNNING)

    def closing(self, layout: Layout, cycles: int) -> Any:
        """Wait for the end of a run, renewing its lease; return its STATUS."""
        self.until_state(DeviceState.RUNNING)
        seconds = layout.seconds(cycles) + PATIENCE_S
        end_ns = self.link.now_ns() + round(seconds * 1e9)
        while self.link.now_ns() < end_ns:
            self.grant(lease_ms=LEASE_MS)
            try:
                return self.wait(MessageType.STATUS, lambda one: one.state == DeviceState.IDLE, within_s=0.5)
            except Broken:
                continue
        raise Broken(f"a run of {layout.seconds(cycles):.2f} s has not ended after {seconds:.2f} s")
