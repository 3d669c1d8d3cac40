"""Devices whose EXPOSED, STATUS or MARK contradict the stream, each message in itself allowed and under a right checksum.

`Lie` names what is said and in which messages, `LyingLink` says it, `lied` runs an ordinary session with it: whatever `LyingLink.told`
counts must not PASS.
"""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mutated_sessions import Mutation, Session, Stage, mutate

from pans.protocol.links import Link
from pans.protocol.session import STREAM_TYPES
from pans.protocol.wire import DeviceState, MessageType, StateReason
from pans.protocol.wire import messages as wire
from pans.protocol.wire.commands import Arm, unpack_command
from pans.protocol.wire.framing import Frame, FrameDecoder, encode_frame
from pans_sim.device.instrument import Instrument

MODES = ("sequential", "parallel", "device-driven", "device-driven-counts", "device-driven-detectors")
OBJECTS = 40
STATUS_EVERY = 5  # objects: a session of the protocol's one STATUS a second would have two of them
SHORT = 1, 2, 3, 1 << 30  # how many messages lie


class Lie(NamedTuple):
    """`what` is said, one of LIES, in messages from number `first` on that can say it, in at most `most`; `size` is how much of it."""

    what: str
    first: int
    most: int
    size: int

    @classmethod
    def drawn(cls, what: str, dice: random.Random) -> "Lie":
        """Return one by chance."""
        return cls(what, dice.randint(0, 4), dice.choice(SHORT), dice.randint(0, 1 << 20))


def _another(payload: bytes, name: str, **changes: Any) -> bytes:
    for field, value in changes.items():
        payload = mutate(payload, Mutation(name, field, value))
    return payload


class LyingLink(Link):
    """An ordinary link around another one; `told` counts the messages that lie."""

    def __init__(self, link: Any, lie: Lie | None, stage: Stage) -> None:
        self._link, self.lie, self.stage = link, lie, stage
        self.name, self.simulated, self.virtual = link.name, link.simulated, link.virtual
        self.now_ns, self.close = link.now_ns, link.close
        self._from_device, self._from_host = FrameDecoder(), FrameDecoder()
        self.start_tick = self.came = self.exposed = self.shift = (
            0  # of the stream; `shift`: messages that were put into it
        )
        self._seen = self.told = 0

    def read(self, timeout_s: float) -> bytes:
        """See `Link.read`."""
        return b"".join(
            encode_frame(one.type, one.payload, one.session, one.flags)
            for frame in self._from_device.feed(self._link.read(timeout_s))
            for one in self._passed(frame)
        )

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        for frame in self._from_host.feed(data):
            if frame.type == MessageType.COMMAND and frame.payload[4] == wire.Opcode.ARM:
                arm = unpack_command(Arm, wire.decode_command(frame.payload).body)
                self.start_tick = arm.start_tick
        self._link.write(data)

    def _passed(self, frame: Frame) -> list[Frame]:
        if not self.start_tick:
            return [frame]
        frames = self._lied(frame)
        if frame.type == MessageType.EXPOSED:
            self.exposed += wire.decode_exposed(frame.payload).exposures
        if frame.type not in STREAM_TYPES:
            return frames
        if frame.type != MessageType.MARK:
            self.came = int.from_bytes(frame.payload[16:24], "little") + int.from_bytes(frame.payload[28:30], "little")
        numbered = []
        for number, one in enumerate(frames):
            seq = int.from_bytes(frame.payload[:4], "little") + self.shift + number
            numbered.append(one._replace(payload=seq.to_bytes(4, "little") + one.payload[4:]))
        self.shift += len(frames) - 1
        return numbered

    def _lied(self, frame: Frame) -> list[Frame]:
        lie = self.lie
        if lie is None or (payloads := LIES[lie.what](self, frame)) is None:
            return [frame]
        self._seen += 1
        if not lie.first < self._seen <= lie.first + lie.most:
            return [frame]
        self.told += 1
        return [frame._replace(payload=payload) for payload in payloads]


Said = list[bytes] | None


def _exposed(change: Callable[[LyingLink, Any], Any]) -> Callable[[LyingLink, Frame], Said]:
    """A lie in EXPOSED; `change` returns its other fields, {} to leave it out, None where it cannot lie."""

    def said(link: LyingLink, frame: Frame) -> Said:
        if frame.type != MessageType.EXPOSED:
            return None
        changes = change(link, wire.decode_exposed(frame.payload))
        return changes if not changes else [_another(frame.payload, "EXPOSED", **changes)]

    return said


def _status(change: Callable[[LyingLink, Any], Any]) -> Callable[[LyingLink, Frame], Said]:
    """A lie in STATUS of a run from which blocks have come; `change` returns its other fields, None where it cannot lie."""

    def said(link: LyingLink, frame: Frame) -> Said:
        if frame.type != MessageType.STATUS or not link.came:
            return None
        changes = change(link, wire.decode_status(frame.payload))
        return None if changes is None else [_another(frame.payload, "STATUS", **changes)]

    return said


