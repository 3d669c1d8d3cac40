"""The handshakes of a recording: what the device said of itself, each time that it was greeted."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from pans.protocol.wire import messages as wire

from .recording import Recording

SESSIONS_MAX, REFUSED_MAX = 1000, 100  # that are shown; a device may fill a file with either


_COUNTED = ("welcomes", "acks", "pongs", "malformed")


def handshakes(recording: Recording) -> list[dict[str, Any]]:
    """Return one row for each session with an answer: what the device is, how many answers came, which commands it refused.

    Rows are bounded in number. The texts are the device's: whoever prints them makes them safe (safe_text).
    """
    rows: dict[int, dict[str, Any]] = {}
    for _, body in recording.answers():
        try:
            frame = wire.unpack_body(body)
        except wire.MalformedMessage:
            continue  # verify.py's
        if frame.session not in rows and len(rows) == SESSIONS_MAX:
            continue
        new = {"session": frame.session, "device": {}, **dict.fromkeys(_COUNTED, 0), "refused": []}
        row = rows.setdefault(frame.session, new)
        try:
            _take_answer(row, frame.type, frame.payload)
        except wire.MalformedMessage:
            row["malformed"] += 1
    _name_refused(rows, recording)
    return list(rows.values())


def _take_answer(row: dict[str, Any], kind: int, payload: bytes) -> None:
    if kind == wire.MessageType.WELCOME:
        row["welcomes"] += 1
        row["device"] = row["device"] or dict(wire.decode_welcome(payload).facts)
    elif kind == wire.MessageType.ACK:
        row["acks"] += 1
        ack, refused = wire.decode_ack(payload), row["refused"]
        known = {one["command_id"] for one in refused}
        if ack.refused_id and ack.refused_id not in known and len(refused) < REFUSED_MAX:
            refused.append({"command_id": ack.refused_id, "command": "", "status": ack.status, "text": ack.text})
    elif kind == wire.MessageType.PONG:
        row["pongs"] += 1


def _name_refused(rows: dict[int, dict[str, Any]], recording: Recording) -> None:
    """Say which commands the refused ones were."""
    wanted = {(session, one["command_id"]): one for session, row in rows.items() for one in row["refused"]}
    decoder = wire.FrameDecoder()
    for _, data in recording.commands() if wanted else ():
        for frame in decoder.feed(data):
            with suppress(wire.MalformedMessage):
                command = wire.decode_command(frame.payload) if frame.type == wire.MessageType.COMMAND else None
                if command is not None and (one := wanted.get((frame.session, command.command_id))) is not None:
                    known = command.opcode in set(wire.Opcode)
                    one["command"] = wire.Opcode(command.opcode).name if known else str(command.opcode)
