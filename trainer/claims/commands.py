"""The commands that a page names: whether they exist, and whether their options parse.

Owns the finding of commands between backticks. Runs none. The command of a table is parsed whole; of one that is mentioned in a sentence
the name and the options must exist.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import shlex
from collections.abc import Iterator
from functools import cache
from importlib.metadata import entry_points

from pans.runtime.cli import command as parser
from pans.runtime.errors import PansError

from .prose import GENERATED

_SPAN = re.compile(r"`(pans [^`]+)`")
_TOP = ("help", "list", "--help", "--version", "-V")  # of `pans` itself
_OWN_OPTIONS = ("trials",)  # each trial has options of its own


@cache
def _parser_of(name: str) -> argparse.ArgumentParser | None:
    """Return a command's parser, None if there is none of that name; ModuleNotFoundError where an extra is missing."""
    found = [point for point in entry_points(group="pans.commands") if point.name == name]
    return parser.parser_of(name, found[0].load()) if found else None


def command_faults(text: str) -> Iterator[str]:
    """Yield what is wrong with the commands of a page."""
    made = " ".join(found.group() for found in GENERATED.finditer(text))
    for span in dict.fromkeys(_SPAN.findall(text)):
        if (fault := _fault(" ".join(span.split()), whole=f"`{span}`" in made)) is not None:
            yield fault


def _fault(line: str, *, whole: bool) -> str | None:
    words = shlex.split(line)[1:]
    if words[0] in _TOP:
        return None
    try:
        known = _parser_of(words[0])
    except ModuleNotFoundError:
        return None  # of an extra that is not installed: it cannot be told
    if known is None:
        return f"`{line}`: pans {words[0]} is no command"
    options = {option for action in known._actions for option in action.option_strings}
    named = {word.partition("=")[0] for word in words if word.startswith("--")}
    if (unknown := sorted(named - options)) and words[0] not in _OWN_OPTIONS:
        return f"`{line}`: pans {words[0]} has no {', '.join(unknown)}"
    return _whole_fault(known, line, words) if whole else None


def _whole_fault(known: argparse.ArgumentParser, line: str, words: list[str]) -> str | None:
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            known.parse_args(words[1:])
    except (SystemExit, argparse.ArgumentError, PansError) as error:
        return f"`{line}` does not parse: {said.getvalue().strip() or error}"
    return None
