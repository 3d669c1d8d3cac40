"""The message dictionary against the document, the layouts and both decoders, at the edges of every field."""

from __future__ import annotations

import re
from typing import Any

import msgpack
import numpy as np
import pytest
from inner_kernels import called
from tree import ROOT

from pans.decide.core_state import CORE_DTYPE
from pans.protocol.wire import MalformedMessage
from pans.protocol.wire import kernels as walk
from pans.protocol.wire import messages as wire
from pans.protocol.wire.messages import decode_welcome
from pans.protocol.wire.schema import (
    ALL_MESSAGES,
    AUTOMATON_SCHEMA,
    AUTOMATON_SCHEMA_TEXT,
    COUNT_SCHEMA,
    COUNT_SCHEMA_TEXT,
    EXPOSED_SCHEMA,
    EXPOSED_SCHEMA_TEXT,
    FACTS,
    FROM_DEVICE,
    LARGEST_TICK,
    SCHEMA,
    SCHEMA_TEXT,
    STRUCTS,
    Fact,
    Field,
    wrong_facts,
)

DOCUMENT = (ROOT / "docs" / "reference" / "protocol.md").read_text(encoding="utf-8")
RANGES = DOCUMENT.partition("## 8. Ranges")[2].partition("\n## ")[0]
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in RANGES.splitlines() if line.startswith("| ")]
GOOD: dict[str, tuple[Any, ...]] = {
    "PONG": (1, 5, 10, 11),
    "ACK": (3, 3, 1, 5, 0),
    "STATUS": (2, 1, 10, 0, 100, 4),
    "CLICKS": (0, 0, 100, 4, 10, 8, 1),
    "FRAMES": (0, 0, 100, 4, 10, 8, 2, 1),
    "MARK": (0, 1, 2, 0, 4, 100, 1.5),
    "COUNTS": (0, 0, 100, 4, 10, 8, 2, 1),
    "EXPOSED": (3, 5, -2, 1, 2),
}
TAILS = {"CLICKS": bytes(8 * 2 + 1), "FRAMES": bytes(8 * 2), "COUNTS": bytes(8 * 3)}
FACTS_OF_A_DEVICE = {
    key: fact.low if fact.kind is int else True if fact.kind is bool else (*fact.words, "text")[0]
    for key, fact in FACTS.items()
}


def decode(name: str, values: tuple[Any, ...]) -> Any:
    payload = STRUCTS[name].pack(*values) + TAILS.get(name, b"")
    return wire.DECODERS[wire.MessageType[name]](payload)


def with_field(name: str, place: int, value: Any) -> tuple[Any, ...]:
    return (*GOOD[name][:place], value, *GOOD[name][place + 1 :])


def edges(field: Field) -> tuple[list[Any], list[Any]]:
    """Values at the edges of a field that must be taken, and those beyond that must not."""
    low, high = field.range
    if field.code == "f":
        return [low, -0.0, float(np.float32(high)), float("nan")], [-1e-45, float("inf"), float("-inf"), -1.0]
    least, most = field.span
    return [low, high], ([low - 1] if low > least else []) + ([high + 1, most] if high < most else [])


CASES = [(name, place, field) for name in FROM_DEVICE for place, field in enumerate(ALL_MESSAGES[name])]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0]}.{case[2].name}")
def test_what_a_field_may_hold_is_decoded_and_nothing_else(case: tuple[str, int, Field]) -> None:
    name, place, field = case
    taken, refused = edges(field)
    by_size = {"count", "word_bytes", "text_bytes", "last_id", "refused_id", "status", "rx_tick", "tx_tick"}
    for value in taken if field.name not in by_size else []:  # these must agree with something else
        decode(name, with_field(name, place, value))
    for value in refused:
        with pytest.raises(MalformedMessage):
            decode(name, with_field(name, place, value))


@pytest.mark.parametrize(
    ("name", "values"), [("PONG", (1, 5, 11, 10)), ("ACK", (3, 4, 1, 5, 0)), ("ACK", (3, 0, 0, 5, 0))]
)
def test_fields_that_contradict_each_other_are_malformed(name: str, values: tuple[int, ...]) -> None:
    with pytest.raises(MalformedMessage):
        decode(name, values)


