"""TOML files whose faults are reported with file:line:col: where a key stands, what it may hold, what to write instead.

`toml_text` reads a file, `read_toml` takes text and returns the parsed tables and the positions of their keys, or raises ConfigError. A
`Key` is the rule of one value. profile_schema.py and the simulator's scenes say which keys there are.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pans.base.errors import ConfigError, PansError

from .container import other_kind, read_file

KeyPath = tuple[str, ...]
Position = tuple[int, int]  # line, column; both count from 1

_KEY_PART = re.compile(r"""[ \t]*(?:"((?:[^"\\\n]|\\.)*)"|'([^'\n]*)'|([A-Za-z0-9_-]+))[ \t]*""")
KEY_PARTS_MAX = 100
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}' r"|'''.*?'{3,5}" r'|"(?:[^"\\\n]|\\.)*"' r"|'[^'\n]*'" r"|#[^\n]*", re.DOTALL
)  # strings and comments: what brackets and newlines inside of them must not be taken for structure
_TOMLLIB_WHERE = re.compile(r" \(at line (\d+), column (\d+)\)$")


def toml_text(path: Path, most: int, what: str, *kinds: str, remedy: str = "") -> str:
    """Return the text of a TOML file of at most `most` bytes, without a byte order mark and with plain line ends, whoever saved it.

    ConfigError where `what` cannot be read or is of another kind (container.other_kind; `kinds` are allowed besides plain TOML), and
    with line and column for a byte that is not UTF-8.
    """
    try:
        data = read_file(path, most)
    except PansError as error:
        raise ConfigError(error.message, remedy=remedy or error.remedy) from error
    kind, taker = other_kind(data, "TOML", *kinds)
    if kind:
        raise ConfigError(f"{path}: not {what}: it is {kind}", remedy=f"{taker}; {remedy}" if remedy else taker)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line, column = data.count(b"\n", 0, error.start) + 1, error.start - data.rfind(b"\n", 0, error.start)
        found = f"byte 0x{data[error.start]:02x} is not UTF-8"
        raise ConfigError(f"{path}:{line}:{column}: {found}", remedy="save the file as UTF-8") from error


def read_toml(text: str, where: str) -> tuple[dict[str, Any], Mapping[KeyPath, Position]]:
    """Parse `text` (named `where` in messages); returns its tables and the position of every key and section.

    The n-th [[name]] stands under ("name", "n") and the first one under ("name",) too. Keys inside of an inline table have no position of
    their own: `position_of` answers with that of the table.
    Raises ConfigError with the position if the text is not TOML 1.0.
    """
    try:
        for number, line in enumerate(text.split("\n"), 1):  # a key of thousands of parts takes tomllib minutes
            if line.partition("=")[0].count(".") >= KEY_PARTS_MAX and not line.lstrip().startswith("#"):
                raise ConfigError(f"{where}:{number}:1: a line with {KEY_PARTS_MAX} dots or more before any =")
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise _not_toml(error, text, where) from error
    except ValueError as error:  # Python refuses to read a number of thousands of digits
        raise ConfigError(f"{where}:1:1: not valid TOML: {str(error).split(';')[0]}") from error
    except RecursionError as error:
        raise ConfigError(f"{where}:1:1: the TOML is nested too deeply") from error
    return tables, key_positions(text)


def key_positions(text: str) -> dict[KeyPath, Position]:
    """Map each dotted path to the (line, column) of its first character; `text` must be valid TOML."""
    found: dict[KeyPath, Position] = {}
    listed_before: dict[KeyPath, int] = {}
    starts = [0, *(match.end() for match in re.finditer("\n", text))]
    section: KeyPath = ()
    at = 0

    def place(offset: int) -> Position:
        line = bisect_right(starts, offset)
        return line, offset - starts[line - 1] + 1

    while at < len(text):
        if text[at] in " \t\r\n":
            at += 1
        elif text[at] == "#":
            at = _line_end(text, at)
        elif text[at] == "[":
            listed = text.startswith("[[", at)
            section, _ = _dotted_key(text, at + (2 if listed else 1))
            found.setdefault(section, place(at))
            if listed:
                number = listed_before.get(section, 0)
                listed_before[section] = number + 1
                section = (*section, str(number))
                found[section] = place(at)
            at = _line_end(text, at)
        else:
            key, after = _dotted_key(text, at)
            for depth in range(1, len(key) + 1):
                found.setdefault(section + key[:depth], place(at))
            at = _value_end(text, after + 1)
    return found


def position_of(path: KeyPath, positions: Mapping[KeyPath, Position]) -> Position:
    """The position of `path`, or of the nearest table around it; line 1, column 1 if there is none."""
    for length in range(len(path), 0, -1):
        if path[:length] in positions:
            return positions[path[:length]]
    return 1, 1


