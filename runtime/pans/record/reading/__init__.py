"""Recordings read back: one file, or parts as one.

In: a path. Out: a `Recording` with messages, decisions, exposures and clock. Start at recording.py; parts.py joins parts.

>>> from pans.record.reading import read_recording
>>> read_recording("none.pansrec")
Traceback (most recent call last):
    ...
pans.base.errors.UsageError: none.pansrec: cannot be read: No such file or directory
  remedy: check the path and its permissions
"""

from .decision_log import skim_decisions
from .exposures import Exposures, click_list, is_dark, iter_exposures
from .format import FORMAT_VERSION, LIMITS, MAGIC, MESSAGE, TIMING_RUN_DTYPE, Kind
from .handshake import handshakes
from .parts import (
    chain_violations,
    earlier_parts,
    files_of_parts,
    find_parts,
    first_decision,
    is_of_parts,
    missing_parts,
    open_recording,
    part_number,
    parts_in,
    stem_of,
)
from .recorded_facts import checked_summary
from .recording import Recording, read_recording, together
from .sent_plan import TICK_HZ, recorded_plan, sent_to_device

__all__ = [
    "FORMAT_VERSION",
    "LIMITS",
    "MAGIC",
    "MESSAGE",
    "TICK_HZ",
    "TIMING_RUN_DTYPE",
    "Exposures",
    "Kind",
    "Recording",
    "chain_violations",
    "checked_summary",
    "click_list",
    "earlier_parts",
    "files_of_parts",
    "find_parts",
    "first_decision",
    "handshakes",
    "is_dark",
    "is_of_parts",
    "iter_exposures",
    "missing_parts",
    "open_recording",
    "part_number",
    "parts_in",
    "read_recording",
    "recorded_plan",
    "sent_to_device",
    "skim_decisions",
    "stem_of",
    "together",
]
