"""The table of rules, which the modules of rules/ fill when they are imported: number, words and check; and what a check raises.

The words are those of section 12 of docs/reference/protocol.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

Check = Callable[[Any], None]  # of a Bench, which stands above this module


class Broken(Exception):
    """The device did not keep the rule; the text says what it did."""


class Silent(Broken):
    """An answer did not come in time."""


class NotTried(Exception):
    """The rule cannot be tried on this device, or not over this link; the text says why."""


class Rule(NamedTuple):
    """One rule of the protocol. `check` returns when it is kept; it is None for what no link can show, and `why` says so.

    A `long` rule takes minutes of device time and is tried only when asked for.
    """

    number: str
    words: str
    check: Check | None
    why: str = ""
    long: bool = False


RULES: dict[str, Rule] = {}


def rule(number: str, words: str, *, long: bool = False) -> Callable[[Check], Check]:
    """Register the function below as the check of rule `number`, "section.place"."""

    def register(check: Check) -> Check:
        assert number not in RULES, number
        RULES[number] = Rule(number, words, check, long=long)
        return check

    return register


def beyond_the_link(number: str, words: str, why: str) -> None:
    """Register a rule that a link cannot show."""
    assert number not in RULES, number
    RULES[number] = Rule(number, words, None, why)


def need(kept: bool, words: str) -> None:
    """Raise Broken with `words` unless `kept`."""
    if not kept:
        raise Broken(words)


def in_order(number: str) -> tuple[int, ...]:
    """Return the key by which rules are sorted."""
    return tuple(int(part) for part in number.split("."))
