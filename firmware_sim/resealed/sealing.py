"""Files taken apart and put together again with right checksums, whatever they hold by then.

Owns the way from changed contents to bytes that no checksum refuses; the formats are docs/reference/formats.md's. Each function takes a
whole file and a `random.Random`, and returns a changed one.
"""

from __future__ import annotations

import hashlib
import json
import random
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pans.runtime.container import block_bytes, canonical_json, file_prologue
from pans.runtime.errors import DamagedFileError
from pans.runtime.record.format import FORMAT_VERSION, MAGIC, MESSAGE, Kind
from pans.runtime.record.log import LogReader
from pans.runtime.wire.framing import FrameDecoder, encode_frame

from .contents import mutated_array, mutated_bytes, mutated_json, mutated_protobuf

_HEAD = struct.Struct("<8sII")
_BLOCK = struct.Struct("<IIB3xI")
_MODELS = ("head_onnx", "int8_onnx")


def changed_bundle(dice: random.Random, data: bytes) -> bytes:
    """Return a bundle with another header, another part, or another model; its checksums fit."""
    _, version, length = _HEAD.unpack_from(data)
    header = json.loads(data[_HEAD.size : _HEAD.size + length])
    start = _HEAD.size + length
    arrays: dict[str, NDArray[Any]] = {}
    for row in header["parts"]:
        blob = data[start + row["offset"] : start + row["offset"] + row["length"]]
        arrays[row["name"]] = np.frombuffer(blob, row["dtype"]).reshape(row["shape"])
    models = [name for name in _MODELS if name in arrays]
    kind = dice.random()
    if kind < 0.3 and models:
        name = dice.choice(models)
        changed = mutated_protobuf(dice, arrays[name].tobytes())
        arrays[name] = np.frombuffer(changed, np.uint8)
    elif kind < 0.55:
        name = dice.choice(list(arrays))
        arrays[name] = mutated_array(dice, arrays[name])
    elif kind < 0.6:
        del arrays[dice.choice(list(arrays))]
    header["parts"], blobs, offset = [], [], 0
    for name, array in arrays.items():
        blob = array.tobytes()
        row = {
            "name": name,
            "dtype": array.dtype.str,
            "shape": list(array.shape),
            "offset": offset,
            "length": len(blob),
        }
        header["parts"].append(row | {"sha256": hashlib.sha256(blob).hexdigest()})
        blobs.append(blob)
        offset += len(blob)
    text = mutated_json(dice, header) if kind >= 0.6 else canonical_json(header)
    body = b"".join((_HEAD.pack(b"PANSBNDL", version, len(text)), text, *blobs))
    return body + hashlib.sha256(body).digest()


def changed_recording(dice: random.Random, data: bytes) -> bytes:
    """Return a recording with one block changed, removed, doubled or moved; chain, index, END and the bundle's digest fit."""
    blocks = _blocks(data)
    place = dice.randrange(len(blocks))
    kind, payload = blocks[place]
    how = dice.random()
    if how < 0.06:
        del blocks[place]
    elif how < 0.12:
        blocks.insert(dice.randrange(1, len(blocks) + 1), (kind, payload))
    elif how < 0.16:
        other = dice.randrange(len(blocks))
        blocks[place], blocks[other] = blocks[other], blocks[place]
    elif how < 0.18:
        del blocks[dice.randrange(1, len(blocks)) :]
    else:
        blocks[place] = kind, _changed_payload(dice, kind, payload)
    return _sealed(blocks)


def _changed_payload(dice: random.Random, kind: int, payload: bytes) -> bytes:
    if kind in (Kind.HEADER, Kind.END):
        return mutated_json(dice, json.loads(payload))
    if kind == Kind.BUNDLE:
        return changed_bundle(dice, payload)
    if kind == Kind.EVENTS and payload:
        lines = payload.splitlines()
        place = dice.randrange(len(lines))
        lines[place] = mutated_json(dice, json.loads(lines[place]))
        return b"\n".join(lines)
    if kind in (Kind.MESSAGES, Kind.COMMANDS, Kind.ANSWERS) and payload and dice.random() < 0.8:
        return _changed_message(dice, payload, wire=kind == Kind.COMMANDS)
    return mutated_bytes(dice, payload)


