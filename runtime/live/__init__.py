"""The shell around the core while a device runs: one turn after the other, what is late and why, and how a run ends.

Owns the live loop, reconnection and pulses. It decides nothing itself (core, flow), judges
no file (report) and reads no argument (commands). `run_live` takes an open link and a core and returns a `RunResult`.
"""

from .config import RunResult
from .loop import Observers, run_live
from .reconnect import Recovery
from .run import LiveRun
from .run_options import RunOptions

__all__ = ["LiveRun", "Observers", "Recovery", "RunOptions", "RunResult", "run_live"]
