"""What an instrument can do, when its detector clicks, how it was measured, and whether it still is so.

Owns hardware profiles, the click law, calibrations and the statistical tests that a run holds against them (dark counts, dead channels,
the level of light). It talks to no device and decides nothing: a test returns findings, core/dark_guard.py acts on them.

>>> from pans.runtime.instrument import load_profile
>>> load_profile("oled-qcmos").mode
'sequential'
"""

from .calibration import Calibration, load_calibration
from .click_law import ClickLaw, click_law, click_probability
from .cusum import ChannelWatch
from .dead_channels import DeadChannelTest
from .dead_time import DeadTime
from .profile import Profile, load_profile, parse_profile, shipped_profiles

__all__ = [
    "Calibration",
    "ChannelWatch",
    "ClickLaw",
    "DeadChannelTest",
    "DeadTime",
    "Profile",
    "click_law",
    "click_probability",
    "load_calibration",
    "load_profile",
    "parse_profile",
    "shipped_profiles",
]
