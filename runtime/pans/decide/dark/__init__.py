"""Has the detector or the light changed? Dark counts and lit exposures against what is expected.

In: counts of clicks with their exposures. Out: findings with their intervals, alarms, other tables. Start at guard.py; cusum.py has the
test. light_level.py watches the light of fixed patterns, state_watch.py that of automata.
"""

from .cusum import ChannelWatch, WatchSettings
from .guard import DarkGuard, recorded_guard
from .health import LEVELS, ChannelHealth, DarkReport, dark_report
from .light_level import LightWatch
from .state_watch import LOOK_S, TOLERATED, WEEK_S, StateWatch, found_at

__all__ = [
    "LEVELS",
    "LOOK_S",
    "TOLERATED",
    "WEEK_S",
    "ChannelHealth",
    "ChannelWatch",
    "DarkGuard",
    "DarkReport",
    "LightWatch",
    "StateWatch",
    "WatchSettings",
    "dark_report",
    "found_at",
    "recorded_guard",
]