def _block(ticks: Callable[[LyingLink, int], int]) -> Callable[[LyingLink, Frame], Said]:
    """A lie in the tick of a block, by `ticks` for a lie's size, of which EXPOSED says nothing."""

    def said(link: LyingLink, frame: Frame) -> Said:
        if frame.type not in STREAM_TYPES or frame.type == MessageType.MARK or link.lie is None:
            return None
        tick = int.from_bytes(frame.payload[8:16], "little") + ticks(link, link.lie.size)
        return [frame.payload[:8] + tick.to_bytes(8, "little") + frame.payload[16:]]

    return said


def _mark(change: Callable[[LyingLink, Any], Any], *, twice: bool = False) -> Callable[[LyingLink, Frame], Said]:
    """A lie in MARK, or in a second one behind it, each with a number of its own."""

    def said(link: LyingLink, frame: Frame) -> Said:
        if frame.type != MessageType.MARK:
            return None
        other = _another(frame.payload, "MARK", **change(link, wire.decode_mark(frame.payload)))
        return [frame.payload, other] if twice else [other]

    return said


def _size(link: LyingLink, most: int) -> int:
    """1 to `most`, by the lie's size."""
    assert link.lie is not None
    return 1 + link.lie.size % max(1, most)


def _running(status: Any) -> bool:
    return bool(status.state == DeviceState.RUNNING)


def _other_class(link: LyingLink, mark: Any) -> dict[str, int]:
    n = len(link.stage.bundle.classes)
    return {"truth": (mark.truth + _size(link, n - 1)) % n}


IDLE = {"state": DeviceState.IDLE, "lease_left_ms": 0}
LIES: dict[str, Callable[[LyingLink, Frame], Said]] = {
    "EXPOSED left out": _exposed(lambda link, told: []),
    "EXPOSED of fewer": _exposed(
        lambda link, told: (
            {
                "exposures": told.exposures - _size(link, told.exposures - 1),
                **dict.fromkeys(("start_exposure", "length_exposure"), link.exposed),
            }
            if told.exposures > 1
            else []
        )
    ),
    "EXPOSED of more": _exposed(lambda link, told: {"exposures": told.exposures + _size(link, 50)}),
    "EXPOSED names one of before": _exposed(
        lambda link, told: {"start_exposure": link.exposed - _size(link, link.exposed)} if link.exposed else None
    ),
    "EXPOSED names two too far apart": _exposed(
        lambda link, told: {"length_exposure": told.start_exposure + told.exposures - 1 + _size(link, 50)}
    ),
    "blocks late": _block(lambda link, size: 2 + size % 20),
    "blocks a slot late": _block(lambda link, size: (1 + size % 2) * link.stage.plan.slot_period_ticks),
    "blocks early": _block(lambda link, size: -min(2 + size % 20, link.stage.plan.slot_period_ticks)),
    "STATUS of fewer": _status(lambda link, status: {"next_exposure": link.came - _size(link, link.came)}),
    "STATUS of more": _status(
        lambda link, status: (
            {"next_exposure": status.next_exposure + 1 + _size(link, 500)} if _running(status) else None
        )
    ),
    "STATUS of drops": _status(lambda link, status: {"drops": _size(link, link.came)}),
    "STATUS says stopped": _status(
        lambda link, status: {**IDLE, "reason": StateReason.STOPPED} if _running(status) else None
    ),
    "STATUS says completed": _status(
        lambda link, status: {**IDLE, "reason": StateReason.COMPLETED} if _running(status) else None
    ),
    "STATUS says fault": _status(
        lambda link, status: (
            {"state": DeviceState.SAFE, "reason": StateReason.FAULT, "lease_left_ms": 0} if _running(status) else None
        )
    ),
    "MARK of another class too": _mark(_other_class, twice=True),
    "MARK of no class too": _mark(lambda link, mark: {"truth": wire.UNKNOWN_TRUTH}, twice=True),
    "MARK beyond the classes": _mark(lambda link, mark: {"truth": len(link.stage.bundle.classes) + _size(link, 9) - 1}),
    "MARK of another object": _mark(lambda link, mark: {"object_index": mark.object_index + _size(link, 9)}),
    "MARK of another exposure": _mark(lambda link, mark: {"exposure_index": mark.exposure_index + _size(link, 3)}),
    "MARK that moves": _mark(lambda link, mark: {"half_exposures": _size(link, 9)}),
}


def lied(stage: Stage, lie: Lie | None, seed: int, folder: Path) -> tuple[Session, int]:
    """Run one session with `lie` (None: an honest one) against `stage`; return what came of it and how many messages lied."""
    every_ticks = STATUS_EVERY * stage.plan.object_ticks

    class Talkative(Instrument):
        """Sends STATUS, and EXPOSED before it, more often than it must."""

        def _send_status(self) -> None:
            super()._send_status()
            if self._status_tick is not None:
                self._status_tick = self._tick + every_ticks

    link = LyingLink(stage.link(Talkative, seed), lie, stage)
    session = stage.session(link, folder, OBJECTS)
    if link.told and session.summary is not None and session.summary.verdict == "PASS":
        session.wrong.append(f"PASS in spite of {link.told} of {lie}")
    return session, link.told
