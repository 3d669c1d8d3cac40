"""Where a key stands in a TOML text, so that an error message can say file:line:col.

Owns finding positions and turning the parser's own complaints into a ConfigError; never judges values (`tomllib` reads
them, the caller checks them). `read_toml` returns the parsed tables and the positions of their keys.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from typing import Any

from pans.runtime.errors import ConfigError

KeyPath = tuple[str, ...]
Position = tuple[int, int]  # line, column; both count from 1

_KEY_PART = re.compile(r"""[ \t]*(?:"((?:[^"\\\n]|\\.)*)"|'([^'\n]*)'|([A-Za-z0-9_-]+))[ \t]*""")
_STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?"{3,5}' r"|'''.*?'{3,5}" r'|"(?:[^"\\\n]|\\.)*"' r"|'[^'\n]*'" r"|#[^\n]*", re.DOTALL
)  # strings and comments: what brackets and newlines inside of them must not be taken for structure
_TOMLLIB_WHERE = re.compile(r" \(at line (\d+), column (\d+)\)$")


def read_toml(text: str, where: str) -> tuple[dict[str, Any], Mapping[KeyPath, Position]]:
    """Parse `text` (named `where` in messages); returns its tables and the position of every key and section.

    The n-th [[name]] stands under ("name", "n") and the first one under ("name",) too. Keys inside of an inline table have no position of
    their own: `position_of` answers with that of the table.
    Raises ConfigError with the position if the text is not TOML 1.0.
    """
    try:
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
    section: KeyPath = ()
    at = 0
    while at < len(text):
        if text[at] in " \t\r\n":
            at += 1
        elif text[at] == "#":
            at = _line_end(text, at)
        elif text[at] == "[":
            listed = text.startswith("[[", at)
            section, _ = _dotted_key(text, at + (2 if listed else 1))
            found.setdefault(section, _line_column(text, at))
            if listed:
                number = 0
                while (*section, str(number)) in found:
                    number += 1
                section = (*section, str(number))
                found[section] = _line_column(text, at)
            at = _line_end(text, at)
        else:
            key, after = _dotted_key(text, at)
            for depth in range(1, len(key) + 1):
                found.setdefault(section + key[:depth], _line_column(text, at))
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
