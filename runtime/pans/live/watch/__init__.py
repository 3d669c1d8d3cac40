"""What observes a run in threads of its own: state file, metrics, systemd, the computer, a watchdog.

In: a run and its recorder. Out: a flat set of figures, as a file and over HTTP. The loop never waits for them. Start at watchers.py.
"""

from .metrics import MetricsServer, check_address, is_loopback, is_public, parse_address
from .osc import OscSender
from .state_file import read_state
from .watchdog import Watchdog
from .watchers import Watchers

__all__ = [
    "MetricsServer",
    "OscSender",
    "Watchdog",
    "Watchers",
    "check_address",
    "is_loopback",
    "is_public",
    "parse_address",
    "read_state",
]
