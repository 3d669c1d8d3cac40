"""Who watches a run from beside the loop: the state file, metrics, systemd, and the watchdog that ends a process that hangs.

Owns the picture of a run, its ways out, and the end of a run that cannot end itself; all of it runs in threads of its own and judges by the
loop's own heartbeat (`LiveRun.turned_s`). Never takes part in a run: nothing here is waited for by the loop.
"""

from typing import TYPE_CHECKING

from pans.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from .attendants import Attendants
    from .metrics import MetricsServer
    from .state_file import StateFile, picture_of, resources_used
    from .watchdog import Watchdog

__all__ = ["Attendants", "MetricsServer", "StateFile", "Watchdog", "picture_of", "resources_used"]

__getattr__ = lazy_names(
    __name__,
    {
        "Attendants": ".attendants",
        "MetricsServer": ".metrics",
        "StateFile": ".state_file",
        "Watchdog": ".watchdog",
        "picture_of": ".state_file",
        "resources_used": ".state_file",
    },
)
