"""Changed contents: JSON, TOML, arrays and protobuf messages with values that nobody would write.

Owns the values and where they are put; knows no file format. All choices come from the `random.Random` that is given.
"""

from __future__ import annotations

import json
import random
from typing import Any

import numpy as np
from numpy.typing import NDArray

NUMBERS = (
    *(0, 1, -1, 2, 255, 65535, 65536, 1 << 31, (1 << 32) - 1, 1 << 53, (1 << 63) - 1, 1 << 63, (1 << 64) - 1, 1 << 64),
    *(0.5, -0.0, 5e-324, 1e-20, 1e9, 1e15, 1e308, -1e308, 1e-300, 3.4028235e38, 10**30),
)
LITERALS = ("1e999", "-1e999", "NaN", "Infinity", "1" + "0" * 400, "[" * 80 + "]" * 80, "1e-400")
TEXTS = (
    "",
    "x",
    "a" * 300,
    "\x1b[2J",
    "=1+1",
    "nan",
    "../../x",
    "\u202eabc",
    "a\nb",
    "0" * 64,
    "1970-01-01T00:00:00",
    "9999-12-31T23:59:59+00:00",
)
TOML_VALUES = (
    *("0", "-1", "1", "inf", "-inf", "nan", "1e308", "5e-324", "1e999", "9223372036854775807", "18446744073709551616"),
    *(
        "true",
        '"x"',
        '""',
        "[]",
        "{}",
        "[1, 2]",
        "1979-05-27",
        '"' + "a" * 300 + '"',
        "0.0",
        "1e-9",
        "4096",
        "65535",
        "1e9",
        "0.5",
    ),
)
FLOATS = (np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -0.0, 1.0, 1e30)


def mutated_json(dice: random.Random, value: Any) -> bytes:
    """Return the text of `value` (an object) with one to three changes, anywhere in it."""
    tree = json.loads(json.dumps(value))
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        _change_somewhere(dice, tree)
    text = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    for literal in LITERALS:
        text = text.replace(f'"@{literal}@"', literal)
    return text.encode()


def _change_somewhere(dice: random.Random, tree: Any) -> None:
    places: list[tuple[Any, Any]] = []
    pending = [tree]
    while pending:
        one = pending.pop()
        keys = list(one) if isinstance(one, dict) else range(len(one))
        places += [(one, key) for key in keys]
        pending += [one[key] for key in keys if isinstance(one[key], dict | list)]
    if not places:
        return
    parent, key = dice.choice(places)
    kind = dice.random()
    if kind < 0.1:
        del parent[key]
    elif kind < 0.2 and isinstance(parent, dict):
        parent[dice.choice(TEXTS)] = nasty(dice)
    elif kind < 0.3 and isinstance(parent, list):
        parent.append(dice.choice(parent))
    elif kind < 0.5 and isinstance(parent[key], int | float) and not isinstance(parent[key], bool):
        parent[key] = dice.choice((parent[key] + 1, parent[key] - 1, parent[key] * 1000, -parent[key], parent[key] / 7))
    else:
        parent[key] = nasty(dice)


def nasty(dice: random.Random) -> Any:
    """Return a value of any type that JSON knows, or one that it does not."""
    kind = dice.randrange(8)
    if kind < 3:
        return dice.choice(NUMBERS)
    if kind == 3:
        return f"@{dice.choice(LITERALS)}@"
    if kind == 4:
        return dice.choice(TEXTS)
    return dice.choice((None, True, False, [], {}, [[]], {"a": 1}, [1, 2], [None]))


def mutated_toml(dice: random.Random, text: str) -> str:
    """Return TOML text with one to three lines changed, removed, doubled or added."""
    lines = text.split("\n")
    for _ in range(dice.choice((1, 1, 2, 3))):
        places = [number for number, line in enumerate(lines) if "=" in line and not line.startswith("#")]
        if not places:
            break
        place = dice.choice(places)
        kind = dice.random()
        if kind < 0.75:
            lines[place] = lines[place].split("=")[0] + "= " + dice.choice(TOML_VALUES)
        elif kind < 0.85:
            del lines[place]
        elif kind < 0.92:
            lines.insert(dice.randrange(len(lines)), lines[place])
        else:
            lines.insert(
                dice.randrange(len(lines)), dice.choice(("[x]", "a.b.c = 1", "[[change]]", "x = [", "\x00", "= 1"))
            )
    return "\n".join(lines)


