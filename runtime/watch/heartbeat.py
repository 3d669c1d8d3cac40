"""Whether the loop turns, by its own stamp: one rule for the state file, the metrics and systemd.

Owns the limits. The loop stamps `LiveRun.turned_s` at each turn, and while it looks for a lost device at each attempt. Nothing else does.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pans.runtime.live import LiveRun

STALLED_AFTER_S = 0.75  # a turn waits 20 ms at most; the state file, written each second, says "stalled" within 2 s
LOST_STALLED_AFTER_S = 15.0  # while a lost device is looked for: pauses of 2 s, a handshake of 5 s, the upload


def loop_age_s(run: LiveRun) -> float:
    """Return how long ago the loop turned, in seconds."""
    return max(0.0, time.monotonic() - run.turned_s)


def is_stalled(run: LiveRun) -> bool:
    """Whether the loop should have turned by now."""
    return loop_age_s(run) > (STALLED_AFTER_S if run.outage_ns is None else LOST_STALLED_AFTER_S)
