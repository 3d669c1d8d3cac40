"""Which runs can take the compiled turn: the core, the link and the system decide.

Owns the reasons against it, in words for people; never chooses (live/compiled.py does) and never compiles anything.
"""

from __future__ import annotations

import time
from typing import Any

from pans.runtime.core.still import Core
from pans.runtime.link.base import Link

from .system import offered


def excluded(core: Any, link: Link, *, drives: bool) -> str:
    """Return why no compiled turn can be taken with `core`, once warmed up, over `link`; "" where it can."""
    why = (
        _excluded_still(core) if isinstance(core, Core) else getattr(core, "excluded", "the core has no compiled steps")
    )
    if why:
        return str(why)
    if link.virtual:
        return "in virtual time, the host names each state in a turn of its own" if drives else ""
    if missing := offered():
        return missing
    if isinstance(core, Core) and not core.decides_compiled:
        return "the back end is no table and no automaton: it decides in Python"
    before_ns, there_ns = time.perf_counter_ns(), link.now_ns()
    return "" if before_ns <= there_ns <= time.perf_counter_ns() else "the link stamps with a clock of its own"


def _excluded_still(core: Core) -> str:
    if core.counts_photons:
        return "exposures are numbers (photons, or several detectors at once): COUNTS are taken in Python"
    return "" if core.compiles else "--on-dark changes decisions while they are made"
