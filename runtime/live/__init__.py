"""A run on a device that is open: it receives, decides, acts, records and ends; it reconnects when the device is lost.

In come a link, a plan, a core and `RunOptions`; out comes a `RunResult` (`run_live`). Start with loop.py (the whole run), then run.py (one
iteration) and receiver.py (what a call of the kernel brought). Decisions are the core's, verdicts the report's.
"""

from .loop import Observers, run_live
from .reconnect import Recovery
from .run import LiveRun
from .run_options import RunOptions
from .tally import RunResult

__all__ = ["LiveRun", "Observers", "Recovery", "RunOptions", "RunResult", "run_live"]
