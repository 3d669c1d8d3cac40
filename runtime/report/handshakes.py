"""What the device said in WELCOME, ACK and PONG, session by session: JSON-able rows, bounded in number, for whoever audits a recording.

The texts are the device's: whoever prints them makes them safe (safe_text).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pans.runtime.record import Recording
from pans.runtime.wire.messages import (
    FrameDecoder,
    MalformedMessage,
    MessageType,
    Opcode,
    decode_ack,
    decode_command,
    decode_welcome,
    unpack_body,
)

SESSIONS_MAX, REFUSED_MAX = 1000, 100  # that are shown; a device may fill a file with either


def handshakes(recording: Recording) -> list[dict[str, Any]]:
    """Return one row for each session with an answer: what the device is, how many answers came, which commands it refused."""
    rows: dict[int, dict[str, Any]] = {}
    for _, body in recording.answers():
        try:
            frame = unpack_body(body)
        except MalformedMessage:
            continue  # verify.py's
        if frame.session not in rows and len(rows) == SESSIONS_MAX:
            continue
        row = rows.setdefault(frame.session, _empty_row(frame.session))
        try:
            _take(row, frame.type, frame.payload)
        except MalformedMessage:
            row["malformed"] += 1
    _name_refused(rows, recording)
    return list(rows.values())


def _empty_row(session: int) -> dict[str, Any]:
    return {"session": session, "device": {}, "welcomes": 0, "acks": 0, "pongs": 0, "malformed": 0, "refused": []}


def _take(row: dict[str, Any], kind: int, payload: bytes) -> None:
    if kind == MessageType.WELCOME:
        row["welcomes"] += 1
        row["device"] = row["device"] or dict(decode_welcome(payload).facts)
    elif kind == MessageType.ACK:
        row["acks"] += 1
        ack, refused = decode_ack(payload), row["refused"]
        known = {one["command_id"] for one in refused}
        if ack.refused_id and ack.refused_id not in known and len(refused) < REFUSED_MAX:
            refused.append({"command_id": ack.refused_id, "command": "", "status": ack.status, "text": ack.text})
    elif kind == MessageType.PONG:
        row["pongs"] += 1


def _name_refused(rows: dict[int, dict[str, Any]], recording: Recording) -> None:
    """Say which commands the refused ones were."""
    wanted = {(session, one["command_id"]): one for session, row in rows.items() for one in row["refused"]}
    if not wanted:
        return
    for session, number, opcode in _sent_commands(recording):
        if (session, number) in wanted:
            wanted[session, number]["command"] = Opcode(opcode).name if opcode in set(Opcode) else str(opcode)


def _sent_commands(recording: Recording) -> Iterator[tuple[int, int, int]]:
    """Yield (session, id, opcode) of every command that was sent."""
    decoder = FrameDecoder()
    for _, data in recording.commands():
        for frame in decoder.feed(data):
            if frame.type != MessageType.COMMAND:
                continue
            try:
                command = decode_command(frame.payload)
            except MalformedMessage:
                continue
            yield frame.session, command.command_id, command.opcode