def _changed_message(dice: random.Random, payload: bytes, *, wire: bool) -> bytes:
    """Return a block of messages with one removed, doubled, at another time or changed; `wire`: frames as they were sent."""
    rows, position = [], 0
    while position < len(payload):
        host_ns, length = MESSAGE.unpack_from(payload, position)
        position += MESSAGE.size
        rows.append((host_ns, payload[position : position + length]))
        position += length
    place = dice.randrange(len(rows))
    host_ns, body = rows[place]
    kind = dice.random()
    if kind < 0.2:
        del rows[place]
    elif kind < 0.3:
        rows.insert(dice.randrange(len(rows)), rows[place])
    elif kind < 0.5:
        rows[place] = dice.choice((0, -1, (1 << 63) - 1, -(1 << 63), host_ns - 10**12)), body
    else:
        rows[place] = (
            host_ns,
            _changed_frames(dice, body) if wire and dice.random() < 0.8 else mutated_bytes(dice, body),
        )
    return b"".join(MESSAGE.pack(host_ns, len(body)) + body for host_ns, body in rows)


def _changed_frames(dice: random.Random, data: bytes) -> bytes:
    """Return frames as they go over the wire, the payload of one of them changed, under a checksum that fits."""
    frames = FrameDecoder().feed(data)
    if not frames:
        return mutated_bytes(dice, data)
    place = dice.randrange(len(frames))
    payloads = [frame.payload for frame in frames]
    payloads[place] = mutated_bytes(dice, payloads[place])
    return b"".join(
        encode_frame(frame.type, payload, frame.session, frame.flags) for frame, payload in zip(frames, payloads)
    )


def _blocks(data: bytes) -> list[tuple[int, bytes]]:
    found, position = [], 16
    while position < len(data):
        length, _, kind, _ = _BLOCK.unpack_from(data, position)
        position += _BLOCK.size
        found.append((kind, data[position : position + length]))
        position += length + 4
    return found


def _sealed(blocks: list[tuple[int, bytes]]) -> bytes:
    bundle = next((payload for kind, payload in blocks if kind == Kind.BUNDLE), None)
    log, decisions, readable = LogReader(), 0, True
    out, chain = file_prologue(MAGIC, FORMAT_VERSION)
    pieces = [out]
    for index, (kind, payload) in enumerate(blocks):
        if kind == Kind.HEADER and bundle is not None:
            payload = _with(payload, {"bundle_sha256": hashlib.sha256(bundle).hexdigest()})
        elif kind == Kind.DECISIONS and readable:
            try:
                decisions += len(log.rows(payload, ""))
            except DamagedFileError:
                readable = False
        elif kind == Kind.END:
            facts = {"blocks": index, "decisions": decisions, "decisions_sha256": log.hexdigest()}
            payload = _with(payload, facts)
        block, chain = block_bytes(kind, index, chain, payload)
        pieces.append(block)
    return b"".join(pieces)


def _with(payload: bytes, facts: dict[str, Any]) -> bytes:
    """The JSON text with some keys as they must be; as it is where it cannot be read."""
    try:
        value = json.loads(payload)
        return canonical_json({**value, **facts})
    except (ValueError, TypeError, RecursionError):
        return payload


def changed_calibration(dice: random.Random, data: bytes) -> bytes:
    """Return a calibration that says something else, with its checksum."""
    body = {key: value for key, value in json.loads(data).items() if key != "sha256"}
    text = mutated_json(dice, body)
    try:
        changed = json.loads(text)
        digest = hashlib.sha256(canonical_json(changed)).hexdigest()
    except (ValueError, TypeError, RecursionError):
        digest = "0" * 64
    return text[:-1] + b',"sha256":"' + digest.encode() + b'"}'
