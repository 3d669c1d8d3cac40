"""The shell around the core while a device runs: one turn after the other, what is late and why, and how a run ends.

Owns the live loop, reconnection and pulses. It decides nothing itself (core, flow), judges
no file (report) and reads no argument (commands). `run_live` takes an open link and a core and returns a `RunResult`.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .config import RunResult
    from .loop import Observers, run_live
    from .reconnect import Recovery
    from .run import LiveCore, LiveRun
    from .run_options import RunOptions

__all__ = ["LiveCore", "LiveRun", "Observers", "Recovery", "RunOptions", "RunResult", "run_live"]

__getattr__ = lazy_names(
    __name__,
    {
        "LiveCore": ".run",
        "LiveRun": ".run",
        "Observers": ".loop",
        "Recovery": ".reconnect",
        "RunOptions": ".run_options",
        "RunResult": ".config",
        "run_live": ".loop",
    },
)