is_next_mark, next_block = called(walk.is_next_mark), called(walk.next_block)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0]}.{case[2].name}")
def test_the_kernels_take_nothing_that_the_decoders_refuse(case: tuple[str, int, Field]) -> None:
    name, place, field = case
    if name not in ("FRAMES", "MARK"):
        return
    for value in [*edges(field)[1], *edges(field)[0]]:
        values = with_field(name, place, value)
        body = bytes(walk.BODY_HEADER) + STRUCTS[name].pack(*values) + TAILS.get(name, b"")
        at, stop = np.uint64(walk.BODY_HEADER), np.uint64(len(body))
        state = np.zeros(1, CORE_DTYPE)[0]
        state.next_exposure, state.end_exposure = GOOD["FRAMES"][3], 1 << 62
        buffer = np.frombuffer(body + bytes(8), np.uint8).copy()
        if name == "MARK":
            taken = bool(is_next_mark(buffer, at, stop, state))
        else:
            taken = next_block(buffer, at, stop, state)[0] > 0
        if taken:
            decode(name, values)


def test_the_schema_is_that_of_version_1() -> None:
    assert SCHEMA == 0x2E64AFC4
    assert SCHEMA_TEXT in DOCUMENT


@pytest.mark.parametrize(
    ("schema", "text", "value"),
    [
        (AUTOMATON_SCHEMA, AUTOMATON_SCHEMA_TEXT, 0xD00A27FF),
        (COUNT_SCHEMA, COUNT_SCHEMA_TEXT, 0xEEF01CE1),
        (EXPOSED_SCHEMA, EXPOSED_SCHEMA_TEXT, 0x9D499DC7),
    ],
)
def test_an_extension_has_the_schema_of_the_document(schema: int, text: str, value: int) -> None:
    assert schema == value
    assert text in DOCUMENT
    assert f"0x{schema:08X}" in DOCUMENT


def test_every_field_with_a_name_in_the_document_has_its_range_there() -> None:
    for name, fields in ALL_MESSAGES.items():
        for field in fields:
            rows = [row for row in ROWS if name in re.split(r", ", row[0]) or row[0] == "all"]
            assert not field.title or any(field.title in row[1] for row in rows), f"{name}: {field.title}"


def test_the_table_of_welcome_is_the_dictionary() -> None:
    table = DOCUMENT.partition("**WELCOME's map**")[2]
    pairs = re.findall(r"^\| `(\w+)`(?:, `(\w+)`)? \| (.+?) \| (\w+) \|", table, re.MULTILINE)
    listed = {name: (kind, needed) for first, second, kind, needed in pairs for name in (first, second) if name}
    for key, fact in FACTS.items():
        kind, needed = listed[key]
        assert (needed == "yes") is fact.needed
        assert kind.startswith({int: "integer", bool: "boolean", str: "text" if not fact.words else '`"'}[fact.kind])
        if fact.kind is int:
            low, high = re.fullmatch(r"integer, (.+) to (.+)", kind).groups()  # type: ignore[union-attr]
            assert (number(low), number(high)) == (fact.low, fact.high), key


def number(text: str) -> int:
    """A number of the document: 65535, 10^10 or 2^32 - 1.

    No other forms stand in the table.
    """
    power = re.fullmatch(r"(\d+)\^(\d+)(?: - (\d+))?", text)
    return int(power[1]) ** int(power[2]) - int(power[3] or 0) if power else int(text)


def beyond(fact: Fact) -> list[Any]:
    """What a key must not hold."""
    wrong = [None, [], {}, b"x", float("nan"), 1.0]
    if fact.kind is int:
        return [*wrong, fact.low - 1, fact.high + 1, str(fact.low), True]
    return [*wrong, 1, "yes"] if fact.kind is bool else [*wrong, 1, True, *(["both"] if fact.words else [])]


@pytest.mark.parametrize("key", FACTS)
def test_a_key_of_welcome_holds_what_the_dictionary_says_or_is_named(key: str) -> None:
    assert wrong_facts(FACTS_OF_A_DEVICE) == []
    for value in beyond(FACTS[key]):
        (wrong,) = wrong_facts({**FACTS_OF_A_DEVICE, key: value})
        assert wrong.startswith(f"{key} is ")
    without = {name: value for name, value in FACTS_OF_A_DEVICE.items() if name != key}
    assert wrong_facts(without) == ([f"{key} is missing"] if FACTS[key].needed else [])


def test_only_plain_values_of_unknown_keys_are_kept() -> None:
    head = STRUCTS["WELCOME"].pack(SCHEMA, 1)
    facts = {"a": float("nan"), "b": [1], "c": {"d": 1}, "e": 1.5, "f": LARGEST_TICK, "g": None, "h": float("inf")}
    assert decode_welcome(head + msgpack.packb(facts)).facts == {"e": 1.5, "f": LARGEST_TICK}
    for packed in (
        b"\x82\xa1a\x01\xa1a\x02",
        b"\x81\xc4\x01a\x01",
        b"\x81\x01\x02",
    ):  # a key twice, of bytes, of an integer
        with pytest.raises(MalformedMessage):
            decode_welcome(head + packed)
