"""The conformance kit: every rule of the protocol tried on a device over its real link (`pans conform URL`).

Each rule of docs/reference/protocol.md, section 12, has a check that sends what the rule speaks of and judges what comes back. `conform`
tries them all and returns a verdict for each, with the bytes; it never decides anything about light or clicks. A check needs nothing of the
device but the protocol: it is meant for a lab's own firmware.
"""

from .judge import Finding, conform
from .rules import RULES, Rule

__all__ = ["RULES", "Finding", "Rule", "conform"]
