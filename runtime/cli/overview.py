"""The list of commands: grouped by purpose, with one line each, without loading them.

Owns the groups; what a command does in one line is in the command's source.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path

from pans.runtime import __version__
from pans.runtime.errors import UsageError

from .finding import load_command

GROUPS = {
    "Run and look": ("demo", "run", "replay", "verify", "info", "report", "compare", "export", "runs", "service"),
    "Instruments": ("profile", "calibrate", "refit", "tune", "simulate", "devices", "doctor"),
    "Train and compare": ("train", "evaluate", "order", "baseline", "reproduce", "sweep", "batch", "data", "bundle"),
    "Measure and test": ("bench", "conform", "trials", "fuzz"),
    "Shell": ("completion",),
}
OTHERS = "Others"


def overview(commands: Mapping[str, EntryPoint]) -> str:
    """Return the text that `pans` prints without a command."""
    lines = [f"pans {__version__}: decide on a few photons, in time", "", "usage: pans COMMAND [options]"]
    width = max((len(name) for name in commands), default=0)
    for group, names in _grouped(commands):
        lines += ["", f"{group}:", *(f"  {name:<{width}}  {_summary(commands[name])}" for name in names)]
    lines += ["", "`pans help COMMAND` lists a command's options. Start with `pans demo`."]
    return "\n".join(lines)


def _grouped(commands: Mapping[str, EntryPoint]) -> Iterator[tuple[str, list[str]]]:
    known = {name for names in GROUPS.values() for name in names}
    for group, names in {**GROUPS, OTHERS: sorted({*commands} - known)}.items():
        if there := [name for name in names if name in commands]:
            yield group, there


def _summary(point: EntryPoint) -> str:
    try:
        return _written_help(point) or load_command(point).help
    except UsageError as error:
        return f"({error.message}; {error.remedy})"
    except Exception as error:  # one package's broken command must not hide all the others
        return f"(cannot be loaded: {error})"


def _written_help(point: EntryPoint) -> str:
    """Return the help as it is written in the command's source, "" if it is not a plain text there: importing all takes a second."""
    try:
        spec = find_spec(point.module)
        source = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
    except (ImportError, AttributeError, OSError):  # loading it says what is wrong
        return ""
    found = re.search(rf'^{point.attr} = Command\(\s*"([^"\\]*)",', source, re.MULTILINE)
    return found[1] if found else ""
