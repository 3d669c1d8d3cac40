"""The one exception tree; each class knows the exit code that the command line returns for it: 2, or 3 of devices and links.

A message says what, found, allowed and where; `remedy` is the next step. Damaged bytes, lost frames and late deadlines are
measurements, not exceptions: they are counted, flagged and reported. Exceptions are raised only when results could no longer be trusted.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from contextlib import contextmanager

# Exit codes of the contract (docs/reference/exit-codes.md)
EXIT_FINE, EXIT_ALERT, EXIT_USAGE, EXIT_DEVICE, EXIT_TIMING, EXIT_INTERRUPTED = 0, 1, 2, 3, 4, 130
EXIT_INTERNAL = 70  # a fault of pans itself: EX_SOFTWARE of sysexits.h

# a command in backticks, which stays, or an option of `pans train` and its value
_OPTION = re.compile(
    r"`pans [^`]*`|(?:pans train )?--([a-z][a-z-]*)"
    r"(?: ([0-9][\w.:]*|[A-Z]\b|active|automaton|coherent|local|host|[a-z0-9]+(?:-[a-z0-9]+)+))?"
)


class PansError(Exception):
    """Base of all errors raised on purpose; `remedy` is one sentence that says what to do next ("" if nothing helps)."""

    exit_code = 2
    usual_remedy = ""  # shown where an error brings none of its own

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}\n  remedy: {self.remedy}" if self.remedy else self.message


class UsageError(PansError):
    """A command or an argument that makes no sense."""

    usual_remedy = "`pans help COMMAND` explains the options"


class ConfigError(PansError):
    """A profile, calibration or scene that says something impossible; the message starts with file:line:col."""

    usual_remedy = "correct the file there; docs/reference lists every field"


class PlanError(PansError):
    """What is asked for cannot be done by this hardware; the message holds the numbers."""

    usual_remedy = "ask for less, or choose another profile"


class DamagedFileError(PansError):
    """A bundle or recording that is truncated, altered, oversized or inconsistent."""

    usual_remedy = "copy or make the file again"


class RecordingError(PansError):
    """The recording cannot be written any further: the disk is full, or gone."""

    usual_remedy = "make room on the disk, and run again"


class LinkError(PansError):
    """The device cannot be reached, or went away."""

    exit_code = 3
    usual_remedy = "`pans devices` lists what is connected, `pans doctor` checks this machine"


class DeviceError(LinkError):
    """The device answered, and refused."""


@contextmanager
def as_usage_error() -> Iterator[None]:
    """Turn a ValueError of numeric code into a UsageError of the same words, where what a user gave is at fault.

    >>> with as_usage_error():
    ...     raise ValueError("levels is 1, allowed: 2 to 65536")
    Traceback (most recent call last):
        ...
    pans.base.errors.UsageError: levels is 1, allowed: 2 to 65536
    """
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


@contextmanager
def in_python_words(keywords: Container[str] | None = None) -> Iterator[None]:
    """Let an error that is raised within name keywords of a call instead of options of a command; those not in `keywords` are in `options`.

    >>> with in_python_words(["features"]):
    ...     raise PlanError("12 patterns, --shots is 2", remedy="--features 10, or fewer")
    Traceback (most recent call last):
        ...
    pans.base.errors.PlanError: 12 patterns, options["shots"] is 2
      remedy: features=10, or fewer
    """

    def keyword(found: re.Match[str]) -> str:
        if found[1] is None:
            return found[0]
        name, value = found[1].replace("-", "_"), "True" if found[1] == "force" else found[2]
        if value is not None and value[0].islower():
            value = f'"{value}"'
        if keywords is None or name in keywords:
            return name if value is None else f"{name}={value}"
        return f'options["{name}"]' if value is None else f'options={{"{name}": {value}}}'

    try:
        yield
    except PansError as error:
        error.message, error.remedy = (_OPTION.sub(keyword, text) for text in (error.message, error.remedy))
        error.args = (error.message,)
        raise


@contextmanager
def refusing(what: str, remedy: str = "") -> Iterator[None]:
    """Turn an error of the operating system into a UsageError that says `what` cannot be done, and the system's reason.

    >>> with refusing("notes.txt: cannot be read"):
    ...     raise FileNotFoundError(2, "No such file or directory")
    Traceback (most recent call last):
        ...
    pans.base.errors.UsageError: notes.txt: cannot be read: No such file or directory
    """
    try:
        yield
    except OSError as error:
        raise UsageError(f"{what}: {error.strerror or error}", remedy=remedy) from error
