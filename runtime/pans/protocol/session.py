"""The host's end of a session, sans-I/O: handshake, commands until acknowledged, window and lease.

Frames and times go in through `on_frame` and `poll`; bytes to send come out of `take_output`. Failures that end the session raise
LinkError or DeviceError.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from pans.base.errors import DeviceError, LinkError
from pans.protocol.wire.commands import announces_exposed
from pans.protocol.wire.framing import Frame
from pans.protocol.wire.schema import AckStatus, MessageType, Opcode

from .wire import messages as wire

NS_PER_MS = 1_000_000
# The times and limits of the conversation are those of docs/reference/protocol.md, sections 2, 4 and 9.
UNKNOWN_STATUS = 0xFFFF
HELLO_EVERY_NS = 200 * NS_PER_MS
HELLO_GIVE_UP_NS = 5_000 * NS_PER_MS
COMMAND_WINDOW = 8
STREAM_TYPES = frozenset(map(int, wire.STREAM_DECODERS))
ANSWER_TYPES = frozenset((int(MessageType.WELCOME), int(MessageType.ACK), int(MessageType.PONG)))
RETRY_FIRST_NS = 250 * NS_PER_MS
RETRY_LONGEST_NS = 2_000 * NS_PER_MS
RETRY_GIVE_UP_NS = 10_000 * NS_PER_MS
FAST_RETRY_NS = 10 * NS_PER_MS  # least time between repetitions that acknowledgements ask for
MAX_WAITING = 256  # commands not sent yet; above it `submit` refuses
MAX_PROBES = 64  # probes without an answer; the oldest is given up
MAX_KEPT = 256  # answers that nobody has taken; the oldest is forgotten


@dataclass(slots=True)
class SessionCounters:
    """What the session has seen and sent."""

    retransmissions: int = 0
    wrong_session: int = 0
    malformed: int = 0
    unknown_type: int = 0
    stale_probes: int = 0
    implausible: int = 0  # well formed, but no answer to what was sent
    repeated_welcomes: int = 0


class Refusal(NamedTuple):
    """A command that the device did not carry out, of the kind that may be refused without ending the session."""

    command_id: int
    status: int
    text: str
    opcode: int = Opcode.GATE


class ArmTooLate(DeviceError):
    """ARM came when its start had passed: the session goes on, and a later start may be asked for."""


class HostSession:
    """One session with one device; `nonce` must be fresh (not 0) for each."""

    def __init__(self, nonce: int) -> None:
        if not 0 < nonce < 1 << 32:
            raise ValueError(f"nonce must be in 1..2**32-1, found {nonce}")
        self.nonce = nonce
        self.welcome: wire.Welcome | None = None
        self.status: wire.Status | None = None
        self.pongs: deque[tuple[wire.Pong, int]] = deque(maxlen=MAX_KEPT)
        self.refusals: deque[Refusal] = deque(maxlen=MAX_KEPT)
        self.heard_ns = 0  # when the latest frame of this session came
        self.counters = SessionCounters()
        self._output: list[bytes] = []
        self._hello_due_ns: int | None = None
        self._hello_started_ns = 0
        self._welcome_fault = ""  # of the latest one that could not be read
        self.next_id = 1  # of the next command
        self._waiting: deque[tuple[int, bytes]] = deque()  # not sent yet
        self._unacknowledged: deque[tuple[int, bytes]] = deque()
        self._may_be_refused: dict[int, int] = {}  # opcodes by id
        self._retry_due_ns = 0
        self._retry_after_ns = RETRY_FIRST_NS
        self._oldest_ns = 0
        self._fast_retry_ns = 0  # not before
        self._repeats = False  # commands that are sent again wait in the output
        self._probe_id = self._probe_sent = 0
        self._probes: dict[int, int] = {}  # sent and not answered: id and host time

    # -- what the host wants -------------------------------------------------------------------------------------------

    def start(self, now_ns: int) -> None:
        """Open the session: HELLO is sent and repeated until the device answers."""
        self._hello_started_ns = self._hello_due_ns = now_ns
        self.poll(now_ns)

    def submit(self, opcode: Opcode, body: bytes = b"", *, may_be_refused: bool = False) -> int:
        """Queue a command and return its id; it is sent by the next `poll` that finds room in the window.

        A refusal ends the session with DeviceError, unless the command `may_be_refused`: then it is put into `refusals`.
        LinkError when MAX_WAITING commands wait already: nothing is dropped in silence.
        """
        if not self.has_room:
            raise LinkError(f"{MAX_WAITING} commands wait for a device that acknowledges none", remedy="check the link")
        if may_be_refused:
            self._may_be_refused[self.next_id] = opcode
        command_id = self.next_id
        self.next_id += 1
        self._waiting.append((command_id, wire.encode_command(command_id, opcode, body, self.nonce)))
        return command_id

    def probe(self, now_ns: int) -> None:
        """Send one clock probe stamped with `now_ns`."""
        self._probe_id = (self._probe_id + 1) & 0xFFFFFFFF
        self._probes[self._probe_id] = now_ns
        if len(self._probes) > MAX_PROBES:
            del self._probes[next(iter(self._probes))]
        self._output.append(wire.encode_ping(self._probe_id, now_ns, self.nonce))

    def grant(self, stream_limit: int, lease_ms: int) -> None:
        """Move the receive window and renew the lease."""
        self._output.append(wire.encode_grant(wire.Grant(stream_limit & 0xFFFFFFFF, lease_ms), self.nonce))

    def stop_frames(self, next_id: int = 0) -> bytes:
        """Return bytes that stop the device, whatever it has of the commands so far: those that it may lack, in order, then STOP.

        Nothing changes here: it is for a thread that speaks in the place of a loop that is stuck. `next_id` above 0 where a kernel
        has sent commands of which the session has not been told.
        """
        before = [frame for _, frame in (*self._unacknowledged, *self._waiting)]
        return b"".join((*before, wire.encode_command(max(self.next_id, next_id), Opcode.STOP, b"", self.nonce)))

    @property
    def has_probe(self) -> bool:
        """Whether a clock probe is in the output."""
        return self._probe_id != self._probe_sent

    @property
    def has_room(self) -> bool:
        """Whether `submit` takes another command."""
        return len(self._waiting) < MAX_WAITING

    @property
    def in_flight(self) -> int:
        """Commands that the device has not dealt with, waiting ones too; of fewer than COMMAND_WINDOW the next leaves at once."""
        return len(self._waiting) + len(self._unacknowledged)

    @property
    def answered(self) -> int:
        """Every command up to this id has been dealt with: done, or in `refusals`."""
        return self.next_id - 1 - self.in_flight

    def take_output(self) -> bytes:
        """Return the bytes to send now, and forget them."""
        if not self._output:
            return b""
        data = b"".join(self._output)
        self._output.clear()
        self._probe_sent = self._probe_id
        self._repeats = False
        return data

    # -- commands that the kernel sends --------------------------------------------------------------------------------

    @property
    def window(self) -> tuple[int, int, int, bool]:
        """The next id, the oldest one without an answer, since when it waits, and whether commands wait to be sent."""
        oldest = self._unacknowledged[0][0] if self._unacknowledged else self.next_id - len(self._waiting)
        return self.next_id, oldest, self._oldest_ns, bool(self._waiting)

    def continue_from(self, oldest_id: int, oldest_ns: int, sent: list[tuple[int, bytes]], opcode: Opcode) -> None:
        """Take over what was done elsewhere from `window` on, while none waited: commands up to `oldest_id` - 1 were carried out.

        `sent` are ids and frames that have left, all of them of a kind that may be refused.
        """
        while self._unacknowledged and self._unacknowledged[0][0] < oldest_id:
            self._may_be_refused.pop(self._unacknowledged.popleft()[0], None)
        for command_id, frame in sent:
            self.next_id = command_id + 1
            if command_id >= oldest_id:
                self._may_be_refused[command_id] = opcode
                self._unacknowledged.append((command_id, frame))
        if oldest_ns != self._oldest_ns:
            self._oldest_ns, self._retry_after_ns = oldest_ns, RETRY_FIRST_NS
            self._retry_due_ns = oldest_ns + RETRY_FIRST_NS

    # -- what time brings ----------------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> None:
        """Send what is due: HELLO, queued commands, retransmissions; LinkError when the device has been silent too long."""
        if self._hello_due_ns is not None and now_ns >= self._hello_due_ns:
            if now_ns - self._hello_started_ns > HELLO_GIVE_UP_NS:
                if self._welcome_fault:
                    raise DeviceError(
                        f"the device's WELCOME cannot be read: {self._welcome_fault}",
                        remedy="see docs/reference/protocol.md, section 3",
                    )
                raise LinkError(
                    f"no WELCOME within {HELLO_GIVE_UP_NS // NS_PER_MS} ms",
                    remedy="check that no other program uses the device, that the port is right, and that its firmware speaks protocol 1",
                )
            self._output.append(wire.encode_hello(self.nonce))
            self._hello_due_ns = now_ns + HELLO_EVERY_NS
        if self.welcome is None:
            return
        while self._waiting and len(self._unacknowledged) < COMMAND_WINDOW:
            if not self._unacknowledged:
                self._oldest_ns, self._retry_after_ns = now_ns, RETRY_FIRST_NS
                self._retry_due_ns = now_ns + RETRY_FIRST_NS
            command = self._waiting.popleft()
            self._unacknowledged.append(command)
            self._output.append(command[1])
        if self._unacknowledged and now_ns >= self._retry_due_ns:
            self._retry(now_ns)

    def _retry(self, now_ns: int) -> None:
        if now_ns - self._oldest_ns > RETRY_GIVE_UP_NS:
            raise LinkError(
                f"command {self._unacknowledged[0][0]} was not acknowledged within {RETRY_GIVE_UP_NS // NS_PER_MS} ms",
                remedy="check the link; `pans doctor` looks at the port",
            )
        self._repeat()
        self._retry_after_ns = min(2 * self._retry_after_ns, RETRY_LONGEST_NS)
        self._retry_due_ns = now_ns + self._retry_after_ns

    def _repeat(self) -> None:
        """Send unacknowledged commands again, once per output: otherwise a backlog of old ACKs repeats them all every 10 ms."""
        if not self._repeats:
            self._repeats = True
            self._output.extend(frame for _, frame in self._unacknowledged)
            self.counters.retransmissions += len(self._unacknowledged)

    # -- what the device says ------------------------------------------------------------------------------------------

    @property
    def tells_exposed(self) -> bool:
        """Whether the device has announced EXPOSED; one that has not is not listened to."""
        return self.welcome is not None and announces_exposed(self.welcome.facts)

    def on_frame(self, frame: Frame, now_ns: int) -> bool:
        """Digest one frame; return True when the core should see it too (stream messages, STATUS, EXPOSED)."""
        if frame.session != self.nonce:
            self.counters.wrong_session += 1
            return False
        self.heard_ns = now_ns
        if frame.type in STREAM_TYPES:
            return True
        try:
            self._digest(frame, now_ns)
        except wire.MalformedMessage as error:
            self.counters.malformed += 1
            if frame.type == MessageType.WELCOME:
                self._welcome_fault = str(error)
            return False
        return frame.type == MessageType.STATUS or (frame.type == MessageType.EXPOSED and self.tells_exposed)

    def _digest(self, frame: Frame, now_ns: int) -> None:
        if frame.type == MessageType.PONG:
            self._on_pong(wire.decode_pong(frame.payload), now_ns)
        elif frame.type == MessageType.ACK:
            self._on_ack(wire.decode_ack(frame.payload), now_ns)
        elif frame.type == MessageType.STATUS:
            self.status = wire.decode_status(frame.payload)
        elif frame.type == MessageType.WELCOME:
            self._on_welcome(wire.decode_welcome(frame.payload))
        elif frame.type == MessageType.EXPOSED and self.tells_exposed:
            wire.decode_exposed(frame.payload)
        else:
            self.counters.unknown_type += 1

    def _on_pong(self, pong: wire.Pong, now_ns: int) -> None:
        """Keep the first answer to each probe: a repetition would lie about its round trip."""
        sent_ns = self._probes.get(pong.probe_id)
        if sent_ns is None:
            self.counters.stale_probes += 1
        elif sent_ns != pong.host_ns:  # the echo must not change
            self.counters.implausible += 1
        else:
            del self._probes[pong.probe_id]
            self.pongs.append((pong, now_ns))

    def _on_welcome(self, welcome: wire.Welcome) -> None:
        if self.welcome is not None:
            self.counters.repeated_welcomes += 1
            if welcome.facts.get("epoch") != self.welcome.facts.get("epoch"):
                raise LinkError("the device restarted within the session: its clock and its uploads are gone")
            return
        if (welcome.schema, welcome.protocol) != (wire.SCHEMA, wire.PROTOCOL_VERSION):
            raise DeviceError(
                f"the device speaks protocol {welcome.protocol} (schema {welcome.schema:#010x}), "
                f"this runtime {wire.PROTOCOL_VERSION} (schema {wire.SCHEMA:#010x})",
                remedy="install the firmware and the runtime of the same release",
            )
        self.welcome = welcome
        self._hello_due_ns = None

    def _on_ack(self, ack: wire.Ack, now_ns: int) -> None:
        if ack.last_id >= self.next_id - len(self._waiting):  # a command that was never sent
            self.counters.implausible += 1
            return
        oldest = self._unacknowledged[0][0] if self._unacknowledged else 0
        if oldest > ack.last_id and now_ns >= self._fast_retry_ns:
            # A later command was answered, so the oldest is lost: a gate cannot wait for the time-out.
            self._fast_retry_ns = now_ns + FAST_RETRY_NS
            self._repeat()
        while self._unacknowledged and self._unacknowledged[0][0] <= ack.last_id:
            acknowledged, _ = self._unacknowledged.popleft()
            self._oldest_ns, self._retry_after_ns = now_ns, RETRY_FIRST_NS
            self._retry_due_ns = now_ns + RETRY_FIRST_NS
            allowed = self._may_be_refused.pop(acknowledged, None)
            if not ack.refuses(acknowledged):
                continue
            named = acknowledged == ack.refused_id
            status, text = (ack.status, ack.text) if named else (UNKNOWN_STATUS, "the reason was lost on the way")
            if allowed is not None:
                self.refusals.append(Refusal(acknowledged, status, text, allowed))
                continue
            name = AckStatus(status).name if status in set(AckStatus) else str(status)
            refused = ArmTooLate if status == AckStatus.TOO_LATE else DeviceError  # GATE and SHOW may be refused
            raise refused(f"the device refused command {acknowledged} ({name}): {text}")
