"""A contradiction: a message that plan, clock or other messages exclude. An event of the protocol, made by cores and by the clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A message that the plan, the clock or the device's other messages exclude: in `what`, `found` stands where `expected` is due."""

    what: str
    exposure_index: int
    found: int
    expected: int

    def event(self) -> dict[str, Any]:
        """Return it as an event for the recording."""
        facts = {"exposure_index": self.exposure_index, "found": self.found, "expected": self.expected}
        return {"kind": "contradiction", "what": self.what, **facts}
