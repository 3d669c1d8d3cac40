"""Ranges: what a number that arrives from outside may be, and the words of its refusal. Options and fields of files share them."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from datetime import date, time
from typing import Any


@dataclass(frozen=True, slots=True)
class Range:
    """Numbers from `low` to `high`, both allowed; `whole` ones only, or not.

    >>> Range(0, 100, whole=True).checked(7, "label")
    7
    >>> Range(1e-6, 1e6).checked(float("inf"), "scale")
    Traceback (most recent call last):
    ValueError: scale is inf, allowed: a number from 1e-06 to 1e+06
    """

    low: float
    high: float
    whole: bool = False

    @property
    def allowed(self) -> str:
        """What is allowed, in words."""
        noun = "a whole number" if self.whole else "a number"
        low, high = (str(end) if isinstance(end, int) else f"{end:g}" for end in (self.low, self.high))
        return f"{noun} from {low} to {high}"

    def holds(self, value: Any) -> bool:
        """Whether `value` is a number of this range; a boolean is none."""
        kinds = int if self.whole else (int, float)
        return isinstance(value, kinds) and not isinstance(value, bool) and bool(self.low <= value <= self.high)

    def checked(self, value: Any, what: str) -> Any:
        """Return `value`; ValueError if it is not in the range."""
        if not self.holds(value):
            raise ValueError(f"{what} is {number_text(value)}, allowed: {self.allowed}")
        return value

    def option(self, text: str) -> Any:
        """Return the number that an option's `text` stands for: the `type` of an argparse argument."""
        try:
            value: float = int(text) if self.whole else float(text)
        except ValueError:
            value = math.nan
        if not self.holds(value):
            raise argparse.ArgumentTypeError(f"{ascii(text)[1:-1][:40]!r} is not {self.allowed}")
        return value


@dataclass(frozen=True, slots=True)
class Each:
    """An object whose values, or a list whose items, all are of one shape; `size` items, None: any number."""

    kind: type[dict[str, Any]] | type[list[Any]]
    shape: Any
    size: int | None = None


WHOLE = Range(-(1 << 63), (1 << 63) - 1, whole=True)
FINITE = Range(-1e300, 1e300)
COUNT = Range(0, 1 << 53, whole=True)
AMOUNT = Range(0, 1e26)  # photons, microseconds, seconds; 2^64 ticks of a clock of 1 Hz are 2e25 us
SIGNED = Range(-1e26, 1e26)
SHARE = Range(0, 1)
END_OF_INTERVAL = Range(-1e-9, 1 + 1e-9)  # rounding may lead a little beyond a share
OBJECTS = Range(0, (1 << 32) - 1, whole=True)  # a decision has its object as u32


def demand(holds: bool, message: str) -> None:
    """Raise ValueError with `message` unless `holds`."""
    if not holds:
        raise ValueError(message)


def number_text(value: Any) -> str:
    """Return what was found where a number should be, never longer than a line."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 1 << 64:
        return "a whole number beyond 64 bits"
    return (value.isoformat() if isinstance(value, date | time) else ascii(value))[:60]
