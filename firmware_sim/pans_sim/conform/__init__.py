"""Every rule of the protocol tried on a device over its real link (`pans conform URL`).

A link and a profile go in; a finding for each rule of docs/reference/protocol.md, section 12, comes out: kept, broken or not tried, with
the bytes. Start with judge.py; the rules stand in rules/, and registry.py has their table. The device needs nothing but the protocol.
"""

from .judge import Finding, conform
from .registry import RULES, Rule

__all__ = ["RULES", "Finding", "Rule", "conform"]