def mutated_array(dice: random.Random, array: NDArray[Any]) -> NDArray[Any]:
    """Return a copy with some values, or all of them, replaced by edges of its type, or turned about."""
    changed = array.copy()
    flat = changed.reshape(-1)
    if not flat.size:
        return changed
    kind = dice.random()
    if kind < 0.15:
        flat[:] = flat[::-1].copy()
        return changed
    values: tuple[Any, ...] = FLOATS
    if array.dtype.kind in "iu" and kind < 0.3:  # next to what was there: still in range more often than not
        place = dice.randrange(flat.size)
        flat[place] = flat[(place + 1) % flat.size] if kind < 0.2 else flat[place] ^ 1
        return changed
    if array.dtype.kind in "iu":
        info = np.iinfo(array.dtype)
        values = (info.min, info.max, 0, 1, info.max // 2)
    where = slice(None) if kind < 0.4 else [dice.randrange(flat.size) for _ in range(dice.choice((1, 1, 3, 20)))]
    flat[where] = np.array(dice.choice(values)).astype(array.dtype)
    return changed


def mutated_bytes(dice: random.Random, data: bytes) -> bytes:
    """Return bytes with a few flipped, cut, doubled, or overwritten by an edge."""
    changed = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 5))):
        if not changed:
            break
        place, kind = dice.randrange(len(changed)), dice.random()
        if kind < 0.5:
            changed[place] ^= 1 << dice.randrange(8)
        elif kind < 0.8:
            width = dice.choice((1, 2, 4, 8))
            edge = dice.choice((0, (1 << 8 * width) - 1, 1 << (8 * width - 1), 1))
            changed[place : place + width] = edge.to_bytes(width, "little")
        elif kind < 0.9:
            del changed[place : place + dice.choice((1, 4, 40))]
        else:
            changed[place:place] = changed[place : place + dice.choice((1, 4, 40))]
    return bytes(changed)


def mutated_protobuf(dice: random.Random, data: bytes, depth: int = 0) -> bytes:
    """Return a protobuf message with one field changed, removed, doubled or moved, somewhere in it; all lengths right."""
    fields = _fields(data)
    if not fields:
        return mutated_bytes(dice, data)
    place = dice.randrange(len(fields))
    number, wire, value = fields[place]
    kind = dice.random()
    if wire == 2 and kind < 0.75 and depth < 8 and _fields(value):
        fields[place] = number, wire, mutated_protobuf(dice, value, depth + 1)
    elif kind < 0.15:
        del fields[place]
    elif kind < 0.3:
        fields.insert(dice.randrange(len(fields) + 1), fields[place])
    elif kind < 0.4:
        other = dice.randrange(len(fields))
        fields[place], fields[other] = fields[other], fields[place]
    elif wire == 0:
        fields[place] = number, wire, abs(int(dice.choice(NUMBERS[:14]))) & ((1 << 64) - 1)
    elif wire == 2 and dice.random() < 0.3:
        fields[place] = (
            number,
            wire,
            dice.choice((b"", b"Loop", b"Expand", b"Relu", b"Transpose", b"ReduceSum", b"MatMul", b"x")),
        )
    else:
        fields[place] = number, wire, mutated_bytes(dice, value)[: 8 if wire == 1 else 4 if wire == 5 else None]
    return b"".join(_packed(*field) for field in fields)


def _fields(data: bytes) -> list[tuple[int, int, Any]]:
    """Return the fields of `data` as (number, wire type, value), or [] if it is no message."""
    found: list[tuple[int, int, Any]] = []
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        wire = key & 7
        if position < 0 or wire not in (0, 1, 2, 5) or not 0 < key >> 3 < 100:
            return []
        length = {1: 8, 5: 4}.get(wire, 0)
        if wire in (0, 2):
            length, position = _varint(data, position)
            if position < 0:
                return []
        if wire == 0:
            found.append((key >> 3, wire, length))
            continue
        if length > len(data) - position:
            return []
        found.append((key >> 3, wire, data[position : position + length]))
        position += length
    return found


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 64, 7):
        if position >= len(data):
            break
        value |= (data[position] & 127) << shift
        position += 1
        if data[position - 1] < 128:
            return value, position
    return 0, -1


def _packed(number: int, wire: int, value: Any) -> bytes:
    start = _packed_number(number << 3 | wire)
    if wire == 0:
        return start + _packed_number(value)
    return start + (_packed_number(len(value)) if wire == 2 else b"") + value


def _packed_number(value: int) -> bytes:
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])