def _dotted_key(text: str, at: int) -> tuple[KeyPath, int]:
    parts: list[str] = []
    while match := _KEY_PART.match(text, at):
        basic, literal, bare = match.groups()
        parts.append(tomllib.loads(f'k = "{basic}"')["k"] if basic is not None else literal if bare is None else bare)
        at = match.end()
        if not text.startswith(".", at):
            break
        at += 1
    return tuple(parts), at


def _value_end(text: str, at: int) -> int:
    """Where the value that starts at `at` ends: the first newline outside of strings and brackets."""
    depth = 0
    while at < len(text):
        if match := _STRING.match(text, at):
            at = match.end()
            continue
        if text[at] in "[{":
            depth += 1
        elif text[at] in "]}":
            depth -= 1
        elif text[at] == "\n" and depth == 0:
            break
        at += 1
    return at


def _line_end(text: str, at: int) -> int:
    end = text.find("\n", at)
    return len(text) if end < 0 else end


def _line_column(text: str, at: int) -> Position:
    return text.count("\n", 0, at) + 1, at - (text.rfind("\n", 0, at) + 1) + 1


def _not_toml(error: tomllib.TOMLDecodeError, text: str, where: str) -> ConfigError:
    message = str(error)
    match = _TOMLLIB_WHERE.search(message)
    if match:
        line, column = int(match[1]), int(match[2])
        message = message[: match.start()]
    else:  # tomllib says "at end of document"
        line, column = _line_column(text, len(text))
    return ConfigError(
        f"{where}:{line}:{column}: not valid TOML: {message}",
        remedy="a line is `key = value`; text stands in double quotes; a section is `[name]`",
    )


@dataclass(frozen=True, slots=True)
class Key:
    """One key: its kind, its range (for numbers) and whether it must be there."""

    kind: str  # "text", "whole", "number", "names" (a list of texts), or "numbers"
    low: float = 0.0
    high: float = 0.0
    above: bool = False  # low itself is not allowed
    required: bool = True
    infinite: bool = False  # inf is a meaning, not a mistake
    choices: tuple[str, ...] = ()
    meaning: str = ""

    def fits(self, value: Any) -> bool:
        """Whether the type is right: a boolean is no number, a whole number is one."""
        is_one = {"text": _is_text, "names": _is_text, "whole": _is_whole}.get(self.kind, _is_number)
        return isinstance(value, list) and all(map(is_one, value)) if self.kind in _LISTS else is_one(value)

    def within(self, value: Any) -> bool:
        """Whether a value of the right type is an allowed one; nan is in no range."""
        return all(map(self._holds, value)) if self.kind in _LISTS else self._holds(value)

    def _holds(self, value: Any) -> bool:
        if isinstance(value, str):
            return value in self.choices if self.choices else bool(value.strip())
        if value == math.inf:
            return self.infinite
        return bool(self.low < value <= self.high or (value == self.low and not self.above))

    @property
    def allowed(self) -> str:
        """What may stand there, in words."""
        if self.kind == "text":
            return " or ".join(f'"{choice}"' for choice in self.choices) or "text in quotes, not empty"
        if self.kind == "names":
            return "a list of texts in quotes"
        if self.kind == "numbers":
            return f"a list of numbers from {self.low:.12g} to {self.high:.12g}"
        noun = "a whole number" if self.kind == "whole" else "a number"
        low, high = f"{self.low:.12g}", f"{self.high:.12g}"
        limits = f"above {low} and at most {high}" if self.above else f"from {low} to {high}"
        return f"{noun} {limits}{', or inf' if self.infinite else ''}"


_LISTS = ("names", "numbers")


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or _is_whole(value)


def found(value: Any) -> str:
    """What a file holds, in words and never longer than a line."""
    if isinstance(value, bool):
        return f"the boolean {str(value).lower()}"
    if isinstance(value, str):
        return f'the text "{value[:40]}{"..." if len(value) > 40 else ""}"'
    if isinstance(value, (int, float)):
        return repr(value) if abs(value) < 10**20 or isinstance(value, float) else "an enormous whole number"
    if isinstance(value, (dict, list)):
        return "a table" if isinstance(value, dict) else "a list" if value else "an empty list"
    return f"a {type(value).__name__}"


def type_remedy(value: Any, kind: str) -> str:
    """What to write instead of a value of the wrong type."""
    examples = {
        "text": "write the value in double quotes",
        "names": 'for example ["null"]',
        "numbers": "write plain numbers in brackets, for example [0.01, 0.002]",
    }
    if kind in examples:
        return examples[kind]
    if isinstance(value, str):
        return "write the number without quotes"
    if kind == "whole" and isinstance(value, float) and value.is_integer():
        return f"write {int(value)} without a decimal point or exponent"
    return "write a plain number"


def near(name: str, known: list[str], form: str = "{}", page: str = "docs/reference/profiles.md") -> str:
    """The known name that was probably meant, or the page that explains them all."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {form.format(close[0])}?" if close else f"{page} explains every key"
