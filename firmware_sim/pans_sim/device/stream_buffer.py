"""The device's end of the stream: sequence numbers, receive window, buffer and drop count (docs/reference/protocol.md, section 5).

`StreamBuffer.put`, `put_due` and `grant` return the frames that may be sent now.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pans.protocol.wire import messages as wire

from .sequential import Measurement, StreamMessage

if TYPE_CHECKING:
    from .parallel import FrameRun

U32 = 0xFFFFFFFF


@dataclass(slots=True)
class StreamBuffer:
    """At most `capacity` messages are held back; when it is full the newest is dropped whole and its exposures counted."""

    capacity: int
    sequence: int = 0
    limit: int = 0
    dropped_exposures: int = 0
    dropped_messages: int = 0  # since power-on
    _held: deque[tuple[int, bytes]] = field(default_factory=deque)

    def restart(self) -> None:
        """Number anew for the next run; the receive window stays, since the host may grant just before it arms."""
        self._held.clear()
        self.sequence = self.dropped_exposures = 0

    def put(self, message: StreamMessage, session: int) -> list[bytes]:
        """Number a message and hold it, or drop it; return what the window lets out."""
        if len(self._held) >= self.capacity:
            self.dropped_messages += 1
            self.dropped_exposures += _exposures_in(message)
            return []
        self._held.append((self.sequence, self._encode(message, session)))
        self.sequence = (self.sequence + 1) & U32
        return self._released()

    def put_each(self, run: Measurement | FrameRun, tick: int, session: int) -> list[bytes | memoryview]:
        """`put` every message of `run` that is due by `tick`."""
        sent: list[bytes | memoryview] = []
        while (due := run.next_tick) is not None and due <= tick:
            sent += self.put(run.emit(), session)
        return sent

    def put_due(self, run: Measurement | FrameRun, tick: int, session: int) -> list[bytes | memoryview]:
        """As `put_each`, but in one piece where messages are made ahead and the window lets all of them out."""
        if isinstance(run, Measurement):
            return self.put_each(run, tick, session)
        sent: list[bytes | memoryview] = []
        while (stretch := run.stretch()) is not None and (due := stretch.due_by(tick)):
            if not self._held and due <= (self.limit - self.sequence) & U32 < 1 << 31:
                sent.append(stretch.take(due, self.sequence, self.dropped_exposures & U32, session))
                self.sequence = (self.sequence + due) & U32
                if stretch.sent < len(stretch.due):
                    break  # as a rule: the rest is not due
                continue
            for _ in range(due):
                if len(self._held) >= self.capacity:
                    self.dropped_messages += 1
                    self.dropped_exposures += stretch.skip()
                    continue
                frame = stretch.take(1, self.sequence, self.dropped_exposures & U32, session)
                self._held.append((self.sequence, bytes(frame)))
                self.sequence = (self.sequence + 1) & U32
                sent += self._released()
        return sent

    def grant(self, limit: int) -> list[bytes]:
        """Move the receive window: messages with a sequence below `limit` may leave; return those that now do."""
        self.limit = limit
        return self._released()

    def _released(self) -> list[bytes]:
        released = []
        held, limit = self._held, self.limit
        while held and 0 < (limit - held[0][0]) & U32 < 1 << 31:  # modulo 2^32
            released.append(held.popleft()[1])
        return released

    def _encode(self, message: StreamMessage, session: int) -> bytes:
        drops = self.dropped_exposures & U32
        if isinstance(message, wire.Mark):
            return wire.encode_mark(message._replace(seq=self.sequence), session)
        if isinstance(message, wire.ClickBlock):
            return wire.encode_clicks(message._replace(seq=self.sequence, drops=drops), session)
        return wire.encode_frames(message._replace(seq=self.sequence, drops=drops), session)


def _exposures_in(message: StreamMessage) -> int:
    if isinstance(message, wire.Mark):
        return 0
    return len(message.patterns) if isinstance(message, wire.ClickBlock) else len(message.words)
