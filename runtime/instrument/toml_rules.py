"""What a key of one of our TOML files may hold, and the words in which a wrong one is refused.

Owns the kinds of keys and the small talk of error messages; never reads a file and knows no file's own keys (profile_check.py and the
simulator's scenes do). Pure functions of the value that was found.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Key:
    """One key: its kind, its range (for numbers) and whether it must be there."""

    kind: str  # "text", "whole", "number", or "names" (a list of texts)
    low: float = 0.0
    high: float = 0.0
    above: bool = False  # low itself is not allowed
    required: bool = True
    infinite: bool = False  # inf is a meaning, not a mistake
    choices: tuple[str, ...] = ()

    def fits(self, value: Any) -> bool:
        """Whether the type is right: a boolean is no number, a whole number is one."""
        if self.kind == "text":
            return isinstance(value, str)
        if self.kind == "names":
            return isinstance(value, list) and all(isinstance(one, str) for one in value)
        return isinstance(value, int if self.kind == "whole" else (int, float)) and not isinstance(value, bool)

    def within(self, value: Any) -> bool:
        """Whether a value of the right type is an allowed one; nan is in no range."""
        if self.kind == "text":
            return value in self.choices if self.choices else bool(value.strip())
        if self.kind == "names":
            return all(one.strip() for one in value)
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
        noun = "a whole number" if self.kind == "whole" else "a number"
        low, high = f"{self.low:.12g}", f"{self.high:.12g}"
        limits = f"above {low} and at most {high}" if self.above else f"from {low} to {high}"
        return f"{noun} {limits}{', or inf' if self.infinite else ''}"


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
    if kind == "text":
        return "write the value in double quotes"
    if kind == "names":
        return 'for example ["null"]'
    if isinstance(value, str):
        return "write the number without quotes"
    if kind == "whole" and isinstance(value, float) and value.is_integer():
        return f"write {int(value)} without a decimal point or exponent"
    return "write a plain number"


def near(name: str, known: list[str], form: str = "{}", page: str = "docs/reference/profiles.md") -> str:
    """The known name that was probably meant, or the page that explains them all."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {form.format(close[0])}?" if close else f"{page} explains every key"
