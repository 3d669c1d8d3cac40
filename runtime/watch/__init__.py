"""What watches a run from beside its loop: state file, metrics, systemd, the computer around it, and the end of a process that hangs.

A `LiveRun` and its recorder come in; a flat picture of the run goes out, as a file and over HTTP. All of it runs in threads of its own,
which the loop never waits for. Begin with `watchers.py`.
"""

from .metrics import MetricsServer
from .state_file import StateFile, picture_of, resources_used
from .watchdog import Watchdog
from .watchers import Watchers

__all__ = ["MetricsServer", "StateFile", "Watchdog", "Watchers", "picture_of", "resources_used"]
