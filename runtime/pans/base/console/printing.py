"""What a command prints: its answer on stdout, everything for people on stderr, errors as two lines or as one JSON object."""

from __future__ import annotations

import argparse
import json
import logging
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pans.base.errors import PansError

from .logs import LOGGER, plain, stderr_line
from .text import lines, one_line

_WHERE = re.compile(r"(?:argument (?P<option>[^:]{1,60})|(?P<place>[^\s:]{1,4096}(?::\d+)*)): ")


@dataclass(slots=True)
class State:
    """What one call of `main` was asked for and has printed."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    said: bool = False  # anything at all
    answered: bool = False  # on stdout
    command: str = ""


state = State()


def begin(words: list[str]) -> None:
    """Set what is printed from here on, by the command line's words."""
    state.quiet, state.verbose = (bool(flags & {*words}) for flags in ({"-q", "--quiet"}, {"-v", "--verbose"}))
    state.as_json = "--json" in words
    state.said = state.answered = False
    state.command = next((word for word in words if not word.startswith("-")), "")


def say(text: str) -> None:
    """Print for people, on stderr: stdout belongs to the JSON object or the answer itself. Nothing with `--quiet`."""
    LOGGER.info("%s", text)
    if not state.quiet:
        _print_error(text)


def note(text: str) -> None:
    """Print for people who asked for more with `--verbose`."""
    if state.verbose:
        say(text)


def warn(text: str) -> None:
    """Print a warning on stderr, with `--quiet` too."""
    LOGGER.warning("%s", text)
    _print_error(f"pans: warning: {text}", logging.WARNING)


def emit(args: argparse.Namespace, payload: Mapping[str, Any], text: str = "") -> None:
    """Print one JSON object when `--json` was given, else `text`; both on stdout."""
    if args.json:
        _answer(json.dumps(payload, allow_nan=False, default=plain))
    elif text:
        _answer(lines(text))


def fail(error: PansError, exit_code: int) -> int:
    """Print an error on stderr, with `--json` also as one object on stdout unless the answer is there; return `exit_code`."""
    advice = error.remedy or error.usual_remedy.replace("COMMAND", one_line(state.command, 20) or "COMMAND")
    remedy = f"\n  remedy: {one_line(advice)}" if advice else ""
    # no line of a message can pass for one of ours
    _print_error(f"pans: {error.message}".replace("\n", "\n    ") + remedy, logging.ERROR)
    if state.as_json and not state.answered:
        facts = {"message": error.message, "where": where_of(error), "remedy": advice, "exit": exit_code}
        _answer(json.dumps({"error": facts}))
    return exit_code


def where_of(error: PansError) -> str:
    """Return the file (with line and column) or the option that a message begins with, "" where it names none.

    >>> where_of(PansError("lab.toml:14:1: dead_time_ns must be above 0"))
    'lab.toml:14:1'
    >>> where_of(PansError("argument --seconds: 'nan' is not a number from 0 to 1e+09"))
    '--seconds'
    """
    found = _WHERE.match(error.message)
    return "" if found is None else found["option"] or found["place"]


def _answer(text: str) -> None:
    state.said = state.answered = True
    print(text, flush=True)


def _print_error(text: str, level: int = logging.INFO) -> None:
    state.said = True
    print(stderr_line(lines(text), level), file=sys.stderr, flush=True)
